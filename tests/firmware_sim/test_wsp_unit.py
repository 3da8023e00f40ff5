"""The reference WSP unit on a bus: what it sends, in which order, and how it starts and exits."""

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

from rollerrig.configs.errors import BusError, ConfigError
from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.firmware_sim.cia301.nmt import Command, State
from rollerrig.firmware_sim.wsp import logic
from rollerrig.firmware_sim.wsp import node as wsp_unit
from rollerrig.wsp_interface import rig_objects, signals
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub

# identifiers that the unit receives
SYNC = 0x080
SPEEDS = 0x190
PRESSURES = 0x191
# identifiers that the unit sends
HEARTBEAT = 0x720
REFERENCE = 0x1A0
MAGNETS = 0x211
SAND = 0x212

# data of heartbeats
BOOT_UP = bytes((State.INITIALISING,))
OPERATIONAL = bytes((State.OPERATIONAL,))
STOPPED = bytes((State.STOPPED,))

# data of magnets, two bits an axle
ALL_OFF = b"\x00"
AXLE_1_VENTS = b"\x03"

# of the unit of the coach
FRAMES = rig_objects.unit_frames(signals.table(COACH), 0)
EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
# numbers that make the names of virtual channels unique
CHANNELS = itertools.count()


def speeds(*omega_rad_s):
    """Return the data of node 16's TPDO1."""
    return struct.pack("<4h", *(round(100.0 * omega) for omega in omega_rad_s))


RUNNING = speeds(67.4, 67.4, 67.4, 67.4)
LOCKED = speeds(0.0, 67.4, 67.4, 67.4)


def locking(cycle):
    """Return the speeds in a cycle after a wheel began to lock at 40 m/s2, until it stands."""
    return speeds(max(0.0, 67.4 - 0.9 * cycle), 67.4, 67.4, 67.4)


class Bench:
    """The other end of a virtual bus, and the unit in a separate thread."""

    def __init__(self, channel, lockstep_s=0.0):
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.unit_bus = can.Bus(interface="virtual", channel=channel)
        reference = wsp_unit.Reference(logic.load(), FRAMES, dynamic_brake=False)
        self.unit = wsp_unit.Unit(self.unit_bus, reference, FRAMES, lockstep_s)
        self.thread = threading.Thread(target=self.unit.run, daemon=True)
        self.thread.start()

    def send(self, can_id, data=b""):
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def heard(self, until=None, timeout_s=60.0):
        """Return the frames (identifier, data) up to the first with identifier `until`.

        Without such a frame the function returns at the timeout what has come so far.
        """
        frames = []
        end_s = time.monotonic() + timeout_s
        while True:
            rest_s = end_s - time.monotonic()
            if rest_s <= 0.0:
                return frames
            message = self.bus.recv(rest_s)
            if message is None:
                continue
            frames.append((message.arbitration_id, bytes(message.data)))
            if message.arbitration_id == until:
                return frames

    def cycle(self, data=RUNNING):
        """Send one SYNC and the frames of nodes 16 and 17; return the frames of the answer."""
        self.send(SYNC)
        self.send(SPEEDS, data)
        self.send(PRESSURES, bytes(8))
        return self.heard(MAGNETS)

    def lock_a_wheel(self):
        """Run three cycles with a locked wheel; the unit then vents axle 1."""
        for _ in range(3):
            self.cycle(LOCKED)

    def command(self, command, node=32):
        """Send an NMT command."""
        self.send(0x000, bytes((command, node)))


@pytest.fixture
def bench():
    bench = Bench(f"wsp-unit-{os.getpid()}-{next(CHANNELS)}")
    assert bench.heard(HEARTBEAT) == [(HEARTBEAT, BOOT_UP)]
    assert bench.heard(HEARTBEAT) == [(HEARTBEAT, OPERATIONAL)]
    yield bench
    bench.unit.stop()
    bench.thread.join(60.0)
    bench.bus.shutdown()
    bench.unit_bus.shutdown()


def ids(frames):
    """Return the identifiers of frames."""
    return [can_id for can_id, _ in frames]


