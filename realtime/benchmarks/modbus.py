"""How many Modbus requests a second the supervisory PLC answers while the rig runs.

A client in a process of its own reads ten registers over TCP, one request after another, each sent
when the answer to the one before is there.

    python -m rollerrig.realtime.benchmarks.modbus HOST PORT SECONDS
"""

import asyncio
import json
import socket
import struct
import sys
import time
from typing import Any

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.benchmarks import figures, wall
from rollerrig.realtime.benchmarks.figures import Result, Target

AT_LEAST_PER_S = 15_000
REGISTERS = 10
_FIRST = 200
_REQUEST = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, _FIRST, REGISTERS)
_ANSWER_BYTES = 9 + 2 * REGISTERS
# the client's start and end lie inside the run
_MARGIN_S = 2.0


def requests(seconds: float) -> Result:
    """A run with a client: requests a second, round trips in us, and what the loop made of it."""
    with wall.held(seconds + _MARGIN_S, "none", beside=_client(seconds)) as measured:
        trips_us = figures.quantiles(measured.beside["trips_us"])
        loop = measured.summary["loop"]
        return {"per_s": measured.beside["per_s"], "registers": REGISTERS, "trip_us": trips_us,
                "answered": measured.summary["modbus"]["requests"], "missed_ticks": loop["missed"],
                "lateness_us": loop["lateness_us"], "bus_thread_share": measured.bus_thread_share}


def target(result: Result) -> Target:
    """The requirement, as the time that a request may take."""
    return Target(f"a Modbus request, for {AT_LEAST_PER_S} a second", 1e6 / result["per_s"],
                  1e6 / AT_LEAST_PER_S, "us")


def _client(seconds: float) -> wall.Beside:
    async def beside(bench: Any) -> Any:
        while not (bench.supervisor and bench.supervisor.port):
            await asyncio.sleep(0.01)
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "rollerrig.realtime.benchmarks.modbus", "127.0.0.1",
            str(bench.supervisor.port), f"{seconds:g}", stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE)
        out, error = await process.communicate()
        if process.returncode:
            raise RollerrigError("the benchmark's client has ended: "
                                 + error.decode(errors="replace").strip()[-300:])
        return json.loads(out)

    return beside


def ask(host: str, port: int, seconds: float) -> Result:
    """What the client does: ask and wait, again and again."""
    trips_us: list[float] = []
    with socket.create_connection((host, port), 5.0) as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        begun = before = time.perf_counter()
        while before < begun + seconds:
            line.sendall(_REQUEST)
            if len(line.recv(_ANSWER_BYTES)) != _ANSWER_BYTES:
                raise ConnectionError("an answer that is too short")
            now = time.perf_counter()
            trips_us.append(1e6 * (now - before))
            before = now
    return {"per_s": len(trips_us) / (before - begun), "trips_us": trips_us}


if __name__ == "__main__":
    print(json.dumps(ask(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))))
