"""The bench as NMT master and SYNC producer, and all nodes together on one rack."""

import math

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import encoder406, io401, nmt_master, rack
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.drive402 import drive as drive402
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.events import Code

MS = 1_000_000  # ns
TABLE = signals.table(COACH)

UNIT_HEARTBEAT = 0x720
# data of a heartbeat
BOOT_UP = b"\0"
OPERATIONAL = b"\x05"
PRE_OPERATIONAL = b"\x7f"
START_UNIT = b"\x01\x20"  # NMT command START to node 32


class Rig:
    """The default rig on one port of a hub, and a tester on another port."""

    def __init__(self, **options):
        self.now_ns = 0
        self.hub = Hub(lambda: self.now_ns)
        self.frames = []
        self.events = []
        self.hub.tap(self.frames.append)
        self.tester = self.hub.attach(lambda frame: None, "tester")
        self.row = np.zeros(signals.WIDTH)
        self.commands = np.zeros(io401.COMMANDS)
        self.network = nmt_master.NmtMaster(TABLE, **options)
        self.network.on_event = self.on_event
        self.drives = [
            drive402.build(node, axle, self.row) for axle, node in enumerate(TABLE.drive_nodes, 1)
        ]
        self.encoder = encoder406.build(TABLE, self.row)
        self.brake = io401.build(TABLE, self.row, self.commands)
        self.nodes = [*self.drives, self.encoder, self.brake]
        self.rack = rack.Rack()
        for member in (self.network, *self.nodes):
            self.rack.add(member)
        port = self.hub.attach(self.rack.on_frame, "rig")
        self.rack.start(port.send, 0)

    def on_event(self, code, **fields):
        self.events.append(events.make(0.0, code, **fields))

    def run(self, milliseconds, unit=None):
        """Let time pass. `unit`: the data of a heartbeat that the WSP unit sends every 50 ms."""
        for at_ms in range(milliseconds):
            self.now_ns += MS
            if unit is not None and at_ms % 50 == 0:
                self.tester.send(Frame(UNIT_HEARTBEAT, unit))
            self.rack.poll(self.now_ns)

    def sent(self, can_id):
        """Return the data of all frames with an identifier."""
        return [frame.data for frame in self.frames if frame.can_id == can_id]


@pytest.fixture
def rig():
    return Rig()


def test_every_node_is_operational_right_after_its_boot_up(rig):
    assert [node.state for node in rig.nodes] == [State.OPERATIONAL] * 6
    assert rig.network.all_operational() is False
    rig.run(100)
    assert rig.network.all_operational()


@pytest.mark.conformance("CiA 301", "SYNC producer")
def test_one_sync_brings_the_process_data_of_all_nodes_once(rig):
    rig.frames.clear()
    rig.network.sync()
    sync, *pdos = [frame.can_id for frame in rig.frames]
    assert sync == 0x80
    of_drives = [0x181, 0x281, 0x182, 0x282, 0x183, 0x283, 0x184, 0x284]
    of_speed_unit = [0x190, 0x290, 0x390]
    of_brake_io = [0x191]
    brake_demand = [0x291]  # with the first SYNC, and then after changes
    assert sorted(pdos) == sorted(of_drives + of_speed_unit + of_brake_io + brake_demand)

    rig.frames.clear()
    rig.network.sync()
    _, *pdos = [frame.can_id for frame in rig.frames]
    assert sorted(pdos) == sorted(of_drives + of_speed_unit + of_brake_io)


def test_the_bench_sends_a_heartbeat(rig):
    assert rig.sent(0x77F) == [BOOT_UP]
    rig.run(300)
    assert rig.sent(0x77F)[1:] == [OPERATIONAL] * 3


@pytest.mark.conformance("CiA 301", "NMT master: start after boot-up")
def test_the_unit_is_started_when_it_appears_and_once_only(rig):
    rig.frames.clear()
    rig.tester.send(Frame(UNIT_HEARTBEAT, BOOT_UP))
    rig.tester.send(Frame(UNIT_HEARTBEAT, PRE_OPERATIONAL))
    rig.tester.send(Frame(UNIT_HEARTBEAT, PRE_OPERATIONAL))
    assert rig.sent(0) == [START_UNIT]
    assert not rig.network.unit_is_operational
    rig.tester.send(Frame(UNIT_HEARTBEAT, OPERATIONAL))
    assert rig.network.unit_is_operational


