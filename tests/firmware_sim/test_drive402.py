"""The roller drive: states, option codes, modes, control sources. Real frames over the hub."""

import pytest
from canopen.profiles.p402 import BaseNode402

from rollerrig.firmware_sim.drive402 import axis, objects, states
from rollerrig.firmware_sim.drive402.states import State
from rollerrig.wsp_interface import signals

RATED_Nm = objects.DEFAULTS["rated_torque_Nm"]
DISABLED = State.SWITCH_ON_DISABLED
READY = State.READY_TO_SWITCH_ON
ON = State.SWITCHED_ON
ENABLED = State.OPERATION_ENABLED

# controlwords
SHUTDOWN = 6
SWITCH_ON = 7
ENABLE = 15
DISABLE_VOLTAGE = 0
QUICK_STOP = 2
RESET = 0x80
HALT = 0x100 | ENABLE

# NMT commands
START = 1
RESET_NODE = 129

# modes of operation, 6060h
PROFILE_VELOCITY = 3
PROFILE_TORQUE = 4
CYCLIC_VELOCITY = 9
CYCLIC_TORQUE = 10

# the statusword of a drive that the rig control moves: OPERATION ENABLED, voltage, but not remote
MOVED_BY_RIG = 0x37

# the controlwords that lead from power-on to a state
WALK = {
    DISABLED: (),
    READY: (SHUTDOWN,),
    ON: (SHUTDOWN, SWITCH_ON),
    ENABLED: (SHUTDOWN, SWITCH_ON, ENABLE),
}


def status(wire, node=1):
    """Return the statusword of a drive."""
    return int.from_bytes(wire.read(node, 0x6041), "little")


# (mask, pattern) of the statusword in each state, from the standard
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
    """Return the state that the statusword shows. Exactly one pattern matches."""
    word = status(wire)
    matching = []
    for (mask, pattern), candidate in PATTERNS.items():
        if word & mask == pattern:
            matching.append(candidate)
    (shown,) = matching
    return shown


def control(wire, *words):
    """Write controlwords one after another."""
    for word in words:
        assert wire.write(1, 0x6040, 0, word, 2) == 0


@pytest.fixture
def drive(wire):
    """A drive that the bus controls, OPERATIONAL."""
    node = wire.drive(1, control="bus")
    wire.nmt(START)
    wire.run(1)
    return node


def set_signal(wire, name, value):
    """Set a signal of axle 1."""
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
def test_every_numbered_transition_is_once_in_the_table():
    automatic = {0, states.SELF_TEST_PASSED, 12, states.FAULT_DETECTED, states.REACTION_COMPLETED}
    numbers = [row.number for row in states.TRANSITIONS]
    assert len(numbers) == len(set(numbers))
    assert set(numbers) | automatic == set(range(17))


@pytest.mark.conformance("CiA 402", "statusword: state, voltage enabled, remote")
@pytest.mark.parametrize(
    ("words", "pattern", "mask"),
    [
        ((), 0x40, 0x4F),
        ((SHUTDOWN,), 0x21, 0x6F),
        ((SHUTDOWN, SWITCH_ON), 0x23, 0x6F),
        ((SHUTDOWN, SWITCH_ON, ENABLE), 0x27, 0x6F),
    ],
)
def test_the_statusword_shows_state_voltage_and_remote(wire, drive, words, pattern, mask):
    control(wire, *words)
    assert status(wire) & mask == pattern
    assert status(wire) & 0x210 == 0x210  # voltage enabled (bit 4), remote (bit 9)


@pytest.mark.conformance("CiA 402", "disable operation option code 605Ch")
def test_disable_operation_brakes_first_and_then_switches_off(wire, drive):
    control(wire, *WALK[ENABLED])
    set_signal(wire, "roller_speed", 10.0)
    control(wire, SWITCH_ON)
    control(wire, SWITCH_ON)  # a repetition changes nothing
    wire.run(100)
    assert state(wire) == ENABLED
    wire.run(500)
    assert state(wire) == ON

    # shutdown does not brake first
    control(wire, ENABLE)
    control(wire, SHUTDOWN)
    assert state(wire) == READY


