"""A WSP unit that never energises a magnet, as a program: never_vents.py HOST PORT.

It joins the bus, sends heartbeats and answers every SYNC like any unit.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs" / "examples"))

import wsp_unit


class NoProtection:
    """Commands FILL on every axle in each cycle: the brake pressure of the driver."""

    def cycle(self, speeds):
        return wsp_unit.FILL


wsp_unit.Protection = NoProtection

if __name__ == "__main__":
    wsp_unit.main(*sys.argv[1:])