def test_every_sync_is_answered_once_with_the_reference_speed_before_the_magnets(bench):
    for i in range(1, 21):
        expected = [REFERENCE, MAGNETS]
        if i % 5 == 0:
            expected = [HEARTBEAT, REFERENCE, MAGNETS]
        assert ids(bench.cycle()) == expected

    # speeds without a SYNC get no answer
    bench.send(SPEEDS, RUNNING)
    assert bench.heard(timeout_s=0.05) == []


def test_the_heartbeat_of_every_fifth_sync_goes_out_before_the_answer(bench):
    frames = []
    for _ in range(25):
        frames.extend(bench.cycle())
    beats = [i for i, frame in enumerate(frames) if frame == (HEARTBEAT, OPERATIONAL)]
    assert len(beats) == 5
    assert all(frames[i + 2][0] == MAGNETS for i in beats)


def test_it_waits_for_the_speeds_of_this_sync(bench):
    bench.send(SPEEDS, LOCKED)
    bench.send(SYNC)
    assert MAGNETS not in ids(bench.heard(timeout_s=0.05))
    bench.send(SPEEDS, RUNNING)
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, ALL_OFF)


def test_over_the_bus_it_decides_bit_for_bit_as_in_the_compiled_loop(bench):
    generator = np.random.default_rng(7)
    # four speeds in 0.01 rad/s that fall at random
    steps = generator.uniform(0.0, 25.0, (400, 4))
    rows = np.round(6740.0 - np.cumsum(steps, axis=0)).astype(int)
    unit = logic.new_unit(logic.load())
    seen = []
    for row in rows:
        magnets, reference = logic.cycle(unit, row)
        answer = dict(bench.cycle(struct.pack("<4h", *row)))
        assert answer[MAGNETS] == bytes((magnets,))
        assert answer[REFERENCE] == struct.pack("<h", reference)
        seen.append(magnets)
    assert len(set(seen)) > 3


def test_without_sync_it_still_sends_heartbeats(bench):
    beats = [bench.bus.recv(60.0) for _ in range(6)]
    assert {(beat.arbitration_id, bytes(beat.data)) for beat in beats} == {(HEARTBEAT, OPERATIONAL)}
    assert np.median(np.diff([beat.timestamp for beat in beats])) > 0.05


def test_other_traffic_does_not_keep_it_from_heartbeating(bench):
    beats = 0
    end_s = time.monotonic() + 60.0
    while beats < 3 and time.monotonic() < end_s:
        bench.send(0x701, b"\x05")
        beats += ids(bench.heard(timeout_s=0.02)).count(HEARTBEAT)
    assert beats == 3


def test_stopped_by_the_master_it_drops_the_magnets_and_is_silent_until_started(bench):
    bench.lock_a_wheel()
    assert bench.cycle(LOCKED)[-1] == (MAGNETS, AXLE_1_VENTS)
    bench.command(Command.STOP)
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, ALL_OFF)
    bench.send(SYNC)
    bench.send(SPEEDS, LOCKED)
    frames = bench.heard(HEARTBEAT) + bench.heard(timeout_s=0.05)
    assert set(frames) == {(HEARTBEAT, STOPPED)}
    bench.command(Command.START, node=0)
    assert ids(bench.cycle(LOCKED))[-2:] == [REFERENCE, MAGNETS]


def test_commands_for_other_nodes_leave_it_alone(bench):
    bench.command(Command.STOP, node=17)
    assert MAGNETS in ids(bench.cycle())


@pytest.mark.parametrize("command", [Command.RESET_NODE, Command.RESET_COMMUNICATION])
def test_a_reset_makes_it_boot_again_with_an_empty_memory(bench, command):
    bench.lock_a_wheel()
    bench.command(command)
    frames = bench.heard(HEARTBEAT) + bench.heard(HEARTBEAT)
    assert frames == [(MAGNETS, ALL_OFF), (HEARTBEAT, BOOT_UP), (HEARTBEAT, OPERATIONAL)]
    still = speeds(0.0, 0.0, 0.0, 0.0)
    assert bench.cycle(still) == [(REFERENCE, b"\x00\x00"), (MAGNETS, ALL_OFF)]


def test_without_speeds_it_repeats_the_magnets_five_times_and_then_drops_them(bench):
    bench.lock_a_wheel()

    # the unit answers a SYNC without speeds when the next SYNC comes
    bench.send(SYNC)
    answers = []
    for _ in range(9):
        bench.send(SYNC)
        answers.append(bench.heard(MAGNETS)[-1][1])
    assert answers == [AXLE_1_VENTS] * 5 + [ALL_OFF] * 4

    # the speeds are back
    bench.send(SPEEDS, LOCKED)
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, AXLE_1_VENTS)
    assert bench.cycle(LOCKED)[-1] == (MAGNETS, AXLE_1_VENTS)


