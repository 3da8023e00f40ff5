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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.wsp_interface.sequences import conditions, verdict
from rollerrig.wsp_interface.sequences.conditions import Condition
from rollerrig.wsp_interface.signals import AXLES

DEFAULT_TIMEOUT_S = 300.0
# a cylinder pressure asked for is a 16-bit count of mbar, bounded by node 17
HIGHEST_DEMAND_Pa = 1e6
HEAD = ("title", "criteria", "scenario", "notes", "start", "friction", "before", "after", "step",
        "measure", "wsp")
START = ("speed", "adhesion", "mass", "gradient", "tables")
STEP = ("title", "at", "for", "until", "hold", "timeout", "set", "ramp", "friction", "fault", "lift",
        "note", "expect")


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
    faults: tuple[str, ...] = field(default=())


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
        return f"{self.path}, line {self.line(table, number, key)}{what}" + (f": {key}" if key else "")


def load(name: str | Path, check_fault: Callable[[str], Any] = lambda text: None) -> Sequence:
    """A sequence by name or path. `check_fault(text)` raises ConfigError for one that is none."""
    path = Path(name) if isinstance(name, Path) else store.find("sequences", str(name))
    given = store.parse(path)
    source = _Source(path)
    _keys(given, HEAD, source, "", 0)
    title = given.get("title")
    if not isinstance(title, str) or len(title.split()) < 3:
        raise ConfigError(f"{source.where(key='title')} = {title!r}: the title is a sentence that "
                          "says what is tested")
    start = _table(given.get("start", {}), source, "start")
    _keys(start, START, source, "start", 0)
    speed = start.get("speed")
    speed_m_s = (None if speed is None else
                 conditions.quantity(speed, "m_s", source.where("start", 0, "speed")))
    tables = dict(start.get("tables", {}))
    if "mass" in start:
        mass_kg = conditions.quantity(start["mass"], "kg", source.where("start", 0, "mass"))
        tables["vehicle"] = {**tables.get("vehicle", {}), "mass_kg": mass_kg}
    if "gradient" in start:
        # uphill is positive; the plant has it as one of its mechanisms
        gradient = conditions.quantity(start["gradient"], "", source.where("start", 0, "gradient"))
        tables["mechanisms"] = {**tables.get("mechanisms", {}), "track_gradient_gradient": gradient}
    level = tables.get("mechanisms", {}).get("track_gradient_gradient", 0.0) >= 0.0
    if "friction" in given:
        tables["friction"] = given["friction"]
    steps = tuple(_steps(given.get("step", []), source, speed_m_s if level else None, check_fault))
    if not steps:
        raise ConfigError(f"{path}: there is no [[step]]; a sequence has at least one")
    profile = verdict.load(str(given.get("criteria", "none")), path)
    limits = verdict.limits(given.get("measure", []),
                            lambda at, key: source.where("measure", at, key), "sequence")
    return Sequence(
        path.stem, path, title, str(given.get("scenario", "")), str(given.get("wsp", "reference")),
        speed_m_s, str(start.get("adhesion", "")), tables, _texts(given.get("notes", []), source.where(key="notes")),
        _conditions(given.get("before", []), source.where(key="before")),
        _conditions(given.get("after", []), source.where(key="after")), steps,
        profile.with_limits(limits))


def _steps(given: Any, source: _Source, speed_m_s: float | None,
           check_fault: Callable[[str], Any]) -> Iterable[Step]:
    if not isinstance(given, list):
        raise ConfigError(f"{source.where('step')}: write [[step]] with two brackets")
    passed_s = 0.0
    for number, content in enumerate(given):
        def at(key: str = "", number: int = number) -> str:
            return source.where("step", number, key)

        _keys(content, STEP, source, "step", number)
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


def _step(content: Mapping[str, Any], at: Callable[..., str], line: int) -> Step:
    def seconds(key: str) -> float | None:
        return conditions.quantity(content[key], "s", at(key)) if key in content else None

    wanted = _table(content.get("set", {}), at, "set")
    for name in wanted:
        if name != "brake_demand":
            raise ConfigError(f"{at('set')}: '{name}' cannot be set{nearest(name, ['brake_demand'])};"
                              " speed, mass and adhesion stand in [start], friction has a key of "
                              "its own")
    brake = wanted.get("brake_demand")
    timeout_s = seconds("timeout")
    return Step(
        str(content.get("title", "")), line, seconds("at"), seconds("for"),
        conditions.condition(content["until"], at("until")) if "until" in content else None,
        seconds("hold") or 0.0, DEFAULT_TIMEOUT_S if timeout_s is None else timeout_s,
        None if brake is None else _pressure(brake, at("set")), _ramp(content.get("ramp"), at),
        _patch(content.get("friction"), at), _texts(content.get("fault", []), at("fault")),
        _texts(content.get("lift", []), at("lift")), _texts(content.get("note", []), at("note")),
        _conditions(content.get("expect", []), at("expect")))


