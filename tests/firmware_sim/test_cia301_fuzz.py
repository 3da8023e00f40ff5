"""Garbage on the bus: no frame makes a node raise, and none stops it (seeded)."""

import random

import numpy as np
import pytest

from rollerrig.firmware_sim import bench_node, nmt_master
from rollerrig.wsp_interface.bus.frames import Frame

FRAMES = 20_000
# identifiers that mean something to the nodes, and any others
LISTENED = (0x000, 0x080, 0x091, 0x100, 0x1A0, 0x201, 0x211, 0x27F, 0x301, 0x601, 0x610, 0x611,
            0x67F, 0x705, 0x710, 0x720, 0x7E5)
LSS_HEADS = (0x04, 0x11, 0x13, 0x15, 0x17, *range(0x40, 0x52), *range(0x5A, 0x5F))
NMT_HEADS = (1, 2, 128, 129, 130, 0, 255)
SDO_HEADS = (0x40, 0x60, 0x70, 0xA0, 0xA2, 0xA3, 0xC0, 0xC1, 0x80, 0xE0, 0x00, 0x10, 0x21, 0x23,
             0x2F, 0xC6, 0xA4)


def garbage(source):
    can_id = source.choice(LISTENED) if source.random() < 0.8 else source.randrange(0x800)
    data = bytearray(source.randbytes(source.choice((8, 8, 8, *range(9)))))
    if (0x600 < can_id < 0x620 or can_id == 0x67F) and len(data) == 8:
        data[0] = source.choice(SDO_HEADS)
        data[1:4] = source.choice((0x1000, 0x1016, 0x1600, 0x1A00, 0x1800, 0x6040, 0x6200, 0x6071,
                                   0x1010, 0x1F00, 0x2101, 0x1003)).to_bytes(2, "little") + bytes(
                                       [source.choice((0, 1, 2, 3, 255))])
    elif can_id == 0x7E5 and len(data) == 8:
        data[0] = source.choice(LSS_HEADS)
    elif can_id == 0 and len(data) >= 2:
        data[:2] = source.choice(NMT_HEADS), source.choice((0, 1, 16, 17, 127, 200))
        del data[source.choice((2, 2, 2, 3)):]
    if source.random() < 0.03:
        return Frame(can_id, b"", remote=True, dlc=source.randrange(9))
    if source.random() < 0.03:
        return Frame(source.randrange(1 << 29), bytes(data), extended=True)
    return Frame(can_id, bytes(data))


@pytest.mark.conformance("Bad input", "SDO, PDO, NMT, LSS, SYNC: seeded garbage")
@pytest.mark.conformance("CiA 301", "malformed NMT, SDO, PDO, LSS, SYNC: an answer or silence")
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_garbage_makes_a_node_raise_or_stops_it(wire, seed):
    source = random.Random(seed)
    harness = wire.plug(bench_node.build(wire.row, np.zeros(4), lambda: None))
    nodes = [wire.drive(1, control="bus"), wire.encoder(), wire.brake(), harness]
    bench = nmt_master.NmtMaster()
    bench.start(lambda frame: None, 0)
    wire.nmt(1)
    for at in range(FRAMES):
        frame = garbage(source)
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
        node.lss.configuring, node.lss.pending = False, node.dictionary.node_id
        node.reset_node()
    wire.nmt(1)
    wire.take()
    wire.sync()
    assert {one.can_id for one in wire.frames} >= {0x181, 0x190, 0x191}
    for number in (1, 16, 17, 127):
        assert wire.read(number, 0x1018, 4) == number.to_bytes(4, "little")
