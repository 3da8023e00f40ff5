"""Everything for tests of a user: the harness on a bench's bus, and what starts benches.

A test is a plain function. Pytest finds the fixture by its entry point, or by one line in
conftest.py: `from rollerrig.wsp_interface.harness import rollerrig_bench`.

    def test_no_wheel_locks(rollerrig_bench):
        rig = rollerrig_bench(initial_speed_km_h=60.0, adhesion="soap")
        rig.brake(bar=3.8)
        rig.until(lambda: rig.vehicle_speed_m_s < 1.0, timeout_s=60.0)
        assert rig.longest_lock_s < 0.4

Without pytest, `bench` is a context manager that starts a bench:

    with bench(initial_speed_km_h=60.0, adhesion="soap", unit="./unit {host} {port}") as rig:
        rig.brake(bar=3.8)
        rig.stop()
"""

import contextlib
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rollerrig.configs.vehicle import COACH
from rollerrig.wsp_interface import own_bench, signals
from rollerrig.wsp_interface.harness_client import (
    Event,
    Harness,
    TimeOutError,
    connect,
    reception,
)

with contextlib.suppress(ImportError):  # a bench runs without pytest
    from rollerrig.wsp_interface.fixture import rollerrig_bench, rollerrig_module_bench

# the columns of a bench with the coach; those of any bench are in `Harness.columns`
COLUMNS = reception(signals.table(COACH)).columns

__all__ = [
    "COLUMNS",
    "Event",
    "Harness",
    "TimeOutError",
    "bench",
    "connect",
    "rollerrig_bench",
    "rollerrig_module_bench",
]


@contextlib.contextmanager
def bench(
    scenario: str = "", folder: str | Path | None = None, **options: Any
) -> Iterator[Harness]:
    """Start a bench, and yield the harness that has joined it. The bench ends with the block.

    scenario: a packaged scenario or a file (default: velim_a1).
    folder: for the record of the run (default: runs/bench, with a number if that exists).
    options: `initial_speed_km_h`, `initial_speed_m_s`, `adhesion`, and `tables` of the scenario;
        `wsp`, `pacing` and `seed` as the options of `rollerrig run`; `unit`, the command that
        starts a WSP unit, as in "./unit {host} {port}".

    Raises RollerrigError: BusError if the bench or its unit has failed, with the last lines that
    the unit has printed, and UnitError at the end of the block if the run is not valid.
    """
    place = Path(folder) if folder is not None else _free_folder()
    with own_bench.start(place, scenario, **options) as harness:
        yield harness
    own_bench.check_valid(own_bench.summary(place))


def _free_folder() -> Path:
    """Return runs/bench, or the first of runs/bench-2, runs/bench-3 ... that does not exist."""
    folder = Path("runs") / "bench"
    numbers = itertools.count(2)
    while folder.exists():
        folder = Path("runs") / f"bench-{next(numbers)}"
    return folder
