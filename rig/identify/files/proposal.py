"""Proposes what the columns of a logger's file are: the kind of the data, channels and units.

A proposal is shown to the user, who accepts or corrects it. Its rules are those of `words`, and:

- The data are braking runs if there are a speed of the vehicle, and speeds, loads and brake torques
  of all wheelsets; a creep curve with creepage and adhesion; else the data of a recorder.
- Numbered columns in a unit of force, or of torque, are loads, or brake torques, if all speeds are
  there and no column is named a load, or a torque.
- A unit comes from the file, else from the end of the name. Stamps without a unit are in seconds,
  unless their size shows another unit (a count since 1970), or they would be 5 s apart or more.
- Loads and torques without a unit are in N and Nm.
- A speed without a unit gets none: the user has to give it, because nothing in the file decides.
"""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.configs.vehicle import COACH_AXLES
from rollerrig.rig.identify.files import stamps, units, words
from rollerrig.rig.identify.files.words import Meaning

KINDS = ("braking_runs", "creep_curve", "recorder")
UNKNOWN = "not recognised"
_DEFAULT = "no unit in the file: the default"
_LONGEST_STEP = 5.0  # stamps that are further apart than 5 s are in milliseconds
# sizes of counts since 1970, in the years 2001 to 2096
_SINCE_1970 = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_EARLIEST_S = 1e9
_LATEST_S = 4e9

# quantity -> key of a channel, by the kind of data; {} is the number
_KEYS = {
    "braking_runs": {
        words.STAMPS: "time_s",
        words.VEHICLE_SPEED: "vehicle_speed_m_s",
        words.WHEEL_SPEED: "wheel_speed_{}_rad_s",
        words.LOAD: "wheel_load_{}_N",
        words.TORQUE: "brake_torque_{}_Nm",
        words.SURFACE_SPEED: "surface_speed_{}_m_s",
        words.POSITION: "position_m",
    },
    "creep_curve": {
        words.CREEPAGE: "creepage",
        words.ADHESION: "adhesion",
        words.VEHICLE_SPEED: "speed_m_s",
        words.LOAD: "wheel_load_N",
    },
    "recorder": {
        words.STAMPS: "time_s",
        words.WHEEL_SPEED: "wheel_speed_{}_m_s",
        words.BOGIE_SPEED: "bogie_speed_{}_m_s",
        words.REFERENCE_SPEED: "reference_speed_m_s",
        words.DEMAND: "brake_demand",
        words.POSITION: "position_m",
    },
}
_REASONS = {
    words.PRESSURE: "a pressure of a brake cylinder; without torques write it as brake_pressure_1_Pa in [channels]",
    words.VEHICLE_SPEED: "a speed of the vehicle, which is not used beside a reference",
    words.DATE: "its first date is the date of the run",
    words.REFERENCE_SPEED: "a reference, which is used of recorders only",
}


class Content(NamedTuple):
    """A column of a file: its name, the unit that the file gives or "", and its first values.

    `numbers` are NaN where there is no number; all of them are for a column of text. `is_stamp` is
    true if the values are text or types of date and time.
    """

    name: str
    unit: str
    numbers: np.ndarray
    is_stamp: bool


class Channel(NamedTuple):
    """A proposed channel. `unit_from` is where the unit was found; "" if it is still missing."""

    key: str
    column: str
    unit: str
    unit_from: str


class Unused(NamedTuple):
    """A column that is not used, and why."""

    column: str
    reason: str


class Proposal(NamedTuple):
    """The kind of the data, its channels, the other columns, and remarks for the user."""

    kind: str
    channels: tuple[Channel, ...]
    unused: tuple[Unused, ...]
    remarks: tuple[str, ...]

    def channel(self, key: str) -> Channel | None:
        """Return the channel of a key; None if there is none."""
        return next((channel for channel in self.channels if channel.key == key), None)

    def without_unit(self) -> list[str]:
        """Return the keys of speeds and positions that have no unit."""
        return [
            channel.key
            for channel in self.channels
            if not channel.unit and ("speed" in channel.key or channel.key == "position_m")
        ]


