"""What a test is judged by: each measure is a row with its unit, its least value and a formula.

All are computed from what the harness saw on the bus, over the braking: from the first brake demand
to standstill or the end. The reference stop [M1] is that of a vehicle which is given the demanded
braking force and never slides; the dry stop is this plant's own run of the same demands on clean
rollers. The index of wheel damage [M3] is this project's, and no standard's.

    [M1] s_ref = v0 t_e + v0^2 / (2 a_e),  a_e = (sum F_B + F_R) / m_dyn,  t_e = T_demand + T_valve
    [M2] shortfall = worst mean over 10 s of (a_demanded - a), with a_demanded from the pressure asked
    [M3] D = E_locked / 1 MJ + E_sliding / 100 MJ, of the worst wheelset

Source: [M1] EN 14531-1 in its simple form (equivalent response time and deceleration; recollection,
to be checked against the standard). Limits: one gradient; pressures as asked, so a demand that moves
counts by its largest.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rollerrig.configs.vehicle import AXLES, brake_torque_Nm_Pa, running_resistance, track_gradient

STANDS_M_S, LOCKED_M_S, LOCK_COUNTS_ABOVE_M_S = 0.01, 0.1, 3.0
SEGMENT_S = 10.0
REFERENCE_ABOVE_M_S = 5.0
LOCKED_MJ, SLIDING_MJ = 1.0, 100.0
_AXLES = range(1, AXLES + 1)
NAN = float("nan")


@dataclass(frozen=True)
class Record:
    """What a sequence left behind.

    `columns`: name to values, shape (n,), one a bus cycle. `demands`: (time_s, pressure_Pa) asked.
    `finals`: quantities read at the end, by signal. `scenario`: the resolved one. `dry_m`: the
    distance of the dry stop, NaN where none was run. `fault_s`: when the first fault began.
    """

    columns: Mapping[str, np.ndarray]
    demands: tuple[tuple[float, float], ...]
    finals: Mapping[str, tuple[float, ...]]
    scenario: Mapping[str, Any]
    dry_m: float = NAN
    fault_s: float = NAN


@dataclass(frozen=True)
class Braking:
    """The part of a record that counts: rows begin..end, and the largest pressure asked."""

    begin: int
    end: int
    stands: bool
    demand_Pa: float


def braking(record: Record) -> Braking:
    """From the first brake demand to standstill, or to the end."""
    time_s, speed = record.columns["time_s"], record.columns["vehicle_speed_m_s"]
    asked = [time for time, pressure_Pa in record.demands if pressure_Pa > 0.0]
    begin = int(np.searchsorted(time_s, asked[0] - 1e-9)) if asked else 0
    begin = min(begin, len(time_s) - 1)
    still = np.flatnonzero(speed[begin:] <= STANDS_M_S)
    end = begin + int(still[0]) if still.size else len(time_s) - 1
    largest = max((pressure_Pa for _, pressure_Pa in record.demands), default=0.0)
    return Braking(begin, end, bool(still.size), largest)


def brake_force_N(record: Record, pressure_Pa: float | np.ndarray) -> Any:
    """Force at the rim of all wheelsets at a cylinder pressure, as the brake's data have it."""
    brake = record.scenario["brake"]
    return AXLES * brake_torque_Nm_Pa(brake) / record.scenario["vehicle"]["wheel_radius_m"] * np.maximum(
        0.0, np.asarray(pressure_Pa) - brake["spring_pressure_Pa"])


def dynamic_mass_kg(record: Record) -> float:
    """The mass with what its wheelsets' rotation adds."""
    v = record.scenario["vehicle"]
    return float(v["mass_kg"] + AXLES * v["wheelset_inertia_kgm2"] / v["wheel_radius_m"] ** 2)


def resistance_N(record: Record, speed_m_s: Any) -> Any:
    """Running resistance at a speed, with that of the gradient and of an extended model."""
    v, extra = record.scenario["vehicle"], record.scenario["mechanisms"]
    v = v | running_resistance(v, extra["running_resistance_force_N"], extra["running_resistance_speed_power"])
    v |= track_gradient(v, extra["track_gradient_gradient"])
    return (v["resistance_A_N"] + v["resistance_B_N_s_m"] * speed_m_s
            + v["resistance_C_N_s2_m2"] * speed_m_s**2)


