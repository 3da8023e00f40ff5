"""The whole rig on a socketcand port, and a canopen master on the client of python-can."""

import asyncio
import threading
import time

import can
import canopen
import numpy as np
import pytest
from canopen.profiles.p402 import BaseNode402

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import encoder406, io401, nmt_master, rack
from rollerrig.firmware_sim.drive402 import axis
from rollerrig.firmware_sim.drive402 import drive as drive402
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.hub import Hub

TABLE = signals.table(COACH)
CYCLE_S = 0.002
CYCLES_A_SYNC = 5
PATIENCE_S = 60.0  # a busy machine is slow
SYNC = 0x80


class PatientDrive(BaseNode402):
    """The drive class of canopen, with time-outs for a busy machine."""

    TIMEOUT_SWITCH_OP_MODE = PATIENCE_S
    TIMEOUT_SWITCH_STATE_FINAL = PATIENCE_S
    TIMEOUT_SWITCH_STATE_SINGLE = PATIENCE_S


class RigThread:
    """The default rig in a thread. The bus controls the drives.

    `errors`: exceptions that reached the event loop of the thread.
    """

    def __init__(self):
        self.row = np.zeros(signals.WIDTH)
        self.commands = np.zeros(io401.COMMANDS)
        self.ready = threading.Event()
        self.running = True
        self.errors = []
        self.thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)
        self.thread.start()
        assert self.ready.wait(PATIENCE_S)

    async def _run(self):
        asyncio.get_running_loop().set_exception_handler(lambda _, what: self.errors.append(what))
        hub = Hub(time.monotonic_ns)
        self.port = await hub.listen("socketcand", port=0)
        bench = nmt_master.NmtMaster(TABLE)
        members = rack.Rack()
        self.drives = [
            drive402.build(node, axle, self.row, control="bus")
            for axle, node in enumerate(TABLE.drive_nodes, 1)
        ]
        self.encoder = encoder406.build(TABLE, self.row)
        self.brake = io401.build(TABLE, self.row, self.commands)
        for member in (bench, *self.drives, self.encoder, self.brake):
            members.add(member)
        port = hub.attach(members.on_frame, "rig")
        members.start(port.send, time.monotonic_ns())
        self.ready.set()

        cycle = 0
        while self.running:
            await asyncio.sleep(CYCLE_S)
            members.poll(time.monotonic_ns())
            cycle += 1
            if cycle % CYCLES_A_SYNC == 0:
                bench.sync()
        await hub.close()

    def close(self):
        self.running = False
        self.thread.join(PATIENCE_S)


@pytest.fixture
def rig():
    thread = RigThread()
    yield thread
    thread.close()
    assert thread.errors == []


@pytest.fixture
def master(rig):
    network = canopen.Network()
    network.connect(
        interface="socketcand",
        host="127.0.0.1",
        port=rig.port,
        channel=signals.BUS_CHANNEL,
        tcp_tune=True,
    )
    yield network
    network.disconnect()


def eventually(condition):
    """Return whether a condition comes true within the patience."""
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        if condition():
            return True
        time.sleep(0.01)
    return False


def test_a_foreign_master_finds_every_node_of_the_rig(rig, master):
    master.scanner.search(limit=20)
    assert eventually(lambda: {1, 2, 3, 4, 16, 17} <= set(master.scanner.nodes))


@pytest.mark.conformance("Masters", "canopen BaseNode402 over socketcand moves a set-point")
def test_a_foreign_master_walks_a_drive_and_moves_its_set_point(rig, master):
    drive = PatientDrive(1, rig.drives[0].dictionary)
    master.add_node(drive)
    drive.nmt.wait_for_heartbeat(timeout=PATIENCE_S)
    drive.setup_402_state_machine()
    drive.rpdo[1].start(CYCLE_S)
    try:
        for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
            drive.state = state
        drive.op_mode = "PROFILED VELOCITY"
        drive.sdo[0x60FF].raw = 50_000  # 5 rad/s
        commands = rig.drives[0].device.axis.commands
        assert eventually(lambda: commands[axis.VELOCITY_rad_s] == pytest.approx(5.0))
        assert commands[axis.ENABLED] == 1.0
    finally:
        drive.rpdo[1].stop()


@pytest.mark.conformance("Masters", "canopen reads speeds by PDO and drives the valves")
def test_a_foreign_unit_reads_speeds_by_pdo_and_drives_the_valves(rig, master):
    unit = canopen.RemoteNode(16, rig.encoder.dictionary)
    brake = canopen.RemoteNode(17, rig.brake.dictionary)
    for node in (unit, brake):
        master.add_node(node)
        node.nmt.wait_for_heartbeat(timeout=PATIENCE_S)
        node.tpdo.read()
        node.rpdo.read()
    # the WSP unit is alive; without its heartbeat the magnets fall off
    heartbeat = master.send_periodic(0x720, b"\x05", 0.05)
    rig.row[TABLE.span("measured_speed")] = [90.0, 91.0, 92.0, 93.0]
    speeds = unit.tpdo[1]
    assert eventually(lambda: speeds.wait_for_reception(1) and speeds[3].raw == 9300)

    brake.rpdo[1][0].raw = 0b11_01_00_11
    brake.rpdo[1].transmit()
    assert eventually(lambda: rig.commands[: COACH.axles].tolist() == [3, 0, 1, 3])
    heartbeat.stop()
    assert eventually(lambda: not rig.commands[io401.MAGNETS].any())


def test_a_raw_python_can_client_sees_the_process_data_of_one_sync(rig):
    with can.Bus(
        interface="socketcand",
        host="127.0.0.1",
        port=rig.port,
        channel=signals.BUS_CHANNEL,
        tcp_tune=True,
    ) as bus:
        seen = []
        end_s = time.monotonic() + PATIENCE_S
        while seen.count(SYNC) < 3 and time.monotonic() < end_s:
            message = bus.recv(1.0)
            if message is not None and message.arbitration_id < 0x700:
                seen.append(message.arbitration_id)
    first = seen.index(SYNC)
    second = seen.index(SYNC, first + 1)
    # the brake demand (291h) comes with the first SYNC and after changes only
    every_cycle = [can_id for can_id in seen[first + 1 : second] if can_id != 0x291]
    assert sorted(every_cycle) == [
        0x181,
        0x182,
        0x183,
        0x184,
        0x190,
        0x191,
        0x281,
        0x282,
        0x283,
        0x284,
        0x290,
        0x390,
    ]
