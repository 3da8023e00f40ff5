"""Finds a configuration by bare name among the packaged ones, or by path, and parses it.

`load("scenarios", "velim_a1")` and `load("scenarios", "my/own.toml")` both work, from any folder.
"""

import os
import tomllib
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest

ROOT = Path(__file__).parent


def names(kind: str) -> list[str]:
    """Names of the packaged configurations of a kind (a folder under configs/)."""
    return sorted(path.stem for path in (ROOT / kind).glob("*.toml"))


def find(kind: str, name: str, beside: Path | None = None) -> Path:
    """The file of a packaged configuration, or a path (also beside the file that names it). Raises ConfigError."""
    given = Path(name)
    # of os.path: no error for a name too long or with a NUL
    if given.suffix == ".toml" or len(given.parts) > 1:
        for candidate in [given] + ([beside.parent / given] if beside else []):
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
    """The content of a TOML file. Raises ConfigError with file, line and column."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None


def load(kind: str, name: str, beside: Path | None = None) -> tuple[dict[str, Any], Path]:
    """Find and parse: the content and where it came from."""
    path = find(kind, name, beside)
    return parse(path), path
