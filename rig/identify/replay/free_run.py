"""Wheelsets and vehicle that move freely under given torques: a simulated stop.

A weak feedback on sliding, as a WSP would give, may change the torques. Each wheelset takes the
step of `wheel`, and the vehicle feels what wheel and brake leave for it.

    [Q1] C = C_given + K (s_given - s), smoothed, at least 0
    [Q3] M dv/dt = -sum (C + J domega/dt) / r - resistance
"""

import math
from typing import NamedTuple

import numpy as np

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.identify.data.parameters import MEMORY, RADIUS
from rollerrig.rig.identify.replay import lanes, wheel

SUBSTEPS = 5
# feedback on sliding, as a WSP would give: torque in N m for a sliding that is too small by 1 m/s
FEEDBACK_NS = 2000.0
FEEDBACK_LAG_S = 0.4
VENTING_GAIN = 3.0  # the feedback is stronger by this where sliding is too large by more than
VENTING_SLIDING_M_S = 1.0  # this: the WSP vents the brake
SLOWEST_M_S = 0.3
GRID_M = 0.25  # of the irregularity of the rail
GRID_CELLS_IN_FRONT = 400.0  # the grid begins 100 m before the start of a stop

# rows of the cells: where the filter of `lanes` has its covariances
FEEDBACK, SLIDING, FORCE, *_ = lanes.FREE_ROWS


class Stop(NamedTuple):
    """What moves a vehicle with n samples."""

    # (n, axles) each
    surface_m_s: np.ndarray  # used on rollers only, but for its first values
    load_N: np.ndarray
    torque_Nm: np.ndarray
    degraded: np.ndarray  # factors of degraded and recovered friction
    recovered: np.ndarray
    sliding_m_s: np.ndarray  # at which the wheels begin, and at which the feedback aims

    parameters: np.ndarray  # (axles, PARAMETERS)
    mass_kg: float
    extra_N: np.ndarray  # (n,), added to the resistance
    resistance: tuple[float, float, float]  # A, B, C of the running resistance A + B v + C v^2
    field: np.ndarray  # (cells, axles), irregularity of the rail
    axle_position_m: np.ndarray  # (axles,), distance behind the first wheelset
    step_s: float
    on_rollers: bool  # the surface has the given speed; otherwise that of the vehicle
    feedback_Ns: float = FEEDBACK_NS
    window: int = 0  # samples after which the sliding is set to the given one again; 0: never


class Motion(NamedTuple):
    """How a vehicle moves."""

    speed_m_s: np.ndarray  # (n,)
    wheel_rad_s: np.ndarray  # (n, axles)
    torque_Nm: np.ndarray  # (n, axles), with the feedback


def run(stop: Stop) -> Motion:
    """Return the motion of a vehicle, which begins at the speed and sliding of the first sample."""
    n, axles = stop.torque_Nm.shape
    motion = Motion(np.empty(n), np.empty((n, axles)), np.empty((n, axles)))
    memory = bool(stop.parameters[0, MEMORY] > 0.0) or None
    cells = np.empty(lanes.CELLS)
    # vector mathematics has no adhesion law where recovered is below degraded
    if not drive(stop, memory, None, cells, motion):
        drive(stop, memory, True, cells, motion)
    return motion


@kernel
def drive(stop, memory, exact, cells, motion):
    """Write the motion of a vehicle [Q1] [Q3]; return False, unfinished, where a force is NaN.

    `memory` is None if recovery has no memory, `exact` is None for vector mathematics. `cells`
    (lanes.CELLS,) is work space.
    """
    n, wheelsets = stop.torque_Nm.shape
    A, B, C = stop.resistance
    h = stop.step_s / SUBSTEPS
    v = stop.surface_m_s[0, 0]
    x = 0.0
    lanes.store_models(stop.parameters, 0, cells)
    _start(stop, 0, cells)
    for j in range(wheelsets):
        cells[FEEDBACK + j] = 0.0
        cells[lanes.LAMBDA + j] = 0.0

    for k in range(n):
        if stop.window > 0 and k % stop.window == 0:
            _start(stop, k, cells)
        motion.speed_m_s[k] = v
        for j in range(wheelsets):
            motion.wheel_rad_s[k, j] = cells[lanes.OMEGA + j]
            motion.torque_Nm[k, j] = max(0.0, stop.torque_Nm[k, j] + cells[FEEDBACK + j])
        if k + 1 == n:
            break

        for i in range(SUBSTEPS):
            # the middle of the substep, between the two samples
            _store_inputs(stop, k, (i + 0.5) / SUBSTEPS, v, x, cells)
            for j in range(wheelsets):
                _step_wheelset(j, stop, h, memory, exact, cells)
            force_N = A + B * v + C * v * v + stop.extra_N[k]
            for j in range(wheelsets):
                force_N += cells[FORCE + j]
            if math.isnan(force_N):
                return False
            x += h * v
            v = max(SLOWEST_M_S, v - h * force_N / stop.mass_kg)  # [Q3]
    return True


