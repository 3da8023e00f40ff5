"""Combinations of brakes: a plan has a campaign for each, in a folder of its name.

A train whose special brakes may be inhibited needs a brake model for each combination.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path

from rollerrig.configs import store, table, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, write_text, writing
from rollerrig.configs.vehicle import EQUIPMENT_KEYS

TABLE = "combinations"
# key of one [combinations.NAME]
ISOLATES = "isolates"
FILE = "combinations.json"
# a name is that of a folder
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}", re.ASCII)


def read(plan: str) -> dict[str, tuple[str, ...]]:
    """Return the combinations of a plan, and the equipment that each isolates.

    `plan` is its name or path. Raises ConfigError.
    """
    content, path = store.load("campaigns", plan)
    given = content.get(TABLE, {})
    if not isinstance(given, dict):
        raise ConfigError(f"{path} [{TABLE}]: must be a table with a table for each combination")
    found = {}
    for name, entry in given.items():
        at = f"{path} [{TABLE}.{name}]"
        if not NAME.fullmatch(name):
            raise ConfigError(
                f"{at}: its name is that of a folder; allowed are letters, digits, - and _, at most 40"
            )
        table.known(entry, (ISOLATES,), lambda key, at=at: at)  # type: ignore[misc]
        found[name] = _equipment(entry.get(ISOLATES), at)
    return found


def _equipment(given: object, at: str) -> tuple[str, ...]:
    """Return the names of a list of equipment. Raises ConfigError."""
    if not isinstance(given, list):
        raise ConfigError(
            f'{at}: {ISOLATES} = {given!r}; give a list, as ["magnetic_track_brake"], or [] if all '
            "brakes act"
        )
    for name in given:
        if name not in EQUIPMENT_KEYS:
            raise ConfigError(f"{at}: {name!r}{table.nearest(str(name), EQUIPMENT_KEYS)}")
    return tuple(given)


def isolating(equipment: Iterable[str]) -> tuple[str, ...]:
    """Return what isolates equipment of a vehicle, in the form of `--set`."""
    return tuple(f"{name}.{EQUIPMENT_KEYS[name]}=[]" for name in equipment)


def claim(out: Path, names: tuple[str, ...]) -> None:
    """Create the folder of these combinations, or check that it has them. Raises ConfigError."""
    before = names_in(out)
    if before not in ((), names):
        raise ConfigError(
            f"{out}: has the combinations {', '.join(before)}; give a new folder with --out, or "
            "remove it"
        )
    if (out / "plan.json").exists():
        raise ConfigError(
            f"{out}: has the results of a plan without combinations; give a new folder with --out"
        )
    with writing(out):
        make_folder(out)
        write_text(out / FILE, json.dumps({TABLE: names}))


def names_in(folder: Path) -> tuple[str, ...]:
    """Return the names of the combinations in a folder; none if it is one campaign.

    Raises ConfigError.
    """
    if not (folder / FILE).is_file():
        return ()
    content = user_files.read_json(folder / FILE, within=folder)
    names = content.get(TABLE) if isinstance(content, dict) else None
    # a file of a colleague leads to no other folder
    if not isinstance(names, list) or not all(NAME.fullmatch(str(name)) for name in names):
        raise ConfigError(f"{folder / FILE}: has no list of combinations; repeat its campaign")
    return tuple(names)
