"""Stops of a train in a campaign: each alone on a core, as with `run --pacing free`."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign.components import train as components
from rollerrig.realtime.train import plan, record, run
from rollerrig.realtime.train.plan import Train
from rollerrig.realtime.train.stop import simulate


class Finished(NamedTuple):
    """A stop that is done: its tag, its summary, and the channels of `speed_steps`."""

    tag: Any
    summary: dict[str, Any]
    channels: dict[str, np.ndarray]


def is_train(scenario: str) -> bool:
    """Whether a scenario, by name or path, is a train. Raises ConfigError."""
    return plan.find(scenario) is not None


def each(jobs: Iterable[tuple[Any, Train]], unit: str) -> Iterator[Finished]:
    """Run trains one after another, with the unit "reference" or "none" in their cars."""
    for tag, train in jobs:
        stop = simulate(train, unit)
        samples = stop.samples()
        counters = run.counters(stop, unit, 0, "free")
        of_cars = record.summaries_of_cars(stop, samples, counters)
        summary = record.summary_of(stop, samples, of_cars, counters, with_alone=False)
        columns = record.train_channels(train, samples)
        channels = {name: columns[name] for name in ("time_s", "vehicle_speed_m_s", "position_m")}
        channels["brake_demand_Pa"] = record.demand_Pa(samples)
        yield Finished(tag, summary, channels)


def places(train: Train, where: str) -> tuple[components.Train, Mapping[str, Any]]:
    """Return the places of the components of a train, and its brake.

    Raises ConfigError for cars that differ in axles or brake: they have no common discs.
    """
    first = train.cars[0].plan
    for number, car in enumerate(train.cars, start=1):
        same_axles = car.plan.kind.axles == first.kind.axles
        if not same_axles or car.plan["brake"] != first["brake"]:
            raise ConfigError(
                f"{where}: [failures] and inputs with per need cars with the same brake, and car "
                f"{number} of {train.name} has another one than car 1; vary values of single cars, as "
                f'in [inputs."car_{number}.brake.pad_friction"]'
            )
    axles = first.kind.axles * len(train.cars)
    found = components.Train(axles, first["brake"]["discs"], len(train.cars), coupled=True)
    return found, first.resolved
