"""The hub and its protocols, over real sockets."""

import asyncio
import contextlib
import random
import socket
import struct
import time

import can
import pytest

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.bus import cannelloni, frames, slcan, socketcand, virtualcan
from rollerrig.wsp_interface.bus.codecs import CODECS
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.bus.session import Mode
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.places import PLACES, PLACES_OF_ADDRESS

TCP_DATA_SEGMENTS_IN = 152  # offset of tcpi_data_segs_in in struct tcp_info, linux/tcp.h


def numbered(count: int) -> list[Frame]:
    return [Frame(0x181, struct.pack("<Q", number)) for number in range(count)]


def numbers(messages) -> list[int]:
    return [struct.unpack("<Q", bytes(message.data))[0] for message in messages]


def python_can_client(bench) -> can.BusABC:
    return can.Bus(
        interface="socketcand", host="127.0.0.1", port=bench.port, channel="rig0", tcp_tune=True
    )


def receive(bus: can.BusABC, count: int) -> list[can.Message]:
    end_s = time.monotonic() + 60.0
    messages = []
    while len(messages) < count and time.monotonic() < end_s:
        message = bus.recv(0.1)
        if message:
            messages.append(message)
    return messages


def read_until(client: socket.socket, ending: bytes) -> bytes:
    client.settimeout(60)
    data = b""
    while not data.endswith(ending):
        chunk = client.recv(65536)
        if not chunk:
            break
        data += chunk
    return data


def read_to_end(client: socket.socket) -> bytes:
    client.settimeout(60)
    data = b""
    while chunk := client.recv(65536):
        data += chunk
    return data


# --- in the process ---


def test_every_frame_reaches_all_nodes_and_taps_but_not_its_sender_with_one_time_stamp():
    ticks = iter(range(0, 10_000, 10))
    hub = Hub(lambda: next(ticks))
    seen = {"tap": [], "a": [], "b": []}
    hub.tap(seen["tap"].append)
    a = hub.attach(seen["a"].append)
    hub.attach(seen["b"].append)
    a.send(Frame(0x80, b""))
    assert seen["a"] == []
    assert seen["b"] == seen["tap"] == [Frame(0x80, b"", time_ns=10)]


def test_a_node_that_answers_inside_its_callback_does_not_overtake_the_question():
    hub = Hub(time.monotonic_ns)
    seen = []
    master = hub.attach(lambda frame: None)
    first = hub.attach(lambda frame: first.send(Frame(0x181, b"")) if frame.can_id == 0x80 else 0)
    hub.attach(lambda frame: seen.append(frame.can_id))
    master.send(Frame(0x80, b""))
    master.send(Frame(0x80, b""))
    assert seen == [0x80, 0x181, 0x80, 0x181]


def test_a_failing_node_is_reported_and_others_still_receive():
    async def run():
        problems = []
        seen = []
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda loop, context: problems.append(context))
        hub = Hub(time.monotonic_ns)
        hub.attach(lambda frame: 1 / 0)
        hub.attach(seen.append)
        hub.attach(print).send(Frame(0x80, b""))
        return problems, seen

    problems, seen = asyncio.run(run())
    assert len(seen) == 1
    assert isinstance(problems[0]["exception"], ZeroDivisionError)
    assert "80h" in problems[0]["message"]


def test_a_closed_port_receives_nothing_and_its_frames_count_as_dropped():
    hub = Hub(time.monotonic_ns)
    seen = []
    closed = hub.attach(seen.append)
    other = hub.attach(lambda frame: None)
    closed.close()
    other.send(Frame(1, b""))
    closed.send(Frame(2, b""))
    assert seen == []
    assert closed.dropped == 1
    assert hub.stats()["frames"] == 1


@pytest.mark.parametrize(
    "frame",
    [
        Frame(0x800, b""),
        Frame(-1, b""),
        Frame(0x2000_0000, b"", extended=True),
        Frame(1, bytes(9)),
        Frame(1, b"", remote=True, dlc=9),
        Frame(1, b"x", remote=True),
    ],
)
def test_a_frame_that_no_can_controller_can_send_is_refused(frame):
    port = Hub(time.monotonic_ns).attach(lambda frame: None)
    with pytest.raises(ValueError, match="CAN frame"):
        port.send(frame)


