"""The adhesion of a line by place, from a CSV file: the `profile` of a [[friction]] step.

The file has the columns `position_m, adhesion`: from this position on, the rail has this initial
adhesion, up to the next row. A first line of names is optional, lines that begin with # are
comments. `adhesion` means what `initial_adhesion` means: what a wheel gets at the speed and the
sliding in [adhesion] (33.3 m/s and 1 m/s unless given), before sliding has cleaned more. So a
measured or assumed line can be played: mu_cd of each row follows from it, all else of the law is
that of the set.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.rig import params as physics

COLUMNS = ("position_m", "adhesion")
# every axle looks through all changes in every tick
MOST_CHANGES = 1000
LEAST_ADHESION = 0.005
MOST_ADHESION = 0.6
_FORM = "two columns position_m,adhesion, as in 0,0.15 and 250,0.05"


def steps(
    profile: Any, start_m: float, sections: Mapping[str, Mapping[str, Any]], at: str, where: str
) -> list[dict[str, float]]:
    """Return the steps of friction that a profile stands for, each with `from_m` and `mu_cd`.

    Parameters
    ----------
    profile : path of the file, relative to the working directory or to the file `where`
    start_m : place of the position 0 of the profile
    sections : all checked sections of the scenario, for the law that is to give the adhesion
    at : what names the profile, for messages
    where : the file that names it

    Raises ConfigError for a file that is missing or has another form, positions that do not rise,
    adhesions that are out of range or that no mu_cd gives, and more than `MOST_CHANGES` changes.
    """
    if not isinstance(profile, str):
        raise ConfigError(f"{at}: profile = {profile!r}; allowed is the path of a CSV file")
    path = Path(profile)
    beside = Path(where).parent / path
    if not path.is_file() and beside.is_file():
        path = beside
    changes = read(path)
    mu_cd_of: dict[float, float] = {}
    result = []
    for position_m, adhesion in changes:
        if adhesion not in mu_cd_of:
            section = {**sections["adhesion"], "initial_adhesion": adhesion}
            mu_cd_of[adhesion] = physics.initial_mu_cd(
                {**sections, "adhesion": section}, f"{path}, position {position_m:g} m"
            )
        result.append({"from_m": start_m + position_m, "mu_cd": mu_cd_of[adhesion]})
    return result


def read(path: Path) -> list[tuple[float, float]]:
    """Return the rows (position in m, adhesion) of a file at which the adhesion changes.

    Raises ConfigError as in `steps`.
    """
    changes: list[tuple[float, float]] = []
    last_m = -math.inf
    text = user_files.read_text(path, user_files.CSV, remedy="give the path of the profile")
    for number, line in enumerate(text.splitlines(), start=1):
        cells = [cell.strip() for cell in line.replace(";", ",").split(",")]
        if not any(cells) or line.lstrip().startswith("#"):
            continue
        if not changes and tuple(cells) == COLUMNS:
            continue
        position_m, adhesion = _numbers(cells, f"{path}, line {number}")
        if position_m <= last_m:
            raise ConfigError(
                f"{path}, line {number}: position {position_m:g} m after {last_m:g} m; positions "
                "must rise from row to row: sort the file"
            )
        if not LEAST_ADHESION <= adhesion <= MOST_ADHESION:
            raise ConfigError(
                f"{path}, line {number}: adhesion = {adhesion:g}; allowed is {LEAST_ADHESION:g} to "
                f"{MOST_ADHESION:g} (a share, not %)"
            )
        last_m = position_m
        if not changes or adhesion != changes[-1][1]:
            changes.append((position_m, adhesion))
    if not changes:
        raise ConfigError(f"{path}: no rows; allowed are {_FORM}")
    if len(changes) > MOST_CHANGES:
        raise ConfigError(
            f"{path}: the adhesion changes {len(changes)} times; allowed are {MOST_CHANGES} changes: "
            "round the adhesions, or keep every tenth row"
        )
    return changes


def _numbers(cells: list[str], at: str) -> tuple[float, float]:
    """Return both numbers of a row. Raises ConfigError."""
    try:
        position_m, adhesion = (float(cell) for cell in cells)
    except ValueError:
        raise ConfigError(f"{at}: {', '.join(cells)!r}; allowed are {_FORM}") from None
    if not (math.isfinite(position_m) and math.isfinite(adhesion)):
        raise ConfigError(f"{at}: {', '.join(cells)!r}; allowed are finite numbers")
    return position_m, adhesion
