"""PDOs, SYNC and emergency messages: real frames over the hub."""

import canopen
import pytest

from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code

START = 1  # NMT command
# identifiers of the axle speed unit, node 16
TPDO = 0x190
EMCY = 0x90

OFF = 1 << 31  # flags of a COB-ID
NO_REMOTE_REQUEST = 1 << 30


@pytest.fixture
def unit(wire):
    """The axle speed unit, OPERATIONAL."""
    node = wire.encoder()
    wire.nmt(START)
    wire.take()
    return node


def configure(wire, sub, value, size, node=16, pdo=0x1800):
    """Switch a PDO off, change a communication parameter, and switch the PDO on."""
    cob_id = int.from_bytes(wire.read(node, pdo, 1), "little")
    assert wire.write(node, pdo, 1, cob_id | OFF, 4) == 0
    assert wire.write(node, pdo, sub, value, size) == 0
    assert wire.write(node, pdo, 1, cob_id & ~OFF, 4) == 0
    wire.take()


def set_speed(wire, speed):
    """Set the measured speed of axle 1 in rad/s. The TPDO carries it in 0.01 rad/s."""
    wire.row[signals.column("measured_speed", 1)] = speed


def first_word(data):
    """Return the speed of axle 1 in the data of a TPDO."""
    return int.from_bytes(data[:2], "little")


@pytest.mark.conformance("CiA 301", "TPDO types 1 to 240")
@pytest.mark.parametrize("every", [1, 2, 5, 240])
def test_a_cyclic_tpdo_goes_out_with_every_nth_sync(wire, unit, every):
    configure(wire, 2, every, 1)
    for _ in range(3 * every):
        wire.sync()
    assert len(wire.take(TPDO)) == 3


@pytest.mark.conformance("CiA 301", "TPDO is sampled at the SYNC")
def test_a_tpdo_carries_the_values_at_the_sync(wire, unit):
    for speed in (1.0, 2.0, 3.0):
        set_speed(wire, speed)
        wire.sync()
    assert [first_word(data) for data in wire.take(TPDO)] == [100, 200, 300]


@pytest.mark.conformance("CiA 301", "TPDO type 0")
def test_an_acyclic_synchronous_tpdo_goes_out_with_the_sync_after_a_change(wire, unit):
    configure(wire, 2, 0, 1)
    wire.sync()
    wire.take()
    set_speed(wire, 5.0)
    wire.run(5)
    assert wire.take(TPDO) == []
    for _ in range(3):
        wire.sync()
    assert [first_word(data) for data in wire.take(TPDO)] == [500]


@pytest.mark.conformance("CiA 301", "TPDO types 254 and 255, inhibit time")
@pytest.mark.parametrize("kind", [254, 255])
def test_an_event_driven_tpdo_goes_out_on_a_change_not_more_often_than_inhibited(wire, unit, kind):
    configure(wire, 3, 100, 2)  # inhibit time 10 ms
    configure(wire, 2, kind, 1)
    wire.run(20)
    assert len(wire.take(TPDO)) == 1

    # a change each millisecond for 30 ms
    for speed in range(1, 31):
        set_speed(wire, float(speed))
        wire.run(1)
    assert len(wire.take(TPDO)) == 3
    wire.run(20)
    assert [first_word(data) for data in wire.take(TPDO)] == [3000]


@pytest.mark.conformance("CiA 301", "TPDO event timer")
def test_the_event_timer_sends_without_a_change(wire, unit):
    configure(wire, 5, 20, 2)
    configure(wire, 2, 254, 1)
    wire.run(101)
    assert len(wire.take(TPDO)) == 6


@pytest.mark.conformance("CiA 406", "cyclic timer 6200h is the event timer")
def test_the_cyclic_timer_of_the_encoder_is_the_event_timer(wire, unit):
    assert wire.write(16, 0x6200, 0, 25, 2) == 0
    assert wire.read(16, 0x1800, 5) == wire.read(16, 0x6200) == b"\x19\0"


@pytest.mark.conformance("CiA 301", "TPDO types 252 and 253, RTR")
@pytest.mark.parametrize(("kind", "sent"), [(252, 200), (253, 300)])
def test_a_tpdo_on_request_is_sampled_at_the_sync_or_at_the_request(wire, unit, kind, sent):
    configure(wire, 2, kind, 1)
    set_speed(wire, 2.0)
    wire.sync()
    set_speed(wire, 3.0)
    wire.take()
    wire.send(TPDO, remote=True, dlc=8)
    assert [first_word(data) for data in wire.take(TPDO) if data] == [sent]


