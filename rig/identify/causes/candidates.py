"""The state of an explanation, and the inputs of the replay under it.

An explanation consists of base parameters within their tolerances, the strength and length of the
rail's irregularity, and any number of causes with their coefficients. `inputs` turns it exactly
into torque, load, friction and wheel parameters of the replay. The columns of `columns` are its
derivatives.
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from scipy.ndimage import shift

from rollerrig.rig.identify.causes import courses, discrepancy, table
from rollerrig.rig.identify.causes.table import Search, Shape
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.replay.sensitivity import Inputs
from rollerrig.rig.mechanisms.constants import RESISTANCE
from rollerrig.rig.mechanisms.mechanism import FRICTION, LOAD, VEHICLE

# of the rail's irregularity, before a fit
UNTUNED_SIGMA = 0.028
UNTUNED_LENGTH_M = 8.0


class Cause(NamedTuple):
    """A cause in a shape, with its coefficients."""

    name: str
    axle: int  # wheelset, -n: bogie n, 0: all wheelsets alike
    shape: Shape
    values: tuple[float, ...]  # coefficients, in the order of the cause's columns


class Explanation(NamedTuple):
    """Base parameters, the irregularity of the rail, and causes."""

    base: dict[str, float]  # deviation of each base parameter, by its label
    sigma: float  # standard deviation of the irregularity
    length_m: float  # correlation length of the irregularity
    causes: tuple[Cause, ...]

    @property
    def level(self) -> float:
        """The logarithm of the contaminant's level over that of the base model.

        It is the mean of the runs.
        """
        levels = [value for label, value in self.base.items() if label.startswith("ln_mu_cd")]
        return float(np.mean(levels or [0.0]))

    def with_cause(self, at: int, cause: Cause) -> "Explanation":
        """Return the explanation with `cause` in place of cause number `at`."""
        return self._replace(causes=(*self.causes[:at], cause, *self.causes[at + 1 :]))


def untuned(design: Design) -> Explanation:
    """Return the explanation before a fit: the base model, without causes."""
    return Explanation(
        base={f"ln_mu_cd_{run}": 0.0 for run in range(design.mass_kg.size)},
        sigma=UNTUNED_SIGMA,
        length_m=UNTUNED_LENGTH_M,
        causes=(),
    )


def inputs(design: Design, explanation: Explanation) -> Inputs:
    """Return the inputs of the replay under an explanation."""
    base = defaultdict(float, explanation.base)
    runs = range(design.mass_kg.size)

    p = np.tile(design.base, (design.segments, 1))
    p[:, parameters.IRREGULARITY] = explanation.sigma
    p[:, parameters.IRREGULARITY_LENGTH] = explanation.length_m
    p[:, parameters.SPEED_NOISE] = design.wheel_noise_rad_s
    p[:, parameters.TORQUE_NOISE] = design.torque_noise_Nm[design.run]
    p[:, parameters.TAU] *= np.exp(base["ln_tau"])
    p[:, parameters.MU_CD] *= np.exp([base[f"ln_mu_cd_{run}"] for run in design.run])

    torque_factors = [
        1.0 + (base["torque_gain"] + base[f"torque_gain_{axle}"]) for axle in design.axle
    ]
    load_factors = [1.0 + base[f"load_gain_{axle}"] for axle in design.axle]
    mass_factors = [1.0 + base[f"mass_{run}"] for run in runs]
    sizes = np.diff(design.start)
    torque_Nm = design.torque_Nm * np.repeat(torque_factors, sizes)
    brake_share = discrepancy.brake_share(design, explanation.base)
    if brake_share is not None:
        torque_Nm *= 1.0 + brake_share
    replay_inputs = Inputs(
        torque_Nm=torque_Nm,
        load_N=design.load_N * np.repeat(load_factors, sizes),
        speed_m_s=design.speed_m_s,
        friction=np.ones((2, design.measured_rad_s.size)),
        parameters=p,
        mass_kg=design.mass_kg * mass_factors,
        force_N=np.zeros(design.vehicle_m_s.size),
    )
    if design.wheel_sensor.is_pulses:
        late_s = discrepancy.wheel_late_s(design, explanation.base)
        replay_inputs = _with_late_inputs(
            design,
            replay_inputs,
            torque_Nm=discrepancy.earlier(design, replay_inputs.torque_Nm, late_s),
            speed_m_s=discrepancy.earlier(design, replay_inputs.speed_m_s, late_s),
        )
    for cause in explanation.causes:
        replay_inputs = _with_cause(design, replay_inputs, cause)
    return replay_inputs


def _with_cause(design: Design, i: Inputs, cause: Cause) -> Inputs:
    """Return inputs as a cause changes them."""
    row = table.BY_NAME[cause.name]
    mechanism = row.mechanism
    value = cause.values[0] if cause.values else 0.0

    if mechanism.acts_on == VEHICLE:
        force_N = resistance(design, i.mass_kg, row, cause.shape, value)
        return i._replace(force_N=i.force_N + force_N)
    if mechanism.constants is not None:
        changed = changed_parameters(i.parameters, row, cause.shape, value)
        acts = courses.acts_on(design, cause.axle)
        return i._replace(parameters=np.where(acts[:, None], changed, i.parameters))
    if cause.name == "adhesion_memory":
        return _with_memory(i, cause.shape, value)
    if cause.name == "torque_sensor_delay":
        by_s = np.full(design.segments, value)
        return i._replace(torque_Nm=shifted(design, i.torque_Nm, by_s))
    if cause.name == "speed_sensor_delay":
        return _with_late_speed(design, i, cause.axle, value)
    if cause.name == "sensor_scale":
        return _with_sensor_scale(design, i, cause.axle, value)
    return _with_courses(design, i, cause)


def _with_memory(i: Inputs, shape: Shape, length_m: float) -> Inputs:
    """Return inputs with adhesion memory of this length."""
    p = i.parameters.copy()
    p[:, parameters.MEMORY] = max(length_m, 0.0)
    p[:, parameters.MEMORY_POWER] = shape.get("speed_power", 0.0)
    p[:, parameters.MEMORY_OF_WORK] = shape.get("of_work", 0.0)
    return i._replace(parameters=p)


def _with_late_speed(design: Design, i: Inputs, axle: int, late_s: float) -> Inputs:
    """Return inputs for a wheel speed that is measured late.

    The inputs of the wheel are shifted by the same time.
    """
    by_s = np.where(courses.acts_on(design, axle), -late_s, 0.0)
    return _with_late_inputs(
        design,
        i,
        torque_Nm=shifted(design, i.torque_Nm, by_s),
        speed_m_s=shifted(design, i.speed_m_s, by_s),
    )


def _with_sensor_scale(design: Design, i: Inputs, axle: int, fraction: float) -> Inputs:
    """Return inputs for a wheel speed that reads too high by a fraction.

    The replay predicts the measured speed omega_m = (1 + fraction) omega. With r' = r / (1 +
    fraction), J' = J / (1 + fraction)^2 and C' = C / (1 + fraction), the balance of the wheel holds
    for omega_m: J' d omega_m/dt = r' N f - C'. The vehicle feels C' / r' = C / r, as before.
    """
    factors = 1.0 + fraction * courses.acts_on(design, axle)
    p = i.parameters.copy()
    p[:, parameters.RADIUS] /= factors
    p[:, parameters.INERTIA] /= factors * factors
    torque_Nm = i.torque_Nm / np.repeat(factors, np.diff(design.start))
    return i._replace(torque_Nm=torque_Nm, parameters=p)


def _with_late_inputs(
    design: Design, i: Inputs, torque_Nm: np.ndarray, speed_m_s: np.ndarray
) -> Inputs:
    """Return inputs with the torques and surface speeds of an earlier time for the wheels.

    The vehicle is measured in time, so its force balance keeps the torque that is not shifted.
    """
    missing_N = (i.torque_Nm - torque_Nm) / i.parameters[0, parameters.RADIUS]
    on_vehicles_N = np.concatenate(
        [design.by_axle(missing_N, run).sum(axis=1) for run in range(design.mass_kg.size)]
    )
    return i._replace(
        torque_Nm=torque_Nm,
        speed_m_s=speed_m_s,
        force_N=i.force_N + on_vehicles_N,
    )


def _with_courses(design: Design, i: Inputs, cause: Cause) -> Inputs:
    """Return inputs that a cause changes by courses of friction, load, torque or resistance."""
    mechanism = table.BY_NAME[cause.name].mechanism
    of_units = courses.courses(design, cause.name, cause.shape)
    change = courses.of_axle(design, cause.axle) * sum(
        value * course for value, course in zip(cause.values, of_units, strict=False)
    )
    if "on_vehicle" in cause.shape:
        return i._replace(force_N=i.force_N + courses.vehicle_samples(design, change))
    if mechanism.acts_on == FRICTION:
        share_of_recovered = 1.0 - cause.shape.get("contaminant_alone", 0.0)
        factors = np.exp([change, share_of_recovered * change])
        return i._replace(friction=i.friction * factors)
    if mechanism.acts_on == LOAD:
        return i._replace(load_N=i.load_N * (1.0 + change))
    if mechanism.share:
        return i._replace(torque_Nm=i.torque_Nm * (1.0 + change))
    return i._replace(torque_Nm=i.torque_Nm + change)


def _shape_values(row: Search, shape: Shape) -> list[float]:
    """Return the values of a cause's shape parameters, in their order."""
    return [shape.get(known.name, known.default) for known in row.mechanism.formula_parameters[1:]]


