"""Parameters are rows: name with its unit, bounds, default, source. This reads a TOML table by rows.

The same rows serve the loader, the documentation and the bounds of identification, so a value that
a program found passes the same gate as one that a person wrote.
"""

import difflib
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple

from rollerrig.configs.errors import ConfigError


class Row(NamedTuple):
    """One parameter. `default` None: it must be given. `choices`: a text parameter's values.

    The type of a value follows the default: float, int, bool, str, or a tuple of floats (then the
    bounds hold for each item). `low` and `high` are inclusive.
    """

    name: str
    default: Any
    low: float
    high: float
    source: str
    choices: tuple[str, ...] = ()


def number(name: str, default: float | None, low: float, high: float, source: str) -> Row:
    """A float with bounds."""
    return Row(name, None if default is None else float(default), low, high, source)


def integer(name: str, default: int, low: int, high: int, source: str) -> Row:
    """An int with bounds."""
    return Row(name, int(default), low, high, source)


def choice(name: str, default: str, choices: tuple[str, ...], source: str) -> Row:
    """One of some words; without choices any text."""
    return Row(name, default, 0, 0, source, choices)


def flag(name: str, default: bool, source: str) -> Row:
    """true or false."""
    return Row(name, default, 0, 1, source)


def read(rows: Iterable[Row], given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Every row's value, from `given` or its default, checked.

    `where` is what messages begin with: file and table. Raises ConfigError for an unknown key, a
    missing one, a wrong type or a value out of bounds.
    """
    table = {row.name: row for row in rows}
    known(given, table, lambda key: where)
    return {name: check(row, given.get(name, row.default), where) for name, row in table.items()}


def known(given: Any, allowed: Collection[str], where: Callable[[str], str]) -> None:
    """Raise ConfigError where `given` is no table, or has a key that is not allowed; `where(key)` is its place."""
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where('')} = {given!r}: a table with keys and values is wanted")
    for key in given:
        if key not in allowed:
            raise ConfigError(f"{where(key)}: unknown key '{key}'{nearest(key, allowed)}")


def nearest(key: str, allowed: Iterable[str]) -> str:
    """The tail of a message on an unknown name: what was probably meant, and what is allowed."""
    allowed = sorted(allowed)
    close = difflib.get_close_matches(key, allowed, n=1, cutoff=0.6)
    hint = f"; did you mean '{close[0]}'?" if close else "."
    return f"{hint} Allowed: {', '.join(allowed)}"


def check(row: Row, value: Any, where: str) -> Any:
    """One value in the type of its row. Raises ConfigError, naming the place and the bounds."""
    at = f"{where}: {row.name}"
    if value is None:
        raise ConfigError(f"{at} is missing; give a number from {row.low:g} to {row.high:g}")
    if isinstance(row.default, bool):
        if not isinstance(value, bool):
            raise ConfigError(f"{at} = {value!r}: write true or false")
        return value
    if isinstance(row.default, str):
        if not isinstance(value, str):
            raise ConfigError(f"{at} = {value!r}: a text in quotes is wanted")
        if row.choices and value not in row.choices:
            raise ConfigError(f"{at} = '{value}'{nearest(value, row.choices)}")
        return value
    if isinstance(row.default, tuple):
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{at} = {value!r}: a list of numbers is wanted")
        if row.default and len(value) != len(row.default):
            raise ConfigError(f"{at} has {len(value)} numbers, {len(row.default)} are wanted")
        return tuple(_number(row, item, at) for item in value)
    return _number(row, value, at)


def _number(row: Row, value: Any, at: str) -> float | int:
    whole = isinstance(row.default, int)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{at} = {value!r}: a {'whole ' if whole else ''}number is wanted")
    if whole and (not math.isfinite(value) or value != int(value)):
        raise ConfigError(f"{at} = {value!r}: a whole number is wanted")
    if math.isnan(value) or not row.low <= value <= row.high:
        raise ConfigError(f"{at} = {value:g} is out of range; allowed {row.low:g} to {row.high:g}")
    return int(value) if whole else float(value)
