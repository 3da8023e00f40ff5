"""The places of a train in which its components are: discs, axles, bogies and cars.

A brake unit is a disc with its pads and cylinder. Discs are numbered from the leading end: axle a
(from 0) has the discs a * n to a * n + n - 1, where n is `brake.discs`.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from rollerrig.configs.vehicle import AXLES_OF_BOGIE, bodies

DISC = "disc"
AXLE = "axle"
BOGIE = "bogie"
CAR = "car"
WHOLE = "train"
# from the smallest to the largest
UNITS = (DISC, AXLE, BOGIE, CAR, WHOLE)

Discs = tuple[int, ...]  # their numbers, from 0


class Train(NamedTuple):
    """The numbers of axles, of discs on each axle, and of cars.

    coupled: whether the cars are those of [train], and not bodies of one vehicle.
    """

    axles: int
    discs: int
    cars: int
    coupled: bool = False

    def units(self, kind: str) -> tuple[Discs, ...]:
        """Return the discs of each unit of a kind, a name of UNITS, from the leading end."""
        all_discs = range(self.axles * self.discs)
        size = {
            DISC: 1,
            AXLE: self.discs,
            BOGIE: AXLES_OF_BOGIE * self.discs,
            CAR: len(all_discs) // self.cars,
            WHOLE: len(all_discs),
        }[kind]
        return tuple(
            tuple(all_discs[begin : begin + size]) for begin in range(0, len(all_discs), size)
        )

    def axles_of(self, discs: Discs) -> list[int]:
        """Return the axles, from 1, of some discs."""
        return sorted({disc // self.discs + 1 for disc in discs})


def of(resolved: Mapping[str, Any]) -> Train:
    """Return the places of the vehicle of a resolved scenario."""
    vehicle = resolved["vehicle"]
    return Train(vehicle["axles"], resolved["brake"]["discs"], bodies(vehicle))
