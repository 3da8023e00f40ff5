"""The list of all that could change a replay: base parameters, causes, and smooth functions.

A column is a course in time of the change of a wheel's acceleration (and of the vehicle's) for a unit of one
coefficient, on the wheelsets of some segments: many columns share a course. Base parameters always stay in the fit,
those with a declared tolerance under a prior; a cause is one or several columns, some causes have variants of shape.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.rig.identify.causes import candidates, courses, table
from rollerrig.rig.identify.causes.courses import of_run, of_vehicle
from rollerrig.rig.identify.causes.table import Search, Shape
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.data.runs import AXLES
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.identify.replay.sensitivity import Inputs, LinearisedReplay
from rollerrig.rig.mechanisms.mechanism import CONTACT, FRICTION, LOAD, TORQUE, VEHICLE

PLACE_BIN_M = 25.0
TIME_BIN_S = 2.0
BASE = "base"
_FREE = 0.0  # tolerance of ln tau and of the contact's constants, which the base may use freely
# of all wheels; of the vehicles, or of all wheels as the torque that the vehicles feel of those that it is on
Part = tuple[np.ndarray | None, np.ndarray | None]


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
    """Columns, their courses and variants. `wheel` (courses, n), `vehicle` (columns on it, nv).

    Behind the courses come those of bins, each `in_bins` where `bins` (kinds, n) holds its number, and of memory.
    """

    columns: list[Column]
    wheel: np.ndarray
    course: np.ndarray  # (columns,) of each column, -1: none
    acts: np.ndarray  # (columns, segments) whether it acts there
    bins: np.ndarray
    in_bins: np.ndarray
    memory: dict[int, Shape]  # shapes of memory by the numbers of their courses
    vehicle: np.ndarray
    on_vehicle: np.ndarray  # (columns on it,)
    variants: list[Variant]

    def variant_of(self, cause: candidates.Cause) -> Variant | None:
        """The one of a cause in its shape, where it was searched."""
        return next((v for v in self.variants if (v.cause, v.axle, v.shape) == cause[:3]), None)


class _Writer:
    """Collects columns: courses of the wheels (flat) with the segments where they act, and vehicle parts (flat)."""

    def __init__(self, design: Design, inputs: Inputs, linear: LinearisedReplay) -> None:
        self.design, self.inputs, self.linear = design, inputs, linear
        self.torque = smooth_torque(design, inputs.torque_Nm)
        self.columns: list[Column] = []
        self.wheel: list[np.ndarray] = []
        self.vehicle: dict[int, np.ndarray] = {}
        self.uses: list[tuple[int, np.ndarray]] = []
        self.variants: list[Variant] = []

    def course(self, wheel: np.ndarray | None) -> int:
        """The number of a new course of the wheels."""
        if wheel is None:
            return -1
        self.wheel.append(wheel.astype(np.float32))
        return len(self.wheel) - 1

    def add(
        self,
        cause: str,
        label: str,
        course: int,
        vehicle: np.ndarray | None = None,
        prior: float = _FREE,
        axle: int = 0,
        run: int | None = None,
    ) -> int:
        """A column of a course, on an axle (0: all) of a run (None: all)."""
        d = self.design
        if vehicle is not None:
            self.vehicle[len(self.columns)] = vehicle.astype(np.float32)
        self.uses.append(
            (course, ((d.axle == axle - 1) | (axle == 0)) & (True if run is None else d.run == run))
        )
        self.columns.append(Column(cause, label, prior))
        return len(self.columns) - 1

    def variants_of(
        self, cause: str, parts: Iterable[Part], shape: Shape, axles: Iterable[int] = (0,)
    ) -> None:
        """A cause in a shape on each of some axles, with a column for each part."""
        given = [(self.course(wheel), vehicle) for wheel, vehicle in parts]
        for axle in axles:
            found = tuple(
                self.add(cause, str(k), course, self.felt(vehicle, axle), axle=axle)
                for k, (course, vehicle) in enumerate(given)
            )
            self.variants.append(Variant(cause, found, shape, axle))

    def felt(self, part: np.ndarray | None, axle: int) -> np.ndarray | None:
        """What the vehicles feel: of a change of the brake torque on an axle the force over their mass."""
        d = self.design
        if part is None or part.size == d.vehicle_m_s.size:
            return part
        return -to_vehicle(d, part, axle) / (d.base[parameters.RADIUS] * vehicle_mass(d))

    def rate(self, name: str) -> np.ndarray:
        """Change of a wheel's acceleration for one of `sensitivity.RATES`."""
        return self.linear.rates[sensitivity.RATES.index(name)]

    def of_torque(self, change: np.ndarray) -> Part:
        """What a change of the brake torque does to wheels and vehicles."""
        return -change / self.inputs.parameters[0, parameters.INERTIA], change


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
    return np.concatenate(
        [np.gradient(values[design.span(s)], design.step_s) for s in range(design.segments)]
    )


