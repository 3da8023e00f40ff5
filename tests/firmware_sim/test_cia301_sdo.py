"""SDO server: the client of canopen over the hub, and raw requests that no client sends."""

import can
import canopen
import pytest

from rollerrig.firmware_sim.cia301 import communication, dictionary
from rollerrig.firmware_sim.cia301.dictionary import Identity, Row
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.wsp_interface.bus.sdo_client import SdoClient

NODE = 9
IDENTITY = Identity(
    vendor="maker",
    product="device",
    vendor_id=1,
    product_code=2,
    revision=3,
    serial=4,
)
# codes of several tests
TOGGLE_BIT = 0x05030000
UNKNOWN_COMMAND = 0x05040001
LENGTH_MISMATCH = 0x06070010
ROWS = [
    Row(0x2000, 0, "Text", "TEXT", "rw", "a text that needs several segments"),
    Row(0x2001, 0, "Data", "DOMAIN", "rw", b""),
    Row(0x2002, 0, "Bounded", "I16", "rw", 0, low=-100, high=100),
    Row(0x2003, 0, "Write only", "U8", "wo", 0),
    Row(0x2004, 0, "Long", "U64", "rw", 0x1122334455667788),
    Row(0x2005, 0, "Flag", "BOOL", "rw", False),
    Row(0x2006, 0, "Real", "F32", "rw", 1.5),
]


@pytest.fixture
def remote(wire):
    """The client's side of a node that has ROWS."""
    rows = communication.rows(communication.Profile(0, "device"), IDENTITY) + ROWS
    node = wire.plug(Node(dictionary.build(rows, NODE, IDENTITY)))
    client = canopen.RemoteNode(NODE, node.dictionary)
    wire.master.add_node(client)
    return client


@pytest.mark.conformance("CiA 301", "SDO expedited and segmented, both directions")
def test_short_values_travel_expedited_and_long_ones_in_segments(remote):
    assert remote.sdo[0x1018][1].raw == 1
    assert remote.sdo[0x2000].raw == "a text that needs several segments"
    assert remote.sdo[0x2004].raw == 0x1122334455667788
    assert remote.sdo[0x2006].raw == 1.5


@pytest.mark.conformance("CiA 301", "SDO block transfer, both directions, with CRC")
@pytest.mark.parametrize("length", [0, 1, 3, 4, 5, 7, 8, 14, 15, 100, 889, 890, 5000])
@pytest.mark.parametrize("block", [False, True])
def test_data_of_any_length_comes_back_as_it_was_written(remote, length, block):
    data = bytes(at * 7 & 0xFF for at in range(length))
    if length == 0:
        # canopen's client cannot write an empty value; raw requests can
        remote.sdo[0x2001].raw = b"x"
        remote.sdo.send_request(bytes.fromhex("2101200000000000"))
        remote.sdo.read_response()
        remote.sdo.send_request(bytes.fromhex("0f00000000000000"))
        remote.sdo.read_response()
    else:
        with remote.sdo.open(0x2001, 0, "wb", size=length, block_transfer=block) as file:
            file.write(data)
    with remote.sdo.open(0x2001, 0, "rb", block_transfer=block) as file:
        assert file.read() == data


@pytest.mark.conformance(
    "CiA 301",
    "SDO download abort codes 06020000, 06090011, 06010001/2, "
    "06070010/12/13, 06090030..32, 08000022",
)
@pytest.mark.parametrize(
    ("index", "sub", "value", "size", "code"),
    [
        # no object, no sub-index
        (0x3000, 0, 0, 1, 0x06020000),
        (0x1000, 1, 0, 4, 0x06090011),
        (0x1018, 9, 0, 4, 0x06090011),
        # read only
        (0x1000, 0, 0, 4, 0x06010002),
        (0x1018, 1, 0, 4, 0x06010002),
        # too long, too short, too high, too low
        (0x2002, 0, 0, 4, 0x06070012),
        (0x2002, 0, 0, 1, 0x06070013),
        (0x2002, 0, 101, 2, 0x06090031),
        (0x2002, 0, -101, 2, 0x06090032),
        # a SYNC producer; another EMCY identifier while the message exists; a restricted one
        (0x1005, 0, 0x40000080, 4, 0x06090030),
        (0x1014, 0, 0x181, 4, 0x08000022),
        (0x1014, 0, 0x601, 4, 0x06090030),
        # a reserved transmission type, a wrong signature, a history of errors
        (0x1400, 2, 245, 1, 0x06090030),
        (0x1010, 1, 0x12345678, 4, 0x08000020),
        (0x1003, 0, 3, 1, 0x06090030),
        # the overflow value of the SYNC counter
        (0x1019, 0, 241, 1, 0x06090031),
        (0x1019, 0, 1, 1, 0x06090030),
        # the bounds themselves are allowed
        (0x2002, 0, 100, 2, 0),
        (0x2002, 0, -100, 2, 0),
    ],
)
def test_a_download_gets_the_abort_code_of_the_standard(
    wire, remote, index, sub, value, size, code
):
    assert wire.write(NODE, index, sub, value, size) == code


