"""The units that files of loggers give: their spellings, and their factors to SI.

A unit is in a row below the names, in brackets behind a name as in "v_Fzg [km/h]", behind a slash
as in "v / km/h", or it is the end of a name as in "v_kmh". A unit with an angle is a different
quantity from one without: "1/min" counts turns, and "rad/s" is an angle by time.
"""

import math
import re
from typing import NamedTuple

# the quantities of units
TIME = "time"
SPEED = "speed"
ROTATION = "rotation"
LENGTH = "length"
FORCE = "force"
TORQUE = "torque"
PRESSURE = "pressure"
RATIO = "ratio"


class Unit(NamedTuple):
    """A unit: the spelling that dataset.toml uses, its quantity, and its factor to the SI unit."""

    name: str
    quantity: str
    factor: float


# Each row: the unit, and further spellings. Spellings are compared without blanks.
_ROWS = (
    (Unit("s", TIME, 1.0), "sec sek secs seconds sekunden second sekunde"),
    (Unit("ms", TIME, 1e-3), "msec millis milliseconds millisekunden"),
    (Unit("us", TIME, 1e-6), "µs μs usec microseconds"),
    (Unit("ns", TIME, 1e-9), "nsec nanoseconds"),
    (Unit("min", TIME, 60.0), "minutes minuten"),
    (Unit("h", TIME, 3600.0), "hours stunden std hr"),
    (Unit("d", TIME, 86400.0), "days tage"),
    (Unit("m/s", SPEED, 1.0), "m_s mps m*s^-1 m*s-1 ms^-1 ms-1 m·s⁻¹ m/sec meters/s"),
    (Unit("km/h", SPEED, 1.0 / 3.6), "km_h kmh kph km/hr km*h^-1 kmph kilometersperhour"),
    (Unit("mph", SPEED, 0.44704), "mi/h miles/h"),
    (Unit("mm/s", SPEED, 1e-3), "mm_s"),
    (Unit("cm/s", SPEED, 1e-2), "cm_s"),
    (Unit("ft/s", SPEED, 0.3048), "ft_s fps"),
    (Unit("kt", SPEED, 1852.0 / 3600.0), "kts knots"),
    (Unit("rad/s", ROTATION, 1.0), "rad_s rad/sec rads rad*s^-1 rad*s-1 rad·s⁻¹ rps_rad"),
    (
        Unit("1/min", ROTATION, 2.0 * math.pi / 60.0),
        "rpm min^-1 min-1 min⁻¹ u/min upm r/min rev/min 1_min turns/min 1/minute",
    ),
    (Unit("rev/s", ROTATION, 2.0 * math.pi), "u/s r/s turns/s rev_s"),
    (Unit("deg/s", ROTATION, math.pi / 180.0), "°/s deg_s grad/s"),
    (Unit("m", LENGTH, 1.0), "meter metre meters metres"),
    (Unit("km", LENGTH, 1000.0), "kilometer kilometre"),
    (Unit("mi", LENGTH, 1609.344), "mile miles"),
    (Unit("cm", LENGTH, 1e-2), ""),
    (Unit("mm", LENGTH, 1e-3), ""),
    (Unit("N", FORCE, 1.0), "newton"),
    (Unit("daN", FORCE, 10.0), ""),
    (Unit("kN", FORCE, 1e3), ""),
    (Unit("kg", FORCE, 9.80665), "kgf kp"),
    (Unit("t", FORCE, 9806.65), "to"),
    (Unit("lbf", FORCE, 4.4482216153), ""),
    (Unit("Nm", TORQUE, 1.0), "N*m N·m N.m n_m"),
    (Unit("kNm", TORQUE, 1e3), "kN*m kN·m kN.m"),
    (Unit("daNm", TORQUE, 10.0), "daN*m"),
    (Unit("kgf m", TORQUE, 9.80665), "kgfm kgf*m kpm"),
    (Unit("lbf ft", TORQUE, 1.3558179483), "lbfft lbf*ft ft*lbf ftlbf ft-lbf lb-ft ft-lb ftlb"),
    (Unit("Pa", PRESSURE, 1.0), ""),
    (Unit("hPa", PRESSURE, 100.0), ""),
    (Unit("mbar", PRESSURE, 100.0), ""),
    (Unit("kPa", PRESSURE, 1e3), ""),
    (Unit("bar", PRESSURE, 1e5), "barg bar(g) bar(rel)"),
    (Unit("MPa", PRESSURE, 1e6), ""),
    (Unit("psi", PRESSURE, 6894.757), ""),
    (Unit("%", RATIO, 0.01), "percent prozent"),
    (Unit("-", RATIO, 1.0), "none"),
)
# Units that a reader knows but does not convert. A row of units may hold them.
_OTHER = frozenset(
    (
        *("°", "deg", "rad", "°c", "degc", "k", "a", "ma", "v", "mv", "kv", "w", "kw", "j", "kj"),
        *("l", "l/min", "hz", "khz", "g", "m/s2", "m/s²", "m/s^2", "v(rms)", "°n", "°e"),
        *("1/s", "s^-1", "s-1", "bit", "count", "counts", "bool", "boolean", "text", "string"),
        *("hh:mm:ss", "enum", "date", "datum"),
    )
)
# "1/s" is an angle by time for some people and turns by time for others
AMBIGUOUS = ("1/s", "s^-1", "s-1", "s⁻¹")
# the ends of names that are units; "_n" and "_t" are left out, because they are letters of formulas
_ENDINGS = (
    "rad_s", "deg_s", "km_h", "m_s", "mm_s", "1_min", "kmh", "kph", "mph", "rpm", "knm", "nm",
    "kn", "kpa", "mbar", "bar", "pa", "ms", "us", "ns", "sec",
)  # fmt: skip
# endings whose capital letters make the difference between units
_EXACT_ENDINGS = ("s", "m", "km", "N", "kN", "Nm", "kNm", "Pa")