@pytest.mark.conformance("CiA 301", "TPDO COB-ID bit 30: no RTR")
def test_a_remote_request_is_not_answered_where_bit_30_forbids_it(wire, unit):
    assert wire.write(16, 0x1800, 1, TPDO | NO_REMOTE_REQUEST, 4) == 0
    wire.take()
    wire.send(TPDO, remote=True, dlc=8)
    assert [data for data in wire.take(TPDO) if data] == []


@pytest.mark.conformance("CiA 301", "SYNC start value")
def test_a_tpdo_with_a_sync_start_value_waits_for_that_count(wire, unit):
    assert wire.write(16, 0x1019, 0, 10, 1) == 0  # SYNC has a counter
    configure(wire, 6, 3, 1)  # start value 3
    configure(wire, 2, 2, 1)  # every second SYNC
    sent = []
    for count in (1, 2, 3, 4, 5, 6, 7):
        wire.sync(count)
        sent.append(len(wire.take(TPDO)))
    assert sent == [0, 0, 1, 0, 1, 0, 1]


@pytest.mark.conformance("CiA 301", "SYNC counter 1019h, EMCY 8240h")
def test_a_sync_of_the_wrong_length_is_reported_once_and_obeyed(wire, unit):
    wire.sync(1)
    wire.sync(2)
    emergencies = [frame.data for frame in wire.frames if frame.can_id == EMCY]
    assert [data[:2] for data in emergencies] == [b"\x40\x82"]
    assert len(wire.take(TPDO)) == 2


@pytest.mark.conformance("CiA 301", "SYNC COB-ID 1005h")
def test_the_node_listens_to_the_sync_identifier_of_1005h(wire, unit):
    assert wire.write(16, 0x1005, 0, 0x7A, 4) == 0x06090030
    assert wire.write(16, 0x1005, 0, 0xA0, 4) == 0
    wire.take()
    wire.sync()
    assert wire.take(TPDO) == []
    wire.send(0xA0)
    assert len(wire.take(TPDO)) == 1


@pytest.mark.conformance("CiA 301", "PDO with 29-bit identifier")
def test_a_pdo_may_have_an_identifier_of_29_bits(wire, unit):
    cob_id = 0x12345678 | 1 << 29
    # the identifier changes while the PDO is off
    assert wire.write(16, 0x1800, 1, cob_id | OFF, 4) == 0
    assert wire.write(16, 0x1800, 1, cob_id, 4) == 0
    wire.take()
    wire.sync()
    long_ones = [(frame.can_id, frame.extended) for frame in wire.frames if frame.can_id > 0x7FF]
    assert long_ones == [(0x12345678, True)]


@pytest.mark.conformance("CiA 301", "PDO remapping by SDO")
def test_a_master_remaps_a_tpdo_and_decodes_it(wire, unit):
    remote = canopen.RemoteNode(16, unit.dictionary)
    wire.master.add_node(remote)
    remote.tpdo.read()
    pdo = remote.tpdo[4]
    pdo.clear()
    pdo.add_variable(0x2102, 1)
    pdo.add_variable(0x6030, 2)
    pdo.trans_type = 1
    pdo.enabled = True
    pdo.save()
    set_speed(wire, 1.23456)
    wire.sync()
    assert pdo[0].raw == 12346
    assert [data for data in wire.take(0x490) if len(data) == 6]


def unmap(wire, node=16, pdo=0x1800):
    """Switch a PDO off, and then its mapping."""
    cob_id = int.from_bytes(wire.read(node, pdo, 1), "little")
    wire.write(node, pdo, 1, cob_id | OFF, 4)
    assert wire.write(node, pdo + 0x200, 0, 0, 1) == 0


@pytest.mark.conformance(
    "CiA 301", "PDO mapping: 06020000, 06040041 for what cannot be transmitted"
)
@pytest.mark.parametrize(
    ("entry", "code"),
    [
        # no object, no sub-index
        (0x30000020, 0x06020000),
        (0x60300910, 0x06020000),
        # not mappable, wrong length, not mappable
        (0x10000020, 0x06040041),
        (0x60300120, 0x06040041),
        (0x60030020, 0x06040041),
        (0x60300110, 0),
    ],
)
def test_only_an_object_that_can_be_transmitted_is_mapped(wire, unit, entry, code):
    unmap(wire)
    assert wire.write(16, 0x1A00, 1, entry, 4) == code