# --- the wire ---


def test_a_frame_of_eight_bytes_has_111_bits_and_135_at_most():
    assert frames.bits(Frame(1, bytes(8))) == 111
    assert frames.bits(Frame(1, bytes(8)), worst=True) == 135
    assert frames.bits(Frame(1, bytes(8), extended=True)) == 131
    assert frames.bits(Frame(1, bytes(8), extended=True), worst=True) == 160
    assert frames.bits(Frame(1, b"", remote=True, dlc=8)) == 47


def test_the_default_rig_at_100_hz_loads_500_kbit_by_38_percent():
    # 16 drive frames, sensor, valves and SYNC, most with eight bytes
    now = [0]
    hub = Hub(lambda: now[0], bitrate=500_000)
    port = hub.attach(lambda frame: None)
    for _ in range(200):
        for frame in [Frame(0x80, b""), *numbered(17)]:
            port.send(frame)
        now[0] += 10_000_000
    load = hub.stats()
    assert load["load_percent"] == pytest.approx(38.7, abs=0.1)
    assert not load["overloaded"]


def test_more_than_the_bus_can_carry_is_flagged_as_overload():
    now = [0]
    hub = Hub(lambda: now[0], bitrate=500_000)
    port = hub.attach(lambda frame: None)
    for _ in range(100):
        for frame in numbered(50):  # 11.1 ms worth every 10 ms
            port.send(frame)
        now[0] += 10_000_000
    assert hub.stats()["overloaded"]
    assert hub.stats()["load_percent"] == pytest.approx(111, abs=0.5)


def test_the_log_is_read_back_by_python_can_frame_by_frame(tmp_path):
    sent = [
        Frame(0x123, b"\xaa\xbb", time_ns=1_234_567_890_123_456_789),
        Frame(0x7FF, b"", time_ns=1_000),
        Frame(0x12345, bytes(range(8)), True),
        Frame(0x701, b"", remote=True, dlc=1),
        Frame(0x702, b"", remote=True),
    ]
    path = tmp_path / "can.log"
    path.write_text("".join(frames.candump_line(frame) + "\n" for frame in sent))
    assert path.read_text().startswith("(1234567890.123456) rig0 123#AABB\n")
    with can.CanutilsLogReader(path) as reader:
        read = list(reader)
    assert len(read) == len(sent)
    for message, frame in zip(read, sent, strict=True):
        assert message.arbitration_id == frame.can_id
        assert bytes(message.data) == frame.data
        assert message.is_extended_id == frame.extended
        assert message.is_remote_frame == frame.remote
        assert message.dlc == frames.length(frame)
        assert message.channel == "rig0"
    assert read[1].timestamp == pytest.approx(1e-6)


# --- socketcand ---


@pytest.mark.conformance(
    "Hub", "socketcand: the client of python-can; no sender gets its frames back"
)
def test_the_client_of_python_can_gets_every_frame_in_order_but_not_those_that_it_sends(bench):
    seen = []
    node = bench.node(seen.append)
    a = python_can_client(bench)
    b = python_can_client(bench)
    bench.send(node, *numbered(500))
    assert numbers(receive(a, 500)) == numbers(receive(b, 500)) == list(range(500))
    for frame in numbered(300):
        a.send(can.Message(arbitration_id=0x201, data=frame.data, is_extended_id=False))
    assert numbers(receive(b, 300)) == list(range(300))
    assert a.recv(0.1) is None
    assert [frame.data for frame in seen] == [frame.data for frame in numbered(300)]
    a.shutdown()
    b.shutdown()
    assert bench.hub.dropped == 0


