"""The folder in which compiled kernels are kept from one process to the next.

    ~/.cache/rollerrig/kernels-0123456789abcdef/...

Numba does not notice that a function which a cached kernel calls has changed. Therefore the folder
is named after a hash of all sources that affect compiled code: a changed source leads to another
folder, and everything is compiled again. The same kernels serve all vehicles. Where the product is
installed does not matter, so the folder may be moved to another machine with its sources.

A kept kernel is a program: who can write into the folder can run code as its user. So each level,
from the root of the file system down to each file, must belong to this user or to root, and no
other user may write to it. A level above the folder that others may write to is refused, and then
nothing is kept. A folder of kernels that was open to others is removed with all that is in it.

The folders used most recently are kept. A process holds a shared lock on its folder as long as it
lives, and no process removes a locked folder.
"""

import contextlib
import fcntl
import hashlib
import os
import re
import shlex
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rollerrig.rig.compiled.numba_import import numba

# the folder of the product
ROOT = Path(__file__).resolve().parents[2]
# folders of the product that contain kernels, or constants that kernels use
_ROOMS = ("configs", "rig", "firmware_sim", "realtime", "wsp_interface")
_COMPILED = "rig/compiled/"
# files of this room that do not change compiled code
_NOT_READ_BY_KERNELS = (
    "numba_import.py",
    "kernel_cache.py",
    "kernel_files.py",
    "lazy_cache.py",
    "compile_progress.py",
    "compile_lock.py",
    "device.py",
)
# an import from the product: the module, and the names in it, which may be modules themselves
_IMPORT = re.compile(rb"^from rollerrig\.([\w.]+) import (\([^)]*\)|.*)", re.MULTILINE)

_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_ONLY_FOR_USER = 0o700

# limits on the folders of older sources: the number of all folders and their total size
FOLDERS_KEPT = 6
BYTES_KEPT = 200_000_000


class UnsafeFolderError(PermissionError):
    """Another user could put code into the compiled kernels; the text names the place."""


# --- the name of the folder ---


def _fingerprint() -> str:
    """Return a hash of all that compiled code depends on: numba and the sources."""
    digest = hashlib.sha256(numba.__version__.encode())
    for name, source in sorted(sources().items()):
        digest.update(name.encode() + source)
    return digest.hexdigest()[:16]


def sources() -> dict[str, bytes]:
    """Return the sources that compiled code depends on, by their path in the product.

    These are files with kernels, files from which they import constants, files with named tuples,
    which kernels take as arguments, and the files that decide how kernels are compiled.
    """
    product = {}
    for room in _ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            product[path.relative_to(ROOT).as_posix()] = path.read_bytes()
    found: set[str] = set()
    for name, source in product.items():
        if b"@kernel" in source:
            found.add(name)
            found.update(_imported_by(source))
        elif name.startswith(_COMPILED) or (name.startswith("rig/") and b"NamedTuple" in source):
            found.add(name)
    found -= {_COMPILED + name for name in _NOT_READ_BY_KERNELS}
    return {name: product[name] for name in found & product.keys()}


def _imported_by(source: bytes) -> Iterator[str]:
    """Yield the path of each file that a source may import, and of some that do not exist."""
    for module, names in _IMPORT.findall(source):
        folder = module.decode().replace(".", "/")
        yield f"{folder}.py"
        for name in re.findall(r"\w+", names.decode()):
            yield f"{folder}/{name}.py"


# --- who may write ---


def _belongs_to_another(state: os.stat_result) -> bool:
    return state.st_uid not in (0, os.geteuid())


def check_levels(folder: Path) -> None:
    """Raise UnsafeFolderError if another user could replace this folder or one above it.

    A folder such as /tmp, in which each user may replace only what belongs to him, is allowed. A
    symbolic link is followed if it belongs to this user or to root. Levels that do not exist are
    not checked.
    """
    named = folder.absolute()
    real = folder.resolve()
    for level in dict.fromkeys((*reversed(named.parents), named, *reversed(real.parents), real)):
        try:
            state = level.lstat()
        except FileNotFoundError:
            continue
        if _belongs_to_another(state):
            raise UnsafeFolderError(f"{level} belongs to another user")
        is_open = state.st_mode & _WRITABLE_BY_OTHERS and not state.st_mode & stat.S_ISVTX
        if is_open and not stat.S_ISLNK(state.st_mode):
            raise UnsafeFolderError(
                f"other users may write to {level}; if nobody else needs to, "
                f"close it with: chmod go-w {shlex.quote(str(level))}"
            )


