"""The sensitivity matrix: how each coefficient would change a replay, one column per coefficient.

A coefficient is a base parameter, or belongs to a cause or to a smooth function. Its column has a
course in time: the change of a wheel's acceleration, and of the vehicle's, for one unit of the
coefficient. It acts on the wheelsets of some segments, so many columns share a course. Base
parameters are always in the fit. Those with a declared tolerance have a prior. A cause has one or
several columns, and some causes have variants of shape.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.vehicle import wheelsets_of
from rollerrig.rig.identify.causes import candidates, courses, discrepancy, table
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.causes.courses import of_run, vehicle_samples
from rollerrig.rig.identify.causes.table import Search, Shape
from rollerrig.rig.identify.data import parameters, pulses
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.identify.replay.sensitivity import F00, Innovations, Inputs, LinearisedReplay
from rollerrig.rig.mechanisms.mechanism import CONTACT, FRICTION, LOAD, TORQUE, VEHICLE

# grids of the search for patches and for sand; edges are moved off them afterwards
PLACE_BIN_M = 25.0
TIME_BIN_S = 2.0
BASE = "base"
TORQUE_SMOOTHING_S = 0.03
LARGEST_ACCELERATION_RAD_S2 = 30.0  # of the covariate "acceleration"; larger ones are outliers
_FREE = 0.0  # prior of a coefficient without a tolerance

# `LinearisedReplay.constants` begins with the changes of the recovery and of the contaminant's
# level; those of causes follow.
_TAU = 0
_LEVEL = 1
_FIRST_CAUSE = 2


class Part(NamedTuple):
    """What one unit of a coefficient changes; None: nothing.

    The vehicles feel either an acceleration (vehicle samples,), or a brake torque in N m for each
    wheel (n,). Such a torque acts through the wheelsets on which the column acts.
    """

    wheel: np.ndarray | None  # (n,) acceleration of the wheels in rad/s2
    felt: np.ndarray | None  # what the vehicles feel


class Column(NamedTuple):
    """One coefficient: its cause, its label, and its prior standard deviation (0: free)."""

    cause: str
    label: str
    prior: float


class Variant(NamedTuple):
    """A cause in one shape on an axle (0: all, -n: bogie n), and the numbers of its columns."""

    cause: str
    columns: tuple[int, ...]
    shape: Shape
    axle: int


class SensitivityMatrix(NamedTuple):
    """Columns, their courses and the variants of causes.

    Courses are numbered: first those in `wheel`, then those of bins, then those of variants with a
    finite step. The course of a bin is `in_bins` at the samples where `bins` holds its number, and
    0 elsewhere. The course of a finite step is the difference of whole replays, which the fit
    computes.
    """

    columns: list[Column]
    wheel: np.ndarray  # (courses, n)
    course: np.ndarray  # (columns,) number of the course of each column, -1: none
    acts: np.ndarray  # (columns, segments) whether the column acts there
    bins: np.ndarray  # (kinds, n) number of the course of the bin at each sample, -1: none
    in_bins: np.ndarray  # (n,)
    stepped: dict[int, Variant]  # variants with a finite step, by the number of their course
    vehicle: np.ndarray  # (columns on the vehicles, vehicle samples)
    on_vehicle: np.ndarray  # the numbers of these columns
    variants: list[Variant]

    def variant_of(self, cause: Cause) -> Variant | None:
        """Return the variant with the shape of a cause; None if the matrix has none."""
        for variant in self.variants:
            is_same_cause = variant.cause == cause.name and variant.axle == cause.axle
            if is_same_cause and variant.shape == cause.shape:
                return variant
        return None


class _Writer:
    """Collects the columns of a sensitivity matrix around one replay."""

    def __init__(self, design: Design, inputs: Inputs, linear: LinearisedReplay) -> None:
        self.design = design
        self.inputs = inputs
        self.linear = linear
        self.torque_Nm = smooth_torque(design, inputs.torque_Nm)
        self.columns: list[Column] = []
        self.courses_of_wheels: list[np.ndarray] = []
        self.course_of: list[int] = []  # of each column
        self.acts: list[np.ndarray] = []  # of each column, (segments,)
        self.vehicle: dict[int, np.ndarray] = {}  # by the number of the column
        self.variants: list[Variant] = []

    def add_course(self, wheel: np.ndarray | None) -> int:
        """Add a course of the wheels (n,) and return its number; -1 for None."""
        if wheel is None:
            return -1
        self.courses_of_wheels.append(wheel.astype(np.float32))
        return len(self.courses_of_wheels) - 1

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
        """Add a column of a course and return its number.

        It acts on one axle (0: all, -n: bogie n) of one run (None: all).
        """
        design = self.design
        number = len(self.columns)
        if vehicle is not None:
            self.vehicle[number] = vehicle.astype(np.float32)
        acts = courses.acts_on(design, axle)
        if run is not None:
            acts = acts & (design.run == run)
        self.course_of.append(course)
        self.acts.append(acts)
        self.columns.append(Column(cause, label, prior))
        return number

    def add_variants(
        self, cause: str, parts: Iterable[Part], shape: Shape, axles: Iterable[int] = (0,)
    ) -> None:
        """Add a cause in a shape on each of some axles, with a column for each part."""
        # all axles share the courses of the wheels
        courses_of_parts = []
        felt_of_parts = []
        for part in parts:
            courses_of_parts.append(self.add_course(part.wheel))
            felt_of_parts.append(part.felt)

        for axle in axles:
            columns = []
            for k, course in enumerate(courses_of_parts):
                vehicle = self.vehicle_acceleration(felt_of_parts[k], axle)
                columns.append(self.add(cause, str(k), course, vehicle, axle=axle))
            self.variants.append(Variant(cause, tuple(columns), shape, axle))

    def vehicle_acceleration(self, felt: np.ndarray | None, axle: int) -> np.ndarray | None:
        """Return the acceleration of the vehicles, from what they feel (`Part.felt`)."""
        design = self.design
        if felt is None or felt.size == design.vehicle_m_s.size:
            return felt
        mass_kg = vehicle_mass(design)
        return -sum_of_wheelsets(design, felt, axle) / (design.base[parameters.RADIUS] * mass_kg)

    def rate(self, name: str) -> np.ndarray:
        """Return the change of a wheel's acceleration for a name of `sensitivity.RATES`, (n,)."""
        return self.linear.rates[sensitivity.RATES.index(name)]

    def of_torque(self, change_Nm: np.ndarray) -> Part:
        """Return what a change of the brake torque does to wheels and vehicles."""
        wheel = -change_Nm / self.inputs.parameters[0, parameters.INERTIA]
        return Part(wheel, change_Nm)