def reference_distance_m(record: Record) -> float:
    """The computed stop [M1]; NaN where nothing is braked."""
    part = braking(record)
    v0 = float(record.columns["vehicle_speed_m_s"][part.begin])
    # v^2 of the resistance has its mean over the distance at v0^2 / 2
    drag_N = float(resistance_N(record, v0 / math.sqrt(2.0)))
    force_N = float(brake_force_N(record, part.demand_Pa))
    if force_N <= 0.0:
        return NAN
    equivalent_m_s2 = (force_N + drag_N) / dynamic_mass_kg(record)
    response_s = (record.scenario["brake"]["fill_time_constant_s"]
                  + record.scenario["valve"]["fill_time_constant_s"])
    return v0 * response_s + v0**2 / (2.0 * equivalent_m_s2)  # [M1]


# -- the measures

def _distance_m(record: Record) -> float:
    part, position = braking(record), record.columns["position_m"]
    return float(position[part.end] - position[part.begin]) if part.stands else NAN


def _time_s(record: Record) -> float:
    part, time_s = braking(record), record.columns["time_s"]
    return float(time_s[part.end] - time_s[part.begin]) if part.stands else NAN


def _sliding(record: Record) -> np.ndarray:
    """Sliding of each wheelset over the braking, shape (4, n), from measured speeds, m/s."""
    part, radius_m = braking(record), record.scenario["vehicle"]["wheel_radius_m"]
    rows = slice(part.begin, part.end + 1)
    speed = record.columns["vehicle_speed_m_s"][rows]
    return np.array([speed - radius_m * record.columns[f"measured_speed_{axle}_rad_s"][rows]
                     for axle in _AXLES])


def _active(record: Record) -> np.ndarray:
    """Where any dump valve does not fill, over the braking."""
    part = braking(record)
    rows = slice(part.begin, part.end + 1)
    return np.any([record.columns[f"valve_{axle}"][rows] > 0.5 for axle in _AXLES], axis=0)


def _adhesion_used(record: Record) -> float:
    part, active = braking(record), _active(record)
    if not active.any():
        return NAN
    rows = slice(part.begin, part.end + 1)
    return float(np.mean([record.columns[f"adhesion_{axle}"][rows][active] for axle in _AXLES]))


def _shortfall_m_s2(record: Record) -> float:
    part = braking(record)
    rows = slice(part.begin, part.end + 1)
    time_s, speed = record.columns["time_s"][rows], record.columns["vehicle_speed_m_s"][rows]
    if len(time_s) < 2 or time_s[-1] - time_s[0] < SEGMENT_S:
        return NAN
    asked = (brake_force_N(record, record.columns["brake_demand_Pa"][rows])
             + resistance_N(record, speed)) / dynamic_mass_kg(record)
    gained = np.concatenate(([0.0], np.cumsum(0.5 * (asked[1:] + asked[:-1]) * np.diff(time_s))))
    first = np.flatnonzero(time_s <= time_s[-1] - SEGMENT_S + 1e-9)
    last = np.searchsorted(time_s, time_s[first] + SEGMENT_S - 1e-9)
    length_s = time_s[last] - time_s[first]
    wanted, was = gained[last] - gained[first], speed[first] - speed[last]
    return float(np.max((wanted - was) / length_s))  # [M2]


def _damage(record: Record) -> float:
    part, radius_m = braking(record), record.scenario["vehicle"]["wheel_radius_m"]
    rows = slice(part.begin, part.end + 1)
    time_s, speed = record.columns["time_s"][rows], record.columns["vehicle_speed_m_s"][rows]
    locked_J = []
    for axle, slides in zip(_AXLES, _sliding(record), strict=True):
        rim = radius_m * record.columns[f"measured_speed_{axle}_rad_s"][rows]
        load_N = record.finals["wheel_load"][axle - 1]
        power = record.columns[f"adhesion_{axle}"][rows] * load_N * slides
        locked = (rim < LOCKED_M_S) & (speed > LOCK_COUNTS_ABOVE_M_S)
        locked_J.append(np.sum(np.where(locked, power, 0.0)[1:] * np.diff(time_s)))
    total = np.array(locked_J) / (LOCKED_MJ * 1e6) + np.array(
        record.finals["sliding_work"]) / (SLIDING_MJ * 1e6)
    return float(total.max())  # [M3]


