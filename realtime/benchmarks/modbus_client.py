"""A Modbus TCP client in a process of its own: reads ten registers, one request after another.

    python -m rollerrig.realtime.benchmarks.modbus_client HOST PORT SECONDS

Each request goes out when the answer to the one before is there. The request is pymodbus', the socket is
plain: pymodbus' own client takes four times as long for a request as the server, and would measure
itself. What was measured goes to standard output as JSON.
"""

import json
import socket
import sys
import time

from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ReadHoldingRegistersRequest

REGISTERS = 10
_FIRST = 200
_ANSWER_BYTES = 9 + 2 * REGISTERS


def ask(host: str, port: int, seconds: float) -> dict[str, object]:
    """Requests a second, and each round trip in us."""
    trips_us: list[float] = []
    reading = ReadHoldingRegistersRequest(dev_id=1, transaction_id=1, address=_FIRST, count=REGISTERS)
    request = FramerSocket(DecodePDU(is_server=False)).buildFrame(reading)
    with socket.create_connection((host, port), 5.0) as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        begun = before = time.perf_counter()
        while before < begun + seconds:
            line.sendall(request)
            if len(line.recv(_ANSWER_BYTES)) != _ANSWER_BYTES:
                raise ConnectionError("an answer that is too short, or the end")
            now = time.perf_counter()
            trips_us.append(1e6 * (now - before))
            before = now
    return {"per_s": len(trips_us) / (before - begun), "trips_us": trips_us}


if __name__ == "__main__":
    print(json.dumps(ask(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))))
