"""One run of a train in free pacing, from its scenario to the folder with its record."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rollerrig.realtime.bench.options import Progress
from rollerrig.realtime.record import played
from rollerrig.realtime.train import record
from rollerrig.realtime.train.plan import Train
from rollerrig.realtime.train.stop import Stop

# ticks between two reports of progress
_TICKS = 5000


def record_run(
    train: Train,
    unit: str,
    out: Path,
    seed: int,
    on_progress: Callable[[Progress], None],
) -> dict[str, Any]:
    """Run a train to its end without a bus, write its folder, and return its summary.

    `unit`: "reference" or "none". Raises ConfigError.
    """
    record.begin(train, out)
    stop = Stop(train, unit, seed)
    while not stop.is_done:
        stop.run(_TICKS)
        on_progress(stop.progress())
    return record.write(stop, out, counters(stop, unit, seed, "free"))


def counters(stop: Stop, unit: str, seed: int, pacing: str) -> dict[str, Any]:
    """Return what the summaries of a run cannot take from its channels."""
    return {
        "pacing": pacing,
        "seed": seed,
        "random": stop.is_random,
        "unit": unit,
        "unit_played": played.unit_of(unit)._asdict(),
        "ended": "finished",
        "loop": {"ticks": stop.ticks, "missed": 0},
        "bus": {"frames": 0, "dropped": 0, "load_percent": 0.0},
        "modbus": {"requests": 0},
    }
