"""Quantities with units and conditions, as a person writes them: "3.8 bar", "vehicle_speed < 5 km/h".

A value is turned into SI once, here; a unit that does not belong to a signal is refused, and so is a condition that no
run can meet, because the quantity never leaves its range. A condition names a signal of the table of signals (of one
axle as `cylinder_pressure_2`, else of all that it has), or `every NAME` or `any NAME` where a signal has several axles.
"""

import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.harness_client import COLUMNS

# unit as written: (unit of the table of signals, factor to it)
UNITS: dict[str, tuple[str, float]] = {
    "m/s": ("m_s", 1.0),
    "km/h": ("m_s", 1.0 / 3.6),
    "m/s2": ("m_s2", 1.0),
    "rad/s": ("rad_s", 1.0),
    "Pa": ("Pa", 1.0),
    "kPa": ("Pa", 1e3),
    "mbar": ("Pa", 1e2),
    "bar": ("Pa", 1e5),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "min": ("s", 60.0),
    "m": ("m", 1.0),
    "km": ("m", 1e3),
    "t": ("kg", 1e3),
    "kg": ("kg", 1.0),
    "NL": ("NL", 1.0),
    "": ("", 1.0),
    "%": ("", 0.01),
}
# what a quantity can be at all: by unit, and by signal where that is narrower
RANGES: dict[str, tuple[float, float]] = {
    "vehicle_speed": (0.0, 100.0),
    "position": (0.0, 1e6),
    "time": (0.0, 36000.0),
    "brake_demand": (0.0, 1e6),
    "cylinder_pressure": (0.0, 1e6),
    "adhesion": (-1.0, 1.0),
    "valve": (0.0, 2.0),
    "magnets": (0.0, 3.0),
    "measured_speed": (0.0, 327.67),
    "wsp_reference_speed": (0.0, 327.67),
    "vehicle_acceleration": (-20.0, 20.0),
}
_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
_QUANTITY = re.compile(r"\s*([-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)\s*([A-Za-z%][A-Za-z0-9/%]*)?\s*$")
_CONDITION = re.compile(r"\s*(?:(every|any)\s+)?([a-z_0-9]+)\s*(<=|>=|<|>)\s*(.+)$")
_KNOWN = tuple(
    dict.fromkeys(
        signal.name for signal in signals.SIGNALS if signals.columns(signal)[0] in COLUMNS
    )
)


@dataclass(frozen=True)
class Condition:
    """A comparison of columns (of each where `all_of`) with a bound in SI; `unit` as it was written."""

    text: str
    columns: tuple[str, ...]
    compare: str
    bound: float
    all_of: bool
    unit: str = ""

    def holds(self, values: Mapping[str, float]) -> bool:
        """Whether it holds for the newest values; a value that is not known does not."""
        met = (_OPERATORS[self.compare](values[name], self.bound) for name in self.columns)
        return all(met) if self.all_of else any(met)

    def readings(self, values: Mapping[str, float]) -> str:
        """The newest values in the unit of the condition."""
        found = ", ".join(f"{values[name] / UNITS[self.unit][1]:.4g}" for name in self.columns)
        return f"{found} {self.unit}".strip()


def quantity(text: object, unit: str, where: str) -> float:
    """A value with its unit as SI. `unit` as in the table of signals. Raises ConfigError."""
    allowed = ", ".join(repr(one) for one, (base, _) in UNITS.items() if base == unit and one)
    form = f"write a number with its unit ({allowed or 'none'}) in quotes"
    found = _QUANTITY.match(text) if isinstance(text, str) else None
    if not found:
        raise ConfigError(f"{where} = {text!r}: {form}")
    base, factor = UNITS.get(found[2] or "", (None, 0.0))
    if base is None:
        raise ConfigError(f"{where} = '{text}': no unit is called '{found[2]}'; {form}")
    if base != unit:
        raise ConfigError(
            f"{where} = '{text}': the unit '{found[2] or 'none'}' does not belong here; {form}"
        )
    return float(found[1]) * factor


def condition(text: object, where: str) -> Condition:
    """A condition from its text. Raises ConfigError for what is unknown or can never be."""
    found = _CONDITION.match(text) if isinstance(text, str) else None
    if not found or not isinstance(text, str):
        raise ConfigError(
            f"{where} = {text!r}: write a condition such as "
            "'vehicle_speed < 5 km/h' or 'every cylinder_pressure > 3 bar'"
        )
    name, columns = _columns(found[2], where)
    unit, compare = signals.BY_NAME[name].unit, found[3]
    bound = quantity(found[4], unit, f"{where}: {found[2]}")
    low, high = RANGES.get(name, (-float("inf"), float("inf")))
    if {"<": bound <= low, "<=": bound < low, ">": bound >= high, ">=": bound > high}[compare]:
        raise ConfigError(
            f"{where} = '{text}': can never be, because {name} stays within {low:g} to {high:g} "
            f"{unit.replace('_', '/')}; mend the bound or the direction"
        )
    written = _QUANTITY.match(found[4])
    return Condition(
        text, columns, compare, bound, found[1] != "any", (written[2] or "") if written else ""
    )


def _columns(name: str, where: str) -> tuple[str, tuple[str, ...]]:
    stem, _, axle = name.rpartition("_")
    if axle.isdecimal() and stem in _KNOWN:
        if not 1 <= int(axle) <= signals.BY_NAME[stem].axles:
            raise ConfigError(
                f"{where}: '{name}': there are axles 1 to {signals.BY_NAME[stem].axles}"
            )
        return stem, (signals.columns(signals.BY_NAME[stem])[int(axle) - 1],)
    if name not in _KNOWN:
        raise ConfigError(f"{where}: no signal is called '{name}'{nearest(name, _KNOWN)}")
    return name, signals.columns(signals.BY_NAME[name])
