"""A client in a separate process, on the hub (socketcand over TCP, as any unit) or on Modbus TCP.

    python -m rollerrig.realtime.benchmarks.client ROLE HOST PORT BUS
    python -m rollerrig.realtime.benchmarks.client modbus HOST PORT SECONDS

    listen    notes when it has received the last TPDO of each SYNC
    unit      does the same, and answers each frame of axle speeds: all hold magnets on, off, on ...
    ask       measures round trips of a frame that the hub echoes, and of an SDO upload
    modbus    reads ten registers repeatedly; each request waits for the answer to the one before

The Modbus request is that of pymodbus, but the socket is plain: the client of pymodbus takes four
times as long for a request as the server, so it would measure itself.

The client prints what it measured as JSON when the bus closes, or when it has finished. Times are
CLOCK_MONOTONIC in ns, which all processes share.
"""

import contextlib
import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

from rollerrig.configs.vehicle import COACH
from rollerrig.wsp_interface import magnets, rig_objects, signals
from rollerrig.wsp_interface.bus import socketcand
from rollerrig.wsp_interface.bus.connection_set import SDO_REPLY, SDO_REQUEST, SYNC, TPDO
from rollerrig.wsp_interface.bus.frames import Frame

# identifiers: axle speeds, magnets, all TPDOs of the rig; the benches have the coach
SPEEDS = rig_objects.SPEEDS_ID
MAGNETS = rig_objects.MAGNETS_ID
_NODES = signals.table(COACH).rig_nodes
TPDOS = frozenset(first + node for first in TPDO for node in _NODES)
# a frame that the hub's echo returns with another identifier
ECHO_CALL = 0x7F0
ECHO_ANSWER = 0x7F1
# an SDO upload of 1000h (device type) from the axle speed unit
SDO_CALL = SDO_REQUEST + signals.SPEED_NODE
SDO_ANSWER = SDO_REPLY + signals.SPEED_NODE
_READ_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))
# data of heartbeats: boot-up, operational
_BOOT_UP = b"\x00"
_OPERATIONAL = b"\x05"
# a heartbeat goes out every so many SYNCs
_SYNCS_PER_HEARTBEAT = 5
_HOLD_ALL = magnets.pack([magnets.HOLDING] * COACH.axles)
# round trips in one block, and blocks of each kind
BLOCK = 25
_BLOCKS = 60
# of SCHED_FIFO
PRIORITY = 50
# holding registers of one Modbus request
REGISTERS = 10
_FIRST_REGISTER = 200
# a Modbus TCP answer: header, function and byte count, then the registers
_MODBUS_ANSWER_BYTES = 9 + 2 * REGISTERS


@dataclass
class Sync:
    """What the client received of one bus cycle."""

    stamp_us: int  # the hub's time stamp of the SYNC frame
    last_tpdo_ns: int = 0  # when the client had the last TPDO before the next SYNC; 0: none


def connect(host: str, port: int, bus: str) -> socket.socket:
    """Return a connection to the hub in rawmode. Raises ConnectionError where it is no such hub."""
    line = socket.create_connection((host, port), 5.0)
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for expected, command in ((b"hi", f"< open {bus} >"), (b"ok", "< rawmode >"), (b"ok", "")):
        if expected not in line.recv(256):
            raise ConnectionError(f"{host}:{port} is no CAN hub with a bus {bus}")
        line.sendall(command.encode())
    return line


def send(line: socket.socket, can_id: int, data: bytes) -> None:
    """Put a frame on the bus."""
    line.sendall(socketcand.encode_command(Frame(can_id, data)))


def frames(line: socket.socket) -> Iterator[tuple[int, Frame]]:
    """Yield (time of reception in ns, frame) until the bus closes.

    The frame's own time is the stamp of the hub.
    """
    rest = b""
    with contextlib.suppress(OSError):
        while chunk := line.recv(1 << 16):
            now_ns = time.monotonic_ns()
            *messages, rest = (rest + chunk).split(b">")
            for message in messages:
                frame = socketcand.parse_event(message.lstrip(b"< "))
                if frame:
                    yield now_ns, frame


