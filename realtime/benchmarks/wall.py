"""A wall-paced run to measure on: the real bench with bus, recorder and unit, for some seconds.

Its record lives in a temporary folder as long as the caller looks at it. Whatever else is to be measured runs beside
it in the bus thread's own event loop.
"""

import asyncio
import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.bench.bench import Bench
from rollerrig.realtime.bench.options import Options
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.loop.tick import TICK

SCENARIO = "velim_a1"
Beside = Callable[[Parts], Awaitable[Any]]


class Measured(NamedTuple):
    """A run that has ended: its parts, folder, summary, and what was measured beside it."""

    parts: Parts
    folder: Path
    summary: dict[str, Any]
    beside: Any
    bus_thread_share: float


@contextlib.contextmanager
def held(
    seconds: float,
    unit: str = "reference",
    settings: tuple[str, ...] = (),
    live: bool = False,
    beside: Beside | None = None,
) -> Iterator[Measured]:
    """Run the scenario for some seconds on a hub with a free port; the record lives in the block.

    `beside(parts)` runs once the bus is open. Raises RollerrigError as a run does, and
    KeyboardInterrupt where the user broke it off.
    """
    plan = scenario.load(
        SCENARIO,
        settings=(
            f"duration_max_s={seconds:g}",
            "bus.interface=hub",
            "bus.socketcand_port=0",
            "modbus.port=0",
            *settings,
        ),
    )
    with tempfile.TemporaryDirectory(prefix="rollerrig-bench-") as name:
        folder = Path(name) / "run"
        run = Bench(plan, Options("wall", unit, folder, live), lambda progress: None)
        summary, share, *found = asyncio.run(_run(run, beside))
        if run.parts.ended_by == "interrupted":
            raise KeyboardInterrupt
        yield Measured(run.parts, folder, summary, found[0] if found else None, share)


async def client(*arguments: object) -> Any:
    """Run `benchmarks.client` in a process of its own to its end, and return what it measured.

    Raises RollerrigError with its last words when it fails.
    """
    process = await asyncio.create_subprocess_exec(
        *children.command(
            sys.executable, "-m", "rollerrig.realtime.benchmarks.client", *map(str, arguments)
        ),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        out, error = await process.communicate()
    finally:
        if process.returncode is None:
            process.kill()
    if process.returncode:
        raise RollerrigError(
            "the benchmark's client has ended: " + error.decode(errors="replace").strip()[-300:]
        )
    return json.loads(out)


async def _run(run: Bench, beside: Beside | None) -> list[Any]:
    """The summary, the bus thread's share, and what was measured beside."""
    tasks = [asyncio.ensure_future(_share(run.parts))]
    if beside:
        tasks.append(asyncio.ensure_future(_when_open(run.parts, beside)))
    try:
        return [await run.run(), *await asyncio.wait_for(asyncio.gather(*tasks), 10.0)]
    except TimeoutError:
        raise RollerrigError(
            "what was measured beside the run has not ended with it; the machine may be overloaded: "
            "try again when it is less busy"
        ) from None
    finally:
        for task in tasks:
            task.cancel()


async def _when_open(parts: Parts, beside: Beside) -> Any:
    while parts.bus is None and not parts.stopping:
        await asyncio.sleep(0.01)
    return None if parts.stopping else await beside(parts)


async def _share(parts: Parts) -> float:
    """The share of a core that the bus thread takes between the first tick and the last."""
    while not (parts.data.control[TICK] or parts.stopping):
        await asyncio.sleep(0.01)
    begun_s, cpu_s, share = time.monotonic(), time.thread_time(), 0.0
    while not parts.stopping:
        await asyncio.sleep(0.05)
        share = (time.thread_time() - cpu_s) / (time.monotonic() - begun_s)
    return share
