"""Reads stamps of samples as seconds: numbers in any unit, date and time, times of a day.

Text has one of these forms, with a fraction behind a point or a comma, or none:

    [T1] 2026-03-29 10:00:00.1   with T or a blank, with / instead of -, with Z or +02:00 or neither
    [T2] 29.03.2026 10:00:00,1   day, month, year, because dates with points begin with the day
    [T3] 29/03/2026 10:00:00     day and month, or month and day: the numbers of the file decide;
         also with - between them, and with AM or PM behind the time
    [T4] 10:00:00.1              time of a day; it counts on where the clock passes midnight

If the numbers of the file do not decide in [T3], a file within a single date is read, because its
seconds do not depend on the order. Other files are refused.

Numbers are in a stated unit. Two cases are recognised by their values: days of a spreadsheet [T5],
and stamps of whole seconds with several samples in each [T6].

    [T5] numbers between 20000 and 80000 (the years 1954 to 2119) with steps below 10 us
    [T6] more than half of the samples have the stamp of the sample before
"""

import math
import re
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.files import units

# a unit of stamps -> its length in s
UNITS = {name: unit.factor for name in units.of_quantity(units.TIME) if (unit := units.find(name))}
DAY_S = 86400.0
_MONTHS = 12
SHORTEST_STEP_S = 1e-5  # samples of a vehicle are not closer, so the unit of the stamps is wrong
_SPREADSHEET_DAYS = (20000.0, 80000.0)
_MOST_DIFFERENCE = 0.3  # of the usual number of samples with one stamp

_TIME = r"(?P<h>\d{1,2}):(?P<min>\d{2})(?::(?P<s>\d{2})(?:[.,:](?P<f>\d{1,9}))?)?"
_HALF_DAY = r"(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?"
_ZONE = r"\s*(?P<zone>[Zz]|[-+]\d{2}:?\d{2})?"
_YEAR_FIRST = re.compile(
    rf"^(?P<y>\d{{4}})[-/.](?P<a>\d{{1,2}})[-/.](?P<b>\d{{1,2}})(?:[T\s]+{_TIME}{_ZONE})?$"
)
_YEAR_LAST = re.compile(
    rf"^(?P<a>\d{{1,2}})(?P<mark>[-/.])(?P<b>\d{{1,2}})[-/.](?P<y>\d{{4}}|\d{{2}})"
    rf"(?:[,T\s]+{_TIME}{_HALF_DAY})?$"
)
_OF_DAY = re.compile(rf"^{_TIME}{_HALF_DAY}$")
FORMS = (
    "2026-03-29 10:00:00.0, followed by Z or +02:00 if the time zone is known, or "
    "29.03.2026 10:00:00,0, or 10:00:00.0"
)


class Stamps(NamedTuple):
    """Stamps (n,) in s, NaN where there is none, and what the reader of a report must know."""

    time_s: np.ndarray
    notes: tuple[str, ...]


def read(path: Path, values: pa.ChunkedArray, name: str, unit: str) -> Stamps:
    """Return the stamps of a column; numbers are in `unit`, or in s if it is "".

    Raises ConfigError if values are no stamps, or if their unit cannot be right.
    """
    if pa.types.is_dictionary(values.type):
        values = values.cast(values.type.value_type)
    if pa.types.is_string(values.type) or pa.types.is_large_string(values.type):
        time_s = _of_text(path, pc.utf8_trim_whitespace(values), name)
        return even_stamps(path, Stamps(time_s, ()), name)
    if pa.types.is_timestamp(values.type):
        # Only the count since 1970 is used. It is in UTC if the file gives a zone, so it does not
        # jump when local clocks change to winter time.
        values = values.cast(pa.int64()).cast(pa.duration(values.type.unit))
    if pa.types.is_duration(values.type):
        return even_stamps(path, Stamps(_seconds(values.cast(pa.duration("ns"))), ()), name)
    if pa.types.is_time(values.type):
        time_s = _over_midnight(_seconds(values.cast(pa.time64("ns"))))
        return even_stamps(path, Stamps(time_s, ()), name)

    try:
        # safe=False: a float holds a count of ns since 1970 to about 0.3 us only
        numbers = np.asarray(values.cast(pa.float64(), safe=False).to_numpy(), float)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        raise _no_stamps(path, name, str(values.type)) from None
    return even_stamps(path, of_numbers(path, numbers, name, unit), name)


