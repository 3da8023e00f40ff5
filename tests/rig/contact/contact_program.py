"""Results of the half-space program CONTACT on a rail: a reference for creep force models."""

import csv
from pathlib import Path

_FILE = Path(__file__).parents[2] / "data" / "creep_curves_rail_r300.csv"


def contact_curves():
    """Return one dict of numbers for each combination of creepages and spin."""
    with _FILE.open() as file:
        lines = [line for line in file if not line.startswith("#")]
    rows = []
    for row in csv.DictReader(lines):
        rows.append({key: float(value) for key, value in row.items() if key != "patch"})
    return rows
