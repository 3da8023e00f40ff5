"""The list of all that could change a replay: base parameters, causes, and smooth functions.

A column is a course in time of the change of a wheel's acceleration (and of the vehicle's) for a
unit of one coefficient. Base parameters always stay in the fit, those with a declared tolerance
under a prior; a cause is one or several columns, some causes have variants of shape.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.rig.identify.causes import candidates, courses, table
from rollerrig.rig.identify.causes.courses import of_axle, of_run, of_vehicle
from rollerrig.rig.identify.causes.table import Search, Shape
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.data.runs import AXLES
from rollerrig.rig.identify.filter import sensitivity
from rollerrig.rig.identify.filter.sensitivity import Inputs, Linear
from rollerrig.rig.mechanisms.mechanism import CONTACT, FRICTION, LOAD, TORQUE, VEHICLE

PLACE_BIN_M = 25.0
TIME_BIN_S = 2.0
BASE = "base"
# tolerance of ln tau and of the contact's constants, which the base may use freely
_FREE = 0.0
# causes in given shapes
Shaped = tuple[tuple[str, Shape], ...]
Part = tuple[np.ndarray | None, np.ndarray | None]  # of the wheels and of the vehicles


class Column(NamedTuple):
    """One coefficient: the cause whose it is, its label, prior deviation (0: free)."""

    cause: str
    label: str
    prior: float


class Variant(NamedTuple):
    """A cause in one shape: the columns that it frees, and what the shape is."""

    cause: str
    columns: tuple[int, ...]
    shape: Shape
    axle: int  # 0: all


class SensitivityMatrix(NamedTuple):
    """Columns, their courses and variants. `wheel` (n, columns), `vehicle` (nv, columns)."""

    columns: list[Column]
    wheel: np.ndarray
    vehicle: np.ndarray
    variants: list[Variant]


class _Writer:
    """Collects columns: a wheel part (flat) and a vehicle part (flat)."""

    def __init__(self, design: Design, inputs: Inputs, linear: Linear) -> None:
        self.design, self.inputs, self.linear = design, inputs, linear
        self.torque = smooth_torque(design, inputs.torque_Nm)
        self.columns: list[Column] = []
        self.wheel: list[np.ndarray] = []
        self.vehicle: list[np.ndarray] = []
        self.variants: list[Variant] = []

    def add(self, cause: str, label: str, wheel: np.ndarray | None,
            vehicle: np.ndarray | None = None, prior: float = _FREE) -> int:
        d = self.design
        self.columns.append(Column(cause, label, prior))
        self.wheel.append(np.zeros(d.measured_rad_s.size, np.float32) if wheel is None
                          else wheel.astype(np.float32))
        self.vehicle.append(np.zeros(d.vehicle_m_s.size, np.float32) if vehicle is None
                            else vehicle.astype(np.float32))
        return len(self.columns) - 1

    def variant(self, cause: str, parts: Iterable[Part], shape: Shape, axle: int = 0) -> None:
        """A cause in a shape, with a column for each part."""
        found = tuple(self.add(cause, str(k), *part) for k, part in enumerate(parts))
        self.variants.append(Variant(cause, found, shape, axle))

    def rate(self, name: str) -> np.ndarray:
        """Change of a wheel's acceleration for one of `sensitivity.RATES`."""
        return self.linear.rates[:, sensitivity.RATES.index(name)]

    def of_torque(self, change: np.ndarray) -> Part:
        """What a change of the brake torque does to wheels and vehicles."""
        d = self.design
        return (-change / self.inputs.parameters[0, parameters.INERTIA],
                -to_vehicle(d, change) / (d.base[parameters.RADIUS] * vehicle_mass(d)))


def smooth_torque(design: Design, torque: np.ndarray) -> np.ndarray:
    """Torque smoothed within each segment (0.03 s), half a sample on: of the step that follows."""
    out = np.empty_like(torque)
    for s in range(design.segments):
        at = design.span(s)
        smooth = gaussian_filter1d(torque[at], 0.03 / design.step_s, mode="nearest")
        out[at] = 0.5 * (smooth + np.append(smooth[1:], smooth[-1]))
    return out


def rate(design: Design, values: np.ndarray) -> np.ndarray:
    """d/dt within each segment."""
    return np.concatenate([np.gradient(values[design.span(s)], design.step_s) for s in range(design.segments)])


