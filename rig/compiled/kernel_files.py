"""The files of one kernel in the folder of compiled kernels, for this user alone.

Numba makes them with the permissions that new files of the process have. Here each file and folder
is closed to other users from its first moment. Numba also names their folder after the place where
the product is installed; here it is named after the place of the source in the product, so that
compiled kernels may be moved.
"""

import contextlib
import functools
import hashlib
import logging
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from rollerrig.rig.compiled import kernel_cache, numba_import  # noqa: F401  the first import of numba

# isort: split
from numba.core import caching

log = logging.getLogger(__name__)


@functools.cache
def _warn() -> None:
    """Warn, once in a process, that each start compiles again."""
    log.warning(
        "compiled kernels are not kept, so that each start compiles them again: %s; "
        "or set XDG_CACHE_HOME to a folder that only you can write to",
        kernel_cache.refusal(),
    )


class _Locator(caching._CacheLocator):
    """States where the files of a kernel are, and whether its source is the same."""

    def __init__(self, function: Any, source_file: str) -> None:
        self._py_file = source_file  # numba names it in a warning
        self._line = function.__code__.co_firstlineno
        source = Path(source_file).resolve()
        if source.is_relative_to(kernel_cache.ROOT):
            folder = "-".join(source.relative_to(kernel_cache.ROOT).parent.parts)
        else:
            folder = self.get_suitable_cache_subpath(source_file)
        self._folder = (kernel_cache.folder() or Path()) / folder

    def get_cache_path(self) -> str:
        """Return the folder of the files."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Return a hash of the source: a copy of the file may have another time."""
        return hashlib.sha256(Path(self._py_file).read_bytes()).hexdigest()

    def get_disambiguator(self) -> str:
        """Return what distinguishes functions of one name in a file: the line."""
        return str(self._line)

    def ensure_cache_path(self) -> None:
        """Make the folder."""
        kernel_cache.make_private(self._folder)

    @classmethod
    def from_function(cls, function: Any, source_file: str) -> Any:
        """Return the locator of a function, None if it has no source file."""
        return cls(function, source_file) if os.path.exists(source_file) else None


class _Implementation(caching.CompileResultCacheImpl):
    _locator_classes: Any = (_Locator,)


class _Files(caching.IndexDataCacheFile):
    @contextlib.contextmanager
    def _open_for_write(self, path: str) -> Iterator[IO[bytes]]:
        """Open a file that replaces `path` when it is written; only this user can open it."""
        with tempfile.NamedTemporaryFile(
            dir=self._cache_path, prefix="writing-", delete=False
        ) as file:
            try:
                yield file
                file.flush()
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise


class KernelFiles(caching.FunctionCache):
    """Numba's cache of one kernel in the folder of compiled kernels.

    Where kernels are not kept, it finds nothing, writes nothing, and warns once.
    """

    _impl_class = _Implementation

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        locator = self._impl.locator
        self._cache_file = _Files(
            locator.get_cache_path(), self._impl.filename_base, locator.get_source_stamp()
        )
        if kernel_cache.folder() is None:
            self.disable()
            _warn()

    def _load_overload(self, signature: Any, context: Any) -> Any:
        # OSError: root has compiled it for itself only
        with contextlib.suppress(OSError):
            return super()._load_overload(signature, context)
        return None

    def _save_overload(self, signature: Any, compiled: Any) -> None:
        # OSError: the disk is full, or the folder belongs to root
        with contextlib.suppress(OSError):
            super()._save_overload(signature, compiled)
