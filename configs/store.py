"""Finds a configuration by its name among the packaged ones, or by path, and parses it.

`load("scenarios", "velim_a1")` and `load("scenarios", "my/own.toml")` both work in any folder.
"""

import os
import tomllib
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest

ROOT = Path(__file__).parent


def names(kind: str) -> list[str]:
    """Returns the names of the packaged configurations of a kind (a folder under configs/)."""
    return sorted(path.stem for path in (ROOT / kind).glob("*.toml"))


def find(kind: str, name: str, beside: Path | None = None) -> Path:
    """Returns the file of a packaged configuration, or of a path.

    A path is also looked up in the folder of `beside`, the file that mentions it. Raises ConfigError.
    """
    given = Path(name)
    if given.suffix == ".toml" or len(given.parts) > 1:
        candidates = [given]
        if beside:
            candidates.append(beside.parent / given)
        for candidate in candidates:
            # os.path, because Path raises an error for a name that is too long or contains NUL
            if os.path.isfile(candidate):
                return candidate
        raise ConfigError(
            f"{name}: no such file; give a path to a TOML file or one of: {', '.join(names(kind))}"
        )
    packaged = ROOT / kind / f"{name}.toml"
    if not os.path.isfile(packaged):
        raise ConfigError(
            f"no {kind.rstrip('s')} is called '{name}'{nearest(name, names(kind))}; "
            "or give the path of a TOML file"
        )
    return packaged


def parse(path: Path) -> dict[str, Any]:
    """Returns the content of a TOML file. Raises ConfigError with file, line and column."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None


def load(kind: str, name: str, beside: Path | None = None) -> tuple[dict[str, Any], Path]:
    """Returns the content of a configuration, and its file. Raises ConfigError."""
    path = find(kind, name, beside)
    return parse(path), path
