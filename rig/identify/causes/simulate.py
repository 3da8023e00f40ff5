"""Simulates stops of the same design as measured ones, under a known explanation.

The measured course of torque acts with a weak feedback on sliding, as in `free_run`, so
that the simulated wheels go through the same speeds and slidings without copying the measured
noise. Irregularity of the rail, noise and calibration are drawn again. Without a cause this shows
what "nothing is wrong" looks like. With a cause it shows what the method makes of that cause.

    [Q2] field = rail(x) + run_i(x) + axle_ij(x), Ornstein-Uhlenbeck in distance; shares by
         `rail.shares`
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.identify.causes import columns, discrepancy
from rollerrig.rig.identify.causes.candidates import Explanation, inputs
from rollerrig.rig.identify.data import pulses
from rollerrig.rig.identify.data.parameters import RADIUS
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.data.pulses import PulseSensor, Sensor
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.replay import free_run
from rollerrig.rig.identify.replay.free_run import GRID_M, Stop
from rollerrig.rig.identify.replay.rail import USUAL, RailShares
from rollerrig.rig.identify.replay.sensitivity import Inputs

_GRID_MARGIN_M = 150.0  # more than the stop needs: 100 m before its start, 50 m behind its end
_LOAD_SMOOTHING_SAMPLES = 20.0  # what is faster in a measured load is noise
_END_SHARE = 0.98  # of the last speed of the measured run


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
    cells = int((length_m + _GRID_MARGIN_M) / GRID_M)
    keep = math.exp(-GRID_M / correlation_m)
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
        before = int((starts_m[number] - min(starts_m)) / GRID_M)
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
    degraded, recovered = replay_inputs.friction
    motion = free_run.run(
        Stop(
            surface_m_s=surface_m_s,
            load_N=by_axle(replay_inputs.load_N) * (1.0 + errors.load),
            torque_Nm=by_axle(shared.torque_Nm),
            degraded=by_axle(degraded),
            recovered=by_axle(recovered),
            sliding_m_s=by_axle(shared.sliding_m_s),
            parameters=replay_inputs.parameters[axles * number : axles * (number + 1)],
            mass_kg=replay_inputs.mass_kg[number] * (1.0 + errors.mass),
            extra_N=replay_inputs.force_N[design.vehicle_span(number)],
            resistance=tuple(design.resistance),
            field=irregularity,
            axle_position_m=data.axle_position_m,
            step_s=design.step_s,
            on_rollers=run.surface_m_s is not None,
        )
    )
    speed_m_s, wheel_rad_s, torque_Nm = motion

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