def propose(
    contents: Sequence[Content],
    kind: str = "",
    mapped: Mapping[str, str] | None = None,
    given_units: Mapping[str, str] | None = None,
    axles: int = COACH_AXLES,
) -> Proposal:
    """Return the proposal for the columns of a file.

    `kind` is one of KINDS, or "" to find it. `mapped` are columns by the key of their channel,
    whose unit may be left out; a channel with the column "" is left out. `given_units` are units by
    a key or its beginning. `axles` is the number of wheelsets of the vehicle, each of which has its
    channels in braking runs. Raises ConfigError if a column does not exist, or nothing is
    recognised.
    """
    mapped = mapped or {}
    names = [content.name for content in contents]
    mapped = _with_their_units(mapped, names)
    meanings = {}
    for content in contents:
        found = words.meaning(words.column(content.name, content.unit))
        if content.is_stamp and (found is None or found.quantity == words.DATE):
            found = Meaning(words.STAMPS, 0)
        if found:
            meanings[content.name] = found
    renumbered = _numbered_apart(meanings)
    meanings |= renumbered
    told = _told(mapped)
    by_unit = _loads_and_torques_by_unit(contents, meanings | told, axles)
    meanings |= by_unit
    kind = kind or _kind(set((meanings | told).values()), mapped, axles)
    mapped = {full_key(key, kind): name for key, name in mapped.items()}

    columns = _columns(contents, meanings, kind, mapped, axles)
    by_name = {content.name: content for content in contents}
    channels = []
    for key, name in columns.items():
        channel = _with_unit(key, by_name[name], given_units or {})
        if channel.unit or key != "position_m" or key in mapped:
            channels.append(channel)
    used = {channel.column for channel in channels}
    unused = []
    for name in names:
        if name not in used:
            reason = _reason(meanings.get(name))
            if name == columns.get("position_m"):
                reason = "a position without a unit; give it as in --unit position_m=m"
            unused.append(Unused(name, reason))
    remarks = _remarks(kind, channels, meanings, renumbered)
    if renumbered:
        remarks.append(
            f"{', '.join(repr(name) for name in renumbered)} have the same number: they are numbered in "
            "the order of the file; correct it with --map"
        )
    if by_unit:
        remarks.append(
            f"{', '.join(repr(name) for name in by_unit)} are taken as loads and brake torques by their "
            "units and numbers only; correct it with --map"
        )
    if kind == "recorder":
        remarks += _missing_of_braking_runs(meanings | told, axles)
    return Proposal(kind, tuple(channels), tuple(unused), tuple(remarks))


def full_key(key: str, kind: str) -> str:
    """Return the key of a channel of a kind of data whose unit may be left out."""
    found = words.meaning(words.column(key, ""))
    template = _KEYS[kind].get(found.quantity, "") if found else ""
    full = template.format(found.number) if found else ""
    return full if words.column(full, "").name == key else key


def _told(mapped: Mapping[str, str]) -> dict[str, Meaning]:
    """Return the meanings of the channels that the user has mapped, by their keys."""
    found = {key: words.meaning(words.column(key, "")) for key, name in mapped.items() if name}
    return {key: meaning for key, meaning in found.items() if meaning is not None}


def _with_their_units(mapped: Mapping[str, str], names: Sequence[str]) -> dict[str, str]:
    """Return the columns that are mapped, as they are in the file.

    Raises ConfigError, which names all that are wrong.
    """
    columns = {}
    wrong = []
    for key, name in mapped.items():
        try:
            columns[key] = _with_its_unit(key, name, names)
        except ConfigError as error:
            wrong.append(str(error))
    if wrong:
        raise ConfigError("; ".join(wrong))
    return columns


