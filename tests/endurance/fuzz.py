"""`rollerrig bench fuzz`: malformed and random inputs through every interface of a running bench.

The interfaces are the CAN protocols of the hub (frames of every kind, and broken text), the objects
of the harness, and Modbus over TCP and over a serial line. Nothing may crash, and everything must
answer afterwards. An input may affect the rig: a harness may inject faults, and a master may stop
the unit. The run must then report why it is not valid. Two requests that end a run are left out.

All inputs of an interface follow from its seed.
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

INPUTS = 1_000_000
# SYNCs that a polite client must receive afterwards
SYNCS = 20

# --- what inputs are made of ---

# identifiers that mean something to the nodes
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
LSS_REQUEST = 0x7E5
# objects that the nodes have
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
# first bytes of the services: LSS, NMT, SDO
LSS_COMMANDS = (0x04, 0x11, 0x13, 0x15, 0x17, *range(0x40, 0x52), *range(0x5A, 0x5F))
NMT_COMMANDS = (1, 2, 128, 129, 130, 0, 255)
SDO_COMMANDS = bytes.fromhex("40 60 70 A0 A2 A3 C0 C1 80 E0 00 10 21 23 2F C6 A4")
# objects of node 127 that a harness writes: (index, sub-index)
HARNESS_OBJECTS = (
    (rig.HARNESS, rig.JOINED),
    (rig.HARNESS, rig.CYCLE),
    (rig.PACING, 0),
    (rig.FAULT, rig.INJECT),
    (rig.FAULT, rig.LIFT),
    (rig.FRICTION, 1),
    (rig.FRICTION, 5),
    (rig.NOTE, 0),
)
# what it writes there: some faults with a short duration, the rest is wrong
HARNESS_TEXTS = (
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
# first byte of an SDO download in segments, and data bytes of a segment
_SEGMENTED_DOWNLOAD = 0x21
_SEGMENT_BYTES = 7
# function codes of Modbus that write coils
_WRITE_COILS = (5, 15)
_LARGEST_PDU = 253

# --- how a client connects ---

# what a client sends first, by the protocol of the hub
OPENINGS = {
    "socketcand": b"< open rig0 >< rawmode >",
    "slcan": b"C\rS6\rO\r",
    "virtualcan": b"",
    "cannelloni": cannelloni.HELLO,
}
# settings of a run that offers all interfaces
SETTINGS: tuple[str, ...] = ("--set", "modbus.serial=pty")
for _codec in OPENINGS:
    if _codec != "socketcand":  # each run has that one
        SETTINGS += ("--set", f"bus.{_codec}_port=0")
# inputs that are sent together, and the pause after them; on a serial line a message ends with
# silence
_BATCH = 20
_PAUSE_S = 0.002
_SILENCE_S = 0.025
# a client sends so many batches at most before it connects again, and may not read the answers
_BATCHES_PER_CONNECTION = 60
_SHARE_THAT_READS = 0.7
# seconds that nodes need after a reset
_RESET_S = 1.0
# a polite Modbus request for a speed, and the first bytes of its answer: function, byte count
_SPEED_REQUEST = bytes.fromhex("0001 0000 0006 01 04 00CA 0001")
_SPEED_ANSWER = b"\x04\x02"


# --- inputs ---


def random_frame(source: random.Random) -> Frame:
    """Return a frame of any kind: SDO, PDO, NMT, LSS, SYNC, EMCY, heartbeat, remote or extended.

    Most frames mean something to a node.
    """
    known = source.random() < 0.8
    can_id = source.choice(LISTENED) if known else source.randrange(0x800)
    data = bytearray(source.randbytes(source.choice((8, 8, 8, *range(9)))))
    if (0x600 < can_id < 0x620 or can_id == 0x67F) and len(data) == 8:
        data[0] = source.choice(SDO_COMMANDS)
        data[1:3] = source.choice(OBJECTS).to_bytes(2, "little")
        data[3] = source.choice((0, 1, 2, 3, 255))
    elif can_id == LSS_REQUEST and len(data) == 8:
        data[0] = source.choice(LSS_COMMANDS)
    elif can_id == NMT and len(data) >= 2:
        data[0] = source.choice(NMT_COMMANDS)
        data[1] = source.choice((0, 1, 16, 17, 127, 200))
        del data[source.choice((2, 2, 2, 3)) :]

    if source.random() < 0.03:
        return Frame(can_id, b"", remote=True, dlc=source.randrange(9))
    if source.random() < 0.03:
        return Frame(source.randrange(1 << 29), bytes(data), extended=True)
    return Frame(can_id, bytes(data))


def encoded_frame(codec: str, source: random.Random) -> bytes:
    """Return a random frame as a client of a protocol sends it."""
    if codec == "socketcand":
        return socketcand.encode_command(random_frame(source))
    return CODECS[codec].encode(random_frame(source))


def broken_command(source: random.Random) -> bytes:
    """Return a socketcand command with changed bytes, a word too many, or a missing end."""
    command = bytearray(encoded_frame("socketcand", source))
    for _ in range(source.randrange(3)):
        value = source.randrange(256)
        command[source.randrange(len(command))] = value
    more = source.choice(
        (b"", b"", b"< send >", b"< sendrtr 7FF 9 >", b"< error >", b"< add 0 0 1 8 >", b"<" * 300)
    )
    cut = source.randrange(1, len(command) + 1)
    end = source.choice((len(command), cut))
    return bytes(command[:end]) + more


def harness_request(source: random.Random) -> bytes:
    """Return an SDO request to node 127 as a harness sends it, whole in segments or with gaps."""
    index, sub = source.choice(HARNESS_OBJECTS)
    content = source.choice(HARNESS_TEXTS)
    command = source.choice(
        (_SEGMENTED_DOWNLOAD, _SEGMENTED_DOWNLOAD, 0x20, 0x23, 0x2B, 0x2F, 0x40)
    )
    size = source.choice((len(content), 0, 1, 1 << 31))
    messages = [bytes((command,)) + struct.pack("<HBI", index, sub, size)]
    if command == _SEGMENTED_DOWNLOAD:
        messages += _segments(content)

    sent = []
    for message in messages:
        if source.random() < 0.98:
            sent.append(socketcand.encode_command(Frame(SDO_REQUEST + BENCH_NODE, message)))
    return b"".join(sent)


def _segments(content: bytes) -> list[bytes]:
    """Return the segments of an SDO download (CiA 301): toggle bit, unused bytes, last segment."""
    messages = []
    for number, at in enumerate(range(0, len(content), _SEGMENT_BYTES)):
        part = content[at : at + _SEGMENT_BYTES]
        toggle = number % 2
        unused = _SEGMENT_BYTES - len(part)
        last = at + _SEGMENT_BYTES >= len(content)
        head = toggle << 4 | unused << 1 | last
        messages.append(bytes((head,)) + part.ljust(_SEGMENT_BYTES, b"\0"))
    return messages


def modbus_request(source: random.Random) -> bytes:
    """Return a Modbus request that is more or less wrong: cut, stretched, or completely random."""
    function = source.choice([*pdu.FUNCTIONS, source.randrange(256)])
    body = source.randbytes(source.choice([0, 1, 3, 4, 4, 4, 5, 6, 9, 12, 40, 200]))
    if source.random() < 0.5:
        address = source.choice([0, 1, 100, 200, 65535])
        count = source.randrange(130)
        body = struct.pack(">HH", address, count) + body[4:]
    return (bytes((function,)) + body)[:_LARGEST_PDU]


def _unit_of(source: random.Random, request: bytes) -> int:
    """Return the unit that a request goes to; 1 is the PLC, and 0 means every unit."""
    # not the coils of the PLC: one of them ends the run, as it should
    if request[0] in _WRITE_COILS:
        return source.choice((11, 14, 200))
    return source.choice((1, 11, 14, 0, 200))


def modbus_tcp(source: random.Random) -> bytes:
    """Return a request with a header that is correct, with few exceptions."""
    request = modbus_request(source)
    transaction = source.randrange(65536)
    wrong_protocol = source.random() < 0.002
    unit = _unit_of(source, request)
    header = struct.pack(">HHHB", transaction, wrong_protocol, len(request) + 1, unit)
    return header + request


def modbus_rtu(source: random.Random) -> bytes:
    """Return a request with a checksum that is correct in nine of ten cases."""
    request = modbus_request(source)
    # 0 would be every unit, and so the coils of the PLC, too
    unit = _unit_of(source, request) or 11
    message = bytes((unit,)) + request
    wrong_checksum = source.random() < 0.1
    return message + (FramerRTU.compute_CRC(message) ^ wrong_checksum).to_bytes(2, "big")


# --- interfaces ---


class Interface(NamedTuple):
    """A way into the bench."""

    name: str
    port: str  # key of `addresses`
    opening: bytes  # what a client sends first
    make: Callable[[random.Random], bytes]  # makes one input


INTERFACES = (
    *(
        Interface(f"frames, {codec}", codec, opening, partial(encoded_frame, codec))
        for codec, opening in OPENINGS.items()
    ),
    Interface("text of socketcand", "socketcand", OPENINGS["socketcand"], broken_command),
    Interface("harness", "socketcand", OPENINGS["socketcand"], harness_request),
    Interface("Modbus TCP", "modbus", b"", modbus_tcp),
    Interface("Modbus RTU", "serial", b"", modbus_rtu),
)
# a port of TCP on this machine, or the path of a serial device
Address = int | str


def addresses(run: runs.Run) -> dict[str, Address]:
    """Return where each interface is, from the events of the run."""
    found: dict[str, Address] = {}
    for codec in OPENINGS.keys() - {"socketcand"}:
        port = partial(run.event_fields, Code.BUS_PORT, protocol=codec)
        found[codec] = run.wait_for(port, f"its port of {codec}")["port"]
    place = run.wait_for(partial(run.event_fields, Code.BUS_PLACE), "its port of socketcand")
    found["socketcand"] = plugin.parse_address(place["address"])[1]
    served = run.wait_for(partial(run.event_fields, Code.MODBUS_SERVED), "its port of modbus")
    found["modbus"] = served["port"]
    line = run.wait_for(partial(run.event_fields, Code.MODBUS_SERIAL_SERVED), "its serial line")
    found["serial"] = line["device"]
    return found


def attack(
    interface: Interface,
    address: Address,
    source: random.Random,
    count: int,
    goes_on: Callable[[], bool],
) -> Result:
    """Send `count` inputs over one connection after another, as long as `goes_on()`.

    Some connections never read the answers. Returns what was sent and answered.
    """
    left = count
    connections = 0
    answered = 0
    while left and goes_on():
        with contextlib.suppress(OSError), _connected(address) as (write, read):
            connections += 1
            reads = source.random() < _SHARE_THAT_READS
            write(interface.opening)
            for _ in range(source.randrange(1, _BATCHES_PER_CONNECTION)):
                inputs = [interface.make(source) for _ in range(min(_BATCH, left))]
                write(b"".join(inputs) + _some_noise(source))
                left -= len(inputs)
                time.sleep(_SILENCE_S if isinstance(address, str) else _PAUSE_S)
                if reads:
                    answered += len(read())
                if not (left and goes_on()):
                    break
    return {
        "door": interface.name,
        "inputs": count - left,
        "connections": connections,
        "answered": answered,
    }


def _some_noise(source: random.Random) -> bytes:
    """Return random bytes in three of a hundred cases."""
    noise = source.randbytes(source.randrange(200))
    return noise if source.random() < 0.03 else b""


@contextlib.contextmanager
def _connected(address: Address) -> Any:
    """Connect to a port or a serial device; yield (write, read)."""
    if isinstance(address, int):
        with socket.create_connection(("127.0.0.1", address), 2.0) as line:
            line.settimeout(0.5)
            yield line.sendall, lambda: line.recv(1 << 16)
        return
    device = os.open(address, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield lambda data: os.write(device, data), lambda: os.read(device, 1 << 16)
    finally:
        os.close(device)


# --- judgement ---


def unanswered(where: dict[str, Address]) -> list[str]:
    """Return what does not answer a polite client: SYNC, SDO of any node, Modbus."""
    missing = ["SYNC", "SDO", "Modbus TCP"]
    with (
        contextlib.suppress(OSError),
        client.connect("127.0.0.1", int(where["socketcand"]), "rig0") as line,
    ):
        line.settimeout(10.0)
        frames = (frame for _, frame in client.frames(line))
        if _syncs_of(itertools.islice(frames, 50 * SYNCS)) >= SYNCS:
            missing.remove("SYNC")

        # an attack may have changed node numbers, so all numbers are tried
        client.send(line, NMT, bytes((Command.RESET_NODE, 0)))
        time.sleep(_RESET_S)
        for node in range(1, 128):
            client.send(line, SDO_REQUEST + node, b"\x40\x18\x10\x04" + bytes(4))
        if any(_answers_serial_number(f) for f in itertools.islice(frames, 100 * SYNCS)):
            missing.remove("SDO")
    with contextlib.suppress(OSError), _connected(where["modbus"]) as (write, read):
        write(_SPEED_REQUEST)
        # behind transaction, protocol, length and unit
        if read()[7:9] == _SPEED_ANSWER:
            missing.remove("Modbus TCP")
    return missing


def _syncs_of(frames: Iterable[Frame]) -> int:
    return sum(frame.can_id == client.SYNC for frame in frames)


def _answers_serial_number(frame: Frame) -> bool:
    """Return whether a frame answers an SDO upload of 1018h:4."""
    return SDO_REPLY < frame.can_id < SDO_REQUEST and frame.data[1:4] == b"\x18\x10\x04"


def failures(events: Iterable[Event]) -> list[str]:
    """Return what failed inside the bench, from its events."""
    return sorted({event.text for event in events if event.code == Code.BENCH_EXCEPTION})


def run(given: argparse.Namespace, say: Say) -> Result:
    """Attack a bench in real time until all inputs are sent or it exits; then judge it."""
    count = given.count or INPUTS
    say(f"{count} inputs ...")
    with (
        runs.started("--pacing", "wall", *SETTINGS) as bench,
        ThreadPoolExecutor(len(INTERFACES)) as attackers,
    ):
        where = addresses(bench)
        rows = bench.wait_for(bench.rows, "its first sample")

        def attack_one(interface: Interface) -> Result:
            return attack(
                interface,
                where[interface.port],
                random.Random(f"{given.seed} {interface.name}"),
                count=-(-count // len(INTERFACES)),  # rounded up
                goes_on=lambda: bench.process.poll() is None,
            )

        attacks = list(attackers.map(attack_one, INTERFACES))
        missing = unanswered(where)
        simulated_s = runs.last_s(rows)
        status = bench.stop()
        summary = records.summary(bench.folder)
        failed = failures(records.each_event(bench.folder))
        crashed = "Traceback" in bench.stderr() or status not in (0, 4)

    because = summary.get("invalid_because", [])
    explained = bool(because or summary.get("valid"))
    sent = min(count, sum(one["inputs"] for one in attacks))
    return {
        "doors": attacks,
        "simulated_s": simulated_s,
        "failures": failed,
        "because": because,
        "targets": [
            target("inputs that were not sent", count - sent, 0.0),
            target("runs with a traceback, or another exit status", float(crashed), 0.0),
            target("failures inside the bench", len(failed), 0.0),
            target("of SYNC, SDO and Modbus, those without an answer", len(missing), 0.0),
            target("runs that are not valid and do not report why", float(not explained), 0.0),
        ],
        "notes": [
            f"{simulated_s:.0f} s, {summary['bus']['frames']} frames; {'; '.join(because)}",
            *missing,
            *failed,
        ],
    }


def table(result: Result) -> Table:
    """Return what went through each interface."""
    rows = []
    for one in result["doors"]:
        rows.append((one["door"], one["inputs"], one["connections"], one["answered"]))
    return figures.table(
        "inputs through every interface",
        ("interface", "inputs", "connections", "bytes answered"),
        rows,
    )
