"""Verdicts: measures against limits, each with its margin and the source of its number.

A criteria profile is a TOML file of limits; a sequence may add limits of its own, which replace those of the profile
for the same measure. A run that could not be measured is an error, never a pass, and so is one whose pre-condition did
not hold: its measures are void. A measure that a run cannot have (the WSP did not act) is left out and says so. Nothing
here certifies anything.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import known, nearest
from rollerrig.wsp_interface.sequences import measures
from rollerrig.wsp_interface.sequences.measures import Record

DISCLAIMER = "not a certification"
UNVERIFIED = "recollection, to be checked against ..."
_VOID = "void: "
_KEYS = ("measure", "unit", "max", "min", "source")


class Result(StrEnum):
    """How a limit, a check or a whole sequence came out, from good to bad; the worst decides."""

    PASS = "pass"
    ABSENT = "not applicable"
    FAIL = "fail"
    ERROR = "error"


@dataclass(frozen=True)
class Limit:
    """A bound on a measure; inf where there is none on that side."""

    measure: str
    unit: str
    low: float
    high: float
    source: str


@dataclass(frozen=True)
class Profile:
    """Named limits."""

    name: str
    title: str
    limits: tuple[Limit, ...]

    def with_limits(self, more: tuple[Limit, ...]) -> "Profile":
        """The same with limits that replace those of the same measure."""
        named = {one.measure for one in more}
        return replace(
            self, limits=(*(one for one in self.limits if one.measure not in named), *more)
        )


@dataclass(frozen=True)
class Verdict:
    """One line of a report. `margin` is the distance to the nearer limit over that limit."""

    what: str
    unit: str
    value: float
    limit: str
    margin: float
    result: Result
    source: str
    text: str = ""

    @property
    def void(self) -> bool:
        """Whether it tells nothing, since a pre-condition did not hold."""
        return self.result is Result.ABSENT and self.text.startswith(_VOID)

    @property
    def shown(self) -> str:
        """The value with its unit; "never" where it was not reached, empty where there is none."""
        if not math.isfinite(self.value):
            return "never" if math.isinf(self.value) else ""
        return f"{self.value:.4g} {self.unit}".strip()

    @property
    def told(self) -> str:
        """The value against its limit."""
        return f"{self.what} {self.shown}, wanted {self.limit} {self.unit}".strip()


def load(name: str, beside: Path | None = None) -> Profile:
    """A criteria profile by name or path; "none" has no limits. Raises ConfigError."""
    if name == "none":
        return Profile("none", "no limits of its own", ())
    content, path = store.load("criteria", name, beside)
    known(content, ("title", "limit"), lambda key: str(path))
    found = limits(content.get("limit", []), lambda at, key: f"{path} [[limit]] {at + 1}: {key}")
    return Profile(path.stem, str(content.get("title", path.stem)), found)


def limits(given: Any, where: Callable[[int, str], str]) -> tuple[Limit, ...]:
    """Limits from their tables. Raises ConfigError: unknown measure, wrong unit, contradiction."""
    if not isinstance(given, list) or not all(isinstance(one, dict) for one in given):
        raise ConfigError(f"{where(0, '')}: write the table with two brackets, one for each limit")
    return tuple(_limit(one, partial(where, at)) for at, one in enumerate(given))


def _limit(given: Any, where: Callable[[str], str]) -> Limit:
    known(given, _KEYS, where)
    name = given.get("measure")
    if not isinstance(name, str) or name not in measures.BY_NAME:
        raise ConfigError(
            f"{where('measure')} = {name!r}: no measure is called so"
            f"{nearest(str(name), measures.BY_NAME)}"
        )
    measure = measures.BY_NAME[name]
    if given.get("unit") != measure.unit:
        raise ConfigError(
            f"{where('unit')} = {given.get('unit')!r}: {name} is in '{measure.unit}'; "
            f'write unit = "{measure.unit}"'
        )
    if not given.get("source"):
        raise ConfigError(
            f"{where('source')} is missing; say where the number comes from, or '{UNVERIFIED}'"
        )
    low, high = given.get("min", -math.inf), given.get("max", math.inf)
    for key, bound in (("min", low), ("max", high)):
        if isinstance(bound, bool) or not isinstance(bound, int | float) or math.isnan(bound):
            raise ConfigError(f"{where(key)} = {bound!r}: a number is wanted")
    if "min" not in given and "max" not in given:
        raise ConfigError(f"{where('measure')}: a limit has a min, a max or both")
    if low > high:
        raise ConfigError(
            f"{where('max')} = {high:g} is below min = {low:g}; nothing can meet both"
        )
    if high < measure.least:
        raise ConfigError(
            f"{where('max')} = {high:g} is below {measure.least:g}, the least that "
            f"{name} can be; nothing can meet it"
        )
    return Limit(name, measure.unit, float(low), float(high), str(given["source"]))


def judge(profile: Profile, record: Record, void: str = "") -> list[Verdict]:
    """A verdict for each limit of a profile; none is passed or failed where something makes them `void`."""
    verdicts = [_judge(limit, record) for limit in profile.limits]
    return (
        [
            replace(
                one, value=math.nan, margin=math.nan, result=Result.ABSENT, text=f"{_VOID}{void}"
            )
            for one in verdicts
        ]
        if void
        else verdicts
    )


def _judge(limit: Limit, record: Record) -> Verdict:
    bounds = " and ".join(
        [f"at least {limit.low:g}"] * math.isfinite(limit.low)
        + [f"at most {limit.high:g}"] * math.isfinite(limit.high)
    )
    measure = measures.BY_NAME[limit.measure]
    try:
        value, text = float(measure.of(record)), measure.text
        result = Result.PASS if limit.low <= value <= limit.high else Result.FAIL
    except (KeyError, IndexError, ValueError) as error:
        value, result, text = math.nan, Result.ERROR, f"cannot be computed: {error!r}"
    else:
        if math.isnan(value):
            result = Result.ABSENT if measure.absent else Result.ERROR
            text = measure.absent or "was not measured: did the vehicle stop?"
    # a limit of nothing has no room to speak of
    rooms = [
        sign * (bound - value) / abs(bound)
        for sign, bound in ((1, limit.high), (-1, limit.low))
        if math.isfinite(bound) and bound != 0.0
    ]
    return Verdict(
        what=limit.measure,
        unit=limit.unit,
        value=value,
        limit=bounds,
        margin=min(rooms, default=math.nan),
        result=result,
        source=limit.source,
        text=text,
    )


def worst(results: list[Result]) -> Result:
    """The result of a whole: what is not applicable does not count; nothing at all is an error."""
    counted = [one for one in results if one is not Result.ABSENT]
    return max(counted, key=list(Result).index) if counted else Result.ERROR
