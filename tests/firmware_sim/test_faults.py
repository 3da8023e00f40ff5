"""The fault catalogue: every row is seen on the bus and in the record, and is lifted again."""

import asyncio
import filecmp

import faulty_run
import numpy as np
import pytest
from faulty_run import PLAN, samples

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.faults import catalogue, effects, panel
from rollerrig.firmware_sim.modbus.pdu import RefusedError
from rollerrig.realtime.bench import bench, fault_registers, options, scenario, tick_data
from rollerrig.realtime.loop import ring, tick
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.events import Code

TIMES = {kind: (begin, end) for kind, begin, end, _ in PLAN}
# a change shows on the bus one SYNC later
CYCLE_S = 0.01


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    return faulty_run.run(tmp_path_factory.mktemp("faults"))


@pytest.fixture(scope="module")
def again(tmp_path_factory):
    return faulty_run.run(tmp_path_factory.mktemp("again"))


def within(kind, settle_s=2 * CYCLE_S):
    """The interval in which a fault holds and its beginning has settled."""
    begin, end = TIMES[kind]
    return begin + settle_s, end


def after(kind, for_s=0.05):
    """An interval after a fault has been lifted."""
    end = TIMES[kind][1]
    return end + 2 * CYCLE_S, end + 2 * CYCLE_S + for_s


def speeds_on_bus(rig, from_s, to_s):
    """Speeds of TPDO1 of node 16 in rad/s, shape (n, 4)."""
    return np.array([np.frombuffer(one, "<i2") for one in rig.on_bus(0x190, from_s, to_s)]) * 0.01


def measured(rig, from_s, to_s):
    return samples(rig, "measured_speed:_rad_s", from_s, to_s)


def turning(rig, from_s, to_s):
    return samples(rig, "wheel_speed:_rad_s", from_s, to_s)


@pytest.mark.conformance("Faults", "every fault: begins and is lifted, recorded")
@pytest.mark.parametrize("kind", [kind.name for kind in catalogue.CATALOGUE])
def test_every_fault_of_the_catalogue_is_recorded_when_it_begins_and_when_it_is_lifted(rig, kind):
    begin, end = TIMES[kind]
    assert begin in rig.reported(Code.FAULT_BEGINS, kind=kind)
    lifted = rig.reported(Code.FAULT_LIFTED, kind=kind)
    assert any(time == pytest.approx(end, abs=1e-9) for time in lifted)


def test_a_run_with_every_fault_repeats_bit_for_bit(rig, again):
    assert filecmp.cmp(rig.run.folder / "can.log", again.run.folder / "can.log", shallow=False)
    for name in rig.run.table.column_names:
        if not name.startswith("tick_"):
            assert np.array_equal(rig.run.column(name), again.run.column(name), equal_nan=True), (
                name
            )


def test_before_a_fault_sensors_tell_the_wheels_own_speed(rig):
    assert np.array_equal(measured(rig, 0.0, 0.5), turning(rig, 0.0, 0.5))


@pytest.mark.conformance("Faults", "speed_sensor_stuck")
def test_a_stuck_sensor_repeats_one_speed_while_the_wheel_slows_down(rig):
    told, real = (
        measured(rig, *within("speed_sensor_stuck")),
        turning(rig, *within("speed_sensor_stuck")),
    )
    assert np.ptp(told[0]) == 0.0
    assert np.ptp(real[0]) > 0.3
    assert np.ptp(speeds_on_bus(rig, *within("speed_sensor_stuck"))[:, 0]) == 0.0
    assert np.ptp(rig.channel("pulse_count_1", *within("speed_sensor_stuck"))) == 0.0
    assert np.array_equal(
        measured(rig, *after("speed_sensor_stuck"))[0],
        turning(rig, *after("speed_sensor_stuck"))[0],
    )


@pytest.mark.conformance("Faults", "speed_sensor_dropout")
def test_a_sensor_that_drops_out_tells_zero_and_counts_no_pulses(rig):
    span = within("speed_sensor_dropout")
    assert not measured(rig, *span)[1].any()
    assert not speeds_on_bus(rig, *span)[:, 1].any()
    assert np.ptp(rig.channel("pulse_count_2", *span)) == 0.0
    assert (speeds_on_bus(rig, *after("speed_sensor_dropout"))[:, 1] > 10.0).all()