@pytest.mark.conformance("Hub", "one time stamp for each frame")
def test_all_clients_and_the_log_see_the_same_time_stamp(bench):
    clients = [bench.raw_mode() for _ in range(2)]
    bench.send(bench.node(), Frame(0x80, b"\x01"))
    texts = [read_until(client, b">") for client in clients]
    assert texts[0] == texts[1] == socketcand.encode_event(bench.log[0])
    assert bench.log[0].time_ns > 0


@pytest.mark.conformance("Hub", "socketcand: handshake answers in separate segments")
def test_each_answer_of_the_handshake_is_a_separate_segment_and_frames_wait_for_it(bench):
    client = bench.connect()
    assert client.recv(256) == b"< hi >"
    node = bench.node()
    began_s = time.monotonic()
    client.sendall(b"< open rig0 >\n< rawmode >\n")
    assert client.recv(256) == b"< ok >"
    assert client.recv(256) == b"< ok >"
    bench.send(node, Frame(0x181, b"\x01"))
    assert client.recv(256).startswith(b"< frame 181 ")
    assert time.monotonic() - began_s >= 0.05


@pytest.mark.conformance(
    "Hub", "socketcand: commands in any number of pieces, bytes as SavvyCAN sends them"
)
def test_commands_are_understood_in_any_number_of_pieces(bench):
    client = bench.connect()
    script = (
        b"< open rig0 >< rawmode ><send 1 0><  send\t7fF 2  a B >\r\n"
        b"< send 92345678 3 ffffff80 ffffffff 1 >< send 00000123 1 7F >"
    )
    for index in range(len(script)):
        client.sendall(script[index : index + 1])
    assert bench.until(lambda: len(bench.log) == 4)
    assert [frame[:3] for frame in bench.log] == [
        (0x001, b"", False),
        (0x7FF, b"\x0a\x0b", False),
        (0x12345678, b"\x80\xff\x01", True),
        (0x123, b"\x7f", True),
    ]


@pytest.mark.conformance("Hub", "socketcand: 11-bit and 29-bit identifiers")
def test_identifiers_of_11_and_29_bits_have_three_and_eight_digits(bench):
    client = bench.raw_mode()
    node = bench.node()
    bench.send(node, Frame(0x12, b"\xab"), Frame(0x12, b"", True))
    words = read_until(client, b"  >").split()
    assert words[2] == b"012"
    assert words[4] == b"AB"
    assert words[7] == b"00000012"


@pytest.mark.conformance("Hub", "socketcand: remote frames")
def test_remote_frames_pass_in_both_directions(bench):
    a = bench.raw_mode()
    b = bench.raw_mode()
    a.sendall(b"< sendrtr 701 1 >")
    assert bench.until(lambda: bench.log)
    assert bench.log[0][:5] == (0x701, b"", False, True, 1)
    assert read_until(b, b">").split()[1:3] == [b"rtr", b"701"]


@pytest.mark.conformance("Bad input", "socketcand: an unknown or malformed command is answered")
@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"< echo >", b"< echo >"),
        (b"< subscribe 0 0 123 >", b"< error unknown command >"),
        (b"< >", b"< error unknown command >"),
        (b"nonsense > < nonsense < rubbish >", b"< error unknown command >"),
        (b"< send 123 9 1 2 3 4 5 6 7 8 9 >", b"< error malformed send >"),
        (b"< send 123 2 1 >", b"< error malformed send >"),
        (b"< send 12g 1 1 >", b"< error malformed send >"),
        (b"< send -1 1 1 >", b"< error malformed send >"),
        (b"< send 1 1 0x1 >", b"< error malformed send >"),
        (b"< send 1 1 +1 >", b"< error malformed send >"),
        (b"< send 1_0 1 1 >", b"< error malformed send >"),
        (b"< sendrtr 1 >", b"< error malformed sendrtr >"),
        (b"< send" + b" 0" * 300 + b" >", b"< error unknown command >"),
        (b"<" + b"x" * 5000, b"< error command too long >"),
    ],
)
def test_an_unknown_or_malformed_command_is_answered_and_the_client_stays(bench, command, answer):
    client = bench.raw_mode()
    client.sendall(command)
    assert read_until(client, b">") == answer
    client.sendall(b"> < send 123 1 55 >")
    assert bench.until(lambda: len(bench.log) == 1)
    assert bench.log[0][:2] == (0x123, b"\x55")


