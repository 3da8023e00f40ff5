"""The state of an explanation, and what it makes of the measured inputs of a replay.

Base parameters within their tolerances, the strength and length of the rail's irregularity, and
any number of causes with their coefficients: `inputs` turns them into torque, load, friction and
wheel parameters of the replay, exactly (the columns of `columns` are its derivatives).
"""

from collections import defaultdict
from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.ndimage import shift

from rollerrig.rig.identify.causes import courses, table
from rollerrig.rig.identify.causes.table import Search, Shape
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.replay.sensitivity import Inputs
from rollerrig.rig.mechanisms.constants import RESISTANCE
from rollerrig.rig.mechanisms.mechanism import FRICTION, LOAD, VEHICLE


class Cause(NamedTuple):
    """One cause in one shape: `values` in the order of its columns; windows (run, from, to)."""

    name: str
    axle: int
    shape: Shape
    values: tuple[float, ...]


class Explanation(NamedTuple):
    """Base values by label, strength and length of the field, causes."""

    base: dict[str, float]
    sigma: float
    length_m: float
    causes: tuple[Cause, ...]

    @property
    def level(self) -> float:
        """Logarithm of the contaminant's level over the base model's, mean of the fitted runs."""
        return float(
            np.mean([v for label, v in self.base.items() if label.startswith("ln_mu_cd")] or [0.0])
        )

    def with_cause(self, at: int, cause: Cause) -> "Explanation":
        """The same with another cause at this place."""
        return self._replace(causes=(*self.causes[:at], cause, *self.causes[at + 1 :]))


def untuned(design: Design) -> Explanation:
    """The untuned base."""
    return Explanation(
        {f"ln_mu_cd_{run}": 0.0 for run in range(design.mass_kg.size)}, 0.028, 8.0, ()
    )


def inputs(design: Design, explanation: Explanation) -> Inputs:
    """Inputs of the replay under an explanation."""
    base = defaultdict(float, explanation.base)
    p = np.tile(design.base, (design.segments, 1))
    p[:, parameters.IRREGULARITY], p[:, parameters.IRREGULARITY_LENGTH] = (
        explanation.sigma,
        explanation.length_m,
    )
    p[:, parameters.SPEED_NOISE], p[:, parameters.TORQUE_NOISE] = (
        design.wheel_noise_rad_s,
        design.torque_noise_Nm[design.run],
    )
    p[:, parameters.TAU] *= np.exp(base["ln_tau"])
    p[:, parameters.MU_CD] *= np.exp([base[f"ln_mu_cd_{run}"] for run in design.run])
    gain = [1.0 + (base["torque_gain"] + base[f"torque_gain_{axle}"]) for axle in design.axle]
    lift = [1.0 + base[f"load_gain_{axle}"] for axle in design.axle]
    sizes = np.diff(design.start)
    found = Inputs(
        torque_Nm=design.torque_Nm * np.repeat(gain, sizes),
        load_N=design.load_N * np.repeat(lift, sizes),
        speed_m_s=design.speed_m_s,
        friction=np.ones((2, design.measured_rad_s.size)),
        parameters=p,
        mass_kg=design.mass_kg * [1.0 + base[f"mass_{run}"] for run in range(design.mass_kg.size)],
        force_N=np.zeros(design.vehicle_m_s.size),
    )
    return reduce(lambda i, cause: _with(design, i, cause), explanation.causes, found)