def _reference_error_m_s(record: Record) -> float:
    part, active = braking(record), _active(record)
    rows = slice(part.begin, part.end + 1)
    speed = record.columns["vehicle_speed_m_s"][rows]
    reference = record.columns["wsp_reference_speed_m_s"][rows]
    counts = active & (speed > REFERENCE_ABOVE_M_S) & np.isfinite(reference)
    return float(np.max(np.abs(reference - speed)[counts])) if counts.any() else NAN


def _full_brake_after_s(record: Record) -> float:
    """From the first fault until every cylinder has 90 % of the demanded pressure."""
    time_s = record.columns["time_s"]
    pressed = np.all([record.columns[f"cylinder_pressure_{axle}_Pa"]
                      >= 0.9 * record.columns["brake_demand_Pa"] for axle in _AXLES], axis=0)
    after = np.flatnonzero(pressed & (time_s >= record.fault_s))
    return float(time_s[after[0]] - record.fault_s) if after.size else math.inf


def _over(value: float, base: float) -> float:
    return value / base if base > 0.0 else NAN


@dataclass(frozen=True)
class Measure:
    """One row. `least` is the least value it can have at all."""

    name: str
    unit: str
    least: float
    text: str
    of: Callable[[Record], float]


MEASURES: tuple[Measure, ...] = (
    Measure("stop_distance", "m", 0.0, "from the first brake demand to standstill", _distance_m),
    Measure("stop_time", "s", 0.0, "from the first brake demand to standstill", _time_s),
    Measure("stop_distance_over_reference", "", 0.0, "stop distance over the computed one, EN 14531",
            lambda r: _over(_distance_m(r), reference_distance_m(r))),
    Measure("stop_distance_over_dry", "", 0.0, "stop distance over that of the dry stop",
            lambda r: _over(_distance_m(r), r.dry_m)),
    Measure("longest_lock", "s", 0.0, "longest lock of a wheelset above the cut-off speed",
            lambda r: max(r.finals["longest_lock"])),
    Measure("sliding_max", "m/s", 0.0, "largest sliding of a wheelset",
            lambda r: float(_sliding(r).max())),
    Measure("sliding_mean", "m/s", 0.0, "mean sliding of the worst wheelset",
            lambda r: float(_sliding(r).mean(axis=1).max())),
    Measure("air_consumption", "NL", 0.0, "air that the brake cylinders used, all axles",
            lambda r: r.finals["air_consumption"][0]),
    Measure("utilised_adhesion", "", 0.0, "mean adhesion of all axles while the WSP acts",
            _adhesion_used),
    Measure("deceleration_shortfall", "m/s2", -20.0, "demanded less achieved deceleration, worst "
            "segment of 10 s", _shortfall_m_s2),
    Measure("wheel_damage_index", "", 0.0, "energy of locks over 1 MJ plus of sliding over 100 MJ, "
            "worst wheelset", _damage),
    Measure("reference_speed_error", "m/s", 0.0, "largest error of the unit's reference speed while "
            "it acts, above 5 m/s", _reference_error_m_s),
    Measure("vents", "", 0.0, "times a dump valve began to vent, all axles",
            lambda r: float(sum(r.finals["vents"]))),
    Measure("full_brake_after_fault", "s", 0.0, "from the first fault until every cylinder has 90 % "
            "of the demand", _full_brake_after_s),
)
BY_NAME = {one.name: one for one in MEASURES}
# a measure that may be missing without harm, and why
MAY_BE_ABSENT = {
    "reference_speed_error": "the unit tells no reference speed, or did not act",
    "utilised_adhesion": "the WSP did not act",
    "deceleration_shortfall": "the braking was shorter than 10 s",
}
