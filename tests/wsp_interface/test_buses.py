"""Buses opened from addresses, and the bench's nodes on a python-can bus, over real sockets."""

import os
import socket
import struct
import time
import types

import can
import pytest

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface.bus import kernel, plugin
from rollerrig.wsp_interface.bus.buses import open_client, open_hub
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.kernel import KernelCan, available


@pytest.fixture
def other(bench):
    """A second hub in the same event loop, joined to the first one over TCP by the plugin.

    Its nodes are on a python-can bus with a descriptor, as on kernel SocketCAN.
    """
    joined = types.SimpleNamespace(lost=[])
    joined.hub = bench.do(
        lambda: open_hub(
            f"rollerrig:{bench.address()}", time.monotonic_ns, on_lost=joined.lost.append
        )
    )
    yield joined
    if bench.loop.is_running():
        bench.do(joined.hub.close)


def data_of(number: int) -> bytes:
    return struct.pack("<I", number)


# --- nodes on a python-can bus ---


@pytest.mark.conformance("Hub", "nodes on a python-can bus")
def test_nodes_on_a_python_can_bus_talk_to_it_and_to_each_other_in_order(bench, other):
    here = []
    there = []
    node = bench.do(lambda: other.hub.attach(lambda frame: None))
    bench.do(lambda: other.hub.attach(lambda frame: here.append((frame.can_id, frame.data))))
    far = bench.node(lambda frame: there.append((frame.can_id, frame.data)))
    for start in range(0, 1000, 100):
        numbers = range(start, start + 100)
        bench.send(node, *(Frame(0x181, data_of(number)) for number in numbers))
        bench.send(far, *(Frame(0x201, data_of(number)) for number in numbers))
    assert bench.until(lambda: len(here) == 2000 and len(there) == 1000)
    assert [pair for pair in here if pair[0] == 0x181] == there
    assert there == [(0x181, data_of(n)) for n in range(1000)]
    assert [pair for pair in here if pair[0] == 0x201] == [(0x201, data_of(n)) for n in range(1000)]
    assert other.hub.stats()["frames"] == 2000
    assert other.hub.dropped == 0


@pytest.mark.parametrize("frame", [Frame(0x12, b"", True), Frame(0x701, b"", remote=True, dlc=1)])
def test_every_kind_of_frame_passes_and_gets_the_time_stamp_of_the_bench(bench, other, frame):
    seen = []
    bench.do(lambda: other.hub.tap(seen.append))
    bench.send(bench.node(), frame)
    assert bench.until(lambda: seen)
    assert seen[0]._replace(time_ns=0) == frame
    assert abs(seen[0].time_ns - time.monotonic_ns()) < 5_000_000_000


def test_programs_may_join_a_hub_on_a_python_can_bus(bench, other):
    port = bench.do(lambda: other.hub.listen("socketcand", port=0))
    with plugin.RollerrigBus(f"127.0.0.1:{port}/rig0") as client:
        client.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        assert bench.until(lambda: bench.log)
        bench.send(bench.node(), Frame(0x321, b""))
        assert client.recv(60).arbitration_id == 0x321


def test_the_loss_of_the_python_can_bus_is_reported_once_and_its_nodes_frames_are_counted(
    bench, other
):
    node = bench.do(lambda: other.hub.attach(print))
    bench.do(bench.hub.close)
    assert bench.until(lambda: other.lost)
    assert "closed" in str(other.lost[0])
    bench.send(node, Frame(1, b""))
    time.sleep(0.05)
    assert len(other.lost) == 1
    assert bench.problems == []


def test_closing_the_hub_shuts_the_python_can_bus(bench, other):
    assert len(bench.hub.stats()["clients"]) == 1
    bench.do(other.hub.close)
    assert bench.until(lambda: not bench.hub.stats()["clients"])
    assert other.lost == []


def test_an_interface_without_a_descriptor_is_read_in_a_thread(bench):
    channel = f"buses-{os.getpid()}-{time.monotonic_ns()}"
    seen = []
    far = can.Bus(interface="virtual", channel=channel)
    hub = bench.do(lambda: open_hub(f"virtual:{channel}", time.monotonic_ns))
    node = bench.do(lambda: hub.attach(seen.append))
    for number in range(200):
        far.send(can.Message(arbitration_id=1, data=data_of(number), is_extended_id=False))
    assert bench.until(lambda: len(seen) == 200)
    assert [frame.data for frame in seen] == [data_of(number) for number in range(200)]
    bench.send(node, Frame(2, b"\x05"))
    assert far.recv(5).arbitration_id == 2
    assert far.recv(0.05) is None
    bench.do(hub.close)
    far.shutdown()


