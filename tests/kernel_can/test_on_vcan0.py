"""The bench on a CAN interface of the kernel.

`make kernel-can` runs these tests in a guest that has `vcan0`.
"""

import asyncio
import contextlib
import json
import os
import random
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import can
import pyroute2
import pytest

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface import harness
from rollerrig.wsp_interface.bus.buses import open_client, open_hub
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.kernel import available
from rollerrig.wsp_interface.events import Code

pytestmark = pytest.mark.skipif(
    "vcan0" not in available().up, reason="this machine has no vcan0; run: make kernel-can"
)

# classes of error frames, from linux/can/error.h
ERROR_FRAME = 0x2000_0000
CONTROLLER = 0x04
NO_ACKNOWLEDGE = 0x20
BUS_OFF = 0x40
ERROR_PASSIVE = 0x20  # byte 1 of the data of CONTROLLER

# the unit of the README, which joins socketcand://127.0.0.1:29536/rig0
UNIT = str(Path(__file__).parents[2] / "docs" / "examples" / "wsp_unit.py")
RUN = [sys.executable, "-m", "rollerrig.realtime.cli", "run", "velim_a1", "--pacing", "lockstep"]


# a program that sends heartbeats of node 17 (711h, OPERATIONAL) on an interface
HEARTBEATS_OF_NODE_17 = """
import socket, sys, time
raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
raw.bind((sys.argv[1],))
while True:
    raw.send(bytes.fromhex("11070000010000000500000000000000"))
    time.sleep(0.1)
"""


def ip(*words: str) -> int:
    """Run `ip`; return its exit status."""
    return subprocess.run(["ip", *words], capture_output=True).returncode


@pytest.fixture
def channel():
    """The name of a new interface, only for this test."""
    name = f"vcan{os.getpid() % 10_000}"
    if ip("link", "add", "dev", name, "type", "vcan"):
        pytest.skip("only root can make interfaces")
    ip("link", "set", name, "up")
    yield name
    ip("link", "del", name)


def sender(channel: str) -> socket.socket:
    """Return a raw socket on an interface. A frame is 16 bytes, as in linux/can.h."""
    raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    raw.bind((channel,))
    return raw


def raw_frame(can_id: int, data: bytes = b"") -> bytes:
    return struct.pack("=IB3x8s", can_id, len(data), data.ljust(8, b"\0"))


def test_an_interface_that_is_set_down_at_any_moment_closes_the_bus(channel):
    """The kernel reports it once, to the first caller, which may be the sender or the reader."""
    source = random.Random(1)

    async def run(number: int) -> None:
        lost: list[BusError] = []
        hub = await open_hub(f"socketcan:{channel}", time.monotonic_ns, on_lost=lost.append)
        node = hub.attach(lambda frame: None)
        other = sender(channel)
        delay_s = source.uniform(0.0, 0.03)
        down = asyncio.create_task(asyncio.to_thread(_down_up, channel, delay_s))
        end_s = time.monotonic() + 5.0
        while not lost and time.monotonic() < end_s:
            node.send(Frame(0x181, bytes(8)))
            with contextlib.suppress(OSError):
                other.send(raw_frame(0x201))
            await asyncio.sleep(0.001)
        await down
        other.close()
        await hub.close()
        assert len(lost) == 1, number

    for number in range(10):
        asyncio.run(run(number))


def _down_up(channel: str, after_s: float) -> None:
    """Set an interface down, and up again, after a while."""
    time.sleep(after_s)
    ip("link", "set", channel, "down")
    ip("link", "set", channel, "up")


def lost_before_any_socket() -> int:
    """Return how many packets of all interfaces this kernel has dropped from its backlog.

    On a busy machine the kernel delivers later than a program sends, and its backlog overflows.
    """
    lines = Path("/proc/net/softnet_stat").read_text().splitlines()
    return sum(int(line.split()[1], 16) for line in lines)


