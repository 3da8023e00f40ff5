"""One run of a train, from its scenario to the folder with its record.

In free pacing there is no bus. In lockstep one car has a bus of its own, with the nodes and
identifiers of a vehicle alone, and a unit on it: the bench runs this car as it runs a vehicle, and
the other cars take their ticks with it.
"""

import asyncio
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.realtime.bench import bench
from rollerrig.realtime.bench.options import Options, Progress
from rollerrig.realtime.record import played
from rollerrig.realtime.train import plan, record
from rollerrig.realtime.train.plan import Train
from rollerrig.realtime.train.stop import Stop

# ticks between two reports of progress
_TICKS = 5000


def record_free(
    train: Train,
    unit: str,
    out: Path,
    seed: int,
    on_progress: Callable[[Progress], None],
) -> dict[str, Any]:
    """Run a train to its end without a bus, write its folder meanwhile, and return its summary.

    `unit`: "reference" or "none". Raises ConfigError.
    """
    record.begin(train, out)
    stop = Stop(train, unit, seed)
    recorder = record.Recorder(stop, out)
    while not stop.is_done:
        stop.run(_TICKS)
        recorder.add()
        on_progress(stop.progress())
    stop.end()
    return recorder.finish(counters(stop, unit, seed, "free"))


def record_on_bus(
    train: Train, car: int, options: Options, on_progress: Callable[[Progress], None]
) -> dict[str, Any]:
    """Run a train in lockstep with a unit on the bus of one car, counted from 1.

    `options` are those of the bench; `out` is the folder of the train. Writes the folder and
    returns the summary. Raises ConfigError, and what `Bench.run` raises.
    """
    if not 1 <= car <= len(train.cars):
        raise ConfigError(
            f"--car {car}: {train.name} has {len(train.cars)} cars; allowed are these"
        )
    of_car = train.cars[car - 1]
    if not of_car.has_unit:
        raise ConfigError(
            f"--car {car}: this car of {train.name} has unit = 'none'; allowed is a car with a unit"
        )
    out = options.out
    # the record of the car alone is that of its bench
    options = options._replace(out=record.folder_of_car(out, car))
    bench.check(of_car.plan, options)
    record.begin(train, out)
    named = dataclasses.replace(of_car.plan, name=record.name_of_car(train, car))
    running = bench.Bench(named, options, on_progress)
    stop = Stop(train, plan.REFERENCE, options.seed, car, running.parts.data)
    running.parts.ticks_of = lambda data: stop
    failure: RollerrigError | None = None
    try:
        asyncio.run(running.run())
    except RollerrigError as error:
        if stop.ticks == 0:
            # nothing has moved; the record of the car says why
            raise
        failure = error
    stop.end()
    of_run = counters(stop, plan.REFERENCE, options.seed, options.pacing)
    result = record.Recorder(stop, out, car).finish(of_run)
    if failure is not None:
        raise failure
    return result


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
