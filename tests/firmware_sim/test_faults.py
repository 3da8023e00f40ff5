"""Each fault of the catalogue shows on the bus and in the record, and disappears when lifted."""

import asyncio
import filecmp

import faulty_run
import numpy as np
import pytest
from faulty_run import PLAN, samples

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.firmware_sim.faults import bus, catalogue, effects, panel
from rollerrig.firmware_sim.faults.confinement import Controllers
from rollerrig.firmware_sim.modbus.pdu import RefusedError
from rollerrig.realtime.bench import bench, fault_registers, options, scenario, tick_data
from rollerrig.realtime.loop import ring, tick
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

# begin and end of each fault in seconds
TIMES = {kind: (begin, end) for kind, begin, end, _ in PLAN}
# a change shows on the bus one SYNC later
CYCLE_S = 0.01

# identifiers on the bus
SPEEDS = 0x190  # TPDO1 of node 16
PRESSURES = 0x191  # TPDO1 of node 17
MAGNETS = 0x211  # the WSP unit's answer to SYNC
HEARTBEAT_16 = 0x710
HEARTBEAT_17 = 0x711
HEARTBEAT_4 = 0x704
HEARTBEAT_UNIT = 0x720
BABBLE = 0x07F
# an error frame as in candump: the error flag with the classes protocol violation and bus error
ERROR_FRAME = 0x20000088

# bytes of an error frame's data
PROTOCOL_VIOLATION = 2
TRANSMIT_ERRORS = 6
RECEIVE_ERRORS = 7

# recorded states of a valve
FILL = 0.0
HOLD = 1.0
VENT = 2.0
# recorded magnets of an axle: only the hold magnet is energised
HOLD_MAGNET = 1.0

# emergency error codes of CiA 301
ERROR_PASSIVE = 0x8120
HEARTBEAT_MISSING = 0x8130
RECOVERED_FROM_BUS_OFF = 0x8140
NO_ERROR = 0

# heartbeat data
BOOT_UP = b"\x00"
OPERATIONAL = b"\x05"

# the second argument of a register's writer
CHECK_ONLY = True
EXECUTE = False


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """Return the record of the run that contains every fault."""
    return faulty_run.run(tmp_path_factory.mktemp("faults"))


@pytest.fixture(scope="module")
def second_rig(tmp_path_factory):
    """Return the record of a repetition of that run."""
    return faulty_run.run(tmp_path_factory.mktemp("again"))


def within(kind, settle_s=2 * CYCLE_S):
    """Return the interval in which a fault is active and its beginning has settled."""
    begin, end = TIMES[kind]
    return begin + settle_s, end


def after(kind, for_s=0.05):
    """Return an interval after a fault has been lifted."""
    end = TIMES[kind][1]
    return end + 2 * CYCLE_S, end + 2 * CYCLE_S + for_s


def speeds_on_bus(rig, from_s, to_s):
    """Return the speeds of TPDO1 of node 16 in rad/s, shape (n, 4)."""
    frames = rig.on_bus(SPEEDS, from_s, to_s)
    return np.array([np.frombuffer(data, "<i2") for data in frames]) * 0.01


def pressures_on_bus(rig, from_s, to_s):
    """Return the cylinder pressures of TPDO1 of node 17 in mbar, shape (n, 4)."""
    frames = rig.on_bus(PRESSURES, from_s, to_s)
    return np.array([np.frombuffer(data, "<i2") for data in frames])


def measured_speeds(rig, from_s, to_s):
    """Return the speeds that the sensors measure in rad/s, shape (4, n)."""
    return samples(rig, "measured_speed:_rad_s", from_s, to_s)


def wheel_speeds(rig, from_s, to_s):
    """Return the true speeds of the wheels in rad/s, shape (4, n)."""
    return samples(rig, "wheel_speed:_rad_s", from_s, to_s)


# --- all faults ---


@pytest.mark.parametrize("name", ["dump_valve_stuck", "valve_stuck"])
def test_a_stuck_valve_is_answered_with_the_faults_of_its_magnets(name):
    with pytest.raises(ConfigError) as refused:
        catalogue.parse(f"{name} axle=1", COACH, "fault")
    assert "did you mean 'hold_magnet_stuck' or 'vent_magnet_stuck'?" in str(refused.value)
    assert f"'{name}' is not a fault" in str(refused.value)


