"""What a test is judged by: each measure is a row with its unit, its least value and a formula.

All are computed from what the harness saw on the bus, over the braking: from the first brake demand to standstill or
the end. The reference stop [M1] is that of a vehicle which is given the demanded braking force and never slides; the
dry stop is this plant's own run of the same demands on clean rollers. The index of wheel damage [M3] is this project's,
and no standard's.

    [M1] s_ref = v0 t_e + v0^2 / (2 a_e),  a_e = (sum F_B + F_R) / m_dyn,  t_e = T_demand + T_valve
    [M2] shortfall = worst mean over 10 s of (a_demanded - a), with a_demanded from the pressure asked
    [M3] D = E_locked / 1 MJ + E_sliding / 100 MJ, of the worst wheelset

Source: [M1] EN 14531-1 in its simple form (equivalent response time and deceleration; recollection, to be checked
against the standard). Limits: one gradient; pressures as asked, so a demand that moves counts by its largest.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rollerrig.configs.vehicle import (
    AXLES,
    brake_torque_Nm_Pa,
    running_resistance,
    track_gradient,
    weighed_share,
)

STANDS_M_S, LOCKED_M_S = 0.01, 0.1
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

    @cached_property
    def braking(self) -> slice:
        """The rows that count: from the first brake demand to standstill, or to the end."""
        time_s = self.columns["time_s"]
        asked = [time for time, pressure_Pa in self.demands if pressure_Pa > 0.0]
        begin = min(int(np.searchsorted(time_s, asked[0] - 1e-9)), len(time_s) - 1) if asked else 0
        still = np.flatnonzero(self.columns["vehicle_speed_m_s"][begin:] <= STANDS_M_S)
        return slice(begin, begin + int(still[0]) + 1 if still.size else len(time_s))

    def braked(self, name: str) -> np.ndarray:
        """A column over the braking, shape (n,)."""
        return self.columns[name][self.braking]

    def wheelsets(self, name: str, unit: str = "") -> np.ndarray:
        """A signal of every wheelset over the braking, shape (4, n)."""
        return np.array([self.braked(f"{name}_{axle}{unit}") for axle in _AXLES])


def brake_force_N(record: Record, pressure_Pa: float | np.ndarray) -> Any:
    """Force at the rim of all wheelsets at a cylinder pressure, as the brake's data have it."""
    brake = record.scenario["brake"]
    return (
        AXLES
        * brake_torque_Nm_Pa(brake)
        / record.scenario["vehicle"]["wheel_radius_m"]
        * np.maximum(0.0, np.asarray(pressure_Pa) - brake["spring_pressure_Pa"])
    )


def dynamic_mass_kg(record: Record) -> float:
    """The mass with what its wheelsets' rotation adds."""
    v = record.scenario["vehicle"]
    return float(v["mass_kg"] + AXLES * v["wheelset_inertia_kgm2"] / v["wheel_radius_m"] ** 2)


def resistance_N(record: Record, speed_m_s: Any) -> Any:
    """Running resistance at a speed, with that of the gradient and of an extended model."""
    v, extra = record.scenario["vehicle"], record.scenario["mechanisms"]
    v = v | running_resistance(
        v, extra["running_resistance_force_N"], extra["running_resistance_speed_power"]
    )
    v |= track_gradient(v, extra["track_gradient_gradient"])
    return (
        v["resistance_A_N"]
        + v["resistance_B_N_s_m"] * speed_m_s
        + v["resistance_C_N_s2_m2"] * speed_m_s**2
    )


def demanded_m_s2(record: Record, pressure_Pa: Any, speed_m_s: Any) -> Any:
    """The deceleration that a demanded cylinder pressure would give without any sliding."""
    return (brake_force_N(record, pressure_Pa) + resistance_N(record, speed_m_s)) / dynamic_mass_kg(
        record
    )


def reference_distance_m(record: Record) -> float:
    """The computed stop [M1] at the largest pressure asked; NaN where nothing is braked."""
    v0 = float(record.braked("vehicle_speed_m_s")[0])
    # v^2 of the resistance has its mean over the distance at v0^2 / 2
    drag_N = float(resistance_N(record, v0 / math.sqrt(2.0)))
    asked_Pa = max((pressure_Pa for _, pressure_Pa in record.demands), default=0.0)
    force_N = float(
        brake_force_N(
            record, asked_Pa * weighed_share(record.scenario["air"], record.scenario["vehicle"])
        )
    )
    if force_N <= 0.0:
        return NAN
    equivalent_m_s2 = (force_N + drag_N) / dynamic_mass_kg(record)
    response_s = (
        record.scenario["brake"]["fill_time_constant_s"]
        + record.scenario["valve"]["fill_time_constant_s"]
    )
    return v0 * response_s + v0**2 / (2.0 * equivalent_m_s2)  # [M1]


