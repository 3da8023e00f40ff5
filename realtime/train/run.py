"""One run of a train, from its scenario to the folder with its record.

In free pacing there is no bus. In lockstep and in real time some cars have buses of their own, each
with the nodes and identifiers of a vehicle alone, and a unit on it: the bench runs these cars as it
runs a vehicle, and all cars take their ticks together.
"""

import asyncio
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.realtime.bench import bench, rig_bus
from rollerrig.realtime.bench.options import Options, Progress
from rollerrig.realtime.bench.scenario import AUTOMATIC_PORT, Scenario
from rollerrig.realtime.record import played
from rollerrig.realtime.train import plan, record
from rollerrig.realtime.train.plan import Train
from rollerrig.realtime.train.stop import Stop
from rollerrig.wsp_interface.bus.codecs import CODECS

# ticks between two reports of progress
_TICKS = 5000


def record_free(
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
    stop.end()
    return record.write(stop, out, counters(stop, unit, seed, "free"))


class OnBuses(NamedTuple):
    """A train that is ready to run: the benches of the cars with buses, by car, and the stop."""

    benches: dict[int, bench.Bench]
    stop: Stop


def on_buses(
    train: Train,
    cars: Sequence[int],
    options: Options,
    on_progress: Callable[[Progress], None],
) -> OnBuses:
    """Return a train with units on the buses of cars, counted from 1; empty: all with a unit.

    `options` are those of the bench; `out` is the folder of the train. Raises ConfigError.
    """
    numbers = _checked(train, cars)
    out = options.out
    plans = {number: _on_own_bus(train, number, numbers, options) for number in numbers}
    # the record of a car on a bus is that of its bench
    given = {}
    for number in numbers:
        given[number] = options._replace(out=record.folder_of_car(out, number))
        bench.check(plans[number], given[number])
        # the processes that wait already are those of the first car
        options = options._replace(recorder=None, waiting_unit=None)
    record.begin(train, out)
    benches = {}
    for number in numbers:
        report = _of_car(on_progress, number, has_figures=number == numbers[0])
        benches[number] = bench.Bench(plans[number], given[number], report, number)
    data = {number: one.parts.data for number, one in benches.items()}
    stop = Stop(train, plan.REFERENCE, options.seed, data)
    for one in benches.values():
        one.parts.train_deceleration_m_s2 = stop.link.deceleration_m_s2
    first = benches[numbers[0]].parts
    first.ticks_of = lambda data: stop
    first.wall = stop.wall
    return OnBuses(benches, stop)


def record_on_bus(
    train: Train,
    cars: Sequence[int],
    options: Options,
    on_progress: Callable[[Progress], None],
) -> dict[str, Any]:
    """Run a train in lockstep or in real time; write its folder and return its summary.

    Arguments as for `on_buses`. Raises ConfigError, and what `Bench.run` raises.
    """
    benches, stop = on_buses(train, cars, options, on_progress)
    failure: RollerrigError | None = None
    try:
        asyncio.run(bench.run(list(benches.values())))
    except RollerrigError as error:
        if stop.ticks == 0:
            # nothing has moved; the records of the cars say why
            raise
        failure = error
    stop.end()
    of_run = counters(stop, plan.REFERENCE, options.seed, options.pacing)
    result = record.write(stop, options.out, of_run, list(benches))
    if failure is not None:
        raise failure
    return result


def _checked(train: Train, cars: Sequence[int]) -> list[int]:
    """Return the cars that get a bus, in their order; all with a unit if none is named."""
    with_unit = [number for number, car in enumerate(train.cars, start=1) if car.has_unit]
    if not cars and not with_unit:
        raise ConfigError(
            f"--car all: no car of {train.name} has a unit; allowed is --pacing free, or a car without "
            "unit = 'none'"
        )
    for car in cars:
        if not 1 <= car <= len(train.cars):
            raise ConfigError(
                f"--car {car}: {train.name} has {len(train.cars)} cars; allowed are these"
            )
        if car not in with_unit:
            raise ConfigError(
                f"--car {car}: this car of {train.name} has unit = 'none'; allowed is a car with a unit"
            )
    return sorted(set(cars)) or with_unit


def _on_own_bus(train: Train, number: int, numbers: Sequence[int], options: Options) -> Scenario:
    """Return the scenario of a car with a bus that no other car has.

    The buses have the ports from that of the scenario on. Raises ConfigError for an interface that
    all cars would share.
    """
    of_car = train.cars[number - 1].plan
    bus = dict(of_car["bus"])
    place = numbers.index(number)
    if len(numbers) > 1:
        if bus["interface"] not in ("auto", rig_bus.HUB):
            raise ConfigError(
                f"bus.interface = {bus['interface']!r} with {len(numbers)} cars on buses: each has a bus "
                "of its own; allowed is 'hub', or one car with --car"
            )
        bus["interface"] = rig_bus.HUB
    for protocol in CODECS:
        key = f"{protocol}_port"
        if place and bus[key] > 0:
            bus[key] += place
    if place and bus["socketcand_port"] == AUTOMATIC_PORT:
        # a unit that another program starts must know the port
        is_awaited = options.unit == "external"
        bus["socketcand_port"] = CODECS["socketcand"].port + place if is_awaited else 0
    return dataclasses.replace(
        of_car,
        name=record.name_of_car(train, number),
        resolved={**of_car.resolved, "bus": bus},
    )


def _of_car(
    on_progress: Callable[[Progress], None], number: int, has_figures: bool
) -> Callable[[Progress], None]:
    """Return what reports the messages of a car with its number, and figures if it has them."""

    def report(progress: Progress) -> None:
        if progress.message:
            on_progress(progress._replace(message=f"car {number}: {progress.message}"))
        elif has_figures:
            on_progress(progress)

    return report


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
