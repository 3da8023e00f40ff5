"""The stopping distance by mean values, as EN 14531-1 computes it, and the braked weight.

[N1] Cylinder force F_C = p A i_C eta_C + F_s,C; springs that release the brake are negative.
[N2] Force of the pads or blocks F_b = (F_C i_l + F_s,l) i_R eta_R + F_s,R.
[N3] Brake force at the rail F_B = F_b mu 2 r_s / D. Block brakes have r_s = D / 2.
[N4] Equivalent response time of a brake unit t_e,i = t_a + t_ab / 2, for a force that rises evenly.
[N5] Mean running resistance from v_0 to standstill F_Ra = A + 2/3 B v_0 + 1/2 C v_0**2.
[N6] t_e = sum(t_e,i F_B,i) / (sum(F_B,i) + F_ext), a_e = (sum(F_B,i) + F_ext) / m_dyn, and the
     distance s = v_0 t_e + v_0**2 / (2 a_e). m_dyn has the rotating masses, F_ext the resistance.
[N7] Adhesion that a unit requires: (F_B - m_rot a_e) / (m_st g).
[N8] Braked weight percentage lambda = C / s - D, by the speed of the stop. That of a vehicle is the
     least of all speeds; the braked weight is lambda times the mass.

Sources: RailwayBrakeCalculation by R. Pfaff (MIT licence), commits 9a780ab and c232ace: [N1] to
[N7] after EN 14531-1, constants of [N8] after UIC 544-1 and EN 16834. The standards themselves were
not at hand.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rollerrig.configs import table
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import GRAVITY_M_S2

KM_H = 3.6
# C in % m and D in % of [N8] by the speed in km/h
SINGLE_VEHICLE = {
    100: (52840.0, 10.0),
    120: (83634.0, 19.0),
    140: (119179.0, 19.0),
    160: (161280.0, 19.0),
}
TRAIN = {
    100: (61300.0, 8.9),
    120: (91633.0, 11.6),
    140: (130995.0, 11.6),
    150: (152640.0, 11.6),
    160: (176714.0, 11.6),
    180: (228219.0, 11.6),
    200: (287620.0, 11.6),
}
ASSESSMENTS = {"single": SINGLE_VEHICLE, "train": TRAIN}

# keys of one [[brake_unit]] of a file
UNIT_ROWS = (
    table.choice("name", "", (), "a word"),
    table.integer("number", 1, 1, 10_000, "equal units"),
    table.number("cylinder_pressure_Pa", None, 0.0, 2e6, "p of [N1]"),
    table.number("cylinder_area_m2", None, 1e-5, 10.0, "A of [N1]"),
    table.number("cylinder_ratio", 1.0, 0.01, 100.0, "i_C of [N1]"),
    table.number("cylinder_efficiency", 1.0, 0.01, 1.0, "eta_C of [N1]"),
    table.number("cylinder_spring_N", 0.0, -1e5, 0.0, "F_s,C of [N1]"),
    table.number("lever_ratio", 1.0, 0.01, 100.0, "i_l of [N2], before the slack adjuster"),
    table.number("lever_spring_N", 0.0, -1e5, 0.0, "F_s,l of [N2]"),
    table.number("rigging_ratio", 1.0, 0.01, 1000.0, "i_R of [N2]"),
    table.number("rigging_efficiency", 1.0, 0.01, 1.0, "eta_R of [N2]"),
    table.number("rigging_spring_N", 0.0, -1e5, 0.0, "F_s,R of [N2]"),
    table.number("friction", None, 0.001, 1.0, "mean friction of the pads or blocks, mu of [N3]"),
    table.number("friction_radius_m", 0.0, 0.0, 2.0, "r_s of [N3]; 0: block brake"),
    table.number("wheel_diameter_m", None, 0.1, 4.0, "D of [N3]"),
    table.number("delay_s", 0.0, 0.0, 60.0, "t_a of [N4]"),
    table.number("build_up_s", None, 0.0, 120.0, "t_ab of [N4]"),
    table.number("mass_kg", None, 1.0, 1e7, "m_st of [N7], on the wheels of this unit"),
    table.number("rotating_mass_kg", 0.0, 0.0, 1e6, "m_rot of [N7]"),
)
# keys at the top of a file
TRAIN_ROWS = (
    table.choice("title", "", (), "a sentence"),
    table.number("resistance_A_N", 0.0, 0.0, 1e6, "A of [N5]"),
    table.number("resistance_B_N_s_m", 0.0, 0.0, 1e5, "B of [N5]"),
    table.number("resistance_C_N_s2_m2", 0.0, 0.0, 1e4, "C of [N5]"),
    table.number("external_force_N", 0.0, -1e7, 1e7, "added to F_ext; falling track: negative"),
    table.number("gravity_m_s2", GRAVITY_M_S2, 9.7, 9.9, "g of [N7]"),
)
BRAKE_UNIT = "brake_unit"


class Unit(NamedTuple):
    """Equal brake units.

    force_N: F_B of one of them [N3]. response_s: t_e,i. cylinder_N, pads_N: [N1], [N2]; None where
    they are not known one by one. mass_kg, rotating_mass_kg: of one unit.
    """

    name: str
    number: int
    force_N: float
    response_s: float
    mass_kg: float
    rotating_mass_kg: float
    cylinder_N: float | None = None
    pads_N: float | None = None


class Vehicle(NamedTuple):
    """What is braked: its units, and its resistance by powers of the speed [N5]."""

    title: str
    units: tuple[Unit, ...]
    resistance: tuple[float, float, float]  # N, N s/m, N s2/m2
    external_force_N: float = 0.0
    gravity_m_s2: float = GRAVITY_M_S2

    @property
    def mass_kg(self) -> float:
        """The mass without that of rotation."""
        return sum(unit.number * unit.mass_kg for unit in self.units)

    @property
    def dynamic_mass_kg(self) -> float:
        """m_dyn of [N6]."""
        return self.mass_kg + sum(unit.number * unit.rotating_mass_kg for unit in self.units)

    @property
    def force_N(self) -> float:
        """The force of all brake units."""
        return sum(unit.number * unit.force_N for unit in self.units)


class Stop(NamedTuple):
    """The stop of a vehicle by [N6].

    resistance_N: F_Ra. response_s: t_e. deceleration_m_s2: a_e. adhesion: the largest of [N7].
    energy_J: of the brake units, without the response time.
    """

    speed_m_s: float
    resistance_N: float
    response_s: float
    deceleration_m_s2: float
    distance_m: float
    adhesion: float
    energy_J: float


def read(content: Mapping[str, Any], path: Path) -> Vehicle:
    """Return the vehicle of a file with [[brake_unit]]. Raises ConfigError."""
    given = dict(content)
    entries = given.pop(BRAKE_UNIT, None)
    if not isinstance(entries, list) or not entries:
        raise ConfigError(f"{path}: has no [[{BRAKE_UNIT}]]; give at least one")
    head = table.read(TRAIN_ROWS, given, str(path))
    units = tuple(
        _unit(table.read(UNIT_ROWS, entry, f"{path} [[{BRAKE_UNIT}]] {place}"), place)
        for place, entry in enumerate(entries, start=1)
    )
    return Vehicle(
        head["title"],
        units,
        (head["resistance_A_N"], head["resistance_B_N_s_m"], head["resistance_C_N_s2_m2"]),
        head["external_force_N"],
        head["gravity_m_s2"],
    )


def _unit(given: Mapping[str, Any], place: int) -> Unit:
    """Return the brake unit of the checked keys of UNIT_ROWS."""
    of_piston_N = given["cylinder_pressure_Pa"] * given["cylinder_area_m2"]
    cylinder_N = (
        of_piston_N * given["cylinder_ratio"] * given["cylinder_efficiency"]
        + given["cylinder_spring_N"]
    )  # [N1]
    before_N = cylinder_N * given["lever_ratio"] + given["lever_spring_N"]
    pads_N = (
        before_N * given["rigging_ratio"] * given["rigging_efficiency"] + given["rigging_spring_N"]
    )  # [N2]
    radius_m = given["friction_radius_m"] or 0.5 * given["wheel_diameter_m"]
    return Unit(
        name=given["name"] or f"unit {place}",
        number=given["number"],
        # springs stronger than the cylinder keep the brake released
        force_N=max(pads_N, 0.0) * given["friction"] * 2.0 * radius_m / given["wheel_diameter_m"],
        response_s=given["delay_s"] + 0.5 * given["build_up_s"],  # [N4]
        mass_kg=given["mass_kg"],
        rotating_mass_kg=given["rotating_mass_kg"],
        cylinder_N=cylinder_N,
        pads_N=pads_N,
    )


def stop(vehicle: Vehicle, speed_m_s: float) -> Stop:
    """Return the stop of a vehicle from a speed [N6]. Raises ConfigError if it does not stop."""
    a, b, c = vehicle.resistance
    resistance_N = a + 2.0 / 3.0 * b * speed_m_s + 0.5 * c * speed_m_s**2  # [N5]
    retarding_N = vehicle.force_N + resistance_N + vehicle.external_force_N
    if not retarding_N > 0.0:
        raise ConfigError(
            f"{vehicle.title or 'this vehicle'} does not stop from {speed_m_s:g} m/s: all forces "
            f"together retard it by {retarding_N:g} N; give it more brake force"
        )
    of_units = sum(unit.number * unit.force_N * unit.response_s for unit in vehicle.units)
    response_s = of_units / retarding_N
    deceleration_m_s2 = retarding_N / vehicle.dynamic_mass_kg
    braking_m = speed_m_s**2 / (2.0 * deceleration_m_s2)
    return Stop(
        speed_m_s=speed_m_s,
        resistance_N=resistance_N,
        response_s=response_s,
        deceleration_m_s2=deceleration_m_s2,
        distance_m=speed_m_s * response_s + braking_m,
        adhesion=max(adhesion(vehicle, unit, deceleration_m_s2) for unit in vehicle.units),
        energy_J=vehicle.force_N * braking_m,
    )


def adhesion(vehicle: Vehicle, unit: Unit, deceleration_m_s2: float) -> float:
    """Return the adhesion that a unit requires at a deceleration [N7]."""
    of_rail_N = unit.force_N - unit.rotating_mass_kg * deceleration_m_s2
    return of_rail_N / (unit.mass_kg * vehicle.gravity_m_s2)


def braked_weight_percentages(
    vehicle: Vehicle, assessment: Mapping[int, tuple[float, float]], most_km_h: float = 1e9
) -> dict[int, float]:
    """Return lambda in % by the speed in km/h [N8], of the speeds up to a largest one.

    `assessment` is one of ASSESSMENTS. Raises ConfigError if the vehicle does not stop.
    """
    found = {}
    for speed_km_h, (numerator, subtrahend) in assessment.items():
        if speed_km_h <= most_km_h:
            distance_m = stop(vehicle, speed_km_h / KM_H).distance_m
            found[speed_km_h] = numerator / distance_m - subtrahend
    return found


def response_s(time_s: Sequence[float], shares: Sequence[float]) -> float:
    """Return the equivalent response time of a measured force: the time that it lacks.

    time_s: times (n,) from the demand on. shares: the force as a share of the full one (n,). A
    force that rises evenly from t_a for t_ab has that of [N4].
    """
    lacking = 0.0
    for before in range(len(time_s) - 1):
        mean = 0.5 * (shares[before] + shares[before + 1])
        lacking += (1.0 - mean) * (time_s[before + 1] - time_s[before])
    return lacking
