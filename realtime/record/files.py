"""Files that appear whole or not at all."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replaced(path: Path, suffix: str = "") -> Iterator[Path]:
    """Gives a place beside a file, for the file anew; it takes the old one's place in one step.

    Nothing is left of what failed. `suffix` is for writers that look at how a name ends.
    """
    new = path.with_name(f".{path.name}.new{suffix}")
    try:
        yield new
        new.replace(path)
    finally:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
