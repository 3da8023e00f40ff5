"""The bench on a CAN interface of the kernel. `make kernel-can` runs this in a guest that has `vcan0`."""

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
    "vcan0" not in available().up, reason="no vcan0 here: make kernel-can"
)
RUN = [sys.executable, "-m", "rollerrig.realtime.cli", "run", "velim_a1", "--pacing", "lockstep"]


def ip(*words: str) -> int:
    return subprocess.run(["ip", *words], capture_output=True).returncode


@pytest.fixture
def channel():
    """An interface of this test's own."""
    name = f"vcan{os.getpid() % 10_000}"
    if ip("link", "add", "dev", name, "type", "vcan"):
        pytest.skip("interfaces can only be made by root")
    ip("link", "set", name, "up")
    yield name
    ip("link", "del", name)


def sender(channel: str) -> socket.socket:
    """A raw socket: 16 bytes are a frame, as linux/can.h has it."""
    raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    raw.bind((channel,))
    return raw


def raw_frame(can_id: int, data: bytes = b"") -> bytes:
    return struct.pack("=IB3x8s", can_id, len(data), data.ljust(8, b"\0"))


def test_an_interface_that_is_set_down_at_any_moment_ends_the_bus(channel):
    """The kernel tells one caller once: sender or reader, whoever comes first."""
    dice = random.Random(1)

    async def run(n: int) -> None:
        lost: list[BusError] = []
        hub = await open_hub(f"socketcan:{channel}", time.monotonic_ns, on_lost=lost.append)
        node = hub.attach(lambda frame: None)
        other = sender(channel)
        down = asyncio.create_task(asyncio.to_thread(_down_up, channel, dice.uniform(0.0, 0.03)))
        end_s = time.monotonic() + 5.0
        while not lost and time.monotonic() < end_s:
            node.send(Frame(0x181, bytes(8)))
            with contextlib.suppress(OSError):
                other.send(raw_frame(0x201))
            await asyncio.sleep(0.001)
        await down
        other.close()
        await hub.close()
        assert len(lost) == 1, n

    for n in range(10):
        asyncio.run(run(n))


def _down_up(channel: str, after_s: float) -> None:
    time.sleep(after_s)
    ip("link", "set", channel, "down")
    ip("link", "set", channel, "up")


@pytest.mark.parametrize("sent", [3000, 30_000])
def test_every_frame_of_a_flood_is_seen_or_counted_as_lost(channel, sent):
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
        end_s = time.monotonic() + 60.0
        while seen + hub.dropped < sent and time.monotonic() < end_s:
            await asyncio.sleep(0.01)
        dropped = hub.dropped
        await hub.close()
        return seen, dropped

    seen, dropped = asyncio.run(run())
    assert seen + dropped == sent
    assert seen >= 3000  # the kernel's own choice of buffer holds 278


def test_a_frame_has_the_time_at_which_the_kernel_took_it(channel):
    async def run() -> float:
        hub = await open_hub(f"socketcan:{channel}", time.monotonic_ns, kernel_time=True)
        seen: list[Frame] = []
        hub.tap(seen.append)
        with sender(channel) as other:
            before_ns = time.monotonic_ns()
            other.send(raw_frame(0x201))
            after_ns = time.monotonic_ns()
        time.sleep(0.2)  # the event loop stands
        while not seen:
            await asyncio.sleep(0.001)
        await hub.close()
        assert before_ns - 5_000_000 < seen[0].time_ns < after_ns + 5_000_000

    asyncio.run(run())


def test_a_controllers_errors_are_events_and_bus_off_ends_the_bus(channel):
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
                (0x04, bytes((0, 0x20)) + bytes(6)),
                (0x20, bytes(8)),
                (0x40, bytes(8)),
            ):
                assert not lost
                other.send(raw_frame(0x2000_0000 | kind, data))
                await asyncio.sleep(0.2)
        await hub.close()
        assert [(frame.can_id, frame.error) for frame in seen] == [
            (0x04, True),
            (0x20, True),
            (0x40, True),
        ]

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
    """Hardware queues ten by default; here a slow one, which takes a frame in about 0.3 ms."""
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
            for n in range(200):
                node.send(Frame(0x181, struct.pack("<I", n)))
            numbers = []
            while len(numbers) < 200 and (message := await asyncio.to_thread(far.recv, 5.0)):
                numbers.append(struct.unpack("<I", message.data)[0])
        assert numbers == list(range(200))
        assert hub.dropped == 0
        await hub.close()

    asyncio.run(run())


def test_a_second_bench_on_an_interface_is_refused_until_the_first_has_gone(channel):
    async def run() -> None:
        first = await open_hub(f"socketcan:{channel}", time.monotonic_ns)
        with pytest.raises(BusError, match="another bench is on"):
            await open_hub(f"socketcan:{channel}", time.monotonic_ns)
        await first.close()
        await (await open_hub(f"socketcan:{channel}", time.monotonic_ns)).close()

    asyncio.run(run())


def test_a_run_is_refused_where_one_of_its_nodes_speaks_already(channel, tmp_path):
    beat = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import socket,sys,time\n"
            "s = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)\n"
            f"s.bind(({channel!r},))\n"
            "while True: s.send(bytes.fromhex('11070000010000000500000000000000')); time.sleep(0.1)",
        ]
    )
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
        beat.kill()
        beat.wait()
    assert done.returncode != 0
    assert "a node 17 sends there already (711h)" in done.stderr


@pytest.mark.conformance("Hub", "nodes on kernel SocketCAN")
def test_a_lockstep_run_on_vcan0_is_the_one_on_the_hub_to_the_byte_and_lets_socketcand_in(tmp_path):
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
        assert done.returncode == 4, done.stderr  # it does not stop in that time
        logs.append((out / "can.log").read_bytes())
    assert logs[0] == logs[1]
    assert len(logs[0].splitlines()) > 1000
    events = json.loads((tmp_path / "kernel" / "summary.json").read_text())["events"]
    places = [one["fields"]["address"] for one in events if one["code"] == Code.BUS_PLACE]
    assert places == ["socketcan:vcan0"]
    ports = [one["fields"] for one in events if one["code"] == Code.BUS_PORT]
    assert any(port["protocol"] == "socketcand" for port in ports)


def test_a_harness_drives_a_lockstep_run_on_vcan0(tmp_path):
    said = ""
    bench = subprocess.Popen(
        [*RUN, "--harness", "--set", "bus.socketcand_port=0", "--out", str(tmp_path / "run")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        said = next(line for line in bench.stdout if "waiting for a harness" in line)
        with harness.connect("socketcan:vcan0", ends=True) as rig:
            rig.brake(bar=1.0)
            rig.wait(0.3)
            assert rig.lockstep
            assert all(pressure_Pa > 0.0 for pressure_Pa in rig.axles("cylinder_pressure"))
    finally:
        said += bench.communicate(timeout=240)[0]
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["ended"] == "finished", said