@pytest.mark.conformance("Faults", "every fault: begins and is lifted, recorded")
@pytest.mark.parametrize("kind", list(catalogue.of(COACH)))
def test_every_fault_of_the_catalogue_is_recorded_when_it_begins_and_when_it_is_lifted(rig, kind):
    begin, end = TIMES[kind]
    assert begin in rig.reported(Code.FAULT_BEGINS, kind=kind)

    lifted = rig.reported(Code.FAULT_LIFTED, kind=kind)
    assert any(time == pytest.approx(end, abs=1e-9) for time in lifted)


def test_a_run_with_every_fault_repeats_bit_for_bit(rig, second_rig):
    first = rig.run
    second = second_rig.run
    assert filecmp.cmp(first.folder / "can.log", second.folder / "can.log", shallow=False)

    for name in first.table.column_names:
        # the columns of ticks hold times of this machine
        if name.startswith("tick_"):
            continue
        assert np.array_equal(first.column(name), second.column(name), equal_nan=True), name


# --- speed sensors ---


def test_before_a_fault_sensors_measure_the_wheels_true_speed(rig):
    assert np.array_equal(measured_speeds(rig, 0.0, 0.5), wheel_speeds(rig, 0.0, 0.5))


@pytest.mark.conformance("Faults", "speed_sensor_stuck")
def test_a_stuck_sensor_repeats_one_speed_while_the_wheel_slows_down(rig):
    span = within("speed_sensor_stuck")
    assert np.ptp(measured_speeds(rig, *span)[0]) == 0.0
    assert np.ptp(wheel_speeds(rig, *span)[0]) > 0.3
    assert np.ptp(speeds_on_bus(rig, *span)[:, 0]) == 0.0
    assert np.ptp(rig.channel("pulse_count_1", *span)) == 0.0

    later = after("speed_sensor_stuck")
    assert np.array_equal(measured_speeds(rig, *later)[0], wheel_speeds(rig, *later)[0])


@pytest.mark.conformance("Faults", "speed_sensor_dropout")
def test_a_sensor_that_drops_out_measures_zero_and_counts_no_pulses(rig):
    span = within("speed_sensor_dropout")
    assert not measured_speeds(rig, *span)[1].any()
    assert not speeds_on_bus(rig, *span)[:, 1].any()
    assert np.ptp(rig.channel("pulse_count_2", *span)) == 0.0

    later = after("speed_sensor_dropout")
    assert (speeds_on_bus(rig, *later)[:, 1] > 10.0).all()


@pytest.mark.conformance("Faults", "missing_tooth")
def test_missing_teeth_make_the_measured_speed_dip_once_a_turn(rig):
    span = within("missing_tooth", 0.05)
    true_speed = wheel_speeds(rig, *span)[2]
    ratio = measured_speeds(rig, *span)[2] / true_speed
    dips = ratio < 0.95

    turns = np.ptp(rig.channel("wheel_angle_3_rad", *span)) / (2 * np.pi)
    assert turns - 1.5 <= dips.sum() <= turns + 1.5
    assert np.abs(ratio[~dips] - 1.0).max() < 0.05
    assert speeds_on_bus(rig, *span)[:, 2].min() < 0.95 * true_speed.min()


@pytest.mark.conformance("Faults", "speed_noise_burst")
def test_a_noise_burst_scatters_the_measured_speed_by_its_standard_deviation(rig):
    span = within("speed_noise_burst", 0.0)
    error = (measured_speeds(rig, *span) - wheel_speeds(rig, *span))[3]
    assert 3.0 < error[1:].std() < 7.0
    assert speeds_on_bus(rig, *span)[2:, 3].std() > 3.0

    later = after("speed_noise_burst")
    assert np.array_equal(measured_speeds(rig, *later)[3], wheel_speeds(rig, *later)[3])


@pytest.mark.conformance("Faults", "swapped_axles")
def test_swapped_axles_report_each_others_speed(rig):
    span = within("swapped_axles")
    measured = measured_speeds(rig, *span)
    true = wheel_speeds(rig, *span)
    assert not np.array_equal(true[0], true[1])
    assert np.array_equal(measured[:2], true[[1, 0]])


@pytest.mark.conformance("Faults", "wheel_diameter_mismatch")
def test_a_larger_wheel_is_measured_slower_by_the_difference_of_the_diameters(rig):
    span = within("wheel_diameter_mismatch")
    measured = measured_speeds(rig, *span)[2]
    true = wheel_speeds(rig, *span)[2]
    assert measured * 1.05 == pytest.approx(true, rel=1e-12)

    on_bus = speeds_on_bus(rig, *span)
    assert on_bus[:, 2] == pytest.approx(on_bus[:, 1] / 1.05, rel=0.01)