def smooth_torque(design: Design, torque_Nm: np.ndarray) -> np.ndarray:
    """Return the torque of the step after each sample, smoothed within each segment, shape (n,)."""
    out = np.empty_like(torque_Nm)
    for s in range(design.segments):
        at = design.span(s)
        smooth = gaussian_filter1d(
            torque_Nm[at], TORQUE_SMOOTHING_S / design.step_s, mode="nearest"
        )
        # half a sample later
        out[at] = 0.5 * (smooth + np.append(smooth[1:], smooth[-1]))
    return out


def time_derivative(design: Design, values: np.ndarray) -> np.ndarray:
    """Return d/dt within each segment, shape (n,)."""
    return np.concatenate(
        [np.gradient(values[design.span(s)], design.step_s) for s in range(design.segments)]
    )


def sum_of_wheelsets(design: Design, values: np.ndarray, axle: int = 0) -> np.ndarray:
    """Return the sum over wheelsets (`wheelsets_of`: all by default), shape (vehicle samples,)."""
    axles = wheelsets_of(axle, design.axles)
    sums = []
    for run in range(design.mass_kg.size):
        first = design.axles * run
        sums.append(sum(values[design.span(first + j - 1)] for j in axles))
    return np.concatenate(sums)


def vehicle_mass(design: Design) -> np.ndarray:
    """Return the mass in kg at each vehicle sample."""
    return np.repeat(design.mass_kg, np.diff(design.vehicle_start))


