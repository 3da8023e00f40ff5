"""How many Modbus requests a second the supervisory PLC answers while the rig runs.

A client in a process of its own reads ten registers over TCP, one request after another, beside a
real run in wall pacing with nodes, recorder and real-time thread.
"""

import asyncio
from typing import Any

from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.benchmarks import figures, modbus_client, wall
from rollerrig.realtime.benchmarks.figures import Result, Target

AT_LEAST_PER_S = 15_000
# the client's start and end have to lie inside the run
_MARGIN_S = 4.0


def requests(seconds: float) -> Result:
    """A run with a client: requests a second, round trips in us, and what the loop made of it."""
    with wall.held(seconds + _MARGIN_S, "none", beside=_client(seconds)) as measured:
        loop = measured.summary["loop"]
        return {"per_s": measured.beside["per_s"], "registers": modbus_client.REGISTERS,
                "trip_us": figures.quantiles(measured.beside["trips_us"]),
                "answered": measured.summary["modbus"]["requests"], "missed_ticks": loop["missed"],
                "lateness_us": loop["lateness_us"], "bus_thread_share": measured.bus_thread_share}


def target(result: Result) -> Target:
    """The requirement, as the time that a request may take."""
    return Target(f"a Modbus request, for {AT_LEAST_PER_S} a second", 1e6 / result["per_s"],
                  1e6 / AT_LEAST_PER_S, "us")


def _client(seconds: float) -> wall.Beside:
    async def beside(parts: Parts) -> Any:
        while "modbus" not in parts.ports:
            await asyncio.sleep(0.01)
        return await wall.client("modbus_client", "127.0.0.1", str(parts.ports["modbus"]), f"{seconds:g}")

    return beside