def of_numbers(path: Path, numbers: np.ndarray, name: str, unit: str) -> Stamps:
    """Return the stamps of numbers (n,) in a unit; without a unit spreadsheet days are recognised.

    Raises ConfigError if the samples are closer than samples of a vehicle can be.
    """
    given = units.find(unit or "s")
    if given is None or given.name not in UNITS:
        raise ConfigError(f"{path}: the unit of '{name}' is '{unit}'; allowed: {', '.join(UNITS)}")
    time_s = numbers * given.factor
    step_s = _typical_step(time_s)
    if not 0.0 < step_s < SHORTEST_STEP_S:
        return Stamps(time_s, ())

    known = numbers[np.isfinite(numbers)]
    first, last = _SPREADSHEET_DAYS
    if not unit and first < known.min() and known.max() < last:  # [T5]
        note = (
            f"{path.name}: the stamps in '{name}' are days of a spreadsheet ({known[0]:.6f} is a "
            f"date): they are multiplied by 86400, and samples are {step_s * DAY_S:.4g} s apart"
        )
        return Stamps(numbers * DAY_S, (note,))
    raise ConfigError(
        f"{path}: samples in '{name}' are {step_s:.3g} s apart if its unit is {given.name}, and "
        f"samples of a vehicle are not closer than {SHORTEST_STEP_S:g} s; write the right unit of "
        f"time_s in [channels], one of: {', '.join(UNITS)}"
    )


def _typical_step(time_s: np.ndarray) -> float:
    """Return the median of the steps that are not 0, in s; infinite if there is none."""
    steps_s = np.abs(np.diff(time_s[np.isfinite(time_s)]))
    steps_s = steps_s[steps_s > 0.0]
    return float(np.median(steps_s)) if steps_s.size else math.inf


def even_stamps(path: Path, stamps: Stamps, name: str) -> Stamps:
    """Return stamps of which samples with the same stamp are spread up to the next one [T6].

    The samples of a stamp are taken as evenly spaced. Raises ConfigError if their number is not
    about the same for each stamp, because then the moments of the samples are unknown.
    """
    known = np.flatnonzero(np.isfinite(stamps.time_s))
    time_s = stamps.time_s[known]
    steps_s = np.diff(time_s)
    if time_s.size < 3 or 2 * np.count_nonzero(steps_s == 0.0) <= steps_s.size:
        return stamps
    begins = np.flatnonzero(np.concatenate([[True], steps_s != 0.0]))
    counts = np.diff(np.append(begins, time_s.size))
    if begins.size < 3:
        raise ConfigError(
            f"{path}: column '{name}' has only {begins.size} different stamps for {time_s.size} "
            "samples, so the moments of the samples are unknown; give stamps with a fraction"
        )
    resolution_s = float(np.median(np.diff(time_s[begins])))
    usual = float(np.median(counts[1:-1]))

    # the first and the last stamp may hold fewer samples
    inner = counts[1:-1]
    wrong = np.flatnonzero(np.abs(inner - usual) > max(_MOST_DIFFERENCE * usual, 1.0))
    if wrong.size or resolution_s <= 0.0:
        at = begins[1 + wrong[0]] if wrong.size else begins[1]
        count = inner[wrong[0]] if wrong.size else usual
        raise ConfigError(
            f"{path}: column '{name}' has stamps of whole {resolution_s:g} s with several samples "
            f"each, usually {usual:g}, but {count:g} at sample {at + 1}, so the moments of the "
            "samples are unknown; give stamps with a fraction, or leave that part out"
        )
    spread_s = np.empty_like(time_s)
    for number, (begin, count) in enumerate(zip(begins, counts, strict=True)):
        share = np.arange(count) / max(count, usual if number in (0, begins.size - 1) else count)
        if number == 0:
            # a recording begins within a second, so its samples are the last of it
            share = share + max(0.0, 1.0 - count / usual)
        spread_s[begin : begin + count] = time_s[begin] + resolution_s * share
    result = stamps.time_s.copy()
    result[known] = spread_s
    note = (
        f"{path.name}: the stamps in '{name}' are whole multiples of {resolution_s:g} s with about "
        f"{usual:g} samples each; the samples are spread evenly in between, so a moment is known to "
        f"about {resolution_s / usual:.2g} s only"
    )
    return Stamps(result, (*stamps.notes, note))


# --- text ---