@pytest.mark.conformance("Faults", "missing_tooth")
def test_missing_teeth_make_the_measured_speed_dip_once_a_turn(rig):
    span = within("missing_tooth", 0.05)
    ratio = measured(rig, *span)[2] / turning(rig, *span)[2]
    dips = ratio < 0.95
    turns = np.ptp(rig.channel("wheel_angle_3_rad", *span)) / (2 * np.pi)
    assert turns - 1.5 <= dips.sum() <= turns + 1.5
    assert np.abs(ratio[~dips] - 1.0).max() < 0.05
    assert speeds_on_bus(rig, *span)[:, 2].min() < 0.95 * turning(rig, *span)[2].min()


@pytest.mark.conformance("Faults", "speed_noise_burst")
def test_a_noise_burst_scatters_the_measured_speed_by_its_standard_deviation(rig):
    span = within("speed_noise_burst", 0.0)
    error = (measured(rig, *span) - turning(rig, *span))[3]
    assert 3.0 < error[1:].std() < 7.0
    assert speeds_on_bus(rig, *span)[2:, 3].std() > 3.0
    assert np.array_equal(
        measured(rig, *after("speed_noise_burst"))[3], turning(rig, *after("speed_noise_burst"))[3]
    )


@pytest.mark.conformance("Faults", "swapped_axles")
def test_swapped_axles_tell_each_others_speed(rig):
    told, real = measured(rig, *within("swapped_axles")), turning(rig, *within("swapped_axles"))
    assert not np.array_equal(real[0], real[1])
    assert np.array_equal(told[:2], real[[1, 0]])


@pytest.mark.conformance("Faults", "wheel_diameter_mismatch")
def test_a_larger_wheel_is_measured_slower_by_the_difference_of_the_diameters(rig):
    span = within("wheel_diameter_mismatch")
    assert measured(rig, *span)[2] * 1.05 == pytest.approx(turning(rig, *span)[2], rel=1e-12)
    assert speeds_on_bus(rig, *span)[:, 2] == pytest.approx(
        speeds_on_bus(rig, *span)[:, 1] / 1.05, rel=0.01
    )


def pressures(rig, from_s, to_s):
    """Cylinder pressures of TPDO1 of node 17 in mbar, shape (n, 4)."""
    return np.array([np.frombuffer(one, "<i2") for one in rig.on_bus(0x191, from_s, to_s)])


@pytest.mark.conformance("Faults", "hold_magnet_stuck")
def test_a_stuck_hold_magnet_keeps_the_pressure_that_the_others_pass(rig):
    span = within("hold_magnet_stuck", 0.1)
    assert set(rig.channel("valve_1", *span)) == {1.0}
    assert np.ptp(pressures(rig, *span)[:, 0]) <= 1
    assert np.ptp(pressures(rig, *span)[:, 2]) > 100
    assert set(
        rig.channel("valve_1", *(time + 0.05 for time in after("hold_magnet_stuck", 0.02)))
    ) == {0.0}


@pytest.mark.conformance("Faults", "vent_magnet_stuck")
def test_a_stuck_vent_magnet_empties_the_cylinder(rig):
    begin, end = TIMES["vent_magnet_stuck"]
    assert set(rig.channel("valve_2", begin + 0.1, end)) == {2.0}
    assert pressures(rig, end - 0.02, end)[-1, 1] < 0.2 * pressures(rig, begin, begin + 0.02)[0, 1]


@pytest.mark.conformance("Faults", "hold_magnet_dead")
def test_a_dead_hold_magnet_lets_the_cylinder_fill_when_hold_is_asked(rig):
    asked = rig.on_bus(0x211, 2.2, 2.4)
    assert set(asked) == {b"\x55"}
    assert set(rig.channel("valve_3", 2.2, 2.4)) == {0.0}
    assert set(rig.channel("valve_1", 2.2, 2.4)) == {1.0}
    assert np.ptp(pressures(rig, 2.2, 2.4)[:, 2]) > np.ptp(pressures(rig, 2.2, 2.4)[:, 0])


@pytest.mark.conformance("Faults", "vent_magnet_dead")
def test_a_dead_vent_magnet_only_holds_when_vent_is_asked(rig):
    assert set(rig.on_bus(0x211, 2.5, 2.7)) == {b"\xff"}
    assert set(rig.channel("valve_4", 2.5, 2.7)) == {1.0}
    assert set(rig.channel("magnets_4", 2.5, 2.7)) == {1.0}
    assert set(rig.channel("valve_3", 2.5, 2.7)) == {2.0}
    assert np.ptp(pressures(rig, 2.5, 2.7)[:, 3]) <= 1