def test_nothing_can_be_sent_before_a_bus_is_open_and_another_bus_is_refused(bench):
    client = bench.connect()
    client.sendall(b"< send 1 0 >< open other >")
    text = read_to_end(client)
    assert text.startswith(b"< hi >< error unknown command >< error could not open bus")
    assert b"rig0" in text
    assert bench.log == []


def test_bcmmode_stops_the_frames_and_rawmode_starts_them_again(bench):
    client = bench.raw_mode()
    node = bench.node()
    client.sendall(b"< bcmmode >")
    assert read_until(client, b"< ok >") == b"< ok >"
    bench.send(node, Frame(1, b""))
    client.sendall(b"< rawmode >")
    assert read_until(client, b"< ok >") == b"< ok >"
    bench.send(node, Frame(2, b""))
    assert read_until(client, b">").startswith(b"< frame 002")


@pytest.mark.conformance("Hub", "one write for each SYNC")
def test_frames_sent_in_one_callback_leave_in_one_segment(bench):
    client = bench.raw_mode()
    node = bench.node()

    def segments() -> int:
        info = client.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
        return struct.unpack_from("I", info, TCP_DATA_SEGMENTS_IN)[0]

    time.sleep(0.08)  # past the hold after rawmode
    before = segments()
    bench.send(node, *numbered(20))
    text = read_until(client, socketcand.encode_event(bench.log[-1]))
    assert text.count(b">") == 20
    assert segments() - before == 1


# --- clients that misbehave ---


@pytest.mark.conformance(
    "Bad input", "a slow client loses frames, which are counted, and delays no other"
)
def test_a_client_that_does_not_read_loses_frames_while_another_gets_all(start_hub):
    bench = start_hub(buffer_bytes=100_000)
    slow = bench.connect()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.sendall(b"< open rig0 >< rawmode >")
    good = python_can_client(bench)
    node = bench.node()
    received = []
    for start in range(0, 40_000, 200):
        batch = [Frame(0x181, struct.pack("<Q", start + n)) for n in range(200)]
        bench.send(node, *batch)
        received += numbers(receive(good, 200))
    assert received == list(range(40_000))
    by_client = {client["name"]: client for client in bench.hub.stats()["clients"]}
    slow_stats = by_client["socketcand {}:{}".format(*slow.getsockname())]
    assert slow_stats["dropped"] > 1000
    assert bench.hub.dropped == slow_stats["dropped"]
    good.shutdown()
    slow.close()
    assert bench.until(lambda: not bench.hub.stats()["clients"])
    assert bench.hub.dropped == slow_stats["dropped"]  # still counted after it has left


@pytest.mark.conformance("Bad input", "a client that does not read its answers is bounded")
def test_a_client_that_sends_without_reading_the_answers_is_bounded(start_hub):
    bench = start_hub(buffer_bytes=50_000)
    client = bench.connect()
    client.settimeout(60)
    client.sendall(b"< echo >" * 2000)
    assert bench.until(lambda: bench.hub.dropped > 0)
    witness = bench.raw_mode()
    witness.sendall(b"< send 1 0 >")
    assert bench.until(lambda: len(bench.log) == 1)