@pytest.mark.conformance("CiA 402", "shutdown option code 605Bh")
@pytest.mark.parametrize(("option", "immediate"), [(0, True), (1, False)])
def test_shutdown_switches_off_immediately_or_brakes_first(wire, drive, option, immediate):
    wire.write(1, 0x605B, 0, option, 2)
    set_signal(wire, "roller_speed", 1.0)
    control(wire, *WALK[ENABLED], SHUTDOWN)
    wire.run(1)
    assert (state(wire) == READY) is immediate
    wire.run(1000)
    assert state(wire) == READY


@pytest.mark.conformance("CiA 402", "mode 9: target with offset 60B1h, follows command (bit 12)")
def test_cyclic_velocity_follows_the_target_and_its_offset_and_sets_bit_12(wire, drive):
    wire.write(1, 0x6060, 0, CYCLIC_VELOCITY, 1)
    control(wire, *WALK[ENABLED])
    wire.write(1, 0x60FF, 0, 30_000, 4)  # 3 rad/s
    wire.write(1, 0x60B1, 0, 5_000, 4)  # 0.5 rad/s
    wire.run(1)
    assert drive.device.axis.commands[axis.LOOP] == axis.LOOP_VELOCITY
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == pytest.approx(3.5)
    assert status(wire) & states.FOLLOWS
    control(wire, QUICK_STOP)
    assert status(wire) & states.FOLLOWS == 0


@pytest.mark.conformance("CiA 402", "transition 16 and a stop under way")
def test_enabling_again_cancels_a_stop_under_way(wire, drive):
    control(wire, *WALK[ENABLED])
    set_signal(wire, "roller_speed", 10.0)
    control(wire, SWITCH_ON)
    wire.run(50)
    control(wire, ENABLE)
    wire.run(1000)
    assert state(wire) == ENABLED


@pytest.mark.conformance("CiA 402", "quick stop option code 605Ah")
@pytest.mark.parametrize(
    ("option", "while_braking", "after_rest"),
    [
        (0, DISABLED, DISABLED),
        (1, State.QUICK_STOP_ACTIVE, DISABLED),
        (2, State.QUICK_STOP_ACTIVE, DISABLED),
        (3, State.QUICK_STOP_ACTIVE, DISABLED),
        (5, State.QUICK_STOP_ACTIVE, State.QUICK_STOP_ACTIVE),
        (6, State.QUICK_STOP_ACTIVE, State.QUICK_STOP_ACTIVE),
    ],
)
def test_quick_stop_follows_its_option_code(wire, drive, option, while_braking, after_rest):
    assert wire.write(1, 0x605A, 0, option, 2) == 0
    control(wire, *WALK[ENABLED])
    set_signal(wire, "roller_speed", 6.0)
    control(wire, QUICK_STOP)
    wire.run(1)
    assert state(wire) == while_braking
    wire.run(1000)
    assert state(wire) == after_rest
    if option >= 5:
        control(wire, ENABLE)
        assert state(wire) == ENABLED


@pytest.mark.conformance("CiA 402", "quick stop deceleration 6085h")
def test_the_quick_stop_ramp_is_that_of_6085h(wire, drive):
    control(wire, *WALK[ENABLED])
    set_signal(wire, "roller_speed", 6.0)
    wire.write(1, 0x6085, 0, 600_000, 4)  # 60 rad/s2
    control(wire, QUICK_STOP)
    wire.run(50)
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == pytest.approx(3.0)
    wire.run(50)
    assert state(wire) == DISABLED


