"""The rig on its bus: the port on which programs find it, and parameters that nodes store."""

import asyncio
import contextlib
import functools
import os
import socket
import time

import numpy as np
import pytest
from bench_process import BenchProcess

from rollerrig.configs.errors import BusError
from rollerrig.configs.vehicle import COACH
from rollerrig.realtime.bench import rig_bus, scenario
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.codecs import CODECS
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, UNIT_HEARTBEAT_ID

TABLE = signals.table(COACH)

SAVE = b"save"  # the signature in 1010h that stores the parameters
# requests of SDO as they are on the bus: command specifier, index, sub-index
READ_1017 = b"\x40\x17\x10\0"  # read the heartbeat time
WRITE_1017 = b"\x2b\x17\x10\0"  # write two bytes to it
STORE_ALL = b"\x23\x10\x10\1"  # write four bytes to 1010h sub 1
WRITTEN = 0x60
SDO_REQUEST = 0x600


class Rig:
    """A rig on a hub that listens nowhere, and an SDO client."""

    def __init__(self, *settings):
        self.hub = Hub(lambda: 0)
        self.answers = []
        plan = scenario.load("dry_stop", settings=settings)
        rig_bus.RigBus(
            self.hub,
            plan,
            np.zeros(signals.WIDTH),
            lambda row: None,
            events.ignore,
            lambda: 0,
        )
        self.port = self.hub.attach(lambda frame: self.answers.append(frame.data), "client")

    def request(self, node, data):
        """The answer of a node to an SDO request."""
        self.answers.clear()
        self.port.send(Frame(SDO_REQUEST + node, data.ljust(8, b"\0")))
        return self.answers[-1]

    def heartbeat_ms(self, node):
        answer = self.request(node, READ_1017)
        return int.from_bytes(answer[4:6], "little")


@pytest.mark.parametrize("node", [1, 16, 17])
def test_a_parameter_that_a_master_stores_is_kept_in_the_next_run_with_the_same_store(
    node, tmp_path
):
    store = f"bus.store={tmp_path / 'memory'}"
    first = Rig(store)
    assert first.heartbeat_ms(node) == 100
    first.request(node, WRITE_1017 + (250).to_bytes(2, "little"))
    assert first.request(node, STORE_ALL + SAVE)[0] == WRITTEN
    assert Rig(store).heartbeat_ms(node) == 250
    assert Rig().heartbeat_ms(node) == 100


# --- a bench that stands still ---