def _until_standstill(record: Record, name: str) -> float:
    values, stands = record.braked(name), record.braked("vehicle_speed_m_s")[-1] <= STANDS_M_S
    return float(values[-1] - values[0]) if stands else NAN


def _rims(record: Record) -> np.ndarray:
    """Speed of each wheelset's rim over the braking, shape (4, n), as measured, m/s."""
    return record.scenario["vehicle"]["wheel_radius_m"] * record.wheelsets(
        "measured_speed", "_rad_s"
    )


def _sliding(record: Record) -> np.ndarray:
    """Sliding of each wheelset over the braking, shape (4, n), m/s."""
    return record.braked("vehicle_speed_m_s") - _rims(record)


def _active(record: Record) -> np.ndarray:
    """Where any dump valve does not fill, over the braking."""
    return np.any(record.wheelsets("valve") > 0.5, axis=0)


def _adhesion_used(record: Record) -> float:
    active = _active(record)
    return float(np.mean(record.wheelsets("adhesion")[:, active])) if active.any() else NAN


def _initial_adhesion(record: Record) -> float:
    """Adhesion of the first wheelset when it first slides as much as its adhesion is stated at."""
    sliding = _sliding(record)[0]
    begun = np.flatnonzero(sliding >= record.scenario["adhesion"]["initial_at_sliding_m_s"])
    return float(record.wheelsets("adhesion")[0, begun[0]]) if begun.size else NAN


def _shortfall_m_s2(record: Record) -> float:
    time_s, speed = record.braked("time_s"), record.braked("vehicle_speed_m_s")
    if len(time_s) < 2 or time_s[-1] - time_s[0] < SEGMENT_S:
        return NAN
    asked = demanded_m_s2(record, record.braked("brake_demand_Pa"), speed)
    gained = np.concatenate(([0.0], np.cumsum(0.5 * (asked[1:] + asked[:-1]) * np.diff(time_s))))
    first = np.flatnonzero(time_s <= time_s[-1] - SEGMENT_S + 1e-9)
    last = np.searchsorted(time_s, time_s[first] + SEGMENT_S - 1e-9)
    wanted, was = gained[last] - gained[first], speed[first] - speed[last]
    return float(np.max((wanted - was) / (time_s[last] - time_s[first])))  # [M2]


def _damage(record: Record) -> float:
    load_N = np.array(record.finals["wheel_load"])[:, np.newaxis]
    power = record.wheelsets("adhesion") * load_N * _sliding(record)
    locked = (_rims(record) < LOCKED_M_S) & (
        record.braked("vehicle_speed_m_s") > record.scenario["rig"]["lock_above_m_s"]
    )
    locked_J = np.sum(
        np.where(locked, power, 0.0)[:, 1:] * np.diff(record.braked("time_s")), axis=1
    )
    total = locked_J / (LOCKED_MJ * 1e6) + np.array(record.finals["sliding_work"]) / (
        SLIDING_MJ * 1e6
    )
    return float(total.max())  # [M3]


def _reference_error_m_s(record: Record) -> float:
    speed, reference = record.braked("vehicle_speed_m_s"), record.braked("wsp_reference_speed_m_s")
    counts = _active(record) & (speed > REFERENCE_ABOVE_M_S) & np.isfinite(reference)
    return float(np.max(np.abs(reference - speed)[counts])) if counts.any() else NAN


def _full_brake_after_s(record: Record) -> float:
    """From the first fault until every cylinder has 90 % of the demanded pressure."""
    time_s, wanted_Pa = record.columns["time_s"], 0.9 * record.columns["brake_demand_Pa"]
    pressed = np.all(
        [record.columns[f"cylinder_pressure_{axle}_Pa"] >= wanted_Pa for axle in _AXLES], axis=0
    )
    after = np.flatnonzero(pressed & (time_s >= record.fault_s))
    return float(time_s[after[0]] - record.fault_s) if after.size else math.inf