def _with_its_unit(key: str, name: str, names: Sequence[str]) -> str:
    """Return the column that a name means, which may be given without its unit.

    Raises ConfigError if there is no such column, or if several columns are meant.
    """
    if not name or name in names:
        return name
    meant = [column for column in names if units.split(column).name == name]
    if len(meant) == 1:
        return meant[0]
    if meant:
        raise ConfigError(
            f"--map {key}={name}: these columns differ only in their unit: "
            f"{', '.join(repr(column) for column in meant)}; write one with its unit"
        )
    raise ConfigError(f"--map {key}={name}: there is no column '{name}'{nearest(name, names)}")


def _numbered_apart(meanings: Mapping[str, Meaning]) -> dict[str, Meaning]:
    """Return new numbers of columns that have the same number, and names that differ in a letter.

    Only speeds of wheels, bogies and vehicles count: two speeds of one vehicle, as TCU_A_Velocity
    and TCU_B_Velocity, are those of its wheels. Columns of other quantities keep their numbers.
    """
    renumbered: dict[str, Meaning] = {}
    for quantity in (words.WHEEL_SPEED, words.BOGIE_SPEED, words.VEHICLE_SPEED):
        names = [name for name, found in meanings.items() if found.quantity == quantity]
        numbers = [meanings[name].number for name in names]
        if len(set(numbers)) == len(numbers) or len(set(numbers)) > 1:
            continue
        if all(_differ_in_a_letter(names[0], name) for name in names[1:]):
            of_wheels = words.WHEEL_SPEED if quantity == words.VEHICLE_SPEED else quantity
            for number, name in enumerate(names, start=1):
                renumbered[name] = Meaning(of_wheels, number)
    return renumbered


def _loads_and_torques_by_unit(
    contents: Sequence[Content], meanings: Mapping[str, Meaning], axles: int
) -> dict[str, Meaning]:
    """Return columns that are loads or brake torques by their units, and their numbers alone.

    Only if speeds of all wheelsets and of the vehicle are there: then columns that are numbered
    from 1 to `axles` in a unit of force are loads, and those in a unit of torque brake torques.
    """
    present = set(meanings.values())
    speeds = {Meaning(words.WHEEL_SPEED, axle) for axle in range(1, axles + 1)}
    quantities = {found.quantity for found in present}
    if not speeds <= present or words.VEHICLE_SPEED not in quantities:
        return {}
    found: dict[str, Meaning] = {}
    for of_unit, quantity in ((units.FORCE, words.LOAD), (units.TORQUE, words.TORQUE)):
        if quantity in quantities:
            continue
        numbered: dict[str, int] = {}
        for content in contents:
            named = words.column(content.name, content.unit)
            known = units.find(named.unit) if named.unit else None
            if content.name not in meanings and known is not None and known.quantity == of_unit:
                numbered[content.name] = words.number_of(named)
        if sorted(numbered.values()) == list(range(1, axles + 1)):
            found |= {name: Meaning(quantity, number) for name, number in numbered.items()}
    return found


def _differ_in_a_letter(name: str, other: str) -> bool:
    """Return whether two names differ only in single letters, as VrTCU_A_A1 and VrTCU_B_A1."""
    pairs = list(zip(words.words_of(name), words.words_of(other), strict=False))
    if len(words.words_of(name)) != len(words.words_of(other)):
        return False
    return all(one == two or len(one) == len(two) == 1 for one, two in pairs)


def _missing_of_braking_runs(meanings: Mapping[str, Meaning], axles: int) -> list[str]:
    """Return a remark on the channels that braking runs lack, if loads or torques are there."""
    present = set(meanings.values())
    quantities = {found.quantity for found in present}
    if not quantities & {words.LOAD, words.TORQUE, words.PRESSURE}:
        return []
    keys = _KEYS["braking_runs"]
    missing = [] if words.VEHICLE_SPEED in quantities else [keys[words.VEHICLE_SPEED]]
    for quantity in (words.WHEEL_SPEED, words.LOAD, words.TORQUE):
        for axle in range(1, axles + 1):
            if Meaning(quantity, axle) not in present:
                missing.append(keys[quantity].format(axle))
    if not missing:
        return []
    return [
        f"for braking runs of {axles} axles these channels are missing: {', '.join(missing)}; name "
        "their columns with --map, or give --vehicle"
    ]


