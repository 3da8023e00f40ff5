"""Creep forces of the half-space program, kept in tests/data/half_space_creep_forces.csv.

    python tests/rig/contact/half_space_table.py

writes the table anew, in a few minutes. A force is that on infinitely small elements where a second
grid is given (`halfspace.extrapolated_force`).
"""

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from halfspace import HalfSpace, extrapolated_force

from rollerrig.rig.contact.patch import Patch, patch_for

FILE = Path(__file__).parents[2] / "data" / "half_space_creep_forces.csv"
YOUNG_PA = 2.1e11
POISSON = 0.3
SHEAR_PA = YOUNG_PA / (2.0 + 2.0 * POISSON)


class Contact(NamedTuple):
    """A wheel on a roller, or on a rail with an infinite radius."""

    wheel_m: float
    roller_m: float
    lateral_m: float
    load_N: float
    mu: float

    @property
    def limit_N(self) -> float:
        """The friction limit."""
        return self.mu * self.load_N

    def patch(self) -> Patch:
        """Return the patch by the code under test."""
        return patch_for(
            wheel_radius_m=self.wheel_m,
            roller_radius_m=self.roller_m,
            lateral_radius_m=self.lateral_m,
            young_Pa=YOUNG_PA,
            shear_Pa=SHEAR_PA,
            poisson=POISSON,
            cells=30,
        )


class Row(NamedTuple):
    """A contact, its motion, and the force on the wheel over mu N."""

    series: str  # one of SERIES
    contact: Contact
    elements: int
    fine_elements: int  # 0: no second grid
    a_m: float  # semi-axes along and across
    b_m: float
    xi: float
    eta: float
    phi_1_m: float
    fx: float
    fy: float

    def computed(self) -> tuple[float, float]:
        """Return the force over mu N by the half-space program."""
        motion = (self.xi, self.eta, self.phi_1_m, self.contact.limit_N)
        coarse = HalfSpace(self.a_m, self.b_m, SHEAR_PA, POISSON, self.elements)
        if not self.fine_elements:
            return tuple(coarse.force(*motion))
        fine = HalfSpace(self.a_m, self.b_m, SHEAR_PA, POISSON, self.fine_elements)
        return tuple(extrapolated_force(coarse, fine, *motion))

    def distance(self, fx: float, fy: float) -> float:
        """Return how far a force over mu N is from that of the row."""
        return math.hypot(fx - self.fx, fy - self.fy)


# a/b from 0.37 to 4.8
CONTACTS = (
    Contact(0.445, math.inf, 2.0, 52_700.0, 0.10),
    Contact(0.445, 1.0, 1.2, 80_000.0, 0.35),
    Contact(0.445, 0.5, 0.3, 30_000.0, 0.25),
    Contact(0.625, math.inf, 0.3, 106_700.0, 0.30),
    Contact(0.445, math.inf, 0.04, 40_000.0, 0.30),
)
# creepages along and across, and spin; in units of those at which the linear force is the limit
SIDEWAYS = ((0.5, 0.0, 0.0), (0.9, -0.9, 0.0), (-0.4, 1.6, 0.0), (2.5, 1.0, 0.0))
SPINNING = ((0.4, -0.1, 1.0), (-0.9, -1.2, 1.3), (0.0, 0.0, -0.8), (-1.7, 1.5, 0.7))
# the worst cases of FASTSIM on long and narrow patches, in the same units
LONG = Contact(0.445, math.inf, 0.0536, 45_000.0, 0.30)  # a/b = 4
LONGEST = Contact(0.445, math.inf, 0.0281, 45_000.0, 0.30)  # a/b = 6
NARROW = Contact(0.445, math.inf, 2.777, 45_000.0, 0.30)  # a/b = 0.3
WORST = (
    (LONG, ((1.3, -0.85, 2.25), (0.1, -2.25, 2.2))),
    (LONGEST, ((1.55, -0.85, 1.75), (0.7, 0.05, 1.1), (-0.15, 0.2, -0.95))),
    (NARROW, ((2.6, 0.0, 2.4), (-2.3, -0.3, -2.0))),
)
# a/b = 5 is a row of Kalker's table, a/b = 6 lies between two rows
SPIN_ALONE = (
    Contact(0.445, math.inf, 0.03763, 45_000.0, 0.30),
    Contact(0.445, math.inf, 0.0281, 45_000.0, 0.30),
)
SERIES = ("without spin", "with spin", "long or narrow", "spin alone")


def in_units(contact: Contact, patch: Patch, motion: tuple[float, float, float]) -> list[float]:
    """Return creepages and spin of numbers in the units above."""
    growth = contact.load_N ** (1.0 / 3.0)
    a_m = patch.a1 * growth
    b_m = patch.b1 * growth
    unit = contact.limit_N / (SHEAR_PA * a_m * b_m * patch.c11)
    xi, eta, phi = motion
    return [unit * xi, unit * eta, unit / math.sqrt(a_m * b_m) * phi]


def _cases() -> Iterator[tuple[str, Contact, int, int, tuple[float, float, float]]]:
    """Yield series, contact, numbers of elements and motion of all rows."""
    for contact in CONTACTS:
        for motion in SIDEWAYS:
            yield "without spin", contact, 15, 0, motion
    for contact in CONTACTS:
        for motion in SPINNING:
            yield "with spin", contact, 15, 21, motion
    for contact, motions in WORST:
        for motion in motions:
            yield "long or narrow", contact, 15, 21, motion
    for contact in SPIN_ALONE:
        yield "spin alone", contact, 15, 0, (0.0, 0.0, 1e-4)


def rows(series: str) -> list[Row]:
    """Return the rows of a series."""
    found = []
    with FILE.open() as file:
        for cells in csv.reader(line for line in file if not line.startswith("#")):
            if cells[0] != series:
                continue
            contact = Contact(*map(float, cells[1:6]))
            numbers = map(float, cells[8:])
            found.append(Row(series, contact, int(cells[6]), int(cells[7]), *numbers))
    return found


def write() -> None:
    """Write the table."""
    names = [*Row._fields[:1], *Contact._fields, *Row._fields[2:]]
    lines = ["# force on the wheel over mu N by tests/rig/contact/halfspace.py", ",".join(names)]
    for series, contact, elements, fine_elements, motion in _cases():
        patch = contact.patch()
        growth = contact.load_N ** (1.0 / 3.0)
        motion_m = in_units(contact, patch, motion)
        row = Row(
            series,
            contact,
            elements,
            fine_elements,
            patch.a1 * growth,
            patch.b1 * growth,
            *motion_m,
            fx=0.0,
            fy=0.0,
        )
        fx, fy = row.computed()
        row = row._replace(fx=fx, fy=fy)
        cells = [series, *contact, *row[2:4], *(f"{value:.12g}" for value in row[4:])]
        lines.append(",".join(map(str, cells)))
        print(lines[-1], flush=True)
    FILE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    write()