def test_a_sync_whose_speeds_never_come_is_answered_by_the_clock_where_no_other_comes(bench):
    bench.cycle()
    bench.send(SYNC)
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, ALL_OFF)


def test_in_lockstep_it_sends_nothing_by_the_clock_and_answers_without_speeds_at_the_next_sync():
    bench = Bench(f"wsp-unit-{os.getpid()}-{next(CHANNELS)}", lockstep_s=0.01)
    assert bench.heard(HEARTBEAT) + bench.heard(HEARTBEAT) == [
        (HEARTBEAT, BOOT_UP),
        (HEARTBEAT, OPERATIONAL),
    ]
    assert bench.heard(timeout_s=0.5) == []
    bench.cycle()
    bench.send(SYNC)
    assert bench.heard(timeout_s=0.5) == []
    for n in range(3, 8):
        bench.send(SYNC)
        # The heartbeat of the fifth SYNC precedes its answer, so both come with the sixth SYNC.
        expected = [MAGNETS]
        if n == 6:
            expected = [HEARTBEAT, MAGNETS]
        assert ids(bench.heard(MAGNETS)) == expected

    bench.unit.stop()
    bench.thread.join(60.0)
    assert not bench.thread.is_alive()


def test_speeds_of_a_wrong_length_are_not_speeds(bench):
    bench.send(SYNC)
    bench.send(SPEEDS, bytes(6))
    assert MAGNETS not in ids(bench.heard(timeout_s=0.05))
    bench.send(SPEEDS, RUNNING)
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, ALL_OFF)


def test_before_it_stops_on_request_it_switches_the_magnets_off(bench):
    bench.lock_a_wheel()
    bench.unit.stop()
    assert bench.heard(MAGNETS)[-1] == (MAGNETS, ALL_OFF)
    bench.thread.join(60.0)
    assert not bench.thread.is_alive()


def test_it_exits_when_the_bus_closes(bench):
    bench.cycle()
    bench.unit_bus.shutdown()
    bench.thread.join(60.0)
    assert not bench.thread.is_alive()


def test_a_unit_of_a_further_group_has_the_identifiers_and_axles_of_its_group():
    frames = wsp_unit.frames_of_group(Kind(6, dynamic_brake=True), 2)
    bus = can.Bus(interface="virtual", channel=f"group{next(CHANNELS)}")
    unit = wsp_unit.Unit(bus, wsp_unit.Reference(logic.load(), frames, True), frames, 0.01)
    sent = []
    unit._send = lambda can_id, data: sent.append((can_id, len(data)))
    unit._boot()
    unit._handlers[SYNC](can.Message(arbitration_id=SYNC))
    speeds_of_two = struct.pack("<2h", 6740, 6740)
    unit._handlers[0x1B0](can.Message(arbitration_id=0x1B0, data=speeds_of_two))
    bus.shutdown()
    # heartbeats, reference speed, permitted shares of two motors, magnets
    assert sent == [(0x740, 1), (0x740, 1), (0x1C0, 2), (0x233, 4), (0x231, 1)]


def test_a_group_that_the_vehicle_does_not_have_is_an_error_that_names_the_option():
    with pytest.raises(ConfigError, match=r"--group 2: a vehicle with 4 axles has 1 .*--axles 8"):
        wsp_unit.frames_of_group(COACH, 2)