@pytest.mark.conformance("Bad input", "protocols of the hub: garbage never disturbs the bus")
def test_garbage_never_disturbs_the_bus(bench):
    ports = {codec: bench.listen(codec) for codec in CODECS if codec != "socketcand"}
    ports["socketcand"] = bench.port
    random_source = random.Random(20_240_601)
    vocabulary = [
        b"<",
        b">",
        b" ",
        b"send",
        b"open rig0",
        b"rawmode",
        b"echo",
        b"ffffff80",
        b"8",
        b"t1238",
        b"\r",
        b"O\r",
        b"R0000",
        b"CANNELLONIv1",
        b"\0\0\0\x0e",
        b"\xff" * 5,
    ]
    witness = python_can_client(bench)
    other = python_can_client(bench)
    for round_number in range(60):
        client = bench.connect(ports[random_source.choice(sorted(ports))])
        for _ in range(random_source.randrange(1, 5)):
            pieces = []
            for _ in range(random_source.randrange(60)):
                if random_source.random() < 0.7:
                    pieces.append(random_source.choice(vocabulary))
                else:
                    pieces.append(random_source.randbytes(random_source.randrange(20)))
            try:
                client.sendall(b"".join(pieces))
            except OSError:
                break  # the hub has closed the connection
        client.close()
        mark = struct.pack("<Q", 0x5A00_0000 + round_number)
        witness.send(can.Message(arbitration_id=0x123, data=mark, is_extended_id=False))
        while True:  # the garbage may also contain valid frames
            message = other.recv(5)
            assert message is not None
            if message.arbitration_id == 0x123 and bytes(message.data) == mark:
                break
    assert bench.problems == []
    witness.shutdown()
    other.shutdown()


@pytest.mark.conformance("Bad input", "a client that vanishes disturbs no other")
def test_a_client_that_vanishes_with_a_reset_disturbs_no_other(bench):
    node = bench.node()
    client = bench.raw_mode()
    witness = bench.raw_mode()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()
    for number in range(50):
        bench.send(node, Frame(number, b""))
    assert read_until(witness, socketcand.encode_event(bench.log[-1])).count(b">") == 50
    assert bench.until(lambda: len(bench.hub.stats()["clients"]) == 1)
    assert bench.problems == []


# --- the other protocols ---

SAMPLES = [
    Frame(0x123, b"\x11\x22"),
    Frame(0x7FF, b""),
    Frame(0x1ABCDEF0, bytes(range(8)), True),
    Frame(0x12, b"\x80", True),
    Frame(0x701, b"", remote=True, dlc=1),
    Frame(0x1ABCDEF0, b"", True, True, 8),
]


@pytest.mark.conformance(
    "Hub", "slcan, virtualcan, cannelloni: base, extended and remote frames both ways"
)
@pytest.mark.parametrize(
    ("codec", "hello", "greeting", "encode"),
    [
        ("slcan", b"C\rS6\rO\r", b"\r\r\r", slcan.encode_event),
        ("virtualcan", b"", b"", virtualcan.encode_event),
        ("cannelloni", b"CANNELLONIv1", b"CANNELLONIv1", cannelloni.encode_event),
    ],
)
def test_each_other_protocol_carries_base_extended_and_remote_frames_both_ways(
    bench, codec, hello, greeting, encode
):
    client = bench.connect(bench.listen(codec))
    client.sendall(hello)
    if greeting:
        assert read_until(client, greeting) == greeting
    assert bench.until(lambda: any(client.listening for client in bench.hub._clients))
    for byte in b"".join(encode(frame) for frame in SAMPLES):
        client.sendall(bytes([byte]))
    assert bench.until(lambda: len(bench.log) == len(SAMPLES))
    assert [frame._replace(time_ns=0) for frame in bench.log] == SAMPLES
    if codec == "slcan":
        assert read_until(client, b"z\rZ\r") == b"z\rz\rZ\rZ\rz\rZ\r"
    node = bench.node()
    bench.send(node, *SAMPLES)
    expected = b"".join(encode(frame) for frame in SAMPLES)
    assert read_until(client, expected) == expected


def test_a_virtualcan_client_that_sends_more_after_a_wrong_length_repeats_no_frame():
    packet = virtualcan.encode_event(Frame(0x123, b"\x11"))
    wrong_length = b"\xff\xff\xff\xff"
    session = virtualcan.VirtualcanSession("rig0")
    events = []
    for chunk in (packet[:6], packet[6:] + wrong_length, packet[6:]):
        events += session.feed(chunk)
    frames_received = [event for event in events if isinstance(event, Frame)]
    assert len(frames_received) == 1
    assert events[1:] == [Mode.CLOSE, Mode.CLOSE]


