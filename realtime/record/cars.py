"""The cars of a recorded train: their axles, their places, and the rail that these axles meet.

A train's record has quantities of car n with the prefix car_n_, and its axles count through.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError

# a channel of the record by name, shape (n,)
Column = Callable[[str], np.ndarray]

# places along the rail at which its friction is compared
_MOST_PLACES = 600


class Car(NamedTuple):
    """A car of a recorded train; distances are behind the leading end of the train.

    axles: of the train, counted from 1. front_m: of its leading end. wheelsets_m: of each axle.
    """

    number: int
    axles: range
    front_m: float
    length_m: float
    wheelsets_m: tuple[float, ...]

    def mean(self, column: Column, signal: str, unit: str = "") -> np.ndarray:
        """Return the mean of a signal over the axles of this car, shape (n,)."""
        behind = f"_{unit}" if unit else ""
        return np.mean([column(f"{signal}_{axle}{behind}") for axle in self.axles], axis=0)

    def place_m(self, column: Column, axle: int) -> np.ndarray:
        """Return the place of an axle of the train on the rail, shape (n,)."""
        seat = axle - self.axles[0]
        behind_m = self.wheelsets_m[seat] - self.wheelsets_m[0]
        return column(f"car_{self.number}_position_m") - behind_m


class Rail(NamedTuple):
    """The friction of the contaminant that each axle has met, place by place.

    place_m: shape (places,), along the rail. friction: shape (axles, places); NaN where an axle has
    not been.
    """

    place_m: np.ndarray
    friction: np.ndarray


def cars(summary: Mapping[str, Any]) -> list[Car]:
    """Return the cars of a train's summary, from the front.

    Raises ConfigError for a summary that is not of a train.
    """
    found = []
    try:
        for number, one in enumerate(summary["cars"], start=1):
            first, last = one["axles"]
            wheelsets_m = tuple(float(place_m) for place_m in one["wheelsets_m"])
            if len(wheelsets_m) != last - first + 1:
                raise ValueError(f"{len(wheelsets_m)} wheelsets")
            found.append(
                Car(
                    number,
                    range(int(first), int(last) + 1),
                    float(one["front_m"]),
                    float(one["length_m"]),
                    wheelsets_m,
                )
            )
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"the summary of this run does not have the cars of a train ({error}); run the train again"
        ) from None
    return found


def rail(column: Column, of_train: list[Car]) -> Rail:
    """Return what each axle met on the rail; the first axle meets it as it was found."""
    ways_m = [car.place_m(column, axle) for car in of_train for axle in car.axles]
    # from the last axle at the start to the first axle at the end
    place_m = np.linspace(ways_m[-1][0], ways_m[0][-1], _MOST_PLACES)
    friction = np.empty((len(ways_m), _MOST_PLACES))
    for at, way_m in enumerate(ways_m):
        met = column(f"friction_degraded_{at + 1}")
        friction[at] = np.interp(place_m, way_m, met, left=np.nan, right=np.nan)
    return Rail(place_m, friction)
