"""Malformed and random inputs through every door of running benches: nothing may crash, and all must answer after it.

The doors: the CAN protocols of the hub, frames of every kind and broken text, the harness' objects, Modbus over TCP and
over a serial line. What an input does to the rig is its right: a harness may inject faults, a master stop the unit. The
run must tell why it is then not valid. Left out are the two wishes that end a run, for they would.
"""

import argparse
import contextlib
import itertools
import os
import random
import socket
import struct
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

from pymodbus.framer import FramerRTU
from rich.table import Table

from endurance import runs
from rollerrig.firmware_sim.cia301.nmt import Command
from rollerrig.firmware_sim.modbus import pdu
from rollerrig.realtime.benchmarks import client, figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import rig_objects as rig
from rollerrig.wsp_interface.bus import cannelloni, plugin, socketcand
from rollerrig.wsp_interface.bus.codecs import CODECS
from rollerrig.wsp_interface.bus.connection_set import NMT, SDO_REPLY, SDO_REQUEST
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code, Event
from rollerrig.wsp_interface.signals import BENCH_NODE

INPUTS, SYNCS = 1_000_000, 20
# identifiers that mean something to the nodes, objects that do, and heads of the services
LISTENED = (
    0x000,
    0x080,
    0x091,
    0x100,
    0x1A0,
    0x201,
    0x211,
    0x27F,
    0x301,
    0x601,
    0x610,
    0x611,
    0x67F,
    0x705,
    0x710,
    0x720,
    0x7E5,
)
OBJECTS = (
    0x1000,
    0x1016,
    0x1600,
    0x1A00,
    0x1800,
    0x6040,
    0x6200,
    0x6071,
    0x1010,
    0x1F00,
    0x2101,
    0x1003,
)
LSS_HEADS = (0x04, 0x11, 0x13, 0x15, 0x17, *range(0x40, 0x52), *range(0x5A, 0x5F))
NMT_HEADS = (1, 2, 128, 129, 130, 0, 255)
SDO_HEADS = bytes.fromhex("40 60 70 A0 A2 A3 C0 C1 80 E0 00 10 21 23 2F C6 A4")
WISHES = (
    (rig.HARNESS, rig.JOINED),
    (rig.HARNESS, rig.CYCLE),
    (rig.PACING, 0),
    (rig.FAULT, rig.INJECT),
    (rig.FAULT, rig.LIFT),
    (rig.FRICTION, 1),
    (rig.FRICTION, 5),
    (rig.NOTE, 0),
)
TEXTS = (
    b"speed_sensor_stuck axle=2 for=0.1",
    b"wsp_frozen for=0.1",
    b"bus_off node=17 for=0.1",
    b"no_such_fault",
    b"speed_sensor_stuck axle=9",
    b"magnet",
    b"\xff\xfe\x00",
    b"x" * 300,
    b"",
)
OPENINGS = {
    "socketcand": b"< open rig0 >< rawmode >",
    "slcan": b"C\rS6\rO\r",
    "virtualcan": b"",
    "cannelloni": cannelloni.HELLO,
}
SETTINGS = (
    *(
        word
        for codec in OPENINGS
        if codec != "socketcand"
        for word in ("--set", f"bus.{codec}_port=0")
    ),
    "--set",
    "modbus.serial=pty",
)
# a serial line begins anew after a silence
_BATCH, _PAUSE_S, _SILENCE_S, _RESET_S = 20, 0.002, 0.025, 1.0
_SPEED_REQUEST, _SPEED_ANSWER = bytes.fromhex("0001 0000 0006 01 04 00CA 0001"), b"\x04\x02"


def garbage(source: random.Random) -> Frame:
    """A frame of any kind: SDO, PDO, NMT, LSS, SYNC, EMCY, heartbeat, remote, extended; most mean something."""
    can_id = source.choice(LISTENED) if source.random() < 0.8 else source.randrange(0x800)
    data = bytearray(source.randbytes(source.choice((8, 8, 8, *range(9)))))
    if (0x600 < can_id < 0x620 or can_id == 0x67F) and len(data) == 8:
        data[0] = source.choice(SDO_HEADS)
        data[1:4] = source.choice(OBJECTS).to_bytes(2, "little") + bytes(
            [source.choice((0, 1, 2, 3, 255))]
        )
    elif can_id == 0x7E5 and len(data) == 8:
        data[0] = source.choice(LSS_HEADS)
    elif can_id == 0 and len(data) >= 2:
        data[:2] = source.choice(NMT_HEADS), source.choice((0, 1, 16, 17, 127, 200))
        del data[source.choice((2, 2, 2, 3)) :]
    if source.random() < 0.03:
        return Frame(can_id, b"", remote=True, dlc=source.randrange(9))
    if source.random() < 0.03:
        return Frame(source.randrange(1 << 29), bytes(data), extended=True)
    return Frame(can_id, bytes(data))