def test_a_hub_on_an_interface_answers_to_the_usual_name_as_well_as_to_that_of_the_interface(bench):
    channel = f"buses-{os.getpid()}-{time.monotonic_ns()}"
    far = can.Bus(interface="virtual", channel=channel)
    hub = bench.do(lambda: open_hub(f"virtual:{channel}", time.monotonic_ns))
    port = bench.do(lambda: hub.listen("socketcand", port=0))
    for name in ("rig0", channel):
        with plugin.RollerrigBus(f"127.0.0.1:{port}/{name}") as client:
            client.send(can.Message(arbitration_id=0x720, is_extended_id=False))
            assert far.recv(60).arbitration_id == 0x720
    with pytest.raises(can.CanInitializationError, match=f"this hub carries {channel}, rig0"):
        plugin.RollerrigBus(f"127.0.0.1:{port}/other")
    bench.do(hub.close)
    far.shutdown()


# --- addresses ---


def test_the_bench_and_a_program_open_the_same_address(bench):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    address = f"socketcand://127.0.0.1:{port}/rig0"
    hub = bench.do(lambda: open_hub(address, time.monotonic_ns, bitrate=250_000))
    assert hub.load.bitrate == 250_000
    seen = []
    bench.do(lambda: hub.attach(seen.append))
    with open_client(address) as client:
        client.send(can.Message(arbitration_id=0x720, is_extended_id=False))
        assert bench.until(lambda: seen)
    with pytest.raises(BusError, match=f"port is already in use.*{port}"):
        bench.do(lambda: open_hub(address, time.monotonic_ns))
    bench.do(hub.close)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("", "allowed are socketcand://"),
        ("rig0", "allowed are socketcand://"),
        ("socketcan:", "allowed are socketcand://"),
        ("telepathy:can0", "unknown interface 'telepathy'; allowed: .*socketcan"),
        ("socketcand://127.0.0.1/rig0", "allowed is socketcand://HOST:PORT/BUS"),
        ("socketcan:nosuchcan", "'socketcan:nosuchcan'.*socketcand://127.0.0.1:29536/rig0"),
        ("slcan:/dev/nosuchtty", "'slcan:/dev/nosuchtty'"),
    ],
)
def test_an_address_that_cannot_be_opened_is_refused_with_the_allowed_ones(bench, address, message):
    with pytest.raises(BusError, match=message):
        open_client(address, connect_timeout_s=0.1)
    with pytest.raises(BusError, match=message):
        bench.do(lambda: open_hub(address, time.monotonic_ns))


def test_a_program_without_a_bench_gets_the_command_that_starts_it():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(BusError, match=f"no CAN hub at 127.0.0.1:{port}.*rollerrig run"):
        open_client(f"socketcand://127.0.0.1:{port}/rig0", connect_timeout_s=0.1)


# --- CAN interfaces of the machine ---


def write_interface(root, name: str, kind: int, flags: int) -> None:
    (root / name).mkdir()
    (root / name / "type").write_text(f"{kind}\n")
    (root / name / "flags").write_text(f"{flags:#x}\n")


def test_can_interfaces_are_distinguished_from_others_and_those_down_get_a_hint(tmp_path):
    for name, kind, flags in (
        ("lo", 772, 0x9),
        ("vcan0", 280, 0xC1),
        ("can1", 280, 0x80),
        ("vcan2", 280, 0x80),
    ):
        write_interface(tmp_path, name, kind, flags)
    interfaces = available(tmp_path)
    assert interfaces.up == ("vcan0",)
    assert interfaces.down == ("can1", "vcan2")
    assert any("ip link set can1 up type can bitrate 500000" in hint for hint in interfaces.hints)
    assert any(hint.endswith("ip link set vcan2 up") for hint in interfaces.hints)


def test_everything_that_is_missing_on_this_machine_has_a_hint(tmp_path):
    interfaces = available()
    if interfaces.af_can and interfaces.up and not interfaces.down:
        assert interfaces.hints == ()
    else:
        assert any("sudo" in hint for hint in interfaces.hints)
    assert available(tmp_path).up == ()


@pytest.mark.parametrize(
    ("name", "interfaces", "message"),
    [
        ("vcan0", KernelCan(False, (), (), ()), "no SocketCAN: sudo modprobe"),
        (
            "vcan0",
            KernelCan(True, ("vcan1",), (), ()),
            "vcan0 is absent; allowed here: vcan1.*add vcan0 type vcan",
        ),
        (
            "can7",
            KernelCan(True, ("vcan1",), (), ()),
            "can7 is absent; .*adapter.*sudo ip link set can7 up",
        ),
        (
            "vcan0",
            KernelCan(True, (), ("vcan0",), ()),
            "vcan0 is down; allowed here: none; to fix this: sudo ip link set vcan0 up",
        ),
    ],
)
def test_a_missing_interface_is_refused_with_the_commands_to_get_it(name, interfaces, message):
    with pytest.raises(BusError, match=message):
        kernel.require(f"socketcan:{name}", name, "", interfaces)


def test_an_interface_that_queues_too_few_frames_for_a_syncs_burst_has_a_hint(tmp_path):
    write_interface(tmp_path, "can0", 280, 0xC1)
    (tmp_path / "can0" / "tx_queue_len").write_text("10\n")
    assert any(
        "sudo ip link set can0 txqueuelen 1000" in hint for hint in available(tmp_path).hints
    )
