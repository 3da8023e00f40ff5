"""The roller drive: states, option codes, modes, control sources. Real frames over the hub."""

import pytest
from canopen.profiles.p402 import BaseNode402

from rollerrig.firmware_sim.drive402 import axis, objects, states
from rollerrig.firmware_sim.drive402.states import State
from rollerrig.wsp_interface import signals

RATED_Nm = objects.DEFAULTS["rated_torque_Nm"]
DISABLED, READY, ON, ENABLED = (
    State.SWITCH_ON_DISABLED,
    State.READY_TO_SWITCH_ON,
    State.SWITCHED_ON,
    State.OPERATION_ENABLED,
)
SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP, RESET, HALT = 6, 7, 15, 0, 2, 0x80, 0x10F
WALK = {
    DISABLED: (),
    READY: (SHUTDOWN,),
    ON: (SHUTDOWN, SWITCH_ON),
    ENABLED: (SHUTDOWN, SWITCH_ON, ENABLE),
}


def status(wire, node=1):
    return int.from_bytes(wire.read(node, 0x6041), "little")


PATTERNS = {
    (0x4F, 0x00): State.NOT_READY_TO_SWITCH_ON,
    (0x4F, 0x40): DISABLED,
    (0x6F, 0x21): READY,
    (0x6F, 0x23): ON,
    (0x6F, 0x27): ENABLED,
    (0x6F, 0x07): State.QUICK_STOP_ACTIVE,
    (0x4F, 0x0F): State.FAULT_REACTION_ACTIVE,
    (0x4F, 0x08): State.FAULT,
}


def state(wire):
    """The state that the statusword tells, by the masks of the standard; one pattern fits."""
    word = status(wire)
    (found,) = (one for (mask, value), one in PATTERNS.items() if word & mask == value)
    return found


def control(wire, *words):
    for word in words:
        assert wire.write(1, 0x6040, 0, word, 2) == 0


@pytest.fixture
def drive(wire):
    """A drive that the bus controls, OPERATIONAL."""
    node = wire.drive(1, control="bus")
    wire.nmt(1)
    wire.run(1)
    return node


def set_row(wire, name, value):
    wire.row[signals.column(name, 1)] = value


@pytest.mark.conformance("CiA 402", "every state and transition by controlword")
@pytest.mark.parametrize(
    ("before", "word", "after"),
    [
        (DISABLED, SHUTDOWN, READY),
        (DISABLED, SWITCH_ON, DISABLED),
        (DISABLED, ENABLE, DISABLED),
        (READY, SWITCH_ON, ON),
        (READY, ENABLE, ENABLED),
        (READY, DISABLE_VOLTAGE, DISABLED),
        (READY, QUICK_STOP, DISABLED),
        (ON, ENABLE, ENABLED),
        (ON, SHUTDOWN, READY),
        (ON, DISABLE_VOLTAGE, DISABLED),
        (ON, QUICK_STOP, DISABLED),
        (ENABLED, SHUTDOWN, READY),
        (ENABLED, DISABLE_VOLTAGE, DISABLED),
        (ENABLED, RESET, ENABLED),
    ],
)
def test_a_controlword_makes_the_transition_of_the_standard(wire, drive, before, word, after):
    control(wire, *WALK[before])
    assert state(wire) == before
    control(wire, word)
    assert state(wire) == after


@pytest.mark.conformance("CiA 402", "transitions 0 to 16, numbered")
def test_every_numbered_transition_stands_once_in_the_table():
    automatic = {0, states.SELF_TEST_PASSED, 12, states.FAULT_DETECTED, states.REACTION_COMPLETED}
    numbers = [row.number for row in states.TRANSITIONS]
    assert len(numbers) == len(set(numbers))
    assert set(numbers) | automatic == set(range(17))


@pytest.mark.conformance("CiA 402", "statusword: state, voltage enabled, remote")
@pytest.mark.parametrize(
    ("word", "pattern", "mask"),
    [((), 0x40, 0x4F), ((6,), 0x21, 0x6F), ((6, 7), 0x23, 0x6F), ((6, 7, 15), 0x27, 0x6F)],
)
def test_the_statusword_tells_state_voltage_and_remote(wire, drive, word, pattern, mask):
    control(wire, *word)
    assert status(wire) & mask == pattern
    assert status(wire) & 0x210 == 0x210