@pytest.mark.conformance("Faults", "speed_sensor_drift")
def test_a_sensor_that_drifts_jumps_and_then_leaves_the_true_speed_at_its_rate(rig):
    span = within("speed_sensor_drift", 0.0)
    measured = measured_speeds(rig, *span)[3]
    true = wheel_speeds(rig, *span)[3]
    since_s = rig.channel("time_s", *span) - span[0]
    drifted = true * (1.0 - 0.10 + 0.04 * since_s)
    assert measured[1:] == pytest.approx(drifted[1:], rel=1e-3)
    assert speeds_on_bus(rig, *span)[-1, 3] == pytest.approx(measured[-1], abs=0.2)

    # its pulses are those of the wheel
    whole, drifting = (
        np.ptp(rig.channel(f"pulse_count_{axle}", *span))
        / np.ptp(rig.channel(f"wheel_angle_{axle}_rad", *span))
        for axle in (3, 4)
    )
    assert drifting == pytest.approx(whole, rel=0.02)

    later = after("speed_sensor_drift")
    assert np.array_equal(measured_speeds(rig, *later)[3], wheel_speeds(rig, *later)[3])


# --- valves and cylinders ---


@pytest.mark.conformance("Faults", "hold_magnet_stuck")
def test_a_stuck_hold_magnet_keeps_the_pressure_while_other_cylinders_fill(rig):
    span = within("hold_magnet_stuck", 0.1)
    assert set(rig.channel("valve_1", *span)) == {HOLD}
    pressures = pressures_on_bus(rig, *span)
    assert np.ptp(pressures[:, 0]) <= 1
    assert np.ptp(pressures[:, 2]) > 100

    from_s, to_s = after("hold_magnet_stuck", 0.02)
    assert set(rig.channel("valve_1", from_s + 0.05, to_s + 0.05)) == {FILL}


@pytest.mark.conformance("Faults", "vent_magnet_stuck")
def test_a_stuck_vent_magnet_empties_the_cylinder(rig):
    begin, end = TIMES["vent_magnet_stuck"]
    assert set(rig.channel("valve_2", begin + 0.1, end)) == {VENT}

    first = pressures_on_bus(rig, begin, begin + 0.02)[0]
    last = pressures_on_bus(rig, end - 0.02, end)[-1]
    assert last[1] < 0.2 * first[1]


@pytest.mark.conformance("Faults", "hold_magnet_dead")
def test_a_dead_hold_magnet_lets_the_cylinder_fill_when_hold_is_commanded(rig):
    span = (2.2, 2.4)
    assert set(rig.on_bus(MAGNETS, *span)) == {bytes([faulty_run.HOLD_ALL])}
    assert set(rig.channel("valve_3", *span)) == {FILL}
    assert set(rig.channel("valve_1", *span)) == {HOLD}

    pressures = pressures_on_bus(rig, *span)
    assert np.ptp(pressures[:, 2]) > np.ptp(pressures[:, 0])


@pytest.mark.conformance("Faults", "vent_magnet_dead")
def test_a_dead_vent_magnet_only_holds_when_vent_is_commanded(rig):
    span = (2.5, 2.7)
    assert set(rig.on_bus(MAGNETS, *span)) == {bytes([faulty_run.VENT_ALL])}
    assert set(rig.channel("valve_4", *span)) == {HOLD}
    assert set(rig.channel("magnets_4", *span)) == {HOLD_MAGNET}
    assert set(rig.channel("valve_3", *span)) == {VENT}
    assert np.ptp(pressures_on_bus(rig, *span)[:, 3]) <= 1


@pytest.mark.conformance("Faults", "cylinder_leak")
def test_a_leaking_cylinder_loses_pressure_and_gets_it_back(rig):
    begin, end = TIMES["cylinder_leak"]
    # axle 2 has been vented like axle 1, and has no leak
    before = pressures_on_bus(rig, begin - 0.05, begin)[-1]
    assert before[0] == pytest.approx(before[1], rel=0.1)

    leaking = pressures_on_bus(rig, end - 0.05, end)[-1]
    assert leaking[0] < 0.75 * leaking[1]

    refilled = pressures_on_bus(rig, end + 0.9, end + 1.0)[-1]
    assert refilled[0] > 0.9 * refilled[3]


# --- sanders ---


