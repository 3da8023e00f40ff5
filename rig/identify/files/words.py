"""Recognises what a column is by the words in its name, German and English.

A name is divided into words at spaces, marks, digits and capital letters: "v_Fzg" has the words v
and fzg, "WheelSpd_FL" has wheel, spd and fl. The rules, in this order:

1. A word of NOT_USED makes the column nothing: engine speeds, set values, temperatures and so on.
2. The words of a quantity decide, in the order of `_quantity`. Long words also
   fit inside of words ("druck" in "Bremszylinderdruck"), short words fit only as a whole word.
3. A speed belongs to a receiver or radar, a bogie, a wheel or the vehicle by the words of these, in
   this order. A corner as FL is that of a wheel. Without such a word, a speed with a number is that
   of a wheel, as v1 or n2, and one without is that of the vehicle.
4. The number is that of the wheel: a digit, or a corner as FL, VL, "front left", "vorne links".
   Corners count as 1 front left, 2 front right, 3 rear left, 4 rear right.
"""

import re
from typing import NamedTuple

from rollerrig.rig.identify.files import units

# what a column may be
STAMPS = "time"
DATE = "date"
WHEEL_SPEED = "wheel_speed"
BOGIE_SPEED = "bogie_speed"
VEHICLE_SPEED = "vehicle_speed"
REFERENCE_SPEED = "reference_speed"
SURFACE_SPEED = "surface_speed"
LOAD = "wheel_load"
TORQUE = "brake_torque"
PRESSURE = "cylinder_pressure"
DEMAND = "brake_demand"
POSITION = "position"
CREEPAGE = "creepage"
ADHESION = "adhesion"
_SPEED = "speed"


class Words(NamedTuple):
    """Words that mean something: `inside` also as a part of a word, `whole` as a word only."""

    inside: tuple[str, ...]
    whole: tuple[str, ...] = ()

    def fit(self, words: list[str]) -> bool:
        """Return whether one of the words of a name is one of these."""
        if any(word in self.whole for word in words):
            return True
        return any(part in word for part in self.inside for word in words)


NOT_USED = Words(
    inside=(
        *("engine", "motor", "temperat", "accel", "beschl", "sliding", "gleit", "steer", "lenk"),
        *("latitude", "longitude", "altitude", "breite", "laenge", "heading", "course", "status"),
        *("quality", "sigma", "error", "fehler", "voltage", "spannung", "current", "target"),
        *("limit", "roller", "rolle", "gear", "throttle", "yaw", "pitch", "transition"),
        *("degraded", "recovered", "dissipated", "energy", "valve", "ventil"),
    ),
    whole=(
        *("soll", "setpoint", "set", "max", "rate", "wind", "temp"),
        *("lat", "lon", "lng", "std"),
    ),
)
# letters that are an acceleration, unless a long word of a speed is in the name: "A1_Velocity"
ACCELERATIONS = Words(inside=(), whole=("acc", "a", "ax", "ay"))
BRAKING = Words(inside=("brake", "brems", "braking"), whole=("bc", "bcp", "bz"))
PLACES = Words(
    inside=("position", "distance", "strecke", "odometer", "chainage", "kilometr", "miles"),
    whole=("weg", "pos", "x", "s", "dist"),
)
TIMES = Words(
    inside=("zeit", "time", "stamp", "stempel", "clock", "elapsed", "datetime"),
    whole=("t", "sec", "secs", "seconds", "utc", "epoch", "uhr"),
)
SPEEDS = Words(
    inside=("speed", "geschw", "velocit", "drehzahl", "tacho", "wheelspd"),
    whole=("v", "n", "vel", "spd", "omega", "rotv", "rpm", "vx", "obd"),
)
LOADS = Words(
    inside=("radlast", "achslast", "aufstand", "wheelload", "normalforce", "radkraft"),
    whole=("load", "last", "fz"),
)
TORQUES = Words(inside=("moment", "torque"), whole=("trq", "mbr"))
PRESSURES = Words(inside=("druck", "pressure"), whole=("p",))
DEMANDS = Words(inside=("demand", "anforder", "befehl", "request", "command"))
CREEPAGES = Words(inside=("creepage", "schlupf"), whole=("creep", "slip"))
DATES = Words(inside=(), whole=("date", "datum"))
# letters of formulas that a unit makes a quantity: Q1 [kN], N2 [kN], s [%]
LOAD_LETTERS = Words(inside=(), whole=("q", "n", "fn"))
CREEPAGE_LETTERS = Words(inside=(), whole=("s", "xi", "nu", "kappa", "lambda"))
# an adhesion is also a coefficient of one of these
COEFFICIENTS = Words(inside=("coeff", "koeff", "beiwert"))
OF_ADHESION = Words(inside=("traction", "friction", "reib"))
ADHESIONS = Words(
    inside=("adhesion", "kraftschluss", "reibwert", "adhaesion"), whole=("mu", "friction")
)
WHEELS = Words(
    inside=("wheel", "radsatz", "radgesch", "raddreh", "achs", "axle"),
    whole=("rad", "rs", "ws", "wss", "whl"),
)
BOGIES = Words(inside=("drehgestell", "bogie"), whole=("dg",))
REFERENCES = Words(inside=("gps", "gnss", "radar", "referen", "correvit"), whole=("ref", "ins"))
VEHICLES = Words(
    inside=("fahrzeug", "vehicle", "vhcl", "train"), whole=("fzg", "zug", "car", "ist", "obd")
)
SURFACES = Words(inside=("surface",))