@pytest.mark.conformance("CiA 402", "fault, 603Fh, EMCY, fault reset on the rising edge")
def test_a_fault_brakes_reports_and_is_reset_by_the_rising_edge_only(wire, drive):
    control(wire, *WALK[ENABLED])
    set_signal(wire, "roller_speed", 6.0)
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

    # bit 7 is still set: the second reset has no rising edge
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
    set_signal(wire, "roller_speed", 6.0)
    drive.device.trip(0x2310, "over-current")
    assert state(wire) == (State.FAULT_REACTION_ACTIVE if option else State.FAULT)


@pytest.mark.conformance("CiA 402", "DC link voltage 6079h and fault 3220h")
def test_too_low_a_dc_link_trips_and_trips_again_while_it_lasts(wire, drive):
    drive.device.axis.dc_link_V = 300.0
    wire.run(1)
    assert state(wire) == State.FAULT
    assert status(wire) & states.VOLTAGE_ENABLED == 0
    assert wire.read(1, 0x6079) == (300_000).to_bytes(4, "little")  # mV

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
    set_signal(wire, "motor_torque", 1.5 * RATED_Nm)
    warned_ms = None
    tripped_ms = None
    for at_ms in range(1500):
        wire.run(1)
        word = status(wire)
        if warned_ms is None and word & states.WARNING:
            warned_ms = at_ms
        if tripped_ms is None and word & 0x08:  # FAULT REACTION ACTIVE or FAULT
            tripped_ms = at_ms
    assert 500 < warned_ms < 700 < tripped_ms < 900
    assert wire.read(1, 0x603F) == b"\x10\x43"


@pytest.mark.conformance("CiA 402", "modes 3, 4, 9, 10: 6060h, 6061h, 6502h")
@pytest.mark.parametrize(
    ("mode", "code"),
    [
        (PROFILE_VELOCITY, 0),
        (PROFILE_TORQUE, 0),
        (CYCLIC_VELOCITY, 0),
        (CYCLIC_TORQUE, 0),
        # profile position, homing, cyclic position, manufacturer
        (1, 0x06090030),
        (6, 0x06090030),
        (8, 0x06090030),
        (-1, 0x06090030),
    ],
)
def test_only_supported_modes_are_accepted(wire, drive, mode, code):
    assert wire.write(1, 0x6060, 0, mode, 1) == code
    if not code:
        assert wire.read(1, 0x6061) == bytes([mode])


@pytest.mark.conformance("CiA 402", "mode 3: ramps, target reached")
def test_profile_velocity_ramps_to_the_target_and_reports_that_it_is_reached(wire, drive):
    wire.write(1, 0x6060, 0, PROFILE_VELOCITY, 1)
    wire.write(1, 0x6083, 0, 100_000, 4)  # 10 rad/s2
    wire.write(1, 0x60FF, 0, 50_000, 4)  # 5 rad/s
    control(wire, *WALK[ENABLED])
    wire.run(250)
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == pytest.approx(2.5)
    assert drive.device.axis.commands[axis.LOOP] == axis.LOOP_VELOCITY
    assert status(wire) & states.TARGET_REACHED == 0
    wire.run(300)
    set_signal(wire, "roller_speed", 5.0)
    wire.run(5)
    assert status(wire) & states.TARGET_REACHED == 0  # within the window time of 10 ms
    wire.run(15)
    assert status(wire) & states.TARGET_REACHED
    assert status(wire) & states.SPEED_ZERO == 0
    assert wire.read(1, 0x606B) == (50_000).to_bytes(4, "little")


def test_a_reversal_begins_with_the_deceleration(wire, drive):
    wire.write(1, 0x6060, 0, PROFILE_VELOCITY, 1)
    wire.write(1, 0x6083, 0, 100_000, 4)  # 10 rad/s2
    wire.write(1, 0x6084, 0, 200_000, 4)  # 20 rad/s2
    wire.write(1, 0x60FF, 0, 50_000, 4)
    control(wire, *WALK[ENABLED])
    wire.run(600)
    wire.write(1, 0x60FF, 0, -60_000 & 0xFFFFFFFF, 4)
    wire.run(100)
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == pytest.approx(3.0)