def to_vehicle(design: Design, force: np.ndarray) -> np.ndarray:
    """Sum over the wheelsets of a flat array, as one flat array of vehicles."""
    return np.concatenate([sum(force[design.span(AXLES * run + j)] for j in range(AXLES))
                           for run in range(design.mass_kg.size)])


def vehicle_mass(design: Design) -> np.ndarray:
    """Mass in kg on each vehicle sample."""
    return np.repeat(design.mass_kg, np.diff(design.vehicle_start))


def write(design: Design, inputs: Inputs, shaped: Shaped = (), search: bool = True
          ) -> tuple[SensitivityMatrix, Linear]:
    """Columns of a design around a replay, and that replay: base, causes in given shapes, all of the search."""
    tried = {row.name: row.shapes if search else () for row in table.TABLE}
    wanted = [(row, shape) for row in table.TABLE
              for shape in (*tried[row.name], *(s for name, s in shaped if name == row.name and s not in tried[name]))]
    constants = [(row, shape) for row, shape in wanted if row.mechanism.acts_on == CONTACT and row.mechanism.constants]
    w = _Writer(design, inputs, sensitivity.linearise(design, inputs, _changed(inputs, constants)))
    _base(w)
    for row, shape in wanted:
        for axle in row.axles:
            w.variant(row.name, _parts(w, row, shape, axle, constants), shape, axle)
    if search:
        _windows(w)
        _smooth_functions(w)
    return SensitivityMatrix(w.columns, np.column_stack(w.wheel), np.column_stack(w.vehicle), w.variants), w.linear


def _changed(inputs: Inputs, constants: list[tuple[Search, Shape]]) -> np.ndarray:
    """Rows of parameters with the recovery, the level and each of some causes a step larger."""
    found = [inputs.parameters.copy() for _ in range(2)]
    for p, at in zip(found, (parameters.TAU, parameters.MU_CD), strict=True):
        p[:, at] *= 1.0 + sensitivity.STEP
    found += [candidates.changed_parameters(inputs.parameters, row, shape, sensitivity.STEP)
              for row, shape in constants]
    return np.stack(found, axis=1)


def _base(w: _Writer) -> None:
    d, tolerance = w.design, max(w.design.calibration, 1e-4)
    level, load = w.linear.constants[:, 1], w.rate("load")
    runs = range(d.mass_kg.size)
    for run in runs:
        w.add(BASE, f"ln_mu_cd_{run}", level * of_run(d, run))
    w.add(BASE, "ln_tau", w.linear.constants[:, 0])
    w.add(BASE, "torque_gain", *w.of_torque(w.torque), tolerance / np.sqrt(2.0))
    for j in range(AXLES):
        w.add(BASE, f"torque_gain_{j}", *w.of_torque(w.torque * of_axle(d, j + 1)), tolerance / np.sqrt(2.0))
        w.add(BASE, f"load_gain_{j}", load * of_axle(d, j + 1), None, tolerance)
    force = np.concatenate([sensitivity.vehicle_force(d, w.inputs, run) for run in runs])
    of_vehicle_run = np.repeat(runs, np.diff(d.vehicle_start))
    for run in runs:
        w.add(BASE, f"mass_{run}", None, force * (of_vehicle_run == run), tolerance)


def _parts(w: _Writer, row: Search, shape: Shape, axle: int, constants: list[tuple[Search, Shape]]) -> Iterator[Part]:
    """The columns of a cause in a shape on an axle, one for each coefficient."""
    d, m, on = w.design, row.mechanism, of_axle(w.design, axle)
    if row.name in _OWN:
        yield from _OWN[row.name](w, on)
    elif (row, shape) in constants:
        yield w.linear.constants[:, 2 + constants.index((row, shape))] * on, None
    elif m.acts_on == VEHICLE:
        yield None, -candidates.resistance(d, d.mass_kg, row, shape, 1.0) / vehicle_mass(d)
    for course in courses.courses(d, row.name, shape):
        if "on_vehicle" in shape:
            yield None, -of_vehicle(d, course) / vehicle_mass(d)
        elif m.acts_on == FRICTION:
            yield w.rate("friction") * course * on, None
        elif m.acts_on == TORQUE:
            yield w.of_torque((w.torque * course if m.share else course) * on)
        elif m.acts_on == LOAD:
            yield w.rate("load") * course * on, None


def _memory(w: _Writer, on: np.ndarray) -> Iterator[Part]:
    yield None, None  # its answer is a finite step of the whole filter, see `tuning`