def listen(line: socket.socket, answers: bool = False) -> dict[str, list[dict[str, int]]]:
    """Return `syncs`: a table of `Sync` for each SYNC, until the bus closes.

    With `answers` the client is a unit: it sends heartbeats, and magnets for each frame of speeds.
    """
    syncs: list[Sync] = []
    if answers:
        send(line, rig_objects.UNIT_HEARTBEAT_ID, _BOOT_UP)
        send(line, rig_objects.UNIT_HEARTBEAT_ID, _OPERATIONAL)
    for now_ns, frame in frames(line):
        if frame.can_id == SYNC:
            syncs.append(Sync(stamp_us=frame.time_ns // 1000))
            if answers and len(syncs) % _SYNCS_PER_HEARTBEAT == 0:
                send(line, rig_objects.UNIT_HEARTBEAT_ID, _OPERATIONAL)
        elif frame.can_id in TPDOS and syncs:
            syncs[-1].last_tpdo_ns = now_ns
            if answers and frame.can_id == SPEEDS:
                hold = len(syncs) % 2 == 1
                send(line, MAGNETS, bytes((_HOLD_ALL if hold else 0,)))
    return {"syncs": [asdict(sync) for sync in syncs]}


def listen_and_answer(line: socket.socket) -> dict[str, list[dict[str, int]]]:
    """Return what `listen` returns, and be a unit that answers."""
    return listen(line, answers=True)


def ask(line: socket.socket) -> dict[str, list[int]]:
    """Return the round trips `echo` and `sdo` in ns.

    They are measured in alternating blocks, so that both meet the same load of the machine.
    """
    trips_ns: dict[str, list[int]] = {"echo": [], "sdo": []}
    kinds = (
        ("echo", ECHO_CALL, ECHO_ANSWER, bytes(8)),
        ("sdo", SDO_CALL, SDO_ANSWER, _READ_DEVICE_TYPE),
    )
    received = frames(line)
    # a run that finishes early also finishes the measurement
    with contextlib.suppress(OSError):
        for name, call, answer, data in kinds * _BLOCKS:
            for _ in range(BLOCK):
                begun_ns = time.monotonic_ns()
                send(line, call, data)
                answered_ns = next((ns for ns, frame in received if frame.can_id == answer), None)
                if answered_ns is not None:
                    trips_ns[name].append(answered_ns - begun_ns)
    return trips_ns


def modbus(host: str, port: int, seconds: float) -> dict[str, object]:
    """Return the requests per second, and each round trip in us. Raises ConnectionError."""
    from pymodbus.framer import FramerSocket
    from pymodbus.pdu import DecodePDU, ReadHoldingRegistersRequest

    reading = ReadHoldingRegistersRequest(
        dev_id=1, transaction_id=1, address=_FIRST_REGISTER, count=REGISTERS
    )
    request = FramerSocket(DecodePDU(is_server=False)).buildFrame(reading)
    trips_us: list[float] = []
    with socket.create_connection((host, port), 5.0) as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        begun_s = time.perf_counter()
        before_s = begun_s
        while before_s < begun_s + seconds:
            line.sendall(request)
            if len(line.recv(_MODBUS_ANSWER_BYTES)) != _MODBUS_ANSWER_BYTES:
                raise ConnectionError("an answer is too short, or the server has closed")
            now_s = time.perf_counter()
            trips_us.append(1e6 * (now_s - before_s))
            before_s = now_s
    return {"per_s": len(trips_us) / (before_s - begun_s), "trips_us": trips_us}


def main(role: str, host: str, port: str, last: str) -> int:
    """Play a role until the bus closes (or the seconds are over), and print what was measured."""
    if role == "modbus":
        result: object = modbus(host, int(port), float(last))
    else:
        with contextlib.suppress(OSError):
            # a unit has its own controller, which no other program keeps busy
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        line = connect(host, int(port), last)
        roles: dict[str, Callable[[socket.socket], object]] = {
            "ask": ask,
            "listen": listen,
            "unit": listen_and_answer,
        }
        result = roles[role](line)
    print(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