@pytest.mark.conformance("Faults", "cylinder_leak")
def test_a_leaking_cylinder_loses_pressure_and_gets_it_back(rig):
    begin, end = TIMES["cylinder_leak"]
    before, late = pressures(rig, begin - 0.05, begin)[-1], pressures(rig, end - 0.05, end)[-1]
    # axle 2 has been vented like axle 1, and has no leak
    assert before[0] == pytest.approx(before[1], rel=0.1)
    assert late[0] < 0.75 * late[1]
    assert (
        pressures(rig, end + 0.9, end + 1.0)[-1, 0]
        > 0.9 * pressures(rig, end + 0.9, end + 1.0)[-1, 3]
    )


@pytest.mark.conformance("Faults", "torque_ripple")
def test_torque_ripple_shows_in_demand_and_torque_on_the_bus(rig):
    span, calm = within("torque_ripple"), (2.9, 3.0)
    assert rig.channel("motor_torque_demand_2_Nm", *span).std() > 1000.0
    actual = np.array(
        [int.from_bytes(one[3:5], "little", signed=True) for one in rig.on_bus(0x182, *span)]
    )
    quiet = np.array(
        [int.from_bytes(one[3:5], "little", signed=True) for one in rig.on_bus(0x182, *calm)]
    )
    assert actual.std() > 3 * quiet.std()
    assert np.diff(np.sign(actual - actual.mean())).astype(bool).sum() > 6


def test_a_sander_that_is_blocked_or_has_a_wrong_orifice_or_no_sand_strews_less_and_the_other_goes_on(
    rig,
):
    def strewn(axle, from_s, to_s):
        return rig.channel(f"sand_rate_{axle}_kg_s", from_s, to_s)

    sound_kg_s = strewn(1, 0.9, 1.0)[-1]
    assert sound_kg_s > 0.05
    assert strewn(1, 1.9, 2.0)[-1] < 0.15 * sound_kg_s
    assert np.ptp(rig.channel("sand_box_1_kg", 1.1, 2.0)) == 0.0
    assert 0.25 * sound_kg_s < strewn(1, 3.9, 4.0)[-1] < 0.5 * sound_kg_s
    assert (strewn(2, 1.1, 2.0) > 0.9 * sound_kg_s).all()
    assert strewn(2, 6.9, 7.0)[-1] > 0.9 * sound_kg_s
    assert rig.channel("sand_box_2_kg", 7.1, 9.0).max() == 0.0
    assert np.ptp(rig.channel("sand_taken_2_kg", 7.1, 9.0)) == 0.0
    assert strewn(2, 8.9, 9.0).max() < 0.1 * sound_kg_s


def words(rig, node, from_s, to_s):
    """Statuswords of a drive."""
    return [int.from_bytes(one[:2], "little") for one in rig.on_bus(0x180 + node, from_s, to_s)]


def emergencies(rig, node, kind, more_s=0.05):
    begin, end = TIMES[kind]
    return [
        int.from_bytes(one[:2], "little") for one in rig.on_bus(0x080 + node, begin, end + more_s)
    ]


def in_fault(word):
    return word & 0x4F == 0x08


def runs(word):
    return word & 0x6F == 0x27


@pytest.mark.conformance(
    "Faults", "drive_trip, drive_over_temperature, power_dip: code, no torque, back"
)
@pytest.mark.parametrize(
    ("kind", "node", "code"),
    [("drive_trip", 1, 0x5112), ("drive_over_temperature", 2, 0x4310), ("power_dip", 3, 0x3220)],
)
def test_a_drive_that_trips_tells_its_code_gives_no_torque_and_runs_again(rig, kind, node, code):
    span = within(kind, 0.05)
    assert emergencies(rig, node, kind) == [code, 0]
    assert all(map(in_fault, words(rig, node, *span)))
    assert np.abs(rig.channel(f"motor_torque_{node}_Nm", *span)).max() < 10.0
    assert all(map(runs, words(rig, node, *after(kind))))
    assert rig.channel(f"motor_torque_{node}_Nm", *after(kind)).mean() > 100.0


@pytest.mark.conformance("Faults", "drive_over_temperature: warning")
def test_a_hot_drive_warns_with_bit_7(rig):
    assert all(word & 0x80 for word in words(rig, 2, *within("drive_over_temperature")))
    assert not any(word & 0x80 for word in words(rig, 2, *after("drive_over_temperature")))


