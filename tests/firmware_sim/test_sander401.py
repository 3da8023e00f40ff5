"""The sander I/O: asked by RPDO and SDO, safe when its partner is lost, described by EDS and DBC, only where fitted."""

import cantools
import numpy as np
import pytest

from rollerrig.firmware_sim import sander401
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.commands import devices
from rollerrig.wsp_interface import descriptions, signals
from rollerrig.wsp_interface.events import Code

START, STOP, RESET_NODE = 1, 2, 129


@pytest.fixture
def sander(wire):
    wire.asked = np.zeros(signals.AXLES)
    node = wire.plug(sander401.build(wire.row, wire.asked))
    wire.nmt(START)
    wire.send(0x720, b"\x05")
    return node


@pytest.mark.conformance("CiA 401", "sanders: outputs 6200h by RPDO and SDO")
def test_sanders_are_asked_by_the_unit_and_by_a_driver(wire, sander):
    wire.send(0x212, [0b00_01_00_01])
    assert wire.asked.tolist() == [1, 0, 1, 0]
    wire.write(18, 0x6200, 1, 0x55, 1)
    assert wire.asked.tolist() == [1, 1, 1, 1]


@pytest.mark.conformance(
    "CiA 401", "sanders stop when their partner is lost, when stopped and when reset"
)
@pytest.mark.parametrize("how", ["lost", STOP, RESET_NODE])
def test_sanders_stop_when_nobody_watches_them(wire, sander, how):
    wire.send(0x212, [0x55])
    if how == "lost":
        wire.run(199)
        assert wire.asked.all()
        wire.run(1)
    else:
        wire.nmt(how)
    assert not wire.asked.any()
    assert wire.reported(Code.SANDERS_STOPPED)


def test_rates_and_boxes_are_told_with_every_sync(wire, sander):
    wire.row[signals.span("sand_rate")] = (0.05, 0.0, 0.067, 0.0)
    wire.row[signals.span("sand_box")] = (29.5, 0.0, 12.34, 0.0)
    wire.take()
    wire.sync()
    assert np.frombuffer(wire.take(0x192)[0], "<i2").tolist() == [500, 0, 670, 0]
    assert np.frombuffer(wire.row.tobytes(), float).size == len(signals.COLUMNS)


def test_eds_and_dbc_describe_the_sanders_of_a_vehicle_that_has_some(tmp_path):
    plans = [scenario.load("velim_a1", settings=settings) for settings in ((), ("sanders.axle=3",))]
    without, fitted = ([one.node_id for one in devices.dictionaries(plan)] for plan in plans)
    assert signals.SANDER_NODE not in without
    assert sorted([*without, signals.SANDER_NODE]) == sorted(fitted)
    descriptions.write(tmp_path, devices.dictionaries(plans[1]))
    assert list(tmp_path.glob("node_018_*.eds"))
    asked = cantools.database.load_file(tmp_path / "rig.dbc").get_message_by_frame_id(0x212)
    assert (
        asked.encode({f"sand_demand_{axle}": int(axle in (1, 3)) for axle in range(1, 5)})
        == b"\x11"
    )
