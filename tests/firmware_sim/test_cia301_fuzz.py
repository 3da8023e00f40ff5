"""Random frames on the bus: no frame makes a node raise or stops it."""

import random

import numpy as np
import pytest
from endurance import fuzz

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import bench_node, nmt_master
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus.frames import Frame

TABLE = signals.table(COACH)
FRAMES = 20_000


@pytest.mark.conformance("Bad input", "SDO, PDO, NMT, LSS, SYNC: seeded garbage")
@pytest.mark.conformance("CiA 301", "malformed NMT, SDO, PDO, LSS, SYNC: an answer or silence")
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_garbage_makes_a_node_raise_or_stops_it(wire, seed):
    source = random.Random(seed)
    harness = wire.plug(bench_node.build(TABLE, wire.row, np.zeros(4), lambda: None))
    nodes = [wire.drive(1, control="bus"), wire.encoder(), wire.brake(), harness]
    bench = nmt_master.NmtMaster(TABLE)
    bench.start(lambda frame: None, 0)
    wire.nmt(1)
    for at in range(FRAMES):
        frame = fuzz.random_frame(source)
        # not through the hub, which would report an exception instead of raising it
        for member in (*nodes, bench):
            member.on_frame(frame)
        if at % 20 == 0:
            wire.run(1)
            bench.poll(wire.now_ns)
            for member in nodes:
                member.on_frame(Frame(0x80, b""))
        if at % 500 == 0:
            wire.nmt(1)
        wire.frames.clear()
        wire.events.clear()
    for node in nodes:
        # an LSS master may have given another identifier
        node.lss.configuring = False
        node.lss.pending = node.dictionary.node_id
        node.reset_node()
    wire.nmt(1)
    wire.take()
    wire.sync()
    assert {frame.can_id for frame in wire.frames} >= {0x181, 0x190, 0x191}
    for number in (1, 16, 17, 127):
        assert wire.read(number, 0x1018, 4) == number.to_bytes(4, "little")