def build(
    design: Design,
    inputs: Inputs,
    causes: Sequence[Cause] = (),
    search: bool = True,
    replayed: Innovations | None = None,
) -> tuple[SensitivityMatrix, LinearisedReplay]:
    """Return the sensitivity matrix around a replay, and that replay.

    The matrix has the base and `causes`; with `search` also all other causes and smooth functions.
    `replayed` are the innovations of these inputs, if they are known.
    """
    wanted = _wanted(causes, search)
    constants = [
        (row, shape)
        for row, shape in wanted
        if row.mechanism.acts_on == CONTACT and row.mechanism.constants
    ]
    linear = sensitivity.linearise(design, inputs, _changed(inputs, constants), replayed)
    writer = _Writer(design, inputs, linear)

    _add_base(writer)
    for row, shape in wanted:
        parts = _parts(writer, row, shape, constants)
        writer.add_variants(row.name, parts, shape, row.places(design.axles))
    bins: list[_Bins] = []
    if search:
        bins = _add_bins(writer)
        for cause in causes:
            _add_size_changes(writer, cause, constants)
        swings = any(table.BY_NAME[cause.name].phase for cause in causes)
        _add_smooth_functions(writer, swings)
    return _matrix(writer, bins), linear


def _wanted(causes: Sequence[Cause], search: bool) -> list[tuple[Search, Shape]]:
    """Return the causes and shapes of a matrix: those of the search, then others of `causes`."""
    wanted = []
    for row in table.TABLE:
        shapes = row.shapes if search else ()
        for shape in shapes:
            wanted.append((row, shape))
        for cause in causes:
            if cause.name == row.name and cause.shape not in shapes:
                wanted.append((row, cause.shape))
    return wanted


def _matrix(writer: _Writer, bins: Sequence["_Bins"]) -> SensitivityMatrix:
    """Return the matrix of the collected columns; numbers the courses that are not written out."""
    linear = writer.linear
    course = np.array(writer.course_of)
    count = len(writer.courses_of_wheels)

    # the bins of one kind have courses in their order, and all columns of a kind share them
    bin_courses = np.full((len(bins), writer.design.measured_rad_s.size), -1)
    for kind, (columns, number) in enumerate(bins):
        inside = number >= 0
        bin_courses[kind, inside] = number[inside] + count
        for numbers_of_columns in columns:
            course[numbers_of_columns] = np.arange(count, count + len(numbers_of_columns))
        count += len(columns[0])

    stepped = {}
    for variant in writer.variants:
        if variant.cause in table.BY_NAME and table.BY_NAME[variant.cause].finite_step:
            course[variant.columns[0]] = count
            stepped[count] = variant
            count += 1
    return SensitivityMatrix(
        columns=writer.columns,
        wheel=np.array(writer.courses_of_wheels),
        course=course,
        acts=np.array(writer.acts),
        bins=bin_courses,
        in_bins=linear.constants[_LEVEL].astype(np.float32),
        stepped=stepped,
        vehicle=np.array([*writer.vehicle.values()]),
        on_vehicle=np.array([*writer.vehicle]),
        variants=writer.variants,
    )


def _changed(inputs: Inputs, constants: list[tuple[Search, Shape]]) -> np.ndarray:
    """Return the parameters after each of some changes, shape (segments, changes, PARAMETERS).

    Each change enlarges one thing by STEP: the recovery, the contaminant's level, then each of
    `constants` (causes that change constants of the model).
    """
    p = inputs.parameters
    rows = [p, p]
    for row, shape in constants:
        rows.append(candidates.changed_parameters(p, row, shape, sensitivity.STEP))
    changed = np.stack(rows, axis=1)
    changed[:, _TAU, parameters.TAU] *= 1.0 + sensitivity.STEP
    changed[:, _LEVEL, parameters.MU_CD] *= 1.0 + sensitivity.STEP
    return changed


def _add_base(writer: _Writer) -> None:
    """Add the columns of the base parameters."""
    design = writer.design
    tolerance = max(design.calibration, 1e-4)
    # the gain of all torques and that of a wheelset share the tolerance
    gain_tolerance = tolerance / np.sqrt(2.0)
    level = writer.add_course(writer.linear.constants[_LEVEL])
    load = writer.add_course(writer.rate("load"))
    runs = range(design.mass_kg.size)

    for run in runs:
        writer.add(BASE, f"ln_mu_cd_{run}", level, run=run)
    writer.add(BASE, "ln_tau", writer.add_course(writer.linear.constants[_TAU]))

    wheel, felt = writer.of_torque(writer.torque_Nm)
    torque = writer.add_course(wheel)
    writer.add(
        BASE, "torque_gain", torque, writer.vehicle_acceleration(felt, 0), prior=gain_tolerance
    )
    for j in range(design.axles):
        writer.add(
            BASE,
            f"torque_gain_{j}",
            torque,
            writer.vehicle_acceleration(felt, j + 1),
            prior=gain_tolerance,
            axle=j + 1,
        )
        writer.add(BASE, f"load_gain_{j}", load, None, prior=tolerance, axle=j + 1)

    force = np.concatenate([sensitivity.vehicle_force(design, writer.inputs, run) for run in runs])
    run_of_sample = np.repeat(runs, np.diff(design.vehicle_start))
    for run in runs:
        writer.add(BASE, f"mass_{run}", -1, force * (run_of_sample == run), prior=tolerance)
    _add_discrepancy(writer)


