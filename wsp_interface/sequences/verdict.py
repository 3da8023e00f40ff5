"""Verdicts: measures against limits, each with its margin and the source of its number.

A criteria profile is a TOML file of limits. A limit may have bounds of speed: then its measure is
that of the braking between these speeds. A sequence may add limits, which replace those of the
profile for the same measure: a limit without bounds replaces all of them, one with bounds that with
the same bounds. A measure that could not be computed is an error, never a pass. An
exceeded limit wins over an error: what failed is a failure, whatever else could not be judged. If a
pre-condition of the sequence did not hold, all measures are void, and the sequence is an error. A
measure that a run cannot have, because for example the WSP did not act, does not count, and its
verdict states why. No verdict certifies anything.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.number_text import rounded
from rollerrig.configs.table import known, nearest
from rollerrig.wsp_interface.sequences import measures
from rollerrig.wsp_interface.sequences.measures import Measure
from rollerrig.wsp_interface.sequences.record import Record

NO_PROFILE = "none"  # the name of the profile without limits
DISCLAIMER = "not a certification"
UNVERIFIED = "recollection, to be checked against ..."
# a source that is only remembered, and the standard against which it has to be checked, with its
# edition such as EN 15595:2018+A1:2023
_REMEMBERED = re.compile(
    r"recollection([^,]*), to be checked against ((?:[^:;,]|:(?=\d))+)[:;,]?\s*(.*)"
)
_VOID = "void: "  # begins the text of a void verdict
_STANDARD = re.compile(r"(?:prEN|EN|UIC|ISO|IEC) ?\d[\d-]*|[Pp]aper[^:;,]*")
HIGHEST_SPEED_M_S = 200.0
# the keys of a limit, each with its value
LIMIT = {
    "measure": "name of a measure",
    "unit": "unit of `max` and `min`, which is that of the measure",
    "max": "largest value that passes",
    "min": "least value that passes",
    "above_m_s": "the measure counts while the vehicle is faster; default: no bound",
    "below_m_s": "the measure counts while the vehicle is not faster; default: no bound",
    "source": "text: where the limit comes from",
}


class Result(StrEnum):
    """The result of a limit, a check or a whole sequence, from good to bad; the worst decides."""

    PASS = "pass"
    ABSENT = "not applicable"
    ERROR = "error"
    FAIL = "fail"


@dataclass(frozen=True)
class Limit:
    """The bounds of a measure, in its unit; infinite on a side without a bound.

    above_m_s, below_m_s: the speeds of the vehicle at which the measure counts.
    """

    measure: str
    unit: str
    low: float
    high: float
    source: str
    above_m_s: float = -math.inf
    below_m_s: float = math.inf

    @property
    def bounded(self) -> bool:
        """Whether only some speeds of the vehicle count."""
        return math.isfinite(self.above_m_s) or math.isfinite(self.below_m_s)

    @property
    def what(self) -> str:
        """The measure, with its bounds of speed."""
        is_above = math.isfinite(self.above_m_s)
        is_below = math.isfinite(self.below_m_s)
        if is_above and is_below:
            bounds = f"{rounded(self.above_m_s)} and {rounded(self.below_m_s)} m/s"
            return f"{self.measure} between {bounds}"
        if is_above:
            return f"{self.measure} above {rounded(self.above_m_s)} m/s"
        if is_below:
            return f"{self.measure} below {rounded(self.below_m_s)} m/s"
        return self.measure

    def replaces(self, other: "Limit") -> bool:
        """Whether a limit of a sequence replaces one of its profile."""
        if self.measure != other.measure:
            return False
        same_bounds = (self.above_m_s, self.below_m_s) == (other.above_m_s, other.below_m_s)
        return same_bounds or not self.bounded


@dataclass(frozen=True)
class Profile:
    """A criteria profile: limits with a name."""

    name: str
    title: str
    limits: tuple[Limit, ...]

    def with_limits(self, more: tuple[Limit, ...]) -> "Profile":
        """Return the profile with more limits, which may replace those of the same measure.

        The title then mentions them.
        """
        if not more:
            return self
        kept = []
        for limit in self.limits:
            if not any(one.replaces(limit) for one in more):
                kept.append(limit)
        title = "limits in the sequence"
        if kept:
            title = f"{self.title}; and limits in the sequence"
        return replace(self, title=title, limits=(*kept, *more))


@dataclass(frozen=True)
class Verdict:
    """One line of a report.

    what: the measure with its bounds of speed, or the name of a step.
    value: in the unit; NaN where there is none.
    limit: the requirement as text.
    margin: the distance to the nearer bound, divided by that bound; negative if it is exceeded.
    source: of the limit.
    text: the meaning of the measure, or why there is no value.
    measure: the name of the measure; "" for a step.
    above_m_s, below_m_s: the speeds at which it counts; infinite without a bound.
    """

    what: str
    unit: str
    value: float
    limit: str
    margin: float
    result: Result
    source: str
    text: str = ""
    measure: str = ""
    above_m_s: float = -math.inf
    below_m_s: float = math.inf

    @property
    def void(self) -> bool:
        """Whether the verdict means nothing, because a pre-condition did not hold."""
        return self.result is Result.ABSENT and self.text.startswith(_VOID)

    @property
    def value_text(self) -> str:
        """The value with its unit; "never" if it is infinite, empty if there is none."""
        if not math.isfinite(self.value):
            return "never" if math.isinf(self.value) else ""
        return f"{rounded(self.value)} {self.unit}".strip()

    @property
    def limit_text(self) -> str:
        """The requirement with its unit."""
        return f"{self.limit} {self.unit}".strip()

    @property
    def against_limit(self) -> str:
        """The value and its limit as text."""
        found = f"{self.what} {self.value_text}".rstrip()
        return f"{found}, wanted {self.limit_text}"


def load(name: str, beside: Path | None = None) -> Profile:
    """Return a criteria profile by name or path; "none" has no limits. Raises ConfigError."""
    if name == NO_PROFILE:
        return Profile(NO_PROFILE, "no limits", ())
    content, path = store.load("criteria", name, beside)
    known(content, ("title", "limit"), lambda key: str(path))
    tables = content.get("limit", [])
    its_limits = limits(tables, lambda number, key: f"{path} [[limit]] {number + 1}: {key}")
    return Profile(path.stem, str(content.get("title", path.stem)), its_limits)


def limits(tables: Any, where: Callable[[int, str], str]) -> tuple[Limit, ...]:
    """Return the limits of the tables [[limit]] or [[measure]].

    `where(number, key)` returns the place of a key of a table (from 0), for messages. Raises
    ConfigError for an unknown measure, a wrong unit or a contradiction.
    """
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise ConfigError(f"{where(0, '')}: write the table with two brackets, one for each limit")
    return tuple(_limit(table, partial(where, number)) for number, table in enumerate(tables))


def _limit(table: Any, where: Callable[[str], str]) -> Limit:
    known(table, LIMIT, where)
    name = table.get("measure")
    if not isinstance(name, str) or name not in measures.BY_NAME:
        raise ConfigError(
            f"{where('measure')} = {name!r}: there is no such measure"
            f"{nearest(str(name), measures.BY_NAME)}"
        )
    measure = measures.BY_NAME[name]
    if table.get("unit") != measure.unit:
        written = f" = {table['unit']!r}" if "unit" in table else " is missing"
        kind = f"is in {measure.unit}" if measure.unit else "has no unit"
        raise ConfigError(f'{where("unit")}{written}: {name} {kind}; write unit = "{measure.unit}"')
    if not table.get("source"):
        raise ConfigError(
            f"{where('source')} is missing; write where the number comes from, or '{UNVERIFIED}'"
        )
    low = table.get("min", -math.inf)
    high = table.get("max", math.inf)
    for key, bound in (("min", low), ("max", high)):
        is_number = isinstance(bound, int | float) and not isinstance(bound, bool)
        if not is_number or math.isnan(bound):
            raise ConfigError(f"{where(key)} = {bound!r}: allowed is a number")
    if "min" not in table and "max" not in table:
        raise ConfigError(f"{where('measure')}: a limit has a min, a max or both")
    if low > high:
        raise ConfigError(
            f"{where('max')} = {high:g} is below min = {low:g}; nothing can meet both"
        )
    if high < measure.least:
        raise ConfigError(
            f"{where('max')} = {high:g} is below {measure.least:g}, the least value that "
            f"{name} can have; nothing can meet it"
        )
    above_m_s, below_m_s = _speeds(table, measure, where)
    source = str(table["source"])
    return Limit(name, measure.unit, float(low), float(high), source, above_m_s, below_m_s)


def _speeds(table: Any, measure: Measure, where: Callable[[str], str]) -> tuple[float, float]:
    """Return the bounds of speed of a limit. Raises ConfigError."""
    above_m_s = table.get("above_m_s", -math.inf)
    below_m_s = table.get("below_m_s", math.inf)
    for key, bound_m_s in (("above_m_s", above_m_s), ("below_m_s", below_m_s)):
        if key not in table:
            continue
        is_number = isinstance(bound_m_s, int | float) and not isinstance(bound_m_s, bool)
        if not is_number or not 0.0 <= bound_m_s <= HIGHEST_SPEED_M_S:
            raise ConfigError(
                f"{where(key)} = {bound_m_s!r}: allowed is a speed of the vehicle in m/s, from 0 to "
                f"{HIGHEST_SPEED_M_S:g}; 30 km/h is 8.33"
            )
        if measure.whole:
            raise ConfigError(
                f"{where(key)}: {measure.name} has no bounds of speed, because {measure.whole}; "
                f"remove {key}, or limit another measure"
            )
    if above_m_s >= below_m_s:
        raise ConfigError(
            f"{where('above_m_s')} = {above_m_s:g} is not below below_m_s = {below_m_s:g}; no speed "
            "is between them"
        )
    return float(above_m_s), float(below_m_s)


def judge(profile: Profile, record: Record, void: str = "") -> list[Verdict]:
    """Return a verdict for each limit of a profile.

    `void` is the reason why the measures mean nothing; then no verdict is a pass or a failure.
    """
    verdicts = [_judge(limit, record) for limit in profile.limits]
    if void:
        verdicts = [_voided(verdict, void) for verdict in verdicts]
    return verdicts


def _voided(verdict: Verdict, reason: str) -> Verdict:
    return replace(
        verdict,
        value=math.nan,
        margin=math.nan,
        result=Result.ABSENT,
        text=f"{_VOID}{reason}",
    )


def _judge(limit: Limit, record: Record) -> Verdict:
    measure = measures.BY_NAME[limit.measure]
    text = measure.meaning(record)
    if limit.bounded:
        record = record.between(limit.above_m_s, limit.below_m_s)
    if limit.bounded and not record.counts.any():
        return _without_rows(limit, record)
    try:
        value = float(measure.of(record))
    except (KeyError, IndexError, ValueError) as error:
        value = math.nan
        result = Result.ERROR
        text = f"cannot be computed: {error!r}"
    else:
        if math.isnan(value) and measure.absent:
            result = Result.ABSENT
            text = measure.absent
        elif math.isnan(value):
            result = Result.ERROR
            text = "was not measured: did the vehicle stop?"
        elif limit.low <= value <= limit.high:
            result = Result.PASS
        else:
            result = Result.FAIL
    return _verdict(limit, value, result, text)


def _without_rows(limit: Limit, record: Record) -> Verdict:
    """Return the verdict on a limit between whose bounds of speed the vehicle has not been."""
    if record.stands:
        text = "the stop has no speed between these bounds"
        return _verdict(limit, math.nan, Result.ABSENT, text)
    return _verdict(limit, math.nan, Result.ERROR, "was not measured: did the vehicle stop?")


def _verdict(limit: Limit, value: float, result: Result, text: str) -> Verdict:
    """Return the verdict on a limit."""
    return Verdict(
        what=limit.what,
        unit=limit.unit,
        value=value,
        limit=_bounds_text(limit),
        margin=_margin(limit, value),
        result=result,
        source=limit.source,
        text=text,
        measure=limit.measure,
        above_m_s=limit.above_m_s,
        below_m_s=limit.below_m_s,
    )


def _bounds_text(limit: Limit) -> str:
    texts = []
    if math.isfinite(limit.low):
        texts.append(f"at least {rounded(limit.low, 6)}")
    if math.isfinite(limit.high):
        texts.append(f"at most {rounded(limit.high, 6)}")
    return " and ".join(texts)


def _margin(limit: Limit, value: float) -> float:
    """Return the distance to the nearer bound over that bound; NaN without a bound, or with 0."""
    margins = []
    if math.isfinite(limit.high) and limit.high != 0.0:
        margins.append((limit.high - value) / abs(limit.high))
    if math.isfinite(limit.low) and limit.low != 0.0:
        margins.append(-(limit.low - value) / abs(limit.low))
    return min(margins, default=math.nan)


def source_words(source: str) -> tuple[str, str]:
    """Return the source of a limit for a reader: a heading, and the rest of the text.

    A number from memory has a heading that says so. A standard that the author of a profile gives
    as the source is shown as a statement of the profile: rollerrig has not verified it.
    """
    remembered = _REMEMBERED.fullmatch(source)
    if remembered is not None:
        of_what, standard, rest = remembered.groups()
        return f"from memory{of_what}, not verified against {standard.strip()}", rest
    if source.startswith("assumption"):
        return "assumption", source.removeprefix("assumption").lstrip(":, ")
    standard_name = _STANDARD.search(source)
    if standard_name is not None:
        return f"{standard_name[0]}, as the criteria profile states; not verified", source
    return "", source


def source_text(source: str) -> str:
    """Return `source_words` in one line."""
    heading, rest = source_words(source)
    return ": ".join(filter(None, (heading, rest)))


def worst(results: list[Result]) -> Result:
    """Return the result of a whole.

    Results that are not applicable do not count. Without any other result the whole is an error.
    """
    counted = [result for result in results if result is not Result.ABSENT]
    if not counted:
        return Result.ERROR
    return max(counted, key=list(Result).index)
