"""Writes files: they appear complete or not at all, and never in the place of a link's target.

A folder for results may hold links that its user has not made, as in an unpacked archive. A file
that is written there replaces such a link, and the file to which the link leads stays as it is. A
folder of the results that is a link is refused. The folder that the user names may be a link.
"""

import contextlib
import errno
import os
import secrets
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from rollerrig.configs.errors import ConfigError

_NAME_BYTES = 8  # random part of the name of a new file
_PERMISSIONS = 0o666  # of a new file, less the umask
# a file system without files without a name: also a folder that cannot be opened for writing
_NO_FILES_WITHOUT_NAME = (errno.EOPNOTSUPP, errno.EISDIR, errno.EINVAL)


@contextlib.contextmanager
def replaced(path: Path, suffix: str = "") -> Iterator[Path]:
    """Yield a path to write to; at the end, what was written replaces `path` in one step.

    After a failure nothing is left. `suffix` is for writers that depend on the extension of a name.
    Raises ConfigError if `path` is a folder, a device or the like, or if another program has
    replaced the new file.

    The yielded path leads to an open file of this process, and not into the folder: other users may
    write there, and could put a link in the place of a file before a writer opens it by its name.
    """
    _check_replaceable(path)
    new = path.with_name(f".{path.name}.{secrets.token_hex(_NAME_BYTES)}.new")
    descriptor, has_name = _new_file(new)
    try:
        with _with_suffix(place_of(descriptor), suffix) as place:
            yield place
        if not has_name:
            # with a descriptor Python calls linkat(), which follows the link in /proc
            os.link(place_of(descriptor), new, src_dir_fd=descriptor)
            has_name = True
        if not os.path.samestat(os.fstat(descriptor), os.lstat(new)):
            raise ConfigError(
                f"{path}: another program has replaced the new file while it was written; give a "
                "folder to which nobody else may write"
            )
        new.replace(path)
    except OSError as error:
        # an error while writing names no file; an error while opening names the path in /proc
        error.filename = str(path)
        raise
    finally:
        os.close(descriptor)
        if has_name:
            with contextlib.suppress(OSError):
                new.unlink(missing_ok=True)


def place_of(descriptor: int) -> Path:
    """Return a path that leads to an open file of this process, whatever happens in its folder."""
    return Path(f"/proc/self/fd/{descriptor}")


def _new_file(path: Path) -> tuple[int, bool]:
    """Return the descriptor of a new file in the folder of a path, and whether it has that name.

    Without a name it disappears with its process, if that is killed. Not every file system has such
    files.
    """
    flags = os.O_RDWR | os.O_CLOEXEC
    try:
        return os.open(path.parent, flags | os.O_TMPFILE, _PERMISSIONS), False
    except OSError as error:
        if error.errno not in _NO_FILES_WITHOUT_NAME:
            raise
    return os.open(path, flags | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, _PERMISSIONS), True


@contextlib.contextmanager
def _with_suffix(place: Path, suffix: str) -> Iterator[Path]:
    """Yield a path that ends with a suffix and leads to a place: a link in a private folder."""
    if not suffix:
        yield place
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder, f"new{suffix}")
        link.symlink_to(place)
        yield link


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
