"""Measures against stops computed by hand; a verdict never passes without a measured value."""

import math
from dataclasses import replace

import numpy as np
import pytest
import synthetic_record as stop

from rollerrig.configs.errors import ConfigError
from rollerrig.wsp_interface.sequences import measures, sequence, verdict
from rollerrig.wsp_interface.sequences.measures import BY_NAME
from rollerrig.wsp_interface.sequences.play import Outcome
from rollerrig.wsp_interface.sequences.verdict import Limit, Profile, Result


def of(name, record=None):
    """Return the value of a measure."""
    return BY_NAME[name].of(record or stop.record())


def limit(name, low=-math.inf, high=math.inf):
    return Limit(name, BY_NAME[name].unit, low, high, "test")


def judged(limit, record=None):
    """Return the verdict on a limit."""
    (only,) = verdict.judge(Profile("t", "t", (limit,)), record or stop.record())
    return only


def test_the_stop_counts_from_the_first_brake_demand():
    assert of("stop_distance") == pytest.approx(stop.SPEED_M_S**2 / 2 / stop.RATE_M_S2, rel=2e-3)
    assert of("stop_time") == pytest.approx(stop.SPEED_M_S / stop.RATE_M_S2, rel=2e-3)


def test_the_reference_stop_is_response_time_and_equivalent_deceleration():
    record = stop.record()
    brake = record.scenario["brake"]
    vehicle = record.scenario["vehicle"]
    torque_Nm = (3.8e5 - brake["spring_pressure_Pa"]) * 0.0324 * 2.1 * 0.95 * 2 * 0.35 * 0.247 * 2
    force_N = 4 * torque_Nm / vehicle["wheel_radius_m"]
    drag_N = 600.0 + 0.9375 * stop.SPEED_M_S**2 / 2
    rate_m_s2 = (force_N + drag_N) / (43000.0 + 4 * 160.0 / 0.445**2)
    by_hand_m = 20.0 * (1.3 + 0.3) + 400.0 / 2 / rate_m_s2
    assert measures.reference_distance_m(record) == pytest.approx(by_hand_m, rel=1e-6)


def test_the_reference_stop_has_the_running_resistance_of_an_extended_model():
    record = stop.record()
    extra = record.scenario["mechanisms"] | {
        "running_resistance_force_N": 2000.0,
        "running_resistance_speed_power": 2.0,
    }
    dragged = replace(record, scenario=record.scenario | {"mechanisms": extra})
    added_N = measures.resistance_N(dragged, 10.0) - measures.resistance_N(record, 10.0)
    assert added_N == pytest.approx(500.0)
    assert measures.reference_distance_m(dragged) < measures.reference_distance_m(record)


def test_motors_add_their_inertia_to_the_mass_that_brakes():
    record = stop.record()
    motors = {"axles": [1, 4], "rotor_inertia_kgm2": 20.0}
    driven = replace(record, scenario=record.scenario | {"dynamic_brake": motors})
    radius_m = record.scenario["vehicle"]["wheel_radius_m"]
    added_kg = measures.dynamic_mass_kg(driven) - measures.dynamic_mass_kg(record)
    assert added_kg == pytest.approx(2 * 20.0 / radius_m**2)


def test_a_demand_of_twice_the_rate_falls_short_by_the_difference():
    record = stop.record()
    force_N = float(measures.brake_force_N(record, 3.8e5)) + 600.0
    demanded_m_s2 = force_N / measures.dynamic_mass_kg(record)
    # drag adds at most 0.9375 * 20^2 N
    expected_m_s2 = demanded_m_s2 - stop.RATE_M_S2
    assert of("deceleration_shortfall") == pytest.approx(expected_m_s2, abs=0.01)


def test_a_stop_shorter_than_a_segment_has_no_shortfall():
    record = stop.record()
    short = replace(
        record,
        columns={name: values[-900:] for name, values in record.columns.items()},
        demands=((record.columns["time_s"][-900], 3.8e5),),
    )
    assert math.isnan(of("deceleration_shortfall", short))
    assert judged(limit("deceleration_shortfall", high=1.0), short).result is Result.ABSENT