def test_a_blocked_wrong_or_empty_sander_gives_less_sand_and_the_other_sander_continues(rig):
    def sand_rate(axle, from_s, to_s):
        return rig.channel(f"sand_rate_{axle}_kg_s", from_s, to_s)

    normal_kg_s = sand_rate(1, 0.9, 1.0)[-1]
    assert normal_kg_s > 0.05

    # axle 1 is blocked from 1 s to 2 s, and axle 2 continues
    assert sand_rate(1, 1.9, 2.0)[-1] < 0.15 * normal_kg_s
    assert np.ptp(rig.channel("sand_box_1_kg", 1.1, 2.0)) == 0.0
    assert (sand_rate(2, 1.1, 2.0) > 0.9 * normal_kg_s).all()

    # axle 1 has a wrong orifice from 3 s to 4 s
    assert 0.25 * normal_kg_s < sand_rate(1, 3.9, 4.0)[-1] < 0.5 * normal_kg_s

    # the box of axle 2 is empty from 7 s
    assert sand_rate(2, 6.9, 7.0)[-1] > 0.9 * normal_kg_s
    assert rig.channel("sand_box_2_kg", 7.1, 9.0).max() == 0.0
    assert np.ptp(rig.channel("sand_taken_2_kg", 7.1, 9.0)) == 0.0
    assert sand_rate(2, 8.9, 9.0).max() < 0.1 * normal_kg_s


# --- drives ---


def drive_frames(rig, node, from_s, to_s):
    """Return the data of TPDO1 of a drive."""
    return rig.on_bus(0x180 + node, from_s, to_s)


def statuswords(rig, node, from_s, to_s):
    """Return the statuswords that a drive sends."""
    return [int.from_bytes(data[:2], "little") for data in drive_frames(rig, node, from_s, to_s)]


def torques_on_bus(rig, node, from_s, to_s):
    """Return the actual torques that a drive sends, in the drive's units."""
    frames = drive_frames(rig, node, from_s, to_s)
    return np.array([int.from_bytes(data[3:5], "little", signed=True) for data in frames])


def emergencies(rig, node, kind, more_s=0.05):
    """Return the emergency codes that a node sends during a fault and shortly after it."""
    begin, end = TIMES[kind]
    frames = rig.on_bus(0x080 + node, begin, end + more_s)
    return [int.from_bytes(data[:2], "little") for data in frames]


def in_fault(statusword):
    """Return whether a statusword is that of the state Fault."""
    return statusword & 0x4F == 0x08


def is_enabled(statusword):
    """Return whether a statusword is that of the state Operation enabled."""
    return statusword & 0x6F == 0x27


def has_voltage(statusword):
    """Return whether bit 4, voltage enabled, is set."""
    return bool(statusword & 0x10)


def warns(statusword):
    """Return whether bit 7, warning, is set."""
    return bool(statusword & 0x80)


@pytest.mark.conformance("Faults", "torque_ripple")
def test_torque_ripple_shows_in_demand_and_torque_on_the_bus(rig):
    span = within("torque_ripple")
    assert rig.channel("motor_torque_demand_2_Nm", *span).std() > 1000.0

    with_ripple = torques_on_bus(rig, 2, *span)
    without_ripple = torques_on_bus(rig, 2, 2.9, 3.0)
    assert with_ripple.std() > 3 * without_ripple.std()

    sign_changes = np.diff(np.sign(with_ripple - with_ripple.mean())).astype(bool)
    assert sign_changes.sum() > 6


@pytest.mark.conformance(
    "Faults", "drive_trip, drive_over_temperature, power_dip: code, no torque, back"
)
@pytest.mark.parametrize(
    ("kind", "node", "code"),
    [("drive_trip", 1, 0x5112), ("drive_over_temperature", 2, 0x4310), ("power_dip", 3, 0x3220)],
)
def test_a_drive_that_trips_sends_its_code_gives_no_torque_and_runs_again(rig, kind, node, code):
    torque = f"motor_torque_{node}_Nm"
    span = within(kind, 0.05)
    assert emergencies(rig, node, kind) == [code, NO_ERROR]
    assert all(in_fault(word) for word in statuswords(rig, node, *span))
    assert np.abs(rig.channel(torque, *span)).max() < 10.0

    later = after(kind)
    assert all(is_enabled(word) for word in statuswords(rig, node, *later))
    assert rig.channel(torque, *later).mean() > 100.0


@pytest.mark.conformance("Faults", "drive_over_temperature: warning")
def test_a_hot_drive_warns_with_bit_7(rig):
    during = statuswords(rig, 2, *within("drive_over_temperature"))
    assert all(warns(word) for word in during)

    later = statuswords(rig, 2, *after("drive_over_temperature"))
    assert not any(warns(word) for word in later)