@pytest.mark.conformance("CiA 301", "SDO upload abort codes")
@pytest.mark.parametrize(
    ("index", "sub", "code"),
    [
        (0x3000, 0, 0x06020000),
        (0x1000, 1, 0x06090011),
        (0x1018, 5, 0x06090011),
        (0x2003, 0, 0x06010001),
    ],
)
def test_an_upload_gets_the_abort_code_of_the_standard(wire, remote, index, sub, code):
    assert wire.read(NODE, index, sub) == code


@pytest.mark.conformance("CiA 301", "SDO: a refused download changes nothing")
def test_a_refused_download_changes_nothing(wire, remote):
    wire.write(NODE, 0x2002, 0, 42, 2)
    for value, size in ((101, 2), (7, 1), (7, 4)):
        assert wire.write(NODE, 0x2002, 0, value, size) != 0
    assert wire.read(NODE, 0x2002) == b"\x2a\0"


@pytest.mark.conformance("CiA 301", "SDO toggle bit: 05030000")
def test_a_wrong_toggle_bit_aborts_the_transfer_in_both_directions(wire, remote):
    # an upload; after the abort there is no transfer
    wire.request(NODE, bytes.fromhex("4000200000000000"))
    assert wire.abort_of(NODE, b"\x70") == TOGGLE_BIT
    assert wire.abort_of(NODE, b"\x60") == UNKNOWN_COMMAND
    # a download
    wire.request(NODE, bytes.fromhex("2101200010000000"))
    assert wire.abort_of(NODE, b"\x10") == TOGGLE_BIT
    assert wire.abort_of(NODE, b"\x00") == UNKNOWN_COMMAND


@pytest.mark.conformance("CiA 301", "SDO unknown command: 05040001")
@pytest.mark.parametrize("head", [0xE0, 0xFF, 0x00, 0x60, 0xC1, 0xA1, 0xA2, 0xA3])
def test_a_command_that_is_unknown_or_out_of_place_is_aborted(wire, remote, head):
    assert wire.abort_of(NODE, [head]) == UNKNOWN_COMMAND


@pytest.mark.conformance("CiA 301", "SDO request of other than eight bytes: silence")
@pytest.mark.parametrize("length", range(8))
def test_a_request_without_eight_bytes_gets_no_answer(wire, remote, length):
    wire.take()
    wire.send(0x600 + NODE, bytes.fromhex("4000100000000000")[:length])
    assert wire.take(0x580 + NODE) == []


@pytest.mark.conformance("CiA 301", "SDO time-out: 05040000")
def test_a_client_that_falls_silent_gets_a_time_out(wire, remote):
    wire.request(NODE, bytes.fromhex("4000200000000000"))
    wire.run(999)
    assert wire.take(0x580 + NODE) == []
    wire.run(1)
    assert wire.take(0x580 + NODE) == [bytes.fromhex("8000200000000405")]
    assert wire.abort_of(NODE, b"\x60") == UNKNOWN_COMMAND


@pytest.mark.conformance("CiA 301", "SDO: a new request ends the old transfer")
def test_a_new_request_takes_the_place_of_an_unfinished_transfer(wire, remote):
    wire.request(NODE, bytes.fromhex("4000200000000000"))
    assert wire.read(NODE, 0x1018, 1) == b"\x01\0\0\0"


@pytest.mark.conformance("CiA 301", "SDO length mismatch: 06070010")
def test_more_or_fewer_bytes_than_announced_are_a_length_mismatch(wire, remote):
    wire.request(NODE, bytes.fromhex("2101200005000000"))
    assert wire.abort_of(NODE, bytes.fromhex("0101020304050607")) == LENGTH_MISMATCH
    wire.request(NODE, bytes.fromhex("2101200005000000"))
    assert wire.abort_of(NODE, bytes.fromhex("0901020300000000")) == LENGTH_MISMATCH


@pytest.mark.conformance("CiA 301", "SDO size is checked before the data")
def test_a_size_that_does_not_fit_is_refused_before_the_data(wire, remote):
    assert wire.abort_of(NODE, bytes.fromhex("2104200009000000")) == 0x06070012
    assert wire.abort_of(NODE, bytes.fromhex("2104200007000000")) == 0x06070013
    assert wire.abort_of(NODE, bytes.fromhex("21012000ffffff7f")) == 0x05040005


