"""The sander I/O: switched by RPDO and SDO, safe when its partner is lost, only where fitted."""

import cantools
import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import sander401
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.commands import devices
from rollerrig.wsp_interface import descriptions, signals
from rollerrig.wsp_interface.events import Code

TABLE = signals.table(COACH)
# NMT commands
START = 1
STOP = 2
RESET_NODE = 129


@pytest.fixture
def commands(wire):
    """The array of commands of the node: 1 where the sander of an axle is on."""
    commands = np.zeros(COACH.axles)
    wire.plug(sander401.build(TABLE, wire.row, commands))
    wire.nmt(START)
    wire.send(0x720, b"\x05")  # the WSP unit is alive
    return commands


@pytest.mark.conformance("CiA 401", "sanders: outputs 6200h by RPDO and SDO")
def test_the_unit_switches_the_sanders_by_rpdo_and_a_driver_by_sdo(wire, commands):
    wire.send(0x212, [0b00_01_00_01])
    assert commands.tolist() == [1, 0, 1, 0]
    wire.write(18, 0x6200, 1, 0x55, 1)
    assert commands.tolist() == [1, 1, 1, 1]


@pytest.mark.conformance(
    "CiA 401", "sanders stop when their partner is lost, when stopped and when reset"
)
@pytest.mark.parametrize("cause", ["lost", STOP, RESET_NODE])
def test_sanders_stop_when_the_partner_is_lost_or_the_node_is_stopped_or_reset(
    wire, commands, cause
):
    wire.send(0x212, [0x55])
    if cause == "lost":
        wire.run(199)
        assert commands.all()
        wire.run(1)
    else:
        wire.nmt(cause)
    assert not commands.any()
    assert wire.reported(Code.SANDERS_STOPPED)


def test_every_sync_sends_the_flow_of_sand_and_the_remaining_sand(wire, commands):
    wire.row[TABLE.span("sand_rate")] = (0.05, 0.0, 0.067, 0.0)
    wire.row[TABLE.span("sand_box")] = (29.5, 0.0, 12.34, 0.0)
    wire.take()
    wire.sync()
    frames = {frame.can_id: frame.data for frame in wire.frames}
    assert np.frombuffer(frames[0x192], "<i2").tolist() == [500, 0, 670, 0]
    assert np.frombuffer(frames[0x292], "<i2").tolist() == [2950, 0, 1234, 0]


def nodes_of(plan):
    """Return the node numbers of a scenario."""
    return sorted(dictionary.node_id for dictionary in devices.dictionaries(plan))


def test_eds_and_dbc_describe_the_sanders_of_a_vehicle_that_has_some(tmp_path):
    without = nodes_of(scenario.load("velim_a1"))
    fitted = scenario.load("velim_a1", settings=("sanders.axle=3",))
    assert signals.SANDER_NODE not in without
    assert sorted([*without, signals.SANDER_NODE]) == nodes_of(fitted)

    descriptions.write(tmp_path, TABLE, devices.dictionaries(fitted))
    assert list(tmp_path.glob("node_018_*.eds"))
    database = cantools.database.load_file(tmp_path / "rig.dbc")
    demand = {"sand_demand_1": 1, "sand_demand_2": 0, "sand_demand_3": 1, "sand_demand_4": 0}
    assert database.encode_message(0x212, demand) == b"\x11"
