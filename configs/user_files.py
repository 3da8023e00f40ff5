"""Opens the files that users give: the only place of the product that does.

A file of a user has to be a regular file: a device, a pipe or a socket can be endless, or can act
when it is opened. It has to be at most as large as its kind allows, so that a wrong file cannot
fill the memory. A file that belongs to a folder (a dataset, a run) has to be in that folder: a
folder of another person must not show a file of the reader by a link.
"""

import json
import os
import stat
from pathlib import Path
from typing import IO, Any, NamedTuple

from rollerrig.configs.errors import ConfigError

_MB = 1_000_000

# O_NONBLOCK: a pipe in the place of the file must not block. O_NOCTTY: a terminal must not become
# the terminal of this process.
_OPEN_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY

_NODES = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


class Kind(NamedTuple):
    """A kind of file: its name in messages, and its largest size."""

    name: str
    most_bytes: int


# The limits are far above what the program needs, and far below the memory of a small machine.
# TOML and DBC are parsed in Python, which takes seconds for a megabyte.
TOML = Kind("a TOML file", 1 * _MB)
KEY = Kind("a key of sealed data", 16 * _MB)
JSON = Kind("a JSON file", 32 * _MB)
NOTE = Kind("a note", _MB // 10)
PROFILE = Kind("a profile", 2 * _MB)
MESSAGES = Kind("a description of CAN messages", 2 * _MB)
CSV = Kind("a CSV file", 128 * _MB)
PARQUET = Kind("a Parquet file", 2_000 * _MB)
TAIL = Kind("the tail of a recording", 2_000 * _MB)
MDF = Kind("an MDF file", 1_000 * _MB)
ROSBAG = Kind("a file of a rosbag", 2_000 * _MB)
EVENTS = Kind("the events of a run", 512 * _MB)
CAN_LOG = Kind("a log of CAN frames", 512 * _MB)
RRD = Kind("a Rerun recording", 20_000 * _MB)
PAGE = Kind("a page", 8 * _MB)
FMU = Kind("an FMU", 256 * _MB)


def check(path: Path, kind: Kind, within: Path | None = None, remedy: str = "") -> Path:
    """Return the path of a file after all checks, for a library that opens it by its name.

    `within`: the folder to which the file belongs. `remedy`: the end of the message if there is no
    such file. Raises ConfigError.
    """
    _check_place(path, within)
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        raise _unreadable(path, error, remedy) from None
    _check_status(path, status, kind)
    return path


def open_binary(path: Path, kind: Kind, within: Path | None = None, remedy: str = "") -> IO[bytes]:
    """Return an open file after all checks; the arguments are those of `check`.

    Raises ConfigError.
    """
    # before it is opened, because some devices act when they are opened
    check(path, kind, within, remedy)
    try:
        file = os.fdopen(os.open(path, _OPEN_FLAGS), "rb")
    except OSError as error:
        raise _unreadable(path, error, remedy) from None
    try:
        # the file may have been replaced in the meantime
        _check_status(path, os.fstat(file.fileno()), kind)
    except ConfigError:
        file.close()
        raise
    return file


def read_bytes(path: Path, kind: Kind, within: Path | None = None, remedy: str = "") -> bytes:
    """Return the content of a file; the arguments are those of `check`. Raises ConfigError."""
    with open_binary(path, kind, within, remedy) as file:
        try:
            content = file.read(kind.most_bytes + 1)
        except OSError as error:
            raise _unreadable(path, error, remedy) from None
    # files of the kernel have the size 0, and a file may grow
    if len(content) > kind.most_bytes:
        raise _too_large(path, kind, f"more than {_size(kind.most_bytes)}")
    return content


def read_text(
    path: Path,
    kind: Kind,
    within: Path | None = None,
    remedy: str = "",
    encoding: str = "utf-8",
) -> str:
    """Return the text of a file; the other arguments are those of `check`. Raises ConfigError.

    All ends of lines become "\\n".
    """
    content = read_bytes(path, kind, within, remedy)
    return decode(path, content, encoding)


def decode(path: Path, content: bytes, encoding: str) -> str:
    """Return the text of the content of a file; all ends of lines become "\\n".

    `path` is for the message. Raises ConfigError if the content is not text of this encoding.
    """
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: cannot be read as text ({encoding}): {error}; save it in UTF-8"
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path, within: Path | None = None, remedy: str = "") -> Any:
    """Return the content of a JSON file; the arguments are those of `check`. Raises ConfigError."""
    text = read_text(path, JSON, within, remedy)
    try:
        return parse_json(text)
    except ValueError as error:
        raise ConfigError(f"{path}: not valid JSON: {error}") from None


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text. Raises ValueError, also for one that is nested deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("its lists and objects are nested too deeply") from None


def _check_place(path: Path, within: Path | None) -> None:
    """Raise ConfigError if a file that belongs to a folder is outside of it."""
    if within is None:
        return
    try:
        place = path.resolve()
        inside = place.is_relative_to(within.resolve())
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: a circle of links
        raise _unreadable(path, error, "") from None
    if not inside:
        raise ConfigError(
            f"{path}: is outside of its folder (it leads to {place}); only files in {within} are "
            "read: copy the file into the folder"
        )


def _check_status(path: Path, status: os.stat_result, kind: Kind) -> None:
    """Raise ConfigError if a file is not a regular file, or larger than its kind allows."""
    for is_node, name in _NODES:
        if is_node(status.st_mode):
            raise ConfigError(f"{path}: is {name}, and {kind.name} is needed; give a regular file")
    if status.st_size > kind.most_bytes:
        raise _too_large(path, kind, _size(status.st_size))


def _too_large(path: Path, kind: Kind, size: str) -> ConfigError:
    return ConfigError(
        f"{path}: has {size}; {kind.name} may have at most {_size(kind.most_bytes)}: is it the "
        "right file? If so, split it"
    )


def _unreadable(path: Path, error: Exception, remedy: str) -> ConfigError:
    """Return the error for a file that cannot be opened."""
    reason = getattr(error, "strerror", None) or str(error)
    if isinstance(error, FileNotFoundError):
        reason = "no such file"
    elif isinstance(error, ValueError):
        # the path itself: the system knows no path with this character
        reason = "a path must not contain the character NUL"
    else:
        reason = f"cannot be read: {reason}"
    return ConfigError(f"{path}: {reason}" + (f"; {remedy}" if remedy else ""))


def _size(count: int) -> str:
    """Return a number of bytes as text."""
    if count < _MB:
        return f"{count / 1000:.4g} kB"
    return f"{count / _MB:.4g} MB"
