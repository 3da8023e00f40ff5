"""The reference WSP unit on a bus: what it says, in which order, and how it starts and ends."""

import asyncio
import itertools
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import numpy as np
import pytest

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim.cia301.nmt import Command, State
from rollerrig.firmware_sim.wsp import logic
from rollerrig.firmware_sim.wsp import node as wsp_unit
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub

SYNC, SPEEDS, PRESSURES = 0x080, 0x190, 0x191
HEARTBEAT, REFERENCE, MAGNETS = 0x720, 0x1A0, 0x211
EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
CHANNELS = itertools.count()


def speeds(*omega_rad_s):
    """The payload of node 16's TPDO1."""
    return struct.pack("<4h", *(round(100.0 * omega) for omega in omega_rad_s))


RUNNING = speeds(67.4, 67.4, 67.4, 67.4)
LOCKED = speeds(0.0, 67.4, 67.4, 67.4)


class Bench:
    """The other end of a virtual bus, and the unit in a thread of its own."""

    def __init__(self, channel, lockstep_s=0.0):
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.unit_bus = can.Bus(interface="virtual", channel=channel)
        self.unit = wsp_unit.Unit(self.unit_bus, wsp_unit.Reference(logic.load()), lockstep_s)
        self.thread = threading.Thread(target=self.unit.run, daemon=True)
        self.thread.start()

    def send(self, can_id, data=b""):
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def heard(self, until=None, timeout_s=60.0):
        """Frames (identifier, data) up to one with identifier `until`, or until time is over."""
        frames, end_s = [], time.monotonic() + timeout_s
        while (rest_s := end_s - time.monotonic()) > 0.0:
            message = self.bus.recv(rest_s)
            if message is not None:
                frames.append((message.arbitration_id, bytes(message.data)))
                if message.arbitration_id == until:
                    break
        return frames

    def cycle(self, data=RUNNING):
        """One SYNC with everything that node 16 and 17 say; the frames of the answer."""
        self.send(SYNC)
        self.send(SPEEDS, data)
        self.send(PRESSURES, bytes(8))
        return self.heard(MAGNETS)

    def command(self, command, node=32):
        self.send(0x000, bytes((command, node)))


@pytest.fixture
def bench():
    bench = Bench(f"wsp-unit-{os.getpid()}-{next(CHANNELS)}")
    assert bench.heard(HEARTBEAT) == [(HEARTBEAT, bytes((State.INITIALISING,)))]
    assert bench.heard(HEARTBEAT) == [(HEARTBEAT, bytes((State.OPERATIONAL,)))]
    yield bench
    bench.unit.stop()
    bench.thread.join(60.0)
    bench.bus.shutdown()
    bench.unit_bus.shutdown()


def ids(frames):
    return [can_id for can_id, _ in frames]


def test_every_sync_is_answered_once_with_the_reference_speed_before_the_magnets(bench):
    for i in range(1, 21):
        beat = [HEARTBEAT] if i % 5 == 0 else []
        assert ids(bench.cycle()) == [*beat, REFERENCE, MAGNETS]
    bench.send(SPEEDS, RUNNING)  # nobody asked
    assert bench.heard(timeout_s=0.05) == []


def test_the_heartbeat_of_every_fifth_sync_goes_out_before_the_answer(bench):
    frames = [frame for _ in range(25) for frame in bench.cycle()]
    beats = [i for i, frame in enumerate(frames) if frame == (HEARTBEAT, b"\x05")]
    assert len(beats) == 5
    assert all(frames[i + 2][0] == MAGNETS for i in beats)


def test_it_waits_for_the_speeds_of_this_sync(bench):
    bench.send(SPEEDS, LOCKED)
    bench.send(SYNC)
    assert MAGNETS not in ids(bench.heard(timeout_s=0.05))
    bench.send(SPEEDS, RUNNING)
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, b"\x00")


def test_over_the_bus_it_decides_bit_for_bit_as_in_the_compiled_loop(bench):
    generator = np.random.default_rng(7)
    rows = np.round(6740.0 - np.cumsum(generator.uniform(0.0, 25.0, (400, 4)), axis=0)).astype(int)
    unit = logic.new_unit(logic.load())
    seen = []
    for row in rows:
        magnets, reference = logic.cycle(unit, row)
        said = dict(bench.cycle(struct.pack("<4h", *row)))
        assert said[MAGNETS] == bytes((magnets,))
        assert said[REFERENCE] == struct.pack("<h", reference)
        seen.append(magnets)
    assert len(set(seen)) > 3


def test_while_no_sync_comes_it_still_heartbeats(bench):
    beats = [bench.bus.recv(60.0) for _ in range(6)]
    assert {(beat.arbitration_id, bytes(beat.data)) for beat in beats} == {(HEARTBEAT, b"\x05")}
    assert np.median(np.diff([beat.timestamp for beat in beats])) > 0.05


