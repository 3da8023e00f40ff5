"""Simulates stops of the same design as measured ones, under a known explanation.

The measured course of torque is replayed with a weak feedback on sliding, as a WSP would give, so
that the simulated wheels go through the same speeds and slidings without copying the measured
noise. Irregularity of the rail, noise and calibration are drawn afresh. With no cause in it this is
what "nothing is wrong" looks like; with a cause it tells what the method would make of it.

    [Q1] C = C_measured + K (s_measured - s), smoothed; wheel and vehicle as in `replay`
    [Q2] field = rail(x) + axle_j(x), equal shares, Ornstein-Uhlenbeck in distance; rail(x) is the
         same for all runs
"""

import math

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.compiled.variants import variant
from rollerrig.rig.compiled.vector_math import MATH
from rollerrig.rig.identify.causes import columns
from rollerrig.rig.identify.causes.candidates import Explanation, inputs
from rollerrig.rig.identify.data.parameters import MEMORY, RADIUS
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.data.runs import AXLES, Dataset, Run
from rollerrig.rig.identify.replay import lanes, replay
from rollerrig.rig.identify.replay.sensitivity import Inputs

SUBSTEPS = 5
# feedback on sliding, as a WSP would give: torque in N m for a sliding that is too small by 1 m/s
FEEDBACK_NS = 2000.0
FEEDBACK_LAG_S = 0.4
VENTING_GAIN = 3.0  # the feedback is stronger by this where sliding is too large by more than
VENTING_SLIDING_M_S = 1.0  # this: the WSP vents the brake
SLOWEST_M_S = 0.3
_GRID_M = 0.25  # of the irregularity of the rail
_GRID_CELLS_IN_FRONT = 400.0  # the grid begins 100 m before the start of a stop

