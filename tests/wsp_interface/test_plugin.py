"""The python-can plugin, with the hub and with servers that fail, over real sockets."""

import asyncio
import select
import socket
import struct
import threading
import time

import can
import canopen
import pytest

from rollerrig.wsp_interface.bus import plugin
from rollerrig.wsp_interface.bus.frames import Frame


@pytest.fixture
def bus(bench):
    with can.Bus(interface="rollerrig", channel=bench.address()) as opened:
        yield opened


@pytest.fixture
def node(bench):
    return bench.node()


@pytest.fixture
def server():
    """A listening socket; the test plays the server."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


def send_numbers(bench, node, count: int) -> None:
    batch = [Frame(0x181, struct.pack("<I", number)) for number in range(count)]
    bench.send(node, *batch)


def numbers(messages) -> list[int]:
    return [struct.unpack("<I", bytes(message.data))[0] for message in messages]


def play_handshake(server, chunks=(b"< hi >", b"< ok >", b"< ok >")) -> tuple:
    """Return the plugin, connected to a server that sends the chunks, and the server's socket."""
    accepted = []
    port = server.getsockname()[1]

    def play():
        connection = server.accept()[0]
        for chunk in chunks:
            connection.sendall(chunk)
            time.sleep(0.005)
        accepted.append(connection)

    thread = threading.Thread(target=play)
    thread.start()
    try:
        opened = plugin.RollerrigBus(f"127.0.0.1:{port}/rig0", connect_timeout=60.0)
    finally:
        thread.join()
    return opened, accepted[0]


@pytest.mark.conformance("Hub", "python-can plugin: entry point can.interface")
@pytest.mark.parametrize("prefix", ["", "socketcand://"])
def test_python_can_finds_the_plugin_by_its_name_and_both_forms_of_address(bench, prefix):
    with can.Bus(interface="rollerrig", channel=prefix + bench.address()) as bus:
        assert isinstance(bus, plugin.RollerrigBus)
        assert "rig0" in bus.channel_info


@pytest.mark.conformance("Hub", "python-can plugin: every kind of frame, RTR too")
@pytest.mark.parametrize(
    "frame",
    [
        Frame(0x123, b""),
        Frame(0x7FF, bytes(range(0xF8, 0x100))),
        Frame(0x12, b"\x01", True),
        Frame(0x1FFFFFFF, b"\x80", True),
        Frame(0x701, b"", remote=True, dlc=1),
        Frame(0x1ABCDEF0, b"", True, True, 8),
    ],
)
def test_a_frame_of_any_kind_arrives_unchanged_in_both_directions(bench, bus, node, frame):
    bus.send(plugin.message_of(frame))
    assert bench.until(lambda: bench.log)
    assert bench.log[0]._replace(time_ns=0) == frame
    bench.send(node, frame)
    message = bus.recv(60)
    assert plugin.frame_of(message) == frame
    assert message.timestamp == pytest.approx(bench.log[1].time_ns / 1e9, abs=1e-6)
    assert bus.recv(0.05) is None  # not the frame that it has sent


def test_a_blocking_reader_gets_all_frames_in_order(bench, bus, node):
    send_numbers(bench, node, 2000)
    assert numbers(bus.recv(60) for _ in range(2000)) == list(range(2000))


def test_a_bus_that_reads_ahead_gets_all_frames_and_sends_in_order_with_the_next_recv(bench, node):
    with plugin.RollerrigBus(bench.address(), ahead=True) as bus:
        send_numbers(bench, node, 2000)
        assert numbers(bus.recv(60) for _ in range(2000)) == list(range(2000))
        for can_id in (0x301, 0x302):
            bus.send(can.Message(arbitration_id=can_id, is_extended_id=False))
        assert len(bench.log) == 2000
        assert bus.recv(0) is None
        assert bench.until(lambda: len(bench.log) == 2002)
        bus.send(can.Message(arbitration_id=0x303, is_extended_id=False))
    # the last frame goes out when the bus is closed
    assert bench.until(
        lambda: [frame.can_id for frame in bench.log[2000:]] == [0x301, 0x302, 0x303]
    )


def test_filters_let_only_the_wanted_frames_through(bench, bus, node):
    bus.set_filters([{"can_id": 0x181, "can_mask": 0x7FF}])
    bench.send(node, *(Frame(can_id, b"") for can_id in (0x180, 0x181, 0x182)))
    assert bus.recv(60).arbitration_id == 0x181
    assert bus.recv(0.05) is None


def test_the_descriptor_is_readable_exactly_while_a_whole_frame_is_there(bench, bus, node):
    assert not select.select([bus], [], [], 0.05)[0]
    send_numbers(bench, node, 3)
    for _ in range(3):
        assert select.select([bus], [], [], 60)[0]
        assert bus.recv(0) is not None
    assert not select.select([bus], [], [], 0)[0]
    assert bus.recv(0) is None