@pytest.mark.conformance("Faults", "drive_over_temperature: temperature")
def test_a_hot_motor_tells_its_temperature_and_the_others_tell_the_airs(rig):
    air_K, rise_K = 293.15, rig.run.scenario["drive"]["rated_temperature_rise_K"]
    hot = samples(rig, "motor_temperature:_K", *within("drive_over_temperature"))
    assert hot[1] == pytest.approx(air_K + 1.25 * rise_K, abs=0.01)
    assert np.abs(hot[[0, 2, 3]] - air_K).max() < 3.0
    assert (
        np.abs(samples(rig, "motor_temperature:_K", *after("drive_over_temperature")) - air_K).max()
        < 3.0
    )


@pytest.mark.conformance("Faults", "power_dip")
def test_a_power_dip_trips_every_drive_and_clears_voltage_enabled(rig):
    for node in (1, 2, 3, 4):
        assert all(
            in_fault(word) and not word & 0x10 for word in words(rig, node, *within("power_dip"))
        )
        assert all(word & 0x10 for word in words(rig, node, *after("power_dip")))


@pytest.mark.conformance("Faults", "node_off")
def test_a_node_without_power_is_silent_and_boots_when_it_is_back(rig):
    begin, end = TIMES["node_off"]
    own = {0x190, 0x290, 0x390, 0x710, 0x090, 0x590}
    assert [one for time, one, _ in rig.frames if one in own and begin <= time < end] == []
    back = rig.on_bus(0x710, end, end + 0.05)
    assert back[0] == b"\x00"
    assert rig.on_bus(0x190, end + 0.02, end + 0.1)


@pytest.mark.conformance("Faults", "node_babbling")
def test_a_babbling_node_fills_the_bus(rig):
    begin, end = TIMES["node_babbling"]
    babbled = len(rig.on_bus(0x07F, begin, end + CYCLE_S))
    assert babbled == pytest.approx(2000.0 * (end - begin), abs=21)
    assert rig.on_bus(0x07F, end + CYCLE_S, 9.0) == []


@pytest.mark.conformance("Faults", "frame_lost")
def test_lost_frames_are_missing_on_the_bus_and_counted(rig):
    begin, end = TIMES["frame_lost"]
    assert len(rig.on_bus(0x191, begin, end)) == 10
    assert len(rig.on_bus(0x190, begin, end)) == 20
    assert rig.reported(Code.FAULT_LIFTED, kind="frame_lost", frames_met=10)


@pytest.mark.conformance("Faults", "frame_delayed")
def test_delayed_frames_carry_what_was_true_when_they_were_sent(rig):
    begin, end = TIMES["frame_delayed"]
    told = speeds_on_bus(rig, begin + 0.06, end)[:, 0]
    real = rig.channel("measured_speed_1_rad_s", begin + 0.06, end)
    late = rig.channel("measured_speed_1_rad_s", begin + 0.01, end - 0.05)
    assert rig.on_bus(0x190, begin, begin + 0.045) == []
    assert np.abs(told - late[: len(told)]).max() <= 0.011
    assert np.abs(told - real[: len(told)]).max() > 0.05


@pytest.mark.conformance("Faults", "frame_duplicated")
def test_duplicated_frames_come_twice(rig):
    begin, end = TIMES["frame_duplicated"]
    twice = rig.on_bus(0x191, begin, end)
    assert len(twice) == 40
    assert twice[0::2] == twice[1::2]


@pytest.mark.conformance("Faults", "error_frame")
def test_error_frames_drive_a_node_to_error_passive_to_bus_off_and_back(rig):
    begin, end = TIMES["error_frame"]
    errors = [
        data for time, can_id, data in rig.frames if can_id == 0x20000088 and begin <= time < end
    ]
    counters = [data[6] for data in errors]
    assert counters[:3] == [8, 16, 23]
    assert max(counters) == 255
    codes = emergencies(rig, 17, "error_frame")
    assert codes.index(0x8120) < codes.index(0x8140)
    assert rig.reported(Code.CAN_ERROR_PASSIVE, node=17)
    assert rig.reported(Code.CAN_BUS_OFF, node=17)
    assert not [one for time, one, _ in rig.frames if one == 0x20000088 and end <= time < 9.0]


