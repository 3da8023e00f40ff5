"""Quantities and conditions as a person writes them: "3.8 bar", "vehicle_speed < 5 km/h".

Values become SI here, and nowhere else. A unit that does not belong to a signal is refused. So is a
condition that no run can meet, because the quantity never leaves its range. A condition names a
signal of the table of signals: of one axle as `cylinder_pressure_2`, else of all its axles. `every
NAME` and `any NAME` state how the axles of a signal combine; `every` is the default.
"""

import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.number_text import rounded
from rollerrig.configs.table import nearest
from rollerrig.configs.vehicle import MOST_GROUPS
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.harness_client import reception
from rollerrig.wsp_interface.signals import Table

# unit as a person writes it: (unit in the table of signals, factor to it)
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
# the values that a signal can have at all, in its unit
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
    "wheel_circumferential_speed": (0.0, 100.0),
    "sliding": (-100.0, 100.0),
    **dict.fromkeys(map(signals.reference_speed_name, range(MOST_GROUPS)), (0.0, 327.67)),
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
_NO_UNIT = "the unit is missing"
_NO_RANGE = (-float("inf"), float("inf"))


@dataclass(frozen=True)
class Condition:
    """A comparison of columns with a bound.

    text: the condition as written.
    columns: names of columns of the harness.
    compare: "<", "<=", ">" or ">=".
    bound: in SI.
    all_of: whether all columns must meet it, or any of them.
    unit: of the bound, as written.
    """

    text: str
    columns: tuple[str, ...]
    compare: str
    bound: float
    all_of: bool
    unit: str = ""

    def holds(self, values: Mapping[str, float]) -> bool:
        """Return whether the condition holds. A value of NaN never meets it."""
        compare = _OPERATORS[self.compare]
        met = [compare(values[name], self.bound) for name in self.columns]
        return all(met) if self.all_of else any(met)

    def readings(self, values: Mapping[str, float]) -> str:
        """Return the values of the columns as text, in the unit of the condition."""
        _, factor = UNITS[self.unit]
        texts = [rounded(values[name] / factor) for name in self.columns]
        return f"{', '.join(texts)} {self.unit}".strip()


def quantity(text: object, unit: str, where: str) -> float:
    """Return a value with its unit in SI.

    text: such as "3.8 bar".
    unit: the required unit, as in the table of signals.
    where: place of the text, for messages.

    Raises ConfigError.
    """
    form = f"write {_form(unit)} in quotes"
    match = _QUANTITY.match(text) if isinstance(text, str) else None
    if not match:
        raise ConfigError(f"{where} = {text!r}: {form}")
    number = float(match[1])
    written_unit = match[2] or ""
    if written_unit not in UNITS:
        raise ConfigError(f"{where} = '{text}': no unit is called '{written_unit}'; {form}")
    base, factor = UNITS[written_unit]
    if base != unit:
        wrong = f"the unit '{written_unit}' does not belong here" if written_unit else _NO_UNIT
        raise ConfigError(f"{where} = '{text}': {wrong}; {form}")
    return number * factor


def _form(unit: str) -> str:
    """Return how a quantity is written, as the end of a message; `unit` as in `quantity`."""
    if not unit:
        return "a number without a unit or with %, as in '0.5' or '50 %',"
    allowed = ", ".join(repr(name) for name, (base, _) in UNITS.items() if base == unit)
    return f"a number with its unit ({allowed})"


def condition(text: object, where: str, table: Table) -> Condition:
    """Return a condition from its text, for the vehicle with these signals.

    Raises ConfigError for an unknown signal or unit, and for a condition that can never be met.
    """
    match = _CONDITION.match(text) if isinstance(text, str) else None
    if not match or not isinstance(text, str):
        raise ConfigError(
            f"{where} = {text!r}: write a condition such as "
            "'vehicle_speed < 5 km/h' or 'every cylinder_pressure > 3 bar'"
        )
    quantifier, written_name, compare, written_bound = match.groups()
    name, columns = _columns(written_name, where, table)
    unit = table.by_name[name].unit
    bound = quantity(written_bound, unit, f"{where}: {written_name}")
    low, high = RANGES.get(name, _NO_RANGE)
    if _is_impossible(compare, bound, low, high):
        raise ConfigError(
            f"{where} = '{text}': can never be, because {name} stays within {low:g} to {high:g} "
            f"{unit.replace('_', '/')}; correct the bound or the direction"
        )
    written = _QUANTITY.match(written_bound)
    return Condition(
        text=text,
        columns=columns,
        compare=compare,
        bound=bound,
        all_of=quantifier != "any",
        unit=(written[2] or "") if written else "",
    )


def _is_impossible(compare: str, bound: float, low: float, high: float) -> bool:
    """Return whether no value from low to high meets a comparison."""
    if compare == "<":
        return bound <= low
    if compare == "<=":
        return bound < low
    if compare == ">":
        return bound >= high
    return bound > high


def _columns(name: str, where: str, table: Table) -> tuple[str, tuple[str, ...]]:
    """Return the signal and the columns of a name, with or without an axle."""
    received = reception(table).received
    stem, _, axle = name.rpartition("_")
    if axle.isdecimal() and stem in received:
        signal = table.by_name[stem]
        if not 1 <= int(axle) <= signal.axles:
            raise ConfigError(f"{where}: '{name}': there are axles 1 to {signal.axles}")
        return stem, (signals.columns(signal)[int(axle) - 1],)
    if name not in received:
        raise ConfigError(f"{where}: no signal is called '{name}'{nearest(name, received)}")
    return name, signals.columns(table.by_name[name])
