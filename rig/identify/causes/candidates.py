"""The state of an explanation, and what it makes of the measured inputs of a replay.

Base parameters within their tolerances, the strength and length of the rail's irregularity, and
any number of causes with their coefficients: `inputs` turns them into torque, load, friction and
wheel parameters of the replay, exactly (the columns of `columns` are its derivatives).
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import shift

from rollerrig.rig.identify.causes import columns, courses
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.filter.sensitivity import Inputs

GRAVITY = 9.80665


class Cause(NamedTuple):
    """One cause in one shape: `values` in the order of its columns; windows (run, from, to)."""

    name: str
    axle: int
    shape: dict[str, float]
    values: tuple[float, ...]


class Explanation(NamedTuple):
    """Base values by label, strength and length of the field, causes."""

    base: dict[str, float]
    sigma: float
    length_m: float
    causes: tuple[Cause, ...]


def start(design: Design) -> Explanation:
    """The untuned base."""
    return Explanation({f"ln_mu_cd_{run}": 0.0 for run in range(design.mass_kg.size)}, 0.028, 8.0,
                       ())


def inputs(design: Design, explanation: Explanation) -> Inputs:
    """Inputs of the replay under an explanation."""
    n = design.measured_rad_s.size
    p = np.tile(design.base, (design.segments, 1))
    p[:, parameters.SIGMA], p[:, parameters.LENGTH] = explanation.sigma, explanation.length_m
    p[:, parameters.NOISE] = design.wheel_noise_rad_s
    p[:, parameters.TORQUE_NOISE] = design.torque_noise_Nm[design.run]
    base = explanation.base
    p[:, parameters.TAU] *= np.exp(base.get("ln_tau", 0.0))
    friction = np.zeros(n)
    torque, load = design.torque_Nm, design.load_N
    mass = design.mass_kg.copy()
    gain, lift = np.zeros(design.segments), np.zeros(design.segments)
    for s in range(design.segments):
        run, axle = int(design.run[s]), int(design.axle[s])
        p[s, parameters.MU_CD] *= np.exp(base.get(f"ln_mu_cd_{run}", 0.0))
        gain[s] = base.get("torque_gain", 0.0) + base.get(f"torque_gain_{axle}", 0.0)
        lift[s] = base.get(f"load_gain_{axle}", 0.0)
    sizes = np.diff(design.start)
    torque = torque * np.repeat(1.0 + gain, sizes)
    load = load * np.repeat(1.0 + lift, sizes)
    for run in range(mass.size):
        mass[run] *= 1.0 + base.get(f"mass_{run}", 0.0)
    found = Inputs(torque, load, design.speed_m_s, friction, p, mass,
                   np.zeros(design.vehicle_m_s.size))
    for cause in explanation.causes:
        found = _with(design, found, cause)
    return found


def _with(d: Design, i: Inputs, cause: Cause) -> Inputs:
    mask = np.ones(d.load_N.size) if cause.axle == 0 else columns.of_axle(d, cause.axle - 1)
    rows = np.ones(d.segments, dtype=bool) if cause.axle == 0 else d.axle == cause.axle - 1
    value = cause.values[0] if cause.values else 0.0
    if cause.name in courses.NAMES:
        return i._replace(friction_log=i.friction_log
                          + value * courses.course(d, cause.name, cause.shape))
    if cause.name == "empirical":
        change = courses.empirical(d, cause.shape) @ np.array(cause.values)
        if "on_vehicle" in cause.shape:
            return i._replace(force_N=i.force_N + courses.of_vehicle(d, change))
        return i._replace(friction_log=i.friction_log + change)
    if cause.name == "falling_friction" and "height" in cause.shape:
        p = i.parameters.copy()
        for at in (parameters.A_D, parameters.A_R):
            p[:, at] /= 1.0 + (1.0 - p[:, at]) * value
        return i._replace(parameters=p)
    if cause.name in _COLUMN:
        places = _COLUMN[cause.name] + (_WHOLE_LAYER if "whole" in cause.shape else ())
        p = i.parameters.copy()
        for at, sign in places:
            p[rows, at] *= max(1.0 + sign * value, 0.02)
        return i._replace(parameters=p)
    if cause.name == "adhesion_memory":
        p = i.parameters.copy()
        p[:, parameters.MEMORY] = max(value, 0.0)
        p[:, parameters.MEMORY_POWER] = cause.shape.get("speed_power", 0.0)
        p[:, parameters.MEMORY_OF_WORK] = cause.shape.get("of_work", 0.0)
        return i._replace(parameters=p)
    if cause.name == "brake_gain":
        return i._replace(torque_Nm=i.torque_Nm * (1.0 + value * mask))
    if cause.name == "torque_offset":
        return i._replace(torque_Nm=i.torque_Nm
                          + value * mask * courses.applied(d, cause.shape))
    if cause.name == "pad_fade":
        return i._replace(torque_Nm=i.torque_Nm * (1.0 - value * courses.heat(d, cause.shape)))
    if cause.name == "running_resistance":
        return i._replace(force_N=i.force_N + value * courses.resistance(d, cause.shape))
    if cause.name == "track_gradient":
        mass = np.repeat(i.mass_kg, np.diff(d.vehicle_start))
        return i._replace(force_N=i.force_N + value * GRAVITY * mass)
    if cause.name == "torque_sensor_delay":
        return i._replace(torque_Nm=shifted(d, i.torque_Nm, np.full(d.segments, value)))
    if cause.name == "speed_sensor_delay":
        by = np.where(rows, -value, 0.0)
        return i._replace(torque_Nm=shifted(d, i.torque_Nm, by),
                          speed_m_s=shifted(d, i.speed_m_s, by))
    if cause.name == "wheel_out_of_round":
        return i._replace(load_N=i.load_N * (1.0 + _swing(d, cause) * mask))
    if cause.name == "load_transfer":
        body = np.repeat(np.where(d.axle < 2, 1.0, -1.0), np.diff(d.start))
        bogie = np.repeat(np.where(d.axle % 2 == 0, 1.0, -1.0), np.diff(d.start))
        return i._replace(load_N=i.load_N * (1.0 + d.deceleration_m_s2 * (
            cause.values[0] * body + cause.values[1] * bogie)))
    raise KeyError(cause.name)


# (column of the parameters, sign of the coefficient)
_COLUMN = {
    "wheel_radius": ((parameters.RADIUS, 1.0),),
    "wheel_inertia": ((parameters.INERTIA, 1.0),),
    "roller_curvature": ((parameters.EPS1, 1.0),),
    "interfacial_layer": ((parameters.K_AD, -1.0), (parameters.K_AR, -1.0)),
    "falling_friction": ((parameters.GAMMA_D, 1.0), (parameters.GAMMA_R, 1.0)),
}

_WHOLE_LAYER = ((parameters.K_SD, -1.0), (parameters.K_SR, -1.0))


def _swing(d: Design, cause: Cause) -> np.ndarray:
    out = np.zeros(d.angle_rad.size)
    for run in range(min(d.mass_kg.size, len(cause.values) // 2)):
        out += columns.of_run(d, run) * (cause.values[2 * run] * np.cos(d.angle_rad)
                                         + cause.values[2 * run + 1] * np.sin(d.angle_rad))
    return out


def shifted(d: Design, values: np.ndarray, by_s: np.ndarray) -> np.ndarray:
    """values(t + by) in each segment, by splines of fifth order.

    A straight line between samples would take noise away, which alone looks like a better model.
    """
    out = values.copy()
    for s in range(d.segments):
        if by_s[s] != 0.0:
            at = d.span(s)
            out[at] = shift(values[at], -by_s[s] / d.step_s, order=5, mode="nearest")
    return out