@pytest.mark.conformance("CiA 301", "PDO mapping: what can be received")
@pytest.mark.parametrize(
    ("entry", "code"),
    [
        # the statusword is read only, the controlword is not
        (0x60410010, 0x06040041),
        (0x60400010, 0),
        # a filler of a byte, but none of a bit
        (0x00050008, 0),
        (0x00010001, 0x06020000),
    ],
)
def test_only_a_writable_object_or_a_filler_is_mapped_for_reception(wire, entry, code):
    wire.drive(1)
    unmap(wire, 1, 0x1400)
    assert wire.write(1, 0x1600, 1, entry, 4) == code


@pytest.mark.conformance("CiA 301", "PDO mapping: 06040042 above eight bytes")
def test_more_than_eight_bytes_are_refused_when_the_mapping_is_switched_on(wire, unit):
    unmap(wire)
    for sub in (1, 2, 3):
        assert wire.write(16, 0x1A00, sub, 0x21020020 | sub << 8, 4) == 0
    # three objects of four bytes; nine objects
    assert wire.write(16, 0x1A00, 0, 3, 1) == 0x06040042
    assert wire.write(16, 0x1A00, 0, 9, 1) == 0x06040042
    assert wire.write(16, 0x1A00, 0, 2, 1) == 0


@pytest.mark.conformance("CiA 301", "PDO parameters are fixed while the PDO exists")
def test_a_change_of_a_fixed_parameter_is_refused_while_the_pdo_exists(wire, unit):
    assert wire.write(16, 0x1800, 1, 0x191, 4) == 0x08000022
    assert wire.write(16, 0x1800, 3, 5, 2) == 0x08000022
    assert wire.write(16, 0x1800, 6, 5, 1) == 0x08000022
    assert wire.write(16, 0x1A00, 1, 0x60300110, 4) == 0x08000022


@pytest.mark.conformance("CiA 301", "PDO: restricted COB-IDs are refused")
@pytest.mark.parametrize("cob_id", [0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x601, 0x701, 0x7E5])
def test_an_identifier_of_a_fixed_service_is_refused(wire, unit, cob_id):
    wire.write(16, 0x1800, 1, TPDO | OFF, 4)
    assert wire.write(16, 0x1800, 1, cob_id, 4) == 0x06090030


@pytest.mark.conformance("CiA 301", "RPDO synchronous")
def test_a_synchronous_rpdo_takes_effect_with_the_next_sync(wire):
    wire.drive(1)
    wire.nmt(START)
    wire.send(0x201, b"\x06\0\x03\x10\0")
    assert wire.read(1, 0x6060) == b"\x0a"
    wire.sync()
    assert wire.read(1, 0x6060) == b"\x03"
    assert wire.read(1, 0x6071) == b"\x10\0"


@pytest.mark.conformance("CiA 301", "synchronous window length, 1007h")
def test_a_synchronous_rpdo_after_the_window_is_ignored(wire):
    wire.drive(1)
    wire.nmt(START)
    assert wire.write(1, 0x1007, 0, 3000, 4) == 0  # 3 ms

    # before the first SYNC there is no window
    wire.send(0x201, b"\x06\0\x0a\x10\0")
    wire.sync()
    assert wire.read(1, 0x6071) == b"\x10\0"

    # at the end of the window
    wire.run(3)
    wire.send(0x201, b"\x06\0\x0a\x20\0")
    wire.sync()
    assert wire.read(1, 0x6071) == b"\x20\0"

    # after the window
    wire.run(4)
    wire.send(0x201, b"\x06\0\x0a\x30\0")
    wire.sync()
    assert wire.read(1, 0x6071) == b"\x20\0"

    # without a window
    assert wire.write(1, 0x1007, 0, 0, 4) == 0
    wire.run(4)
    wire.send(0x201, b"\x06\0\x0a\x30\0")
    wire.sync()
    assert wire.read(1, 0x6071) == b"\x30\0"


@pytest.mark.conformance(
    "CiA 301", "communication cycle period, 1006h: EMCY 8100h when SYNC is missing"
)
def test_a_sync_that_is_half_a_cycle_late_is_reported_until_it_is_back(wire, unit):
    assert wire.write(16, 0x1006, 0, 10_000, 4) == 0  # 10 ms

    # before the first SYNC none is late
    wire.run(100)
    assert wire.take(EMCY) == []

    wire.sync()
    wire.run(14)
    wire.sync()
    wire.run(15)
    (emergency,) = wire.take(EMCY)
    assert emergency[:3] == b"\x00\x81\x11"
    wire.run(100)
    assert wire.take(EMCY) == []

    # the end of the error
    wire.sync()
    assert wire.take(EMCY) == [bytes([0, 0, 0, 0, 0x81, 0, 0, 0])]
    assert wire.read(16, 0x1001) == b"\0"

    # without a period none is late
    assert wire.write(16, 0x1006, 0, 0, 4) == 0
    wire.run(100)
    assert wire.take(EMCY) == []