def _torque_delay(w: _Writer, on: np.ndarray) -> Iterator[Part]:
    yield w.of_torque(rate(w.design, w.torque))


def _speed_delay(w: _Writer, on: np.ndarray) -> Iterator[Part]:
    """A late wheel speed: the wheel lives on the inputs of a moment ago."""
    d, p = w.design, w.inputs.parameters[0]
    growth = np.log(np.maximum(w.linear.coefficients[:, 0], 1e-12)) / d.step_s
    yield (rate(d, w.torque) / p[parameters.INERTIA] + growth / p[parameters.RADIUS] * rate(d, d.speed_m_s)) * on, None


def _inertia(w: _Writer, on: np.ndarray) -> Iterator[Part]:
    yield -(w.rate("irregularity") - w.torque / w.inputs.parameters[0, parameters.INERTIA]) * on, None


def _radius(w: _Writer, on: np.ndarray) -> Iterator[Part]:
    yield w.rate("radius") * on, None


_OWN: dict[str, Callable[[_Writer, np.ndarray], Iterator[Part]]] = {
    "adhesion_memory": _memory, "torque_sensor_delay": _torque_delay, "speed_sensor_delay": _speed_delay,
    "wheel_inertia": _inertia, "wheel_radius": _radius}


def _windows(w: _Writer) -> None:
    """Bins of place (all runs) and of time (each run): windows are runs of bins."""
    d, friction = w.design, w.rate("friction")
    lowest, highest = d.places_m
    for i in range(int(np.ceil((highest - lowest) / PLACE_BIN_M))):
        low = lowest + i * PLACE_BIN_M
        w.add("place_bin", f"{low:.6g}", friction * ((d.place_m >= low) & (d.place_m < low + PLACE_BIN_M)))
    behind = 1.0 - of_axle(d, 1)
    for run, end_s in enumerate(d.ends_s):
        mask = of_run(d, run)
        for i in range(int(np.ceil(end_s / TIME_BIN_S))):
            inside = (d.time_s >= i * TIME_BIN_S) & (d.time_s < (i + 1) * TIME_BIN_S)
            label, change = f"{run} {i * TIME_BIN_S:.6g}", friction * inside * mask
            w.add("time_bin", label, change)
            w.add("time_bin behind", label, change * behind)


COVARIATES: dict[str, Callable[[Design, Linear], np.ndarray]] = {
    "sliding": lambda d, l: l.sliding_m_s,
    "speed": lambda d, l: d.speed_m_s,
    "time": lambda d, l: d.time_s,
    "energy": lambda d, l: np.sqrt(np.maximum(l.energy_J_m, 0.0)),
    "load": lambda d, l: d.load_N,
    "acceleration": lambda d, l: np.clip(l.acceleration_rad_s2, -30.0, 30.0),
    "disc_heat": lambda d, l: d.heat_MJ,
    "deceleration": lambda d, l: d.deceleration_m_s2,
}


def bumps(values: np.ndarray, count: int = 4) -> np.ndarray:
    """Smooth functions of a covariate: Gaussian bumps at its quantiles, shape (n, count)."""
    knots = np.quantile(values, np.linspace(0.04, 0.96, count))
    width = np.maximum(np.gradient(knots), 1e-3 * max(np.ptp(values), 1e-12))
    return np.exp(-0.5 * ((values[:, None] - knots) / width) ** 2)


def _smooth_functions(w: _Writer) -> None:
    d, friction = w.design, w.rate("friction")

    def along(name: str, changes: Iterable[np.ndarray], axle: int = 0) -> None:
        on = of_axle(d, axle)
        w.variant(f"along {name}", ((friction * change * on, None) for change in changes), {}, axle)

    for name, of in COVARIATES.items():
        along(name, bumps(of(d, w.linear)).T)
    along("axle", (of_axle(d, j + 1) for j in range(AXLES - 1)))
    # what befalls one wheelset at some moment, not all the time
    shapes = bumps(d.time_s)
    for j in range(AXLES):
        along("time of one axle", (shapes - shapes.mean(axis=0)).T, j + 1)
    along("wheel_angle", (shape(k * d.angle_rad) for k in (1, 2) for shape in (np.cos, np.sin)))
    for name, values in (("time", d.time_s), ("speed", d.speed_m_s)):
        w.variant(f"along vehicle {name}", ((None, bump) for bump in bumps(of_vehicle(d, values)).T), {})
