"""The points of a campaign: how the values of all runs are combined or drawn.

A plan varies values in two tables. `[vary]` has lists (for a matrix) or ranges with equal chances.
`[inputs]` has distributions with sources (`statistics.laws`), correlated by `[[correlation]]`; an
input may have a value for each brake unit. `[failures]` has components that can have failed.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.stats import qmc

from rollerrig.configs import table
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign import drawn_rows
from rollerrig.realtime.campaign.components import applied as applied_of
from rollerrig.realtime.campaign.components import failures as failures_of
from rollerrig.realtime.campaign.components import train as trains
from rollerrig.realtime.campaign.drawn_rows import DrawnRows
from rollerrig.realtime.campaign.statistics import drivers, laws, stratified
from rollerrig.realtime.campaign.statistics import strata as strata_of

MATRIX = "matrix"
SALTELLI = "saltelli"  # blocks of runs for Sobol indices
INDEPENDENT = "random"  # the only design whose runs are independent draws of equal weight
STRATIFIED = "stratified"  # independent draws in strata of exact probabilities
DESIGNS = (MATRIX, "sobol", "halton", "latin_hypercube", INDEPENDENT, SALTELLI, STRATIFIED)
# designs whose runs are a sample of the stops, so that failures have their probability
SAMPLES = (INDEPENDENT, STRATIFIED)
# keys of a range in [vary]
RANGE = (
    table.number("low", None, -1e300, 1e300, "-"),
    table.number("high", None, -1e300, 1e300, "-"),
    table.flag("log", False, "spread evenly in the logarithm"),
)
# keys of [brake] that each unit may have for itself: the factors of the brake torque
_OF_UNITS = ("pad_friction", "efficiency", "lever_ratio", "cylinder_area_m2", "disc_radius_m")
# keys that decide which components a vehicle has
_OF_VEHICLE = ("vehicle_set", "vehicle.axles", "vehicle.bogies_per_body", "brake.discs")
_RANGE_SOURCE = "the range of the plan, with equal chances; no source"


class Points(NamedTuple):
    """All runs of a plan.

    axes: names of the varied values.
    rows: the values of each run, in the order of `axes`.
    sources: (input, law, source) of each input that is drawn from a law.
    ranges: of each input that is drawn: its lowest and highest value, `log` if it is even in the
    logarithm, and its law in words.
    strata: of a stratified design, one after another in the order of the runs.
    applied: what inputs of single units and failures do to a run; None without them.
    """

    axes: tuple[str, ...]
    rows: Sequence[tuple[Any, ...]]
    sources: tuple[tuple[str, str, str], ...]
    ranges: tuple[dict[str, Any], ...] = ()
    strata: tuple[strata_of.Stratum, ...] = ()
    applied: applied_of.Applied | None = None


def points(
    vary: Any,
    inputs: Any,
    correlations: Any,
    head: Mapping[str, Any],
    path: Path,
    failures: Any = None,
    base: Mapping[str, Any] | None = None,
    coupled: trains.Train | None = None,
) -> Points:
    """Return the runs of a plan from its tables. Raises ConfigError.

    `head` has design, runs, seed and rows_up_to: the rows of a random design with more runs are
    drawn when they are needed. `base` is the resolved scenario of the plan, which plans with
    failures or inputs of single units need (`needs_vehicle`). `coupled` are the places of a train,
    whose first car `base` is.
    """
    for name, given in (("vary", vary), ("inputs", inputs)):
        if not isinstance(given, dict):
            raise ConfigError(f"{path} [{name}]: must be a table of values to vary")
    if failures and head["design"] not in SAMPLES:
        raise ConfigError(
            f"{path} [failures]: a {head['design']} design is no sample, so failures have no "
            f'probability in it; set design = "{STRATIFIED}", or "{INDEPENDENT}"'
        )
    if not vary and not inputs and not failures:
        raise ConfigError(
            f"{path}: [vary] and [inputs] are empty, so no value is varied; write, for example, "
            '"adhesion.mu_cd" = [0.03, 0.06] or { low = 0.03, high = 0.1 } in [vary]'
        )
    twice = sorted(set(vary) & set(inputs))
    if twice:
        raise ConfigError(f"{path}: {', '.join(twice)} is in [vary] and in [inputs]; keep one")

    if head["design"] == MATRIX:
        if inputs or correlations:
            raise ConfigError(
                f"{path}: a matrix combines lists, and [inputs] and [[correlation]] draw from laws;"
                f' set design = "{INDEPENDENT}"'
            )
        return Points(tuple(vary), tuple(_matrix(vary, path)), ())
    return _drawn(vary, inputs, correlations, head, path, failures, base, coupled)


def needs_vehicle(inputs: Any, failures: Any) -> bool:
    """Return whether a plan has failures, or inputs of single units of its vehicle."""
    if failures:
        return True
    entries = inputs.values() if isinstance(inputs, dict) else ()
    return any(isinstance(given, dict) and laws.PER in given for given in entries)


def _matrix(vary: Mapping[str, Any], path: Path) -> list[tuple[Any, ...]]:
    """Return all combinations of the listed values."""
    for key, values in vary.items():
        if not isinstance(values, list) or not values:
            raise ConfigError(
                f"{path} [vary] {key} = {values!r}: a matrix needs a list of values; "
                'for a range set design = "sobol"'
            )
    return list(itertools.product(*vary.values()))


def _drawn(
    vary: Mapping[str, Any],
    inputs: Mapping[str, Any],
    correlations: Any,
    head: Mapping[str, Any],
    path: Path,
    failures: Any,
    base: Mapping[str, Any] | None,
    coupled: trains.Train | None,
) -> Points:
    """Return the runs of a design that draws values."""
    design = head["design"]
    of_units = {key: given for key, given in inputs.items() if needs_vehicle({key: given}, None)}
    shared = [_range(key, given, design, path) for key, given in vary.items()]
    for key, given in inputs.items():
        if key not in of_units:
            _check_shared(key, given, path)
            shared.append(laws.read(key, given, f"{path} [inputs] {key}"))
    shared_axes = tuple(law.name for law in shared)
    matrix = laws.read_correlation(correlations, shared_axes, f"{path} [[correlation]]")
    all_laws = list(shared)
    sources = [(law.name, law.text, law.source) for law in shared]

    applied = None
    rarest = failures_of.RAREST.default
    if base is not None:
        _check_same_vehicle((*vary, *inputs), path)
        train = coupled or trains.of(base)
        unit_inputs = []
        for key, given in of_units.items():
            unit_input = _unit_input(key, given, train, base, path)
            law, of_input, text = _unit_law(key, given, unit_input, train, path)
            all_laws += [
                law._replace(name=name, elasticity=law.elasticity / len(unit_input.units))
                for name in unit_input.axes
            ]
            matrix = _block(matrix, of_input)
            sources.append((key, f"{law.text}; {text}", law.source))
            unit_inputs.append(unit_input)
        components, rarest = failures_of.read(failures or {}, train, path)
        sources += [(found.column, found.law, found.source) for found in components]
        axles_of_car = train.axles // train.cars if train.coupled else 0
        factors = tuple(base["brake"]["axle_factors"]) * (train.cars if train.coupled else 1)
        factors = factors or (1.0,) * train.axles
        applied = applied_of.Applied(
            train.discs, factors, tuple(unit_inputs), components, axles_of_car
        )
    components = applied.failures if applied else ()
    axes = tuple(law.name for law in all_laws)
    if design == SALTELLI and not np.array_equal(matrix, np.eye(len(matrix))):
        raise ConfigError(
            f"{path}: Sobol indices are for independent inputs, so a {SALTELLI} design has no "
            f'[[correlation]]; remove it, or set design = "{INDEPENDENT}"'
        )
    rows: Sequence[tuple[Any, ...]]
    in_strata: tuple[strata_of.Stratum, ...] = ()
    if is_large(head):
        identity = [vary, inputs, correlations, failures]
        rows = DrawnRows(head["runs"], head["seed"], all_laws, matrix, identity, components)
    elif design == STRATIFIED:
        _check_keeps_rows(head, path)
        stops = _stratified(all_laws, matrix, components, head, rarest, path)
        in_strata = stops.strata
        columns = _columns(all_laws, stops.shares)
        for place, failure in enumerate(components):
            columns.append([failures_of.shown(failed[place], failure) for failed in stops.failed])
        rows = tuple(zip(*columns, strict=True))
    else:
        number = drawn_rows.components(components)
        cube = _unit_cube(head, len(axes) + number, path)
        columns = _columns(all_laws, laws.correlated(cube[:, : len(axes)], matrix))
        columns += drawn_rows.failure_columns(cube[:, len(axes) :], components)
        rows = tuple(zip(*columns, strict=True))
    ranges = []
    ends = extremes(rows, axes)
    for place, law in enumerate(all_laws):
        low_run, high_run = ends[law.name]
        low, high = rows[low_run][place], rows[high_run][place]
        if law.name in vary:
            low, high = vary[law.name]["low"], vary[law.name]["high"]
        is_log = law.name in vary and bool(vary[law.name].get("log"))
        ranges.append({"low": low, "high": high, "log": is_log, "law": law.text})
    return Points(
        (*axes, *(failure.column for failure in components)),
        rows,
        tuple(sources),
        tuple(ranges),
        in_strata,
        applied,
    )


def _columns(all_laws: Sequence[laws.Law], shares: np.ndarray) -> list[list[Any]]:
    """Return the values of each law at its shares (runs, laws)."""
    return [law.at(shares[:, place]).tolist() for place, law in enumerate(all_laws)]


# --- inputs of single units, and failures ---


def _check_shared(key: str, given: Any, path: Path) -> None:
    """Raise ConfigError for a correlation of units in an input that the whole train shares."""
    further = [name for name in laws.UNIT_KEYS if isinstance(given, dict) and name in given]
    if further:
        raise ConfigError(
            f"{path} [inputs] {key}: {further[0]} is for inputs of single units; add per = "
            f'"{trains.DISC}", or another unit, or remove it'
        )


def _check_same_vehicle(keys: Sequence[str], path: Path) -> None:
    """Raise ConfigError if a plan with components varies how many of them there are."""
    for key in keys:
        if key in _OF_VEHICLE:
            raise ConfigError(
                f"{path}: {key} varies, and [failures] and inputs with per need one vehicle; make a "
                "plan for each"
            )


def _unit_input(
    key: str, given: Mapping[str, Any], train: trains.Train, base: Mapping[str, Any], path: Path
) -> applied_of.UnitInput:
    """Return an input that each unit has for itself."""
    at = f"{path} [inputs] {key}"
    section, _, name = key.partition(".")
    if section != "brake" or name not in _OF_UNITS:
        allowed = ", ".join(f"brake.{known}" for known in _OF_UNITS)
        raise ConfigError(
            f"{at}: per: allowed for the factors of the brake torque: {allowed}; remove per, or vary "
            "one of these"
        )
    kinds = trains.UNITS[:-1]
    per = table.check(table.choice(laws.PER, "", kinds, ""), given[laws.PER], at)
    return applied_of.UnitInput(key, base["brake"][name], train.units(per))


def _unit_law(
    key: str,
    given: Mapping[str, Any],
    unit_input: applied_of.UnitInput,
    train: trains.Train,
    path: Path,
) -> tuple[laws.Law, np.ndarray, str]:
    """Return the law of a unit, the correlations of all units, and both in words."""
    at = f"{path} [inputs] {key}"
    law = laws.read(key, given, at)
    in_car, between_cars = (
        table.check(row, given.get(row.name, row.default), at)
        for row in (laws.IN_CAR, laws.BETWEEN_CARS)
    )
    if between_cars > in_car:
        raise ConfigError(
            f"{at}: correlation_between_cars = {between_cars:g} is above correlation_in_car = "
            f"{in_car:g}; units of one car are at least as alike as those of two"
        )
    cars = train.units(trains.CAR)
    car_of_disc = {disc: number for number, car in enumerate(cars) for disc in car}
    matrix = laws.of_units(
        [car_of_disc[unit[0]] for unit in unit_input.units], in_car, between_cars
    )
    text = (
        f"for each of {len(unit_input.units)} x {given[laws.PER]}; rank correlation {in_car:g} in a "
        f"car, {between_cars:g} between cars"
    )
    return law, matrix, text


def _block(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return a matrix of two independent blocks."""
    size = len(first) + len(second)
    found = np.zeros((size, size))
    found[: len(first), : len(first)] = first
    found[len(first) :, len(first) :] = second
    return found