CORNERS = {
    **dict.fromkeys(("fl", "vl", "lf"), 1),
    **dict.fromkeys(("fr", "vr", "rf"), 2),
    **dict.fromkeys(("rl", "hl", "lr"), 3),
    **dict.fromkeys(("rr", "hr"), 4),
}
_FRONT = Words(inside=("front", "vorn"))
_REAR = Words(inside=("rear", "hinten"))
_LEFT = Words(inside=("left", "links"))
_RIGHT = Words(inside=("right", "rechts"))
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})


# letters of the symbol of a unit at most; a longer text is a word
_LONGEST_SYMBOL = 3


class Meaning(NamedTuple):
    """What a column is: the quantity, and the number of the wheel or bogie, 0 if none is given."""

    quantity: str
    number: int


class Column(NamedTuple):
    """The name of a column without its unit, and the unit with the place where it was found."""

    name: str
    unit: str
    unit_from: str


def column(name: str, unit: str) -> Column:
    """Return name and unit of a column; `unit` is what the file gives, or ""."""
    bare = units.split(name).name
    if unit:
        return Column(bare, unit, "file")
    ending = units.split_ending(bare)
    if ending.unit:
        return Column(ending.name, ending.unit, "end of the name")
    known = units.find(bare)
    if known is not None and known.quantity == units.LENGTH and len(bare) > _LONGEST_SYMBOL:
        # a way that is named by its unit alone, as MILES
        return Column(bare, known.name, "name")
    return Column(bare, "", "")


def words_of(name: str) -> list[str]:
    """Return the words and numbers of a name in lower case."""
    name = re.sub(r"(?<=[a-zäöüß])(?=[A-Z])", " ", name)
    return re.findall(r"[a-z]+|\d+", name.lower().translate(_UMLAUTS))


def meaning(named: Column) -> Meaning | None:
    """Return what a column is by its words and its unit; None if nothing is recognised."""
    words = words_of(named.name)
    if not words or NOT_USED.fit(words):
        return None
    known = units.find(named.unit) if named.unit else None
    of_unit = known.quantity if known else ""
    is_speed = any(part in word for part in SPEEDS.inside for word in words)
    is_speed = is_speed or of_unit in (units.SPEED, units.ROTATION)
    if ACCELERATIONS.fit(words) and not is_speed:
        return None
    quantity = _quantity(words, of_unit)
    if quantity == _SPEED:
        quantity = _owner(words)
    if not quantity or not _unit_fits(quantity, named.unit, of_unit):
        return None
    return Meaning(quantity, _number(words))