def test_other_traffic_does_not_keep_it_from_heartbeating(bench):
    beats, end_s = 0, time.monotonic() + 60.0
    while beats < 3 and time.monotonic() < end_s:
        bench.send(0x701, b"\x05")
        beats += ids(bench.heard(timeout_s=0.02)).count(HEARTBEAT)
    assert beats == 3


def test_stopped_by_the_master_it_drops_the_magnets_and_is_silent_until_started(bench):
    for _ in range(3):
        bench.cycle(LOCKED)
    assert bench.cycle(LOCKED)[-1] == (MAGNETS, b"\x03")
    bench.command(Command.STOP)
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, b"\x00")
    bench.send(SYNC)
    bench.send(SPEEDS, RUNNING)
    said = bench.heard(HEARTBEAT) + bench.heard(timeout_s=0.05)
    assert set(said) == {(HEARTBEAT, bytes((State.STOPPED,)))}
    bench.command(Command.START, node=0)
    assert ids(bench.cycle())[-2:] == [REFERENCE, MAGNETS]


def test_commands_for_other_nodes_leave_it_alone(bench):
    bench.command(Command.STOP, node=17)
    assert MAGNETS in ids(bench.cycle())


@pytest.mark.parametrize("command", [Command.RESET_NODE, Command.RESET_COMMUNICATION])
def test_a_reset_makes_it_boot_again_with_an_empty_memory(bench, command):
    for _ in range(3):
        bench.cycle(LOCKED)
    bench.command(command)
    said = bench.heard(HEARTBEAT) + bench.heard(HEARTBEAT)
    assert said == [(MAGNETS, b"\x00"), (HEARTBEAT, b"\x00"), (HEARTBEAT, b"\x05")]
    still = speeds(0.0, 0.0, 0.0, 0.0)
    assert bench.cycle(still) == [(REFERENCE, b"\x00\x00"), (MAGNETS, b"\x00")]


def test_without_speeds_it_repeats_the_magnets_five_times_and_then_drops_them(bench):
    for _ in range(3):
        bench.cycle(LOCKED)
    bench.send(SYNC)  # each is answered when the next comes
    answers = []
    for _ in range(9):
        bench.send(SYNC)
        answers.append(bench.heard(MAGNETS)[-1][1])
    assert answers == [b"\x03"] * 5 + [b"\x00"] * 4
    bench.send(SPEEDS, LOCKED)  # speeds are back
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, b"\x03")
    assert bench.cycle(LOCKED)[-1] == (MAGNETS, b"\x03")


def test_a_sync_whose_speeds_never_come_is_answered_by_the_clock_where_no_other_comes(bench):
    bench.cycle()
    bench.send(SYNC)
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, b"\x00")


def test_in_lockstep_it_sends_nothing_by_the_clock_and_answers_without_speeds_at_the_next_sync():
    bench = Bench(f"wsp-unit-{os.getpid()}-{next(CHANNELS)}", lockstep_s=0.01)
    assert bench.heard(HEARTBEAT) + bench.heard(HEARTBEAT) == [
        (HEARTBEAT, b"\x00"),
        (HEARTBEAT, b"\x05"),
    ]
    assert bench.heard(timeout_s=0.5) == []
    bench.cycle()
    bench.send(SYNC)
    assert bench.heard(timeout_s=0.5) == []
    for n in range(3, 8):
        bench.send(SYNC)
        # the heartbeat of the fifth goes out before its answer, and so late with it
        assert ids(bench.heard(MAGNETS)) == ([HEARTBEAT, MAGNETS] if n == 6 else [MAGNETS])
    bench.unit.stop()
    bench.thread.join(60.0)
    assert not bench.thread.is_alive()


def test_speeds_of_a_wrong_length_are_not_speeds(bench):
    bench.send(SYNC)
    bench.send(SPEEDS, bytes(6))
    assert MAGNETS not in ids(bench.heard(timeout_s=0.05))
    bench.send(SPEEDS, RUNNING)
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, b"\x00")


def test_when_it_is_told_to_end_the_magnets_are_off_first(bench):
    for _ in range(3):
        bench.cycle(LOCKED)
    bench.unit.stop()
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, b"\x00")
    bench.thread.join(60.0)
    assert not bench.thread.is_alive()


def test_it_ends_when_the_bus_ends(bench):
    bench.cycle()
    bench.unit_bus.shutdown()
    bench.thread.join(60.0)
    assert not bench.thread.is_alive()


def test_a_bus_that_is_not_there_is_an_error_with_its_address():
    with pytest.raises(BusError, match="nonsense"):
        wsp_unit.main("nonsense:nowhere")


