"""Files that appear whole or not at all."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replaced(path: Path, suffix: str = "") -> Iterator[Path]:
    """Gives a place beside a file, for the file anew; it takes the old one's place in one step.

    The place has the suffix of the file, or the one given. Nothing is left of what failed.
    """
    new = path.with_name(f".{path.stem}.new{suffix or path.suffix}")
    try:
        yield new
        new.replace(path)
    finally:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