def _check_keeps_rows(head: Mapping[str, Any], path: Path) -> None:
    """Raise ConfigError for a stratified design of more runs than those that keep their rows."""
    if head["runs"] > head["rows_up_to"]:
        raise ConfigError(
            f"{path}: runs = {head['runs']}: a {STRATIFIED} design keeps the row of each run; allowed "
            f"are up to rows_up_to = {head['rows_up_to']}"
        )


def _stratified(
    all_laws: Sequence[laws.Law],
    matrix: np.ndarray,
    components: Sequence[failures_of.Failure],
    head: Mapping[str, Any],
    rarest: float,
    path: Path,
) -> stratified.Stops:
    """Return the stops of a stratified design."""
    try:
        return stratified.draw(
            all_laws,
            matrix,
            kinds=[failure.kind for failure in components],
            names=[failure.name for failure in components],
            runs=head["runs"],
            seed=head["seed"],
            rarest=rarest,
        )
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def is_large(head: Mapping[str, Any]) -> bool:
    """Return whether a plan keeps no rows of all runs; `head` are the values at its top."""
    return bool(head["design"] == INDEPENDENT and head["runs"] > head["rows_up_to"])


def identity(rows: Sequence[tuple[Any, ...]]) -> Any:
    """Return what decides the values of all runs, for the fingerprint of a plan."""
    return rows.identity if isinstance(rows, DrawnRows) else rows