@pytest.mark.conformance("CiA 402", "disable operation option code 605Ch")
def test_disable_operation_brakes_first_and_then_switches_off(wire, drive):
    control(wire, *WALK[ENABLED])
    set_row(wire, "roller_speed", 10.0)
    control(wire, SWITCH_ON)
    control(wire, SWITCH_ON)
    wire.run(100)
    assert state(wire) == ENABLED
    wire.run(500)
    assert state(wire) == ON
    control(wire, ENABLE)
    control(wire, SHUTDOWN)
    assert state(wire) == READY


@pytest.mark.conformance("CiA 402", "shutdown option code 605Bh")
@pytest.mark.parametrize(("option", "at_once"), [(0, True), (1, False)])
def test_shutdown_switches_off_at_once_or_brakes_first(wire, drive, option, at_once):
    wire.write(1, 0x605B, 0, option, 2)
    set_row(wire, "roller_speed", 1.0)
    control(wire, *WALK[ENABLED], SHUTDOWN)
    wire.run(1)
    assert (state(wire) == READY) is at_once
    wire.run(1000)
    assert state(wire) == READY


@pytest.mark.conformance("CiA 402", "mode 9: target with offset 60B1h, follows command (bit 12)")
def test_cyclic_velocity_follows_the_target_and_its_offset_and_says_so(wire, drive):
    wire.write(1, 0x6060, 0, 9, 1)
    control(wire, *WALK[ENABLED])
    wire.write(1, 0x60FF, 0, 30_000, 4)
    wire.write(1, 0x60B1, 0, 5_000, 4)
    wire.run(1)
    assert drive.device.axis.commands[axis.LOOP] == axis.LOOP_VELOCITY
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == pytest.approx(3.5)
    assert status(wire) & states.FOLLOWS
    control(wire, QUICK_STOP)
    assert status(wire) & states.FOLLOWS == 0


@pytest.mark.conformance("CiA 402", "transition 16 and a stop under way")
def test_enabling_again_cancels_a_stop_under_way(wire, drive):
    control(wire, *WALK[ENABLED])
    set_row(wire, "roller_speed", 10.0)
    control(wire, SWITCH_ON)
    wire.run(50)
    control(wire, ENABLE)
    wire.run(1000)
    assert state(wire) == ENABLED


@pytest.mark.conformance("CiA 402", "quick stop option code 605Ah")
@pytest.mark.parametrize(
    ("option", "at_once", "after_rest"),
    [
        (0, DISABLED, DISABLED),
        (1, State.QUICK_STOP_ACTIVE, DISABLED),
        (2, State.QUICK_STOP_ACTIVE, DISABLED),
        (3, State.QUICK_STOP_ACTIVE, DISABLED),
        (5, State.QUICK_STOP_ACTIVE, State.QUICK_STOP_ACTIVE),
        (6, State.QUICK_STOP_ACTIVE, State.QUICK_STOP_ACTIVE),
    ],
)
def test_quick_stop_follows_its_option_code(wire, drive, option, at_once, after_rest):
    assert wire.write(1, 0x605A, 0, option, 2) == 0
    control(wire, *WALK[ENABLED])
    set_row(wire, "roller_speed", 6.0)
    control(wire, QUICK_STOP)
    wire.run(1)
    assert state(wire) == at_once
    wire.run(1000)
    assert state(wire) == after_rest
    if option >= 5:
        control(wire, ENABLE)
        assert state(wire) == ENABLED


@pytest.mark.conformance("CiA 402", "quick stop deceleration 6085h")
def test_the_quick_stop_ramp_is_that_of_6085h(wire, drive):
    control(wire, *WALK[ENABLED])
    set_row(wire, "roller_speed", 6.0)
    wire.write(1, 0x6085, 0, 600_000, 4)
    control(wire, QUICK_STOP)
    wire.run(50)
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == pytest.approx(3.0)
    wire.run(50)
    assert state(wire) == DISABLED


@pytest.mark.conformance("CiA 402", "fault, 603Fh, EMCY, fault reset on the rising edge")
def test_a_fault_brakes_reports_and_is_reset_by_the_rising_edge_only(wire, drive):
    control(wire, *WALK[ENABLED])
    set_row(wire, "roller_speed", 6.0)
    wire.take()
    drive.device.trip(0x2310, "over-current")
    assert wire.take(0x81)[0][:3] == b"\x10\x23\x03"
    assert state(wire) == State.FAULT_REACTION_ACTIVE
    wire.run(200)
    assert state(wire) == State.FAULT
    assert wire.read(1, 0x603F) == b"\x10\x23"
    control(wire, ENABLE)
    assert state(wire) == State.FAULT
    wire.take()
    control(wire, RESET)
    assert state(wire) == DISABLED
    assert wire.read(1, 0x603F) == b"\0\0"
    drive.device.trip(0x2310, "again")
    control(wire, RESET)
    assert state(wire) == State.FAULT
    control(wire, 0, RESET)
    assert state(wire) == DISABLED