def _over(value: float, base: float) -> float:
    return value / base if base > 0.0 else NAN


@dataclass(frozen=True)
class Measure:
    """One row. `least` is the least value it can have at all, `absent` why it may be missing without harm."""

    name: str
    unit: str
    least: float
    text: str
    of: Callable[[Record], float]
    absent: str = ""


MEASURES: tuple[Measure, ...] = (
    Measure(
        "stop_distance",
        "m",
        0.0,
        "from the first brake demand to standstill",
        lambda r: _until_standstill(r, "position_m"),
    ),
    Measure(
        "stop_time",
        "s",
        0.0,
        "from the first brake demand to standstill",
        lambda r: _until_standstill(r, "time_s"),
    ),
    Measure(
        "stop_distance_over_reference",
        "",
        0.0,
        "stop distance over the computed one, EN 14531",
        lambda r: _over(_until_standstill(r, "position_m"), reference_distance_m(r)),
    ),
    Measure(
        "stop_distance_over_dry",
        "",
        0.0,
        "stop distance over that of the dry stop",
        lambda r: _over(_until_standstill(r, "position_m"), r.dry_m),
    ),
    Measure(
        "longest_lock",
        "s",
        0.0,
        "longest lock of a wheelset above lock_above_m_s",
        lambda r: max(r.finals["longest_lock"]),
    ),
    Measure(
        "sliding_max",
        "m/s",
        0.0,
        "largest sliding of a wheelset",
        lambda r: float(_sliding(r).max()),
    ),
    Measure(
        "sliding_mean",
        "m/s",
        0.0,
        "mean sliding of the worst wheelset",
        lambda r: float(_sliding(r).mean(axis=1).max()),
    ),
    Measure(
        "air_consumption",
        "NL",
        0.0,
        "air that the brake cylinders used, all axles",
        lambda r: r.finals["air_consumption"][0],
    ),
    Measure(
        "reservoir_least",
        "Pa",
        0.0,
        "least pressure of the auxiliary reservoir",
        lambda r: (
            r.finals["reservoir_least"][0] if r.scenario["air"]["reservoir_volume_L"] > 0.0 else NAN
        ),
        "the vehicle has no reservoir: its air never runs out",
    ),
    Measure(
        "sand_used",
        "kg",
        0.0,
        "sand that all sanders took from their boxes",
        lambda r: (
            sum(r.finals["sand_taken"])
            if any(r.scenario["sanders"][key] for key in ("axle", "second_axle"))
            else NAN
        ),
        "the vehicle has no sander",
    ),
    Measure(
        "utilised_adhesion",
        "",
        0.0,
        "mean adhesion of all axles while the WSP acts",
        _adhesion_used,
        "the WSP did not act",
    ),
    Measure(
        "initial_adhesion",
        "",
        0.0,
        "adhesion of the first wheelset when it first slides by initial_at_sliding_m_s",
        _initial_adhesion,
        "the first wheelset did not slide so much",
    ),
    Measure(
        "deceleration_shortfall",
        "m/s2",
        -20.0,
        "demanded less achieved deceleration, worst segment of 10 s",
        _shortfall_m_s2,
        "the braking was shorter than 10 s",
    ),
    Measure(
        "wheel_damage_index",
        "",
        0.0,
        "energy of locks over 1 MJ plus of sliding over 100 MJ, worst wheelset",
        _damage,
    ),
    Measure(
        "wheel_flat",
        "mm",
        0.0,
        "longest flat that locks have made",
        lambda r: (
            1e3 * max(r.finals["flat_length"]) if r.scenario["flats"]["wear_mm3_J"] > 0.0 else NAN
        ),
        "wheels stay round: flats.wear_mm3_J is 0",
    ),
    Measure(
        "reference_speed_error",
        "m/s",
        0.0,
        "largest error of the unit's reference speed while it acts, above 5 m/s",
        _reference_error_m_s,
        "the unit tells no reference speed, or did not act",
    ),
    Measure(
        "vents",
        "",
        0.0,
        "times a dump valve began to vent, all axles",
        lambda r: float(sum(r.finals["vents"])),
    ),
    Measure(
        "full_brake_after_fault",
        "s",
        0.0,
        "from the first fault until every cylinder has 90 % of the demand",
        _full_brake_after_s,
    ),
)
BY_NAME = {one.name: one for one in MEASURES}