@pytest.mark.conformance("CiA 402", "repeated PDOs do not disturb a ramp")
def test_a_pdo_that_repeats_mode_and_controlword_does_not_disturb_the_ramp(wire, drive):
    wire.write(1, 0x60FF, 0, 500_000, 4)
    for word in WALK[ENABLED]:
        send_controlword(wire, word)
    for _ in range(100):
        send_controlword(wire, ENABLE)
    # 20 rad/s2 for 101 ms
    assert drive.device.axis.commands[axis.VELOCITY_rad_s] == pytest.approx(20.0 * 0.101)


def send_controlword(wire, word):
    """Send RPDO1 with a controlword, profile velocity and no torque; then a millisecond passes."""
    wire.send(0x201, bytes([word, 0, PROFILE_VELOCITY, 0, 0]))
    wire.sync()
    wire.run(1)


@pytest.mark.conformance("CiA 402", "halt bit and option code 605Dh")
def test_halt_ramps_the_velocity_to_zero_and_its_end_resumes_the_target(wire, drive):
    wire.write(1, 0x6060, 0, CYCLIC_VELOCITY, 1)
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
    wire.write(1, 0x6087, 0, 1000, 4)  # the rated torque in a second
    wire.write(1, 0x6071, 0, 500, 2)  # half the rated torque
    wire.write(1, 0x6060, 0, PROFILE_TORQUE, 1)
    control(wire, *WALK[ENABLED])
    wire.run(250)
    assert drive.device.axis.commands[axis.TORQUE_Nm] == pytest.approx(0.25 * RATED_Nm)
    assert status(wire) & states.TARGET_REACHED == 0
    wire.run(300)
    assert status(wire) & states.TARGET_REACHED

    wire.write(1, 0x6060, 0, CYCLIC_TORQUE, 1)
    wire.run(1)
    assert drive.device.axis.commands[axis.TORQUE_Nm] == pytest.approx(0.5 * RATED_Nm)


@pytest.mark.conformance("CiA 402", "max torque 6072h, internal limit (bit 11)")
def test_a_torque_above_6072h_is_limited_and_reported(wire, drive):
    wire.write(1, 0x6072, 0, 300, 2)
    wire.write(1, 0x6071, 0, -500, 2)
    control(wire, *WALK[ENABLED])
    wire.run(2)
    assert drive.device.axis.commands[axis.TORQUE_Nm] == pytest.approx(-0.3 * RATED_Nm)
    assert status(wire) & states.INTERNAL_LIMIT


@pytest.mark.conformance("CiA 402", "max slippage 60F8h (bit 13)")
def test_slippage_is_reported_when_the_speed_deviates_from_the_demand(wire, drive):
    wire.write(1, 0x60F8, 0, 1000, 4)  # 0.1 rad/s
    wire.write(1, 0x6060, 0, PROFILE_VELOCITY, 1)
    control(wire, *WALK[ENABLED])
    wire.run(2)
    assert status(wire) & states.SLIPPAGE == 0
    set_signal(wire, "roller_speed", 3.0)
    wire.run(2)
    assert status(wire) & states.SLIPPAGE


@pytest.mark.conformance("CiA 402", "abort connection option code 6007h")
@pytest.mark.parametrize(
    ("option", "after"), [(0, ENABLED), (1, State.FAULT), (2, DISABLED), (3, DISABLED)]
)
def test_the_reaction_to_a_lost_connection_follows_6007h(wire, drive, option, after):
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
    wire.nmt(RESET_NODE, 1)
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
        assert status(wire) == MOVED_BY_RIG
    wire.nmt(RESET_NODE, 1)
    assert status(wire) == MOVED_BY_RIG


