"""Imports of large packages without packages that they look for and that rollerrig does not use."""

import sys
from types import TracebackType
from typing import NamedTuple


class without(NamedTuple):  # noqa: N801
    """Lets imports of a package fail inside the block, as if it were not installed.

    It has no effect if the package is imported already. It saves processor time at the start of a
    program: python-can looks for asammdf to read MF4 files, which imports pandas (0.8 s; rollerrig
    imports asammdf itself where it needs it). Arrow looks for pandas (0.4 s). Numba looks for
    scipy.linalg to multiply matrices in kernels, and no kernel does (docs/compiled_kernels.md).
    """

    package: str

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        """Is called by `import` before all other finders of modules; it finds no module."""
        if name == self.package:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    def __enter__(self) -> None:
        sys.meta_path.insert(0, self)

    def __exit__(
        self, kind: type | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        sys.meta_path.remove(self)