def holds_dates(values: pa.ChunkedArray) -> bool:
    """Return whether a column has date and time, as a type or as text in all its values."""
    types = pa.types
    if types.is_timestamp(values.type) or types.is_time(values.type):
        return True
    if not (types.is_string(values.type) or types.is_large_string(values.type)):
        return False
    texts = [text for text in values.to_pylist() if text]
    return bool(texts) and all(map(is_text_stamp, texts))


def date_of(text: str) -> str:
    """Return a date as year-month-day; "" if the text is no date, or day and month are unclear."""
    text = text.strip()
    first = _YEAR_FIRST.match(text)
    if first:
        return f"{first['y']}-{int(first['a']):02}-{int(first['b']):02}"
    last = _YEAR_LAST.match(text)
    if last is None:
        return ""
    one, two = int(last["a"]), int(last["b"])
    year = last["y"] if len(last["y"]) > 2 else f"20{last['y']}"
    if last["mark"] == "." or one > _MONTHS:
        return f"{year}-{two:02}-{one:02}"
    if two > _MONTHS:
        return f"{year}-{one:02}-{two:02}"
    return ""


def numbers_or_nan(values: pa.ChunkedArray) -> np.ndarray:
    """Return a column as numbers (n,); all are NaN if it is text."""
    try:
        return np.asarray(values.cast(pa.float64(), safe=False).to_numpy(), float)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        return np.full(len(values), np.nan)


def is_text_stamp(text: str) -> bool:
    """Return whether a text has one of the forms of stamps with a time."""
    text = text.strip()
    match = _YEAR_FIRST.match(text) or _YEAR_LAST.match(text) or _OF_DAY.match(text)
    return match is not None and match["h"] is not None


def _of_text(path: Path, values: pa.ChunkedArray, name: str) -> np.ndarray:
    """Return stamps (n,) in s of a column of text. Raises ConfigError."""
    # empty cells have no stamp
    values = pc.if_else(pc.equal(values, ""), pa.scalar(None, values.type), values)
    if values.null_count == len(values):
        return np.full(len(values), np.nan)
    with suppress(pa.ArrowInvalid):
        return _seconds(_as_instants(values).cast(pa.int64()).cast(pa.duration("ns")))

    for pattern in (_YEAR_FIRST, _YEAR_LAST, _OF_DAY):
        parts = pc.extract_regex(values, pattern=pattern.pattern)
        if parts.null_count == values.null_count:
            return _of_parts(path, values, parts, pattern, name)
    for place, value in enumerate(values.to_pylist()):
        if value is not None and not is_text_stamp(value):
            raise _no_stamps(path, name, f"{value!r} in sample {place + 1}")
    raise _no_stamps(path, name, "stamps of different forms")