def _contradictions(step: Step, content: Mapping[str, Any], at: Callable[..., str], passed_s: float,
                    speed_m_s: float | None) -> None:
    """Refuse what cannot be met in any run."""
    if step.for_s is not None and step.until is not None:
        raise ConfigError(f"{at('for')}: a step lasts either `for` a time or `until` a condition; "
                          "keep one, and give `timeout` for the longest wait")
    for key in ("hold", "timeout"):
        if key in content and step.until is None:
            raise ConfigError(f"{at(key)}: belongs to `until`, which this step has not")
    if step.until is not None and step.hold_s >= step.timeout_s:
        raise ConfigError(f"{at('hold')} = {step.hold_s:g} s can never be within timeout = "
                          f"{step.timeout_s:g} s")
    if step.at_s is not None and step.at_s < passed_s - 1e-9:
        raise ConfigError(f"{at('at')} = {step.at_s:g} s is over before the step can begin: the "
                          f"steps before it take at least {passed_s:g} s")
    if step.brake_Pa is not None and step.ramp is not None:
        raise ConfigError(f"{at('ramp')}: the step also sets brake_demand; keep one")
    until, begins_s = step.until, max(passed_s, step.at_s or 0.0)
    if until is None:
        return
    if until.columns == ("time_s",) and until.compare in ("<", "<=") and until.bound <= begins_s:
        raise ConfigError(f"{at('until')} = '{until.text}': can never be, {begins_s:g} s have passed "
                          "by then")
    if (until.columns == ("vehicle_speed_m_s",) and until.compare in (">", ">=")
            and speed_m_s is not None and until.bound > speed_m_s):
        raise ConfigError(f"{at('until')} = '{until.text}': can never be: the vehicle begins at "
                          f"{speed_m_s:.4g} m/s and nothing drives it")


def _pressure(text: Any, where: str) -> float:
    pressure_Pa = conditions.quantity(text, "Pa", where)
    if not 0.0 <= pressure_Pa <= HIGHEST_DEMAND_Pa:
        raise ConfigError(f"{where} = '{text}': a brake demand is from 0 to "
                          f"{HIGHEST_DEMAND_Pa / 1e5:g} bar")
    return pressure_Pa


def _ramp(content: Any, at: Callable[..., str]) -> Ramp | None:
    if content is None:
        return None
    form = "write ramp = { brake_demand = '3.8 bar', in = '4 s' }"
    if not isinstance(content, dict) or set(content) != {"brake_demand", "in"}:
        raise ConfigError(f"{at('ramp')} = {content!r}: {form}")
    in_s = conditions.quantity(content["in"], "s", at("ramp"))
    if in_s <= 0.0:
        raise ConfigError(f"{at('ramp')}: in = '{content['in']}': a ramp takes time; {form}")
    return Ramp(_pressure(content["brake_demand"], at("ramp")), in_s)


def _patch(content: Any, at: Callable[..., str]) -> Patch | None:
    if content is None:
        return None
    where = at("friction")
    if not isinstance(content, dict) or not {"mu"} <= set(content) <= {"mu", "axles"}:
        raise ConfigError(f"{where} = {content!r}: write friction = {{ mu = 0.05, axles = [1, 2] }}")
    mu, axles = content["mu"], content.get("axles", list(range(1, AXLES + 1)))
    if not isinstance(mu, int | float) or not (mu == 0 or 0.0005 <= mu <= 1.0):
        raise ConfigError(f"{where}: mu = {mu!r}: from 0.0005 to 1, or 0 for what the scenario says")
    if not axles or not all(type(one) is int and 1 <= one <= AXLES for one in axles):
        raise ConfigError(f"{where}: axles = {axles!r}: a list of axle numbers from 1 to {AXLES}")
    return Patch(float(mu), tuple(axles))


def _table(content: Any, source: Any, name: str) -> dict[str, Any]:
    if not isinstance(content, dict):
        where = source.where(name) if isinstance(source, _Source) else source(name)
        raise ConfigError(f"{where} = {content!r}: a table is wanted")
    return content


def _keys(given: Any, allowed: tuple[str, ...], source: _Source, table: str, number: int) -> None:
    if not isinstance(given, dict):
        raise ConfigError(f"{source.where(table, number)}: a table is wanted")
    for key in given:
        if key not in allowed:
            raise ConfigError(f"{source.where(table, number, key)}: unknown key"
                              f"{nearest(key, allowed)}")


def _texts(given: Any, where: str) -> tuple[str, ...]:
    texts = [given] if isinstance(given, str) else given
    if not isinstance(texts, list) or not all(isinstance(one, str) for one in texts):
        raise ConfigError(f"{where} = {given!r}: a text in quotes is wanted, or a list of texts")
    return tuple(texts)


def _conditions(given: Any, where: str) -> tuple[Condition, ...]:
    return tuple(conditions.condition(one, where) for one in _texts(given, where))
