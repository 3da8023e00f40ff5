"""Files that appear complete or not at all, and the error where they cannot be written."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from rollerrig.configs.errors import ConfigError


@contextlib.contextmanager
def replaced(path: Path, suffix: str = "") -> Iterator[Path]:
    """Yield a temporary path next to `path`; at the end, its file replaces `path` in one step.

    After a failure the temporary file is removed. `suffix` is for writers that depend on the
    extension of a name.
    """
    new = path.with_name(f".{path.name}.new{suffix}")
    try:
        yield new
        new.replace(path)
    finally:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)


@contextlib.contextmanager
def writing(path: Path, remedy: str = "give another folder with --out") -> Iterator[None]:
    """Raise ConfigError if a file or folder cannot be written inside the block."""
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written: {error.strerror or error}; {remedy}"
        ) from None
