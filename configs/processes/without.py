"""Imports of big packages without what they look for and this project never uses through them."""

import sys
from types import TracebackType
from typing import NamedTuple


class without(NamedTuple):  # noqa: N801
    """Let imports of a package fail inside the block, as if it were not installed; nothing where it is there already.

    python-can looks for asammdf, to read MF4 files (0.8 s of processor time, as that brings pandas; rollerrig asks
    asammdf itself), Arrow for pandas (0.4 s), numba for scipy.linalg, to multiply matrices in kernels (0.2 s, and none
    does).
    """

    package: str

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        """As the first finder of modules; it finds none."""
        if name == self.package:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    def __enter__(self) -> None:
        sys.meta_path.insert(0, self)

    def __exit__(
        self, kind: type | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        sys.meta_path.remove(self)