@pytest.mark.conformance("Faults", "drive_over_temperature: temperature")
def test_a_hot_motor_reports_its_temperature_and_the_others_report_the_airs(rig):
    air_K = 293.15
    rise_K = rig.run.scenario["drive"]["rated_temperature_rise_K"]

    hot_K = samples(rig, "motor_temperature:_K", *within("drive_over_temperature"))
    assert hot_K[1] == pytest.approx(air_K + 1.25 * rise_K, abs=0.01)
    assert np.abs(hot_K[[0, 2, 3]] - air_K).max() < 3.0

    later_K = samples(rig, "motor_temperature:_K", *after("drive_over_temperature"))
    assert np.abs(later_K - air_K).max() < 3.0


@pytest.mark.conformance("Faults", "power_dip")
def test_a_power_dip_trips_every_drive_and_clears_voltage_enabled(rig):
    for node in (1, 2, 3, 4):
        for word in statuswords(rig, node, *within("power_dip")):
            assert in_fault(word)
            assert not has_voltage(word)
        for word in statuswords(rig, node, *after("power_dip")):
            assert has_voltage(word)


# --- nodes and frames ---


def sent_by(rig, identifiers, from_s, to_s):
    """Return the identifiers of this set that are on the bus within an interval."""
    return [
        can_id
        for time_s, can_id, _ in rig.frames
        if can_id in identifiers and from_s <= time_s < to_s
    ]


@pytest.mark.conformance("Faults", "node_off")
def test_a_node_without_power_is_silent_and_boots_when_it_is_back(rig):
    begin, end = TIMES["node_off"]
    frames_of_node_16 = {0x190, 0x290, 0x390, 0x710, 0x090, 0x590}
    assert sent_by(rig, frames_of_node_16, begin, end) == []

    assert rig.on_bus(HEARTBEAT_16, end, end + 0.05)[0] == BOOT_UP
    assert rig.on_bus(SPEEDS, end + 0.02, end + 0.1)


@pytest.mark.conformance("Faults", "node_babbling")
def test_a_babbling_node_fills_the_bus(rig):
    begin, end = TIMES["node_babbling"]
    count = len(rig.on_bus(BABBLE, begin, end + CYCLE_S))
    assert count == pytest.approx(2000.0 * (end - begin), abs=21)
    assert rig.on_bus(BABBLE, end + CYCLE_S, 9.0) == []


@pytest.mark.conformance("Faults", "frame_lost")
def test_lost_frames_are_missing_on_the_bus_and_counted(rig):
    begin, end = TIMES["frame_lost"]
    assert len(rig.on_bus(PRESSURES, begin, end)) == 10
    assert len(rig.on_bus(SPEEDS, begin, end)) == 20
    assert rig.reported(Code.FAULT_LIFTED, kind="frame_lost", frames_met=10)


@pytest.mark.conformance("Faults", "frame_delayed")
def test_delayed_frames_carry_the_values_of_the_time_when_they_were_sent(rig):
    begin, end = TIMES["frame_delayed"]
    assert rig.on_bus(SPEEDS, begin, begin + 0.045) == []

    on_bus = speeds_on_bus(rig, begin + 0.06, end)[:, 0]
    at_arrival = rig.channel("measured_speed_1_rad_s", begin + 0.06, end)
    when_sent = rig.channel("measured_speed_1_rad_s", begin + 0.01, end - 0.05)
    assert np.abs(on_bus - when_sent[: len(on_bus)]).max() <= 0.011
    assert np.abs(on_bus - at_arrival[: len(on_bus)]).max() > 0.05


@pytest.mark.conformance("Faults", "frame_duplicated")
def test_duplicated_frames_come_twice(rig):
    begin, end = TIMES["frame_duplicated"]
    frames = rig.on_bus(PRESSURES, begin, end)
    assert len(frames) == 40
    assert frames[0::2] == frames[1::2]


@pytest.mark.conformance("Faults", "error_frame")
def test_error_frames_drive_a_node_to_error_passive_to_bus_off_and_back(rig):
    begin, end = TIMES["error_frame"]
    counters = [data[TRANSMIT_ERRORS] for data in rig.on_bus(ERROR_FRAME, begin, end)]
    assert counters[:3] == [8, 16, 23]
    assert max(counters) == 255

    codes = emergencies(rig, 17, "error_frame")
    assert codes.index(ERROR_PASSIVE) < codes.index(RECOVERED_FROM_BUS_OFF)
    assert rig.reported(Code.CAN_ERROR_PASSIVE, node=17)
    assert rig.reported(Code.CAN_BUS_OFF, node=17)
    assert rig.on_bus(ERROR_FRAME, end, 9.0) == []