def _with(d: Design, i: Inputs, cause: Cause) -> Inputs:
    row = table.BY_NAME[cause.name]
    m, on, rows = (
        row.mechanism,
        courses.of_axle(d, cause.axle),
        (d.axle == cause.axle - 1) | (cause.axle == 0),
    )
    value = cause.values[0] if cause.values else 0.0
    if m.acts_on == VEHICLE:
        return i._replace(force_N=i.force_N + resistance(d, i.mass_kg, row, cause.shape, value))
    if m.constants is not None:
        changed = changed_parameters(i.parameters, row, cause.shape, value)
        return i._replace(parameters=np.where(rows[:, None], changed, i.parameters))
    if cause.name == "adhesion_memory":
        p = i.parameters.copy()
        p[:, parameters.MEMORY] = max(value, 0.0)
        p[:, parameters.MEMORY_POWER] = cause.shape.get("speed_power", 0.0)
        p[:, parameters.MEMORY_OF_WORK] = cause.shape.get("of_work", 0.0)
        return i._replace(parameters=p)
    if cause.name == "torque_sensor_delay":
        return i._replace(torque_Nm=shifted(d, i.torque_Nm, np.full(d.segments, value)))
    if cause.name == "speed_sensor_delay":
        by = np.where(rows, -value, 0.0)
        torque_Nm = shifted(d, i.torque_Nm, by)
        now = (i.torque_Nm - torque_Nm) / i.parameters[
            0, parameters.RADIUS
        ]  # the vehicle lives on that of now
        force_N = i.force_N + np.concatenate(
            [d.by_axle(now, run).sum(axis=1) for run in range(d.mass_kg.size)]
        )
        return i._replace(
            torque_Nm=torque_Nm, speed_m_s=shifted(d, i.speed_m_s, by), force_N=force_N
        )
    given = courses.courses(d, cause.name, cause.shape)
    change = on * sum(v * course for v, course in zip(cause.values, given, strict=False))
    if "on_vehicle" in cause.shape:
        return i._replace(force_N=i.force_N + courses.of_vehicle(d, change))
    if m.acts_on == FRICTION:
        of_recovered = 1.0 - cause.shape.get("contaminant_alone", 0.0)
        return i._replace(friction=i.friction * np.exp([change, of_recovered * change]))
    if m.acts_on == LOAD:
        return i._replace(load_N=i.load_N * (1.0 + change))
    return i._replace(torque_Nm=i.torque_Nm * (1.0 + change) if m.share else i.torque_Nm + change)


def _shape(row: Search, shape: Shape) -> list[float]:
    return [shape.get(known.name, known.default) for known in row.mechanism.formula_parameters[1:]]


def resistance(
    d: Design, mass_kg: np.ndarray, row: Search, shape: Shape, value: float
) -> np.ndarray:
    """Force in N that a cause of a size adds to the resistance, shape (vehicle samples,)."""
    assert row.mechanism.constants is not None
    nothing = np.zeros(mass_kg.size)
    # where drives hold the speed no force changes it
    model = dict.fromkeys(RESISTANCE.values(), nothing) | {
        "mass_kg": np.where(np.isfinite(mass_kg), mass_kg, 0.0)
    }
    model |= row.mechanism.constants(model, value, *_shape(row, shape))
    A, B, C = (np.repeat(model[key], np.diff(d.vehicle_start)) for key in RESISTANCE.values())
    v = courses.of_vehicle(d, d.speed_m_s)
    return A + B * v + C * v * v


def changed_parameters(p: np.ndarray, row: Search, shape: Shape, value: float) -> np.ndarray:
    """Rows of parameters (segments, PARAMETERS) with the constants that a cause of a size changes."""
    assert row.mechanism.constants is not None
    out = p.copy()
    model = {key: p[:, at] for key, at in parameters.COLUMN.items()}
    for key, changed in row.mechanism.constants(model, value, *_shape(row, shape)).items():
        out[:, parameters.COLUMN[key]] = changed
    return out


def shifted(d: Design, values: np.ndarray, by_s: np.ndarray) -> np.ndarray:
    """values(t + by) in each segment, by splines of fifth order: straight lines would take noise away."""
    out = values.copy()
    for s in np.flatnonzero(by_s).tolist():
        out[d.span(s)] = shift(values[d.span(s)], -by_s[s] / d.step_s, order=5, mode="nearest")
    return out