@pytest.mark.conformance("CiA 402", "fault reaction option code 605Eh")
@pytest.mark.parametrize("option", [0, 1, 2])
def test_the_fault_reaction_follows_605eh(wire, drive, option):
    wire.write(1, 0x605E, 0, option, 2)
    control(wire, *WALK[ENABLED])
    set_row(wire, "roller_speed", 6.0)
    drive.device.trip(0x2310, "over-current")
    assert state(wire) == (State.FAULT_REACTION_ACTIVE if option else State.FAULT)


@pytest.mark.conformance("CiA 402", "DC link voltage 6079h and fault 3220h")
def test_too_low_a_dc_link_trips_and_trips_again_while_it_lasts(wire, drive):
    drive.device.axis.dc_link_V = 300.0
    wire.run(1)
    assert state(wire) == State.FAULT
    assert status(wire) & states.VOLTAGE_ENABLED == 0
    assert wire.read(1, 0x6079) == (300_000).to_bytes(4, "little")
    control(wire, RESET)
    wire.run(1)
    assert state(wire) == State.FAULT
    drive.device.axis.dc_link_V = 750.0
    control(wire, 0, RESET)
    wire.run(1)
    assert state(wire) == DISABLED


@pytest.mark.conformance("CiA 402", "thermal warning (bit 7) and fault 4310h")
def test_a_motor_that_is_overloaded_for_long_warns_and_then_trips(wire):
    wire.drive(1, control="bus", parameters={"thermal_time_constant_s": 1.0})
    control(wire, *WALK[ENABLED])
    set_row(wire, "motor_torque", 1.5 * RATED_Nm)
    warned_ms = tripped_ms = None
    for at in range(1500):
        wire.run(1)
        warned_ms = warned_ms or (status(wire) & states.WARNING and at)
        tripped_ms = tripped_ms or (status(wire) & 0x08 and at)
    assert 500 < warned_ms < 700 < tripped_ms < 900
    assert wire.read(1, 0x603F) == b"\x10\x43"


@pytest.mark.conformance("CiA 402", "modes 3, 4, 9, 10: 6060h, 6061h, 6502h")
@pytest.mark.parametrize(
    ("mode", "code"),
    [
        (3, 0),
        (4, 0),
        (9, 0),
        (10, 0),
        (1, 0x06090030),
        (6, 0x06090030),
        (8, 0x06090030),
        (-1, 0x06090030),
    ],
)
def test_only_supported_modes_are_taken(wire, drive, mode, code):
    assert wire.write(1, 0x6060, 0, mode, 1) == code
    if not code:
        assert wire.read(1, 0x6061) == bytes([mode])


@pytest.mark.conformance("CiA 402", "mode 3: ramps, target reached")
def test_profile_velocity_ramps_to_the_target_and_says_when_it_is_there(wire, drive):
    wire.write(1, 0x6060, 0, 3, 1)
    wire.write(1, 0x6083, 0, 100_000, 4)
    wire.write(1, 0x60FF, 0, 50_000, 4)
    control(wire, *WALK[ENABLED])
    wire.run(250)
    velocity = drive.device.axis.commands[axis.VELOCITY_rad_s]
    assert velocity == pytest.approx(2.5)
    assert drive.device.axis.commands[axis.LOOP] == axis.LOOP_VELOCITY
    assert status(wire) & states.TARGET_REACHED == 0
    wire.run(300)
    set_row(wire, "roller_speed", 5.0)
    wire.run(20)
    assert status(wire) & states.TARGET_REACHED
    assert status(wire) & states.SPEED_ZERO == 0
    assert wire.read(1, 0x606B) == (50_000).to_bytes(4, "little")