def to_vehicle(design: Design, force: np.ndarray, axle: int = 0) -> np.ndarray:
    """Sum over the wheelsets (or that of one) of a flat array, as one flat array of vehicles."""
    chosen = range(AXLES) if axle == 0 else (axle - 1,)
    return np.concatenate(
        [
            sum(force[design.span(AXLES * run + j)] for j in chosen)
            for run in range(design.mass_kg.size)
        ]
    )


def vehicle_mass(design: Design) -> np.ndarray:
    """Mass in kg on each vehicle sample."""
    return np.repeat(design.mass_kg, np.diff(design.vehicle_start))


def write(
    design: Design, inputs: Inputs, causes: Sequence[candidates.Cause] = (), search: bool = True
) -> tuple[SensitivityMatrix, LinearisedReplay]:
    """Columns of a design around a replay, and that replay: base, the causes in it, all of the search."""
    tried = {row.name: row.shapes if search else () for row in table.TABLE}
    wanted = [
        (row, shape)
        for row in table.TABLE
        for shape in (
            *tried[row.name],
            *(c.shape for c in causes if c.name == row.name and c.shape not in tried[row.name]),
        )
    ]
    constants = [
        (row, shape)
        for row, shape in wanted
        if row.mechanism.acts_on == CONTACT and row.mechanism.constants
    ]
    w = _Writer(design, inputs, sensitivity.linearise(design, inputs, _changed(inputs, constants)))
    _base(w)
    for row, shape in wanted:
        w.variants_of(row.name, _parts(w, row, shape, constants), shape, row.axles)
    places = _windows(w) if search else []
    if search:
        for cause in causes:
            _in_size(w, cause, constants)
        _smooth_functions(w, any(table.BY_NAME[cause.name].phase for cause in causes))
    course, acts = (np.array(part) for part in zip(*w.uses, strict=True))
    # courses that are not written: of the windows, bins of one change, and of memory, answers of the whole filter
    bins, count = np.full((len(places), design.measured_rad_s.size), -1), len(w.wheel)
    for kind, (columns, number) in enumerate(places):
        held = number >= 0
        bins[kind, held] = number[held] + count
        for own in columns:
            course[own] = np.arange(count, count + len(own))
        count += len(columns[0])
    memory = {}
    for v in w.variants:
        if v.cause == "adhesion_memory":
            course[v.columns[0]], memory[count], count = count, v.shape, count + 1
    return SensitivityMatrix(
        columns=w.columns,
        wheel=np.array(w.wheel),
        course=course,
        acts=acts,
        bins=bins,
        in_bins=w.linear.constants[1].astype(np.float32),
        memory=memory,
        vehicle=np.array([*w.vehicle.values()]),
        on_vehicle=np.array([*w.vehicle]),
        variants=w.variants,
    ), w.linear


def _changed(inputs: Inputs, constants: list[tuple[Search, Shape]]) -> np.ndarray:
    """Rows of parameters with the recovery, the level and each of some causes a step larger."""
    p = inputs.parameters
    found = np.stack(
        [p, p, *(candidates.changed_parameters(p, *one, sensitivity.STEP) for one in constants)],
        axis=1,
    )
    found[:, [0, 1], [parameters.TAU, parameters.MU_CD]] *= 1.0 + sensitivity.STEP
    return found