@pytest.mark.parametrize("sent", [3000, 30_000])
def test_every_frame_of_a_flood_is_seen_or_counted_as_lost(channel, sent):
    lost_before = lost_before_any_socket()

    async def run() -> tuple[int, int]:
        hub = await open_hub(f"socketcan:{channel}", time.monotonic_ns)
        seen = 0

        def count(frame: Frame) -> None:
            nonlocal seen
            seen += 1

        hub.attach(count)
        with sender(channel) as other:
            for _ in range(sent):  # while the bench is not reading
                other.send(raw_frame(0x201, bytes(8)))
        arrived = sent - (lost_before_any_socket() - lost_before)
        end_s = time.monotonic() + 60.0
        while seen + hub.dropped < arrived and time.monotonic() < end_s:
            await asyncio.sleep(0.01)
        dropped = hub.dropped
        await hub.close()
        return seen, dropped

    seen, dropped = asyncio.run(run())
    assert seen + dropped == sent - (lost_before_any_socket() - lost_before)
    # the default buffer of the kernel holds 278; what reaches the socket is at least its backlog of
    # 1000
    assert seen >= 900


def test_a_frame_has_the_time_at_which_the_kernel_took_it(channel):
    async def run() -> None:
        hub = await open_hub(f"socketcan:{channel}", time.monotonic_ns, kernel_time=True)
        seen: list[Frame] = []
        hub.tap(seen.append)
        with sender(channel) as other:
            before_ns = time.monotonic_ns()
            other.send(raw_frame(0x201))
            after_ns = time.monotonic_ns()
        time.sleep(0.2)  # blocks the event loop
        while not seen:
            await asyncio.sleep(0.001)
        await hub.close()
        assert before_ns - 5_000_000 < seen[0].time_ns < after_ns + 5_000_000

    asyncio.run(run())


def test_errors_of_a_controller_are_events_and_bus_off_closes_the_bus(channel):
    seen_events: list[tuple[Code, dict[str, object]]] = []
    lost: list[BusError] = []

    async def run() -> None:
        hub = await open_hub(
            f"socketcan:{channel}",
            time.monotonic_ns,
            on_lost=lost.append,
            on_event=lambda code, **fields: seen_events.append((code, fields)),
        )
        seen: list[Frame] = []
        hub.tap(seen.append)
        with sender(channel) as other:
            for kind, data in (
                (CONTROLLER, bytes((0, ERROR_PASSIVE)) + bytes(6)),
                (NO_ACKNOWLEDGE, bytes(8)),
                (BUS_OFF, bytes(8)),
            ):
                assert not lost
                other.send(raw_frame(ERROR_FRAME | kind, data))
                await asyncio.sleep(0.2)
        await hub.close()
        assert [frame.can_id for frame in seen] == [CONTROLLER, NO_ACKNOWLEDGE, BUS_OFF]
        assert all(frame.error for frame in seen)

    asyncio.run(run())
    assert [code for code, _ in seen_events[:2]] == [Code.BUS_CONTROLLER] * 2
    assert "error-passive" in seen_events[0][1]["condition"]
    assert "no node acknowledges" in seen_events[1][1]["condition"]
    assert "bus-off" in str(lost[0])


def test_can_fd_frames_are_counted(channel):
    seen_events: list[tuple[Code, dict[str, object]]] = []

    async def run() -> int:
        hub = await open_hub(
            f"socketcan:{channel}",
            time.monotonic_ns,
            on_event=lambda code, **fields: seen_events.append((code, fields)),
        )
        with can.Bus(interface="socketcan", channel=channel, fd=True) as other:
            for _ in range(3):
                other.send(
                    can.Message(arbitration_id=1, data=bytes(32), is_fd=True, is_extended_id=False)
                )
        await asyncio.sleep(0.3)
        dropped = hub.dropped
        await hub.close()
        return dropped

    assert asyncio.run(run()) == 3
    assert [code for code, _ in seen_events] == [Code.BUS_FRAMES_LOST]
    assert "CAN FD" in seen_events[0][1]["reason"]


def test_a_queue_of_ten_frames_loses_nothing_of_a_burst(channel):
    """The queue of hardware has ten frames by default. This one takes a frame in about 0.3 ms."""
    with pyroute2.IPRoute() as kernel:
        # limits in bytes; a frame counts 16
        kernel.tc(
            "add",
            "tbf",
            socket.if_nametoindex(channel),
            0x10000,
            rate="400kbit",
            burst=200,
            limit=320,
        )

    async def run() -> int:
        hub = await open_hub(f"socketcan:{channel}", time.monotonic_ns)
        node = hub.attach(lambda frame: None)
        with open_client(f"socketcan:{channel}") as far:
            for number in range(200):
                node.send(Frame(0x181, struct.pack("<I", number)))
            numbers = []
            while len(numbers) < 200:
                message = await asyncio.to_thread(far.recv, 5.0)
                if message is None:
                    break
                numbers.append(struct.unpack("<I", message.data)[0])
        assert numbers == list(range(200))
        assert hub.dropped == 0
        await hub.close()

    asyncio.run(run())