_BRACKETS = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<a>[^\]\[]*)\]|\((?P<b>[^()]*(?:\([a-z]+\))?)\))")
_SLASH = re.compile(r"(?P<name>.*\S)\s+(?:/|in)\s+(?P<unit>\S+)")


def _spellings() -> dict[str, Unit]:
    """Return the units by their spellings."""
    units = {}
    for unit, others in _ROWS:
        for spelling in (unit.name, *others.split()):
            units[spelling] = unit
    return units


_EXACT = _spellings()


def _in_lower_case() -> dict[str, Unit]:
    """Return the units by their spellings in lower case, without those that become the same."""
    units: dict[str, Unit] = {}
    repeated = set()
    for spelling, unit in _EXACT.items():
        lower = spelling.lower()
        if units.get(lower, unit) != unit:
            repeated.add(lower)
        units[lower] = unit
    return {spelling: unit for spelling, unit in units.items() if spelling not in repeated}


_LOWER = _in_lower_case()


def bare(text: str) -> str:
    """Return the text of a unit without blanks and without the brackets around it."""
    text = re.sub(r"\s+", "", text)
    for opening, closing in ("[]", "()", "<>", "{}"):
        if text.startswith(opening) and text.endswith(closing):
            text = text[1:-1]
    return text


def find(text: str) -> Unit | None:
    """Return the unit that a text is, as "[km/h]" or "RPM"; None if the text is no known unit."""
    text = bare(text)
    unit = _EXACT.get(text)
    if unit is None:
        unit = _LOWER.get(text.lower())
    return unit


def is_unit(text: str) -> bool:
    """Return whether a text is a unit, also one that is not converted."""
    return find(text) is not None or bare(text).lower() in _OTHER


def of_quantity(quantity: str) -> tuple[str, ...]:
    """Return the names of the units of a quantity."""
    return tuple(unit.name for unit, _ in _ROWS if unit.quantity == quantity)


class NamedUnit(NamedTuple):
    """The parts of a column's name: the name itself, and the text of the unit, or ""."""

    name: str
    unit: str


def split(column: str) -> NamedUnit:
    """Return name and unit of a column's name with a unit in brackets or behind a slash.

    The unit is "" if there is none, or if the text in brackets is no known unit.
    """
    column = column.strip()
    match = _BRACKETS.fullmatch(column)
    if match:
        unit = match["a"] if match["a"] is not None else match["b"]
        if is_unit(unit):
            return NamedUnit(match["name"].strip(), bare(unit))
    match = _SLASH.fullmatch(column)
    if match and is_unit(match["unit"]):
        return NamedUnit(match["name"], bare(match["unit"]))
    return NamedUnit(column, "")


def split_ending(name: str) -> NamedUnit:
    """Return name and unit of a name that ends in a unit, as "v_kmh" or "time_ms"."""
    for ending in _EXACT_ENDINGS:
        if name.endswith(f"_{ending}") and not re.search(r"(?i)(^|_)(m|km|rad|deg)_s$", name):
            return NamedUnit(name[: -len(ending) - 1], ending)
    for ending in _ENDINGS:
        if name.lower().endswith(f"_{ending}"):
            found = find(ending) or find(ending.replace("n", "N"))
            if found:
                return NamedUnit(name[: -len(ending) - 1], found.name)
    return NamedUnit(name, "")