@pytest.mark.conformance("Hub", "virtualcan, cannelloni, slcan: the bytes of their documents")
def test_the_bytes_of_the_binary_protocols_are_those_of_their_documents():
    frame = Frame(0x123, b"\x11\x22")
    remote = Frame(0x701, b"", remote=True, dlc=1)
    assert virtualcan.encode_event(frame).hex() == "0000000e0000012300021122" + "00" * 6
    assert virtualcan.encode_event(remote).hex() == "0000000e400007010001" + "00" * 8
    assert cannelloni.encode_event(frame).hex() == "00000123021122"
    assert cannelloni.encode_event(remote).hex() == "4000070101"
    assert cannelloni.encode_event(Frame(1, b"", True)).hex() == "8000000100"
    assert slcan.encode_event(Frame(1, b"\xab", True)) == b"T000000011AB\r"
    assert slcan.encode_event(remote) == b"r7011\r"


def test_slcan_refuses_frames_until_open_and_in_listen_only(bench):
    client = bench.connect(bench.listen("slcan"))
    client.sendall(b"t1230\rL\rt1230\rV\rX9\rO\rt1230\r")
    assert read_until(client, b"z\r") == b"\a\r\aV1013\r\a\rz\r"
    assert len(bench.log) == 1


@pytest.mark.conformance("Bad input", "virtualcan, cannelloni: a stream out of step is closed")
@pytest.mark.parametrize(
    ("codec", "wire"),
    [
        ("cannelloni", b"GET / HTTP/1.1\r\n\r\n"),
        ("cannelloni", b"CANNELLONIv1\0\0\1\x23\x7f"),
        ("virtualcan", b"GET / HTTP/1.1\r\n\r\n"),
    ],
)
def test_a_binary_stream_out_of_step_is_closed(bench, codec, wire):
    client = bench.connect(bench.listen(codec))
    client.sendall(wire)
    assert read_to_end(client) in (b"", b"CANNELLONIv1")
    assert bench.log == []


def test_cannelloni_skips_can_fd_and_error_frames(bench):
    client = bench.connect(bench.listen("cannelloni"))
    client.sendall(
        b"CANNELLONIv1"
        + bytes.fromhex("00000001 a0 00")
        + bytes(32)
        + bytes.fromhex("20000001 08")
        + bytes(8)
        + bytes.fromhex("00000002 00")
    )
    assert bench.until(lambda: len(bench.log) == 1)
    assert bench.log[0].can_id == 2


# --- clients of other protocols ---

# another protocol, whose bytes contain valid commands of each of the hub's protocols
POST = (
    b"POST / HTTP/1.1\r\nContent-Length: 99\r\n\r\n< open rig0 >< rawmode >< send 123 1 ff >"
    b"\rO\rt12310F\rCANNELLONIv1\0\0\1\x23\0\0\0\0\x0e\0\0\1\x23\0\0" + bytes(8)
)


@pytest.mark.conformance(
    "Bad input",
    "a client of another protocol is closed, none of its commands is executed, one event",
)
@pytest.mark.parametrize("codec", CODECS)
def test_a_client_that_begins_with_another_protocol_is_closed_and_reported_once(start_hub, codec):
    reported = []
    bench = start_hub(on_event=lambda code, **fields: reported.append((code, fields)))
    port = bench.listen(codec)
    for pieces in ([POST], [POST[:3], POST[3:]]):
        client = bench.connect(port)
        for piece in pieces:
            client.sendall(piece)
            time.sleep(0.05)
        assert read_to_end(client) in (b"", b"< hi >", b"CANNELLONIv1")
    assert bench.log == []
    assert reported == [(Code.HUB_FOREIGN_CLIENT, {"bus": "rig0", "protocol": codec})]


# --- places ---


def await_end(client: socket.socket) -> None:
    """Wait until the hub closes a client; the test fails if it does not within a minute."""
    with contextlib.suppress(ConnectionResetError):
        read_to_end(client)


