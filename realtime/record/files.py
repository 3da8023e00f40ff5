"""Files that appear whole or not at all, and what is said where they cannot be written."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from rollerrig.configs.errors import ConfigError


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


@contextlib.contextmanager
def writing(path: Path, mend: str = "give another folder with --out") -> Iterator[None]:
    """Raises ConfigError where what is written to a file or folder meanwhile cannot be."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}; {mend}") from None