@pytest.mark.conformance("CiA 301", "RPDO types 254 and 255: take effect immediately")
@pytest.mark.conformance("CiA 301", "RPDO dummy mapping")
def test_fillers_of_an_rpdo_are_skipped(wire):
    wire.drive(1)
    wire.nmt(START)
    unmap(wire, 1, 0x1400)
    wire.write(1, 0x1600, 1, 0x00060010, 4)  # a filler of two bytes
    wire.write(1, 0x1600, 2, 0x60710010, 4)
    wire.write(1, 0x1600, 0, 2, 1)
    wire.write(1, 0x1400, 2, 255, 1)  # event-driven
    wire.write(1, 0x1400, 1, 0x201, 4)
    wire.send(0x201, b"\xff\xff\x22\x00")
    assert wire.read(1, 0x6071) == b"\x22\0"


@pytest.mark.conformance("CiA 301", "RPDO too short: EMCY 8210h")
def test_a_short_rpdo_is_reported_and_ignored_and_the_next_good_one_ends_the_error(wire):
    wire.brake()
    wire.nmt(START)
    wire.take()
    # twice too short, one report
    wire.send(0x211, b"")
    wire.send(0x211, b"")
    assert wire.take(0x91) == [b"\x10\x82\x11\x01\x00\x01\0\0"]
    assert wire.read(17, 0x1001) == b"\x11"
    assert wire.read(17, 0x1003, 0) == b"\x01"
    assert wire.read(17, 0x1003, 1)[:2] == b"\x10\x82"
    assert wire.read(17, 0x6200, 1) == b"\0"
    wire.take()

    wire.send(0x211, b"\x03")
    assert wire.take(0x91) == [b"\0\0\0\x10\x82\0\0\0"]
    assert wire.read(17, 0x1001) == b"\0"
    assert wire.read(17, 0x6200, 1) == b"\x03"
    assert len(wire.reported(Code.PDO_TOO_SHORT, pdo=1)) == 1


@pytest.mark.conformance("CiA 301", "RPDO too long is used as far as mapped")
def test_a_longer_rpdo_is_used_as_far_as_it_is_mapped(wire):
    wire.brake()
    wire.nmt(START)
    wire.send(0x211, b"\x0c\xff\xff")
    assert wire.read(17, 0x6200, 1) == b"\x0c"


@pytest.mark.conformance("CiA 301", "RPDO event timer: EMCY 8250h")
def test_a_late_rpdo_is_reported(wire):
    wire.brake()
    wire.write(17, 0x1400, 5, 30, 2)  # a message at least every 30 ms
    wire.nmt(START)
    wire.send(0x211, b"\0")
    wire.take()
    wire.run(40)
    assert wire.take(0x91)[0][:2] == b"\x50\x82"


@pytest.mark.conformance("CiA 301", "EMCY history 1003h and error register 1001h")
def test_the_error_history_is_cleared_by_writing_zero(wire):
    wire.brake()
    wire.nmt(START)
    wire.send(0x211, b"")
    assert wire.write(17, 0x1003, 0, 0, 1) == 0
    assert wire.read(17, 0x1003, 0) == b"\0"


@pytest.mark.conformance("CiA 301", "EMCY inhibit time 1015h")
def test_emergencies_keep_their_inhibit_time_and_none_is_lost(wire):
    node = wire.encoder()
    # 20 ms; the time can change while the message is off
    wire.write(16, 0x1014, 0, EMCY | OFF, 4)
    assert wire.write(16, 0x1015, 0, 200, 2) == 0
    wire.write(16, 0x1014, 0, EMCY, 4)
    wire.take()
    for code in (0x1000, 0x2000, 0x3000):
        node.emergency.report(code)
    assert [data[:2] for data in wire.take(EMCY)] == [b"\x00\x10"]
    wire.run(19)
    assert wire.take(EMCY) == []
    wire.run(1)
    assert [data[:2] for data in wire.take(EMCY)] == [b"\x00\x20"]
    wire.run(20)
    assert [data[:2] for data in wire.take(EMCY)] == [b"\x00\x30"]


@pytest.mark.conformance("CiA 301", "EMCY COB-ID 1014h")
def test_no_emergency_is_sent_where_1014h_is_not_valid(wire):
    node = wire.encoder()
    wire.write(16, 0x1014, 0, EMCY | OFF, 4)
    wire.take()
    node.emergency.report(0x1000)
    assert wire.take(EMCY) == []
    assert wire.read(16, 0x1001) == b"\x01"