@kernel_inlined
def _start(stop, k, cells):
    """Set the speeds of the wheels to those of the given sliding at sample k."""
    for j in range(stop.torque_Nm.shape[1]):
        rim_m_s = stop.surface_m_s[k, j] - stop.sliding_m_s[k, j]
        cells[lanes.OMEGA + j] = rim_m_s / stop.parameters[j, RADIUS]


@kernel_inlined
def _store_inputs(stop, k, w, v, x, cells):
    """Write the inputs a share `w` of the way from sample k to the next, at speed v and place x."""
    field = stop.field
    for j in range(stop.torque_Nm.shape[1]):
        cells[lanes.SPEED + j] = _at(stop.surface_m_s, k, j, w) if stop.on_rollers else v
        cells[lanes.LOAD + j] = _at(stop.load_N, k, j, w)
        cells[lanes.TORQUE + j] = _at(stop.torque_Nm, k, j, w)
        cells[lanes.DEGRADED + j] = _at(stop.degraded, k, j, w)
        cells[lanes.RECOVERED + j] = _at(stop.recovered, k, j, w)
        cells[SLIDING + j] = _at(stop.sliding_m_s, k, j, w)
        at = (x - stop.axle_position_m[j]) / GRID_M + GRID_CELLS_IN_FRONT
        cell = min(max(int(at), 0), field.shape[0] - 2)
        share = min(max(at - cell, 0.0), 1.0)
        cells[lanes.M + j] = (1.0 - share) * field[cell, j] + share * field[cell + 1, j]


@kernel_inlined
def _at(values, k, j, w):
    """Return the value of column j a share `w` of the way from row k to the next."""
    return (1.0 - w) * values[k, j] + w * values[k + 1, j]


@kernel_inlined
def _step_wheelset(j, stop, h, memory, exact, cells):
    """Advance the wheelset of lane j by a step of h seconds, with the feedback [Q1]."""
    model = lanes.lane_model(cells, j)
    r = model.wheel_radius_m
    omega = cells[lanes.OMEGA + j]
    missing = cells[SLIDING + j] - (cells[lanes.SPEED + j] - r * omega)
    aim = missing + VENTING_GAIN * min(missing + VENTING_SLIDING_M_S, 0.0)
    feedback = cells[FEEDBACK + j]
    feedback += (stop.feedback_Ns * aim - feedback) * h / FEEDBACK_LAG_S
    brake_Nm = max(0.0, cells[lanes.TORQUE + j] + feedback)

    arguments = (
        omega,
        None if memory is None else cells[lanes.LAMBDA + j],
        cells[lanes.M + j],
        cells[lanes.SPEED + j],
        cells[lanes.LOAD + j],
        brake_Nm,
        cells[lanes.DEGRADED + j],
        cells[lanes.RECOVERED + j],
        model,
        h,
    )
    step = lanes.wheel_step(*arguments) if exact is None else wheel.wheel_step(*arguments)
    # the mean force of the step
    rate_rad_s2 = (step.omega - omega) / h
    cells[FORCE + j] = (brake_Nm + model.wheelset_inertia_kgm2 * rate_rad_s2) / r
    cells[FEEDBACK + j] = feedback
    cells[lanes.OMEGA + j] = max(0.0, step.omega)
    cells[lanes.LAMBDA + j] = step.lambda_
