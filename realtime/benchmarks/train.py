"""`rollerrig bench train`: five coaches with five units in real time, each on a bus of its own.

Each unit is a process. Measured are the lateness of the loop, the SYNCs, and the processor time of
all threads and processes between the first and the last tick, at three rates of SYNC.
"""

import argparse
import asyncio
import os
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table

from rollerrig.realtime.bench import bench
from rollerrig.realtime.bench.options import Options
from rollerrig.realtime.benchmarks import client, figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.loop.tick import TICK
from rollerrig.realtime.record import records
from rollerrig.realtime.train import plan
from rollerrig.realtime.train import run as train_run
from rollerrig.realtime.train.run import OnBuses

TRAIN = "five_coaches"
SECONDS = 20.0
# of SYNC; a tick takes 1 ms
RATES_HZ = (100, 500, 1000)
TICK_HZ = 1000
# requirements: cores, and the shares of ticks and SYNCs that may be missed
CORES = 2.0
MISSED_SHARE = 1e-3


class Processor(NamedTuple):
    """Processor time in s so far: of the bus thread, of all else in this process, and of others."""

    bus_thread: float
    loop: float
    units: float
    recorders: float


def run(given: argparse.Namespace, say: Say) -> Result:
    """Run the train at each rate for the requested seconds."""
    found = []
    for hz in RATES_HZ:
        say(f"{TRAIN}, SYNC at {hz} Hz, {given.seconds:g} s ...")
        found.append(_measured(hz, given.seconds, tuple(given.set)))
    targets = []
    for one in found:
        at = f"SYNC at {one['hz']} Hz"
        targets += [
            target(f"{at}: cores", one["cores"], CORES),
            target(f"{at}: share of ticks missed", one["missed"] / one["ticks"], MISSED_SHARE),
            target(f"{at}: share of SYNCs not sent", one["syncs_lost_share"], MISSED_SHARE),
        ]
    return {"rates": found, "targets": targets, "notes": []}


def _measured(hz: int, seconds: float, settings: tuple[str, ...]) -> Result:
    """Return the figures of one run. Raises RollerrigError; KeyboardInterrupt if interrupted."""
    of_run = (
        f"duration_max_s={seconds:g}",
        f"loop.tick_hz={TICK_HZ}",
        f"bus.sync_period_s={1 / hz!r}",
        "bus.interface=hub",
        "bus.socketcand_port=0",
    )
    train = plan.load(TRAIN, settings=(*of_run, *settings))
    with tempfile.TemporaryDirectory(prefix="rollerrig-bench-") as name:
        options = Options("wall", plan.REFERENCE, Path(name) / "run")
        ready = train_run.on_buses(train, (), options, lambda progress: None)
        cars = list(ready.benches.values())
        summaries, used_s, took_s = asyncio.run(_run(ready))
        if cars[0].parts.ended_by == "interrupted":
            raise KeyboardInterrupt
        period_us = round(1e6 / hz)
        syncs_us = [_syncs(car.parts.options.out) for car in cars]
        loop = summaries[0]["loop"]
        lost = [max(0.0, 1.0 - len(stamps) / _due(loop["ticks"], hz)) for stamps in syncs_us]
    return {
        "hz": hz,
        "ticks": loop["ticks"],
        "missed": loop["missed"],
        "lateness_us": loop["lateness_us"],
        "syncs_lost_share": max(lost),
        "sync_first_us": figures.quantiles(_after_tick(syncs_us[0], period_us)),
        "sync_last_us": figures.quantiles(_after_tick(syncs_us[-1], period_us)),
        "cores_of": {key: value / took_s for key, value in used_s._asdict().items()},
        "cores": sum(used_s) / took_s,
    }


def _due(ticks: int, hz: int) -> int:
    """Return the SYNCs of a run with so many ticks; with the last one it is over."""
    return max(1, (ticks - 1) * hz // TICK_HZ)


def _syncs(folder: Path) -> list[int]:
    """Return the time stamps of all SYNCs in us."""
    return [stamp for stamp, can_id, _ in records.frames(folder) if can_id == client.SYNC]


def _after_tick(stamps_us: Sequence[int], period_us: int) -> list[int]:
    """Return how long after the deadline of its tick each SYNC was sent, if within a period."""
    return [stamp % period_us for stamp in stamps_us]


async def _run(ready: OnBuses) -> tuple[list[dict[str, Any]], Processor, float]:
    """Return the summaries, and the processor time from the first to the last tick, in s."""
    measuring = asyncio.ensure_future(_used(ready))
    try:
        summaries = await bench.run(list(ready.benches.values()))
        return summaries, *await measuring
    finally:
        measuring.cancel()


async def _used(ready: OnBuses) -> tuple[Processor, float]:
    parts = [one.parts for one in ready.benches.values()]
    first = parts[0]
    while not (first.data.control[TICK] or first.stopping):
        await asyncio.sleep(0.01)
    begun_s = now_s = time.monotonic()
    begun = now = _processor(ready)
    while not any(one.stopping for one in parts):
        now_s, now = time.monotonic(), _processor(ready)
        await asyncio.sleep(0.1)
    used = Processor(*(after - before for after, before in zip(now, begun, strict=True)))
    return used, max(now_s - begun_s, 0.1)


def _processor(ready: OnBuses) -> Processor:
    processes = [one.parts.processes for one in ready.benches.values()]
    bus_thread_s = time.thread_time()
    return Processor(
        bus_thread=bus_thread_s,
        loop=time.process_time() - bus_thread_s,
        units=_time_of(unit.pid for one in processes for unit in one.units),
        recorders=_time_of(one.recorder.pid for one in processes if one.recorder),
    )


def _time_of(pids: Iterable[int]) -> float:
    """Return the processor time of processes in s; one that has exited counts as 0."""
    ticks = 0
    for pid in pids:
        try:
            stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
        except OSError:
            continue
        # user and system time; the name before them may have blanks, and ends with a bracket
        ticks += sum(map(int, stat.rpartition(")")[2].split()[11:13]))
    return ticks / os.sysconf("SC_CLK_TCK")


def table(result: Result) -> Table:
    """Return a row for each figure, and a column for each rate."""
    rates = result["rates"]
    rows: list[tuple[object, ...]] = []
    for key, title in (
        ("lateness_us", "lateness of a tick, us"),
        ("sync_first_us", "SYNC of the first car after its tick, us"),
        ("sync_last_us", "SYNC of the last car after its tick, us"),
    ):
        rows += [
            (f"{title}: {name}", *(one[key].get(name) for one in rates))
            for name in figures.QUANTILES
        ]
    rows.append(("ticks", *(one["ticks"] for one in rates)))
    rows.append(("ticks missed", *(one["missed"] for one in rates)))
    rows.append(("share of SYNCs not sent", *(one["syncs_lost_share"] for one in rates)))
    for key, title in (
        ("bus_thread", "cores: bus thread with all nodes"),
        ("loop", "cores: real-time loop"),
        ("units", "cores: five units"),
        ("recorders", "cores: five recorders"),
    ):
        rows.append((title, *(one["cores_of"][key] for one in rates)))
    rows.append(("cores: all", *(one["cores"] for one in rates)))
    heads = ("", *(f"SYNC at {one['hz']} Hz" for one in rates))
    return figures.table(f"{TRAIN} in real time, five buses and five units", heads, rows)