def test_the_damage_index_counts_the_energy_of_a_lock():
    # 0.08 of 100 kN at about 15.75 m/s for 0.5 s, and 2 MJ of sliding
    by_hand = 0.08 * 1e5 * 15.75 * stop.LOCK_S / 1e6 + 2e6 / 1e8
    assert of("wheel_damage_index") == pytest.approx(by_hand, rel=0.03)


def test_a_lock_counts_from_the_speed_that_the_scenario_names():
    record = stop.record()
    rig = record.scenario["rig"] | {"lock_above_m_s": 17.0}  # the lock is at 16 m/s
    changed = replace(record, scenario=record.scenario | {"rig": rig})
    assert of("wheel_damage_index", changed) == 2e6 / 1e8


def test_sliding_reference_error_and_adhesion_are_those_of_the_record():
    assert of("sliding_max") == pytest.approx(16.0, abs=0.1)
    assert of("reference_speed_error") == pytest.approx(stop.SLIP_M_S)
    assert of("utilised_adhesion") == pytest.approx(0.08)


def test_no_measure_follows_a_faulty_speed_sensor():
    sound = stop.record()
    faulty = stop.record()
    for axle in range(1, 5):
        faulty.columns[f"measured_speed_{axle}_rad_s"][:] = 0.0
    for measure in measures.MEASURES:
        values = [math.nan, math.nan]
        for at, record in enumerate((sound, faulty)):
            try:
                values[at] = measure.of(record)
            except KeyError:  # a signal that this record does not have
                continue
        assert np.array_equal(values[0], values[1], equal_nan=True), measure.name
    assert measures.as_measured(faulty)["sliding_max"] == pytest.approx(stop.SPEED_M_S, abs=0.1)


def test_full_brake_after_a_fault_waits_for_the_last_cylinder():
    record = stop.record()
    pressure = np.where(record.columns["time_s"] < 7.0, 1e5, 3.8e5)
    record.columns["cylinder_pressure_3_Pa"][:] = pressure
    assert of("full_brake_after_fault", replace(record, fault_s=5.0)) == pytest.approx(2.0)


def test_a_margin_is_the_distance_to_the_limit_as_a_share_of_the_limit():
    passed = judged(limit("longest_lock", high=1.0))
    assert passed.result is Result.PASS
    assert passed.margin == pytest.approx(0.5)
    failed = judged(limit("longest_lock", high=0.4))
    assert failed.result is Result.FAIL
    assert failed.margin == pytest.approx(-0.25)
    least = judged(limit("longest_lock", low=0.4))
    assert least.result is Result.PASS
    assert least.margin == pytest.approx(0.25)


def test_a_limit_of_zero_has_no_margin_but_a_result():
    failed = judged(limit("longest_lock", high=0.0))
    assert failed.result is Result.FAIL
    assert np.isnan(failed.margin)


def test_a_limit_itself_passes():
    assert judged(limit("longest_lock", high=stop.LOCK_S)).result is Result.PASS


def test_a_train_that_does_not_stop_is_an_error_and_no_pass():
    record = stop.record()
    record.columns["vehicle_speed_m_s"][:] += 1.0
    assert judged(limit("stop_distance", high=1e9), record).result is Result.ERROR


def test_a_unit_that_sends_no_reference_speed_is_not_judged_by_it():
    absent = judged(limit("reference_speed_error", high=0.1), stop.record(sends_reference=False))
    assert absent.result is Result.ABSENT
    assert "sends no reference speed" in absent.text


