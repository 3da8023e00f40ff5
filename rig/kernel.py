"""How every numerical kernel of the project is compiled: cached, without the GIL, IEEE arithmetic.

No fastmath: a run repeats bit for bit. No function arguments: they never hit numba's cache. Numba
does not notice when a function that a cached one calls has changed, so the cache lives in a folder
named after all sources that hold kernels or their structures: a changed source compiles afresh.
"""

import contextlib
import hashlib
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numba
from numba.core import config as _config

# numba fills this module with its settings when it loads it
settings: Any = _config
# its published types do not know all options
_njit: Any = numba.njit
_ROOMS = ("rig", "firmware_sim", "realtime", "wsp_interface")
_SEEN_BY_KERNELS = ("signals.py", "state_type.py")
_KEPT = 24


def _fingerprint(root: Path) -> str:
    """A hash of all that compiled code depends on: kernels, their structures in rig, and two tables."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(path for room in _ROOMS for path in (root / room).rglob("*.py")):
        source = path.read_bytes()
        structures = b"NamedTuple" in source and root / "rig" in path.parents
        if b"@kernel" in source or structures or path.name in _SEEN_BY_KERNELS:
            digest.update(path.name.encode() + source)
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rollerrig"
    folder = base / f"kernels-{_fingerprint(Path(__file__).resolve().parent.parent)}"
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    if new:
        old = sorted(base.glob("kernels-*"), key=lambda path: path.stat().st_mtime)
        for path in old[:-_KEPT]:
            shutil.rmtree(path, ignore_errors=True)
    return folder


def is_compiled() -> bool:
    """Whether an earlier process has compiled these sources."""
    return any(Path(settings.CACHE_DIR).rglob("*.nbi"))


if not os.environ.get("NUMBA_CACHE_DIR"):
    # without a writable home numba finds a place of its own
    with contextlib.suppress(OSError):
        settings.CACHE_DIR = str(_cache_folder())

# nothing is allocated in a step, so numba need not count references to arrays: with fifty of them
# in the state that took twice the time of the physics, and much of the time to compile
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy",
                            # no kernel is handed to another as a function: none needs one for C
                            "no_cfunc_wrapper": True}
kernel = _njit(**_OPTIONS, _nrt=False)
# for what every step calls with the whole state: its hundreds of array fields would be copied for
# each call; the arithmetic is the same to the last bit
kernel_inlined = _njit(**_OPTIONS, _nrt=False, forceinline=True)

# for batch work that makes arrays of its own; a step never calls these
kernel_with_memory = _njit(**_OPTIONS)


def written(name: str, lines: Sequence[str], file: str, module: str, names: Mapping[str, Any]) -> Any:
    """The kernel `name` from lines that a table gave; it is cached as if it stood in `file`."""
    space: dict[str, Any] = {"__name__": module, **names}
    exec(compile("\n".join(lines), file, "exec"), space)
    return kernel(space[name])


def constructor(structure: Any, arguments: str, fields: Iterable[str], counted: bool = False, **names: Any) -> Any:
    """A kernel that makes a named tuple: of its arguments, an expression for each field.

    `counted`: with references to arrays counted, which numba wants for arrays at an address.
    """
    space: dict[str, Any] = {"structure": structure, **names}
    exec(f"def made({arguments}):\n    return structure({', '.join(fields)})", space)
    return _njit(nogil=True, _nrt=counted, forceinline=True)(space["made"])


def seeing(structure: Any, places: Iterable[slice | None]) -> Any:
    """A kernel that views a flat buffer as a named tuple, `views` for compiled code; None stays None."""
    return constructor(structure, "buffer", ("None" if place is None else f"buffer[{place.start}:{place.stop}]"
                                             for place in places))
