"""A sequence: a scripted test as TOML, read and checked before anything moves.

    title = "A full service stop from 120 km/h on soap"
    criteria = "service_stop"
    [start]                       # the bench that is wanted
    speed = "120 km/h"
    adhesion = "soap"
    [[step]]
    title = "the driver brakes"
    at = "1 s"                    # begins then; else when the step before is done
    set = { brake_demand = "3.8 bar" }
    until = "vehicle_speed < 0.1 km/h"
    timeout = "120 s"

A step sets at its beginning (`set`, `ramp`, `friction`, `fault`, `lift`, `note`), lasts `for` a time
or `until` a condition has held for `hold`, and may `expect` conditions at its end. Contradictions,
unknown signals, wrong units and faults are refused with file and line.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import known, nearest
from rollerrig.wsp_interface.sequences import conditions, verdict
from rollerrig.wsp_interface.sequences.conditions import Condition
from rollerrig.wsp_interface.signals import AXLES

Where = Callable[[str], str]  # the place of a key, for messages

DEFAULT_TIMEOUT_S = 300.0
# a cylinder pressure asked for is a 16-bit count of mbar, bounded by node 17
HIGHEST_DEMAND_Pa = 1e6
_SETTABLE = ("brake_demand", "sand")
HEAD = (
    "title",
    "criteria",
    "scenario",
    "notes",
    "start",
    "friction",
    "before",
    "after",
    "step",
    "measure",
    "wsp",
)
START = ("speed", "adhesion", "mass", "gradient", "tables")
STEP = (
    "title",
    "at",
    "for",
    "until",
    "hold",
    "timeout",
    "set",
    "ramp",
    "friction",
    "fault",
    "lift",
    "note",
    "expect",
)


@dataclass(frozen=True)
class Ramp:
    """Brake demand that moves evenly to a pressure within a time."""

    to_Pa: float
    in_s: float


@dataclass(frozen=True)
class Patch:
    """Friction under axles, 0 to give it back to the scenario."""

    mu: float
    axles: tuple[int, ...]


@dataclass(frozen=True)
class Step:
    """One step; times in s. `at_s` None: at once, `for_s` None: until (or no longer than now)."""

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
    """A checked sequence. `tables` are what the scenario is changed by."""

    name: str
    path: Path
    title: str
    scenario: str
    wsp: str
    speed_m_s: float | None
    adhesion: str
    tables: dict[str, Any]
    notes: tuple[str, ...]
    before: tuple[Condition, ...]
    after: tuple[Condition, ...]
    steps: tuple[Step, ...]
    criteria: verdict.Profile


class _Source:
    """Where things stand in a file, so that a message can name the line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines = path.read_text(encoding="utf-8").splitlines()

    def line(self, table: str = "", number: int = 0, key: str = "") -> int:
        """The line of a key, of the table `[table]` or its number-th `[[table]]`, from 1."""
        at, end = 0, len(self.lines)
        heads = [i for i, one in enumerate(self.lines) if re.match(r"\s*\[", one)]
        if table:
            wanted = re.compile(rf"\s*\[\[?\s*{re.escape(table)}\s*\]")
            own = [i for i in heads if wanted.match(self.lines[i])]
            at = own[min(number, len(own) - 1)] if own else 0
            end = next((i for i in heads if i > at), len(self.lines))
        elif heads:
            end = heads[0]
        pattern = re.compile(rf"\s*\"?{re.escape(key)}\"?\s*[=.]") if key else re.compile("")
        return next((i for i in range(at, end) if pattern.match(self.lines[i])), at) + 1

    def where(self, table: str = "", number: int = 0, key: str = "") -> str:
        """File and line, and what stands there."""
        what = f" [{table}]" if table else ""
        return f"{self.path}, line {self.line(table, number, key)}{what}" + (
            f": {key}" if key else ""
        )