def test_half_a_message_does_not_keep_the_descriptor_readable(server):
    bus, connection = play_handshake(server)
    connection.sendall(b"< frame 123 1.0000")
    assert select.select([bus], [], [], 60)[0]
    assert bus.recv(0) is None
    assert not select.select([bus], [], [], 0.05)[0]
    connection.sendall(b"07 AA >< fra")
    message = bus.recv(60)
    assert (message.arbitration_id, bytes(message.data)) == (0x123, b"\xaa")
    assert message.timestamp == pytest.approx(1.000007)
    assert bus.recv(0) is None
    bus.shutdown()
    connection.close()


def test_a_notifier_in_an_event_loop_gets_every_frame_of_a_burst(bench, bus, node):
    async def run():
        received = []
        notifier = can.Notifier(bus, [received.append], loop=asyncio.get_running_loop())
        await asyncio.to_thread(send_numbers, bench, node, 1500)
        async with asyncio.timeout(60):
            while len(received) < 1500:
                await asyncio.sleep(0.005)
        notifier.stop()
        return received

    assert numbers(asyncio.run(run())) == list(range(1500))


def test_a_notifier_thread_gets_every_frame_of_a_burst(bench, bus, node):
    received = []
    notifier = can.Notifier(bus, [received.append], timeout=0.05)
    send_numbers(bench, node, 1500)
    assert bench.until(lambda: len(received) == 1500)
    notifier.stop()
    assert numbers(received) == list(range(1500))


def test_canopen_reads_a_node_through_the_plugin(bench):
    def answer(frame: Frame) -> None:
        if frame.can_id == 0x605:  # expedited upload of 1000h: 00020192h, CiA 301
            sdo.send(Frame(0x585, b"\x43\x00\x10\x00\x92\x01\x02\x00"))

    sdo = bench.do(lambda: bench.hub.attach(answer))
    network = canopen.Network()
    network.connect(interface="rollerrig", channel=bench.address(), bitrate=500_000)
    try:
        master = network.add_node(5, canopen.ObjectDictionary())
        assert master.sdo.upload(0x1000, 0) == b"\x92\x01\x02\x00"
    finally:
        network.disconnect()


def test_periodic_messages_stop_with_the_bus(bench):
    bus = can.Bus(interface="rollerrig", channel=bench.address())
    bus.send_periodic(can.Message(arbitration_id=0x720, data=b"\x05", is_extended_id=False), 0.005)
    assert bench.until(lambda: len(bench.log) >= 5)
    bus.shutdown()
    bus.shutdown()  # a second time is harmless
    assert bench.until(lambda: not bench.hub.stats()["clients"])
    count = len(bench.log)
    time.sleep(0.05)
    assert len(bench.log) == count


def test_can_fd_and_error_frames_are_refused(bus):
    for message in (can.Message(is_fd=True, data=bytes(12)), can.Message(is_error_frame=True)):
        with pytest.raises(can.CanOperationError, match="classical"):
            bus.send(message)


# --- the end of the connection ---


@pytest.mark.conformance("Hub", "python-can plugin: end of the bus is noticed")
def test_the_end_of_the_hub_raises_after_the_last_frame(bench, bus, node):
    send_numbers(bench, node, 3)
    bench.close()
    assert numbers(bus.recv(60) for _ in range(3)) == [0, 1, 2]
    with pytest.raises(can.CanOperationError, match=r"127\.0\.0\.1.*closed"):
        bus.recv(60)
    with pytest.raises(can.CanOperationError, match="closed"):
        bus.send(can.Message())


def test_a_reader_that_swallows_the_end_does_not_spin(bench, bus):
    bench.close()
    ends = 0
    until_s = time.monotonic() + 0.5
    while time.monotonic() < until_s:
        with pytest.raises(can.CanOperationError):
            bus.recv(0.1)
        ends += 1
    assert ends <= 7


def test_an_event_loop_gets_the_end_once_and_does_not_spin(bench, bus):
    async def run():
        problems = []
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda loop, context: problems.append(context["exception"]))
        notifier = can.Notifier(bus, [lambda message: None], loop=loop)
        await asyncio.to_thread(bench.close)
        calls = 0
        receive = bus._recv_internal

        def counting(timeout):
            nonlocal calls
            calls += 1
            return receive(timeout)

        bus._recv_internal = counting
        await asyncio.sleep(0.5)
        notifier.stop()
        return problems, calls

    problems, calls = asyncio.run(run())
    assert [type(problem) for problem in problems] == [can.CanOperationError]
    assert calls < 10