@pytest.mark.conformance("Faults", "receive_error")
def test_a_faulty_receiver_destroys_frames_until_it_is_error_passive_and_then_only_misses_them(rig):
    begin, end = TIMES["receive_error"]
    errors = [
        data for time, can_id, data in rig.frames if can_id == 0x20000088 and begin <= time < end
    ]
    assert [data[7] for data in errors][:3] == [9, 17, 25]
    assert not any(data[2] for data in errors)
    assert len(errors) < 30
    assert emergencies(rig, 16, "receive_error") == [0x8120, 0]
    assert rig.reported(Code.CAN_ERROR_PASSIVE, node=16, counter="receive")
    assert rig.reported(Code.CAN_ERROR_ACTIVE, node=16)
    # without SYNC it sends no speeds; its neighbours hear and are heard, its heartbeat goes on
    assert rig.on_bus(0x190, begin + 0.03, end) == []
    assert len(rig.on_bus(0x191, begin + 0.03, end)) == 37
    assert set(rig.on_bus(0x710, begin, end)) == {b"\x05"}
    assert len(rig.on_bus(0x190, end + 0.015, end + 0.115)) == 10


@pytest.mark.conformance("Faults", "bus_off")
def test_a_node_whose_controller_is_off_says_nothing_and_goes_on_without_booting(rig):
    begin, end = TIMES["bus_off"]
    own = {0x184, 0x284, 0x704, 0x084}
    assert [one for time, one, _ in rig.frames if one in own and begin <= time < end] == []
    assert emergencies(rig, 4, "bus_off")[:1] == [0x8140]
    assert set(rig.on_bus(0x704, end, end + 0.3)) == {b"\x05"}
    assert all(map(runs, words(rig, 4, end + 0.02, end + 0.1)))
    assert rig.channel("motor_torque_4_Nm", begin, end).mean() > 100.0


@pytest.mark.conformance("Faults", "heartbeat_late")
def test_late_heartbeats_make_the_master_miss_the_node(rig):
    begin, end = TIMES["heartbeat_late"]
    assert rig.on_bus(0x711, begin, end) == []
    assert any(begin < time < end for time in rig.reported(Code.NODE_LOST, node=17))
    assert rig.on_bus(0x711, end, end + 0.05)


@pytest.mark.conformance("Faults", "wsp_frozen")
def test_a_frozen_unit_lets_the_brakes_apply_after_its_heartbeat_is_lost(rig):
    begin, end = TIMES["wsp_frozen"]
    for can_id in (0x211, 0x720):
        assert rig.on_bus(can_id, begin, end) == []
    assert emergencies(rig, 17, "wsp_frozen", 0.1) == [0x8130, 0]
    assert any(
        begin + 0.15 < time < begin + 0.3
        for time in rig.reported(Code.MAGNETS_FAIL_SAFE, magnets=0)
    )
    # what was held back comes at once when the unit goes on
    assert len(rig.on_bus(0x211, end, end + 0.005)) > 30


def test_a_fault_can_be_injected_and_cleared_by_hand(rig):
    begin, end, _ = faulty_run.BY_HAND
    assert not measured(rig, begin + 0.02, end)[3].any()
    assert measured(rig, end + 0.02, end + 0.1)[3].all()
    assert len(rig.reported(Code.FAULT_BEGINS, fault="speed_sensor_dropout axle=4")) == 1
    assert len(rig.reported(Code.FAULT_LIFTED, fault="speed_sensor_dropout axle=4")) == 1


@pytest.mark.conformance("Faults", "wsp_frozen: the reference unit")
def test_the_reference_units_process_is_stopped_and_goes_on(tmp_path):
    path = tmp_path / "frozen.toml"
    path.write_text(
        'adhesion = "dry"\ninitial_speed_m_s = 20.0\nduration_max_s = 1.2\n[bus]\n'
        'interface = "hub"\nsocketcand_port = 0\n'
    )
    plan = scenario.load(str(path), faults=("wsp_frozen at=0.3 for=0.5",))
    rig = bench.Bench(
        plan, options.Options("lockstep", "reference", tmp_path / "run"), lambda one: None
    )
    result = asyncio.run(rig.run())
    recorded = faulty_run.Recorded(faulty_run.records.load(tmp_path / "run"))
    assert result["ended"] == "finished"
    assert recorded.on_bus(0x211, 0.3, 0.79) == []
    assert recorded.reported(Code.MAGNETS_FAIL_SAFE)
    # every SYNC it has slept through is answered, and then each at its time
    assert len(recorded.on_bus(0x211, 0.795, 0.805)) == 51
    assert len(recorded.on_bus(0x211, 0.805, 1.195)) == 39


