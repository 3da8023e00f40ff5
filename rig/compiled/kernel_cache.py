"""The folder in which compiled kernels are kept from one process to the next.

Numba does not notice that a function which a cached kernel calls has changed. Therefore the folder
is named after a hash of this installation, of all its sources that affect compiled code, of the
number of axles and of the equipment: a changed source leads to another folder, and everything is
compiled again.

A kept kernel is a program: who can write into the folder can run code as its user. So the folder is
used only if it belongs to this user or to root, and no other user may write into it.

The folders used most recently are kept. A process holds a shared lock on its folder as long as it
lives, and no process removes a locked folder.
"""

import contextlib
import fcntl
import hashlib
import os
import shutil
import stat
from pathlib import Path

from rollerrig.configs.vehicle import AXLES, COACH_AXLES, EQUIPMENT
from rollerrig.rig.compiled.numba_import import numba, settings

# folders of the product that contain kernels
_ROOMS = ("rig", "firmware_sim", "realtime", "wsp_interface")
# files without kernels whose content is compiled into kernels
_READ_BY_KERNELS = ("signals.py", "state_type.py", "generated.py", "variants.py", "c_function.py")
# files of this room that mention kernels, but do not change their code
_NOT_READ_BY_KERNELS = (
    "numba_import.py",
    "kernel_cache.py",
    "lazy_cache.py",
    "compile_progress.py",
    "compile_lock.py",
)

_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH

# limits on old folders: their number and their total size
FOLDERS_KEPT = 6
BYTES_KEPT = 200_000_000


def _fingerprint(root: Path) -> str:
    """Return a hash of all that compiled code depends on: numba, the installation, the sources."""
    digest = hashlib.sha256(f"{numba.__version__} {root} {AXLES} {sorted(EQUIPMENT)}".encode())
    paths = sorted(path for room in _ROOMS for path in (root / room).rglob("*.py"))
    for path in paths:
        source = path.read_bytes()
        if _affects_compiled_code(path, source, root):
            digest.update(path.name.encode() + source)
    return digest.hexdigest()[:16]


def _affects_compiled_code(path: Path, source: bytes, root: Path) -> bool:
    """Whether a file holds kernels, or structures that kernels take as arguments."""
    if path.name in _NOT_READ_BY_KERNELS:
        return False
    if path.name in _READ_BY_KERNELS or b"@kernel" in source:
        return True
    return b"NamedTuple" in source and root / "rig" in path.parents


def use() -> None:
    """Make numba keep compiled kernels in the folder of these sources, and locks the folder.

    Raises OSError where the home folder is not writable, or where the folder belongs to another
    user; numba then chooses a folder itself.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rollerrig"
    folder = base / f"kernels-{_fingerprint(Path(__file__).resolve().parents[2])}"
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    for place in (base, folder):
        _keep_others_out(place)
    settings.CACHE_DIR = str(folder)
    os.utime(folder)  # marks it as used now
    # the descriptor stays open, and the folder locked, until the process exits
    fcntl.flock(os.open(folder, os.O_RDONLY), fcntl.LOCK_SH)
    if is_new:
        remove_old(base)


def _keep_others_out(place: Path) -> None:
    """Let no other user write into a folder. Raises PermissionError if it belongs to another."""
    state = place.stat()
    if state.st_uid not in (0, os.geteuid()):
        raise PermissionError(f"{place} belongs to another user")
    if state.st_mode & _WRITABLE_BY_OTHERS:
        place.chmod(stat.S_IMODE(state.st_mode) & ~_WRITABLE_BY_OTHERS)


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


def folder() -> Path | None:
    """Return the folder of compiled kernels, None where numba chooses it."""
    return Path(settings.CACHE_DIR) if settings.CACHE_DIR else None


def is_compiled() -> bool:
    """Return whether an earlier process has compiled these sources."""
    here = folder()
    return here is not None and any(here.rglob("*.nbi"))


def use_folder_of_user(folder: Path) -> None:
    """Make numba keep compiled kernels in a folder that the user has chosen.

    The kernels of other numbers of axles, or with further equipment, are in a folder inside: numba
    would load kernels that were compiled for arrays of another size.
    """
    if AXLES != COACH_AXLES or EQUIPMENT:
        settings.CACHE_DIR = str(folder / "-".join([f"axles_{AXLES}", *sorted(EQUIPMENT)]))


if os.environ.get("NUMBA_CACHE_DIR"):
    use_folder_of_user(Path(os.environ["NUMBA_CACHE_DIR"]))
else:
    with contextlib.suppress(OSError):
        use()