@pytest.mark.conformance("CiA 402", "repeated PDOs do not disturb a ramp")
def test_a_pdo_that_repeats_mode_and_controlword_does_not_disturb_the_ramp(wire, drive):
    wire.write(1, 0x60FF, 0, 500_000, 4)
    for word in (*WALK[ENABLED], *[ENABLE] * 100):
        wire.send(0x201, bytes([word, 0, 3, 0, 0]))
        wire.sync()
        wire.run(1)
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == pytest.approx(20.0 * 0.101)


@pytest.mark.conformance("CiA 402", "halt bit and option code 605Dh")
def test_halt_takes_the_velocity_to_zero_and_its_end_resumes(wire, drive):
    wire.write(1, 0x6060, 0, 9, 1)
    wire.write(1, 0x60FF, 0, 50_000, 4)
    control(wire, *WALK[ENABLED])
    wire.run(2)
    control(wire, HALT)
    wire.run(1000)
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == 0.0
    assert status(wire) & states.FOLLOWS == 0
    control(wire, ENABLE)
    wire.run(2)
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == pytest.approx(5.0)
    assert status(wire) & states.FOLLOWS


@pytest.mark.conformance("CiA 402", "modes 4 and 10: torque slope 6087h and target")
def test_profile_torque_follows_the_slope_and_cyclic_torque_the_target(wire, drive):
    wire.write(1, 0x6087, 0, 1000, 4)
    wire.write(1, 0x6071, 0, 500, 2)
    wire.write(1, 0x6060, 0, 4, 1)
    control(wire, *WALK[ENABLED])
    wire.run(250)
    assert drive.device.axis.commands[axis.TORQUE_Nm] == pytest.approx(0.25 * RATED_Nm)
    assert status(wire) & states.TARGET_REACHED == 0
    wire.run(300)
    assert status(wire) & states.TARGET_REACHED
    wire.write(1, 0x6060, 0, 10, 1)
    wire.run(1)
    assert drive.device.axis.commands[axis.TORQUE_Nm] == pytest.approx(0.5 * RATED_Nm)


@pytest.mark.conformance("CiA 402", "max torque 6072h, internal limit (bit 11)")
def test_a_torque_above_6072h_is_cut_and_told(wire, drive):
    wire.write(1, 0x6072, 0, 300, 2)
    wire.write(1, 0x6071, 0, -500, 2)
    control(wire, *WALK[ENABLED])
    wire.run(2)
    assert drive.device.axis.commands[axis.TORQUE_Nm] == pytest.approx(-0.3 * RATED_Nm)
    assert status(wire) & states.INTERNAL_LIMIT


@pytest.mark.conformance("CiA 402", "max slippage 60F8h (bit 13)")
def test_slippage_is_told_when_the_speed_leaves_the_demand(wire, drive):
    wire.write(1, 0x60F8, 0, 1000, 4)
    wire.write(1, 0x6060, 0, 3, 1)
    control(wire, *WALK[ENABLED])
    wire.run(2)
    assert status(wire) & states.SLIPPAGE == 0
    set_row(wire, "roller_speed", 3.0)
    wire.run(2)
    assert status(wire) & states.SLIPPAGE


@pytest.mark.conformance("CiA 402", "abort connection option code 6007h")
@pytest.mark.parametrize(
    ("option", "after"), [(0, ENABLED), (1, State.FAULT), (2, DISABLED), (3, DISABLED)]
)
def test_a_lost_connection_follows_6007h(wire, drive, option, after):
    wire.write(1, 0x6007, 0, option, 2)
    wire.write(1, 0x1016, 1, 5 << 16 | 50, 4)
    control(wire, *WALK[ENABLED])
    wire.send(0x705, b"\x05")
    wire.run(60)
    assert state(wire) == after


@pytest.mark.conformance("CiA 402", "NMT reset takes the power off the motor")
def test_a_reset_takes_the_power_off_the_motor(wire, drive):
    control(wire, *WALK[ENABLED])
    wire.run(1)
    assert drive.device.axis.commands[axis.ENABLED] == 1.0
    wire.nmt(129, 1)
    wire.run(1)
    assert drive.device.axis.commands[axis.ENABLED] == 0.0
    assert state(wire) == DISABLED


@pytest.mark.conformance("CiA 402", "control source: rig control, bit 9 cleared")
def test_under_the_rig_control_the_drive_is_enabled_and_obeys_no_controlword(wire):
    node = wire.drive(1)
    node.device.control_from_rig()
    for word in (0, SHUTDOWN, QUICK_STOP, 0):
        control(wire, word)
        wire.run(1)
        assert status(wire) == 0x37
    wire.nmt(129, 1)
    assert status(wire) == 0x37