def number_of(named: Column) -> int:
    """Return the number of the wheel in the name of a column; 0 if there is none."""
    return _number(words_of(named.name))


def _quantity(words: list[str], of_unit: str) -> str:
    """Return the quantity of words; the quantity of the unit decides between some of them."""
    if DATES.fit(words) and len(words) == 1:
        return DATE
    is_speed = SPEEDS.fit(words) or of_unit in (units.SPEED, units.ROTATION)
    is_creepage = of_unit == units.RATIO and CREEPAGE_LETTERS.fit(words)
    if CREEPAGES.fit(words) or is_creepage:
        return CREEPAGE
    if ADHESIONS.fit(words) or (COEFFICIENTS.fit(words) and OF_ADHESION.fit(words)):
        return ADHESION
    if TORQUES.fit(words) and (BRAKING.fit(words) or WHEELS.fit(words)):
        return TORQUE
    if of_unit == units.TORQUE and "m" in words:
        return TORQUE
    is_load = WHEELS.fit(words) or LOAD_LETTERS.fit(words)
    if LOADS.fit(words) or (of_unit == units.FORCE and is_load):
        return LOAD
    if PRESSURES.fit(words) or of_unit == units.PRESSURE:
        return PRESSURE if BRAKING.fit(words) or "zylinder" in "".join(words) else ""
    if TIMES.fit(words) and of_unit in ("", units.TIME) and not is_speed:
        return STAMPS
    if is_speed:
        return _SPEED
    if BRAKING.fit(words) and (DEMANDS.fit(words) or len(words) == 1):
        return DEMAND
    if PLACES.fit(words):
        return POSITION
    # a wheel and its number, or a receiver, without another word: its speed
    others = [word for word in words if not (word.isdigit() or word in CORNERS)]
    is_alone = len(others) == 1 and any(owner.fit(words) for owner in (WHEELS, BOGIES, REFERENCES))
    return _SPEED if is_alone else ""


def _owner(words: list[str]) -> str:
    """Return to what a speed belongs."""
    for owner, quantity in (
        (SURFACES, SURFACE_SPEED),
        (REFERENCES, REFERENCE_SPEED),
        (BOGIES, BOGIE_SPEED),
        (WHEELS, WHEEL_SPEED),
        (Words(inside=(), whole=tuple(CORNERS)), WHEEL_SPEED),
        (VEHICLES, VEHICLE_SPEED),
    ):
        if owner.fit(words):
            return quantity
    return WHEEL_SPEED if _number(words) else VEHICLE_SPEED


def _unit_fits(quantity: str, unit: str, of_unit: str) -> bool:
    """Return whether the unit in the file can be one of a quantity; no unit always can."""
    allowed = {
        STAMPS: (units.TIME,),
        LOAD: (units.FORCE,),
        TORQUE: (units.TORQUE,),
        PRESSURE: (units.PRESSURE,),
        POSITION: (units.LENGTH,),
        CREEPAGE: (units.RATIO,),
        ADHESION: (units.RATIO,),
        WHEEL_SPEED: (units.SPEED, units.ROTATION),
        DEMAND: None,
        DATE: None,
    }.get(quantity, (units.SPEED,))
    if allowed is None or not unit:
        return True
    if unit in units.AMBIGUOUS and units.ROTATION in allowed:
        return True
    return of_unit in allowed


def _number(words: list[str]) -> int:
    """Return the number of the wheel in words; 0 if there is none."""
    for word in words:
        if word in CORNERS:
            return CORNERS[word]
    if (_FRONT.fit(words) or _REAR.fit(words)) and (_LEFT.fit(words) or _RIGHT.fit(words)):
        return (3 if _REAR.fit(words) else 1) + _RIGHT.fit(words)
    digits = [int(word) for word in words if word.isdigit()]
    return digits[-1] if digits and 0 < digits[-1] < 100 else 0