def test_a_second_bench_on_an_interface_is_refused_until_the_first_is_closed(channel):
    async def run() -> None:
        first = await open_hub(f"socketcan:{channel}", time.monotonic_ns)
        with pytest.raises(BusError, match="another bench is on"):
            await open_hub(f"socketcan:{channel}", time.monotonic_ns)
        await first.close()
        second = await open_hub(f"socketcan:{channel}", time.monotonic_ns)
        await second.close()

    asyncio.run(run())


def test_a_run_is_refused_if_one_of_its_nodes_sends_already(channel, tmp_path):
    node_17 = subprocess.Popen([sys.executable, "-c", HEARTBEATS_OF_NODE_17, channel])
    try:
        done = subprocess.run(
            [
                *RUN,
                "--set",
                f"bus.interface=socketcan:{channel}",
                "--set",
                "duration_max_s=0.1",
                "--out",
                str(tmp_path / "run"),
            ],
            capture_output=True,
            text=True,
        )
    finally:
        node_17.kill()
        node_17.wait()
    assert done.returncode != 0
    assert "a node 17 sends there already (711h)" in done.stderr


@pytest.mark.conformance("Hub", "nodes on kernel SocketCAN")
def test_a_lockstep_run_on_vcan0_equals_that_on_the_hub_and_has_a_socketcand_port(tmp_path):
    logs = []
    for name, more in (("hub", ["--set", "bus.interface=hub"]), ("kernel", [])):
        out = tmp_path / name
        done = subprocess.run(
            [
                *RUN,
                *more,
                "--set",
                "duration_max_s=1",
                "--set",
                "bus.socketcand_port=0",
                "--out",
                str(out),
            ],
            capture_output=True,
            text=True,
        )
        # not valid: the vehicle does not stop in that time
        assert done.returncode == 4, done.stderr
        logs.append((out / "can.log").read_bytes())
    assert logs[0] == logs[1]
    assert len(logs[0].splitlines()) > 1000
    events = json.loads((tmp_path / "kernel" / "summary.json").read_text())["events"]
    addresses = []
    protocols = []
    for event in events:
        if event["code"] == Code.BUS_PLACE:
            addresses.append(event["fields"]["address"])
        elif event["code"] == Code.BUS_PORT:
            protocols.append(event["fields"]["protocol"])
    assert addresses == ["socketcan:vcan0"]
    assert "socketcand" in protocols


@pytest.mark.conformance("Hub", "on vcan0 a unit joins by the address of the README as well")
def test_the_example_of_the_readme_works_where_vcan0_is_up(tmp_path):
    output = ""
    bench = subprocess.Popen(
        [
            *RUN,
            "--wsp",
            "external",
            "--set",
            "duration_max_s=1",
            "--out",
            str(tmp_path / "run"),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    unit = None
    try:
        output = next(line for line in bench.stdout if "waiting for a WSP unit" in line)
        assert "socketcan:vcan0" in output
        unit = subprocess.Popen([sys.executable, UNIT])
    finally:
        rest, _ = bench.communicate(timeout=240)
        output += rest
        if unit is not None:
            unit.wait(60)
    # not valid: the vehicle does not stop in that time
    assert bench.returncode == 4, output
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["ended"] == "finished", output
    assert summary["bus"]["frames"] > 1000


def test_a_harness_drives_a_lockstep_run_on_vcan0(tmp_path):
    output = ""
    bench = subprocess.Popen(
        [*RUN, "--harness", "--set", "bus.socketcand_port=0", "--out", str(tmp_path / "run")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        output = next(line for line in bench.stdout if "waiting for a harness" in line)
        with harness.connect("socketcan:vcan0", ends=True) as rig:
            rig.brake(bar=1.0)
            rig.wait(0.3)
            assert rig.lockstep
            assert all(pressure_Pa > 0.0 for pressure_Pa in rig.axles("cylinder_pressure"))
    finally:
        rest, _ = bench.communicate(timeout=240)
        output += rest
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["ended"] == "finished", output