def test_a_unit_that_was_there_before_the_bench_is_started_too(rig):
    rig.frames.clear()
    rig.tester.send(Frame(UNIT_HEARTBEAT, PRE_OPERATIONAL))
    assert rig.sent(0) == [START_UNIT]


@pytest.mark.conformance("CiA 301", "NMT master: heartbeat consumer")
def test_a_silent_unit_is_lost_and_found_again(rig):
    rig.run(500, unit=OPERATIONAL)
    assert rig.network.unit_is_operational
    rig.run(250)
    assert rig.network.unit.lost
    assert not rig.network.unit_is_operational
    assert Code.UNIT_LOST in [event.code for event in rig.events]
    rig.run(10, unit=OPERATIONAL)
    assert rig.network.unit_is_operational


def test_a_node_that_an_outside_master_stops_is_not_started_again(rig):
    rig.tester.send(Frame(0, b"\x80\x10"))  # node 16: enter PRE-OPERATIONAL
    rig.run(1000)
    assert rig.encoder.state is State.PRE_OPERATIONAL


def test_a_node_that_boots_again_is_started_again(rig):
    rig.tester.send(Frame(0, b"\x81\x10"))  # node 16: reset
    assert rig.encoder.state is State.OPERATIONAL


@pytest.mark.conformance("CiA 301", "NMT and SYNC left to an outside master")
def test_a_bench_that_is_not_the_master_starts_no_node():
    rig = Rig(master=False)
    rig.run(200)
    assert rig.sent(0) == []
    assert rig.drives[0].state is State.PRE_OPERATIONAL


@pytest.mark.conformance("CiA 301", "SYNC producer: counter")
def test_a_sync_counter_runs_from_one_to_its_overflow_value():
    rig = Rig(sync_overflow=3)
    for _ in range(5):
        rig.network.sync()
    assert rig.sent(0x80) == [b"\1", b"\2", b"\3", b"\1", b"\2"]


def test_the_units_reference_speed_is_known_until_the_unit_is_lost(rig):
    rig.run(60, unit=OPERATIONAL)
    rig.tester.send(Frame(0x1A0, (4230).to_bytes(2, "little")))
    assert rig.network.reference_speeds_m_s[0] == pytest.approx(42.3)
    rig.tester.send(Frame(0x1A0, b"\1"))  # a byte too short
    assert rig.network.reference_speeds_m_s[0] == pytest.approx(42.3)
    rig.run(250)
    assert math.isnan(rig.network.reference_speeds_m_s[0])


def test_a_node_without_power_is_lost_and_boots_when_it_has_power_again(rig):
    rig.run(200)
    rig.rack.power(rig.encoder, False, rig.now_ns)
    rig.frames.clear()
    rig.network.sync()
    assert rig.sent(0x190) == []
    rig.run(600)
    assert rig.network.health[16].lost

    rig.rack.power(rig.encoder, True, rig.now_ns)
    assert rig.sent(0x710)[0] == BOOT_UP
    rig.network.sync()
    assert len(rig.sent(0x190)) == 1


def test_without_power_no_magnet_is_energised_and_no_motor_enabled(rig):
    rig.tester.send(Frame(0x211, b"\xff"))
    assert rig.commands[: COACH.axles].all()
    drive = rig.drives[0]
    drive.poll(MS)
    assert drive.device.enabled

    for member in (drive, rig.brake):
        rig.rack.power(member, False, rig.now_ns)
    assert not rig.commands[io401.MAGNETS].any()
    assert not drive.device.enabled

    rig.run(10)
    for member in (drive, rig.brake):
        rig.rack.power(member, True, rig.now_ns)
    assert drive.device.enabled


def test_an_emergency_of_a_node_becomes_an_event(rig):
    rig.drives[0].device.trip(0x2310, "over-current")
    emergencies = [event for event in rig.events if event.code == Code.NODE_EMERGENCY]
    assert 0x2310 in [event.fields["error_code"] for event in emergencies]
