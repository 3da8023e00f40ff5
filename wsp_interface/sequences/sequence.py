"""A sequence: a scripted test as TOML, which is read and checked before anything moves.

    title = "A full service stop from 120 km/h on soap"
    criteria = "service_stop"
    [start]                       # the bench at the beginning
    speed = "120 km/h"
    adhesion = "soap"
    [[step]]
    title = "the driver brakes"
    at = "1 s"                    # the step begins then; else when the step before is done
    set = { brake_demand = "3.8 bar" }
    until = "vehicle_speed < 0.1 km/h"
    timeout = "120 s"

A step gives its commands at its beginning (`set`, `ramp`, `friction`, `fault`, `lift`, `note`). It
lasts `for` a time or `until` a condition has held for `hold`, and may `expect` conditions at its
end. Contradictions, unknown signals, wrong units and unknown faults are refused with file and line.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rollerrig.configs import store, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import known, nearest
from rollerrig.configs.vehicle import TRAIN, Kind
from rollerrig.wsp_interface import own_bench, signals, unit_choice
from rollerrig.wsp_interface.sequences import conditions, measures, train_script, verdict
from rollerrig.wsp_interface.sequences.conditions import Condition
from rollerrig.wsp_interface.signals import Table
from rollerrig.wsp_interface.unit_choice import AllowList

Where = Callable[[str], str]  # returns the place of a key, for messages
# raises ConfigError for a text that is no fault of a kind of vehicle
CheckFault = Callable[[str, Kind], Any]

DEFAULT_TIMEOUT_S = 300.0
# node 17 refuses a higher demand
HIGHEST_DEMAND_Pa = 1e6
TITLE_WORDS = 3  # a title is a sentence
# friction coefficients that can be commanded, besides 0
LEAST_MU = 0.0005
HIGHEST_MU = 1.0
_TINY_S = 1e-9
_SETTABLE = ("brake_demand", "sand")
# the keys of a sequence and of its tables, each with its value
HEAD = {
    "title": "text: a sentence that states what is tested, of at least three words",
    "criteria": 'name in configs/criteria, or a path; "none": only the limits of [[measure]] '
    "(default)",
    "scenario": "name in configs/scenarios or configs/trains, or a path: what the bench starts from "
    "(default: velim_a1)",
    "notes": "text or list of texts, written into the events of the run",
    "start": "table: speed, load, gradient and adhesion at the beginning",
    "friction": "tables: friction over time or place, as in a scenario",
    "before": "condition or list of conditions that must hold before the first step",
    "after": "condition or list of conditions that must hold after the last step",
    "step": "tables: the steps, in their order; at least one",
    "measure": "tables: limits of this sequence; each replaces that of the criteria for its "
    "measure",
    "wsp": 'the unit, as --wsp of `rollerrig run` (default: "reference")',
}
START = {
    "speed": "m/s or km/h: initial speed",
    "adhesion": "name in configs/adhesion",
    "mass": "kg or t: mass of the vehicle with its load",
    "gradient": "% or a number; positive uphill; the same for the whole run",
    "tables": "tables and keys of a scenario, for everything else",
}
STEP = {
    "title": "text, for the report and the events",
    "at": "s, ms or min after the beginning of the run: the step begins then; without it, when "
    "the step before is done",
    "for": "s, ms or min: how long the step lasts",
    "until": "condition: the step lasts until it holds; either `for` or `until`",
    "hold": "s: how long the condition of `until` must hold (default: 0)",
    "timeout": "s: longest wait for `until`; if it ends, the sequence fails (default: 300 s)",
    "set": "table: brake_demand, 0 to 10 bar; sand, true or false",
    "ramp": "table: brake_demand, and `in`, the time until it is reached",
    "friction": "table: mu, the kinematic friction of the contaminant (mu_cd), 0.0005 to 1, or 0 "
    "for that of the scenario; axles, a list (default: all)",
    "fault": "fault or list of faults that begin with the step, as in --fault; of a train with car=N",
    "lift": "name or list of names of faults that end",
    "note": "text or list of texts, written into the events",
    "expect": "condition or list of conditions that must hold at the end of the step",
}


@dataclass(frozen=True)
class Ramp:
    """A brake demand that changes linearly to a pressure within a time."""

    to_Pa: float
    in_s: float


@dataclass(frozen=True)
class Patch:
    """A friction coefficient under axles; 0 returns to that of the scenario."""

    mu: float
    axles: tuple[int, ...]


@dataclass(frozen=True)
class Step:
    """One step.

    line: of the step in its file.
    at_s: when it begins; None: when the step before is done.
    for_s: how long it lasts; None: until the condition, or no time without one.
    hold_s: how long the condition must hold.
    timeout_s: the longest wait for the condition.
    brake_Pa, sand, ramp, friction, faults, lifts, notes: commands at its beginning.
    expects: conditions at its end.
    """

    title: str
    line: int
    at_s: float | None = None
    for_s: float | None = None
    until: Condition | None = None
    hold_s: float = 0.0
    timeout_s: float = DEFAULT_TIMEOUT_S
    brake_Pa: float | None = None
    sand: bool | None = None
    ramp: Ramp | None = None
    friction: Patch | None = None
    faults: tuple[str, ...] = ()
    lifts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    expects: tuple[Condition, ...] = ()


@dataclass(frozen=True)
class Sequence:
    """A checked sequence.

    name: the file's name without suffix.
    scenario: the scenario to start from; "" for the default.
    wsp: the unit, as the option of `rollerrig run`; started only if `allowed_unit` returns it.
    wsp_at: file and line of the unit, for messages.
    tables: changes of the scenario.
    kind: the kind of the vehicle, by scenario and tables; of a train that of the first car.
    is_train: whether the scenario is a train.
    notes: operator's notes for the events of the run.
    before, after: pre-conditions and post-conditions.
    criteria: the limits for its measures.
    repetition: how many times it was played before; its seed is higher by this.
    """

    name: str
    path: Path
    title: str
    scenario: str
    wsp: str
    wsp_at: str
    speed_m_s: float | None
    adhesion: str
    tables: dict[str, Any]
    kind: Kind
    notes: tuple[str, ...]
    before: tuple[Condition, ...]
    after: tuple[Condition, ...]
    steps: tuple[Step, ...]
    criteria: verdict.Profile
    repetition: int = 0
    is_train: bool = False

    def allowed_unit(self, allowed: AllowList) -> str:
        """Return the unit. Raises ConfigError if it is an FMU that is not in the list."""
        return allowed.check(self.wsp, self.wsp_at)


class _Source:
    """The lines of a file, so that a message can name the line of a key."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines = user_files.read_text(path, user_files.TOML).splitlines()

    def line(self, table: str = "", number: int = 0, key: str = "") -> int:
        """Return the line of a key, from 1: at the top, or in the number-th `[[table]]` (from 0).

        A key may also be a separate table, such as [start.tables] or a wrong [[steps]]. Without a
        key, or if there is no such key, this is the first line of the table.
        """
        begin, end = self._section(table, number)
        if not key:
            return begin + 1
        as_key = re.compile(rf"\s*\"?{re.escape(key)}\"?\s*[=.]")
        for index in range(begin, end):
            if as_key.match(self.lines[index]):
                return index + 1

        full_key = f"{table}.{key}" if table else key
        as_head = re.compile(rf"\s*\[\[?\s*{re.escape(full_key)}\s*[].]")
        for index in range(begin, self._end_of_subtables(table, begin)):
            if as_head.match(self.lines[index]):
                return index + 1
        return begin + 1

    def _end_of_subtables(self, table: str, begin: int) -> int:
        """Return the first line after a table that begins at a line, and after its sub-tables."""
        if table:
            same_head = re.compile(rf"\s*\[\[?\s*{re.escape(table)}\s*\]")
            for index in range(begin + 1, len(self.lines)):
                if same_head.match(self.lines[index]):
                    return index
        return len(self.lines)

    def _section(self, table: str, number: int) -> tuple[int, int]:
        """Return the first line of a table, and the first line after it."""
        heads = [index for index, line in enumerate(self.lines) if re.match(r"\s*\[", line)]
        if not table:
            return 0, heads[0] if heads else len(self.lines)
        wanted = re.compile(rf"\s*\[\[?\s*{re.escape(table)}\s*\]")
        matching = [index for index in heads if wanted.match(self.lines[index])]
        begin = matching[min(number, len(matching) - 1)] if matching else 0
        for index in heads:
            if index > begin:
                return begin, index
        return begin, len(self.lines)

    def where(self, table: str = "", number: int = 0, key: str = "") -> str:
        """Return file and line, with table and key, for a message."""
        text = f"{self.path}, line {self.line(table, number, key)}"
        if table:
            text += f" [{table}]"
        if key:
            text += f": {key}"
        return text


