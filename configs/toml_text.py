"""Parses TOML of users, within limits that the standard library does not have.

The limits have three reasons. Deeply nested values exhaust the stack of the parser, or of the code
that reads the values later. A key with thousands of dots takes the parser minutes. A whole number
of thousands of digits does not fit into the numbers of the program. Source: TOML 1.0 (whole numbers
have 64 bits).
"""

import copy
import functools
import re
import tomllib
from collections.abc import Iterator
from typing import Any

from rollerrig.configs.errors import ConfigError

MOST_NESTED = 32  # tables and lists in one another
LARGEST = 2**63 - 1
_KEPT = 16  # parsed texts
_SMALLEST = -(2**63)

_INTEGERS = "whole numbers from -2^63 to 2^63 - 1 are allowed"
_NESTING = f"tables, lists and dotted keys may be nested at most {MOST_NESTED} deep; write it flat"

# The parts of a dotted key, at the beginning of a line or of an inline table. The quantifiers are
# possessive: a text that does not match is left in one pass.
_KEY_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(
    rf"(?:^|[\[{{,])[ \t]*+(?:{_KEY_PART}[ \t]*+\.[ \t]*+){{{MOST_NESTED}}}", re.MULTILINE
)
_LONG_NUMBER = re.compile(r"[0-9_]{400}")


def parse(text: str, where: str) -> dict[str, Any]:
    """Return the content of a TOML text. Raises ConfigError, which begins with `where`."""
    try:
        # the caller may change what it gets
        return copy.deepcopy(_parsed(text, where))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: not valid TOML: {error}") from None


@functools.lru_cache(maxsize=_KEPT)
def _parsed(text: str, where: str) -> dict[str, Any]:
    """Return the content of a TOML text; a campaign reads the same few files for each run."""
    return _parse(text, where)


def value(text: str, where: str) -> Any:
    """Return the value that a text is in TOML.

    Raises ValueError if it is none, and ConfigError, which begins with `where`, for a value beyond
    the limits.
    """
    return _parse(f"value = {text}", where)["value"]


def _parse(text: str, where: str) -> dict[str, Any]:
    """Return the content of a TOML text. Raises TOMLDecodeError, and ConfigError for the limits."""
    if long_key := _LONG_KEY.search(text):
        raise ConfigError(f"{where}, line {_line(text, long_key.start())}: {_NESTING}")
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise ConfigError(f"{where}: {_NESTING}") from None
    except ValueError:
        # Python refuses whole numbers of thousands of digits
        number = _LONG_NUMBER.search(text)
        line = f", line {_line(text, number.start())}" if number else ""
        raise ConfigError(f"{where}{line}: a number has too many digits; {_INTEGERS}") from None
    _check(content, where)
    return content


def _line(text: str, position: int) -> int:
    """Return the number of the line of a position, from 1."""
    return text.count("\n", 0, position) + 1


def _check(content: dict[str, Any], where: str) -> None:
    """Raise ConfigError if values are nested too deeply, or a whole number is too large."""
    # a stack instead of recursion: the nesting may be what is wrong
    waiting: list[tuple[str, Any, int]] = [("", content, 0)]
    while waiting:
        key, item, depth = waiting.pop()
        if depth > MOST_NESTED:
            raise ConfigError(f"{where}: {key[:80]}: {_NESTING}")
        if isinstance(item, int) and not _SMALLEST <= item <= LARGEST:
            raise ConfigError(f"{where}: {key[:80]}: the number is too large; {_INTEGERS}")
        waiting.extend((name, child, depth + 1) for name, child in _children(key, item))


def _children(key: str, item: Any) -> Iterator[tuple[str, Any]]:
    """Yield the items of a table or list with their full keys."""
    if isinstance(item, dict):
        for name, child in item.items():
            yield f"{key}.{name}".removeprefix("."), child
    elif isinstance(item, list):
        for child in item:
            yield key, child
