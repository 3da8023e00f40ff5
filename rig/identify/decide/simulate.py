"""Simulates stops of the same design as measured ones, under a known explanation.

The measured course of torque is replayed with a weak feedback on sliding, as a WSP would give, so
that the simulated wheels go through the same speeds and slidings without copying the measured
noise. Irregularity of the rail, noise and calibration are drawn again. Without a cause this shows
what "nothing is wrong" looks like. With a cause it shows what the method makes of that cause.

    [Q1] C = C_measured + K (s_measured - s), smoothed; wheel and vehicle as in `replay`
    [Q2] field = rail(x) + run_i(x) + axle_ij(x), Ornstein-Uhlenbeck in distance; shares by
         `rail.shares`
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.compiled.variants import variant
from rollerrig.rig.compiled.vector_math import MATH
from rollerrig.rig.identify.causes import columns, discrepancy
from rollerrig.rig.identify.causes.candidates import Explanation, inputs
from rollerrig.rig.identify.data import pulses
from rollerrig.rig.identify.data.parameters import MEMORY, RADIUS
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.data.pulses import PulseSensor, Sensor
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.replay import lanes, replay
from rollerrig.rig.identify.replay.rail import USUAL, RailShares
from rollerrig.rig.identify.replay.sensitivity import Inputs

SUBSTEPS = 5
# feedback on sliding, as a WSP would give: torque in N m for a sliding that is too small by 1 m/s
FEEDBACK_NS = 2000.0
FEEDBACK_LAG_S = 0.4
VENTING_GAIN = 3.0  # the feedback is stronger by this where sliding is too large by more than
VENTING_SLIDING_M_S = 1.0  # this: the WSP vents the brake
SLOWEST_M_S = 0.3
LARGEST_EXPONENT = 2.0  # of a step where adhesion falls steeply: the growth is limited to e^2
SMALLEST_EXPONENT = 1e-6  # below it (e^x - 1) / x is 1
_GRID_M = 0.25  # of the irregularity of the rail
_GRID_CELLS_IN_FRONT = 400.0  # the grid begins 100 m before the start of a stop
_GRID_MARGIN_M = 150.0  # more than the stop needs: 100 m before its start, 50 m behind its end
_LOAD_SMOOTHING_SAMPLES = 20.0  # what is faster in a measured load is noise
_END_SHARE = 0.98  # of the last speed of the measured run

# The rows of the state and of the inputs begin here in the cells, which are those of `lanes`. They
# are below the rows of the parameters, where `lanes.lane_model` reads.
OMEGA = 0
FEEDBACK = OMEGA + lanes.MOST_LANES
LAMBDA = FEEDBACK + lanes.MOST_LANES
SURFACE = LAMBDA + lanes.MOST_LANES
LOAD = SURFACE + lanes.MOST_LANES
DEGRADED = LOAD + lanes.MOST_LANES
RECOVERED = DEGRADED + lanes.MOST_LANES
SLIDING = RECOVERED + lanes.MOST_LANES
TORQUE = SLIDING + lanes.MOST_LANES
IRREGULARITY = TORQUE + lanes.MOST_LANES
FORCE = IRREGULARITY + lanes.MOST_LANES


@kernel_inlined
def wheel_step(
    omega,
    feedback,
    lambda_,
    surface,
    load,
    degraded,
    recovered,
    wanted_sliding,
    irregularity,
    torque,
    model,
    h,
):
    """Return (omega, feedback, lambda, force on the vehicle) of one wheelset after a step h [Q1].

    The force in N is the mean of the step: what wheel and brake leave for the vehicle. The step is
    that of `replay.predict`, with bounds for a substep that is shorter.
    """
    r = model.wheel_radius_m
    inertia = model.wheelset_inertia_kgm2

    sliding = surface - r * omega
    f, slope, lambda_ = replay.wheel_adhesion(
        sliding,
        surface,
        0.5 * load,
        degraded,
        recovered,
        model,
        lambda_,
        replay.lag_share(surface, h, model),
    )

    missing = wanted_sliding - sliding
    aim = FEEDBACK_NS * missing + VENTING_GAIN * FEEDBACK_NS * min(
        missing + VENTING_SLIDING_M_S, 0.0
    )
    feedback += (aim - feedback) * h / FEEDBACK_LAG_S
    brake = max(0.0, torque + feedback)

    # exponential Euler step
    roughness = math.exp(irregularity)
    contact_N = load * f * roughness
    error_rate_1_s = -r * r * load * slope * roughness / inertia
    x = min(error_rate_1_s * h, LARGEST_EXPONENT)
    mean_growth = math.expm1(x) / x if abs(x) > SMALLEST_EXPONENT else 1.0
    change = h * mean_growth * (r * contact_N - brake) / inertia
    force = (brake + inertia * change / h) / r
    return max(0.0, omega + change), feedback, lambda_, force


@kernel_inlined
def _drive(
    torque,
    sliding,
    load,
    friction,
    surface,
    field,
    place,
    parameters,
    mass,
    extra_N,
    resistance,
    speed0,
    step_s,
    on_rollers,
    cells,
    out_speed,
    out_wheel,
    out_torque,
):
    """Do what `drive` does; return False, with the work unfinished, if a force is NaN."""
    n = len(torque)
    h = step_s / SUBSTEPS
    v = speed0
    x = 0.0
    wheelsets = len(parameters)
    lanes.store_models(parameters, cells)
    for j in range(wheelsets):
        cells[OMEGA + j] = (v - sliding[0, j]) / parameters[j, RADIUS]
        cells[FEEDBACK + j] = 0.0
        cells[LAMBDA + j] = 0.0

    for k in range(n):
        out_speed[k] = v
        for j in range(wheelsets):
            out_wheel[k, j] = cells[OMEGA + j]
            out_torque[k, j] = max(0.0, torque[k, j] + cells[FEEDBACK + j])
        if k + 1 == n:
            break

        for i in range(SUBSTEPS):
            w = (i + 0.5) / SUBSTEPS  # the middle of the substep, between the two samples
            force = resistance[0] + resistance[1] * v + resistance[2] * v * v + extra_N[k]
            for j in range(wheelsets):
                cells[SURFACE + j] = v
                if on_rollers:
                    cells[SURFACE + j] = (1.0 - w) * surface[k, j] + w * surface[k + 1, j]
                cells[LOAD + j] = (1.0 - w) * load[k, j] + w * load[k + 1, j]
                cells[DEGRADED + j] = (1.0 - w) * friction[0, k, j] + w * friction[0, k + 1, j]
                cells[RECOVERED + j] = (1.0 - w) * friction[1, k, j] + w * friction[1, k + 1, j]
                cells[SLIDING + j] = (1.0 - w) * sliding[k, j] + w * sliding[k + 1, j]
                cells[TORQUE + j] = (1.0 - w) * torque[k, j] + w * torque[k + 1, j]
                at = (x - place[j]) / _GRID_M + _GRID_CELLS_IN_FRONT
                cell = min(max(int(at), 0), field.shape[0] - 2)
                share = min(max(at - cell, 0.0), 1.0)
                cells[IRREGULARITY + j] = (1.0 - share) * field[cell, j] + share * field[
                    cell + 1, j
                ]
            for j in range(wheelsets):
                omega, feedback, lambda_, force_of_wheelset = wheel_step(
                    cells[OMEGA + j],
                    cells[FEEDBACK + j],
                    cells[LAMBDA + j],
                    cells[SURFACE + j],
                    cells[LOAD + j],
                    cells[DEGRADED + j],
                    cells[RECOVERED + j],
                    cells[SLIDING + j],
                    cells[IRREGULARITY + j],
                    cells[TORQUE + j],
                    lanes.lane_model(cells, j),
                    h,
                )
                cells[OMEGA + j] = omega
                cells[FEEDBACK + j] = feedback
                cells[LAMBDA + j] = lambda_
                cells[FORCE + j] = force_of_wheelset
            for j in range(wheelsets):
                force += cells[FORCE + j]
            if math.isnan(force):
                return False
            x += h * v
            v = max(SLOWEST_M_S, v - h * force / mass)
    return True


_drive_in_lanes = variant(_drive, wheel_step=variant(wheel_step, math=MATH, replay=lanes.REPLAY))


@kernel
def drive(
    torque,
    sliding,
    load,
    friction,
    surface,
    field,
    place,
    parameters,
    mass,
    extra_N,
    resistance,
    speed0,
    step_s,
    on_rollers,
    cells,
    out_speed,
    out_wheel,
    out_torque,
):
    """Simulate one stop [Q1] and write speed (n,), and wheel speed and torque (n, axles).

    `torque`, `sliding`, `load` and `surface` (n, axles) and `friction` (2, n, axles) are inputs;
    with `on_rollers` the surface has the speeds of `surface`, otherwise that of the vehicle.
    `field` (cells, axles) is the irregularity of the rail, `place` (axles,) the distance of the
    wheelsets behind the first one. `extra_N` (n,) is added to the `resistance` (A, B, C). `cells`
    (lanes.CELLS,) is work space.
    """
    # vector code has no adhesion memory, and no adhesion law where recovered is below degraded
    done = False
    if parameters[0, MEMORY] <= 0.0:
        done = _drive_in_lanes(
            torque,
            sliding,
            load,
            friction,
            surface,
            field,
            place,
            parameters,
            mass,
            extra_N,
            resistance,
            speed0,
            step_s,
            on_rollers,
            cells,
            out_speed,
            out_wheel,
            out_torque,
        )
    if not done:
        _drive(
            torque,
            sliding,
            load,
            friction,
            surface,
            field,
            place,
            parameters,
            mass,
            extra_N,
            resistance,
            speed0,
            step_s,
            on_rollers,
            cells,
            out_speed,
            out_wheel,
            out_torque,
        )


@kernel
def add_share_of_previous(share, values):
    """Add to each row of values (n, columns) a share of the row before, in place and in order."""
    for k in range(1, len(values)):
        for j in range(values.shape[1]):
            values[k, j] += share * values[k - 1, j]


def field(
    rng: np.random.Generator,
    length_m: float,
    sigma: float,
    correlation_m: float,
    columns_wanted: int,
) -> np.ndarray:
    """Return an irregularity of deviation sigma on a grid of 0.25 m, shape (cells, columns).

    The grid begins 100 m before the start and has room for `length_m`.
    """
    cells = int((length_m + _GRID_MARGIN_M) / _GRID_M)
    keep = math.exp(-_GRID_M / correlation_m)
    fresh = math.sqrt(1.0 - keep * keep)
    values = rng.normal(size=(cells, columns_wanted)) * sigma * fresh
    # the first cell has no cell before it, and yet the full deviation
    values[0] /= fresh
    add_share_of_previous(keep, values)
    return values


class _CalibrationErrors(NamedTuple):
    """The errors of calibration of one simulated recording, as shares."""

    torque: np.ndarray  # (axles,)
    load: np.ndarray  # (axles,)
    mass: float


class _SharedInputs(NamedTuple):
    """What all runs of a simulated recording share."""

    replay: Inputs  # of the explanation
    torque_Nm: np.ndarray  # flat: the torque that acts, smooth
    sliding_m_s: np.ndarray  # flat: the sliding that the feedback aims at
    errors: _CalibrationErrors
    brake_share: np.ndarray  # flat: the torque that acts over the recorded one, less 1
    late: tuple[float, float]  # both parts of [D3] of `data/pulses`


def runs(
    data: Dataset,
    design: Design,
    measured: list[Run],
    explanation: Explanation,
    rng: np.random.Generator,
    shares: RailShares = USUAL,
) -> list[Run]:
    """Return simulated stops like the measured ones, under an explanation, with fresh noise.

    `shares` says how much of the irregularity the wheelsets have in common.
    """
    # the wheels react in time; a sensor of pulses shows it later
    in_time = design._replace(wheel_sensor=PulseSensor(Sensor.DIRECT))
    replay_inputs = inputs(in_time, explanation)

    # the gain of all torques and that of a wheelset share the tolerance
    gain_tolerance = design.calibration / math.sqrt(2.0)
    gain_of_all = rng.normal(0.0, gain_tolerance)
    errors = _CalibrationErrors(
        torque=gain_of_all + rng.normal(0.0, gain_tolerance, design.axles),
        load=rng.normal(0.0, design.calibration, design.axles),
        mass=rng.normal(0.0, design.calibration),
    )
    brake = discrepancy.brake_share(design, discrepancy.draw_brake(design, rng))
    assert brake is not None
    late_window = explanation.base.get(discrepancy.LATE_WINDOW, 0.0)
    late_pulse = explanation.base.get(discrepancy.LATE_PULSE, 0.0)

    # the measured sliding, with the wheel radius of the explanation
    radius_m = np.repeat(replay_inputs.parameters[:, RADIUS], np.diff(design.start))
    wheel_rad_s = (design.speed_m_s - design.sliding_m_s) / design.base[RADIUS]
    shared = _SharedInputs(
        replay=replay_inputs,
        torque_Nm=columns.smooth_torque(design, replay_inputs.torque_Nm),
        sliding_m_s=design.speed_m_s - radius_m * wheel_rad_s,
        errors=errors,
        brake_share=brake,
        late=(late_window, late_pulse),
    )

    # a rail for all runs, one for each run, and what each wheelset adds
    longest_s = float(np.max(np.diff(design.start))) * design.step_s
    longest_m = longest_s * float(design.speed_m_s.max())
    of_all = explanation.sigma * math.sqrt(shares.in_all)
    of_run = explanation.sigma * math.sqrt(shares.in_run - shares.in_all)
    of_wheelset = explanation.sigma * math.sqrt(1.0 - shares.in_run)
    # runs may begin at different places of the same rail
    starts_m = [0.0 if run.position_m is None else float(run.position_m[0]) for run in measured]
    longest_m += max(starts_m) - min(starts_m)
    rail = field(rng, longest_m, of_all, explanation.length_m, 1)
    simulated = []
    for number, run in enumerate(measured):
        irregularity = rail + field(rng, longest_m, of_wheelset, explanation.length_m, design.axles)
        if of_run > 0.0:
            irregularity += field(rng, longest_m, of_run, explanation.length_m, 1)
        # the grid of a run begins 100 m before its start
        before = int((starts_m[number] - min(starts_m)) / _GRID_M)
        irregularity = np.ascontiguousarray(irregularity[before:])
        simulated.append(_simulate_run(data, design, run, number, shared, irregularity, rng))
    return simulated


def _simulate_run(
    data: Dataset,
    design: Design,
    run: Run,
    number: int,
    shared: _SharedInputs,
    irregularity: np.ndarray,
    rng: np.random.Generator,
) -> Run:
    """Return the simulated recording of run `number`; `irregularity` is that of `field`."""

    def by_axle(flat: np.ndarray) -> np.ndarray:
        return design.by_axle(flat, number)

    # the stop
    replay_inputs = shared.replay
    errors = shared.errors
    surface_m_s = by_axle(design.speed_m_s)
    samples = run.time_s.size
    axles = design.axles
    speed_m_s = np.empty(samples)
    wheel_rad_s = np.empty((samples, axles))
    torque_Nm = np.empty((samples, axles))
    drive(
        by_axle(shared.torque_Nm),
        by_axle(shared.sliding_m_s),
        by_axle(replay_inputs.load_N) * (1.0 + errors.load),
        np.array([by_axle(factor) for factor in replay_inputs.friction]),
        surface_m_s,
        irregularity,
        data.axle_position_m,
        replay_inputs.parameters[axles * number : axles * (number + 1)],
        replay_inputs.mass_kg[number] * (1.0 + errors.mass),
        replay_inputs.force_N[design.vehicle_span(number)],
        design.resistance,
        float(surface_m_s[0, 0]),
        design.step_s,
        run.surface_m_s is not None,
        np.empty(lanes.CELLS),
        speed_m_s,
        wheel_rad_s,
        torque_Nm,
    )

    # the sensors: a cause in the torque or its timing acts, but the recording does not show it
    hidden_Nm = by_axle(shared.torque_Nm - columns.smooth_torque(design, design.torque_Nm))
    shown_Nm = torque_Nm - hidden_Nm
    smooth_load_N = gaussian_filter1d(run.load_N, _LOAD_SMOOTHING_SAMPLES, axis=0)
    load_noise_N = float(np.std(run.load_N - smooth_load_N))

    # the recording ends at about the last speed of the measured run
    slow = np.flatnonzero(speed_m_s < _END_SHARE * float(surface_m_s[-1, 0]))
    n = int(slow[0]) if slow.size else samples

    # the order of these draws decides the results
    wheel_noise_rad_s = rng.normal(0.0, design.wheel_noise_rad_s, (n, axles))
    speed_noise_m_s = rng.normal(0.0, design.speed_noise_m_s, n)
    load_noise = rng.normal(0.0, load_noise_N, (n, axles))
    torque_noise_Nm = rng.normal(0.0, design.torque_noise_Nm[number], (n, axles))
    sensor = design.wheel_sensor
    if sensor.kind is Sensor.COUNTED:
        shown_rad_s = pulses.counted(wheel_rad_s[:n], sensor.quantum_rad_s, rng)
    elif sensor.kind is Sensor.TIMED:
        late_window, late_pulse = shared.late
        shown_rad_s = pulses.timed(
            sensor, wheel_rad_s[:n], design.step_s, late_window, late_pulse, rng
        )
    else:
        shown_rad_s = wheel_rad_s[:n] + wheel_noise_rad_s
    brake_share = by_axle(shared.brake_share)[:n]
    return run._replace(
        time_s=run.time_s[:n],
        speed_m_s=speed_m_s[:n] + speed_noise_m_s,
        wheel_speed_rad_s=shown_rad_s,
        load_N=by_axle(design.load_N)[:n] + load_noise,
        torque_Nm=shown_Nm[:n] * (1.0 + errors.torque - brake_share) + torque_noise_Nm,
        position_m=None if run.position_m is None else run.position_m[:n],
        surface_m_s=None if run.surface_m_s is None else run.surface_m_s[:n],
    )
