"""Single values and further faults of a train: of all cars, of the train, or of one car.

A setting `car_2.load_kg=4e4` or `car_2.brake.pad_friction=0.2` is of car 2, counted from the front
(`train.car.2.load_kg` is the same); `train.delay_s=0.1` is of the train; any other one is of all
cars. A fault has its car among its words: `speed_sensor_dropout car=2 axle=1`.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rollerrig.configs import table
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import TRAIN
from rollerrig.realtime.bench import scenario

_SETTING = re.compile(r"\s*(?:car_|train\.car\.)(\d+)\.([^=]+)=(.*)", re.DOTALL)
# a key of the train has no further table
_DEEPER = re.compile(rf"\s*{TRAIN}\.[^=]*\.[^=]*=.*", re.DOTALL)
_CAR_WORD = re.compile(r"car=(\d+)")
# the same for all cars, so a setting of one car cannot change it
SHARED = ("loop", "bus", "modbus", "rig")


class OfCar(NamedTuple):
    """What is changed in one car: keys of [[train.car]], settings of its tables, and faults."""

    keys: dict[str, Any]
    settings: tuple[str, ...]
    faults: tuple[str, ...]


NOTHING = OfCar({}, (), ())


class Changes(NamedTuple):
    """What is changed in a train; `by_car` has cars counted from 1."""

    shared: tuple[str, ...]
    train: tuple[str, ...]
    by_car: Mapping[int, OfCar]

    def check(self, cars: int, rows: Sequence[table.Row], where: str) -> None:
        """Raise ConfigError for a car that the train does not have, and for a key of no car."""
        allowed = [row.name for row in rows if row.name != "count"]
        for number, of_car in self.by_car.items():
            if not 1 <= number <= cars:
                raise ConfigError(f"{where}: car {number}: it has the cars 1 to {cars}")
            table.known(of_car.keys, allowed, lambda key, at=number: f"{where} car_{at}")


def read(settings: Sequence[str], faults: Sequence[str], faults_from: str) -> Changes:
    """Return the changes of settings and faults, as texts of the command line.

    `faults_from` is what gave the faults, for messages. Raises ConfigError.
    """
    shared: list[str] = []
    of_train: list[str] = []
    keys: dict[int, dict[str, Any]] = {}
    by_car: dict[int, list[str]] = {}
    for one in settings:
        of_car = _SETTING.fullmatch(one)
        if of_car is None:
            if _DEEPER.fullmatch(one):
                raise ConfigError(
                    f"--set {one}: allowed are keys of [train], as in {TRAIN}.delay_s=0.1, and those of "
                    "one car, as in car_2.load_kg=4e4"
                )
            (of_train if one.startswith(f"{TRAIN}.") else shared).append(one)
            continue
        number, key, text = int(of_car[1]), of_car[2].strip(), of_car[3]
        section, _, name = key.rpartition(".")
        if section in SHARED:
            raise ConfigError(
                f"car_{number}.{key}: [{section}] is the same for all cars; write {key}={text}"
            )
        if section:
            by_car.setdefault(number, []).append(f"{key}={text}")
        else:
            keys.setdefault(number, {}).update(scenario.settings_of([f"car.{name}={text}"], "car"))
    faults_of = _by_car(faults, faults_from)
    numbers = {*keys, *by_car, *faults_of}
    return Changes(
        tuple(shared),
        tuple(of_train),
        {
            number: OfCar(
                _named(keys.get(number, {})),
                tuple(by_car.get(number, ())),
                tuple(faults_of.get(number, ())),
            )
            for number in sorted(numbers)
        },
    )


def _named(keys: dict[str, Any]) -> dict[str, Any]:
    """Return keys of a car, where `vehicle` may be the name of a file, as in [[train.car]]."""
    return {("vehicle_set" if key == "vehicle" else key): value for key, value in keys.items()}


def _by_car(faults: Sequence[str], faults_from: str) -> dict[int, list[str]]:
    """Return the faults of each car, without the word that names it. Raises ConfigError."""
    found: dict[int, list[str]] = {}
    for text in faults:
        number, of_car = car_of_fault(text, faults_from)
        found.setdefault(number, []).append(of_car)
    return found


def car_of_fault(text: str, faults_from: str) -> tuple[int, str]:
    """Return the car of a fault and its other words. Raises ConfigError where no car is named."""
    words = text.split()
    cars = [_CAR_WORD.fullmatch(word) for word in words]
    numbers = [int(one[1]) for one in cars if one]
    if len(numbers) != 1:
        raise ConfigError(
            f"{faults_from} '{text}': a fault of a train is one of a car; write car=N once, as in "
            "'speed_sensor_dropout car=2 axle=1'"
        )
    return numbers[0], " ".join(word for word, car in zip(words, cars, strict=True) if not car)