def load(name: str | Path, check_fault: CheckFault = lambda text, kind: None) -> Sequence:
    """Return a sequence by name or path. Raises ConfigError."""
    path = name if isinstance(name, Path) else store.find("sequences", name)
    content = store.parse(path)
    source = _Source(path)
    in_head = partial(source.where, "", 0)
    in_start = partial(source.where, "start", 0)
    known(content, HEAD, in_head)
    title = content.get("title")
    if not isinstance(title, str) or len(title.split()) < TITLE_WORDS:
        raise ConfigError(
            f"{in_head('title')} = {title!r}: the title is a sentence that states what is tested"
        )
    start = content.get("start", {})
    known(start, START, in_start)

    speed_m_s = _optional(start, "speed", "m_s", in_start)
    tables = _tables(content, in_start)
    scenario = _text(content, "scenario", "", in_head)
    is_train = TRAIN in own_bench.load(scenario)[0]
    try:
        kind = own_bench.kind_of_scenario(scenario, tables, "the scenario")
    except ConfigError as error:
        raise ConfigError(f"{path} [start]: {error}") from None
    vehicle = signals.table(kind)
    gradient = tables.get("mechanisms", {}).get("track_gradient_gradient", 0.0)
    is_downhill = gradient < 0.0
    steps = tuple(
        _steps(
            content.get("step", []),
            source,
            vehicle,
            # downhill a vehicle may become faster
            highest_speed_m_s=None if is_downhill else speed_m_s,
            # a fault of a train is checked with its cars
            check_fault=check_fault if not is_train else lambda text, kind: None,
        )
    )
    if not steps:
        place = in_head("step") if "step" in content else str(path)
        raise ConfigError(f"{place}: there is no [[step]]; a sequence has at least one")

    unit = _text(content, "wsp", "reference", in_head)
    try:
        unit_choice.check(unit)
    except ConfigError as error:
        raise ConfigError(f"{in_head('wsp')}: {error}") from None

    limits = verdict.limits(content.get("measure", []), partial(source.where, "measure"))
    profile = verdict.load(_text(content, "criteria", "none", in_head), path)
    before = _conditions(content, "before", in_head, vehicle)
    after = _conditions(content, "after", in_head, vehicle)
    criteria = profile.with_limits(limits)
    if is_train:
        train_script.check_start(start, in_start("mass"))
        train_script.check(steps, path)
        for condition in (*before, *after):
            train_script.check_condition(condition, str(path))
    measures.check_fit([limit.measure for limit in criteria.limits], is_train, str(path))
    return Sequence(
        name=path.stem,
        path=path,
        title=title,
        scenario=scenario,
        wsp=unit,
        wsp_at=in_head("wsp"),
        speed_m_s=speed_m_s,
        adhesion=_text(start, "adhesion", "", in_start),
        tables=tables,
        kind=kind,
        notes=_texts(content, "notes", in_head),
        before=before,
        after=after,
        steps=steps,
        criteria=criteria,
        is_train=is_train,
    )