def _base(w: _Writer) -> None:
    d, tolerance = w.design, max(w.design.calibration, 1e-4)
    level, load = w.course(w.linear.constants[1]), w.course(w.rate("load"))
    runs = range(d.mass_kg.size)
    for run in runs:
        w.add(BASE, f"ln_mu_cd_{run}", level, run=run)
    w.add(BASE, "ln_tau", w.course(w.linear.constants[0]))
    change, felt = w.of_torque(w.torque)
    torque = w.course(change)
    w.add(BASE, "torque_gain", torque, w.felt(felt, 0), tolerance / np.sqrt(2.0))
    for j in range(AXLES):
        w.add(
            BASE, f"torque_gain_{j}", torque, w.felt(felt, j + 1), tolerance / np.sqrt(2.0), j + 1
        )
        w.add(BASE, f"load_gain_{j}", load, None, tolerance, j + 1)
    force = np.concatenate([sensitivity.vehicle_force(d, w.inputs, run) for run in runs])
    of_vehicle_run = np.repeat(runs, np.diff(d.vehicle_start))
    for run in runs:
        w.add(BASE, f"mass_{run}", -1, force * (of_vehicle_run == run), tolerance)


def _parts(
    w: _Writer, row: Search, shape: Shape, constants: list[tuple[Search, Shape]]
) -> Iterator[Part]:
    """The columns of a cause in a shape on all axles, one for each coefficient."""
    d, m = w.design, row.mechanism
    if row.name in _OWN:
        yield _OWN[row.name](w)
    elif (row, shape) in constants:
        yield w.linear.constants[2 + constants.index((row, shape))], None
    elif m.acts_on == VEHICLE:
        yield None, -candidates.resistance(d, d.mass_kg, row, shape, 1.0) / vehicle_mass(d)
    for course in courses.courses(d, row.name, shape):
        if "on_vehicle" in shape:
            yield None, -of_vehicle(d, course) / vehicle_mass(d)
        elif m.acts_on == FRICTION:
            yield (
                (w.linear.constants[1] if shape.get("contaminant_alone") else w.rate("friction"))
                * course,
                None,
            )
        elif m.acts_on == TORQUE:
            yield w.of_torque(w.torque * course if m.share else course)
        elif m.acts_on == LOAD:
            yield w.rate("load") * course, None


def _speed_delay(w: _Writer) -> Part:
    """A late wheel speed: the wheel lives on the inputs of a moment ago."""
    d, p = w.design, w.inputs.parameters[0]
    growth = np.log(np.maximum(w.linear.coefficients[:, 0], 1e-12)) / d.step_s
    return rate(d, w.torque) / p[parameters.INERTIA] + growth / p[parameters.RADIUS] * rate(
        d, d.speed_m_s
    ), None


def _inertia(w: _Writer) -> Part:
    inertia = w.inputs.parameters[0, parameters.INERTIA]
    return w.torque / inertia - w.rate("irregularity"), inertia * rate(
        w.design, w.design.measured_rad_s
    )


_OWN: dict[str, Callable[[_Writer], Part]] = {
    # its answer is a finite step of the whole filter, see `tuning`
    "adhesion_memory": lambda w: (None, None),
    "torque_sensor_delay": lambda w: w.of_torque(rate(w.design, w.torque)),
    "speed_sensor_delay": _speed_delay,
    "wheel_inertia": _inertia,
    "wheel_radius": lambda w: (w.rate("radius"), None),
}