def test_a_missing_bus_is_an_error_with_its_address():
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
        """Run a coroutine in the loop's thread and return its result."""
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
        """Wait until the unit has sent this number of frames."""
        while len(self.frames) < count:
            self.heard.clear()
            await asyncio.wait_for(self.heard.wait(), 240.0)

    async def until_last(self, frame):
        """Wait until the newest frame is this one."""
        while self.frames[-1] != frame:
            self.heard.clear()
            await asyncio.wait_for(self.heard.wait(), 60.0)

    async def cycles(self, count):
        """Run SYNC cycles that wait for the answer; a wheel locks in the second half."""
        for i in range(count):
            self.rig.send(Frame(SYNC, b""))
            data = locking(max(0, i - count // 2))
            self.rig.send(Frame(SPEEDS, data))
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
    """Build the Go example and return the path of the program."""
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


def command_line(kind, port, request):
    """Return the command line that starts a WSP unit as a separate program."""
    if kind == "reference":
        return [sys.executable, "-c", REFERENCE_UNIT, f"socketcand://127.0.0.1:{port}/rig0"]
    if kind == "python":
        return [sys.executable, str(EXAMPLES / "wsp_unit.py"), "127.0.0.1", str(port)]
    return [request.getfixturevalue("go_unit"), f"127.0.0.1:{port}"]


@pytest.mark.parametrize(
    "kind", ["reference", "python", pytest.param("go", marks=pytest.mark.nightly)]
)
def test_every_unit_answers_in_lockstep_and_exits_when_the_bus_closes(kind, lockstep, request):
    command = command_line(kind, lockstep.port, request)
    with subprocess.Popen(command, stderr=subprocess.PIPE) as unit:
        try:
            lockstep.do(lockstep.until(2), 240.0)
            assert lockstep.frames[:2] == [(HEARTBEAT, BOOT_UP), (HEARTBEAT, OPERATIONAL)]
            lockstep.frames.clear()
            begin_s = time.monotonic()
            lockstep.do(lockstep.cycles(200), 240.0)
            elapsed_s = time.monotonic() - begin_s

            # the examples send no reference speed
            frames = [frame for frame in lockstep.frames if frame[0] != REFERENCE]
            answers = [data for can_id, data in frames if can_id == MAGNETS]
            assert len(answers) == 200
            assert set(answers[:100]) == {ALL_OFF}
            assert AXLE_1_VENTS in answers[100:]

            # A heartbeat precedes every fifth answer, or an earlier one if 0.1 s have passed: there
            # are never more than five answers between two heartbeats.
            answers_before_heartbeat = [0]
            for i, (can_id, _) in enumerate(frames):
                if can_id == HEARTBEAT:
                    answers_before_heartbeat.append(ids(frames[:i]).count(MAGNETS))
            answers_before_heartbeat.append(len(answers))
            assert np.diff(answers_before_heartbeat).max() <= 5
            # nor are there more than these two rules give; one may precede the first SYNC
            assert ids(frames).count(HEARTBEAT) <= 200 // 5 + elapsed_s / 0.1 + 1

            lockstep.close()
            assert unit.wait(60.0) == 0
        finally:
            unit.kill()


def test_a_terminated_unit_leaves_the_magnets_off_and_status_zero(lockstep, request):
    with subprocess.Popen(command_line("reference", lockstep.port, request)) as unit:
        try:
            lockstep.do(lockstep.until(2), 240.0)
            lockstep.do(lockstep.cycles(50), 240.0)
            assert lockstep.frames[-1] == (MAGNETS, AXLE_1_VENTS)
            unit.send_signal(signal.SIGTERM)
            assert unit.wait(60.0) == 0
        finally:
            unit.kill()
    lockstep.do(lockstep.until_last((MAGNETS, ALL_OFF)))


def sand_commands(sand):
    """Return the sand commands of a unit with this setting while wheels run, slide and run."""
    bus = can.Bus(interface="virtual", channel=f"sand{next(CHANNELS)}")
    params = logic.load()._replace(sand=sand)
    reference = wsp_unit.Reference(params, FRAMES, dynamic_brake=False)
    unit = wsp_unit.Unit(bus, reference, FRAMES, 0.01)
    unit._boot()

    sent = []
    unit._send = lambda can_id, data: sent.append((can_id, data))
    slides = [locking(cycle) for cycle in (*range(12), *range(12, 0, -1))]
    for payload in [RUNNING] * 20 + slides + [RUNNING] * 250:
        unit._handlers[SYNC](can.Message(arbitration_id=SYNC))
        unit._handlers[SPEEDS](can.Message(arbitration_id=SPEEDS, data=payload))
    bus.shutdown()
    return [data for can_id, data in sent if can_id == SAND]


def test_a_unit_with_sand_requests_sand_while_wheels_slide():
    assert sand_commands(True) == [b"\x55", b"\x00"]


def test_a_unit_without_sand_never_requests_sand():
    assert sand_commands(False) == []
