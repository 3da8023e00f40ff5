"""Many runs from one plan: a matrix or a random design over any values of a scenario.

A plan is resolved into numbered runs, and these are cut into chunks. A chunk is one file of the
result. It is written whole when its runs are done. Therefore a campaign that was killed continues
where it stopped, and no finished run is computed again. The result does not depend on how the
chunks were spread: over the cores of this machine, or over a Dask cluster (`spreading`). A large
campaign keeps no rows of all runs (`large`).
"""

import bisect
import functools
import hashlib
import itertools
import json
import math
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from rollerrig.configs import store, table, unpacking, user_files
from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.output_files import make_folder, replaced, write_text, writing
from rollerrig.configs.table import choice, integer
from rollerrig.configs.vehicle import Kind, equipment_of
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign import (
    bench_runs,
    combined,
    design,
    speed_steps,
    spreading,
    train_stops,
)
from rollerrig.realtime.campaign.components import applied as applied_of
from rollerrig.realtime.campaign.statistics import strata as strata_of
from rollerrig.realtime.campaign.stops import stops_in_lanes, stops_on_device
from rollerrig.realtime.record import figures, played, summary
from rollerrig.realtime.train import plan as trains
from rollerrig.realtime.train import record as train_record
from rollerrig.realtime.train.plan import Train
from rollerrig.rig.compiled import device as gpu
from rollerrig.wsp_interface import unit_choice

# keys at the top of a plan
ROWS = (
    choice("title", "", (), "a sentence"),
    choice("scenario", "velim_a1", (), "configs/scenarios, or configs/trains"),
    choice("unit", "reference", (), "reference, none, or package.module:function"),
    choice("design", design.MATRIX, design.DESIGNS, "how values are combined"),
    integer("runs", 64, 1, 1_000_000_000, "of a random design"),
    integer("seed", 0, 0, 2**31 - 1, "of a random design"),
    integer("chunk", 20, 1, 10_000, "runs that one worker does at a time"),
    table.number("step_s", 0.0, 0.0, 1e-2, "physics of most stops; 0: the step of the scenario"),
    integer("rows_up_to", 200_000, 0, 10_000_000, "runs of a random design that keep their rows"),
)
# The share of the stops with the longest distances that run again at the step of the scenario, if
# the others have a longer one: of all stops, or of each chunk of a large campaign.
AGAIN = 0.01
# columns of the step of a row, and of the share by which the longer step has missed the distance
STEP = "step_s"
MISSED = "long_step_missed"
# columns of the number of the stratum of a row, and of the weight of the row among all stops
STRATUM = "stratum"
WEIGHT = "weight"
# runs in a chunk of a large campaign, if the plan states no other
_LARGE_CHUNK = 200
# what computes the stops
CORES, CUDA = DEVICES = ("cores", "cuda")
# runs in a chunk of a campaign on a GPU, if the plan states no other: threads that run together
_GPU_CHUNK = 2000
# units that a campaign knows without importing a module
_NAMED_UNITS = ("reference", "none")
# package.module:function
_FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", re.ASCII)
_UNIT_IS = (
    "write package.module:function of an installed package, where the function returns a unit: "
    "a call from 8 integers to a byte"
)
# the option of the command line without which a plan runs no code
ALLOW_CODE = "--allow-code"

_DISTANCE = "braking_distance_m"
# files of a result: of a chunk, and of stops that have run again
_PART = "part"
_AGAIN = "again"

AnyScenario = scenario.Scenario | Train
Row = dict[str, Any]  # one run of the result, by the names of its columns