def still_open(client: socket.socket) -> bool:
    """Return whether the hub has not closed a client yet."""
    client.setblocking(False)
    try:
        while client.recv(65536):
            pass
    except BlockingIOError:
        return True
    except ConnectionResetError:
        return False
    return False


@pytest.mark.conformance(
    "Bad input", "clients of the hub are bounded; refused ones cause one event"
)
def test_clients_beyond_the_limit_are_refused_and_reported_once_if_all_others_have_spoken(
    start_hub,
):
    reported = []
    bench = start_hub(on_event=lambda code, **fields: reported.append((code, fields)))
    clients = [bench.raw_mode() for _ in range(PLACES_OF_ADDRESS)]
    for _ in range(2):
        await_end(bench.connect())
    assert len(bench.hub.stats()["clients"]) == PLACES_OF_ADDRESS
    full = {"bus": "rig0", "protocol": "socketcand", "clients_max": PLACES_OF_ADDRESS}
    assert reported == [(Code.HUB_FULL, full | {"address": "127.0.0.1"})]
    # another protocol has a separate limit, and a client that leaves makes room
    other = bench.connect(bench.listen("cannelloni"))
    assert read_until(other, b"CANNELLONIv1") == b"CANNELLONIv1"
    clients.pop().close()
    assert bench.until(lambda: len(bench.hub.stats()["clients"]) == PLACES_OF_ADDRESS)
    bench.raw_mode().close()


@pytest.mark.conformance("Bad input", "one machine cannot take all places of the hub")
def test_the_clients_of_one_address_leave_places_for_those_of_others(start_hub):
    reported = []
    bench = start_hub(on_event=lambda code, **fields: reported.append((code, fields)))
    clients = []
    for address in ("127.0.0.1", "127.0.0.2"):
        clients += [bench.raw_mode(address) for _ in range(PLACES_OF_ADDRESS)]
    assert len(bench.hub.stats()["clients"]) == PLACES
    assert reported == []
    await_end(bench.connect(source="127.0.0.3"))
    ((code, fields),) = reported
    assert code == Code.HUB_FULL
    assert fields["clients_max"] == PLACES
    assert fields["address"] is None


@pytest.mark.conformance("Bad input", "silent clients cannot keep a unit out: CAN")
@pytest.mark.parametrize("codec", ["socketcand", "slcan", "cannelloni"])
def test_the_client_that_has_been_silent_longest_gives_way_to_a_new_one(start_hub, codec):
    reported = []
    bench = start_hub(on_event=lambda code, **fields: reported.append((code, fields)))
    hello = {"socketcand": b"< open rig0 >", "slcan": b"O\r", "cannelloni": b"CANNELLONIv1"}
    port = bench.listen(codec)
    speaker = bench.connect(port)
    speaker.sendall(hello[codec])
    assert bench.until(lambda: not any(client.silent for client in bench.hub._clients))

    silent = [bench.connect(port) for _ in range(PLACES_OF_ADDRESS - 1)]
    assert bench.until(lambda: len(bench.hub.stats()["clients"]) == PLACES_OF_ADDRESS)
    new = [bench.connect(port) for _ in range(3)]
    for client in new:
        client.sendall(hello[codec])
    for client in silent[:3]:
        await_end(client)
    assert bench.until(lambda: sum(not one.silent for one in bench.hub._clients) == 4)
    assert all(still_open(client) for client in (speaker, *silent[3:], *new))
    (event,) = reported
    assert event[0] == Code.SERVER_SILENT_GAVE_WAY
    assert codec in event[1]["server"]


@pytest.mark.conformance("Hub", "virtualcan: a program may listen only, and keeps its place")
def test_newer_silent_clients_do_not_push_out_a_virtualcan_client_that_only_listens(bench):
    port = bench.listen("virtualcan")
    listener = bench.connect(port)
    assert bench.until(lambda: len(bench.hub.stats()["clients"]) == 1)
    others = [bench.connect(port) for _ in range(PLACES_OF_ADDRESS + 5)]
    assert bench.until(lambda: sum(not still_open(client) for client in others) == 6)
    bench.send(bench.node(), *SAMPLES)
    expected = b"".join(virtualcan.encode_event(frame) for frame in SAMPLES)
    assert read_until(listener, expected) == expected


