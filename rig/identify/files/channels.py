"""Columns of a table as channels in SI units, with the units of dataset.toml and of the file.

The unit that dataset.toml gives and the unit in the file have to agree. If only one of them is
given, it counts. If none is given, the unit in the key counts: wheel_speed_1_rad_s is in rad/s.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.files import numbers, stamps, tables, units
from rollerrig.rig.identify.files.tables import Table
from rollerrig.rig.identify.files.units import Unit


class Source(NamedTuple):
    """Where a channel is: the column, and the unit that dataset.toml gives, or ""."""

    column: str
    unit: str


def seconds(path: Path, table: Table, source: Source) -> stamps.Stamps:
    """Return the stamps of a table in s, NaN where there is none. Raises ConfigError."""
    tables.check_column(path, source.column, table.names)
    values = table.data[source.column]
    unit = _agreed(path, source, table.units.get(source.column, ""), "time_s")
    if unit is None:
        return stamps.read(path, values, source.column, "")
    if unit.quantity != units.TIME:
        raise ConfigError(
            f"{path}: the unit of '{source.column}' is '{unit.name}'; allowed: "
            f"{', '.join(stamps.UNITS)}"
        )
    return stamps.read(path, values, source.column, unit.name)


def factor(
    path: Path, source: Source, key: str, key_unit: str, found: str, radius_m: float = math.nan
) -> float:
    """Return the factor of a channel's values to the unit in its key.

    `key_unit` is the unit in the key, and `found` is the text of the unit in the file, or "".
    `radius_m` is the radius of the wheel, for a speed that is given as a rotation or the reverse.
    Raises ConfigError if units contradict one another, or are of another quantity.
    """
    target = units.find(key_unit)
    if target is None:
        return 1.0  # a channel without a unit
    if found in units.AMBIGUOUS and not source.unit:
        # "1/s" may be rad/s or turns a second; a key in rad/s decides
        if target.quantity == units.ROTATION:
            return 1.0
        raise ConfigError(
            f"{path}: column '{source.column}' has the unit '{found}', which is rad/s or turns a "
            f'second; write unit = "rad/s" or unit = "rev/s" for {key} in [channels]'
        )
    unit = _agreed(path, source, found, key) or target
    if unit.quantity == target.quantity:
        return unit.factor / target.factor
    if (unit.quantity, target.quantity) == (units.ROTATION, units.SPEED):
        return unit.factor * radius_m
    if (unit.quantity, target.quantity) == (units.SPEED, units.ROTATION):
        return unit.factor / radius_m
    raise ConfigError(
        f"{path}: column '{source.column}' has the unit '{unit.name}', which is no unit of {key}; "
        f"allowed: {', '.join(allowed(target))}"
    )


def allowed_in(key_unit: str) -> list[str]:
    """Return the units of a channel whose key has this text of a unit."""
    target = units.find(key_unit)
    return allowed(target) if target else []


def allowed(target: Unit) -> list[str]:
    """Return the units of a channel whose key has this unit."""
    names = list(units.of_quantity(target.quantity))
    if target.quantity == units.ROTATION:
        names += units.of_quantity(units.SPEED)
    return names


def _agreed(path: Path, source: Source, found: str, key: str) -> Unit | None:
    """Return the unit that dataset.toml and the file give; None if none is given.

    Raises ConfigError if they differ, or if a unit is not known.
    """
    given = units.find(source.unit) if source.unit else None
    if source.unit and given is None:
        raise ConfigError(
            f"{path}: unit = '{source.unit}' of {key} is not known; write a unit as km/h, rad/s or "
            "1/min in [channels]"
        )
    in_file = units.find(found) if found else None
    if given and in_file and given != in_file:
        raise ConfigError(
            f"{path}: column '{source.column}' has the unit '{found}' in the file, but dataset.toml "
            f"gives unit = '{source.unit}' for {key}; correct one of them"
        )
    if found and in_file is None and given is None:
        raise ConfigError(
            f"{path}: column '{source.column}' has the unit '{found}' in the file, which is not "
            f"known; write the unit of {key} as `unit` in [channels]"
        )
    return given or in_file


def values(path: Path, table: Table, column: str) -> np.ndarray:
    """Return a column as numbers (n,), NaN where there is none. Raises ConfigError."""
    tables.check_column(path, column, table.names)
    return numbers.as_floats(path, table.data[column], column)


def check_name(
    path: Path, sources: Mapping[str, Source], key: str, key_unit: str, found: str
) -> None:
    """Raise ConfigError if the name of a column and its unit in the file contradict each other.

    Only a column counts that is read by its name, without an entry in [channels].
    """
    in_file = units.find(found) if found else None
    if key in sources or in_file is None or in_file == units.find(key_unit):
        return
    raise ConfigError(
        f"{path}: {key} has the unit '{found}' in the file; '{key_unit}' is required, as in its "
        f'name: convert it, or write {key} = {{ column = "{key}", unit = "{in_file.name}" }} in '
        "[channels]"
    )
