"""Node 19: torques of motors, permitted shares, and a partner that is lost."""

import struct

import numpy as np
import pytest

from rollerrig.configs.vehicle import Kind
from rollerrig.firmware_sim import traction401
from rollerrig.firmware_sim.rack import Rack
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.frames import Frame

MS = 1_000_000  # ns
TABLE = signals.table(Kind(6, dynamic_brake=True))
# shares per mille that the unit of each group sends
SHARES = ((0, 1000, 500, 250), (100, 200))


class Played:
    """What the node of a group has commanded and sent.

    `commanded`: the array of commands after the frames of unit and driver. `sent`: the data of its
    frames after a SYNC, by identifier. `lost`: the array after the unit was lost.
    """

    def __init__(self, group):
        row = np.zeros(signals.WIDTH)
        row[TABLE.span("dynamic_torque")] = [1000.0, -2000.0, 0.0, 0.0, 500.0, 600.0]
        row[TABLE.span("dynamic_share")] = 1.0
        commands = np.ones(7)
        commands[-1] = -1.0
        offset = 32 * group
        shares = SHARES[group]
        frames = []
        rack = Rack()
        rack.add(traction401.build(TABLE, row, commands, group=group))
        rack.start(frames.append, 0)
        rack.on_frame(Frame(0x000, b"\x01\x00"))
        rack.poll(1)
        rack.on_frame(Frame(0x213 + offset, struct.pack(f"<{len(shares)}h", *shares)))
        rack.on_frame(Frame(0x313, struct.pack("<h", 800)))
        self.commanded = commands.tolist()

        frames.clear()
        rack.on_frame(Frame(0x080, b""))
        rack.poll(2)
        self.sent = {frame.can_id: frame.data.hex() for frame in frames}

        rack.on_frame(Frame(0x720 + offset, b"\x05"))
        rack.poll(10 * MS)
        rack.poll(500 * MS)
        self.lost = commands.tolist()


@pytest.fixture(scope="module")
def played():
    """The nodes of both groups, the leading one first."""
    return Played(0), Played(1)


def test_a_unit_permits_shares_to_the_motors_of_its_group_and_node_19_takes_a_demand(played):
    leading, further = played
    assert leading.commanded == [0.0, 1.0, 0.5, 0.25, 1.0, 1.0, 0.8]
    # the node of a further group demands no traction
    assert further.commanded == [1.0, 1.0, 1.0, 1.0, 0.1, 0.2, -1.0]


def test_the_node_sends_torques_in_newton_metres_and_shares_per_mille(played):
    leading, further = played
    assert leading.sent == {0x193: "e80330f800000000", 0x293: "e803" * 4}
    assert further.sent == {0x1B3: "f4015802", 0x2B3: "e803" * 2}


def test_when_the_unit_is_lost_the_motors_of_its_group_give_nothing(played):
    leading, further = played
    assert leading.lost == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, -1.0]
    assert further.lost == [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, -1.0]
