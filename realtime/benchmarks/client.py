"""A client in a process of its own: of the hub, as any unit would be (plain TCP, socketcand), or of Modbus TCP.

    python -m rollerrig.realtime.benchmarks.client ROLE HOST PORT BUS
    python -m rollerrig.realtime.benchmarks.client modbus HOST PORT SECONDS

`listen` notes when the last TPDO of each SYNC is in its hands; `unit` answers the axle speeds too, with all hold
magnets on and off by turns; `ask` measures round trips, of a frame that the hub's own echo returns and of an SDO
upload, by turns. `modbus` reads ten registers, one request when the answer to the one before is there: the request is
pymodbus', the socket is plain, for pymodbus' own client takes four times as long for a request as the server, and
would measure itself. What was measured goes to standard output as JSON when the bus ends (or all is asked). Times are
CLOCK_MONOTONIC in ns, which all processes share.
"""

import contextlib
import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial

from rollerrig.wsp_interface import magnets, rig_objects, signals
from rollerrig.wsp_interface.bus import socketcand
from rollerrig.wsp_interface.bus.connection_set import SDO_REPLY, SDO_REQUEST, SYNC, TPDO
from rollerrig.wsp_interface.bus.frames import Frame

SPEEDS, MAGNETS = rig_objects.SPEEDS.can_id, rig_objects.MAGNETS_ID
ECHO_CALL, ECHO_ANSWER = 0x7F0, 0x7F1
SDO_CALL, SDO_ANSWER = SDO_REQUEST + signals.SPEED_NODE, SDO_REPLY + signals.SPEED_NODE
_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))
TPDOS = frozenset(first + node for first in TPDO for node in signals.RIG_NODES)
_HOLD_ALL = magnets.pack([magnets.HOLDING] * signals.AXLES)
BLOCK, _BLOCKS = 25, 60
PRIORITY = 50
REGISTERS, _FIRST_REGISTER = 10, 200


def connect(host: str, port: int, bus: str) -> socket.socket:
    """A connection to the hub in rawmode."""
    line = socket.create_connection((host, port), 5.0)
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for answer, command in ((b"hi", f"< open {bus} >"), (b"ok", "< rawmode >"), (b"ok", "")):
        if answer not in line.recv(256):
            raise ConnectionError(f"{host}:{port} is no CAN hub with a bus {bus}")
        line.sendall(command.encode())
    return line


def send(line: socket.socket, can_id: int, data: bytes) -> None:
    """Put a frame on the bus."""
    line.sendall(socketcand.encode_command(Frame(can_id, data)))


def frames(line: socket.socket) -> Iterator[tuple[int, Frame]]:
    """All frames until the bus ends, with when `recv` had them; their own times are the hub's stamps."""
    rest = b""
    with contextlib.suppress(OSError):
        while chunk := line.recv(1 << 16):
            now_ns = time.monotonic_ns()
            *whole, rest = (rest + chunk).split(b">")
            for one in whole:
                if frame := socketcand.parse_event(one.lstrip(b"< ")):
                    yield now_ns, frame


def listen(line: socket.socket, answers: bool = False) -> dict[str, list[list[int]]]:
    """For each SYNC its stamp in us, and when it and the last TPDO that followed it were here."""
    syncs: list[list[int]] = []
    if answers:
        send(line, rig_objects.UNIT_HEARTBEAT_ID, b"\x00")
        send(line, rig_objects.UNIT_HEARTBEAT_ID, b"\x05")
    for now_ns, frame in frames(line):
        if frame.can_id == SYNC:
            syncs.append([frame.time_ns // 1000, now_ns, 0])
            if answers and len(syncs) % 5 == 0:
                send(line, rig_objects.UNIT_HEARTBEAT_ID, b"\x05")
        elif frame.can_id in TPDOS and syncs:
            syncs[-1][2] = now_ns
            if answers and frame.can_id == SPEEDS:
                send(line, MAGNETS, bytes((_HOLD_ALL * (len(syncs) % 2),)))
    return {"syncs": syncs}


def ask(line: socket.socket) -> dict[str, list[int]]:
    """Round trips in ns, in blocks by turns so that both meet the same machine."""
    found: dict[str, list[int]] = {"echo": [], "sdo": []}
    kinds = (
        ("echo", ECHO_CALL, ECHO_ANSWER, bytes(8)),
        ("sdo", SDO_CALL, SDO_ANSWER, _DEVICE_TYPE),
    )
    heard = frames(line)
    # a run that ends early ends the questions
    with contextlib.suppress(OSError):
        for name, call, answer, data in kinds * _BLOCKS:
            for _ in range(BLOCK):
                begun_ns = time.monotonic_ns()
                send(line, call, data)
                now_ns = next((now_ns for now_ns, frame in heard if frame.can_id == answer), None)
                if now_ns is not None:
                    found[name].append(now_ns - begun_ns)
    return found


def modbus(host: str, port: int, seconds: float) -> dict[str, object]:
    """Requests a second, and each round trip in us."""
    from pymodbus.framer import FramerSocket
    from pymodbus.pdu import DecodePDU, ReadHoldingRegistersRequest

    trips_us: list[float] = []
    reading = ReadHoldingRegistersRequest(
        dev_id=1, transaction_id=1, address=_FIRST_REGISTER, count=REGISTERS
    )
    request, answer_bytes = (
        FramerSocket(DecodePDU(is_server=False)).buildFrame(reading),
        9 + 2 * REGISTERS,
    )
    with socket.create_connection((host, port), 5.0) as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        begun = before = time.perf_counter()
        while before < begun + seconds:
            line.sendall(request)
            if len(line.recv(answer_bytes)) != answer_bytes:
                raise ConnectionError("an answer that is too short, or the end")
            now = time.perf_counter()
            trips_us.append(1e6 * (now - before))
            before = now
    return {"per_s": len(trips_us) / (before - begun), "trips_us": trips_us}


ROLES: dict[str, Callable[[socket.socket], object]] = {
    "listen": listen,
    "unit": partial(listen, answers=True),
    "ask": ask,
}


def main(role: str, host: str, port: str, last: str) -> int:
    """Play a role until the bus ends (or the seconds are over), then tell."""
    if role == "modbus":
        found: object = modbus(host, int(port), float(last))
    else:
        with contextlib.suppress(OSError):
            # as a unit with a controller of its own, which nobody else keeps busy
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        found = ROLES[role](connect(host, int(port), last))
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
