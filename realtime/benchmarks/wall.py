"""A run in real time to measure on: the real bench with bus, recorder and unit, for some seconds.

Its record is in a temporary folder, which exists as long as the caller needs it. What else is
measured runs in the event loop of the bus thread, next to the run.
"""

import asyncio
import contextlib
import json
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
# a measurement that runs next to the run; it gets the parts of the run
Measurement = Callable[[Parts], Awaitable[Any]]
# seconds that measurements have after the end of the run
_FINISH_WITHIN_S = 10.0


class Measured(NamedTuple):
    """A run that has finished."""

    parts: Parts
    folder: Path
    summary: dict[str, Any]
    result: Any  # of the measurement; None without one
    bus_thread_share: float  # of a core


@contextlib.contextmanager
def held(
    seconds: float,
    unit: str = "reference",
    settings: tuple[str, ...] = (),
    live: bool = False,
    measurement: Measurement | None = None,
) -> Iterator[Measured]:
    """Run the scenario for some seconds on a hub with a free port; the record exists in the block.

    `measurement(parts)` starts when the bus is open. Raises RollerrigError as a run does, and
    KeyboardInterrupt where the user interrupted the run.
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
        summary, share, result = asyncio.run(_run(run, measurement))
        if run.parts.ended_by == "interrupted":
            raise KeyboardInterrupt
        yield Measured(
            parts=run.parts,
            folder=folder,
            summary=summary,
            result=result,
            bus_thread_share=share,
        )


async def client(*arguments: object) -> Any:
    """Run `benchmarks.client` in a separate process until it exits; return what it measured.

    Raises RollerrigError with its last words when it fails.
    """
    words = children.module("rollerrig.realtime.benchmarks.client", *map(str, arguments))
    process = await asyncio.create_subprocess_exec(
        *children.command(*words),
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
        last_words = error.decode(errors="replace").strip()[-300:]
        raise RollerrigError(f"the client of the benchmark has failed: {last_words}")
    return json.loads(out)


async def _run(run: Bench, measurement: Measurement | None) -> tuple[dict[str, Any], float, Any]:
    """Return the summary, the bus thread's share of a core, and the result of the measurement."""
    tasks = [
        asyncio.ensure_future(_share(run.parts)),
        asyncio.ensure_future(_when_open(run.parts, measurement)),
    ]
    try:
        summary = await run.run()
        share, result = await asyncio.wait_for(asyncio.gather(*tasks), _FINISH_WITHIN_S)
        return summary, share, result
    except TimeoutError:
        raise RollerrigError(
            "a measurement has not finished with its run; the machine may be overloaded: "
            "try again when it is less busy"
        ) from None
    finally:
        for task in tasks:
            task.cancel()


async def _when_open(parts: Parts, measurement: Measurement | None) -> Any:
    """Start the measurement when the bus is open; return its result."""
    if measurement is None:
        return None
    while parts.bus is None and not parts.stopping:
        await asyncio.sleep(0.01)
    if parts.stopping:
        return None
    return await measurement(parts)


async def _share(parts: Parts) -> float:
    """Return the share of a core that the bus thread uses between the first and the last tick."""
    while not (parts.data.control[TICK] or parts.stopping):
        await asyncio.sleep(0.01)
    begun_s = time.monotonic()
    cpu_begun_s = time.thread_time()
    share = 0.0
    while not parts.stopping:
        await asyncio.sleep(0.05)
        share = (time.thread_time() - cpu_begun_s) / (time.monotonic() - begun_s)
    return share