@pytest.mark.conformance("Faults", "receive_error")
def test_a_faulty_receiver_destroys_frames_until_it_is_error_passive_and_then_only_misses_them(rig):
    begin, end = TIMES["receive_error"]
    errors = rig.on_bus(ERROR_FRAME, begin, end)
    counters = [data[RECEIVE_ERRORS] for data in errors]
    assert counters[:3] == [9, 17, 25]
    assert not any(data[PROTOCOL_VIOLATION] for data in errors)
    assert len(errors) < 30

    assert emergencies(rig, 16, "receive_error") == [ERROR_PASSIVE, NO_ERROR]
    assert rig.reported(Code.CAN_ERROR_PASSIVE, node=16, counter="receive")
    assert rig.reported(Code.CAN_ERROR_ACTIVE, node=16)

    # The node misses SYNC, so it sends no speeds. Its heartbeat continues.
    assert rig.on_bus(SPEEDS, begin + 0.03, end) == []
    assert set(rig.on_bus(HEARTBEAT_16, begin, end)) == {OPERATIONAL}
    # its neighbour still receives SYNC and sends
    assert len(rig.on_bus(PRESSURES, begin + 0.03, end)) == 37

    assert len(rig.on_bus(SPEEDS, end + 0.015, end + 0.115)) == 10


@pytest.mark.conformance("Faults", "bus_off")
def test_a_node_whose_controller_is_off_sends_nothing_and_continues_without_booting(rig):
    begin, end = TIMES["bus_off"]
    frames_of_node_4 = {0x184, 0x284, 0x704, 0x084}
    assert sent_by(rig, frames_of_node_4, begin, end) == []

    assert emergencies(rig, 4, "bus_off")[:1] == [RECOVERED_FROM_BUS_OFF]
    assert set(rig.on_bus(HEARTBEAT_4, end, end + 0.3)) == {OPERATIONAL}
    assert all(is_enabled(word) for word in statuswords(rig, 4, end + 0.02, end + 0.1))
    # the drive itself has kept running
    assert rig.channel("motor_torque_4_Nm", begin, end).mean() > 100.0


@pytest.mark.conformance("Faults", "heartbeat_late")
def test_late_heartbeats_make_the_master_miss_the_node(rig):
    begin, end = TIMES["heartbeat_late"]
    assert rig.on_bus(HEARTBEAT_17, begin, end) == []
    assert any(begin < time < end for time in rig.reported(Code.NODE_LOST, node=17))
    assert rig.on_bus(HEARTBEAT_17, end, end + 0.05)


# --- the WSP unit ---


@pytest.mark.conformance("Faults", "wsp_frozen")
def test_a_frozen_unit_lets_the_brakes_apply_after_its_heartbeat_is_lost(rig):
    begin, end = TIMES["wsp_frozen"]
    assert rig.on_bus(MAGNETS, begin, end) == []
    assert rig.on_bus(HEARTBEAT_UNIT, begin, end) == []

    assert emergencies(rig, 17, "wsp_frozen", 0.1) == [HEARTBEAT_MISSING, NO_ERROR]
    fail_safe = rig.reported(Code.MAGNETS_FAIL_SAFE, magnets=0)
    assert any(begin + 0.15 < time < begin + 0.3 for time in fail_safe)

    # the delayed answers arrive immediately when the unit continues
    assert len(rig.on_bus(MAGNETS, end, end + 0.005)) > 30


@pytest.mark.conformance("Faults", "wsp_frozen: the reference unit")
def test_the_reference_units_process_is_stopped_and_continues(tmp_path):
    path = tmp_path / "frozen.toml"
    path.write_text(
        'adhesion = "dry"\n'
        "initial_speed_m_s = 20.0\n"
        "duration_max_s = 1.2\n"
        "[bus]\n"
        'interface = "hub"\n'
        "socketcand_port = 0\n"
    )
    plan = scenario.load(str(path), faults=("wsp_frozen at=0.3 for=0.5",))
    out = tmp_path / "run"
    rig = bench.Bench(plan, options.Options("lockstep", "reference", out), lambda progress: None)
    result = asyncio.run(rig.run())
    assert result["ended"] == "finished"

    recorded = faulty_run.Recorded(records.load(out))
    assert recorded.on_bus(MAGNETS, 0.3, 0.79) == []
    assert recorded.reported(Code.MAGNETS_FAIL_SAFE)
    # the unit first answers every SYNC that it missed, and then each SYNC in time
    assert len(recorded.on_bus(MAGNETS, 0.795, 0.805)) == 51
    assert len(recorded.on_bus(MAGNETS, 0.805, 1.195)) == 39