def load(name: str | Path, check_fault: Callable[[str], Any] = lambda text: None) -> Sequence:
    """A sequence by name or path. `check_fault(text)` raises ConfigError for one that is none."""
    path = name if isinstance(name, Path) else store.find("sequences", name)
    given = store.parse(path)
    source = _Source(path)
    head, at_start = partial(source.where, "", 0), partial(source.where, "start", 0)
    known(given, HEAD, head)
    title, start = given.get("title"), given.get("start", {})
    if not isinstance(title, str) or len(title.split()) < 3:
        raise ConfigError(
            f"{head('title')} = {title!r}: the title is a sentence that says what is tested"
        )
    known(start, START, at_start)

    def started(key: str, unit: str) -> float | None:
        return conditions.quantity(start[key], unit, at_start(key)) if key in start else None

    speed_m_s, mass_kg, gradient = (
        started("speed", "m_s"),
        started("mass", "kg"),
        started("gradient", ""),
    )
    tables = dict(start.get("tables", {}))
    if mass_kg is not None:
        tables["vehicle"] = {**tables.get("vehicle", {}), "mass_kg": mass_kg}
    if gradient is not None:
        # uphill is positive; the plant has it as one of its mechanisms
        tables["mechanisms"] = {**tables.get("mechanisms", {}), "track_gradient_gradient": gradient}
    level = tables.get("mechanisms", {}).get("track_gradient_gradient", 0.0) >= 0.0
    if "friction" in given:
        tables["friction"] = given["friction"]
    steps = tuple(_steps(given.get("step", []), source, speed_m_s if level else None, check_fault))
    if not steps:
        raise ConfigError(f"{path}: there is no [[step]]; a sequence has at least one")
    limits = verdict.limits(given.get("measure", []), partial(source.where, "measure"))
    return Sequence(
        name=path.stem,
        path=path,
        title=title,
        scenario=str(given.get("scenario", "")),
        wsp=str(given.get("wsp", "reference")),
        speed_m_s=speed_m_s,
        adhesion=str(start.get("adhesion", "")),
        tables=tables,
        notes=_texts(given, "notes", head),
        before=_conditions(given, "before", head),
        after=_conditions(given, "after", head),
        steps=steps,
        criteria=verdict.load(str(given.get("criteria", "none")), path).with_limits(limits),
    )


def _steps(
    given: Any, source: _Source, speed_m_s: float | None, check_fault: Callable[[str], Any]
) -> Iterable[Step]:
    if not isinstance(given, list):
        raise ConfigError(f"{source.where('step')}: write [[step]] with two brackets")
    passed_s = 0.0
    for number, content in enumerate(given):
        at = partial(source.where, "step", number)
        known(content, STEP, at)
        step = _step(content, at, source.line("step", number))
        for text in step.faults:
            try:
                check_fault(text)
            except ConfigError as error:
                raise ConfigError(f"{at('fault')}: {error}") from None
        _contradictions(step, content, at, passed_s, speed_m_s)
        if step.at_s is not None:
            passed_s = max(passed_s, step.at_s)
        passed_s += max(step.for_s or 0.0, step.ramp.in_s if step.ramp else 0.0, step.hold_s)
        yield step


def _step(content: Mapping[str, Any], at: Where, line: int) -> Step:
    def seconds(key: str, default: Any = None) -> Any:
        return conditions.quantity(content[key], "s", at(key)) if key in content else default

    wanted = content.get("set", {})
    if not isinstance(wanted, dict):
        raise ConfigError(f"{at('set')} = {wanted!r}: a table is wanted")
    for name in wanted:
        if name not in _SETTABLE:
            raise ConfigError(
                f"{at('set')}: '{name}' cannot be set{nearest(name, _SETTABLE)};"
                " speed, mass and adhesion stand in [start], friction has a key of its own"
            )
    return Step(
        title=str(content.get("title", "")),
        line=line,
        at_s=seconds("at"),
        for_s=seconds("for"),
        until=conditions.condition(content["until"], at("until")) if "until" in content else None,
        hold_s=seconds("hold", 0.0),
        timeout_s=seconds("timeout", DEFAULT_TIMEOUT_S),
        brake_Pa=_pressure(wanted["brake_demand"], at("set")) if "brake_demand" in wanted else None,
        sand=_switch(wanted["sand"], at("set")) if "sand" in wanted else None,
        ramp=_ramp(content.get("ramp"), at("ramp")),
        friction=_patch(content.get("friction"), at("friction")),
        faults=_texts(content, "fault", at),
        lifts=_texts(content, "lift", at),
        notes=_texts(content, "note", at),
        expects=_conditions(content, "expect", at),
    )