def machine(path_of_plan, array=None, ticks=300):
    """The row after some ticks of a machine whose faults array holds these values."""
    plan = scenario.load(path_of_plan)
    place = ring.Ring(ring.place("rows"), np.float64, 1 << 10, len(signals.COLUMNS))
    try:
        made = tick_data.build(plan, place)
        if array is not None:
            made.commands.values[tick.FAULTS :] = array
        tick.run_ticks(made, ticks)
        return made.row.copy()
    finally:
        place.close()
        place.unlink()


def test_a_faults_array_whose_values_are_zero_changes_no_bit():
    zeros = np.zeros(effects.SIZE)
    zeros[effects.ANY] = 1.0
    row = machine("dry_stop")
    assert np.array_equal(row, machine("dry_stop", zeros), equal_nan=True)
    zeros[effects.slot(effects.LEAK_per_s, 1)] = 1.0
    assert not np.array_equal(row, machine("dry_stop", zeros), equal_nan=True)


@pytest.mark.conformance("Faults", "injected from the command line")
def test_a_fault_of_the_command_line_is_the_scenarios_fault():
    plan = scenario.load("dry_stop", faults=("frame_lost can_id=0x190 every=3 at=5 for=2",))
    assert plan["fault"] == [
        {"kind": "frame_lost", "at_s": 5.0, "for_s": 2.0, "can_id": 0x190, "every": 3}
    ]
    assert plan.faults == catalogue.all_of(plan["fault"], "again")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("speed_sensor_stuk axle=2", "did you mean 'speed_sensor_stuck'"),
        ("speed_sensor_stuck axle=5", "allowed 1 to 4"),
        ("speed_sensor_stuck axel=2", "did you mean 'axle'"),
        ("node_off node=5", "allowed are 1, 2, 3, 4, 16, 17"),
        ("swapped_axles axle=2 other=2", "give two axles"),
        ("power_dip for=0", "out of range"),
        ("node_off node", "write key=number"),
    ],
)
def test_a_wrong_fault_is_refused_with_what_is_allowed(text, said):
    with pytest.raises(ConfigError, match="--fault") as refused:
        catalogue.parse(text)
    assert said in str(refused.value)


def test_a_fault_of_the_bus_is_refused_where_there_is_no_bus():
    planned = (catalogue.parse("node_off node=16"),)
    with pytest.raises(ConfigError, match="--pacing free has none"):
        panel.check_pacing(planned, "free")
    panel.check_pacing(planned, "lockstep")


class Told:
    """A rig without a bus: a panel on an array, and the events."""

    def __init__(self):
        self.events = []
        self.array = np.zeros(effects.SIZE)
        self.faults = panel.Panel((), self.event)
        self.faults.connect(panel.Site(self.array, lambda: None))

    def event(self, code, /, **fields):
        self.events.append(events.make(0.0, code, **fields))


@pytest.mark.conformance("Faults", "injected over Modbus")
@pytest.mark.conformance("Modbus", "faults are chosen, injected and lifted by registers")
def test_a_fault_is_chosen_injected_and_lifted_over_modbus():
    told = Told()
    desk = fault_registers.FaultRegisters(told.faults, told.event)
    write, read = desk.writers(), desk.readers()
    number = catalogue.BY_NAME["cylinder_leak"].number
    for name, raw in (
        ("fault", number),
        ("fault_target", 3),
        ("fault_duration", 20),
        ("inject_fault", 1),
    ):
        write[name](raw, True)
        assert read["faults_active"]() == 0
        write[name](raw, False)
    assert told.array[effects.slot(effects.LEAK_per_s, 3)] == 0.5
    assert (read["faults_active"](), read["fault"]()) == (1, number)
    told.faults.poll(2.1)
    assert not told.array.any()
    write["inject_fault"](1, False)
    write["lift_faults"](1, False)
    assert not told.array.any()
    assert [one.code for one in told.events] == [Code.FAULT_BEGINS, Code.FAULT_LIFTED] * 2


def test_a_fault_that_cannot_be_is_refused_over_modbus_and_told():
    told = Told()
    write = fault_registers.FaultRegisters(told.faults, told.event).writers()
    with pytest.raises(RefusedError):
        write["fault"](len(catalogue.CATALOGUE), True)
    write["fault_target"](9, False)
    with pytest.raises(RefusedError):
        write["inject_fault"](1, False)
    assert told.events[0].code == Code.FAULT_REFUSED
    assert "allowed 1 to 4" in told.events[0].fields["reason"]