@pytest.mark.conformance("CiA 402", "control source changes without a jump in torque")
def test_the_control_source_changes_while_running_without_a_jump_in_torque(wire):
    node = wire.drive(1)
    wire.nmt(1)
    set_row(wire, "motor_torque", -0.2 * RATED_Nm)
    node.device.control_from_bus()
    for _ in range(20):
        wire.run(1)
        assert node.device.axis.commands[axis.TORQUE_Nm] == pytest.approx(-0.2 * RATED_Nm)
    assert status(wire) & 0x26F == 0x227
    wire.write(1, 0x6071, 0, 0, 2)
    wire.run(1)
    assert node.device.axis.commands[axis.TORQUE_Nm] == 0.0
    node.device.control_from_rig()
    assert status(wire) == 0x37
    assert node.device.axis.commands[axis.LOOP] == axis.LOOP_RIG


@pytest.mark.conformance(
    "CiA 402", "emergency stop from outside the bus: quick stop, barred until taken back"
)
@pytest.mark.parametrize("control_source", ["rig", "bus"])
def test_an_emergency_stop_brakes_the_motor_and_bars_the_drive_until_it_is_taken_back(
    wire, control_source
):
    node = wire.drive(1, control=control_source)
    wire.nmt(1)
    if control_source == "bus":
        control(wire, *WALK[ENABLED])
    assert state(wire) == ENABLED
    set_row(wire, "roller_speed", 40.0)
    node.device.emergency_stop(True)
    assert state(wire) == State.QUICK_STOP_ACTIVE
    wire.run(500)
    commands = node.device.axis.commands
    assert commands[axis.LOOP] == axis.LOOP_STOP
    # 40 rad/s less half a second of 60 rad/s2
    assert commands[axis.VELOCITY_rad_s] == pytest.approx(10.0, abs=0.2)
    wire.run(500)
    # the ramp has ended, the motor has not: it brakes on
    assert commands[axis.VELOCITY_rad_s] == 0.0
    assert commands[axis.ENABLED] == 1.0
    set_row(wire, "roller_speed", 0.0)
    wire.run(2)
    assert state(wire) == DISABLED
    assert commands[axis.ENABLED] == 0.0
    control(wire, SHUTDOWN, SWITCH_ON, ENABLE)
    node.device.control_from_rig() if control_source == "rig" else None
    assert state(wire) == DISABLED
    node.device.emergency_stop(False)
    assert state(wire) == (ENABLED if control_source == "rig" else DISABLED)
    if control_source == "bus":
        control(wire, *WALK[ENABLED])
        assert state(wire) == ENABLED


@pytest.mark.conformance("CiA 402", "default PDOs")
def test_default_pdos_carry_the_signals_and_take_set_points(wire, drive):
    set_row(wire, "roller_speed", 12.3456)
    set_row(wire, "roller_angle", 7.0)
    set_row(wire, "motor_torque", 0.25 * RATED_Nm)
    wire.take()
    wire.sync()
    frames = {one.can_id: one.data for one in wire.frames}
    assert frames[0x181] == status(wire).to_bytes(2, "little") + b"\x0a" + b"\xfa\0"
    assert frames[0x281] == (123_456).to_bytes(4, "little") + (7000).to_bytes(4, "little")
    wire.send(0x201, bytes([6, 0, 10, 100, 0]))
    wire.send(0x301, (77).to_bytes(4, "little"))
    wire.sync()
    assert state(wire) == READY
    assert wire.read(1, 0x6071) == b"\x64\0"
    assert wire.read(1, 0x60FF)[:1] == b"\x4d"


@pytest.mark.conformance("Masters", "canopen BaseNode402 walks a drive to OPERATION ENABLED")
def test_canopen_walks_a_drive_to_operation_enabled(wire, drive):
    remote = BaseNode402(1, drive.dictionary)
    wire.master.add_node(remote)
    wire.run(100)
    remote.setup_402_state_machine()
    for word, wanted in ((6, "READY TO SWITCH ON"), (7, "SWITCHED ON"), (15, "OPERATION ENABLED")):
        remote.controlword = word
        # canopen leaves a synchronous RPDO to a cyclic task of its user
        remote.rpdo[1].transmit()
        wire.sync()
        assert remote.state == wanted
    assert remote.is_op_mode_supported("PROFILED VELOCITY")
