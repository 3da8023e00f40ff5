"""A client of the hub in a process of its own, as any unit would be: plain TCP, socketcand.

    python -m rollerrig.realtime.benchmarks.client ROLE HOST PORT BUS

`listen` notes when the last TPDO of each SYNC is in its hands; `unit` answers the axle speeds too,
with all hold magnets on and off by turns; `ask` measures round trips, of a frame that the hub's own
echo returns and of an SDO upload, by turns. What was measured goes to standard output as JSON when
the bus ends (or all is asked). Times are CLOCK_MONOTONIC in ns, which all processes share.
"""

import contextlib
import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from rollerrig.wsp_interface import rig_objects, signals
from rollerrig.wsp_interface.bus.connection_set import SDO_REPLY, SDO_REQUEST, SYNC, TPDO

SPEEDS, MAGNETS = rig_objects.SPEEDS.can_id, rig_objects.MAGNETS_ID
ECHO_CALL, ECHO_ANSWER = 0x7F0, 0x7F1
SDO_CALL, SDO_ANSWER = SDO_REQUEST + signals.SPEED_NODE, SDO_REPLY + signals.SPEED_NODE
_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))
TPDOS = frozenset(first + node for first in TPDO for node in signals.RIG_NODES)
_HOLD_ALL = sum(1 << 2 * at for at in range(signals.AXLES))
BLOCK, _BLOCKS = 25, 60
PRIORITY = 50


class Heard(NamedTuple):
    """A frame: when `recv` had it, its identifier, and the hub's stamp in us of the run's clock."""

    time_ns: int
    can_id: int
    stamp_us: int


class Line:
    """A connection to the hub in rawmode."""

    def __init__(self, host: str, port: int, bus: str) -> None:
        self._socket = socket.create_connection((host, port), 5.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._rest = b""
        for answer, command in ((b"hi", f"< open {bus} >"), (b"ok", "< rawmode >"), (b"ok", "")):
            if answer not in self._socket.recv(256):
                raise ConnectionError(f"{host}:{port} is no CAN hub with a bus {bus}")
            self._socket.sendall(command.encode())

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame on the bus."""
        bytes_ = " ".join(f"{one:X}" for one in data)
        self._socket.sendall(f"< send {can_id:X} {len(data)} {bytes_} >".encode())

    def frames(self) -> Iterator[Heard]:
        """All frames until the bus ends."""
        while chunk := self._receive():
            now_ns = time.monotonic_ns()
            *whole, self._rest = (self._rest + chunk).split(b">")
            for one in whole:
                words = one.split()
                if words[1] == b"frame":
                    seconds, _, micros = words[3].partition(b".")
                    yield Heard(now_ns, int(words[2], 16), 1_000_000 * int(seconds) + int(micros))

    def _receive(self) -> bytes:
        try:
            return self._socket.recv(1 << 16)
        except OSError:
            return b""


def listen(line: Line, answers: bool = False) -> dict[str, list[list[int]]]:
    """For each SYNC its stamp in us, and when it and the last TPDO that followed it were here."""
    syncs: list[list[int]] = []
    if answers:
        line.send(rig_objects.UNIT_HEARTBEAT_ID, b"\x00")
        line.send(rig_objects.UNIT_HEARTBEAT_ID, b"\x05")
    for heard in line.frames():
        if heard.can_id == SYNC:
            syncs.append([heard.stamp_us, heard.time_ns, 0])
            if answers and len(syncs) % 5 == 0:
                line.send(rig_objects.UNIT_HEARTBEAT_ID, b"\x05")
        elif heard.can_id in TPDOS and syncs:
            syncs[-1][2] = heard.time_ns
            if answers and heard.can_id == SPEEDS:
                line.send(MAGNETS, bytes((_HOLD_ALL * (len(syncs) % 2),)))
    return {"syncs": syncs}


def unit(line: Line) -> dict[str, list[list[int]]]:
    """As `listen`, answering."""
    return listen(line, answers=True)


def ask(line: Line) -> dict[str, list[int]]:
    """Round trips in ns, in blocks by turns so that both meet the same machine."""
    found: dict[str, list[int]] = {"echo": [], "sdo": []}
    kinds = (("echo", ECHO_CALL, ECHO_ANSWER, bytes(8)),
             ("sdo", SDO_CALL, SDO_ANSWER, _DEVICE_TYPE))
    frames = line.frames()
    # a run that ends early ends the questions
    with contextlib.suppress(OSError):
        for name, call, answer, data in kinds * _BLOCKS:
            for _ in range(BLOCK):
                begun_ns = time.monotonic_ns()
                line.send(call, data)
                heard = next((one for one in frames if one.can_id == answer), None)
                if heard:
                    found[name].append(heard.time_ns - begun_ns)
    return found


ROLES: dict[str, Callable[[Line], object]] = {"listen": listen, "unit": unit, "ask": ask}


def main(role: str, host: str, port: str, bus: str) -> int:
    """Play a role until the bus ends, then tell."""
    with contextlib.suppress(OSError):
        # as a unit with a controller of its own, which nobody else keeps busy
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    print(json.dumps(ROLES[role](Line(host, int(port), bus))))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
