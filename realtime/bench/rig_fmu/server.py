"""The process that computes for the library of an FMU: it answers requests over a socket.

The library starts it with the socket as standard input, and the folder of the resources as its only
argument. The first answer comes when the rig is built and compiled. The process exits when its
connection is closed, so also when the importing tool has crashed. What it prints goes to a file of
the library, which shows its last words if the process dies. `rig_fmu.c` describes the messages.
"""

import os
import socket
import struct
import sys
from typing import Any

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.bench.rig_fmu.rig import RefusedError, Rig

_LENGTH = struct.Struct("=I")
_TIMES = struct.Struct("=dd")
_REFERENCE = struct.Struct("=I")
_NUMBER = struct.Struct("=d")
_DONE = b"\0"
_REFUSED = b"\1"


def main() -> int:
    """Serve until the connection is closed; return the exit status."""
    connection = socket.socket(fileno=os.dup(0))
    # a program that reads standard input must not take requests
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    children.keep_working_folder_out()
    try:
        rig = Rig(sys.argv[1])
    except RollerrigError as error:
        _send(connection, _REFUSED + str(error).encode())
        return 2
    _send(connection, _DONE)
    while request := _receive(connection):
        try:
            answer = _DONE + _execute(rig, request[:1], request[1:])
        except RollerrigError as error:
            answer = _REFUSED + str(error).encode()
        _send(connection, answer)
    return 0


def _execute(rig: Rig, kind: bytes, content: bytes) -> bytes:
    """Return the content of the answer to a request. Raises RefusedError."""
    match kind:
        case b"D":
            at_s, step_s = _TIMES.unpack(content)
            return _NUMBER.pack(rig.step(at_s, step_s))
        case b"G":
            values = rig.get(_references(content), boolean=False)
            return struct.pack(f"={len(values)}d", *values)
        case b"g":
            return bytes(rig.get(_references(content), boolean=True))
        case b"S":
            count = len(content) // (_REFERENCE.size + _NUMBER.size)
            numbers: list[Any] = list(struct.unpack(f"={count}I{count}d", content))
            rig.set(numbers[:count], numbers[count:], boolean=False)
        case b"s":
            count = len(content) // (_REFERENCE.size + 1)
            switches: list[Any] = list(struct.unpack(f"={count}I{count}?", content))
            rig.set(switches[:count], switches[count:], boolean=True)
        case b"I":
            (start_s,) = _NUMBER.unpack(content)
            rig.begin(start_s)
        case b"R":
            rig.reset()
        case _:
            raise RefusedError(f"unknown request {kind!r}")
    return b""


def _references(content: bytes) -> list[int]:
    return list(struct.unpack(f"={len(content) // _REFERENCE.size}I", content))


def _send(connection: socket.socket, answer: bytes) -> None:
    """Send an answer. A library that is gone is noticed when the next request is read."""
    try:
        connection.sendall(_LENGTH.pack(len(answer)) + answer)
    except OSError:
        sys.exit(0)


def _receive(connection: socket.socket) -> bytes:
    """Return the next request; empty when the connection is closed."""
    head = _exactly(connection, _LENGTH.size)
    return _exactly(connection, _LENGTH.unpack(head)[0]) if head else b""


def _exactly(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        try:
            piece = connection.recv(size - len(data))
        except OSError:
            return b""
        if not piece:
            return b""
        data += piece
    return data


if __name__ == "__main__":
    sys.exit(main())