def _add_discrepancy(writer: _Writer) -> None:
    """Add the columns of the model discrepancy, which are base parameters too."""
    design = writer.design
    of_vehicle = np.repeat(np.arange(design.mass_kg.size), np.diff(design.vehicle_start))
    parts: dict[tuple[bool, int], tuple[int, np.ndarray | None]] = {}
    vehicles: dict[tuple[bool, int, int], np.ndarray | None] = {}
    for mode in discrepancy.modes(design):
        is_common = mode.axle == discrepancy.ALL_AXLES
        kind = (is_common, mode.number)
        if kind not in parts:
            part = writer.of_torque(writer.torque_Nm * discrepancy.course(design, mode))
            parts[kind] = (writer.add_course(part.wheel), part.felt)
        course, felt = parts[kind]
        # the runs share the course of a wheelset
        of_wheelset = (*kind, mode.axle)
        if of_wheelset not in vehicles:
            vehicles[of_wheelset] = writer.vehicle_acceleration(felt, mode.axle)
        vehicle = vehicles[of_wheelset]
        assert vehicle is not None
        run = None
        if mode.run != discrepancy.ALL_RUNS:
            run = mode.run
            vehicle = vehicle * (of_vehicle == run)
        writer.add(BASE, mode.label, course, vehicle, prior=mode.prior, axle=mode.axle, run=run)

    if design.wheel_sensor.is_pulses:
        late = _speed_delay_part(writer).wheel
        assert late is not None
        turning_rad_s = design.speed_m_s / design.base[parameters.RADIUS]
        priors = discrepancy.priors(design)
        for label, unit_s in (
            (discrepancy.LATE_WINDOW, design.step_s),
            (discrepancy.LATE_PULSE, 1.0 / np.maximum(turning_rad_s, pulses.LEAST_SPEED_RAD_S)),
        ):
            writer.add(BASE, label, writer.add_course(late * unit_s), prior=priors[label])


def _parts(
    writer: _Writer, row: Search, shape: Shape, constants: list[tuple[Search, Shape]]
) -> Iterator[Part]:
    """Yield the part of each coefficient of a cause in a shape, on all axles."""
    design = writer.design
    linear = writer.linear
    mechanism = row.mechanism
    if row.finite_step:
        # the fit computes the response as a difference of whole replays
        yield Part(None, None)
    elif row.name in _SPECIAL_PARTS:
        yield _SPECIAL_PARTS[row.name](writer)
    elif (row, shape) in constants:
        number = _FIRST_CAUSE + constants.index((row, shape))
        yield Part(linear.constants[number], None)
    elif mechanism.acts_on == VEHICLE:
        force_N = candidates.resistance(design, design.mass_kg, row, shape, 1.0)
        yield Part(None, -force_N / vehicle_mass(design))

    for course in courses.courses(design, row.name, shape):
        if "on_vehicle" in shape:
            yield Part(None, -vehicle_samples(design, course) / vehicle_mass(design))
        elif mechanism.acts_on == FRICTION:
            rate = writer.rate("friction")
            if shape.get("contaminant_alone"):
                rate = linear.constants[_LEVEL]
            yield Part(rate * course, None)
        elif mechanism.acts_on == TORQUE:
            change_Nm = writer.torque_Nm * course if mechanism.share else course
            yield writer.of_torque(change_Nm)
        elif mechanism.acts_on == LOAD:
            yield Part(writer.rate("load") * course, None)


def _torque_delay_part(writer: _Writer) -> Part:
    """Return the part of a torque that is measured late."""
    return writer.of_torque(time_derivative(writer.design, writer.torque_Nm))