class Plan(NamedTuple):
    """A campaign: `axes` are the names of the varied values, `points` has a row of them per run."""

    head: dict[str, Any]  # by the names of ROWS
    axes: tuple[str, ...]
    points: Sequence[tuple[Any, ...]]
    first: int = 0  # number of the first run in `points`
    # of a random design, for each axis: the range, see `design.Points`
    ranges: tuple[dict[str, Any], ...] = ()
    # (input, law, source) of each input that is drawn from a law
    sources: tuple[tuple[str, str, str], ...] = ()
    # the rows have the deceleration of each of these steps; None: they have none
    steps: speed_steps.Steps | None = None
    # of a stratified design; the runs are in the order of the strata
    strata: tuple[strata_of.Stratum, ...] = ()
    # what inputs of single units and failures do to a run
    applied: applied_of.Applied | None = None
    device: str = CORES  # what computes the stops, of DEVICES
    # the combination of brakes: its name, and the equipment that it isolates
    combination: str = ""
    isolates: tuple[str, ...] = ()

    @property
    def isolating(self) -> tuple[str, ...]:
        """What isolates the equipment, in the form of `--set`."""
        return combined.isolating(self.isolates)

    def stratum_of(self, number: int) -> int:
        """Return the number of the stratum of a run of a stratified design."""
        ends = list(itertools.accumulate(found.runs for found in self.strata))
        return bisect.bisect_right(ends, number)

    @property
    def chunks(self) -> range:
        """The numbers of all chunks; the last chunk may be smaller."""
        size = self.head["chunk"]
        # rounded up
        return range(-(-len(self.points) // size))

    @property
    def is_large(self) -> bool:
        """Whether the rows of most runs are not kept."""
        return design.is_large(self.head)


# --- the plan ---

# the tables of a plan, next to the values at its top
TABLES = ("vary", "inputs", "correlation", "failures", "etcs", combined.TABLE)


def load(
    name: str,
    allow_code: bool = False,
    unit_command: str = "",
    combination: str = "",
    device: str = CORES,
    **heads: Any,
) -> Plan:
    """Return a plan by name or path; `heads` replace values at its top. Raises ConfigError.

    `combination` is one of the plan's [combinations]; without one all brakes act.

    A unit that is a Python function is refused without `allow_code`, because a plan is data, and
    data runs no code. `unit_command` is a command that starts a unit for each run, which the user
    has given; it replaces the unit of the plan. The first and the last run, and those with extreme
    values, are resolved, to find bad values early. A plan that does not run on the `device` is
    refused.
    """
    content, path = store.load("campaigns", name)
    content = content | heads
    table.known(content, [*(row.name for row in ROWS), *TABLES], lambda key: str(path))
    vary = content.pop("vary", {})
    inputs = content.pop("inputs", {})
    correlations = content.pop("correlation", [])
    failures = content.pop("failures", None)
    steps_table = content.pop("etcs", None)
    isolates = combined.read(name)[combination] if combination else ()
    content.pop(combined.TABLE, None)
    head = table.read(ROWS, content, str(path))
    if "chunk" not in content and design.is_large(head):
        head["chunk"] = _LARGE_CHUNK
    if "chunk" not in content and device == CUDA:
        head["chunk"] = _GPU_CHUNK
    # the path of a scenario is relative to the plan, but workers may run elsewhere
    if head["scenario"].endswith(".toml"):
        head["scenario"] = str(store.find("scenarios", head["scenario"], path).resolve())

    base: Mapping[str, Any] | None = None
    coupled = None
    if design.needs_vehicle(inputs, failures):
        found = _scenario(head["scenario"], combined.isolating(isolates))
        base = found.resolved
        if isinstance(found, Train):
            coupled, base = train_stops.places(found, str(path))
    drawn = design.points(vary, inputs, correlations, head, path, failures, base, coupled)
    steps = None
    if steps_table is not None:
        steps = speed_steps.read(steps_table, f"{path} [etcs]")
        if combination and steps.nominal_m_s2:
            raise ConfigError(
                f"{path} [etcs] nominal_m_s2: each combination has its own nominal deceleration; remove "
                "it, and a run without variation gives it"
            )
    plan = Plan(
        head,
        drawn.axes,
        drawn.rows,
        ranges=drawn.ranges,
        sources=drawn.sources,
        steps=steps,
        strata=drawn.strata,
        applied=drawn.applied,
        combination=combination,
        isolates=isolates,
        device=device,
    )
    _check_equipment(plan, path)
    if unit_command:
        head["unit"] = unit_choice.check(f"{unit_choice.COMMAND}{unit_command}")
    else:
        _check_unit(head["unit"], path, allow_code)
        _unit(head["unit"])
    _check_train(plan, path)
    _check_failures(plan, path)
    _check_values(plan, path)
    _check_step(plan, path)
    _check_device(plan, path)
    return plan


def _check_equipment(plan: Plan, path: Path) -> None:
    """Raise ConfigError if the vehicle does not have the equipment that a combination isolates."""
    if not plan.isolates:
        return
    found = _scenario(plan.head["scenario"], ())
    has = equipment_of((found.cars[0].plan if isinstance(found, Train) else found).resolved)
    for name in plan.isolates:
        if name not in has:
            raise ConfigError(
                f"{path} [combinations.{plan.combination}]: {plan.head['scenario']} has no {name} that "
                "acts; remove it from isolates, or choose a scenario with it"
            )


def _check_train(plan: Plan, path: Path) -> None:
    """Raise ConfigError for what a campaign with a train does not have."""
    if not train_stops.is_train(plan.head["scenario"]):
        return
    unit = plan.head["unit"]
    is_program = bool(unit_choice.command_of(unit))
    for refused, what, remedy in (
        (plan.device == CUDA, "--device cuda", "leave --device out: a train runs on cores"),
        (plan.head[STEP] != 0.0, f"step_s = {plan.head[STEP]:g}", "set step_s = 0"),
        (
            unit not in _NAMED_UNITS and not is_program,
            f'unit = "{unit}"',
            "allowed are reference, none, and a program with --unit, which is on car 1",
        ),
        (
            is_program and plan.steps is not None,
            "--unit with [etcs]",
            "leave --unit out, or remove [etcs]",
        ),
    ):
        if refused:
            raise ConfigError(
                f"{path}: {what}: {plan.head['scenario']} is a train, whose campaigns do not have this "
                f"yet; {remedy}"
            )


def _check_failures(plan: Plan, path: Path) -> None:
    """Raise ConfigError unless the scenario allows each component to fail."""
    if plan.applied is None:
        return
    values = dict(zip(plan.axes, plan.points[0], strict=True))
    values |= {failure.column: "" for failure in plan.applied.failures}
    for failure in plan.applied.failures:
        for unit in failure.effects:
            try:
                settings, faults = plan.applied.changes(values | {failure.column: str(unit)})
                _load(plan, (*plan.isolating, *settings), faults)
            except ConfigError as error:
                raise ConfigError(f"{path} [failures] {failure.name}: {error}") from None


def _check_device(plan: Plan, path: Path) -> None:
    """Raise ConfigError if a plan for a GPU has a unit or a scenario that does not run there.

    The scenarios are those of the first and last run, of runs with extreme values, of the first run
    with each text, and of each component that can fail.
    """
    if plan.device == CORES:
        return
    gpu.check_installed()
    if plan.head["unit"] not in _NAMED_UNITS:
        raise ConfigError(
            f'{path}: unit = "{plan.head["unit"]}" does not run on a GPU; allowed there are '
            "reference and none, or leave --device out"
        )
    numbers = {0, len(plan.points) - 1, *_first_with_texts(plan)}
    for runs in design.extremes(plan.points, plan.axes).values():
        numbers |= set(runs)
    changed: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {}
    if plan.applied is not None:
        values = dict(zip(plan.axes, plan.points[0], strict=True))
        values |= {failure.column: "" for failure in plan.applied.failures}
        for failure in plan.applied.failures:
            failed = {failure.column: str(next(iter(failure.effects)))}
            changed[f"[failures] {failure.name}"] = plan.applied.changes(values | failed)
    changed |= {f"run {number}": changes(plan, number) for number in sorted(numbers)}
    for where, (settings, faults) in changed.items():
        try:
            resolved = _load(plan, settings, faults)
            # a train is refused on any GPU
            found = None if isinstance(resolved, Train) else stops_in_lanes.obstacle(resolved)
        except ConfigError:
            # the row of this run reports it
            continue
        if found is not None:
            raise ConfigError(
                f"{path}: {where} does not run on a GPU because of {found}, or leave --device out"
            )


def _check_step(plan: Plan, path: Path) -> None:
    """Raise ConfigError if the step of the plan does not divide the tick of the first run."""
    if _long_step_s(plan) is not None:
        try:
            _with_long_step(plan, plan.first)
        except ConfigError as error:
            raise ConfigError(
                f"{path}: step_s = {plan.head[STEP]:g}: {error}; or set step_s = 0 for the step of "
                "the scenario"
            ) from None


def _check_values(plan: Plan, path: Path) -> None:
    """Raise ConfigError unless the first and the last run, and extreme values, can be resolved."""
    drawn = [source[0] for source in plan.sources]
    for axis, runs in design.extremes(plan.points, drawn).items():
        for run in runs:
            try:
                resolve(plan, run)
            except ConfigError as error:
                raise ConfigError(
                    f"{path}: {axis}: run {run} draws a value that the scenario does not allow: "
                    f"{error}; limit it with low and high"
                ) from None
    resolve(plan, 0)
    resolve(plan, len(plan.points) - 1)


def _check_unit(name: str, path: Path, allow_code: bool) -> None:
    """Raise ConfigError unless a unit is one of the named ones, or code that the user allows."""
    if name in _NAMED_UNITS:
        return
    if name.startswith(unit_choice.COMMAND):
        raise ConfigError(
            f'{path}: unit = "{name}" is a program, and a plan starts no program; if you trust it, '
            f"give the command on the command line: --unit {shlex.quote(unit_choice.command_of(name))}"
        )
    if not _FUNCTION.fullmatch(name):
        raise ConfigError(
            f'{path}: unit = "{name}"; allowed are reference, none, and package.module:function'
        )
    if not allow_code:
        raise ConfigError(
            f'{path}: unit = "{name}" is code, and a plan runs no code; if you trust this plan and '
            f"this function, allow it on the command line with {ALLOW_CODE}"
        )


def _unit(name: str) -> str | free.UnitCall:
    """Return the unit of a plan that `load` has checked. Raises ConfigError if it has none."""
    if name in _NAMED_UNITS:
        return name
    module, _, function = name.partition(":")
    try:
        unit = getattr(import_module(module), function)()
    except Exception as error:  # of any kind: it is code of the user
        raise ConfigError(f'unit = "{name}": {error!r}; {_UNIT_IS}') from None
    if not callable(unit):
        raise ConfigError(f'unit = "{name}": the function returns {unit!r}; {_UNIT_IS}')
    return unit


def resolve(plan: Plan, number: int, files: scenario.Files = store.load) -> AnyScenario:
    """Return the scenario of run `number`, from `files`. Raises ConfigError."""
    return _load(plan, *changes(plan, number), files)


def _load(
    plan: Plan,
    settings: tuple[str, ...],
    faults: tuple[str, ...],
    files: scenario.Files = store.load,
) -> AnyScenario:
    """Return the scenario of a plan with some values and faults. Raises ConfigError."""
    resolved = _scenario(plan.head["scenario"], settings, faults, files)
    if isinstance(resolved, Train):
        return resolved
    for fault in resolved.faults:
        catalogue.check_equipped(fault, resolved.resolved, plan.head["scenario"])
    # a program of the user needs a bench with a bus, which refuses nothing that free pacing does
    if not unit_choice.command_of(plan.head["unit"]):
        free.check(resolved)
    return resolved


def _scenario(
    name: str,
    settings: tuple[str, ...],
    faults: tuple[str, ...] = (),
    files: scenario.Files = store.load,
) -> AnyScenario:
    """Return a scenario or a train, by name or path. Raises ConfigError."""
    if train_stops.is_train(name):
        return trains.load(name, settings=settings, faults=faults)
    return scenario.load(name, "", settings, faults=faults, files=files)


def _digest(found: AnyScenario) -> str:
    """Return a hash of everything that decides the result of a run."""
    return train_record.digest(found) if isinstance(found, Train) else scenario.digest(found)


def _long_step_s(plan: Plan) -> float | None:
    """Return the step of the plan if it is longer than that of its scenario; None if it is not.

    A plan that varies the step, or whose unit is code, has the step of the scenario.
    """
    step_s = float(plan.head[STEP])
    if step_s == 0.0 or plan.head["unit"] not in _NAMED_UNITS or "loop.step_s" in plan.axes:
        return None
    try:
        of_scenario_s = float(resolve(plan, plan.first)["loop"][STEP])
    except RollerrigError:
        # the row of this run reports it
        return None
    return step_s if step_s > of_scenario_s else None


def _with_long_step(plan: Plan, number: int, files: scenario.Files = store.load) -> AnyScenario:
    """Return the scenario of a run with the step of the plan, if it runs in lanes. Raises
    ConfigError.

    Stops that run alone keep the step of the scenario: longer ones are checked in lanes only.
    """
    settings, faults = changes(plan, number)
    longer = (*settings, f"loop.step_s={plan.head[STEP]!r}")
    found = _load(plan, longer, faults, files)
    fits = not isinstance(found, Train) and stops_in_lanes.fits(found)
    return found if fits else resolve(plan, number, files)


def changes(plan: Plan, number: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what run `number` changes: texts in the form of `--set`, and of `--fault`."""
    values = dict(zip(plan.axes, plan.points[number - plan.first], strict=True))
    if plan.applied is not None:
        settings, faults = plan.applied.changes(values)
        return (*plan.isolating, *settings), faults
    settings = tuple(f"{key}={json.dumps(value)}" for key, value in values.items())
    return (*plan.isolating, *settings), ()


def command(plan: Plan, number: int) -> str:
    """Return the command line that repeats a run and records it."""
    unit = plan.head["unit"]
    unit_command = unit_choice.command_of(unit)
    if unit_command:
        given = (plan.head["scenario"], unit_command, *changes(plan, number))
        return shlex.join(["rollerrig", "run", *bench_runs.words_of(*given)])
    pacing = "free"
    if unit not in _NAMED_UNITS:
        unit = "external"
        pacing = "lockstep"
    words = ["rollerrig", "run", plan.head["scenario"], "--pacing", pacing, "--wsp", unit]
    words += bench_runs.options_of(*changes(plan, number))
    # a user pastes it into a shell, so what is in the plan must not become another command
    return shlex.join(words)


# --- a chunk ---


def piece(plan: Plan, chunk: int) -> Plan:
    """Return the plan with the runs of one chunk only, which is all that a worker needs."""
    size = plan.head["chunk"]
    begin = chunk * size - plan.first
    return plan._replace(points=plan.points[begin : begin + size], first=chunk * size)


def run_chunk(plan: Plan, chunk: int) -> list[Row]:
    """Run one chunk; return one row per run.

    A run that fails has an error and no figures. A run that is not valid has its reasons and no
    figures. The longest stops of a chunk of a large campaign run again with the step of the
    scenario, if that of the plan is longer. Those of other campaigns do so after the last chunk,
    see `run_again`.
    """
    of_chunk = piece(plan, chunk)
    unit_command = unit_choice.command_of(plan.head["unit"])
    if unit_command:
        rows = _empty_rows(of_chunk)
        for number, row in rows.items():
            done = bench_runs.run(
                plan.head["scenario"],
                unit_command,
                *changes(plan, number),
                columns=speed_steps.CHANNELS if plan.steps is not None else (),
            )
            row["error"] = done.error
            if done.error is None:
                _fill(row, done.summary)
                if plan.steps is not None:
                    row |= speed_steps.figures(done.channels, plan.steps)
        return list(rows.values())

    rows = once(of_chunk)
    if plan.is_large and _long_step_s(of_chunk) is not None:
        for row in run_again([_alone(of_chunk, rows[number]) for number in longest(rows.values())]):
            rows[row["run"]] = row
    return list(rows.values())


def once(plan: Plan) -> dict[int, Row]:
    """Run all runs of a plan in this process, none of them again; return their rows by number."""
    rows = _empty_rows(plan)
    has_long_step = _long_step_s(plan) is not None
    resolved = _with_long_step if has_long_step else resolve
    files = functools.cache(store.load)
    _compute(plan, rows, lambda number: resolved(plan, number, files))
    return rows


def _empty_rows(plan: Plan) -> dict[int, Row]:
    """Return rows without results for all runs of a plan, by number."""
    numbered = enumerate(plan.points, start=plan.first)
    return {number: empty_row(plan, number, point) for number, point in numbered}


def _compute(plan: Plan, rows: dict[int, Row], resolved: Callable[[int], AnyScenario]) -> None:
    """Write the results of runs into their rows, by number; `resolved` gives their scenarios."""
    jobs: dict[Kind, list[tuple[int, scenario.Scenario]]] = {}
    of_trains: list[tuple[int, Train]] = []
    for number, row in rows.items():
        try:
            found = resolved(number)
            if isinstance(found, Train):
                of_trains.append((number, found))
            else:
                jobs.setdefault(found.kind, []).append((number, found))
        except RollerrigError as error:
            row["error"] = str(error)

    for done in train_stops.each(of_trains, plan.head["unit"]):
        row = rows[done.tag]
        _fill(row, done.summary)
        row[STEP] = done.summary["step_s"]
        if plan.steps is not None:
            row |= speed_steps.figures(done.channels, plan.steps)
    unit = _unit(plan.head["unit"])
    place = stops_on_device if plan.device == CUDA else stops_in_lanes
    for kind, of_kind in jobs.items():
        read = dict.fromkeys((*summary.channels_of(kind), *speed_steps.CHANNELS))
        for finished in place.together(of_kind, unit, list(read)):
            row = rows[finished.tag]
            _fill(row, summarize(finished, plan.head["unit"]))
            row[STEP] = finished.plan["loop"][STEP]
            if plan.steps is not None:
                row |= speed_steps.figures(finished.channels, plan.steps)


class Again(NamedTuple):
    """A stop that runs again: a plan of this run only, and its distance with the longer step.

    before_m: None if the vehicle did not stop within its time.
    """

    plan: Plan
    before_m: float | None


def _alone(plan: Plan, row: Row) -> Again:
    number = row["run"]
    begin = number - plan.first
    of_run = plan._replace(points=plan.points[begin : begin + 1], first=number)
    return Again(of_run, row[_DISTANCE])


def longest(rows: Iterable[Row]) -> list[int]:
    """Return the numbers of the longest stops, rising: the share AGAIN of the rows, at least one.

    A vehicle that did not stop within its time is longer than any other. Of equal distances the
    first runs are taken, so the result does not depend on who computed them.
    """
    count = 0
    distances_m = []
    for row in rows:
        count += 1
        if row["stopped"] is False:
            distances_m.append((-math.inf, row["run"]))
        elif row[_DISTANCE]:
            distances_m.append((-row[_DISTANCE], row["run"]))
    distances_m.sort()
    return sorted(number for _, number in distances_m[: math.ceil(AGAIN * count)])


def run_again(stops: Sequence[Again]) -> list[Row]:
    """Run stops with the step of the scenario; return their rows, with MISSED."""
    plans = {stop.plan.first: stop.plan for stop in stops}
    rows = {number: empty_row(plan, number, plan.points[0]) for number, plan in plans.items()}
    _compute(stops[0].plan, rows, lambda number: resolve(plans[number], number))
    for stop in stops:
        row = rows[stop.plan.first]
        if stop.before_m and row[_DISTANCE]:
            row[MISSED] = stop.before_m / row[_DISTANCE] - 1.0
    return list(rows.values())


def _fill(row: Row, found: Row) -> None:
    """Write the results of a run into its row, from its summary."""
    for figure in figures.FIGURES:
        row[figure.name] = figure.of(found)
    for key in ("stopped", "ended", "valid", "config_hash"):
        row[key] = found[key]
    for key in ("invalid_because", "warnings"):
        row[key] = "; ".join(found[key]) or None


def empty_row(plan: Plan, number: int, point: tuple[Any, ...]) -> Row:
    """Return the row of a run without results; the order of the keys is that of the columns."""
    row: Row = {"run": number}
    if plan.strata:
        stratum = plan.stratum_of(number)
        found = plan.strata[stratum]
        row |= {STRATUM: stratum, WEIGHT: found.probability / found.runs}
    results = (
        *("stopped", "ended", "valid", "invalid_because", "warnings"),
        *figures.BY_NAME,
        *("config_hash", "error", STEP, MISSED),
        *((*plan.steps.columns, speed_steps.BUILD_UP) if plan.steps else ()),
    )
    inputs = dict(zip(plan.axes, point, strict=True))
    return row | inputs | dict.fromkeys(results)


def summarize(finished: stops_in_lanes.Finished, unit: str) -> Row:
    """Return the summary of a run in memory; it equals that of a recorded run in free pacing."""
    plan = finished.plan
    time_s = finished.channels["time_s"]
    # a unit that fails at the first tick leaves no sample
    ticks = round(float(time_s[-1]) * plan["loop"]["tick_hz"]) if len(time_s) else 0
    counters = {
        "pacing": "free",
        "seed": 0,
        "unit": unit,
        "config_hash": scenario.digest(plan),
        "scenario": plan.name,
        "ended": finished.ended,
        "loop": {"ticks": ticks, "missed": 0},
    }
    return summary.of(finished.channels, counters, plan.resolved, finished.events)


# --- the result ---


def open_result(plan: Plan, out: Path) -> list[int]:
    """Create or open a result folder; return the chunks that are still missing.

    Raises ConfigError if the folder holds the results of another plan.
    """
    claim(plan, out)
    return [chunk for chunk in plan.chunks if not part(out, chunk).is_file()]


def claim(plan: Plan, out: Path) -> None:
    """Create a result folder for a plan, or check that it holds this plan. Raises ConfigError."""
    found = fingerprint(plan)
    mark = out / "plan.json"
    _check_same_step(plan, mark, out)
    if mark.exists() and _fingerprint(mark, out) != found:
        raise ConfigError(
            f"{out} holds the results of another plan, scenario, unit or version; give a new folder "
            "with --out, or remove it"
        )
    with writing(out):
        make_folder(out, "results")
        write_text(mark, json.dumps(_manifest(plan, found), indent=1))


def _manifest(plan: Plan, found: str) -> dict[str, Any]:
    """Return what plan.json has of a plan with this fingerprint."""
    return {
        "fingerprint": found,
        "head": plan.head,
        "unit_played": played.unit_of(plan.head["unit"])._asdict(),
        "version": played.version(),
        "axes": plan.axes,
        "device": plan.device,
        "runs": len(plan.points),
        "sources": plan.sources,
        "etcs": plan.steps._asdict() if plan.steps else None,
        "components": plan.applied.as_json() if plan.applied else None,
        "strata": [found._asdict() for found in plan.strata],
        "combination": {"name": plan.combination, combined.ISOLATES: plan.isolates},
    }


def write_deviation(plan: Plan, out: Path, ran_again: int, largest: float) -> None:
    """Add to plan.json how many stops ran again, and how far the longer step had been off.

    ran_again: number of stops; nothing is written if there are none.
    largest: largest relative deviation of their distances.
    """
    if ran_again:
        deviation = {"ran_again": ran_again, "largest_deviation": largest}
        content = _manifest(plan, fingerprint(plan)) | {"long_step": deviation}
        with writing(out):
            write_text(out / "plan.json", json.dumps(content, indent=1))


def _check_same_step(plan: Plan, mark: Path, out: Path) -> None:
    """Raise ConfigError if a folder has stops with another step than the plan."""
    content = user_files.read_json(mark, within=out) if mark.exists() else None
    head = content.get("head") if isinstance(content, dict) else None
    step_s = head.get(STEP, plan.head[STEP]) if isinstance(head, dict) else plan.head[STEP]
    if step_s != plan.head[STEP]:
        raise ConfigError(
            f"{out} holds stops with step_s = {step_s}, and this plan has step_s = "
            f"{plan.head[STEP]}; one result has one step: set step_s = {step_s} to continue, or "
            "give a new folder with --out"
        )


def fingerprint(plan: Plan) -> str:
    """Return a hash of all that decides the results of a plan, and their columns."""
    # an older version may have written other columns
    columns = list(empty_row(plan, plan.first, plan.points[0]))
    head = dict(plan.head)
    # how many rows are kept changes no row
    rows_up_to = head.pop("rows_up_to")
    # the scenarios, with the files that they name, and the parameters of the reference unit
    first = resolve(plan, plan.first)
    cars = [car.plan for car in first.cars] if isinstance(first, Train) else [first]
    units = [logic.load(one["wsp_config"]) for one in cars]
    unit = None
    if plan.head["unit"] == "reference":
        unit = units if isinstance(first, Train) else units[0]
    of_plan: list[Any] = [
        head,
        plan.axes,
        design.identity(plan.points),
        columns,
        [_digest(first), *_digests_of_names(plan)],
        unit,
    ]
    if plan.applied is not None:
        of_plan += [plan.applied.as_json(), plan.strata]
    if plan.steps is not None:
        of_plan.append(plan.steps)
    if plan.isolates:
        of_plan.append(plan.isolates)
    if plan.is_large:
        of_plan.append(rows_up_to)
    if plan.device != CORES:
        # the digits of a GPU are others
        of_plan.append(plan.device)
    identity = json.dumps(of_plan, sort_keys=True)
    return hashlib.sha256(identity.encode()).hexdigest()[:16]


def _digests_of_names(plan: Plan) -> list[str]:
    """Return a hash of the first run with each text among the varied values, which may name a file.

    A run whose scenario is refused has none; its row reports why.
    """
    found = []
    for number in _first_with_texts(plan):
        try:
            found.append(_digest(resolve(plan, number)))
        except ConfigError:
            continue
    return found


def _first_with_texts(plan: Plan) -> Iterator[int]:
    """Yield the numbers of runs that have a text among the varied values that no run before has.

    A large campaign varies no text.
    """
    if plan.is_large:
        return
    components = plan.applied.failures if plan.applied else ()
    columns = {failure.column for failure in components}
    seen: set[tuple[str, str]] = set()
    for number, point in enumerate(plan.points, start=plan.first):
        pairs = zip(plan.axes, point, strict=True)
        texts = {pair for pair in pairs if isinstance(pair[1], str) and pair[0] not in columns}
        if not texts <= seen:
            seen |= texts
            yield number


def _fingerprint(mark: Path, out: Path) -> Any:
    """Return the fingerprint of the plan whose results a folder holds. Raises ConfigError."""
    content = user_files.read_json(mark, within=out)
    if not isinstance(content, dict) or "fingerprint" not in content:
        raise ConfigError(f"{mark}: has no fingerprint of a plan; give a new folder with --out")
    return content["fingerprint"]


def again_count(plan: Plan) -> int:
    """Return how many stops of the whole campaign run again after its last chunk, at most."""
    if plan.is_large or _long_step_s(plan) is None:
        return 0
    return math.ceil(AGAIN * len(plan.points))


def open_again(plan: Plan, out: Path) -> dict[int, list[Again]]:
    """Return the stops that must still run again, by the number of their file.

    All chunks must be done. The longest stops are those of the whole campaign. They are found in
    the files of the chunks, which no later run changes: a campaign that is killed in between finds
    the same ones.
    """
    if not again_count(plan):
        return {}
    columns = ["run", "stopped", _DISTANCE]
    found = {row["run"]: row for row in _parts(out, _PART).select(columns).to_pylist()}
    numbers = longest(found.values())
    size = plan.head["chunk"]
    missing = {}
    for first in range(0, len(numbers), size):
        chunk = first // size
        if not part(out, chunk, _AGAIN).is_file():
            missing[chunk] = [_alone(plan, found[n]) for n in numbers[first : first + size]]
    return missing


def part(out: Path, chunk: int, kind: str = _PART) -> Path:
    """Return the path of the file of one chunk, or of some stops that have run again."""
    return out / "results" / f"{kind}-{chunk:06d}.parquet"


def write_chunk(out: Path, chunk: int, rows: list[Row], kind: str = _PART) -> None:
    """Write the rows of a chunk to its file, in one step. Raises RollerrigError if it cannot."""
    path = part(out, chunk, kind)
    try:
        with replaced(path) as new:
            pq.write_table(as_table(rows), new)
    except OSError as error:
        raise RollerrigError(
            f"{path}: cannot be written: {error}; finished chunks are kept: make room, and repeat "
            "the command to continue"
        ) from None


def as_table(rows: Sequence[Row]) -> pa.Table:
    """Return rows as a table; there must be at least one."""
    return pa.Table.from_pylist(rows, schema=_schema(rows[0]))


def _schema(row: Row) -> pa.Schema:
    """Return the types of all columns; a column may be empty in the rows of one chunk."""
    fixed = {
        "run": pa.int64(),
        STRATUM: pa.int64(),
        "stopped": pa.bool_(),
        "valid": pa.bool_(),
        "vents": pa.int64(),
        "ended": pa.string(),
        "invalid_because": pa.string(),
        "warnings": pa.string(),
        "config_hash": pa.string(),
        "error": pa.string(),
    }
    fields = []
    for key, value in row.items():
        # the other columns are figures, or inputs: numbers or words
        kind = pa.string() if isinstance(value, str) else pa.float64()
        fields.append((key, fixed.get(key, kind)))
    return pa.schema(fields)


def result(out: Path) -> pa.Table:
    """Return all rows of a result folder, sorted by run. Raises ConfigError if there are none.

    The row of a stop that has run again is that of the step of the scenario.
    """
    rows = _parts(out, _PART)
    again = _parts(out, _AGAIN) if part(out, 0, _AGAIN).is_file() else None
    if again is not None:
        has_run_again = pc.is_in(rows["run"], value_set=again["run"].combine_chunks())
        rows = pa.concat_tables([rows.filter(pc.invert(has_run_again)), again])
    return rows.sort_by("run")


def _parts(out: Path, kind: str) -> pa.Table:
    """Return the rows of all files of a kind. Raises ConfigError if there are none."""
    paths = sorted((out / "results").glob(f"{kind}-*.parquet"))
    if not paths:
        raise ConfigError(
            f"{out}: no results; run 'rollerrig campaign PLAN' with this folder as --out"
        )
    tables = []
    for path in paths:
        user_files.check(path, user_files.PARQUET, within=out)
        try:
            unpacking.check_parquet(path, pq.read_metadata(path))
            tables.append(pq.read_table(path))
        except (pa.ArrowException, ValueError, OSError) as error:
            raise ConfigError(
                f"{path}: cannot be read: {error}; remove it, and repeat the command to run it again"
            ) from None
    return pa.concat_tables(tables)


def work(plan: Plan) -> spreading.Work:
    """Return what does a chunk of a campaign and returns its rows, for `spreading`."""

    def call(chunk: int) -> tuple[Any, ...]:
        return run_chunk, piece(plan, chunk), chunk

    return call


def work_again(stops: dict[int, list[Again]]) -> spreading.Work:
    """Return what runs some stops again and returns their rows, for `spreading`."""

    def call(chunk: int) -> tuple[Any, ...]:
        return run_again, stops[chunk]

    return call


def write_again(out: Path, chunk: int, rows: list[Row]) -> None:
    """Write the rows of stops that have run again. Raises RollerrigError if it cannot."""
    write_chunk(out, chunk, rows, _AGAIN)