@pytest.mark.conformance("Bad input", "a client that sends nothing valid is closed: CAN")
def test_a_client_that_sends_nothing_valid_is_closed_after_its_time_but_no_listener_is(start_hub):
    reported = []
    bench = start_hub(
        first_message_s=3.0, on_event=lambda code, **fields: reported.append((code, fields))
    )
    ports = {codec: bench.listen(codec) for codec in CODECS}
    speaker = bench.connect(ports["socketcand"])
    speaker.sendall(b"< open rig0 >< rawmode >")
    listener = bench.connect(ports["virtualcan"])

    silent = [bench.connect(ports[codec]) for codec in ("socketcand", "slcan", "cannelloni")]
    babbler = bench.connect(ports["socketcand"])
    babbler.sendall(b"< hello >< send 1 0 >")
    unfinished = bench.connect(ports["slcan"])
    unfinished.sendall(b"\r\rt123")
    for client in (*silent, babbler, unfinished):
        await_end(client)

    assert {code for code, _ in reported} == {Code.SERVER_SILENT_CLOSED}
    assert len(reported) == 3  # one for each protocol
    bench.send(bench.node(), Frame(0x80, b""))
    assert read_until(speaker, b"  >").endswith(socketcand.encode_event(bench.log[0]))
    packet = virtualcan.encode_event(bench.log[0])
    assert read_until(listener, packet) == packet


# --- opening and closing ---


def test_the_error_for_a_port_in_use_has_the_port_and_the_remedy(bench):
    message = rf"127.0.0.1:{bench.port}.*ss -ltnp 'sport = :{bench.port}'"
    with pytest.raises(BusError, match=message):
        bench.do(lambda: bench.hub.listen("socketcand", port=bench.port))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"codec": "telepathy"}, "allowed: socketcand, slcan, virtualcan, cannelloni"),
        ({"port": 70000}, "65535"),
        ({"host": "192.0.2.1", "port": 0}, "127.0.0.1"),
    ],
)
def test_a_wrong_address_is_refused_with_the_allowed_ones(bench, options, message):
    with pytest.raises(BusError, match=message):
        bench.do(lambda: bench.hub.listen(**options))


@pytest.mark.conformance("Bad input", "loopback by default: CAN")
def test_the_hub_listens_on_loopback_by_default(bench):
    assert bench.hub._servers[0].sockets[0].getsockname()[0] == "127.0.0.1"


@pytest.mark.conformance("Bad input", "an address that others reach causes an event: CAN")
def test_a_hub_that_listens_beyond_loopback_reports_an_event(start_hub):
    reported = []
    bench = start_hub(on_event=lambda code, **fields: reported.append((code, fields)))
    assert reported == []
    bench.do(lambda: bench.hub.listen("slcan", host="0.0.0.0", port=0))
    ((code, fields),) = reported
    assert code == Code.SERVER_EXPOSED
    assert "slcan" in fields["server"]
    assert "BEYOND THIS MACHINE" in events.text(code, fields)


def test_closing_sends_waiting_frames_and_then_closes_every_client_even_one_that_does_not_read(
    bench,
):
    reader = bench.raw_mode()
    stuck = bench.raw_mode()
    closed = []
    node = bench.do(lambda: bench.hub.attach(print, on_close=lambda: closed.append(True)))
    bench.send(node, *numbered(8000))
    last = bench.log[-1]
    text = bytearray()

    async def close_and_read():
        task = asyncio.ensure_future(bench.hub.close())
        text.extend(await asyncio.to_thread(read_to_end, reader))
        await task

    bench.do(close_and_read)
    assert text.count(b">") == 8000
    assert text.endswith(socketcand.encode_event(last))
    assert closed == [True]
    stuck.close()