@pytest.mark.conformance("CiA 301", "SDO expedited without size")
def test_an_expedited_download_without_size_has_the_size_of_its_object(wire, remote):
    assert wire.request(NODE, bytes.fromhex("2202200011001100"))[0][0] == 0x60
    assert wire.read(NODE, 0x2002) == b"\x11\0"


@pytest.mark.conformance("CiA 301", "SDO block download: lost segments")
def test_a_lost_segment_of_a_block_is_requested_again(wire, remote):
    # 14 bytes with a checksum; segment 2 is lost, and segment 3 claims to be the last one
    wire.request(NODE, bytes.fromhex("c60120000e000000"))
    assert wire.request(NODE, b"\x01abcdefg") == []
    (answer,) = wire.request(NODE, b"\x83hijklmn")
    assert answer[:3] == bytes([0xA2, 1, 127])

    # the rest comes in a new block
    (answer,) = wire.request(NODE, b"\x81hijklmn")
    assert answer[:3] == bytes([0xA2, 1, 127])
    wrong_checksum = b"\xc1\x00\x00"
    assert wire.abort_of(NODE, wrong_checksum) == 0x05040004


@pytest.mark.conformance("CiA 301", "SDO block upload: lost segments")
def test_a_block_upload_repeats_the_segments_that_the_client_has_not_received(wire, remote):
    remote.sdo.download(0x2001, 0, bytes(range(50)))
    (answer,) = wire.request(NODE, bytes.fromhex("a401200004000000"))  # blocks of 4 segments
    assert answer == bytes.fromhex("c601200032000000")
    first_block = wire.request(NODE, b"\xa3")
    assert [segment[0] for segment in first_block] == [1, 2, 3, 4]

    # the client has received 2 of 4 segments
    second_block = wire.request(NODE, b"\xa2\x02\x04")
    assert second_block[0][1:] == bytes(range(14, 21))
    # all 4, and the next block may be longer
    last_block = wire.request(NODE, b"\xa2\x04\x7f")
    assert last_block[-1][0] == 0x80 | 2

    # of 7 bytes of the last segment 6 are unused
    (end,) = wire.request(NODE, b"\xa2\x02\x7f")
    assert end[0] == 0xC1 | 6 << 2
    assert wire.request(NODE, b"\xa1") == []


@pytest.mark.conformance("CiA 301", "SDO block size: 05040002")
@pytest.mark.parametrize("size", [0, 128])
def test_a_block_size_that_is_not_1_to_127_is_refused(wire, remote, size):
    assert wire.abort_of(NODE, bytes.fromhex("a4002000") + bytes([size])) == 0x05040002


@pytest.mark.conformance("CiA 301", "several SDO clients, 1201h")
def test_a_second_client_has_a_separate_server(wire, remote):
    for sub, cob_id in ((1, 0x640 + 0x60), (2, 0x5C0 - 0x60)):
        assert wire.write(NODE, 0x1201, sub, cob_id, 4) == 0
    wire.request(NODE, bytes.fromhex("4000200000000000"))
    wire.send(0x6A0, bytes.fromhex("4018100100000000"))
    assert wire.take(0x560) == [bytes.fromhex("4318100101000000")]
    # the first client's transfer is still there
    assert wire.request(NODE, b"\x60")[0][1:] == b"a text "


@pytest.mark.conformance("CiA 301", "every object of every node is readable")
def test_every_object_of_every_node_is_readable_or_write_only(wire):
    for node in [wire.drive(1), wire.encoder(), wire.brake()]:
        client = canopen.RemoteNode(node.node_id, node.dictionary)
        wire.master.add_node(client)
        for at, variable in node.objects.variables.items():
            if variable.readable:
                data = client.sdo.upload(at >> 8, at & 0xFF)
                assert not variable.fixed_size or len(data) == len(variable) // 8
            else:
                assert wire.read(node.node_id, at >> 8, at & 0xFF) == 0x06010001


def test_the_client_of_harnesses_reads_a_text_of_several_segments(wire):
    wire.brake()
    answers = []

    def send(message):
        wire.send(message.arbitration_id, bytes(message.data))
        answers.extend(wire.take(0x591))

    def read(timeout_s):
        return can.Message(arbitration_id=0x591, data=answers.pop(0), is_extended_id=False)

    client = SdoClient(send, read, pass_on=print)
    assert client.read(17, 0x1008, 0) == b"brake I/O"
    client.write(17, 0x1017, 0, (250).to_bytes(2, "little"))
    assert client.read(17, 0x1017, 0) == b"\xfa\0"
