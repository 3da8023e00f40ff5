"""Where compiled kernels are kept from one process to the next, and what is said while numba compiles them.

Numba does not notice when a function that a cached one calls has changed, so the cache lives in a folder named after
this installation and all its sources that hold kernels or their structures: a changed source compiles afresh. The
folders used last are kept. A process locks its folder as long as it lives, and no other removes a locked one.
"""

import contextlib
import fcntl
import hashlib
import logging
import os
import shutil
import threading
import time
from pathlib import Path
from typing import Any

from rollerrig.configs.processes.without import without

with without("yaml"), without("scipy"):  # settings in a file, and whether scipy is too old
    import numba
from numba.core import caching, config, event
from numba.core.runtime.nrt import rtsys

log = logging.getLogger(__name__)
# numba fills this module with its settings when it loads it
settings: Any = config
_ROOMS = ("rig", "firmware_sim", "realtime", "wsp_interface")
_SEEN_BY_KERNELS, _SEEN_BY_NONE = ("signals.py", "state_type.py"), (Path(__file__).name,)
_KEPT, _KEPT_BYTES = 6, 200_000_000
PERIOD_S = 5.0


def _fingerprint(root: Path) -> str:
    """A hash of all that compiled code depends on: kernels, their structures in rig, and two tables."""
    digest = hashlib.sha256(f"{numba.__version__} {root}".encode())
    for path in sorted(path for room in _ROOMS for path in (root / room).rglob("*.py")):
        source = path.read_bytes()
        structures = b"NamedTuple" in source and root / "rig" in path.parents
        if path.name not in _SEEN_BY_NONE and (
            b"@kernel" in source or structures or path.name in _SEEN_BY_KERNELS
        ):
            digest.update(path.name.encode() + source)
    return digest.hexdigest()[:16]


def use() -> None:
    """Let numba keep what it compiles in the folder of these sources; without a writable home it finds its own."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rollerrig"
    folder = base / f"kernels-{_fingerprint(Path(__file__).resolve().parents[2])}"
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    settings.CACHE_DIR = str(folder)
    os.utime(folder)
    # open, and so locked, until the process ends
    fcntl.flock(os.open(folder, os.O_RDONLY), fcntl.LOCK_SH)
    if new:
        remove_old(base)


def remove_old(base: Path, kept: int = _KEPT, kept_bytes: int = _KEPT_BYTES) -> None:
    """Remove the folders of kernels in `base` that have not been used for longest, unless a process uses them."""
    folders = sorted(base.glob("kernels-*"), key=lambda path: path.stat().st_mtime, reverse=True)
    size = 0
    for number, path in enumerate(folders, start=1):
        size += sum(one.stat().st_size for one in path.rglob("*") if one.is_file())
        if number > kept or size > kept_bytes:
            with contextlib.suppress(OSError):
                file = os.open(path, os.O_RDONLY)
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(path, ignore_errors=True)
                finally:
                    os.close(file)


def is_compiled() -> bool:
    """Whether an earlier process has compiled these sources."""
    return any(Path(settings.CACHE_DIR).rglob("*.nbi"))


def has_compiled() -> bool:
    """Whether this process has compiled any."""
    return _compiling.done > 0


class Kept:
    """The cache of one kernel, opened when it is first called: most are called by other kernels only.

    Numba would first load all that compiling needs (`refresh`, 0.4 s), which code that has been compiled does not. That
    with a memory of its own (`counted`) needs the counters of references.
    """

    def __init__(self, function: Any, counted: bool) -> None:
        self._function, self._counted = function, counted

    def __getattr__(self, name: str) -> Any:
        if name == "_cache":
            self._cache = caching.FunctionCache(self._function)
            return self._cache
        return getattr(self._cache, name)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """What numba's own does, less the refresh."""
        if self._counted:
            rtsys.initialize(context)
        with without("scipy.linalg"):
            return self._cache._load_overload(signature, context)


class _Compiling(event.Listener):
    """Says at once that numba compiles, every few seconds how far it is, and when it has not for as long."""

    def __init__(self) -> None:
        self.done = self._open = 0
        self._begun_s = self._ended_s = 0.0

    def on_start(self, event: Any) -> None:
        self._open += 1
        with without("scipy.linalg"):
            import numba.np.arraymath  # noqa: F401, as numba would now
        if not self._begun_s:
            self._begun_s = time.monotonic()
            log.warning(
                "compiling the kernels, once after an installation or a change of them (1 to 2 minutes) ..."
            )
            threading.Thread(target=self._tell, name="compiling", daemon=True).start()

    def on_end(self, event: Any) -> None:
        self._open -= 1
        self.done += 1
        self._ended_s = time.monotonic()

    def _tell(self) -> None:
        time.sleep(PERIOD_S)
        while self._open or time.monotonic() - self._ended_s < PERIOD_S:
            log.warning(
                "compiling: %.0f s so far, %d kernels done",
                time.monotonic() - self._begun_s,
                self.done,
            )
            time.sleep(PERIOD_S)
        log.warning("compiled %d kernels in %.0f s", self.done, self._ended_s - self._begun_s)
        self._begun_s = 0.0


_compiling = _Compiling()
event.register("numba:compile", _compiling)
if not os.environ.get("NUMBA_CACHE_DIR"):
    with contextlib.suppress(OSError):
        use()