def test_an_exceeded_limit_is_a_failure_also_if_another_measure_could_not_be_judged(tmp_path):
    assert verdict.worst([Result.FAIL, Result.ERROR, Result.PASS]) is Result.FAIL
    path = tmp_path / "one.toml"
    path.write_text(stop.GOOD)
    one = Outcome(sequence.load(path), tmp_path / "one")
    # the train does not stop, and an axle locks for longer than allowed
    rolls = stop.record()
    rolls.columns["vehicle_speed_m_s"][:] = 20.0
    locks = (limit("longest_lock", high=0.4), limit("stop_distance", high=500.0))
    one.verdicts = verdict.judge(Profile("two", "two limits", locks), rolls)
    assert [line.result for line in one.verdicts] == [Result.FAIL, Result.ERROR]
    assert one.result is Result.FAIL
    # of a run that is not valid nothing is judged
    one.error = "the run is not valid"
    assert one.result is Result.ERROR


def test_the_worst_verdict_decides_and_no_verdict_is_an_error():
    assert verdict.worst([Result.PASS, Result.FAIL]) is Result.FAIL
    assert verdict.worst([Result.PASS, Result.ERROR]) is Result.ERROR
    assert verdict.worst([Result.PASS, Result.ABSENT]) is Result.PASS
    assert verdict.worst([]) is Result.ERROR
    assert verdict.worst([Result.ABSENT]) is Result.ERROR


# --- the unit under diagnosis ---


def vents_axle_3_in_place_of_axle_2():
    """Return a stop in which axle 2 slides with its valve on fill, and axle 3 is vented."""
    record = stop.record()
    columns = dict(record.columns)
    columns["valve_3"] = columns["valve_2"]
    columns["valve_2"] = np.zeros(len(columns["time_s"]))
    return replace(record, columns=columns)


def test_a_vent_of_an_axle_that_slides_is_none_without_sliding():
    assert of("vents_without_sliding") == 0.0
    assert of("vented_wrong_axle") == 0.0


def test_a_vent_of_a_rolling_axle_counts_and_so_does_its_time_beside_a_sliding_one():
    record = vents_axle_3_in_place_of_axle_2()
    assert of("vents_without_sliding", record) == 1.0
    assert of("vented_wrong_axle", record) == pytest.approx(stop.LOCK_S, abs=0.011)


def test_a_reference_speed_drifts_for_the_time_that_it_is_off():
    assert of("reference_speed_drift") == 0.0
    record = stop.record()
    time_s = record.columns["time_s"]
    off_m_s = np.where((time_s > 4.0) & (time_s < 6.5), 5.0, 0.0)
    reference_m_s = record.columns["vehicle_speed_m_s"] - off_m_s
    columns = dict(record.columns) | {"wsp_reference_speed_m_s": reference_m_s}
    drifting = replace(record, columns=columns)
    assert of("reference_speed_drift", drifting) == pytest.approx(2.5, abs=0.03)


def test_without_a_reference_speed_its_drift_is_not_applicable():
    record = stop.record(sends_reference=False)
    assert judged(limit("reference_speed_drift", high=0.0), record).result is Result.ABSENT


def test_the_profile_of_the_wiring_passes_a_right_unit_and_fails_a_swapped_one():
    profile = verdict.load("wiring")
    right = verdict.judge(profile, stop.record())
    assert {one.result for one in right} == {Result.PASS}
    swapped = verdict.judge(profile, vents_axle_3_in_place_of_axle_2())
    failed = [one.what for one in swapped if one.result is Result.FAIL]
    assert "vents_without_sliding" in failed


@pytest.mark.parametrize(
    ("measure", "unit", "message"),
    [
        ("stop_distance_over_dry", {}, "unit is missing: stop_distance_over_dry has no unit"),
        ("stop_time", {}, 'unit is missing: stop_time is in s; write unit = "s"'),
        ("stop_time", {"unit": "m"}, "unit = 'm': stop_time is in s; write unit = \"s\""),
    ],
)
def test_a_limit_without_its_unit_is_refused_with_the_line_to_write(measure, unit, message):
    table = {"measure": measure, "max": 2.0, "source": "assumption", **unit}
    with pytest.raises(ConfigError) as refused:
        verdict.limits([table], lambda number, key: key)
    assert message in str(refused.value)
    assert f'write unit = "{BY_NAME[measure].unit}"' in str(refused.value)