# --- the array of effects ---


def row_after(scenario_name, effect_values=None, ticks=300):
    """Return the row after some ticks of a bench whose effects array holds these values."""
    plan = scenario.load(scenario_name)
    rows = ring.Ring(ring.place("rows"), np.float64, 1 << 10, len(plan.table.columns))
    try:
        data = tick_data.build(plan, rows)
        if effect_values is not None:
            data.commands.values[tick.FAULTS : tick.MOTORS] = effect_values
        tick.run_ticks(data, ticks)
        return data.row.copy()
    finally:
        rows.close()
        rows.unlink()


def test_a_faults_array_whose_values_are_zero_changes_no_bit():
    row = row_after("dry_stop")

    # the flag makes the tick look at the effects, which are all zero
    values = np.zeros(effects.SIZE)
    values[effects.ANY] = 1.0
    assert np.array_equal(row, row_after("dry_stop", values), equal_nan=True)

    # the comparison does notice an effect
    values[effects.slot(effects.LEAK_per_s, 1)] = 1.0
    assert not np.array_equal(row, row_after("dry_stop", values), equal_nan=True)


# --- how faults are given ---


def test_a_fault_can_be_injected_and_cleared_by_hand(rig):
    begin, end, _ = faulty_run.BY_HAND
    assert not measured_speeds(rig, begin + 0.02, end)[3].any()
    assert measured_speeds(rig, end + 0.02, end + 0.1)[3].all()

    fault = "speed_sensor_dropout axle=4"
    assert len(rig.reported(Code.FAULT_BEGINS, fault=fault)) == 1
    assert len(rig.reported(Code.FAULT_LIFTED, fault=fault)) == 1


@pytest.mark.conformance("Faults", "injected from the command line")
def test_a_fault_of_the_command_line_is_the_scenarios_fault():
    plan = scenario.load("dry_stop", faults=("frame_lost can_id=0x190 every=3 at=5 for=2",))
    assert plan["fault"] == [
        {"kind": "frame_lost", "at_s": 5.0, "for_s": 2.0, "can_id": 0x190, "every": 3}
    ]
    assert plan.faults == catalogue.all_of(plan["fault"], COACH, "again")


@pytest.mark.parametrize(
    ("text", "message"),
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
def test_a_wrong_fault_is_refused_with_what_is_allowed(text, message):
    with pytest.raises(ConfigError, match="--fault") as refused:
        catalogue.parse(text, COACH)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("vehicle", "text", "message"),
    [
        (Kind(2), "swapped_axles axle=1 other=3", "other = 3 is out of range; allowed 1 to 2"),
        (Kind(8), "speed_sensor_stuck axle=9", "axle = 9 is out of range; allowed 1 to 8"),
        (Kind(8), "wsp_frozen group=3", "group = 3 is out of range; allowed 0 to 2"),
        (COACH, "wsp_frozen group=1", "unknown key 'group'"),
        (Kind(6), "node_off node=39", "allowed are 1, 2, 3, 4, 33, 34, 16, 48, 17, 49"),
        (COACH, "dynamic_brake_lost axle=1", "of vehicles with [dynamic_brake] axles"),
        (COACH, "track_brake_dead bogie=1", "of vehicles with [magnetic_track_brake] bogies"),
        (
            Kind(6, magnetic_track_brake=True),
            "track_brake_dead bogie=4",
            "bogie = 4 is out of range; allowed 1 to 3",
        ),
    ],
)
def test_a_fault_is_refused_that_the_vehicle_cannot_have(vehicle, text, message):
    with pytest.raises(ConfigError, match="--fault") as refused:
        catalogue.parse(text, vehicle)
    assert message in str(refused.value)