def _windows(w: _Writer) -> list[tuple[list[list[int]], np.ndarray]]:
    """Bins of place (all runs) and of time (each run): windows are runs of bins; [(columns, bin (n,), -1: none)]."""
    d = w.design
    lowest, highest = d.places_m
    count = int(np.ceil((highest - lowest) / PLACE_BIN_M))
    at_place = [w.add("place_bin", f"{lowest + i * PLACE_BIN_M:.6g}", -1) for i in range(count)]
    place = np.floor((d.place_m - lowest) / PLACE_BIN_M).astype(int)
    place[(place < 0) | (place >= count)] = -1
    at_time: list[list[int]] = [[], []]
    time = np.full(d.time_s.size, -1)
    for run, end_s in enumerate(d.ends_s):
        count, began = int(np.ceil(end_s / TIME_BIN_S)), len(at_time[0])
        for i in range(count):
            for own, behind in zip(at_time, ("", " behind"), strict=True):
                own.append(w.add(f"time_bin{behind}", f"{run} {i * TIME_BIN_S:.6g}", -1, run=run))
                w.uses[-1][1][d.axle == 0] &= not behind
        number = np.floor(d.time_s / TIME_BIN_S).astype(int)
        inside = (of_run(d, run) > 0.0) & (number < count)
        time[inside] = began + number[inside]
    return [([at_place], place), (at_time, time)]


def _in_size(w: _Writer, cause: candidates.Cause, constants: list[tuple[Search, Shape]]) -> None:
    """What makes a cause another one in each run, or as time goes on: a mechanism has one size."""
    d, row = w.design, table.BY_NAME[cause.name]
    if row.phase or row.name == "adhesion_memory":
        return
    of_runs = [of_run(d, run) for run in range(1, d.mass_kg.size)]
    changes = {"the runs": of_runs} if of_runs else {}
    if row.name in _OWN:  # of what else acts on wheels or vehicle the smooth functions of time tell
        changes["time"] = [d.time_s / d.time_s.mean() - 1.0]
    for along, courses_of_size in changes.items():
        for wheel, felt in _parts(w, row, cause.shape, constants):
            w.variants_of(
                f"along {along} in the size of {cause.name}",
                [(_times(d, wheel, of), _times(d, felt, of)) for of in courses_of_size],
                {},
                (cause.axle,),
            )


def _times(d: Design, part: np.ndarray | None, of: np.ndarray) -> np.ndarray | None:
    return part if part is None else part * (of if part.size == of.size else of_vehicle(d, of))


# along which smooth functions are tried, as the replay or the measurement has it
ALONG: dict[str, Callable[[Design, LinearisedReplay], np.ndarray]] = {
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
    """Smooth functions of a covariate: Gaussian bumps at its quantiles, shape (count, n)."""
    knots = np.quantile(values, np.linspace(0.04, 0.96, count))
    width = np.maximum(np.gradient(knots), 1e-3 * max(np.ptp(values), 1e-12))
    return np.exp(-0.5 * ((values - knots[:, None]) / width[:, None]) ** 2)


def _smooth_functions(w: _Writer, swings: bool) -> None:
    d, friction = w.design, w.rate("friction")

    def along(name: str, changes: Iterable[np.ndarray], axles: Iterable[int] = (0,)) -> None:
        w.variants_of(f"along {name}", ((friction * change, None) for change in changes), {}, axles)

    for name, of in ALONG.items():
        along(name, bumps(of(d, w.linear)))
    every = w.course(friction)
    w.variants.append(
        Variant(
            "along axle",
            tuple(w.add("along axle", str(j), every, axle=j + 1) for j in range(AXLES - 1)),
            {},
            0,
        )
    )
    # what befalls one wheelset at some moment, not all the time
    shapes = bumps(d.time_s)
    along("time of one axle", shapes - shapes.mean(axis=1)[:, None], range(1, AXLES + 1))
    along("wheel_angle", (shape(k * d.angle_rad) for k in (1, 2) for shape in (np.cos, np.sin)))
    for name, values in (("time", d.time_s), ("speed", d.speed_m_s)):
        w.variants_of(
            f"along vehicle {name}", ((None, bump) for bump in bumps(of_vehicle(d, values))), {}
        )
    if swings:
        # what a swing of one size leaves of one that grows with the speed: no load does, a pole wheel off centre does
        faster = d.speed_m_s / d.speed_m_s.mean() - 1.0
        along(
            "wheel_angle and speed",
            (
                faster * shape(d.angle_rad) * of_run(d, run)
                for run in range(d.mass_kg.size)
                for shape in (np.cos, np.sin)
            ),
            range(1, AXLES + 1),
        )
