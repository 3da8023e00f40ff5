"""A limit may judge only some speeds of the braking, and relative to what the rail gave.

The stops are computed by hand (`synthetic_record`): axle 2 locks for half a second at 16 m/s.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import synthetic_record as stop

from rollerrig.configs.errors import ConfigError
from rollerrig.wsp_interface.sequences import measures, verdict
from rollerrig.wsp_interface.sequences.measures import BY_NAME, MEASURES
from rollerrig.wsp_interface.sequences.verdict import Result

WALK_M_S = 2.0  # below lock_above_m_s of the scenario
# measures that are sums over the braking
SUMS = ("stop_distance", "stop_time", "vents", "air_consumption")


def limits(*tables):
    """Return checked limits, each without a source in its table."""
    whole = [{"unit": BY_NAME[one["measure"]].unit, "source": "test", **one} for one in tables]
    return verdict.limits(whole, lambda number, key: f"file [[limit]] {number + 1}: {key}")


def judged(table, record=None):
    """Return the verdict on one limit."""
    profile = verdict.Profile("t", "t", limits(table))
    (only,) = verdict.judge(profile, record or stop.record())
    return only


def of(name, above_m_s=-math.inf, below_m_s=math.inf, record=None):
    return BY_NAME[name].of((record or stop.record()).between(above_m_s, below_m_s))


def walking_lock():
    """Return the stop with a lock of axle 3 from 2 m/s to standstill."""
    record = stop.record()
    columns = dict(record.columns)
    speed = columns["vehicle_speed_m_s"]
    slow = speed < WALK_M_S
    columns["wheel_circumferential_speed_3_m_s"] = np.where(slow, 0.0, speed)
    columns["sliding_3_m_s"] = np.where(slow, speed, 0.0)
    return replace(record, columns=columns)


@pytest.mark.parametrize("name", SUMS)
@pytest.mark.parametrize("speed_m_s", [1.0, 8.33, 15.75, 19.0])
def test_what_is_above_a_speed_and_what_is_below_it_are_together_the_whole(name, speed_m_s):
    record = stop.record(vents=1.0)
    whole = of(name, above_m_s=0.0, record=record)
    above = of(name, above_m_s=speed_m_s, record=record)
    below = of(name, below_m_s=speed_m_s, record=record)
    assert above + below == pytest.approx(whole, rel=1e-9)
    assert whole > 0.0


@pytest.mark.parametrize("name", ["stop_distance", "stop_time"])
def test_a_bound_below_all_speeds_changes_nothing(name):
    assert of(name, above_m_s=0.0) == pytest.approx(of(name), rel=1e-9)


def test_the_distance_between_two_speeds_is_that_of_constant_deceleration():
    between_m = of("stop_distance", 5.0, 10.0)
    assert between_m == pytest.approx((10.0**2 - 5.0**2) / 2 / stop.RATE_M_S2, rel=3e-3)


def test_air_between_bounds_is_that_of_the_cylinders_that_fill():
    record = stop.record()
    brake = record.scenario["brake"]
    # all cylinders of the synthetic stop fill at its beginning
    by_hand_NL = 4 * brake["cylinder_volume_L"] * 3.8e5 / 101325.0
    assert of("air_consumption", above_m_s=19.0) == pytest.approx(by_hand_NL)
    assert of("air_consumption", below_m_s=19.0) == 0.0


def test_a_lock_counts_only_between_the_bounds_of_speed():
    # it lasts from 16 to 15.5 m/s
    assert of("longest_lock", above_m_s=10.0) == pytest.approx(stop.LOCK_S, abs=0.02)
    assert of("longest_lock", below_m_s=10.0) == 0.0
    assert of("longest_lock", above_m_s=15.75) == pytest.approx(stop.LOCK_S / 2, abs=0.02)


def test_a_lock_at_walking_speed_is_seen_with_a_bound_and_never_without():
    record = walking_lock()
    assert of("longest_lock", record=record) == stop.LOCK_S
    assert of("longest_lock", below_m_s=8.33, record=record) == pytest.approx(WALK_M_S, abs=0.05)
    table = {"measure": "longest_lock", "max": 0.4, "below_m_s": 8.33}
    assert judged(table, record).result is Result.FAIL
    assert judged(table).result is Result.PASS


def test_the_locked_distance_counts_at_any_speed():
    at_16_m = 15.75 * stop.LOCK_S
    walking_m = WALK_M_S**2 / 2 / stop.RATE_M_S2
    assert of("locked_distance") == pytest.approx(at_16_m, rel=0.03)
    record = walking_lock()
    assert of("locked_distance", below_m_s=8.33, record=record) == pytest.approx(
        walking_m, rel=0.03
    )


def test_a_wheel_that_rolls_to_standstill_is_not_locked_at_the_end():
    record = stop.record()
    assert of("longest_lock", below_m_s=8.33, record=record) == 0.0
    assert of("locked_distance", below_m_s=8.33, record=record) == 0.0
    assert of("longest_deep_slide", below_m_s=8.33, record=record) == 0.0


def test_sliding_outside_of_the_bounds_does_not_count():
    assert of("sliding_max", above_m_s=10.0) == pytest.approx(16.0, abs=0.1)
    assert of("sliding_max", below_m_s=10.0) == 0.0
    assert of("longest_deep_slide", below_m_s=10.0) == 0.0
    assert of("wheel_damage_index", below_m_s=10.0) == 0.0
    assert of("wheel_damage_index", above_m_s=10.0) > 0.0


def test_a_vent_without_sliding_counts_at_its_speed():
    record = stop.record()
    columns = dict(record.columns)
    columns["valve_3"] = columns["valve_2"]  # axle 3 rolls
    record = replace(record, columns=columns)
    assert of("vents_without_sliding", above_m_s=10.0, record=record) == 1.0
    assert of("vents_without_sliding", below_m_s=10.0, record=record) == 0.0
    # axle 2 slides when its vent begins, also if the rows before do not count
    assert of("vents_without_sliding", below_m_s=15.98) == 0.0


def test_the_worst_segment_lies_between_the_bounds():
    record = stop.record()
    demand_Pa = record.columns["brake_demand_Pa"]
    fast = record.columns["vehicle_speed_m_s"] > 12.0
    columns = dict(record.columns) | {"brake_demand_Pa": np.where(fast, demand_Pa, 0.5e5)}
    eased = replace(record, columns=columns)
    assert of("deceleration_shortfall", below_m_s=11.9, record=eased) < 0.0
    assert of("deceleration_shortfall", record=eased) > 0.0


def test_a_stop_without_a_speed_between_the_bounds_is_not_judged_by_them():
    table = {"measure": "longest_lock", "max": 0.4, "above_m_s": 50.0}
    assert judged(table).result is Result.ABSENT


def test_a_vehicle_that_never_became_slow_enough_is_an_error():
    record = stop.record()
    columns = dict(record.columns)
    columns["vehicle_speed_m_s"] = columns["vehicle_speed_m_s"] + 10.0
    rolls = replace(record, columns=columns)
    for name in ("longest_lock", "stop_distance"):
        table = {"measure": name, "max": 1e9, "below_m_s": 8.33}
        assert judged(table, rolls).result is Result.ERROR
    assert judged({"measure": "stop_distance", "max": 1e9, "above_m_s": 12.0}, rolls).value > 0.0


@pytest.mark.parametrize("measure", MEASURES, ids=lambda measure: measure.name)
def test_every_measure_takes_bounds_of_speed_or_states_why_not(measure):
    table = {"measure": measure.name, "max": 1e9, "above_m_s": 1.0, "below_m_s": 15.0}
    if not measure.whole:
        (limit,) = limits(table)
        assert limit.what == f"{measure.name} between 1 and 15 m/s"
        return
    with pytest.raises(ConfigError) as refused:
        limits(table)
    assert measure.whole in str(refused.value)
    assert "above_m_s" in str(refused.value)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ({"below_m_s": "30 km/h"}, "allowed is a speed of the vehicle in m/s"),
        ({"below_m_s": True}, "allowed is a speed of the vehicle in m/s"),
        ({"above_m_s": -1.0}, "from 0 to 200"),
        ({"above_m_s": math.nan}, "from 0 to 200"),
        ({"above_m_s": 9.0, "below_m_s": 8.0}, "no speed is between them"),
        ({"above_m_s": 8.0, "below_m_s": 8.0}, "no speed is between them"),
    ],
)
def test_wrong_bounds_of_speed_are_refused(bounds, message):
    with pytest.raises(ConfigError, match=message):
        limits({"measure": "longest_lock", "max": 0.4, **bounds})


def test_a_limit_of_a_sequence_replaces_those_of_its_profile_with_the_same_bounds():
    whole = {"measure": "longest_lock", "max": 0.4}
    slow = {"measure": "longest_lock", "max": 1.0, "below_m_s": 8.33}
    other = {"measure": "vents", "max": 9.0}
    profile = verdict.Profile("t", "t", limits(whole, slow, other))

    def kept(*tables):
        replaced = profile.with_limits(limits(*tables))
        return [(limit.what, limit.high) for limit in replaced.limits]

    slow_name = "longest_lock below 8.33 m/s"
    assert kept({**slow, "max": 2.0}) == [("longest_lock", 0.4), ("vents", 9.0), (slow_name, 2.0)]
    # a sequence that was written before there were bounds has the last word on its measure
    assert kept({**whole, "max": 30.0}) == [("vents", 9.0), ("longest_lock", 30.0)]


def test_a_verdict_names_its_bounds_and_has_them_as_numbers():
    line = judged({"measure": "longest_lock", "max": 0.4, "below_m_s": 8.33})
    assert line.what == "longest_lock below 8.33 m/s"
    assert (line.measure, line.above_m_s, line.below_m_s) == ("longest_lock", -math.inf, 8.33)


# --- relative to what the rail gave ---


def slid_first(initial_adhesion):
    """Return the stop, in which axle 1 slides by 2 m/s at the beginning, at an adhesion."""
    record = stop.record()
    columns = dict(record.columns)
    time_s = columns["time_s"]
    slides = (time_s > 2.0) & (time_s < 3.0)
    columns["sliding_1_m_s"] = np.where(slides, 2.0, 0.0)
    columns["adhesion_1"] = np.where(slides, initial_adhesion, columns["adhesion_1"])
    return replace(record, columns=columns)


def test_the_stop_of_the_rail_uses_the_initial_adhesion_on_the_whole_weight():
    record = slid_first(0.05)
    weight_N = 9.80665 * 43000.0
    drag_N = 600.0 + 0.9375 * stop.SPEED_M_S**2 / 2
    rate_m_s2 = (0.05 * weight_N + drag_N) / (43000.0 + 4 * 160.0 / 0.445**2)
    by_hand_m = stop.SPEED_M_S * (1.3 + 0.3) + stop.SPEED_M_S**2 / 2 / rate_m_s2
    assert measures.rail_distance_m(record) == pytest.approx(by_hand_m, rel=1e-6)
    stop_m = stop.SPEED_M_S**2 / 2 / stop.RATE_M_S2
    assert of("stop_distance_over_rail", record=record) == pytest.approx(
        stop_m / by_hand_m, rel=3e-3
    )


def test_a_rail_that_gives_more_than_the_brake_demands_is_no_better_than_the_brake():
    assert measures.rail_distance_m(slid_first(0.6)) == measures.reference_distance_m(stop.record())


def test_without_sliding_a_run_does_not_show_what_the_rail_gives():
    line = judged({"measure": "stop_distance_over_rail", "max": 1.0})
    assert line.result is Result.ABSENT
    assert "initial adhesion" in line.text


def test_utilised_adhesion_is_relative_to_the_initial_one():
    # axle 2 vents while every axle has 0.08
    ratio = of("utilised_over_initial_adhesion", record=slid_first(0.05))
    assert ratio == pytest.approx(0.08 / 0.05)


def test_the_busiest_valve_counts_by_the_second():
    record = stop.record()
    columns = dict(record.columns)
    pulses = np.where((columns["time_s"] * 2.0) % 1.0 < 0.5, 2.0, 0.0)  # two a second
    columns["valve_4"] = pulses
    record = replace(record, columns=columns)
    assert of("vents_per_second", record=record) == pytest.approx(2.0, rel=0.05)
    assert of("vents_per_second", below_m_s=10.0, record=record) == pytest.approx(2.0, rel=0.06)
