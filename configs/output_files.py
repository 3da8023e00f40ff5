"""Writes files: they appear complete or not at all, and never in the place of a link's target.

A folder for results may hold links that its user has not made, as in an unpacked archive. A file
that is written there replaces such a link, and the file to which the link leads stays as it is. A
folder of the results that is a link is refused. The folder that the user names may be a link.
"""

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from rollerrig.configs.errors import ConfigError


@contextlib.contextmanager
def replaced(path: Path, suffix: str = "") -> Iterator[Path]:
    """Yield a temporary path next to `path`; at the end, its file replaces `path` in one step.

    After a failure the temporary file is removed. `suffix` is for writers that depend on the
    extension of a name. Raises ConfigError if `path` is a folder, a device or the like.
    """
    _check_replaceable(path)
    new = path.with_name(f".{path.name}.new{suffix}")
    # left by a process that was killed, or a link
    new.unlink(missing_ok=True)
    try:
        yield new
        new.replace(path)
    finally:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file in one step. Raises ConfigError as `replaced`, and OSError.

    What UTF-8 cannot hold (a name of a file in another encoding) is written as an escape.
    """
    with replaced(path) as new:
        new.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file in one step. Raises ConfigError as `replaced`, and OSError."""
    with replaced(path) as new:
        new.write_bytes(content)


def create(path: Path, buffering: int = -1) -> IO[bytes]:
    """Return a new empty file, for writing and reading, as a log that others read meanwhile.

    It replaces what is there. Raises ConfigError as `replaced`, and OSError.
    """
    _check_replaceable(path)
    path.unlink(missing_ok=True)
    return open(path, "x+b", buffering=buffering)


def make_folder(folder: Path, *names: str) -> Path:
    """Make a folder, and folders in it, and return the last one.

    Raises ConfigError if one of the inner folders is a link, and OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        folder = folder / name
        check_no_link(folder)
        folder.mkdir(exist_ok=True)
    return folder


def check_no_link(folder: Path) -> None:
    """Raise ConfigError if a folder for results, inside the folder of the user, is a link."""
    if folder.is_symlink():
        raise ConfigError(
            f"{folder}: is a link to {os.readlink(folder)}, and results are not written through a "
            "link; remove it, or give another folder"
        )


@contextlib.contextmanager
def writing(path: Path, remedy: str = "give another folder with --out") -> Iterator[None]:
    """Raise ConfigError if a file or folder cannot be written inside the block."""
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written: {error.strerror or error}; {remedy}"
        ) from None


def _check_replaceable(path: Path) -> None:
    """Raise ConfigError unless a file may replace what is there: nothing, a file, or a link."""
    try:
        mode = os.lstat(path).st_mode
    except OSError:
        return  # nothing is there, or writing shows the reason
    except ValueError:
        raise ConfigError(f"{path}: a path must not contain the character NUL") from None
    if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
        raise ConfigError(
            f"{path}: is a folder, a device or a pipe, and a file cannot replace it; give another name"
        )
