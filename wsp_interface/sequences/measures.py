"""The measures by which a test is judged: rows with a unit, a least value and a formula.

All are computed from the true motion, which node 127 sends to the harness, over the braking: from
the first brake demand to standstill (`braking`) or to the end. A speed sensor may be faulty, so no
measure uses the measured speeds. What follows from these is shown separately, and marked as
measured.

The reference stop [M1] is that of a vehicle which gets the demanded braking force and never slides.
The dry stop is a run of this plant with the same demands on clean rollers. The index of wheel
damage [M3] belongs to this project; it is in no standard.

    [M1] s_ref = v0 t_e + v0^2 / (2 a_e),  a_e = (sum F_B + F_R) / m_dyn,  t_e = T_demand + T_valve
         F_R = A + 2/3 B v0 + 1/2 C v0^2, the mean over the distance at a constant deceleration
    [M2] shortfall = worst mean over 10 s of (a_demanded - a), a_demanded by the demand
    [M3] D = E_locked / 1 MJ + E_sliding / 100 MJ, of the worst wheelset
    [M4] s_rail = v0 t_e + v0^2 / (2 a_r),  a_r = min(a_e, (tau_i m g + F_R) / m_dyn)

The stop [M4] is that of a vehicle which uses on all wheelsets, from the response of its brake to
standstill, the initial adhesion tau_i of the run itself. So a distance over s_rail compares a unit
with what the rail gave in this test, whatever this was: a unit that lets the wheels clean the rail
is below 1, and locked wheels are above it.

Source: [M1] EN 14531-1 in its simple form (equivalent response time and deceleration; recollection,
to be checked against the standard). [M4] this project, after the idea of CEN/TR 17315:2019, which
relates the distance to the adhesion of the test (recollection, to be checked against it). Limits:
one gradient; if the demand changes, [M1] uses the largest one.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import (
    brake_factors,
    brake_torque_Nm_Pa,
    running_resistance,
    track_gradient,
    weighed_share,
)
from rollerrig.wsp_interface import braking
from rollerrig.wsp_interface.sequences.record import NAN, Record

SEGMENT_S = 10.0  # of [M2]
REFERENCE_ABOVE_M_S = 5.0  # below this speed the unit's reference speed is not judged
# energies of [M3] that count as 1
LOCKED_MJ = 1.0
SLIDING_MJ = 100.0
FULL_BRAKE = 0.9  # share of the demanded pressure that counts as full brake
NORMAL_PRESSURE_PA = 101325.0  # of a normal litre of air
GRAVITY_M_S2 = 9.80665
_TINY_S = 1e-9


def brake_force_N(record: Record, pressure_Pa: float | np.ndarray) -> Any:
    """Return the force at the rim of all wheelsets at a cylinder pressure."""
    brake = record.scenario["brake"]
    return (
        sum(brake_factors(record.scenario))
        * brake_torque_Nm_Pa(brake)
        / record.scenario["vehicle"]["wheel_radius_m"]
        * np.maximum(0.0, np.asarray(pressure_Pa) - brake["spring_pressure_Pa"])
    )


def dynamic_mass_kg(record: Record) -> float:
    """Return the mass of the vehicle, with the equivalent mass of its wheelsets and motors."""
    vehicle = record.scenario["vehicle"]
    inertia_kgm2 = record.kind.axles * vehicle["wheelset_inertia_kgm2"]
    motors = record.scenario.get("dynamic_brake")
    if motors:
        inertia_kgm2 += len(motors["axles"]) * motors["rotor_inertia_kgm2"]
    return float(vehicle["mass_kg"] + inertia_kgm2 / vehicle["wheel_radius_m"] ** 2)


def _resistance(record: Record) -> tuple[float, float, float]:
    """Return A, B and C of the running resistance, with gradient and that of an extended model."""
    extension = record.scenario["mechanisms"]
    vehicle = record.scenario["vehicle"]
    vehicle = vehicle | running_resistance(
        vehicle,
        extension["running_resistance_force_N"],
        extension["running_resistance_speed_power"],
    )
    vehicle |= track_gradient(vehicle, extension["track_gradient_gradient"])
    return (
        vehicle["resistance_A_N"],
        vehicle["resistance_B_N_s_m"],
        vehicle["resistance_C_N_s2_m2"],
    )


def resistance_N(record: Record, speed_m_s: Any) -> Any:
    """Return the running resistance at a speed, with the gradient and that of an extended model."""
    constant_N, linear_N_s_m, square_N_s2_m2 = _resistance(record)
    return constant_N + linear_N_s_m * speed_m_s + square_N_s2_m2 * speed_m_s**2


def mean_resistance_N(
    constant_N: float, linear_N_s_m: float, square_N_s2_m2: float, initial_m_s: float
) -> float:
    """Return the mean of a running resistance over a stop with constant deceleration [M1]."""
    linear_N = linear_N_s_m * 2.0 / 3.0 * initial_m_s
    return constant_N + linear_N + square_N_s2_m2 * initial_m_s**2 / 2.0


def equivalent_distance_m(initial_m_s: float, response_s: float, equivalent_m_s2: float) -> float:
    """Return the distance of a stop with an equivalent response time and deceleration [M1]."""
    return initial_m_s * response_s + initial_m_s**2 / (2.0 * equivalent_m_s2)


def demanded_m_s2(record: Record, pressure_Pa: Any, speed_m_s: Any) -> Any:
    """Return the deceleration of a demanded cylinder pressure without any sliding."""
    force_N = brake_force_N(record, pressure_Pa) + resistance_N(record, speed_m_s)
    return force_N / dynamic_mass_kg(record)


def _response_s(record: Record) -> float:
    """Return the equivalent response time of the brake [M1]."""
    brake, valve = record.scenario["brake"], record.scenario["valve"]
    return float(brake["fill_time_constant_s"] + valve["fill_time_constant_s"])


def _full_force_N(record: Record) -> float:
    """Return the force at the rims of the largest demand, as the load weighing lowers it."""
    demanded_Pa = max((pressure_Pa for _, pressure_Pa in record.demands), default=0.0)
    share = weighed_share(record.scenario["air"], record.scenario["vehicle"])
    return float(brake_force_N(record, demanded_Pa * share))


def reference_distance_m(record: Record) -> float:
    """Return the computed stop distance [M1] at the largest demand; NaN if nothing brakes."""
    return _computed_distance_m(record, _full_force_N(record))


def rail_distance_m(record: Record) -> float:
    """Return the distance of a stop that uses the initial adhesion of the run [M4].

    NaN if nothing brakes, or if the first wheelset did not slide enough to show it.
    """
    weight_N = GRAVITY_M_S2 * record.scenario["vehicle"]["mass_kg"]
    usable_N = initial_adhesion(record) * weight_N
    return _computed_distance_m(record, min(usable_N, _full_force_N(record)))


def _computed_distance_m(record: Record, force_N: float) -> float:
    """Return the distance of a stop with a constant force at the rims; NaN without a force."""
    if not force_N > 0.0:
        return NAN
    v0 = float(record.whole("vehicle_speed_m_s")[0])
    drag_N = mean_resistance_N(*_resistance(record), v0)
    equivalent_m_s2 = (force_N + drag_N) / dynamic_mass_kg(record)
    return equivalent_distance_m(v0, _response_s(record), equivalent_m_s2)


def _until_standstill(record: Record, name: str) -> float:
    """Return the change of a column over the braking; NaN if the vehicle does not stop.

    With bounds of speed, it is the change in the steps that count.
    """
    if not record.slow_enough:
        return NAN
    if record.bounded:
        return float(record.steps(name).sum())
    values = record.braked(name)
    return float(values[-1] - values[0])


def sliding(record: Record) -> np.ndarray:
    """Return the sliding of each wheelset over the braking, shape (axles, n), in m/s."""
    return record.wheelsets("sliding", "_m_s")


def measured_sliding(record: Record) -> np.ndarray:
    """Return the sliding that follows from the measured speeds, shape (axles, n), in m/s.

    The unit sees this sliding. It is wrong if a speed sensor is.
    """
    radius_m = record.scenario["vehicle"]["wheel_radius_m"]
    rim_m_s = radius_m * record.wheelsets("measured_speed", "_rad_s")
    return record.braked("vehicle_speed_m_s") - rim_m_s


def largest_m_s(sliding_m_s: np.ndarray) -> float:
    """Return the largest sliding of a wheelset."""
    return float(sliding_m_s.max())


def mean_of_worst_m_s(sliding_m_s: np.ndarray) -> float:
    """Return the mean sliding of the worst wheelset; NaN without a sample."""
    if not sliding_m_s.size:
        return NAN
    return float(sliding_m_s.mean(axis=1).max())


def _longest_s(record: Record, of_wheelsets: np.ndarray) -> float:
    """Return the longest time for which a condition of a wheelset, shape (axles, n), holds."""
    time_s = record.whole("time_s")
    return max(braking.longest_stretch_s(time_s, of_one) for of_one in of_wheelsets)


def _longest_lock_s(record: Record) -> float:
    """Return the longest lock of a wheelset: as the rig counts it, or between the bounds."""
    if record.bounded:
        return _longest_s(record, record.locked)
    return max(record.finals["longest_lock"])


def _longest_deep_slide_s(record: Record) -> float:
    """Return the longest time for which one wheelset slid deeply."""
    sliding_m_s = record.wheelsets_whole("sliding", "_m_s")
    # which speeds count is up to the record
    deep = braking.is_deep(sliding_m_s, record.whole("vehicle_speed_m_s"), 0.0) & record.fast
    return _longest_s(record, deep)


def _locked_distance_m(record: Record) -> float:
    """Return the distance that the worst wheelset ran locked, at every speed that counts."""
    every_speed = record if record.bounded else record.between(0.0, math.inf)
    run_m = every_speed.steps("position_m")
    return float((every_speed.locked[:, :-1] * run_m).sum(axis=1).max())


def as_measured(record: Record) -> dict[str, float]:
    """Return the measures of sliding as they follow from the measured speeds, by name."""
    sliding_m_s = measured_sliding(record)
    return {
        "sliding_max": largest_m_s(sliding_m_s),
        "sliding_mean": mean_of_worst_m_s(sliding_m_s),
    }


def _wsp_acts(record: Record) -> np.ndarray:
    """Return where any dump valve does not fill, over the rows that count, shape (n,)."""
    return np.any(record.wheelsets("valve") > 0.5, axis=0)


def _utilised_adhesion(record: Record) -> float:
    acts = _wsp_acts(record)
    if not acts.any():
        return NAN
    return float(np.mean(record.wheelsets("adhesion")[:, acts]))


def initial_adhesion(record: Record) -> float:
    """Return the first wheelset's adhesion when it first slides by initial_at_sliding_m_s.

    NaN if it did not slide so much.
    """
    sliding_m_s = sliding(record)[0]
    reached = np.flatnonzero(sliding_m_s >= record.scenario["adhesion"]["initial_at_sliding_m_s"])
    if not reached.size:
        return NAN
    return float(record.wheelsets("adhesion")[0, reached[0]])


def _shortfall_m_s2(record: Record) -> float:
    """Return the worst mean over a segment of the demanded less the achieved deceleration [M2].

    A segment counts if all of its rows do.
    """
    time_s = record.whole("time_s")
    speed = record.whole("vehicle_speed_m_s")
    if len(time_s) < 2 or time_s[-1] - time_s[0] < SEGMENT_S:
        return NAN
    demanded = demanded_m_s2(record, record.whole("brake_demand_Pa"), speed)
    # the speed that the demanded deceleration has taken away so far
    changes = 0.5 * (demanded[1:] + demanded[:-1]) * np.diff(time_s)
    demanded_change = np.concatenate(([0.0], np.cumsum(changes)))
    # first and last row of each segment
    first = np.flatnonzero(time_s <= time_s[-1] - SEGMENT_S + _TINY_S)
    last = np.searchsorted(time_s, time_s[first] + SEGMENT_S - _TINY_S)
    left_out = np.concatenate(([0], np.cumsum(~record.counts)))
    within = left_out[last + 1] == left_out[first]
    first, last = first[within], last[within]
    if not first.size:
        return NAN
    wanted = demanded_change[last] - demanded_change[first]
    achieved = speed[first] - speed[last]
    return float(np.max((wanted - achieved) / (time_s[last] - time_s[first])))  # [M2]


def _damage(record: Record) -> float:
    """Return the index of wheel damage of the worst wheelset [M3]."""
    load_N = np.array(record.finals["wheel_load"])[:, np.newaxis]
    sliding_m_s = record.wheelsets_whole("sliding", "_m_s")
    power_W = record.wheelsets_whole("adhesion") * load_N * sliding_m_s
    duration_s = np.diff(record.whole("time_s"))
    locked_W = np.where(record.locked, power_W, 0.0)
    locked_J = np.sum(locked_W[:, 1:] * duration_s, axis=1)
    sliding_J = np.array(record.finals["sliding_work"])
    if record.bounded:
        sliding_J = np.sum(np.where(record.counts, power_W, 0.0)[:, 1:] * duration_s, axis=1)
    total = locked_J / (LOCKED_MJ * 1e6) + sliding_J / (SLIDING_MJ * 1e6)
    return float(total.max())  # [M3]


def _air_NL(record: Record) -> float:
    """Return the air of all cylinders: as the rig counts it, or between the bounds of speed.

    Only filling uses air, V dp / 101325 Pa, as in `rig/brake.py`.
    """
    if not record.bounded:
        return record.finals["air_consumption"][0]
    rises_Pa = 0.0
    for axle in record.axles:
        rises_Pa += np.maximum(record.steps(f"cylinder_pressure_{axle}_Pa"), 0.0).sum()
    return float(record.scenario["brake"]["cylinder_volume_L"] * rises_Pa / NORMAL_PRESSURE_PA)


def _vents(record: Record) -> float:
    """Return the number of vents of all axles: as the rig counts them, or between the bounds."""
    if record.bounded:
        return float(record.begun_vents.sum())
    return float(sum(record.finals["vents"]))


def _vents_per_second(record: Record) -> float:
    """Return how often per second the dump valve of the busiest axle began to vent."""
    duration_s = float(record.steps("time_s").sum())
    return _ratio(float(record.begun_vents.max()), duration_s)


def _reference_error_m_s(record: Record) -> float:
    speed = record.braked("vehicle_speed_m_s")
    reference = record.braked("wsp_reference_speed_m_s")
    counts = _wsp_acts(record) & (speed > REFERENCE_ABOVE_M_S) & np.isfinite(reference)
    if not counts.any():
        return NAN
    return float(np.max(np.abs(reference - speed)[counts]))


def _full_brake_after_s(record: Record) -> float:
    """Return the time from the first fault until every cylinder has 90 % of the demand."""
    time_s = record.columns["time_s"]
    wanted_Pa = FULL_BRAKE * record.columns["brake_demand_Pa"]
    pressures_Pa = [record.columns[f"cylinder_pressure_{axle}_Pa"] for axle in record.axles]
    reached = np.all(np.array(pressures_Pa) >= wanted_Pa, axis=0)
    after = np.flatnonzero(reached & (time_s >= record.fault_s))
    if not after.size:
        return math.inf
    return float(time_s[after[0]] - record.fault_s)


def _reservoir_least_Pa(record: Record) -> float:
    if not record.scenario["air"]["reservoir_volume_L"] > 0.0:
        return NAN
    return record.finals["reservoir_least"][0]


def _sand_used_kg(record: Record) -> float:
    sanders = record.scenario["sanders"]
    if not (sanders["axle"] or sanders["second_axle"]):
        return NAN
    return sum(record.finals["sand_taken"])


def _wheel_flat_mm(record: Record) -> float:
    if not record.scenario["flats"]["wear_mm3_J"] > 0.0:
        return NAN
    return 1e3 * max(record.finals["flat_length"])


def _ratio(value: float, base: float) -> float:
    return value / base if base > 0.0 else NAN


def _coupler_kN(record: Record, sign: float) -> float:
    """Return the largest force of a coupler in kN: 1.0 tension, -1.0 compression.

    Of a whole stop it is that of every step of the physics, between bounds of speed that of the
    samples. 0 for a train without couplers.
    """
    if not record.bounded:
        key = "tension_max_N" if sign > 0.0 else "compression_max_N"
        return 1e-3 * max([0.0, *(sign * one[key] for one in record.train["couplers"])])
    names = [f"coupler_{number}_N" for number in range(1, len(record.train["couplers"]) + 1)]
    return 1e-3 * max([0.0, *(float((sign * record.braked(name)).max()) for name in names)])


def _distance_over_alone(record: Record) -> float:
    """Return the stopping distance of a train over that of its first braked car alone."""
    alone_m = (record.train["alone"] or {}).get("braking_distance_m") or 0.0
    return _ratio(_until_standstill(record, "position_m"), alone_m)


# what has a measure
VEHICLE = "vehicle"
TRAIN = "train"
BOTH = "both"


@dataclass(frozen=True)
class Measure:
    """One row.

    least: the least value that the measure can have.
    text: its meaning; values of the scenario are in braces, see `meaning`.
    of: computes it; NaN if it could not be measured.
    absent: why a run may have no value without an error; "" if it must have one.
    whole: why it cannot be computed between bounds of speed; "" if it can.
    has: what has this measure: VEHICLE, TRAIN or BOTH.
    """

    name: str
    unit: str
    least: float
    text: str
    of: Callable[[Record], float]
    absent: str = ""
    whole: str = ""
    has: str = VEHICLE

    def meaning(self, record: Record) -> str:
        """Return the text with the values of the scenario of a record."""
        return self.text.format_map(record.scenario)


_OF_WHOLE_STOP = "it compares whole stops"
_READ_AT_END = "the rig counts it, and it is read once, at the end"


MEASURES: tuple[Measure, ...] = (
    Measure(
        "stop_distance",
        "m",
        0.0,
        "from the first brake demand to standstill",
        lambda r: _until_standstill(r, "position_m"),
        has=BOTH,
    ),
    Measure(
        "stop_time",
        "s",
        0.0,
        "from the first brake demand to standstill",
        lambda r: _until_standstill(r, "time_s"),
        has=BOTH,
    ),
    Measure(
        "stop_distance_over_reference",
        "",
        0.0,
        "stop distance over the computed one (EN 14531-1 in its simple form, from memory, not "
        "verified)",
        lambda r: _ratio(_until_standstill(r, "position_m"), reference_distance_m(r)),
        whole=_OF_WHOLE_STOP,
    ),
    Measure(
        "stop_distance_over_dry",
        "",
        0.0,
        "stop distance over that of the dry stop",
        lambda r: _ratio(_until_standstill(r, "position_m"), r.dry_m),
        whole=_OF_WHOLE_STOP,
    ),
    Measure(
        "stop_distance_over_rail",
        "",
        0.0,
        "stop distance over that of a stop which uses the initial adhesion of this run on all "
        "wheelsets (after CEN/TR 17315, from memory, not verified)",
        lambda r: _ratio(_until_standstill(r, "position_m"), rail_distance_m(r)),
        "the first wheelset did not slide so much that the run shows its initial adhesion",
        whole=_OF_WHOLE_STOP,
    ),
    Measure(
        "longest_lock",
        "s",
        0.0,
        "longest lock of a wheelset above {rig[lock_above_m_s]:g} m/s, or between the bounds of speed",
        _longest_lock_s,
        has=BOTH,
    ),
    Measure(
        "locked_distance",
        "m",
        0.0,
        "distance that the worst wheelset ran locked, at any speed",
        _locked_distance_m,
        has=BOTH,
    ),
    Measure(
        "longest_deep_slide",
        "s",
        0.0,
        "longest time for which one wheelset turned at less than half of the vehicle's speed, above "
        "{rig[lock_above_m_s]:g} m/s or between the bounds of speed; a lock is a part of it",
        _longest_deep_slide_s,
        has=BOTH,
    ),
    Measure(
        "sliding_max",
        "m/s",
        0.0,
        "largest sliding of a wheelset",
        lambda r: largest_m_s(sliding(r)),
        has=BOTH,
    ),
    Measure(
        "sliding_mean",
        "m/s",
        0.0,
        "mean sliding of the worst wheelset",
        lambda r: mean_of_worst_m_s(sliding(r)),
        has=BOTH,
    ),
    Measure(
        "air_consumption",
        "NL",
        0.0,
        "air that the brake cylinders used, all axles",
        _air_NL,
    ),
    Measure(
        "reservoir_least",
        "Pa",
        0.0,
        "lowest pressure of the auxiliary reservoir",
        _reservoir_least_Pa,
        "the vehicle has no reservoir: its supply of air is unlimited",
        _READ_AT_END,
    ),
    Measure(
        "sand_used",
        "kg",
        0.0,
        "sand that all sanders took from their boxes",
        _sand_used_kg,
        "the vehicle has no sander",
        _READ_AT_END,
    ),
    Measure(
        "utilised_adhesion",
        "",
        0.0,
        "mean adhesion of all axles while the WSP acts",
        _utilised_adhesion,
        "the WSP did not act",
        has=BOTH,
    ),
    Measure(
        "utilised_over_initial_adhesion",
        "",
        0.0,
        "mean adhesion of all axles while the WSP acts, over the initial adhesion of the run",
        lambda r: _ratio(_utilised_adhesion(r), initial_adhesion(r.between(-math.inf, math.inf))),
        "the WSP did not act, or the first wheelset did not slide so much",
    ),
    Measure(
        "initial_adhesion",
        "",
        0.0,
        "adhesion of the first wheelset when it first slides by "
        "{adhesion[initial_at_sliding_m_s]:g} m/s",
        initial_adhesion,
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
        _wheel_flat_mm,
        "wheels stay round: flats.wear_mm3_J is 0",
        _READ_AT_END,
    ),
    Measure(
        "reference_speed_error",
        "m/s",
        0.0,
        "largest error of the unit's reference speed while it acts, above 5 m/s",
        _reference_error_m_s,
        "the unit sends no reference speed, or did not act",
    ),
    Measure(
        "vents",
        "",
        0.0,
        "number of times that a dump valve began to vent, all axles",
        _vents,
        has=BOTH,
    ),
    Measure(
        "vents_per_second",
        "1/s",
        0.0,
        "number of times a second that the dump valve of the busiest axle began to vent",
        _vents_per_second,
        has=BOTH,
    ),
    Measure(
        "vents_without_sliding",
        "",
        0.0,
        "number of times that a dump valve began to vent although its axle had not slid",
        lambda r: float(r.diagnosis.vents_without_sliding),
    ),
    Measure(
        "longest_vent_without_sliding",
        "s",
        0.0,
        "longest time for which a dump valve vented without a break while its axle did not slide",
        lambda r: r.diagnosis.open_without_sliding_s,
    ),
    Measure(
        "vented_wrong_axle",
        "s",
        0.0,
        "longest time for which a valve vented without need while another axle slid with its valve "
        "on fill",
        lambda r: r.diagnosis.wrong_axle_s,
    ),
    Measure(
        "reference_speed_drift",
        "s",
        0.0,
        "longest time for which the unit's reference speed was off by more than 3 m/s and 10 %",
        lambda r: r.diagnosis.drift_s,
        "the unit sends no reference speed",
    ),
    Measure(
        "full_brake_after_fault",
        "s",
        0.0,
        "from the first fault until every cylinder has 90 % of the demand",
        _full_brake_after_s,
        whole="it begins at the fault, at whatever speed",
    ),
    Measure(
        "stop_distance_over_alone",
        "",
        0.0,
        "stop distance of a train over that of its first braked car alone, on the same rail",
        _distance_over_alone,
        whole=_OF_WHOLE_STOP,
        has=TRAIN,
    ),
    Measure(
        "coupler_tension",
        "kN",
        0.0,
        "largest tension in a coupler of a train",
        lambda r: _coupler_kN(r, 1.0),
        has=TRAIN,
    ),
    Measure(
        "coupler_compression",
        "kN",
        0.0,
        "largest compression in a coupler of a train, as a positive number",
        lambda r: _coupler_kN(r, -1.0),
        has=TRAIN,
    ),
)
BY_NAME = {measure.name: measure for measure in MEASURES}


def of_kind(is_train: bool) -> tuple[Measure, ...]:
    """Return the measures of a train, or of one vehicle."""
    return tuple(one for one in MEASURES if one.has in (BOTH, TRAIN if is_train else VEHICLE))


def check_fit(names: Sequence[str], is_train: bool, where: str) -> None:
    """Raise ConfigError for a measure of a train that one vehicle does not have, or vice versa."""
    allowed = [one.name for one in of_kind(is_train)]
    for name in names:
        if name not in allowed:
            what = "a train" if is_train else "one vehicle"
            raise ConfigError(
                f"{where}: {what} has no measure {name}; allowed are {', '.join(allowed)}"
            )
