"""Parameters are rows: name with its unit, bounds, default, source. Here a TOML table is read by
rows.

The loader, the documentation and the bounds of identification use the same rows. So a value from a
program is checked like a value from a person.
"""

import difflib
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple

from rollerrig.configs.errors import ConfigError

# least ratio of difflib at which a name is similar to another
_SIMILAR = 0.6
# names that a message suggests at most
_MOST_SIMILAR = 3
# Results of `read`, by `_key`: the rows, so that no others get their identity, and the values.
_kept: dict[tuple[Any, ...], tuple[Any, dict[str, Any]]] = {}
_MOST_KEPT = 1000


class Row(NamedTuple):
    """One parameter.

    `default` None: the parameter has no default and must be in the table. `choices`: the values of
    a text parameter. The type of a value is that of the default: float, int, bool, str, or a tuple
    of floats (then the bounds apply to each item). `low` and `high` are inclusive.
    """

    name: str
    default: Any
    low: float
    high: float
    source: str
    choices: tuple[str, ...] = ()


def number(name: str, default: float | None, low: float, high: float, source: str) -> Row:
    """Return the row of a float with bounds."""
    return Row(name, None if default is None else float(default), low, high, source)


def integer(name: str, default: int, low: int, high: int, source: str) -> Row:
    """Return the row of an int with bounds."""
    return Row(name, int(default), low, high, source)


def choice(name: str, default: str, choices: tuple[str, ...], source: str) -> Row:
    """Return the row of a text: one of the choices, or any text without choices."""
    return Row(name, default, 0, 0, source, choices)


def flag(name: str, default: bool, source: str) -> Row:
    """Return the row of a bool."""
    return Row(name, default, 0, 1, source)


def read(rows: Iterable[Row], given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the checked value of every row, from `given` or its default.

    `where` is the beginning of messages: file and table. Raises ConfigError for an unknown or
    missing key, a wrong type or a value out of bounds.

    A campaign checks the same few tables for each of its runs, so the last results are kept.
    """
    key = _key(rows, given, where)
    if key is not None and key in _kept:
        return dict(_kept[key][1])
    table = {row.name: row for row in rows}
    known(given, table, lambda key: where)
    found = {name: check(row, given.get(name, row.default), where) for name, row in table.items()}
    if key is not None:
        if len(_kept) == _MOST_KEPT:
            _kept.clear()
        _kept[key] = (rows, found)
    return dict(found)


def _key(rows: Iterable[Row], given: Any, where: str) -> tuple[Any, ...] | None:
    """Return what a result of `read` depends on; None where it is not to be kept."""
    if not isinstance(rows, tuple) or not isinstance(given, Mapping):
        return None
    # 1, 1.0 and True are equal, but not the same to a row
    values = tuple((name, type(value), value) for name, value in given.items())
    key = (id(rows), where, values)
    try:
        hash(key)
    except TypeError:
        # a list
        return None
    return key


def known(given: Any, allowed: Collection[str], where: Callable[[str], str]) -> None:
    """Raise ConfigError if `given` is no table or has a key that is not allowed; `where(key)`: its
    place.
    """
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where('')} = {given!r}: must be a table with keys and values")
    for key in given:
        if key not in allowed:
            raise ConfigError(f"{where(key)}: unknown key '{key}'{nearest(key, allowed)}")


def nearest(
    key: str, allowed: Iterable[str], title: str = "Allowed", others: Iterable[str] = ()
) -> str:
    """Return the end of a message about an unknown name: similar names, and the allowed names.

    `title` says what the list of names is. `others` are names that may be meant but are not
    listed, because there are too many of them.
    """
    names = sorted(allowed)
    meant = similar(key, [*names, *others])
    hint = "."
    if meant:
        quoted = [f"'{name}'" for name in meant]
        hint = f"; did you mean {' or '.join(quoted)}?"
    return f"{hint} {title}: {', '.join(names) or 'none'}"


def similar(key: str, names: Iterable[str]) -> list[str]:
    """Return the names that are probably meant by an unknown one, the most probable first.

    A name that differs only in upper and lower case is meant alone. Otherwise the names that
    contain the key as a word are meant, at most three. Without one, the most similar name is.
    """
    candidates = list(names)
    wanted = key.casefold()
    equal = [name for name in candidates if name.casefold() == wanted]
    if equal:
        return equal[:1]

    # "speed" is in initial_speed_m_s, and "mass_kg" in vehicle.mass_kg
    as_word = re.compile(rf"(?:^|[._]){re.escape(wanted)}(?:$|[._])")
    containing = [name for name in candidates if wanted and as_word.search(name.casefold())]
    if containing:
        # first the names without a table, then the keys of tables that are the word as a whole
        by_place = sorted(
            containing, key=lambda name: ("." in name, not name.casefold().endswith(f".{wanted}"))
        )
        return by_place[:_MOST_SIMILAR]

    by_spelling: dict[str, str] = {}
    for name in candidates:
        by_spelling.setdefault(name.casefold(), name)
    close = difflib.get_close_matches(wanted, by_spelling, n=1, cutoff=_SIMILAR)
    return [by_spelling[name] for name in close]


def check(row: Row, value: Any, where: str) -> Any:
    """Return a value in the type of its row. Raises ConfigError with the place and the bounds."""
    at = f"{where}: {row.name}"
    if value is None:
        raise ConfigError(f"{at} is missing; give a number from {row.low:g} to {row.high:g}")
    if isinstance(row.default, bool):
        if not isinstance(value, bool):
            raise ConfigError(f"{at} = {value!r}: must be true or false")
        return value
    if isinstance(row.default, str):
        if not isinstance(value, str):
            raise ConfigError(f"{at} = {value!r}: must be a text in quotes")
        if row.choices and value not in row.choices:
            raise ConfigError(f"{at} = '{value}'{nearest(value, row.choices)}")
        return value
    if isinstance(row.default, tuple):
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{at} = {value!r}: must be a list of numbers")
        if row.default and len(value) != len(row.default):
            raise ConfigError(f"{at} has {len(value)} numbers; must have {len(row.default)}")
        return tuple(_number(row, item, at) for item in value)
    return _number(row, value, at)


def _number(row: Row, value: Any, at: str) -> float | int:
    whole = isinstance(row.default, int)
    kind = "a whole number" if whole else "a number"
    # in Python a bool is an int
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{at} = {value!r}: must be {kind}")
    if whole and (not math.isfinite(value) or value != int(value)):
        raise ConfigError(f"{at} = {value!r}: must be {kind}")
    if math.isnan(value) or not row.low <= value <= row.high:
        raise ConfigError(f"{at} = {value:g} is out of range; allowed {row.low:g} to {row.high:g}")
    return int(value) if whole else float(value)
