"""What the inputs of single brake units and the failures of a run change in its scenario.

[K1] The brake torque of an axle is that of its scenario times the mean of the factors of its discs.
     The factor of a disc is the product of its inputs, each relative to the value of the scenario,
     and of 1 - loses for each failed component to whose unit it belongs.
"""

import json
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import AXLES_OF_BOGIE
from rollerrig.realtime.campaign.components import failures as failures_of
from rollerrig.realtime.campaign.components import train as trains

FACTORS = "brake.axle_factors"


class UnitInput(NamedTuple):
    """An input that each brake unit has for itself.

    key: of the scenario. nominal: its value there. units: the discs of each unit.
    """

    key: str
    nominal: float
    units: tuple[trains.Discs, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """The names of the inputs of its units."""
        return tuple(axis(self.key, number) for number in range(1, len(self.units) + 1))


def axis(key: str, unit: int) -> str:
    """Return the name of an input of one unit, counted from 1."""
    return f"{key}[{unit}]"


class Applied(NamedTuple):
    """How the values of a run act on its scenario.

    discs: on each axle. factors: [brake] axle_factors of the scenario, of a train those of all
    cars. axles_of_car: of each car of a train; 0 for one vehicle.
    """

    discs: int
    factors: tuple[float, ...]
    inputs: tuple[UnitInput, ...]
    failures: tuple[failures_of.Failure, ...]
    axles_of_car: int = 0

    def changes(self, values: Mapping[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return what a run changes: texts in the form of `--set` and of `--fault`.

        values: of all columns of the plan.
        """
        replaced: dict[str, Any] = {}
        faults: list[str] = []
        by_disc = [1.0] * (self.discs * len(self.factors))
        special: set[str] = set()
        for given in self.inputs:
            for name, unit in zip(given.axes, given.units, strict=True):
                special.add(name)
                for disc in unit:
                    by_disc[disc] *= values[name] / given.nominal
        for failure in self.failures:
            special.add(failure.column)
            for place in failures_of.failed(values[failure.column]):
                effect = failure.effects[place]
                faults += [text for text in effect.faults if text not in faults]
                replaced |= effect.values
                if effect.loses:
                    for disc in effect.discs:
                        by_disc[disc] *= 1.0 - effect.loses
        settings = {key: value for key, value in values.items() if key not in special}
        settings |= replaced
        if any(factor != 1.0 for factor in by_disc):
            by_axle = [
                self.factors[axle]
                * math.fsum(by_disc[axle * self.discs : (axle + 1) * self.discs])
                / self.discs
                for axle in range(len(self.factors))
            ]
            settings |= self._factors(by_axle)
        if self.axles_of_car:
            faults = [self._in_car(text) for text in faults]
        return tuple(f"{key}={json.dumps(value)}" for key, value in settings.items()), tuple(faults)

    def _factors(self, by_axle: list[float]) -> dict[str, Any]:
        """Return the factors of all axles as values of the scenario, or of the cars of a train."""
        size = self.axles_of_car
        if not size:
            return {FACTORS: by_axle}
        cars = range(len(by_axle) // size)
        return {f"car_{n + 1}.{FACTORS}": by_axle[n * size : (n + 1) * size] for n in cars}

    def _in_car(self, text: str) -> str:
        """Return a fault at an axle or bogie of the train as that of a car."""
        words = []
        for word in text.split():
            key, _, value = word.partition("=")
            size = self.axles_of_car // (1 if key == "axle" else AXLES_OF_BOGIE)
            if key in ("axle", "bogie"):
                car, place = divmod(int(value) - 1, size)
                word = f"car={car + 1} {key}={place + 1}"
            words.append(word)
        return " ".join(words)

    def as_json(self) -> dict[str, Any]:
        """Return all of it as plain data, for the file of a plan."""
        return {
            "discs": self.discs,
            "factors": self.factors,
            "axles_of_car": self.axles_of_car,
            "inputs": [list(given) for given in self.inputs],
            "failures": [
                {
                    "name": failure.name,
                    "kind": list(failure.kind),
                    "law": failure.law,
                    "source": failure.source,
                    "effects": {
                        str(unit): list(effect) for unit, effect in failure.effects.items()
                    },
                }
                for failure in self.failures
            ],
        }


def from_json(content: Any, where: str) -> Applied | None:
    """Return what `as_json` has written; None for none. Raises ConfigError."""
    if content is None:
        return None
    try:
        return Applied(
            int(content["discs"]),
            tuple(map(float, content["factors"])),
            tuple(
                UnitInput(str(key), float(nominal), tuple(map(tuple, units)))
                for key, nominal, units in content["inputs"]
            ),
            tuple(_failure(given) for given in content["failures"]),
            int(content.get("axles_of_car", 0)),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"{where}: is not of a campaign of this version ({error!r}); repeat the campaign in a new "
            "folder"
        ) from None


def _failure(given: Mapping[str, Any]) -> failures_of.Failure:
    effects = {}
    for unit, (discs, loses, faults, values) in given["effects"].items():
        effects[int(unit)] = failures_of.Effect(tuple(discs), loses, tuple(faults), dict(values))
    places, probability, most = given["kind"]
    return failures_of.Failure(
        given["name"],
        failures_of.failing.Kind(places, probability, most),
        effects,
        given["law"],
        given["source"],
    )