def _as_instants(values: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return text of ISO 8601 as instants in ns. Raises ArrowInvalid for other text."""
    # Text with an offset from UTC fails without a zone and is read with the zone UTC. Text without
    # an offset is read without a zone.
    try:
        return values.cast(pa.timestamp("ns"))
    except pa.ArrowInvalid:
        return values.cast(pa.timestamp("ns", tz="UTC"))


class _Parts(NamedTuple):
    """Reads groups of a pattern that all values match as arrays."""

    values: pa.ChunkedArray

    def text(self, group: str) -> pa.ChunkedArray:
        """Return the text of a group; "" where the group is missing."""
        return pc.struct_field(self.values, group)

    def number(self, group: str) -> np.ndarray:
        """Return the number of a group (n,), NaN where there is no value, 0 if it is empty."""
        text = self.text(group)
        filled = pc.if_else(pc.equal(text, ""), "0", text)
        return np.asarray(filled.cast(pa.float64()).to_numpy(), float)


def _of_parts(
    path: Path, values: pa.ChunkedArray, extracted: pa.ChunkedArray, pattern: re.Pattern[str],
    name: str,
) -> np.ndarray:  # fmt: skip
    """Return stamps (n,) in s of text that matches a pattern. Raises ConfigError."""
    parts = _Parts(extracted)
    hours = parts.number("h")
    if "half" in pattern.groupindex:
        half = pc.utf8_lower(parts.text("half"))
        is_half = np.asarray(pc.fill_null(pc.not_equal(half, ""), False).to_numpy(), bool)
        is_after = np.asarray(pc.fill_null(pc.equal(half, "p"), False).to_numpy(), bool)
        hours = np.where(is_half, hours % 12.0, hours) + 12.0 * is_after
    minutes = parts.number("min")
    seconds = parts.number("s") + parts.number("f") / _power_of_ten(parts.text("f"))
    if np.nanmax(hours) >= 24.0 or np.nanmax(minutes) >= 60.0 or np.nanmax(seconds) >= 61.0:
        raise _no_stamps(path, name, "a time of the day that does not exist")
    of_day_s = 3600.0 * hours + 60.0 * minutes + seconds
    if pattern is _OF_DAY:
        return _over_midnight(of_day_s)
    return _days(path, values, parts, pattern, name) * DAY_S + of_day_s - _offset_s(parts, pattern)


def _power_of_ten(text: pa.ChunkedArray) -> np.ndarray:
    """Return 10 to the power of the number of characters."""
    lengths = pc.fill_null(pc.utf8_length(text), 0)
    return 10.0 ** np.asarray(lengths.to_numpy(), float)


def _offset_s(parts: _Parts, pattern: re.Pattern[str]) -> np.ndarray | float:
    """Return the offset from UTC in s; 0 where no offset is given."""
    if "zone" not in pattern.groupindex:
        return 0.0
    offsets = {}
    text = parts.text("zone")
    for zone in text.unique().to_pylist():
        offsets[zone] = 0.0
        if zone and zone not in "Zz":
            digits = zone[1:].replace(":", "")
            size_s = 3600.0 * int(digits[:2]) + 60.0 * int(digits[2:])
            offsets[zone] = -size_s if zone.startswith("-") else size_s
    return np.array([offsets[zone] for zone in text.to_pylist()])


def _days(
    path: Path, values: pa.ChunkedArray, parts: _Parts, pattern: re.Pattern[str], name: str
) -> np.ndarray:
    """Return the days since 1970 (n,) of dates. Raises ConfigError."""
    year = parts.number("y")
    if pattern is _YEAR_FIRST:
        return _since_1970(path, name, year, parts.number("a"), parts.number("b"))
    year = np.where(year < 100.0, year + 2000.0, year)
    first = parts.number("a")
    second = parts.number("b")
    marks = set(parts.text("mark").unique().to_pylist()) - {None}
    dates = np.unique(np.column_stack([year, first, second])[np.isfinite(year)], axis=0)

    if marks == {"."} or np.nanmax(first) > 12.0:
        month, day = second, first
    elif np.nanmax(second) > 12.0 or len(dates) == 1:
        # the seconds within a single date do not depend on the order
        month, day = first, second
    else:
        example = next(value for value in values.to_pylist() if value is not None)
        a, b = re.findall(r"\d+", example)[:2]
        raise ConfigError(
            f"{path}: column '{name}' is ambiguous: '{example}' is day {a} of month {b}, or day "
            f"{b} of month {a}, and no date of the file decides; write {FORMS}"
        )
    return _since_1970(path, name, year, month, day)


def _since_1970(
    path: Path, name: str, year: np.ndarray, month: np.ndarray, day: np.ndarray
) -> np.ndarray:
    """Return the days since 1970 (n,) of dates, NaN where there is none. Raises ConfigError."""
    known = np.isfinite(year)
    dates, place = np.unique(
        np.column_stack([year, month, day])[known].astype(int), axis=0, return_inverse=True
    )
    days = []
    for y, m, d in dates.tolist():
        try:
            days.append(float(np.datetime64(f"{y:04d}-{m:02d}-{d:02d}", "D").astype(int)))
        except ValueError:
            raise _no_stamps(path, name, f"the date {y}-{m}-{d}, which does not exist") from None
    result = np.full(year.shape, np.nan)
    result[known] = np.array(days)[place.ravel()]
    return result


def _over_midnight(of_day_s: np.ndarray) -> np.ndarray:
    """Return times of a day that count on where the clock passes midnight, in s."""
    known = np.isfinite(of_day_s)
    time_s = of_day_s[known]
    passes = np.diff(time_s, prepend=time_s[:1]) < -DAY_S / 2.0
    result = of_day_s.copy()
    result[known] = time_s + DAY_S * np.cumsum(passes)
    return result


def _seconds(values: pa.ChunkedArray) -> np.ndarray:
    """Return counts of ns (n,) in s, NaN where there is none."""
    return np.asarray(values.cast(pa.int64()).to_numpy(), float) * 1e-9


def _no_stamps(path: Path, name: str, what: str) -> ConfigError:
    """Return the error for a column that holds no stamps."""
    return ConfigError(
        f"{path}: column '{name}' has neither numbers nor date and time, but {what}; write {FORMS}"
    )
