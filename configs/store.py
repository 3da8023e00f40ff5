"""Finds a configuration by bare name among the packaged ones, or by path, and parses it.

`load("scenarios", "velim_a1")` and `load("scenarios", "my/own.toml")` both work, from any folder.
"""

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
    """The file of a configuration: a path (also relative to the file that names it), or a packaged one.

    Raises ConfigError naming what is there.
    """
    given = Path(name)
    if given.suffix == ".toml" or len(given.parts) > 1:
        for candidate in [given] + ([beside.parent / given] if beside else []):
            if _is_file(candidate):
                return candidate
        raise ConfigError(f"{name}: no such file; give a path to a TOML file or one of: "
                          f"{', '.join(names(kind))}")
    packaged = ROOT / kind / f"{name}.toml"
    if not _is_file(packaged):
        raise ConfigError(f"no {kind.rstrip('s')} is called '{name}'{nearest(name, names(kind))}; "
                          "or give the path of a TOML file")
    return packaged


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False  # a name too long, or with a NUL: no file is called so


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
