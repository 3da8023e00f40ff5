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
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.data.runs import AXLES, Dataset, Run
from rollerrig.rig.identify.replay import lanes, replay
from rollerrig.rig.identify.replay.sensitivity import Inputs

SUBSTEPS = 5
FEEDBACK_NS, FEEDBACK_LAG_S = 2000.0, 0.4
_GRID_M = 0.25


@kernel_inlined
def wheel_step(
    omega, feedback, late, under, N, degraded, recovered, wanted, irregularity, torque, p, h
):
    """(omega, feedback, lambda, force / h on the vehicle) of one wheelset after a step h."""
    r, inertia = p[0], p[1]
    irregular, s = math.exp(irregularity), under - r * omega
    f, rise, late = replay.wheel_adhesion(
        s, under, 0.5 * N, degraded, recovered, p, late, replay.closes(under, h, p)
    )
    off = wanted - s
    # far too much sliding vents the brake
    aim = FEEDBACK_NS * off + 3.0 * FEEDBACK_NS * min(off + 1.0, 0.0)
    feedback += (aim - feedback) * h / FEEDBACK_LAG_S
    C = max(0.0, torque + feedback)
    T = N * f * irregular
    a = -r * r * N * rise * irregular / inertia
    z = min(a * h, 2.0)
    phi = math.expm1(z) / z if abs(z) > 1e-6 else 1.0
    change = h * phi * (r * T - C) / inertia
    # the vehicle feels the mean force: what wheel and brake leave
    return max(0.0, omega + change), feedback, late, (C + inertia * change / h) / r


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
    follows,
    cells,
    out_speed,
    out_wheel,
    out_torque,
):
    n = len(torque)
    h = step_s / SUBSTEPS
    v, x = speed0, 0.0
    lanes.tell(parameters, cells)
    for j in range(AXLES):
        cells[j], cells[4 + j], cells[8 + j] = (v - sliding[0, j]) / parameters[j, 0], 0.0, 0.0
    for k in range(n):
        out_speed[k] = v
        for j in range(AXLES):
            out_wheel[k, j] = cells[j]
            out_torque[k, j] = max(0.0, torque[k, j] + cells[4 + j])
        if k + 1 == n:
            break
        for i in range(SUBSTEPS):
            w = (i + 0.5) / SUBSTEPS
            force = resistance[0] + resistance[1] * v + resistance[2] * v * v + extra_N[k]
            for j in range(AXLES):
                cells[12 + j] = (1.0 - w) * surface[k, j] + w * surface[k + 1, j] if follows else v
                cells[16 + j] = (1.0 - w) * load[k, j] + w * load[k + 1, j]
                for q in range(2):
                    cells[20 + 20 * q + j] = (1.0 - w) * friction[q, k, j] + w * friction[
                        q, k + 1, j
                    ]
                cells[24 + j] = (1.0 - w) * sliding[k, j] + w * sliding[k + 1, j]
                cells[28 + j] = (1.0 - w) * torque[k, j] + w * torque[k + 1, j]
                at = (x - place[j]) / _GRID_M + 400.0
                cell = min(max(int(at), 0), field.shape[0] - 2)
                share = min(max(at - cell, 0.0), 1.0)
                cells[32 + j] = (1.0 - share) * field[cell, j] + share * field[cell + 1, j]
            for j in range(AXLES):
                cells[j], cells[4 + j], cells[8 + j], cells[36 + j] = wheel_step(
                    cells[j],
                    cells[4 + j],
                    cells[8 + j],
                    cells[12 + j],
                    cells[16 + j],
                    cells[20 + j],
                    cells[40 + j],
                    cells[24 + j],
                    cells[32 + j],
                    cells[28 + j],
                    lanes.row(cells, j),
                    h,
                )
            for j in range(AXLES):
                force += cells[36 + j]
            if math.isnan(force):
                return False
            x += h * v
            v = max(0.3, v - h * force / mass)
    return True


_quick = variant(_drive, wheel_step=variant(wheel_step, math=MATH, replay=lanes.REPLAY))


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
    follows,
    cells,
    out_speed,
    out_wheel,
    out_torque,
):
    """One stop [Q1]: inputs (n, 4), writes speed (n,), wheel speed and torque (n, 4)."""
    if parameters[0, 14] > 0.0 or not _quick(
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
        follows,
        cells,
        out_speed,
        out_wheel,
        out_torque,
    ):
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
            follows,
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
    radius = np.repeat(i.parameters[:, parameters.RADIUS], np.diff(design.start))
    wheel = (design.speed_m_s - design.sliding_m_s) / design.base[parameters.RADIUS]
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