def _optional(table: Mapping[str, Any], key: str, unit: str, at: Where) -> float | None:
    """Return a quantity of a table in SI, None where there is none."""
    if key not in table:
        return None
    return conditions.quantity(table[key], unit, at(key))


def _table(value: Any, place: str) -> Mapping[str, Any]:
    """Return a value that must be a table. Raises ConfigError for any other value."""
    if not isinstance(value, Mapping):
        raise ConfigError(
            f"{place}: {value!r} is not a table; write, as in [start.tables.vehicle] with "
            "mass_kg = 40000 below it"
        )
    return value


def _tables(content: Mapping[str, Any], at: Where) -> dict[str, Any]:
    """Return the changes of the scenario."""
    start = content.get("start", {})
    tables = dict(_table(start.get("tables", {}), at("tables")))
    mass_kg = _optional(start, "mass", "kg", at)
    if mass_kg is not None:
        vehicle = _table(tables.get("vehicle", {}), at("tables"))
        tables["vehicle"] = {**vehicle, "mass_kg": mass_kg}
    gradient = _optional(start, "gradient", "", at)  # positive uphill
    if gradient is not None:
        # the plant has the gradient as one of its mechanisms
        mechanisms = _table(tables.get("mechanisms", {}), at("tables"))
        tables["mechanisms"] = {**mechanisms, "track_gradient_gradient": gradient}
    if "friction" in content:
        tables["friction"] = content["friction"]
    return tables