def _is_private(place: Path) -> bool:
    """Return whether a file, or a folder with all in it, was out of reach of other users."""
    try:
        state = place.lstat()
    except FileNotFoundError:
        # another process has replaced a file
        return True
    if _belongs_to_another(state) or state.st_mode & _WRITABLE_BY_OTHERS:
        return False
    if stat.S_ISDIR(state.st_mode):
        return all(_is_private(inside) for inside in place.iterdir())
    # a link could lead out of the folder
    return stat.S_ISREG(state.st_mode)


def _discard(folder: Path) -> None:
    """Remove a folder that was open to others. Raises UnsafeFolderError if something stays."""
    if folder.is_symlink():
        folder.unlink()
    shutil.rmtree(folder, ignore_errors=True)
    if os.path.lexists(folder):
        raise UnsafeFolderError(f"{folder} was open to other users; remove it")


def make_private(folder: Path) -> None:
    """Make a folder and the missing ones above it, each for this user alone."""
    for level in (*reversed(folder.parents), folder):
        # the mode is given when the folder is made: there is no moment in which it is open
        if not level.is_dir():
            level.mkdir(_ONLY_FOR_USER, exist_ok=True)


# --- the folder of this process ---


class Choice(NamedTuple):
    """Where kernels are kept: `folder` is None if nowhere, and `refusal` states why."""

    folder: Path | None
    refusal: str = ""


def choose() -> Choice:
    """Return the folder of these sources; make it, and lock it."""
    try:
        base = _base()
        folder = base / f"kernels-{_fingerprint()}"
        if not _is_private(folder):
            _discard(folder)
        is_new = not folder.exists()
        make_private(folder)
        with contextlib.suppress(PermissionError):  # a folder of root, for all users
            os.utime(folder)  # marks it as used now
        # the descriptor stays open, and the folder locked, until the process exits
        fcntl.flock(os.open(folder, os.O_RDONLY), fcntl.LOCK_SH)
    # RuntimeError: the user has no home folder
    except (OSError, RuntimeError) as error:
        return Choice(None, str(error))
    if is_new:
        remove_old(base)
    return Choice(folder)


def _base() -> Path:
    """Return the folder in which the folders of kernels are, after checking it.

    Raises UnsafeFolderError, other errors of OSError, and RuntimeError.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        base = Path(chosen)
    else:
        cache = os.environ.get("XDG_CACHE_HOME")
        base = (Path(cache) if cache else Path.home() / ".cache") / "rollerrig"
        check_levels(base.parent)
        make_private(base)
        state = base.stat()
        if state.st_mode & _WRITABLE_BY_OTHERS and not _belongs_to_another(state):
            for folder in base.glob("kernels-*"):
                _discard(folder)
            base.chmod(_ONLY_FOR_USER)
    check_levels(base)
    # a link on the way that changes later has no effect
    return base.resolve()


def remove_old(base: Path, folders_kept: int = FOLDERS_KEPT, bytes_kept: int = BYTES_KEPT) -> None:
    """Remove the least recently used folders of `base` beyond these limits, except locked ones."""
    folders = sorted(base.glob("kernels-*"), key=lambda path: path.stat().st_mtime, reverse=True)
    size = 0
    for number, folder in enumerate(folders, start=1):
        size += sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        if number > folders_kept or size > bytes_kept:
            _remove_unless_locked(folder)


def _remove_unless_locked(folder: Path) -> None:
    # OSError: a process uses the folder, or another process removes it at the same time
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(descriptor)


_chosen = choose()


def folder() -> Path | None:
    """Return the folder of compiled kernels, None where nothing is kept (see `refusal`)."""
    return _chosen.folder


def refusal() -> str:
    """Return why this process keeps no compiled kernels; "" if it keeps them."""
    return _chosen.refusal


def is_compiled() -> bool:
    """Return whether an earlier process has compiled these sources."""
    here = folder()
    return here is not None and any(here.rglob("*.nbi"))