def _speed_delay_part(writer: _Writer) -> Part:
    """Return the part of a wheel speed that is measured late: it belongs to earlier inputs."""
    design = writer.design
    row = writer.inputs.parameters[0]
    error_rate_1_s = np.log(np.maximum(writer.linear.coefficients[:, F00], 1e-12)) / design.step_s
    of_torque = time_derivative(design, writer.torque_Nm) / row[parameters.INERTIA]
    of_speed = error_rate_1_s / row[parameters.RADIUS] * time_derivative(design, design.speed_m_s)
    return Part(of_torque + of_speed, None)


def _inertia_part(writer: _Writer) -> Part:
    """Return the part of a different inertia of the wheelsets."""
    design = writer.design
    inertia_kgm2 = writer.inputs.parameters[0, parameters.INERTIA]
    wheel = writer.torque_Nm / inertia_kgm2 - writer.rate("irregularity")
    return Part(wheel, inertia_kgm2 * time_derivative(design, design.turning_rad_s))


def _radius_part(writer: _Writer) -> Part:
    """Return the part of a different wheel radius."""
    return Part(writer.rate("radius"), None)


def _sensor_scale_part(writer: _Writer) -> Part:
    """Return the part of a speed sensor that reads too high (`candidates._with_sensor_scale`).

    It is that of a smaller radius, with inertia and torque that keep the balance of the wheel.
    """
    inertia_kgm2 = writer.inputs.parameters[0, parameters.INERTIA]
    of_torque = writer.torque_Nm / inertia_kgm2
    return Part(2.0 * writer.rate("irregularity") - writer.rate("radius") - of_torque, None)


# causes whose part does not follow from a course or from constants
_SPECIAL_PARTS: dict[str, Callable[[_Writer], Part]] = {
    "torque_sensor_delay": _torque_delay_part,
    "speed_sensor_delay": _speed_delay_part,
    "wheel_inertia": _inertia_part,
    "wheel_radius": _radius_part,
    "sensor_scale": _sensor_scale_part,
}


class _Bins(NamedTuple):
    """Bins of one kind. Several lists of columns may share the bins; each has a column per bin."""

    columns: list[list[int]]
    number: np.ndarray  # (n,) number of the bin of each sample, -1: none


def _add_bins(writer: _Writer) -> list[_Bins]:
    """Add bins of place (all runs together) and of time (each run); a window is a run of bins."""
    return [_add_place_bins(writer), _add_time_bins(writer)]


def _add_place_bins(writer: _Writer) -> _Bins:
    """Add a column for each bin of place."""
    design = writer.design
    lowest_m, highest_m = design.places_m
    count = int(np.ceil((highest_m - lowest_m) / PLACE_BIN_M))
    columns = [
        writer.add("place_bin", f"{lowest_m + i * PLACE_BIN_M:.6g}", -1) for i in range(count)
    ]
    number = np.floor((design.place_m - lowest_m) / PLACE_BIN_M).astype(int)
    number[(number < 0) | (number >= count)] = -1
    return _Bins([columns], number)


def _add_time_bins(writer: _Writer) -> _Bins:
    """Add two columns for each bin of time: on all wheelsets, and on those behind the first one."""
    design = writer.design
    on_all: list[int] = []
    behind_first: list[int] = []
    number = np.full(design.time_s.size, -1)
    for run, end_s in enumerate(design.ends_s):
        count = int(np.ceil(end_s / TIME_BIN_S))
        first = len(on_all)
        for i in range(count):
            label = f"{run} {i * TIME_BIN_S:.6g}"
            on_all.append(writer.add("time_bin", label, -1, run=run))
            behind_first.append(writer.add("time_bin behind", label, -1, run=run))
            acts_of_last_column = writer.acts[-1]
            acts_of_last_column[design.axle == 0] = False
        number_in_run = np.floor(design.time_s / TIME_BIN_S).astype(int)
        inside = (of_run(design, run) > 0.0) & (number_in_run < count)
        number[inside] = first + number_in_run[inside]
    return _Bins([on_all, behind_first], number)


