"""Reads columns of text as numbers: with a decimal point or comma, and with marks of thousands.

"1,234" is ambiguous: 1.234 or 1234. Each column is held against both readings:

    [N1] point:  1234.5, 1,234.5    the decimal mark is a point, thousands may have commas
    [N2] comma:  1234,5, 1.234,5    the decimal mark is a comma, thousands may have points

One value that fits only one reading decides for its column, as "0,5" or "12,3456". A column in
which all values fit both is read with the decimal mark of the other columns of the file. If these
do not decide, a semicolon as separator means a decimal comma, and a comma as separator means a
decimal point. Marks of thousands are never assumed: a column that could only have them by such an
assumption is refused, and the message shows both readings.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.files import csv_form

POINT = "."
COMMA = ","

_EXPONENT = r"([eEdD][-+]?\d+)?"
_INFINITY = r"^[-+]?inf(inity)?$"
_READINGS = {
    POINT: rf"^[-+]?((\d+|[1-9]\d{{0,2}}(,\d{{3}})+)(\.\d*)?|\.\d+){_EXPONENT}$|{_INFINITY}",
    COMMA: rf"^[-+]?((\d+|[1-9]\d{{0,2}}(\.\d{{3}})+)(,\d*)?|,\d+){_EXPONENT}$|{_INFINITY}",
}
# thousands with blanks or apostrophes, in a value with any decimal mark
_GROUPED = r"^[-+]?\d{1,3}(['\x{2019}\x{a0}\x{202f} ]\d{3})+([.,]\d*)?$"
_GROUP_MARKS = r"['\x{2019}\x{a0}\x{202f} ]"
_SWITCHES = {"true": 1.0, "false": 0.0, "on": 1.0, "off": 0.0, "ein": 1.0, "aus": 0.0}
_SHOWN = 40  # characters of a value in a message
_FAST_VALUES = 2000  # a column is judged by so many values first


class _Text(NamedTuple):
    """A column of text: its values without blanks and missing ones, and the readings that fit."""

    values: pa.ChunkedArray
    readings: frozenset[str]


def is_number(text: str) -> bool:
    """Return whether a text is a number with a decimal point."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def columns(
    path: Path, names: tuple[str, ...], texts: list[pa.ChunkedArray], separator: str, decimal: str
) -> list[pa.ChunkedArray]:
    """Return columns as numbers where all values are numbers, and otherwise as text.

    `decimal` is "auto", "." or ",". Missing values are null. Raises ConfigError for a column that
    is ambiguous.
    """
    judged = [_judge(text) for text in texts]
    if decimal == "auto":
        marks = {next(iter(column.readings)) for column in judged if len(column.readings) == 1}
        default = ""
        if len(marks) == 1:
            default = marks.pop()
        elif not marks:
            default = {";": COMMA, ",": POINT}.get(separator, "")
    else:
        default = decimal

    converted = []
    for name, column in zip(names, judged, strict=True):
        readings = column.readings
        if decimal != "auto":
            readings = readings & {decimal}
        if len(readings) == 2:
            converted.append(_ambiguous(path, name, column.values, default))
        elif readings:
            converted.append(_as_numbers(column.values, next(iter(readings))))
        else:
            converted.append(_as_switches(column.values))
    return converted


def _judge(text: pa.ChunkedArray) -> _Text:
    """Return the values of a column of text, and the readings that fit all of them.

    A column in which both readings give the same numbers has the readings "." only if a point is
    there; without any mark it has both.
    """
    values = pc.utf8_trim_whitespace(text)
    lower = pc.utf8_lower(values)
    missing = pc.is_in(lower, value_set=pa.array(sorted(csv_form.MISSING)))
    if pc.any(missing).as_py():
        values = pc.if_else(missing, pa.scalar(None, pa.string()), values)

    # most columns show their mark in the first values, and a cast is faster than an expression
    fitting = _fitting(values.slice(0, _FAST_VALUES))
    if fitting == {POINT}:
        try:
            values.cast(pa.float64())
            return _Text(values, frozenset({POINT}))
        except pa.ArrowInvalid:
            pass
    fitting = _fitting(values, fitting)
    if not fitting:
        grouped = pc.fill_null(pc.match_substring_regex(values, _GROUPED), False)
        if pc.any(grouped).as_py():
            without = pc.replace_substring_regex(values, _GROUP_MARKS, "")
            values = pc.if_else(grouped, without, values)
            fitting = _fitting(values)
    return _Text(values, frozenset(fitting))