class LockstepBench:
    """A hub with a minimal rig on it: each SYNC waits for the unit's magnets."""

    def __init__(self):
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.frames = []
        self.port = self.do(self._open())

    def do(self, coroutine, timeout_s=60.0):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(timeout_s)

    async def _open(self):
        self.hub = Hub(time.monotonic_ns)
        self.heard = asyncio.Event()
        self.rig = self.hub.attach(self._take, "rig")
        return await self.hub.listen("socketcand", port=0)

    def _take(self, frame):
        self.frames.append((frame.can_id, frame.data))
        self.heard.set()

    async def until(self, count):
        """Wait until so many frames have come from the unit."""
        while len(self.frames) < count:
            self.heard.clear()
            await asyncio.wait_for(self.heard.wait(), 240.0)

    async def until_last(self, frame):
        """Wait until a frame is the last that has come."""
        while self.frames[-1] != frame:
            self.heard.clear()
            await asyncio.wait_for(self.heard.wait(), 60.0)

    async def cycles(self, count):
        """Run SYNC cycles, in the second half of them with a locked wheel; each waits."""
        for i in range(count):
            self.rig.send(Frame(SYNC, b""))
            self.rig.send(Frame(SPEEDS, LOCKED if i > count // 2 else RUNNING))
            self.rig.send(Frame(PRESSURES, bytes(8)))
            while ids(self.frames).count(MAGNETS) <= i:
                self.heard.clear()
                await asyncio.wait_for(self.heard.wait(), 60.0)

    def close(self):
        self.do(self.hub.close())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(60.0)


@pytest.fixture
def lockstep():
    bench = LockstepBench()
    yield bench
    if bench.thread.is_alive():
        bench.close()


@pytest.fixture(scope="module")
def go_unit(tmp_path_factory):
    """The Go example, built."""
    if shutil.which("go") is None:
        pytest.skip("no Go compiler on this machine")
    program = tmp_path_factory.mktemp("go") / "wsp_unit"
    subprocess.run(
        ["go", "build", "-o", program, EXAMPLES / "wsp_unit.go"],
        check=True,
        env={**os.environ, "GOFLAGS": "-mod=mod", "CGO_ENABLED": "0"},
    )
    return str(program)


REFERENCE_UNIT = """
import sys
from rollerrig.firmware_sim.wsp import node
sys.exit(node.main(sys.argv[1]))
"""


def start(kind, port, request):
    """A WSP unit as a program of its own."""
    if kind == "reference":
        return [sys.executable, "-c", REFERENCE_UNIT, f"socketcand://127.0.0.1:{port}/rig0"]
    if kind == "python":
        return [sys.executable, str(EXAMPLES / "wsp_unit.py"), "127.0.0.1", str(port)]
    return [request.getfixturevalue("go_unit"), f"127.0.0.1:{port}"]


@pytest.mark.parametrize("kind", ["reference", "python", "go"])
def test_every_unit_is_a_good_citizen_in_lockstep_and_ends_with_the_bus(kind, lockstep, request):
    command = start(kind, lockstep.port, request)
    with subprocess.Popen(command, stderr=subprocess.PIPE) as unit:
        try:
            lockstep.do(lockstep.until(2), 240.0)
            assert lockstep.frames[:2] == [(HEARTBEAT, b"\x00"), (HEARTBEAT, b"\x05")]
            lockstep.frames.clear()
            lockstep.do(lockstep.cycles(200), 240.0)
            said = [frame for frame in lockstep.frames if frame[0] != REFERENCE]
            answers = [data for can_id, data in said if can_id == MAGNETS]
            assert len(answers) == 200
            assert set(answers[:100]) == {b"\x00"}
            assert b"\x03" in answers[100:]
            # a heartbeat before every fifth answer; one more may go out before the first SYNC
            before = [
                ids(said[:i]).count(MAGNETS)
                for i, frame in enumerate(said)
                if frame[0] == HEARTBEAT
            ]
            assert [n for n in before if n] == list(range(4, 200, 5))
            lockstep.close()
            assert unit.wait(60.0) == 0
        finally:
            unit.kill()


def test_a_terminated_unit_leaves_the_magnets_off_and_status_zero(lockstep, request):
    with subprocess.Popen(start("reference", lockstep.port, request)) as unit:
        try:
            lockstep.do(lockstep.until(2), 240.0)
            lockstep.do(lockstep.cycles(50), 240.0)
            assert lockstep.frames[-1] == (MAGNETS, b"\x03")
            unit.send_signal(signal.SIGTERM)
            assert unit.wait(60.0) == 0
        finally:
            unit.kill()
    lockstep.do(lockstep.until_last((MAGNETS, b"\x00")))


def test_a_unit_that_shall_asks_for_sand_while_wheels_slide_and_the_shipped_one_never_does():
    asked = []
    for sand in (False, True):
        bus = can.Bus(interface="virtual", channel=f"sand{next(CHANNELS)}")
        unit = wsp_unit.Unit(bus, wsp_unit.Reference(logic.load()._replace(sand=sand)), 0.01)
        unit._boot()
        sent = []
        unit._send = lambda can_id, data, sent=sent: sent.append((can_id, data))
        for payload in [RUNNING] * 20 + [LOCKED] * 5 + [RUNNING] * 250:
            unit._handlers[SYNC](can.Message(arbitration_id=SYNC))
            unit._handlers[SPEEDS](can.Message(arbitration_id=SPEEDS, data=payload))
        asked.append([data for can_id, data in sent if can_id == 0x212])
        bus.shutdown()
    assert asked == [[], [b"\x55", b"\x00"]]