def _kind(meanings: set[Meaning], mapped: Mapping[str, str], axles: int) -> str:
    """Return the kind of data of these columns. Raises ConfigError."""
    quantities = {found.quantity for found in meanings}
    if {words.CREEPAGE, words.ADHESION} <= quantities and words.WHEEL_SPEED not in quantities:
        return "creep_curve"
    needed = (words.WHEEL_SPEED, words.LOAD, words.TORQUE)
    of_all_axles = meanings.issuperset(
        Meaning(quantity, axle) for quantity in needed for axle in range(1, axles + 1)
    )
    if of_all_axles and words.VEHICLE_SPEED in quantities:
        return "braking_runs"
    speeds = {words.WHEEL_SPEED, words.BOGIE_SPEED, words.VEHICLE_SPEED}
    if speeds & quantities or any("speed" in key for key in mapped):
        return "recorder"
    raise ConfigError(
        "no column is recognised as a speed of a wheel, a bogie or the vehicle; name the columns, "
        "as in: --map time_s=COLUMN --map wheel_speed_1_m_s=COLUMN; of braking runs, add --kind "
        "braking_runs"
    )


def _columns(
    contents: Sequence[Content],
    meanings: Mapping[str, Meaning],
    kind: str,
    mapped: Mapping[str, str],
    axles: int,
) -> dict[str, str]:
    """Return the column of each channel, by its key."""
    columns: dict[str, str] = {}
    for content in _by_preference(contents, meanings):
        found = meanings.get(content.name)
        key = _key(found, kind, meanings, axles) if found else ""
        is_taken = key in columns or key in mapped or content.name in mapped.values()
        if key and not is_taken and (content.is_stamp or np.isfinite(content.numbers).any()):
            columns[key] = content.name
    columns.update(mapped)
    # time first, then in the order of the keys
    keys = sorted((key for key, name in columns.items() if name), key=lambda k: (k != "time_s", k))
    return {key: columns[key] for key in keys}


def _by_preference(contents: Sequence[Content], meanings: Mapping[str, Meaning]) -> list[Content]:
    """Return the columns in the order in which they are chosen if several fit a channel.

    Columns that have the name of a channel come first, and stamps without a unit that are no date
    and time come last. Other columns keep their order.
    """
    keys = {key for keys_of_kind in _KEYS.values() for key in keys_of_kind.values()}

    def rank(content: Content) -> int:
        if re.sub(r"_[1-9]\d*_", "_{}_", content.name) in keys:
            return 0
        found = meanings.get(content.name)
        is_stamps = found is not None and found.quantity == words.STAMPS
        return 2 if is_stamps and not (content.is_stamp or content.unit) else 1

    return sorted(contents, key=rank)


def _key(found: Meaning, kind: str, meanings: Mapping[str, Meaning], axles: int) -> str:
    """Return the key of a channel; "" if the kind of data has no such channel."""
    quantities = {meaning.quantity for meaning in meanings.values()}
    quantity = found.quantity
    if kind == "recorder" and quantity == words.VEHICLE_SPEED:
        # the speed that a vehicle shows is that of its wheels, unless these are recorded, too
        if not quantities & {words.WHEEL_SPEED, words.BOGIE_SPEED}:
            quantity = words.WHEEL_SPEED
            found = Meaning(quantity, 1)
        elif words.REFERENCE_SPEED not in quantities:
            quantity = words.REFERENCE_SPEED
    key = _KEYS[kind].get(quantity, "")
    if "{}" not in key:
        return key
    if not found.number or (kind == "braking_runs" and found.number > axles):
        return ""
    return key.format(found.number)


