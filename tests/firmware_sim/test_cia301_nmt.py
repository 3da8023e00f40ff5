"""Network management, boot-up, heartbeats, guarding: real frames over the hub."""

import pytest

# NMT states, as in a heartbeat
PRE_OPERATIONAL = 127
OPERATIONAL = 5
STOPPED = 4
# NMT commands
START = 1
STOP = 2
ENTER_PRE = 128
RESET_NODE = 129
RESET_COMMUNICATION = 130

HEARTBEAT_LOST = b"\x30\x81"  # error code 8130h of an EMCY, little-endian


def heartbeat_state(wire, node):
    """Return the state that the next heartbeat of a node reports."""
    wire.take()
    wire.run(100)
    return wire.take(0x700 + node)[-1][0]


@pytest.mark.conformance("CiA 301", "NMT boot-up")
def test_a_node_sends_its_boot_up_and_is_pre_operational_after_power_on(wire):
    wire.encoder()
    assert wire.take(0x710) == [b"\0"]
    assert heartbeat_state(wire, 16) == PRE_OPERATIONAL


@pytest.mark.conformance("CiA 301", "NMT commands to a node and to all")
@pytest.mark.parametrize(
    ("command", "state"), [(START, OPERATIONAL), (STOP, STOPPED), (ENTER_PRE, PRE_OPERATIONAL)]
)
@pytest.mark.parametrize("addressed", [0, 16])
def test_an_nmt_command_to_all_or_to_the_node_changes_its_state(wire, command, state, addressed):
    wire.encoder()
    wire.nmt(START)
    wire.nmt(command, addressed)
    assert heartbeat_state(wire, 16) == state


@pytest.mark.conformance("CiA 301", "NMT: malformed messages change nothing")
@pytest.mark.parametrize("frame", [b"\x01", b"\x01\x10\x00", b"", b"\x01\x11", b"\x07\x10"])
def test_an_nmt_message_that_is_malformed_or_for_another_changes_nothing(wire, frame):
    wire.encoder()
    wire.send(0, frame)
    assert heartbeat_state(wire, 16) == PRE_OPERATIONAL


@pytest.mark.conformance("CiA 301", "NMT reset node restores power-on values")
@pytest.mark.parametrize("before", [START, STOP, ENTER_PRE])
def test_reset_node_restores_power_on_values_and_boots_from_every_state(wire, before):
    wire.brake()
    assert wire.write(17, 0x6207, 1, 0x55, 1) == 0
    assert wire.write(17, 0x1017, 0, 30, 2) == 0
    wire.nmt(before, 17)
    wire.take()
    wire.nmt(RESET_NODE, 17)
    assert wire.take(0x711) == [b"\0"]
    assert wire.read(17, 0x6207, 1) == b"\0"
    assert wire.read(17, 0x1017) == b"\x64\0"
    assert heartbeat_state(wire, 17) == PRE_OPERATIONAL


@pytest.mark.conformance("CiA 301", "NMT reset communication restores the communication profile")
def test_reset_communication_restores_the_communication_profile_only(wire):
    wire.brake()
    wire.write(17, 0x6207, 1, 0x55, 1)
    wire.write(17, 0x1017, 0, 30, 2)
    wire.take()
    wire.nmt(RESET_COMMUNICATION, 17)
    assert wire.take(0x711) == [b"\0"]
    assert wire.read(17, 0x6207, 1) == b"\x55"
    assert wire.read(17, 0x1017) == b"\x64\0"


@pytest.mark.conformance("CiA 301", "heartbeat producer, 1017h")
def test_the_heartbeat_has_the_period_of_1017h_and_stops_at_zero(wire):
    wire.encoder()
    wire.write(16, 0x1017, 0, 20, 2)
    wire.take()
    wire.run(200)
    assert len(wire.take(0x710)) == 10
    wire.write(16, 0x1017, 0, 0, 2)
    wire.run(200)
    assert wire.take(0x710) == []


@pytest.mark.conformance("CiA 301", "SDO is silent in STOPPED")
def test_sdo_is_silent_in_stopped_and_answers_again_afterwards(wire):
    wire.encoder()
    wire.nmt(STOP, 16)
    assert wire.request(16, b"\x40\x00\x10\x00") == []
    wire.nmt(START, 16)
    assert wire.read(16, 0x1000) == b"\x96\x01\x0a\x00"