def frame(codec: str, source: random.Random) -> bytes:
    """Any frame as a client of a protocol sends it."""
    encode = socketcand.encode_command if codec == "socketcand" else CODECS[codec].encode
    return encode(garbage(source))


def text(source: random.Random) -> bytes:
    """A command of socketcand with something wrong: a byte changed, a word too many, cut, or none at all."""
    words = bytearray(frame("socketcand", source))
    for _ in range(source.randrange(3)):
        words[source.randrange(len(words))] = source.randrange(256)
    more = source.choice(
        (b"", b"", b"< send >", b"< sendrtr 7FF 9 >", b"< error >", b"< add 0 0 1 8 >", b"<" * 300)
    )
    return bytes(words[: source.choice((len(words), source.randrange(1, len(words) + 1)))]) + more


def wish(source: random.Random) -> bytes:
    """What a harness asks of node 127, whole in segments or with parts missing."""
    index, sub = source.choice(WISHES)
    words, head = source.choice(TEXTS), source.choice((0x21, 0x21, 0x20, 0x23, 0x2B, 0x2F, 0x40))
    parts = [
        bytes((head,)) + struct.pack("<HBI", index, sub, source.choice((len(words), 0, 1, 1 << 31)))
    ]
    for at in range(0, len(words) if head == 0x21 else 0, 7):
        part, last = words[at : at + 7], at + 7 >= len(words)
        parts.append(
            bytes(((at // 7 % 2) << 4 | (7 - len(part)) << 1 | last,)) + part.ljust(7, b"\0")
        )
    return b"".join(
        socketcand.encode_command(Frame(SDO_REQUEST + BENCH_NODE, one))
        for one in parts
        if source.random() < 0.98
    )


def mutated(source: random.Random) -> bytes:
    """A Modbus request that is somewhat wrong: cut, stretched, flipped, or random from the beginning."""
    function = source.choice([*pdu.FUNCTIONS, source.randrange(256)])
    body = source.randbytes(source.choice([0, 1, 3, 4, 4, 4, 5, 6, 9, 12, 40, 200]))
    if source.random() < 0.5:
        body = (
            struct.pack(">HH", source.choice([0, 1, 100, 200, 65535]), source.randrange(130))
            + body[4:]
        )
    return (bytes((function,)) + body)[:253]


def _to_unit(source: random.Random, request: bytes) -> int:
    # not the coils of the PLC: one of them ends the run, as it should
    return (
        source.choice((11, 14, 200))
        if request[0] in (5, 15)
        else source.choice((1, 11, 14, 0, 200))
    )


def modbus_tcp(source: random.Random) -> bytes:
    """A request behind a header that is right, mostly."""
    request = mutated(source)
    return (
        struct.pack(
            ">HHHB",
            source.randrange(65536),
            source.random() < 0.002,
            len(request) + 1,
            _to_unit(source, request),
        )
        + request
    )


def modbus_rtu(source: random.Random) -> bytes:
    """A request with a checksum that is right, mostly; 0 would be everybody, the coils of the PLC too."""
    request = mutated(source)
    frame = bytes((_to_unit(source, request) or 11,)) + request
    return frame + (FramerRTU.compute_CRC(frame) ^ (source.random() < 0.1)).to_bytes(2, "big")


class Door(NamedTuple):
    """A way in: whose port it is, how one begins there, and what makes inputs."""

    name: str
    port: str
    opening: bytes
    make: Callable[[random.Random], bytes]


DOORS = (
    *(
        Door(f"frames, {codec}", codec, opening, partial(frame, codec))
        for codec, opening in OPENINGS.items()
    ),
    Door("text of socketcand", "socketcand", OPENINGS["socketcand"], text),
    Door("harness", "socketcand", OPENINGS["socketcand"], wish),
    Door("Modbus TCP", "modbus", b"", modbus_tcp),
    Door("Modbus RTU", "serial", b"", modbus_rtu),
)


def attack(
    door: Door, place: int | str, source: random.Random, count: int, goes_on: Callable[[], bool]
) -> Result:
    """Send inputs, over a connection after another, until it is enough; some never read what they are sent."""
    left, connections, answered = count, 0, 0
    while left and goes_on():
        with contextlib.suppress(OSError), _connected(place) as (write, read):
            connections, reads = connections + 1, source.random() < 0.7
            write(door.opening)
            for _ in range(source.randrange(1, 60)):
                wires = [door.make(source) for _ in range(min(_BATCH, left))]
                write(
                    b"".join(wires)
                    + source.randbytes(source.randrange(200)) * (source.random() < 0.03)
                )
                left -= len(wires)
                time.sleep(_SILENCE_S if isinstance(place, str) else _PAUSE_S)
                answered += len(read()) if reads else 0
                if not (left and goes_on()):
                    break
    return {
        "door": door.name,
        "inputs": count - left,
        "connections": connections,
        "answered": answered,
    }


@contextlib.contextmanager
def _connected(place: int | str) -> Any:
    """Writing to and reading from a port, or a serial device."""
    if isinstance(place, int):
        with socket.create_connection(("127.0.0.1", place), 2.0) as line:
            line.settimeout(0.5)
            yield line.sendall, lambda: line.recv(1 << 16)
        return
    device = os.open(place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield lambda data: os.write(device, data), lambda: os.read(device, 1 << 16)
    finally:
        os.close(device)


def places(run: runs.Run) -> dict[str, int | str]:
    """Return where each door is, from the events of the run."""
    found: dict[str, int | str] = {}
    for codec in OPENINGS.keys() - {"socketcand"}:
        port = partial(run.heard, Code.BUS_PORT, protocol=codec)
        found[codec] = run.until(port, f"its port of {codec}")["port"]
    place = run.until(partial(run.heard, Code.BUS_PLACE), "its port of socketcand")
    found["socketcand"] = plugin.parse_address(place["address"])[1]
    served = run.until(partial(run.heard, Code.MODBUS_SERVED), "its port of modbus")
    found["modbus"] = served["port"]
    line = run.until(partial(run.heard, Code.MODBUS_SERIAL_SERVED), "its serial line")
    found["serial"] = line["device"]
    return found


def answers(where: dict[str, int | str]) -> list[str]:
    """What does not answer a polite client: SYNC, SDO of the nodes, under whatever number they are, Modbus."""
    missing = ["SYNC", "SDO", "Modbus TCP"]
    with (
        contextlib.suppress(OSError),
        client.connect("127.0.0.1", int(where["socketcand"]), "rig0") as line,
    ):
        line.settimeout(10.0)
        heard = (frame for _, frame in client.frames(line))
        if (
            sum(frame.can_id == client.SYNC for frame in itertools.islice(heard, 50 * SYNCS))
            >= SYNCS
        ):
            missing.remove("SYNC")
        client.send(line, NMT, bytes((Command.RESET_NODE, 0)))
        time.sleep(_RESET_S)
        for node in range(1, 128):
            client.send(line, SDO_REQUEST + node, b"\x40\x18\x10\x04" + bytes(4))
        if any(
            SDO_REPLY < frame.can_id < SDO_REQUEST and frame.data[1:4] == b"\x18\x10\x04"
            for frame in itertools.islice(heard, 100 * SYNCS)
        ):
            missing.remove("SDO")
    with contextlib.suppress(OSError), _connected(where["modbus"]) as (write, read):
        write(_SPEED_REQUEST)
        if read()[7:9] == _SPEED_ANSWER:
            missing.remove("Modbus TCP")
    return missing


def failures(events: Iterable[Event]) -> list[str]:
    """Return what failed inside the bench, from its events."""
    return sorted({event.text for event in events if event.code == Code.BENCH_EXCEPTION})


def run(given: argparse.Namespace, say: Say) -> Result:
    """Attack a bench in real time until all inputs are sent, or it has ended; see what still answers; end it."""
    count = given.count or INPUTS
    say(f"{count} inputs ...")
    with (
        runs.started("--pacing", "wall", *SETTINGS) as bench,
        ThreadPoolExecutor(len(DOORS)) as strangers,
    ):
        where = places(bench)
        rows = bench.until(bench.rows, "its first sample")
        doors = list(
            strangers.map(
                lambda door: attack(
                    door,
                    where[door.port],
                    random.Random(f"{given.seed} {door.name}"),
                    -(-count // len(DOORS)),
                    lambda: bench.process.poll() is None,
                ),
                DOORS,
            )
        )
        missing, simulated_s = answers(where), runs.last_s(rows)
        status, summary = bench.end(), records.summary(bench.folder)
        failed = failures(records.each_event(bench.folder))
        crashed = "Traceback" in bench.words() or status not in (0, 4)
    because = summary.get("invalid_because", [])
    return {
        "doors": doors,
        "simulated_s": simulated_s,
        "failures": failed,
        "because": because,
        "targets": [
            target(
                "inputs that were not sent",
                count - min(count, sum(one["inputs"] for one in doors)),
                0.0,
            ),
            target("runs with a traceback, or a status of their own", float(crashed), 0.0),
            target("failures inside the bench", len(failed), 0.0),
            target("of SYNC, SDO and Modbus what does not answer after it", len(missing), 0.0),
            target(
                "runs that are not valid and do not say why",
                float(not (because or summary.get("valid"))),
                0.0,
            ),
        ],
        "notes": [
            f"{simulated_s:.0f} s, {summary['bus']['frames']} frames; {'; '.join(because)}",
            *missing,
            *failed,
        ],
    }


def table(result: Result) -> Table:
    """What went through each door."""
    return figures.table(
        "inputs through every door",
        ("door", "inputs", "connections", "bytes answered"),
        [tuple(one.values()) for one in result["doors"]],
    )
