"""The pytest fixture `rollerrig_bench`; every pytest run where rollerrig is installed loads this file.

So it imports nothing but pytest until a test asks for a bench.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture
def rollerrig_bench(tmp_path: Any) -> Iterator[Any]:
    """Start benches in lockstep: `rollerrig_bench(initial_speed_km_h=60.0, adhesion="soap")`.

    Gives a function that takes what `own_bench.start` takes and returns a joined Harness; the run's
    folders are `run-1`, `run-2` ... of the test's `tmp_path`. Everything ends with the test.
    """
    from rollerrig.wsp_interface import own_bench

    with contextlib.ExitStack() as stack:
        count = 0

        def start(scenario: str = "", **asked: Any) -> Any:
            nonlocal count
            count += 1
            return stack.enter_context(
                own_bench.start(tmp_path / f"run-{count}", scenario, **asked)).harness

        yield start