# The cells hold a number for each wheelset; the rows of the state and of the inputs begin here. They
# are below the rows of the parameters, where `lanes.lane_model` reads.
OMEGA = 0
FEEDBACK = OMEGA + AXLES
LAMBDA = FEEDBACK + AXLES
SURFACE = LAMBDA + AXLES
LOAD = SURFACE + AXLES
DEGRADED = LOAD + AXLES
RECOVERED = DEGRADED + AXLES
SLIDING = RECOVERED + AXLES
TORQUE = SLIDING + AXLES
IRREGULARITY = TORQUE + AXLES
FORCE = IRREGULARITY + AXLES


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
    """Returns (omega, feedback, lambda, force on the vehicle) of one wheelset after a step h [Q1].

    The force in N is the mean of the step: what wheel and brake leave for the vehicle.
    """
    r = model.wheel_radius_m
    missing = wanted_sliding - (surface - r * omega)
    aim = FEEDBACK_NS * missing + VENTING_GAIN * FEEDBACK_NS * min(
        missing + VENTING_SLIDING_M_S, 0.0
    )
    feedback += (aim - feedback) * h / FEEDBACK_LAG_S
    brake = max(0.0, torque + feedback)
    step = replay.wheel_step(
        omega,
        surface,
        load,
        brake,
        degraded,
        recovered,
        math.exp(irregularity),
        model,
        lambda_,
        replay.lag_share(surface, h, model),
        h,
    )
    force = (brake + model.wheelset_inertia_kgm2 * step.change_rad_s / h) / r
    return max(0.0, omega + step.change_rad_s), feedback, step.lambda_, force


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
    """Does what `drive` does; returns False, with the work unfinished, where a force is NaN."""
    n = len(torque)
    h = step_s / SUBSTEPS
    v = speed0
    x = 0.0
    lanes.store_models(parameters, cells)
    for j in range(AXLES):
        cells[OMEGA + j] = (v - sliding[0, j]) / parameters[j, RADIUS]
        cells[FEEDBACK + j] = 0.0
        cells[LAMBDA + j] = 0.0

    for k in range(n):
        out_speed[k] = v
        for j in range(AXLES):
            out_wheel[k, j] = cells[OMEGA + j]
            out_torque[k, j] = max(0.0, torque[k, j] + cells[FEEDBACK + j])
        if k + 1 == n:
            break

        for i in range(SUBSTEPS):
            w = (i + 0.5) / SUBSTEPS  # the middle of the substep, between the two samples
            force = resistance[0] + resistance[1] * v + resistance[2] * v * v + extra_N[k]
            for j in range(AXLES):
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
            for j in range(AXLES):
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
            for j in range(AXLES):
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
    """Simulates one stop [Q1] and writes speed (n,), and wheel speed and torque (n, AXLES).

    `torque`, `sliding`, `load` and `surface` (n, AXLES) and `friction` (2, n, AXLES) are inputs; with
    `on_rollers` the surface has the speeds of `surface`, otherwise that of the vehicle. `field` (cells,
    AXLES) is the irregularity of the rail, `place` (AXLES,) the distance of the wheelsets behind the
    first one. `extra_N` (n,) is added to the `resistance` (A, B, C). `cells` (lanes.CELLS,) is work
    space.
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
def remembering(keep, values):
    """Values (n, columns), each with a share of the one before added to it, in place."""
    for k in range(1, len(values)):
        for j in range(values.shape[1]):
            values[k, j] += keep * values[k - 1, j]


def field(
    rng: np.random.Generator,
    length_m: float,
    sigma: float,
    correlation_m: float,
    columns_wanted: int,
) -> np.ndarray:
    """Irregularity on a grid of 0.25 m from -100 m on, shape (cells, columns), deviation sigma."""
    cells = int((length_m + 150.0) / _GRID_M)
    keep = math.exp(-_GRID_M / correlation_m)
    white = rng.normal(size=(cells, columns_wanted)) * sigma * math.sqrt(1.0 - keep * keep)
    white[0] /= math.sqrt(1.0 - keep * keep)
    remembering(keep, white)
    return white


def runs(
    data: Dataset,
    design: Design,
    measured: list[Run],
    explanation: Explanation,
    rng: np.random.Generator,
) -> list[Run]:
    """Simulated stops like the measured ones, under an explanation, with fresh noise."""
    i = inputs(design, explanation)
    tolerance = design.calibration / math.sqrt(2.0)
    gain = rng.normal(0.0, tolerance) + rng.normal(0.0, tolerance, AXLES)
    lift, weight = rng.normal(0.0, design.calibration, AXLES), rng.normal(0.0, design.calibration)
    torque = columns.smooth_torque(design, i.torque_Nm)
    # the sliding that the feedback aims at, with the wheel radius of the explanation
    radius = np.repeat(i.parameters[:, RADIUS], np.diff(design.start))
    wheel = (design.speed_m_s - design.sliding_m_s) / design.base[RADIUS]
    sliding = design.speed_m_s - radius * wheel
    # all runs go over the same rail: what it does to one it does to the next
    longest = float(np.max(np.diff(design.start))) * design.step_s * float(design.speed_m_s.max())
    half = explanation.sigma * math.sqrt(0.5)
    rail = field(rng, longest, half, explanation.length_m, 1)
    made = []
    for r, run in enumerate(measured):
        grid = np.ascontiguousarray(rail + field(rng, longest, half, explanation.length_m, AXLES))
        made.append(_run(data, design, run, r, i, grid, torque, sliding, gain, lift, weight, rng))
    return made


def _run(
    data: Dataset,
    design: Design,
    run: Run,
    r: int,
    i: Inputs,
    grid: np.ndarray,
    torque: np.ndarray,
    sliding: np.ndarray,
    gain: np.ndarray,
    lift: np.ndarray,
    weight: float,
    rng: np.random.Generator,
) -> Run:
    def square(flat: np.ndarray) -> np.ndarray:
        return design.by_axle(flat, r)

    n, surface = run.time_s.size, square(design.speed_m_s)
    speed, wheel, C = np.empty(n), np.empty((n, AXLES)), np.empty((n, AXLES))
    drive(
        square(torque),
        square(sliding),
        square(i.load_N) * (1.0 + lift),
        np.array([*map(square, i.friction)]),
        surface,
        grid,
        data.axle_position_m,
        i.parameters[AXLES * r : AXLES * (r + 1)],
        i.mass_kg[r] * (1.0 + weight),
        i.force_N[design.vehicle_span(r)],
        design.resistance,
        float(surface[0, 0]),
        design.step_s,
        run.surface_m_s is not None,
        np.empty(lanes.CELLS),
        speed,
        wheel,
        C,
    )
    # the sensors: causes that lie in torque or timing are taken out again
    shown = C - square(torque - columns.smooth_torque(design, design.torque_Nm))
    noise_N = float(np.std(run.load_N - gaussian_filter1d(run.load_N, 20.0, axis=0)))
    # the recording ends at the speed at which the measured one did
    slow = np.flatnonzero(speed < 0.98 * float(surface[-1, 0]))
    n = int(slow[0]) if slow.size else n
    measured_wheel = wheel[:n] + rng.normal(0.0, design.wheel_noise_rad_s, (n, AXLES))
    return run._replace(
        time_s=run.time_s[:n],
        speed_m_s=speed[:n] + rng.normal(0.0, design.speed_noise_m_s, n),
        wheel_speed_rad_s=measured_wheel,
        load_N=square(design.load_N)[:n] + rng.normal(0.0, noise_N, (n, AXLES)),
        torque_Nm=shown[:n] * (1.0 + gain) + rng.normal(0.0, design.torque_noise_Nm[r], (n, AXLES)),
        position_m=None if run.position_m is None else run.position_m[:n],
        surface_m_s=None if run.surface_m_s is None else run.surface_m_s[:n],
    )