def _steps(
    tables: Any,
    source: _Source,
    vehicle: Table,
    highest_speed_m_s: float | None,
    check_fault: CheckFault,
) -> Iterable[Step]:
    """Yield the checked steps. `highest_speed_m_s` is None if the vehicle may become faster."""
    if not isinstance(tables, list):
        raise ConfigError(f"{source.where('step')}: write [[step]] with two brackets")
    passed_s = 0.0  # the steps so far take at least this time
    for number, table in enumerate(tables):
        at = partial(source.where, "step", number)
        known(table, STEP, at)
        step = _step(table, at, source.line("step", number), vehicle)
        for text in step.faults:
            try:
                check_fault(text, vehicle.kind)
            except ConfigError as error:
                raise ConfigError(f"{at('fault')}: {error}") from None
        _check_durations(step, table, at, passed_s)
        if step.until:
            _check_until(step.until, step, at, passed_s, highest_speed_m_s)
        if step.at_s is not None:
            passed_s = max(passed_s, step.at_s)
        ramp_s = step.ramp.in_s if step.ramp else 0.0
        passed_s += max(step.for_s or 0.0, ramp_s, step.hold_s)
        yield step


def _step(table: Mapping[str, Any], at: Where, line: int, vehicle: Table) -> Step:
    commands = table.get("set", {})
    if not isinstance(commands, dict):
        raise ConfigError(f"{at('set')} = {commands!r}: allowed is a table")
    for name in commands:
        if name not in _SETTABLE:
            raise ConfigError(
                f"{at('set')}: '{name}' cannot be set{nearest(name, _SETTABLE)};"
                " speed, mass, gradient and adhesion belong to [start]: the speed follows from the run,"
                " mass and gradient stay constant; a step changes the friction with the key friction"
            )
    until = None
    if "until" in table:
        until = conditions.condition(table["until"], at("until"), vehicle)
    brake_Pa = None
    if "brake_demand" in commands:
        brake_Pa = _pressure(commands["brake_demand"], at("set"))
    sand = None
    if "sand" in commands:
        sand = _switch(commands["sand"], at("set"))
    timeout_s = _optional(table, "timeout", "s", at)
    return Step(
        title=str(table.get("title", "")),
        line=line,
        at_s=_optional(table, "at", "s", at),
        for_s=_optional(table, "for", "s", at),
        until=until,
        hold_s=_optional(table, "hold", "s", at) or 0.0,
        timeout_s=DEFAULT_TIMEOUT_S if timeout_s is None else timeout_s,
        brake_Pa=brake_Pa,
        sand=sand,
        ramp=_ramp(table.get("ramp"), at("ramp")),
        friction=_patch(table.get("friction"), at("friction"), vehicle.kind.axles),
        faults=_texts(table, "fault", at),
        lifts=_texts(table, "lift", at),
        notes=_texts(table, "note", at),
        expects=_conditions(table, "expect", at, vehicle),
    )


def _check_durations(step: Step, table: Mapping[str, Any], at: Where, passed_s: float) -> None:
    """Raise ConfigError if the times or commands of a step contradict one another."""
    if step.for_s is not None and step.until:
        raise ConfigError(
            f"{at('for')}: a step lasts either `for` a time or `until` a condition; "
            "keep one, and give `timeout` for the longest wait"
        )
    for key in ("hold", "timeout"):
        if key in table and not step.until:
            raise ConfigError(f"{at(key)}: belongs to `until`, which this step does not have")
    if step.until and step.hold_s >= step.timeout_s:
        raise ConfigError(
            f"{at('hold')} = {step.hold_s:g} s can never be within timeout = {step.timeout_s:g} s"
        )
    if step.at_s is not None and step.at_s < passed_s - _TINY_S:
        raise ConfigError(
            f"{at('at')} = {step.at_s:g} s is over before the step can begin: "
            f"the steps before it take at least {passed_s:g} s"
        )
    if step.brake_Pa is not None and step.ramp:
        raise ConfigError(f"{at('ramp')}: the step also sets brake_demand; keep one")