def _range(key: str, span: Any, design: str, path: Path) -> laws.Law:
    """Return the law of a range of [vary]."""
    where = f"{path} [vary] {key}"
    if not isinstance(span, dict):
        raise ConfigError(
            f"{where} = {span!r}: a {design} design needs a range "
            '{ low = ..., high = ... }; for a list set design = "matrix"'
        )
    checked = table.read(RANGE, span, where)
    low, high = checked["low"], checked["high"]
    if not low < high or (checked["log"] and low <= 0.0):
        raise ConfigError(
            f"{where}: low = {low:g} and high = {high:g} must rise, and be above 0 if log = true"
        )
    if checked["log"]:
        text = "evenly in the logarithm"
        return laws.Law(key, stats.loguniform(low, high), 0.0, 1.0, text, _RANGE_SOURCE)
    text = "evenly"
    return laws.Law(key, stats.uniform(low, high - low), 0.0, 1.0, text, _RANGE_SOURCE)


def _unit_cube(head: Mapping[str, Any], dimensions: int, path: Path) -> np.ndarray:
    """Return the sample of a design between 0 and 1, shape (runs, dimensions)."""
    design = head["design"]
    runs = head["runs"]
    seed = head["seed"]
    if design == INDEPENDENT:
        return np.random.default_rng(seed).random((runs, dimensions))
    if design == SALTELLI:
        size = drivers.block_size(dimensions)
        least = drivers.FEWEST_BLOCKS * size
        if runs < least:
            raise ConfigError(
                f"{path}: runs = {runs}: a {SALTELLI} design of {dimensions} inputs has blocks of "
                f"{size} runs, and indices need {drivers.FEWEST_BLOCKS} blocks; set runs = {least} "
                "or more"
            )
        return drivers.blocks(runs // size, dimensions, seed)
    if design == "sobol":
        # a Sobol sequence is balanced only in powers of two; take the first points of enough
        exponent = max(runs - 1, 1).bit_length()
        return np.asarray(qmc.Sobol(dimensions, rng=seed).random_base2(exponent)[:runs])
    kind = qmc.Halton if design == "halton" else qmc.LatinHypercube
    return np.asarray(kind(dimensions, rng=seed).random(runs))


def extremes(rows: Sequence[tuple[Any, ...]], axes: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Return, for each numeric input, the runs with its least and its greatest value."""
    if isinstance(rows, DrawnRows):
        # the columns of failures have no numbers
        return dict(zip(axes, rows.extremes, strict=False))
    found = {}
    for place, axis in enumerate(axes):
        column = [row[place] for row in rows]
        if all(isinstance(value, int | float) for value in column):
            found[axis] = (int(np.argmin(column)), int(np.argmax(column)))
    return found
