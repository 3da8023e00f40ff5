"""Node 19: torques of motors, permitted shares, and a partner that is lost.

Only a process with motors has the node, so the test is such a process.
"""

import json

import pytest
from program import python

pytestmark = pytest.mark.xdist_group("vehicles")

SCRIPT = """
import json
import struct

import numpy as np

from rollerrig.firmware_sim import traction401
from rollerrig.firmware_sim.rack import Rack
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.frames import Frame

MS = 10**6
row = np.zeros(len(signals.COLUMNS))
row[signals.span("dynamic_torque")] = [1000.0, -2000.0, 0.0, 0.0, 500.0, 600.0]
row[signals.span("dynamic_share")] = 1.0
commands = np.ones(7)
commands[-1] = -1.0
found = {}
for group, shares in enumerate(([0, 1000, 500, 250], [100, 200])):
    offset = 32 * group
    rack = Rack()
    rack.add(traction401.build(row, commands, group=group))
    sent = []
    rack.start(sent.append, 0)
    rack.on_frame(Frame(0x000, b"\\x01\\x00"))
    rack.poll(1)
    rack.on_frame(Frame(0x213 + offset, struct.pack(f"<{len(shares)}h", *shares)))
    rack.on_frame(Frame(0x313, struct.pack("<h", 800)))
    found[f"commanded_{group}"] = commands.tolist()
    sent.clear()
    rack.on_frame(Frame(0x080, b""))
    rack.poll(2)
    found[f"sent_{group}"] = {f"{frame.can_id:03X}": frame.data.hex() for frame in sent}
    rack.on_frame(Frame(0x720 + offset, b"\\x05"))
    rack.poll(10 * MS)
    rack.poll(500 * MS)
    found[f"lost_{group}"] = commands.tolist()
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found():
    done = python("-c", SCRIPT, ROLLERRIG_AXLES="6", ROLLERRIG_EQUIPMENT="dynamic_brake")
    assert done.status == 0, done.messages
    return json.loads(done.printed)


def test_a_unit_permits_shares_to_the_motors_of_its_group_and_node_19_takes_a_demand(found):
    assert found["commanded_0"] == [0.0, 1.0, 0.5, 0.25, 1.0, 1.0, 0.8]
    assert found["commanded_1"][4:6] == [0.1, 0.2]
    # the node of a further group demands no traction
    assert found["commanded_1"][-1] == -1.0


def test_the_node_sends_torques_in_newton_metres_and_shares_per_mille(found):
    assert found["sent_0"] == {"193": "e80330f800000000", "293": "e803" * 4}
    assert found["sent_1"] == {"1B3": "f4015802", "2B3": "e803" * 2}


def test_when_the_unit_is_lost_the_motors_of_its_group_give_nothing(found):
    assert found["lost_0"] == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, -1.0]
    assert found["lost_1"][4:6] == [0.0, 0.0]