def _with_unit(key: str, content: Content, given_units: Mapping[str, str]) -> Channel:
    """Return the channel of a column with its unit. Raises ConfigError for an unknown unit."""
    for beginning, unit in given_units.items():
        if key.startswith(beginning):
            known = units.find(unit)
            if known is None:
                raise ConfigError(
                    f"--unit {beginning}={unit}: this unit is not known; write one as km/h, m/s, "
                    "rad/s, 1/min, ms"
                )
            return Channel(key, content.name, known.name, "--unit")
    named = words.column(content.name, content.unit)
    known = units.find(named.unit)
    if key == "time_s" and content.is_stamp:
        return Channel(key, content.name, "", "date and time")
    if known is not None and key != "brake_demand":
        return Channel(key, content.name, known.name, named.unit_from)
    if key == "time_s":
        return Channel(key, content.name, *_unit_of_stamps(content.numbers))
    of_key = units.find(words.column(key, "").unit)
    if of_key is not None and of_key.quantity in (units.FORCE, units.TORQUE):
        return Channel(key, content.name, of_key.name, _DEFAULT)
    return Channel(key, content.name, "", "")


def _unit_of_stamps(numbers: np.ndarray) -> tuple[str, str]:
    """Return (unit, where it is from) of stamps that are numbers without a unit."""
    known = numbers[np.isfinite(numbers)]
    steps = np.diff(known)
    steps = steps[steps > 0.0]
    if not steps.size:
        return "", ""
    step = float(np.median(steps))
    for unit, count in _SINCE_1970.items():
        if _EARLIEST_S < float(known[0]) / count < _LATEST_S:
            return unit, "size of the values, counted since 1970"
    if step < stamps.SHORTEST_STEP_S:
        return "", ""  # days of a spreadsheet, or refused when they are read
    if step >= _LONGEST_STEP:
        return "ms", f"the values: in s the samples would be {step:g} s apart"
    return "s", _DEFAULT


def _reason(found: Meaning | None) -> str:
    """Return why a column is not used."""
    if found is None:
        return UNKNOWN
    if found.quantity in _REASONS:
        return _REASONS[found.quantity]
    number = f" {found.number}" if found.number else ""
    return f"recognised as {found.quantity}{number}, but not needed, or another column was chosen"


def _remarks(
    kind: str,
    channels: Sequence[Channel],
    meanings: Mapping[str, Meaning],
    renumbered: Mapping[str, Meaning],
) -> list[str]:
    """Return what the user must know before a proposal is accepted.

    `renumbered` are columns whose numbers are not those of their names.
    """
    remarks = []
    for channel in channels:
        found = meanings.get(channel.column)
        if kind == "recorder" and found and found.quantity == words.VEHICLE_SPEED:
            if channel.key == "reference_speed_m_s":
                remarks.append(
                    f"'{channel.column}' is taken as the reference: right only if it is measured "
                    "without the wheels (GNSS, radar, optical); else leave it out with --map "
                    "reference_speed_m_s="
                )
            else:
                remarks.append(
                    f"'{channel.column}' is taken as the speed of a wheel, because no wheel is named"
                )
    rotations = [
        f"'{channel.column}'"
        for channel in channels
        if kind == "recorder" and channel.unit in units.of_quantity(units.ROTATION)
    ]
    if rotations:
        remarks.append(
            f"{', '.join(rotations)} are rotations: their speeds need the radius of the wheels, "
            "which is that of --vehicle"
        )
    corners = {name for name in meanings if set(words.words_of(name)) & set(words.CORNERS)}
    if corners - set(renumbered):
        remarks.append(
            "corners are numbered: 1 front left, 2 front right, 3 rear left, 4 rear right"
        )
    return list(dict.fromkeys(remarks))