def test_a_reader_also_gets_the_end_that_a_sender_has_found(server):
    bus, connection = play_handshake(server)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()

    def send_on() -> None:
        for _ in range(100):
            bus.send(can.Message())
            time.sleep(0.001)

    with pytest.raises(can.CanOperationError):
        send_on()
    assert select.select([bus], [], [], 60)[0]
    with pytest.raises(can.CanOperationError):
        bus.recv(0)
    assert not select.select([bus], [], [], 0.05)[0]
    bus.shutdown()


def test_shutdown_wakes_a_reader_in_another_thread(bus):
    ends = []

    def read():
        try:
            bus.recv(None)
        except can.CanOperationError as error:
            ends.append(str(error))

    thread = threading.Thread(target=read)
    thread.start()
    time.sleep(0.05)
    bus.shutdown()
    thread.join(60)
    assert not thread.is_alive()
    assert "shut down" in ends[0]


# --- servers that fail ---


def test_a_hub_that_appears_late_is_waited_for(start_hub):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    bench = start_hub()
    threading.Timer(0.3, lambda: bench.do(lambda: bench.hub.listen(port=port))).start()
    with plugin.RollerrigBus(f"127.0.0.1:{port}/rig0", connect_timeout=60.0) as bus:
        bus.send(can.Message(arbitration_id=1, is_extended_id=False))
        assert bench.until(lambda: bench.log)


def test_without_a_hub_the_error_names_the_address_and_the_command_to_start():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(can.CanInitializationError, match=f"127.0.0.1:{port}.*rollerrig run"):
        plugin.RollerrigBus(f"127.0.0.1:{port}/rig0", connect_timeout=0.1)


def test_a_wrong_bus_name_is_refused_with_the_name_of_the_hubs_bus(bench):
    with pytest.raises(can.CanInitializationError, match="rig0"):
        plugin.RollerrigBus(f"127.0.0.1:{bench.port}/rig7")


@pytest.mark.parametrize(
    "channel",
    [
        "",
        "rig0",
        "127.0.0.1/rig0",
        "127.0.0.1:29536",
        "h:99999/r",
        "h:x/rig0",
        ":29536/rig0",
        "127.0.0.1:29536/",
    ],
)
def test_a_wrong_address_shows_a_right_one(channel):
    with pytest.raises(can.CanInitializationError, match=r"socketcand://127\.0\.0\.1:29536/rig0"):
        plugin.RollerrigBus(channel)


def test_a_server_of_something_else_is_refused(server):
    with pytest.raises(can.CanInitializationError, match="is it a CAN hub"):
        play_handshake(server, [b"HTTP/1.1 400 Bad Request\r\n\r\n<html>"])


def test_a_handshake_in_one_piece_or_in_many_is_understood(server):
    for chunks in (
        [b"< hi >\n< ok >< ok >< frame 001 0.0 >"],
        [b"< h", b"i >< o", b"k ><", b" ok >< frame 001", b" 0.0 >"],
    ):
        bus, connection = play_handshake(server, chunks)
        assert bus.recv(60).arbitration_id == 1
        bus.shutdown()
        connection.close()


def test_errors_and_nonsense_of_the_server_are_skipped(server):
    bus, connection = play_handshake(server)
    connection.sendall(
        b"< error unknown command >< frame >< frame zz 1.0 00 ><frame 1 1.0 0>"
        b"< frame 123 x.0 00 >>>><< frame 7FF 2.5 00 11 >"
    )
    message = bus.recv(60)
    assert (message.arbitration_id, bytes(message.data)) == (0x7FF, b"\x00\x11")
    bus.shutdown()
    connection.close()


def test_a_full_connection_times_out_and_cuts_no_frame_in_half(server):
    bus, connection = play_handshake(server)
    accepted = 0

    def fill() -> None:
        nonlocal accepted
        while accepted < 1_000_000:
            data = struct.pack("<I", accepted)
            bus.send(can.Message(arbitration_id=1, data=data), timeout=0.05)
            accepted += 1

    with pytest.raises(can.CanTimeoutError, match="does not read"):
        fill()
    received = b""

    def drain():
        nonlocal received
        while chunk := connection.recv(1 << 16):
            received += chunk

    thread = threading.Thread(target=drain)
    thread.start()
    bus.send(can.Message(arbitration_id=2))
    bus.shutdown()
    thread.join(60)
    commands = received.split(b">")[2:-1]  # after open and rawmode
    assert len(commands) == accepted + 1
    assert all(command.startswith(b"< send 0000000") for command in commands)
    sent = [bytes(int(word, 16) for word in command.split()[4:]) for command in commands[:-1]]
    assert sent == [struct.pack("<I", number) for number in range(accepted)]
    connection.close()