@pytest.mark.conformance("CiA 301", "PDO only in OPERATIONAL")
def test_pdos_exist_only_in_operational(wire):
    wire.encoder()
    pdos = []
    for command in (ENTER_PRE, START, STOP, START, ENTER_PRE):
        wire.nmt(command, 16)
        wire.take()
        wire.sync()
        pdos.append(len(wire.take(0x190)))
    assert pdos == [0, 1, 0, 1, 0]


@pytest.mark.conformance("CiA 301", "heartbeat consumer, 1016h")
def test_a_partner_is_watched_from_its_first_heartbeat_and_its_loss_is_reported(wire):
    node = wire.encoder()
    assert wire.write(16, 0x1016, 1, 5 << 16 | 50, 4) == 0
    reports = []
    node.on_partner.append(lambda partner, alive: reports.append((partner, alive)))

    # nothing is lost before the first heartbeat
    wire.run(200)
    assert reports == []

    wire.send(0x705, b"\x05")
    wire.take()
    wire.run(49)
    assert wire.take(0x90) == []
    wire.run(1)
    (emergency,) = wire.take(0x90)
    # error code, error register, lost node
    assert emergency[:4] == HEARTBEAT_LOST + b"\x11\x05"
    wire.run(200)
    assert wire.take(0x90) == []

    # the end of the error
    wire.send(0x705, b"\x05")
    assert wire.take(0x90) == [b"\0\0\0" + HEARTBEAT_LOST + b"\0\0\0"]
    assert reports == [(5, False), (5, True)]


@pytest.mark.conformance("CiA 301", "1016h: one partner twice is refused (06040043)")
def test_watching_one_partner_twice_is_refused(wire):
    wire.encoder()
    assert wire.write(16, 0x1016, 1, 5 << 16 | 50, 4) == 0
    assert wire.write(16, 0x1016, 2, 5 << 16 | 70, 4) == 0x06040043
    assert wire.write(16, 0x1016, 2, 200 << 16 | 70, 4) == 0x06090030


@pytest.mark.conformance("CiA 301", "error behaviour, 1029h")
@pytest.mark.parametrize(
    ("behaviour", "state"), [(0, PRE_OPERATIONAL), (1, OPERATIONAL), (2, STOPPED)]
)
def test_1029h_decides_what_a_lost_heartbeat_does_to_the_state(wire, behaviour, state):
    wire.encoder()
    wire.write(16, 0x1016, 1, 5 << 16 | 50, 4)
    wire.write(16, 0x1029, 1, behaviour, 1)
    wire.nmt(START, 16)
    wire.send(0x705, b"\x05")
    wire.run(60)
    assert heartbeat_state(wire, 16) == state


@pytest.mark.conformance("CiA 301", "node guarding, 100Ch and 100Dh")
def test_node_guarding_answers_with_a_toggle_bit_when_no_heartbeat_is_produced(wire):
    wire.encoder()
    # no answer while the node produces heartbeats; [1:] is the request itself
    wire.send(0x710, remote=True, dlc=1)
    assert wire.take(0x710)[1:] == [b""]

    wire.write(16, 0x1017, 0, 0, 2)
    wire.write(16, 0x100C, 0, 50, 2)  # guard time in ms
    wire.write(16, 0x100D, 0, 2, 1)  # life time factor
    answers = []
    for _ in range(3):
        wire.take()
        wire.send(0x710, remote=True, dlc=1)
        answers.append(wire.take(0x710)[-1][0])
    assert answers == [0x7F, 0xFF, 0x7F]

    # 100 ms without a request
    wire.run(101)
    assert wire.take(0x90)[0][:2] == HEARTBEAT_LOST


@pytest.mark.conformance("CiA 301", "TIME consumer, 1012h")
def test_a_time_message_is_taken_over_only_while_the_node_consumes_it(wire):
    node = wire.encoder()
    wire.send(0x100, b"\x01\x00\x00\x00\x02")  # a byte too short
    assert node.time_of_day is None

    wire.send(0x100, (12_345).to_bytes(4, "little") + (7).to_bytes(2, "little"))
    assert node.time_of_day == (7, 12_345)

    wire.write(16, 0x1012, 0, 0x100, 4)  # without bit 31: does not consume
    wire.send(0x100, bytes(6))
    assert node.time_of_day == (7, 12_345)
