"""Finds a configuration by its name among the packaged ones, or by path, and parses it.

`load("scenarios", "velim_a1")` and `load("scenarios", "folder/my.toml")` both work: the
first in any working directory, the second relative to it.
"""

import os
from pathlib import Path
from typing import Any

from rollerrig.configs import toml_text, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest

ROOT = Path(__file__).parent
# the folder of a kind that has the configurations for other vehicles than the coach
VEHICLES = "vehicles"
# what one configuration of a kind is called in messages
_SINGULAR = {
    "buses": "bus",
    "campaigns": "campaign",
    "couplers": "coupler",
    "criteria": "profile of criteria",
    "models": "extended model",
    "programmes": "test programme",
    "rigs": "rig",
    "scenarios": "scenario",
    "sequences": "sequence",
    "trains": "train",
    "vehicles": "vehicle",
    "wsp": "WSP configuration",
}


# earlier names of packaged configurations, by kind: they find the present one
_EARLIER_NAMES = {"adhesion": {"leaf_film": "wet_leaves", "wet": "wet_clean"}}


def names(kind: str) -> list[str]:
    """Return the names of the packaged configurations of a kind (a folder under configs/)."""
    return sorted(path.stem for path in (ROOT / kind).glob("*.toml"))


def names_of_vehicles(kind: str) -> list[str]:
    """Return the names of the packaged configurations of a kind for other vehicles than the coach.

    `names` does not list them: a command without names takes those of the coach. `find` finds them.
    """
    return sorted(path.stem for path in (ROOT / kind / VEHICLES).glob("*.toml"))


def find(kind: str, name: str, mentioned_in: Path | None = None) -> Path:
    """Return the file of a configuration. Raises ConfigError if there is none.

    `name` is the name of a packaged configuration, or an earlier name of it, or a path: it is a
    path if it ends in .toml or has a folder. A path is relative to the working directory. If
    nothing is there, it is relative to the folder of `mentioned_in`, the file that mentions it.
    """
    path = Path(name)
    if path.suffix == ".toml" or len(path.parts) > 1:
        candidates = [path]
        if mentioned_in:
            candidates.append(mentioned_in.parent / path)
        for candidate in candidates:
            # os.path, because Path raises an error for a name that is too long or contains NUL
            if os.path.isfile(candidate):
                return candidate
        packaged_names = [*names(kind), *names_of_vehicles(kind)]
        if not packaged_names:
            raise ConfigError(f"{name}: no such file; give the path of a TOML file")
        hint = nearest(path.stem, packaged_names, "Packaged")
        raise ConfigError(f"{name}: no such file{hint}; or give the path of a TOML file")
    present = _EARLIER_NAMES.get(kind, {}).get(name, name)
    for packaged in (ROOT / kind / f"{present}.toml", ROOT / kind / VEHICLES / f"{present}.toml"):
        if os.path.isfile(packaged):
            return packaged
    raise ConfigError(
        f"no {_SINGULAR.get(kind, kind)} is called '{name}'"
        f"{nearest(name, [*names(kind), *names_of_vehicles(kind)])}; "
        "or give the path of a TOML file"
    )


def parse(path: Path, within: Path | None = None) -> dict[str, Any]:
    """Return the content of a TOML file. Raises ConfigError with file, line and column.

    `within`: the folder to which the file belongs, see `user_files`.
    """
    return toml_text.parse(user_files.read_text(path, user_files.TOML, within), str(path))


def load(kind: str, name: str, mentioned_in: Path | None = None) -> tuple[dict[str, Any], Path]:
    """Return the content of a configuration, and its file (see `find`). Raises ConfigError."""
    path = find(kind, name, mentioned_in)
    return parse(path), path