class WatchedRig:
    """A rig in real time on a hub: its clock, the heartbeats of a unit, what the rig reports."""

    def __init__(self, pacing="wall"):
        self.now_ns = 0
        self.reported = []
        self.fields = {}
        hub = Hub(lambda: self.now_ns)

        def report(code, **fields):
            self.reported.append(code)
            self.fields[code] = fields

        self.bus = rig_bus.RigBus(
            hub,
            scenario.load("dry_stop"),
            np.zeros(signals.WIDTH),
            lambda row: None,
            report,
            lambda: self.now_ns,
            pacing,
        )
        self.bus.keep_time()
        self.unit = hub.attach(lambda frame: None, "unit")

    def heartbeat(self):
        self.unit.send(Frame(UNIT_HEARTBEAT_ID, b"\5"))

    def run(self, milliseconds, with_heartbeats=True):
        """Let time go on in steps of 10 ms, with a heartbeat of the unit in every fifth one."""
        for step in range(milliseconds // 10):
            self.now_ns += 10_000_000
            if with_heartbeats and step % 5 == 0:
                self.heartbeat()
            self.bus.poll()

    def cycles(self, answers):
        """Let a SYNC go out every 10 ms; `answers` has for each the number of frames 211h."""
        for cycle, frames in enumerate(answers):
            self.now_ns += 10_000_000
            if cycle % 5 == 0:
                self.heartbeat()
            self.bus.sync()
            self.bus.poll()
            for _ in range(frames):
                self.unit.send(Frame(MAGNETS_ID, b"\0"))

    def silences(self):
        of_silence = (Code.UNIT_SILENT, Code.UNIT_ANSWERS)
        return [code for code in self.reported if code in of_silence]

    def losses(self):
        lost = (Code.UNIT_LOST, Code.NODE_LOST, Code.HEARTBEAT_LOST)
        return [code for code in self.reported if code in lost]


def in_event_loop(test):
    """Make a test of a coroutine that needs no fixture."""

    @functools.wraps(test)
    def run():
        asyncio.run(test())

    return run


@in_event_loop
async def test_a_bench_that_stood_still_takes_the_frames_that_came_before_it_calls_a_node_lost():
    rig = WatchedRig()
    rig.run(500)
    # longer than the patience with the unit and with the nodes of the rig
    rig.now_ns += 900_000_000
    rig.bus.poll()
    rig.heartbeat()
    rig.run(500)
    assert not rig.losses()
    rig.bus.close()


@in_event_loop
async def test_a_unit_that_is_silent_after_the_bench_stood_still_is_lost():
    rig = WatchedRig()
    rig.run(500)
    rig.now_ns += 900_000_000
    rig.run(100, with_heartbeats=False)
    assert Code.UNIT_LOST in rig.losses()
    assert Code.NODE_LOST not in rig.losses()
    rig.bus.close()


# --- a unit that is alive and no longer commands the valves ---

EACH = [1] * 150  # it answers each SYNC
NONE = [0] * 50  # the next SYNC finds so many without an answer


@in_event_loop
async def test_a_unit_that_answered_each_sync_and_sends_only_its_heartbeat_is_reported_as_silent():
    rig = WatchedRig()
    rig.cycles([*EACH, *NONE])
    assert rig.silences() == []
    rig.cycles([0])
    assert rig.silences() == [Code.UNIT_SILENT]
    assert rig.fields[Code.UNIT_SILENT] == {"node": 32, "syncs": 50, "silent_s": 0.51}
    assert not rig.losses()
    # it is reported once, until it answers again
    rig.cycles([0] * 100)
    rig.cycles(EACH)
    assert rig.silences() == [Code.UNIT_SILENT, Code.UNIT_ANSWERS]
    rig.bus.close()


@pytest.mark.parametrize(
    ("answers", "pacing"),
    [
        ([*EACH, *NONE[1:]] * 3, "wall"),  # pauses that are short enough
        ([*[0, 0, 3] * 60, *NONE], "wall"),  # late answers: each SYNC has one in the end
        ([*[1, 0] * 100, *NONE, 0, *NONE], "wall"),  # a unit that sends commands that change
        ([*NONE, *NONE, 1, *NONE, *NONE], "wall"),
        ([*EACH, *NONE, *NONE], "lockstep"),  # the bench waits for the answer instead
    ],
    ids=["pauses", "late", "on change", "hardly ever", "lockstep"],
)
def test_no_other_unit_is_reported_as_silent(answers, pacing):
    @in_event_loop
    async def run():
        rig = WatchedRig(pacing)
        rig.cycles(answers)
        assert rig.silences() == []
        rig.bus.close()

    run()


@in_event_loop
async def test_a_unit_that_is_dead_is_lost_and_not_silent_until_it_is_back_without_commands():
    rig = WatchedRig()
    rig.cycles(EACH)
    for _ in range(200):
        rig.now_ns += 10_000_000
        rig.bus.sync()
        rig.bus.poll()
    assert Code.UNIT_LOST in rig.losses()
    assert rig.silences() == []
    rig.cycles([*NONE, 0])
    assert rig.silences() == [Code.UNIT_SILENT]
    rig.bus.close()


@in_event_loop
async def test_a_unit_that_boots_again_is_judged_anew():
    rig = WatchedRig()
    rig.cycles(EACH)
    rig.unit.send(Frame(UNIT_HEARTBEAT_ID, b"\0"))
    rig.cycles([*NONE, *NONE])
    assert rig.silences() == []
    rig.bus.close()


# --- the port ---

USUAL_PORT = CODECS["socketcand"].port


@pytest.fixture
def host():
    """A loopback address that no other test uses, so that its usual port is free."""
    high, low = divmod(os.getpid() % 65536, 256)
    return f"127.{high}.{low}.7"


@pytest.fixture
def used_port(host):
    """The usual port of a loopback address, on which another program listens."""
    with socket.create_server((host, USUAL_PORT)):
        yield USUAL_PORT


def bench_on(host, out, *arguments):
    """A run whose port nobody has chosen."""
    return BenchProcess(
        out,
        "--pacing",
        "lockstep",
        "--set",
        f"bus.host={host}",
        "--set",
        "bus.socketcand_port=-1",
        "--set",
        "duration_max_s=0.2",
        *arguments,
        scenario="dry_stop",
    ).finish()


def test_the_hub_is_on_the_usual_port_where_that_is_free(host):
    async def address():
        plan = scenario.load("dry_stop", settings=(f"bus.host={host}", "bus.interface=hub"))
        hub, place = await rig_bus.open_bus(
            plan, time.monotonic_ns, print, events.ignore, wall=True, awaits_others=False
        )
        await hub.close()
        return place

    assert asyncio.run(address()) == f"socketcand://{host}:{USUAL_PORT}/rig0"


def test_a_run_with_the_unit_of_the_bench_takes_a_free_port_if_the_usual_one_is_in_use(
    host, used_port, tmp_path
):
    bench = bench_on(host, tmp_path / "run")
    assert bench.status == 4, bench.stderr  # it does not stop in that time
    assert bench.result["ended"] == "finished"

    (place,) = bench.reported(Code.BUS_PLACE)
    (warning,) = bench.reported(Code.BUS_PORT_IN_USE, port=used_port)
    address = warning.fields["address"]
    assert address == place.fields["address"] != f"socketcand://{host}:{used_port}/rig0"
    assert address in bench.stderr


@pytest.mark.parametrize(
    "outside",
    [
        ("--wsp", "external"),
        ("--harness",),
        ("--set", "bus.master=false"),
        ("--set", "rig.drives=bus"),
    ],
)
def test_a_run_that_waits_for_an_outside_program_refuses_a_usual_port_in_use(
    outside, host, used_port, tmp_path
):
    bench = bench_on(host, tmp_path / "run", *outside)
    assert bench.status == 2, bench.stderr
    assert f"{host}:{used_port}" in bench.result["error"]
    assert "--set bus.socketcand_port=N" in bench.result["error"]
    assert "Traceback" not in bench.stderr


@pytest.mark.parametrize("protocol", CODECS)
def test_a_port_that_was_chosen_is_kept_and_the_error_names_its_key(protocol, host):
    with contextlib.closing(socket.create_server((host, 0))) as other:
        port = other.getsockname()[1]
        settings = (f"bus.host={host}", "bus.interface=hub", f"bus.{protocol}_port={port}")
        plan = scenario.load("dry_stop", settings=settings)
        with pytest.raises(BusError) as refusal:
            asyncio.run(listen(plan))
    assert f"{host}:{port}" in str(refusal.value)
    assert f"--set bus.{protocol}_port=N" in str(refusal.value)


async def listen(plan):
    """Open the bus of a scenario and its other protocols, as a run does."""
    hub, place = await rig_bus.open_bus(
        plan, time.monotonic_ns, print, events.ignore, wall=True, awaits_others=False
    )
    try:
        await rig_bus.open_others(hub, place, plan, events.ignore, awaits_others=False)
    finally:
        await hub.close()


def test_a_run_whose_chosen_port_is_in_use_ends_with_an_error(host, tmp_path):
    with contextlib.closing(socket.create_server((host, 0))) as other:
        port = other.getsockname()[1]
        bench = bench_on(host, tmp_path / "run", "--set", f"bus.socketcand_port={port}")
    assert bench.status == 2, bench.stderr
    assert f"{host}:{port}" in bench.result["error"]
    assert "--set bus.socketcand_port=N" in bench.result["error"]