def _contradictions(
    step: Step, content: Mapping[str, Any], at: Where, passed_s: float, speed_m_s: float | None
) -> None:
    until, begins_s = step.until, max(passed_s, step.at_s or 0.0)
    columns, compare, bound = (
        (until.columns, until.compare, until.bound) if until else ((), "", 0.0)
    )
    never = f" = '{until.text if until else ''}': can never be"
    for key, refused, why in (
        (
            "for",
            step.for_s is not None and until,
            ": a step lasts either `for` a time or `until` a condition; "
            "keep one, and give `timeout` for the longest wait",
        ),
        ("hold", "hold" in content and not until, ": belongs to `until`, which this step has not"),
        (
            "timeout",
            "timeout" in content and not until,
            ": belongs to `until`, which this step has not",
        ),
        (
            "hold",
            until and step.hold_s >= step.timeout_s,
            f" = {step.hold_s:g} s can never be within timeout = {step.timeout_s:g} s",
        ),
        (
            "at",
            step.at_s is not None and step.at_s < passed_s - 1e-9,
            f" = {step.at_s or 0.0:g} s is over before the "
            f"step can begin: the steps before it take at least {passed_s:g} s",
        ),
        (
            "ramp",
            step.brake_Pa is not None and step.ramp,
            ": the step also sets brake_demand; keep one",
        ),
        (
            "until",
            columns == ("time_s",) and compare in ("<", "<=") and bound <= begins_s,
            f"{never}, {begins_s:g} s have passed by then",
        ),
        (
            "until",
            columns == ("vehicle_speed_m_s",)
            and compare in (">", ">=")
            and speed_m_s is not None
            and bound > speed_m_s,
            f"{never}: the vehicle begins at {speed_m_s or 0.0:.4g} m/s and nothing drives it",
        ),
    ):
        if refused:
            raise ConfigError(at(key) + why)


def _switch(given: Any, where: str) -> bool:
    if not isinstance(given, bool):
        raise ConfigError(f"{where}: sand = {given!r}: write true or false")
    return given


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


def _patch(content: Any, where: str) -> Patch | None:
    if content is None:
        return None
    if not isinstance(content, dict) or not {"mu"} <= set(content) <= {"mu", "axles"}:
        raise ConfigError(
            f"{where} = {content!r}: write friction = {{ mu = 0.05, axles = [1, 2] }}"
        )
    mu, axles = content["mu"], content.get("axles", list(range(1, AXLES + 1)))
    if not isinstance(mu, int | float) or not (mu == 0 or 0.0005 <= mu <= 1.0):
        raise ConfigError(
            f"{where}: mu = {mu!r}: from 0.0005 to 1, or 0 for what the scenario says"
        )
    if not axles or not all(type(one) is int and 1 <= one <= AXLES for one in axles):
        raise ConfigError(f"{where}: axles = {axles!r}: a list of axle numbers from 1 to {AXLES}")
    return Patch(float(mu), tuple(axles))


def _texts(content: Mapping[str, Any], key: str, at: Where) -> tuple[str, ...]:
    given = content.get(key, [])
    texts = [given] if isinstance(given, str) else given
    if not isinstance(texts, list) or not all(isinstance(one, str) for one in texts):
        raise ConfigError(f"{at(key)} = {given!r}: a text in quotes is wanted, or a list of texts")
    return tuple(texts)


def _conditions(content: Mapping[str, Any], key: str, at: Where) -> tuple[Condition, ...]:
    return tuple(conditions.condition(one, at(key)) for one in _texts(content, key, at))