def test_a_fault_has_the_axles_and_units_of_its_vehicle():
    frozen = catalogue.parse("wsp_frozen group=2", Kind(6))
    assert (frozen.units, frozen.explains) == ([64], {5, 6})
    assert bus.frozen_groups(frozen) == {1}
    all_frozen = catalogue.parse("wsp_frozen", Kind(6))
    assert (all_frozen.units, bus.frozen_groups(all_frozen)) == ([32, 64], {0, 1})
    assert catalogue.parse("speed_sensor_stuck axle=5", Kind(6)).explains == {5, 6}
    assert not catalogue.parse("frame_lost can_id=0x1B0", COACH).reaches_unit
    assert catalogue.parse("frame_lost can_id=0x1B0", Kind(6)).reaches_unit


def test_a_fault_of_the_bus_is_refused_where_there_is_no_bus():
    planned = (catalogue.parse("node_off node=16", COACH),)
    with pytest.raises(ConfigError, match="--pacing free has none"):
        panel.check_pacing(planned, "free")
    panel.check_pacing(planned, "lockstep")


class RigWithoutBus:
    """A fault panel that acts on an array, and the events that the panel reports."""

    def __init__(self):
        self.events = []
        self.array = np.zeros(effects.SIZE)
        self.faults = panel.Panel((), self.event, {})
        self.faults.connect(panel.Site(self.array, lambda: None))

    def event(self, code, /, **fields):
        self.events.append(events.make(0.0, code, **fields))


@pytest.mark.conformance("Faults", "injected over Modbus")
@pytest.mark.conformance("Modbus", "faults are chosen, injected and lifted by registers")
def test_a_fault_is_chosen_injected_and_lifted_over_modbus():
    rig = RigWithoutBus()
    registers = fault_registers.FaultRegisters(rig.faults, rig.event)
    write = registers.writers()
    read = registers.readers()

    leak = catalogue.BY_NAME["cylinder_leak"].number
    requests = (("fault", leak), ("fault_target", 3), ("fault_duration", 20), ("inject_fault", 1))
    for name, raw in requests:
        # a check has no effect
        write[name](raw, CHECK_ONLY)
        assert read["faults_active"]() == 0
        write[name](raw, EXECUTE)
    assert rig.array[effects.slot(effects.LEAK_per_s, 3)] == 0.5
    assert read["faults_active"]() == 1
    assert read["fault"]() == leak

    # the fault is lifted when its duration of 2 s has passed
    rig.faults.poll(2.1)
    assert not rig.array.any()

    # a second fault is lifted by its register
    write["inject_fault"](1, EXECUTE)
    write["lift_faults"](1, EXECUTE)
    assert not rig.array.any()
    codes = [event.code for event in rig.events]
    assert codes == [Code.FAULT_BEGINS, Code.FAULT_LIFTED] * 2


def test_each_of_two_swapped_sensors_shows_the_speed_of_the_other_axle():
    rig = RigWithoutBus()
    rig.faults.inject("swapped_axles", axle=2, other=3)
    assert rig.array[effects.slot(effects.SOURCE, 2)] == 3
    assert rig.array[effects.slot(effects.SOURCE, 3)] == 2


@pytest.mark.parametrize(("every", "lost"), [(1, [0, 1, 2, 3, 4, 5]), (2, [1, 3, 5]), (3, [2, 5])])
def test_a_rule_of_the_gate_meets_every_nth_frame_of_its_identifier(every, lost):
    gate = bus.Gate(Controllers(lambda *_: None))
    fault = catalogue.parse(f"frame_lost can_id=0x190 every={every}", COACH)
    (rule,) = bus.rules_of(fault)
    gate.add(rule)
    passed = [gate.passes(Frame(0x190, b""), 16, lambda: None) for _ in range(6)]
    assert [at for at, passes in enumerate(passed) if not passes] == lost
    assert gate.passes(Frame(0x191, b""), 16, lambda: None)
    assert (rule.count, rule.hit) == (6, len(lost))


def test_an_impossible_fault_is_refused_over_modbus_and_reported():
    rig = RigWithoutBus()
    write = fault_registers.FaultRegisters(rig.faults, rig.event).writers()
    with pytest.raises(RefusedError):
        write["fault"](max(kind.number for kind in catalogue.CATALOGUE) + 1, CHECK_ONLY)
    # a fault of equipment that this vehicle does not have
    with pytest.raises(RefusedError):
        write["fault"](catalogue.BY_NAME["dynamic_brake_lost"].number, CHECK_ONLY)

    write["fault_target"](9, EXECUTE)
    with pytest.raises(RefusedError):
        write["inject_fault"](1, EXECUTE)
    assert rig.events[0].code == Code.FAULT_REFUSED
    assert "allowed 1 to 4" in rig.events[0].fields["reason"]