def _fitting(values: pa.ChunkedArray, readings: Iterable[str] = _READINGS) -> set[str]:
    """Return those of the readings that fit all values."""
    fitting = set()
    for mark in readings:
        if pc.all(pc.match_substring_regex(values, _READINGS[mark])).as_py() is not False:
            fitting.add(mark)
    return fitting


def _ambiguous(path: Path, name: str, values: pa.ChunkedArray, default: str) -> pa.ChunkedArray:
    """Return the numbers of a column that fits both readings. Raises ConfigError."""
    has_point = pc.any(pc.match_substring(values, ".")).as_py()
    has_comma = pc.any(pc.match_substring(values, ",")).as_py()
    if not (has_point or has_comma):
        return _as_numbers(values, POINT)
    mark = POINT if has_point else COMMA
    if mark == default:
        return _as_numbers(values, mark)

    marked = pc.index(pc.fill_null(pc.match_substring(values, mark), False), True).as_py()
    example = values[marked].as_py()
    as_decimal = float(example.replace(mark, "."))
    as_thousands = float(example.replace(mark, ""))
    raise ConfigError(
        f"{path}: column '{name}' is ambiguous: '{example}' is {as_decimal:g} with a decimal "
        f"{'point' if mark == POINT else 'comma'}, and {as_thousands:g} with marks of thousands; "
        f'write decimal = "{mark}" or decimal = "{COMMA if mark == POINT else POINT}" in '
        "dataset.toml (`rollerrig import --decimal`)"
    )


def _as_numbers(values: pa.ChunkedArray, decimal: str) -> pa.ChunkedArray:
    """Return text that fits the reading with this decimal mark as numbers."""
    if decimal == COMMA:
        values = pc.replace_substring(values, ".", "")
        values = pc.replace_substring(values, ",", ".")
    try:
        return values.cast(pa.float64())
    except pa.ArrowInvalid:
        # marks of thousands, a sign +, the exponent of Fortran
        values = pc.replace_substring_regex(values, r"[,+]", "")
        values = pc.replace_substring_regex(values, r"(\d)[dD]", r"\1e")
        return values.cast(pa.float64())


def _as_switches(values: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return 1 and 0 for a column of "true" and "false" or the like, and other text as it is."""
    lower = pc.utf8_lower(values)
    known = pa.array(list(_SWITCHES))
    if pc.all(pc.is_in(lower, value_set=known, skip_nulls=True)).as_py() is not True:
        return values
    place = pc.index_in(lower, value_set=known)
    return pc.take(pa.array(list(_SWITCHES.values())), place)


def as_floats(path: Path, values: Any, name: str) -> np.ndarray:
    """Return a column as numbers (n,), NaN where there is none.

    Raises ConfigError with the first value that is not a number.
    """
    try:
        # safe=False allows rounding: a float holds a count of ns since 1970 to about 0.3 us only
        numbers = values.cast(pa.float64(), safe=False)
        return np.asarray(numbers.to_numpy(zero_copy_only=False), float)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{path}: column '{name}' is not all numbers: {_first_text(values) or error}; write one "
            "number in each row, all with the same decimal mark"
        ) from None


def _first_text(values: Any) -> str:
    """Return the first value of a column of text that is not a number, in words; else ""."""
    pattern = re.compile("|".join(_READINGS.values()))
    for place, value in enumerate(values.to_pylist(), start=1):
        if isinstance(value, str) and not pattern.match(value):
            return f"sample {place} is {value[:_SHOWN]!r}"
    return ""
