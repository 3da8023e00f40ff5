"""Results of the half-space program CONTACT on a rail: a reference for creep force models."""

import csv
import math
from pathlib import Path
from typing import NamedTuple

from rollerrig.rig.contact.patch import patch_for

_FILE = Path(__file__).parents[2] / "data" / "creep_curves_rail_r300.csv"

# the patch of all results
CONTACT_PATCH = patch_for(
    wheel_radius_m=0.445,
    roller_radius_m=math.inf,
    lateral_radius_m=0.3,
    young_Pa=2.1e11,
    shear_Pa=2.1e11 / 2.6,
    poisson=0.3,
)


class ContactResult(NamedTuple):
    """One result of CONTACT: its inputs, and force and moment on the wheel."""

    a_m: float  # semi-axes along and across
    b_m: float
    load_N: float
    mu: float
    shear_Pa: float
    c11: float
    c22: float
    xi: float
    eta: float
    phi_1_m: float
    fx: float  # over mu N
    fy: float  # over mu N
    mz: float  # over mu N sqrt(a b)

    def distance(self, fx, fy):
        """Return how far a force, also over mu N, is from that of CONTACT."""
        return math.hypot(fx - self.fx, fy - self.fy)


def contact_results():
    """Return all results, one for each combination of creepages and spin."""
    with _FILE.open() as file:
        lines = [line for line in file if not line.startswith("#")]
    results = []
    for row in csv.DictReader(lines):
        results.append(
            ContactResult(
                a_m=float(row["a_mm"]) * 1e-3,
                b_m=float(row["b_mm"]) * 1e-3,
                load_N=float(row["N"]),
                mu=float(row["mu"]),
                shear_Pa=float(row["G_GPa"]) * 1e9,
                c11=float(row["c11"]),
                c22=float(row["c22"]),
                xi=float(row["xi"]),
                eta=float(row["eta"]),
                phi_1_m=float(row["phi_1_per_m"]),
                fx=float(row["CONTACT_fx"]),
                fy=float(row["CONTACT_fy"]),
                mz=float(row["CONTACT_mz"]),
            )
        )
    return results


def results_without_spin():
    return [result for result in contact_results() if result.phi_1_m == 0.0]


def results_with_spin():
    return [result for result in contact_results() if result.phi_1_m != 0.0]