def resistance(
    design: Design, mass_kg: np.ndarray, row: Search, shape: Shape, value: float
) -> np.ndarray:
    """Return the force in N that a cause adds to the resistance, shape (vehicle samples,)."""
    assert row.mechanism.constants is not None
    nothing = np.zeros(mass_kg.size)
    model = dict.fromkeys(RESISTANCE.values(), nothing)
    # where drives hold the speed the mass is infinite, and no force changes the speed
    model["mass_kg"] = np.where(np.isfinite(mass_kg), mass_kg, 0.0)
    model |= row.mechanism.constants(model, value, *_shape_values(row, shape))

    samples = np.diff(design.vehicle_start)
    A, B, C = (np.repeat(model[key], samples) for key in RESISTANCE.values())
    v = courses.vehicle_samples(design, design.speed_m_s)
    return A + B * v + C * v * v


def changed_parameters(p: np.ndarray, row: Search, shape: Shape, value: float) -> np.ndarray:
    """Return parameters (segments, PARAMETERS) as a cause of this size changes their constants."""
    assert row.mechanism.constants is not None
    out = p.copy()
    model = {key: p[:, at] for key, at in parameters.COLUMN.items()}
    changes = row.mechanism.constants(model, value, *_shape_values(row, shape))
    for key, changed in changes.items():
        out[:, parameters.COLUMN[key]] = changed
    return out


def shifted(design: Design, values: np.ndarray, by_s: np.ndarray) -> np.ndarray:
    """Return values(t + by) in each segment; `by_s` has the shape (segments,).

    Splines of fifth order are used, because straight lines between samples would reduce the noise.
    """
    out = values.copy()
    for s in np.flatnonzero(by_s).tolist():
        at = design.span(s)
        out[at] = shift(values[at], -by_s[s] / design.step_s, order=5, mode="nearest")
    return out
