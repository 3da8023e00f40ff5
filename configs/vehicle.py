"""Constants and formulas of the vehicle that all parts of the product share.

[1] T = A i eta 2 mu r n (p - p_spring): two pads press on each disc.
[2] R = A + B v + C v^2. A changed resistance changes one of the coefficients, a gradient changes A.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from rollerrig.configs.errors import ConfigError

# Numbers of axles that a vehicle may have, and the one of the coach, which is the default.
ALLOWED_AXLES = (2, 4, 6, 8, 10, 12)
_ALLOWED_TEXT = ", ".join(map(str, ALLOWED_AXLES))
COACH_AXLES = 4
AXLES_OF_BOGIE = 2
# Axles of one group: a group has its drives, its speed unit, its brake I/O and its WSP unit.
AXLES_OF_GROUP = 4
# the most axles and groups that a vehicle has: arrays of a fixed size have room for them
MOST_AXLES = max(ALLOWED_AXLES)
MOST_GROUPS = -(-MOST_AXLES // AXLES_OF_GROUP)


class Kind(NamedTuple):
    """What decides which axles, groups, channels, nodes and registers a vehicle has."""

    axles: int = COACH_AXLES
    dynamic_brake: bool = False
    magnetic_track_brake: bool = False

    @property
    def groups(self) -> int:
        """The number of groups of axles, each with its drives, speed unit, brake I/O and unit."""
        return -(-self.axles // AXLES_OF_GROUP)

    @property
    def bogies(self) -> int:
        return self.axles // AXLES_OF_BOGIE

    @property
    def unit_axles(self) -> int:
        """The axles of a group with the most axles."""
        return min(self.axles, AXLES_OF_GROUP)

    def axles_of_group(self, group: int) -> int:
        """Return the number of axles of a group; 0 is the leading one. The last may have two."""
        return min(self.axles - AXLES_OF_GROUP * group, AXLES_OF_GROUP)


COACH = Kind()

# the table that makes a scenario one of several cars
TRAIN = "train"
# the most cars of a train
MOST_CARS = 16

# equipment that adds channels, objects on the bus and registers to a vehicle
DYNAMIC_BRAKE = "dynamic_brake"
MAGNETIC_TRACK_BRAKE = "magnetic_track_brake"
# the section of a scenario with each equipment, and the key that lists where the vehicle has it
EQUIPMENT_KEYS = {DYNAMIC_BRAKE: "axles", MAGNETIC_TRACK_BRAKE: "bogies"}


def wheelsets_of(place: int, axles: int) -> range:
    """Return the wheelsets, counted from 1, of a place: n wheelset n, -n bogie n, 0 all `axles`."""
    if place > 0:
        return range(place, place + 1)
    if place < 0:
        last = -place * AXLES_OF_BOGIE
        return range(last - AXLES_OF_BOGIE + 1, last + 1)
    return range(1, axles + 1)


def check_axles(axles: Any, where: str) -> None:
    """Raise ConfigError for a number of axles that no vehicle has; `where` names file and key."""
    if type(axles) is not int or axles not in ALLOWED_AXLES:
        raise ConfigError(f"{where} = {axles!r}; it must be one of {_ALLOWED_TEXT}")


# the two magnets of the dump valve of an axle, as bits; without energised magnets the cylinder
# fills
HOLD_MAGNET = 1
VENT_MAGNET = 2
GRAVITY_M_S2 = 9.80665  # standard gravity, ISO 80000-3
# at this speed a power of the relative speed is 1, so a coefficient has its value there
MIDDLE_SPEED_M_S = 20.0
# the coefficient of the running resistance [2] for each power of the speed
RESISTANCE = {0.0: "resistance_A_N", 1.0: "resistance_B_N_s_m", 2.0: "resistance_C_N_s2_m2"}


def equipment_of(sections: Mapping[str, Any]) -> frozenset[str]:
    """Return the equipment of the vehicle of a resolved scenario."""
    found = []
    for name, key in EQUIPMENT_KEYS.items():
        section = sections.get(name)
        if isinstance(section, Mapping) and section.get(key):
            found.append(name)
    return frozenset(found)


def kind_of(resolved: Mapping[str, Any], where: str) -> Kind:
    """Return the kind of the vehicle of a resolved scenario.

    `where` names the file. Raises ConfigError for a train, and for a number of axles that is not
    allowed.
    """
    if TRAIN in resolved:
        raise ConfigError(
            f"{where} is a train, and this is for one vehicle; allowed is a car of it: the folders "
            "car_1, car_2 ... of its run, or 'rollerrig run' for the whole train"
        )
    section = resolved.get("vehicle")
    axles = section.get("axles", COACH_AXLES) if isinstance(section, Mapping) else COACH_AXLES
    check_axles(axles, f"{where} [vehicle] axles")
    equipment = equipment_of(resolved)
    return Kind(axles, DYNAMIC_BRAKE in equipment, MAGNETIC_TRACK_BRAKE in equipment)


def bodies(vehicle: Mapping[str, Any]) -> int:
    """Return the number of bodies of a checked section [vehicle].

    Raises ConfigError where they cannot share the bogies.
    """
    bogies_per_body = vehicle["bogies_per_body"]
    bogies = vehicle["axles"] // AXLES_OF_BOGIE
    number, remainder = divmod(bogies, bogies_per_body)
    if remainder or number == 0:
        raise ConfigError(
            f"[vehicle] axles = {vehicle['axles']} are {bogies} bogies, which bogies_per_body = "
            f"{bogies_per_body} does not divide; change one of them"
        )
    return number


def axle_positions_m(vehicle: Mapping[str, Any]) -> list[float]:
    """Return the distance of each wheelset behind the first. Raises ConfigError as `bodies`."""
    base_m = vehicle["bogie_wheelbase_m"]
    found: list[float] = []
    for body in range(bodies(vehicle)):
        for bogie in range(vehicle["bogies_per_body"]):
            first_m = body * vehicle["body_distance_m"] + bogie * vehicle["bogie_distance_m"]
            found += [first_m, first_m + base_m]
    return found


def brake_torque_Nm_Pa(brake: Mapping[str, float]) -> float:
    """Return the brake torque of a wheelset in N m for each Pa above the spring pressure [1]."""
    return (
        brake["cylinder_area_m2"]
        * brake["lever_ratio"]
        * brake["efficiency"]
        * 2.0
        * brake["pad_friction"]
        * brake["disc_radius_m"]
        * brake["discs"]
    )


def brake_factors(sections: Mapping[str, Mapping[str, Any]]) -> list[float]:
    """Return the factor of the brake torque of each axle of checked sections.

    Raises ConfigError where [brake] axle_factors does not have one number for each axle.
    """
    axles = sections["vehicle"]["axles"]
    factors = list(sections["brake"].get("axle_factors", ()))
    if factors and len(factors) != axles:
        raise ConfigError(
            f"[brake] axle_factors has {len(factors)} numbers, and the vehicle has {axles} axles; "
            "give one number for each axle, or none"
        )
    return factors or [1.0] * axles


def weighed_share(air: Mapping[str, float], vehicle: Mapping[str, Any]) -> float:
    """Return the share of the demanded pressure that the weighing valve passes at this vehicle
    mass.
    """
    if air["weighed_mass_kg"] == 0.0:
        return 1.0
    loaded = vehicle["mass_kg"] / air["weighed_mass_kg"]
    return float(min(max(loaded, air["weighed_least"]), 1.0))


def running_resistance(
    vehicle: Mapping[str, Any], force_N: float, speed_power: float
) -> dict[str, Any]:
    """R = R_0 + force (v / 20 m/s)^speed_power.

    Raises ConfigError for a power that is not 0, 1 or 2.
    """
    if speed_power not in RESISTANCE:
        raise ConfigError(
            f"[mechanisms] running_resistance_speed_power = {speed_power:g}; allowed are 0 "
            "(constant), 1 and 2 (with the speed, with its square)"
        )
    key = RESISTANCE[speed_power]
    return {key: vehicle[key] + force_N / MIDDLE_SPEED_M_S**speed_power}


def track_gradient(vehicle: Mapping[str, Any], gradient: float) -> dict[str, Any]:
    """R = R_0 + M g gradient; uphill is positive"""
    return {
        "resistance_A_N": vehicle["resistance_A_N"] + GRAVITY_M_S2 * vehicle["mass_kg"] * gradient
    }