def _add_size_changes(writer: _Writer, cause: Cause, constants: list[tuple[Search, Shape]]) -> None:
    """Add smooth functions in the size of a cause: a different size in each run, or along time.

    A true mechanism has one size, so these reveal a wrong cause.
    """
    design = writer.design
    row = table.BY_NAME[cause.name]
    if row.phase or row.finite_step:
        return

    changes: dict[str, list[np.ndarray]] = {}
    if design.mass_kg.size > 1:
        changes["the runs"] = [of_run(design, run) for run in range(1, design.mass_kg.size)]
    # for all other causes the smooth functions along time show the same
    if row.name in _SPECIAL_PARTS:
        changes["time"] = [design.time_s / design.time_s.mean() - 1.0]

    for along, courses_of_size in changes.items():
        for part in _parts(writer, row, cause.shape, constants):
            resized = []
            for size in courses_of_size:
                wheel = _times(design, part.wheel, size)
                felt = _times(design, part.felt, size)
                resized.append(Part(wheel, felt))
            writer.add_variants(
                f"along {along} in the size of {cause.name}",
                resized,
                shape={},
                axles=(cause.axle,),
            )


def _times(design: Design, part: np.ndarray | None, size: np.ndarray) -> np.ndarray | None:
    """Return an entry of a `Part` times a course (n,); None remains None."""
    if part is None:
        return None
    if part.size == size.size:
        return part * size
    return part * vehicle_samples(design, size)


# the covariates along which smooth functions are tried, from the replay or the measurement
ALONG: dict[str, Callable[[Design, LinearisedReplay], np.ndarray]] = {
    "sliding": lambda design, linear: linear.sliding_m_s,
    "speed": lambda design, linear: design.speed_m_s,
    "time": lambda design, linear: design.time_s,
    "energy": lambda design, linear: np.sqrt(np.maximum(linear.energy_J_m, 0.0)),
    "load": lambda design, linear: design.load_N,
    "acceleration": lambda design, linear: np.clip(
        linear.acceleration_rad_s2, -LARGEST_ACCELERATION_RAD_S2, LARGEST_ACCELERATION_RAD_S2
    ),
    "disc_heat": lambda design, linear: design.heat_MJ,
    "deceleration": lambda design, linear: design.deceleration_m_s2,
}


def bumps(values: np.ndarray, count: int = 4) -> np.ndarray:
    """Return smooth functions of a covariate: Gaussian bumps at its quantiles, shape (count, n)."""
    knots = np.quantile(values, np.linspace(0.04, 0.96, count))
    width = np.maximum(np.gradient(knots), 1e-3 * max(np.ptp(values), 1e-12))
    return np.exp(-0.5 * ((values - knots[:, None]) / width[:, None]) ** 2)


def _add_smooth_functions(writer: _Writer, swings: bool) -> None:
    """Add the smooth functions, which show that something remains that no cause explains.

    `swings`: the explanation has a cause with a phase.
    """
    design = writer.design
    friction = writer.rate("friction")
    each_axle = range(1, design.axles + 1)

    def add_along(name: str, changes: Iterable[np.ndarray], axles: Iterable[int] = (0,)) -> None:
        """Add changes of friction."""
        parts = [Part(friction * change, None) for change in changes]
        writer.add_variants(f"along {name}", parts, {}, axles)

    for name, covariate in ALONG.items():
        add_along(name, bumps(covariate(design, writer.linear)))

    # a different friction on each wheelset; the last one has the level of the run
    course = writer.add_course(friction)
    columns = []
    for j in range(design.axles - 1):
        columns.append(writer.add("along axle", str(j), course, axle=j + 1))
    writer.variants.append(Variant("along axle", tuple(columns), {}, 0))

    # A change on one wheelset at some time. Its mean is removed, so that a change that lasts all
    # the time does not count here.
    of_time = bumps(design.time_s)
    add_along("time of one axle", of_time - of_time.mean(axis=1)[:, None], each_axle)

    # once and twice a turn
    swings_of_turn = []
    for times_a_turn in (1, 2):
        angle_rad = times_a_turn * design.angle_rad
        swings_of_turn += [np.cos(angle_rad), np.sin(angle_rad)]
    add_along("wheel_angle", swings_of_turn)

    # a force on the vehicle
    for name, values in (("time", design.time_s), ("speed", design.speed_m_s)):
        parts = [Part(None, bump) for bump in bumps(vehicle_samples(design, values))]
        writer.add_variants(f"along vehicle {name}", parts, {})

    if swings:
        # The remainder of a constant load variation where the variation grows with speed. No load
        # variation does, but an eccentric pole wheel does.
        faster = design.speed_m_s / design.speed_m_s.mean() - 1.0
        changes = []
        for run in range(design.mass_kg.size):
            for wave in (np.cos, np.sin):
                changes.append(faster * wave(design.angle_rad) * of_run(design, run))
        add_along("wheel_angle and speed", changes, each_axle)