def _check_until(
    until: Condition, step: Step, at: Where, passed_s: float, highest_speed_m_s: float | None
) -> None:
    """Raise ConfigError if a condition can never come true."""
    never = f"{at('until')} = '{until.text}': can never be"
    begins_s = max(passed_s, step.at_s or 0.0)
    wants_less = until.compare in ("<", "<=")
    if until.columns == ("time_s",) and wants_less and until.bound <= begins_s:
        raise ConfigError(f"{never}, {begins_s:g} s have passed by then")
    wants_faster = until.columns == ("vehicle_speed_m_s",) and not wants_less
    if wants_faster and highest_speed_m_s is not None and until.bound > highest_speed_m_s:
        raise ConfigError(
            f"{never}: the vehicle begins at {highest_speed_m_s:.4g} m/s and nothing drives it"
        )


def _switch(value: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise ConfigError(f"{where}: sand = {value!r}: write true or false")
    return value


def _pressure(text: Any, where: str) -> float:
    pressure_Pa = conditions.quantity(text, "Pa", where)
    if not 0.0 <= pressure_Pa <= HIGHEST_DEMAND_Pa:
        raise ConfigError(
            f"{where} = '{text}': a brake demand is from 0 to {HIGHEST_DEMAND_Pa / 1e5:g} bar"
        )
    return pressure_Pa


def _ramp(content: Any, where: str) -> Ramp | None:
    if content is None:
        return None
    form = "write ramp = { brake_demand = '3.8 bar', in = '4 s' }"
    if not isinstance(content, dict) or set(content) != {"brake_demand", "in"}:
        raise ConfigError(f"{where} = {content!r}: {form}")
    in_s = conditions.quantity(content["in"], "s", where)
    if in_s <= 0.0:
        raise ConfigError(f"{where}: in = '{content['in']}': a ramp takes time; {form}")
    return Ramp(_pressure(content["brake_demand"], where), in_s)


def _patch(content: Any, where: str, most: int) -> Patch | None:
    """Return the friction of a step, under axles from 1 to `most`."""
    if content is None:
        return None
    if not isinstance(content, dict) or not {"mu"} <= set(content) <= {"mu", "axles"}:
        raise ConfigError(
            f"{where} = {content!r}: write friction = {{ mu = 0.05, axles = [1, 2] }}"
        )
    mu = content["mu"]
    axles = content.get("axles", list(range(1, most + 1)))
    if not isinstance(mu, int | float) or not (mu == 0 or LEAST_MU <= mu <= HIGHEST_MU):
        raise ConfigError(
            f"{where}: mu = {mu!r}: from {LEAST_MU:g} to {HIGHEST_MU:g}, "
            "or 0 for that of the scenario"
        )
    if not axles or not all(type(axle) is int and 1 <= axle <= most for axle in axles):
        raise ConfigError(f"{where}: axles = {axles!r}: a list of axle numbers from 1 to {most}")
    return Patch(float(mu), tuple(axles))


def _text(table: Mapping[str, Any], key: str, default: str, at: Where) -> str:
    value = table.get(key, default)
    if not isinstance(value, str):
        raise ConfigError(
            f"{at(key)} = {value!r}: allowed is a text in quotes; tables of a scenario are in "
            "[start.tables]"
        )
    return value


def _texts(table: Mapping[str, Any], key: str, at: Where) -> tuple[str, ...]:
    """Return the texts of a key: one text, or a list of texts."""
    value = table.get(key, [])
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
        raise ConfigError(f"{at(key)} = {value!r}: allowed is a text in quotes, or a list of texts")
    return tuple(texts)


def _conditions(
    table: Mapping[str, Any], key: str, at: Where, vehicle: Table
) -> tuple[Condition, ...]:
    texts = _texts(table, key, at)
    return tuple(conditions.condition(text, at(key), vehicle) for text in texts)