@pytest.mark.conformance("CiA 402", "control source changes without a jump in torque")
def test_the_control_source_changes_while_running_without_a_jump_in_torque(wire):
    node = wire.drive(1)
    wire.nmt(START)
    set_signal(wire, "motor_torque", -0.2 * RATED_Nm)
    node.device.control_from_bus()
    for _ in range(20):
        wire.run(1)
        assert node.device.axis.commands[axis.TORQUE_Nm] == pytest.approx(-0.2 * RATED_Nm)
    assert status(wire) & 0x26F == 0x227  # OPERATION ENABLED, remote
    wire.write(1, 0x6071, 0, 0, 2)
    wire.run(1)
    assert node.device.axis.commands[axis.TORQUE_Nm] == 0.0

    node.device.control_from_rig()
    assert status(wire) == MOVED_BY_RIG
    assert node.device.axis.commands[axis.LOOP] == axis.LOOP_RIG


@pytest.mark.conformance(
    "CiA 402", "emergency stop from outside the bus: quick stop, blocked until reset"
)
@pytest.mark.parametrize("control_source", ["rig", "bus"])
def test_an_emergency_stop_brakes_the_motor_and_blocks_the_drive_until_it_is_reset(
    wire, control_source
):
    node = wire.drive(1, control=control_source)
    wire.nmt(START)
    if control_source == "bus":
        control(wire, *WALK[ENABLED])
    assert state(wire) == ENABLED
    set_signal(wire, "roller_speed", 40.0)

    node.device.emergency_stop(True)
    assert state(wire) == State.QUICK_STOP_ACTIVE
    wire.run(500)
    commands = node.device.axis.commands
    assert commands[axis.LOOP] == axis.LOOP_STOP
    # 40 rad/s less half a second of 60 rad/s2
    assert commands[axis.VELOCITY_rad_s] == pytest.approx(10.0, abs=0.2)
    wire.run(500)
    # the ramp has reached zero, but the motor has not: the drive continues to brake
    assert commands[axis.VELOCITY_rad_s] == 0.0
    assert commands[axis.ENABLED] == 1.0
    set_signal(wire, "roller_speed", 0.0)
    wire.run(2)
    assert state(wire) == DISABLED
    assert commands[axis.ENABLED] == 0.0

    # until the reset nothing enables the drive
    control(wire, *WALK[ENABLED])
    if control_source == "rig":
        node.device.control_from_rig()
    assert state(wire) == DISABLED

    node.device.emergency_stop(False)
    if control_source == "bus":
        # the master must enable the drive again
        assert state(wire) == DISABLED
        control(wire, *WALK[ENABLED])
    assert state(wire) == ENABLED


@pytest.mark.conformance("CiA 402", "default PDOs")
def test_default_pdos_carry_the_signals_and_take_set_points(wire, drive):
    set_signal(wire, "roller_speed", 12.3456)
    set_signal(wire, "roller_angle", 7.0)
    set_signal(wire, "motor_torque", 0.25 * RATED_Nm)
    wire.take()
    wire.sync()
    frames = {frame.can_id: frame.data for frame in wire.frames}
    assert frames[0x181] == status(wire).to_bytes(2, "little") + b"\x0a" + b"\xfa\0"
    assert frames[0x281] == (123_456).to_bytes(4, "little") + (7000).to_bytes(4, "little")

    wire.send(0x201, bytes([SHUTDOWN, 0, CYCLIC_TORQUE, 100, 0]))
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
    for word, expected in (
        (SHUTDOWN, "READY TO SWITCH ON"),
        (SWITCH_ON, "SWITCHED ON"),
        (ENABLE, "OPERATION ENABLED"),
    ):
        remote.controlword = word
        # canopen does not send a synchronous RPDO itself
        remote.rpdo[1].transmit()
        wire.sync()
        assert remote.state == expected
    assert remote.is_op_mode_supported("PROFILED VELOCITY")
