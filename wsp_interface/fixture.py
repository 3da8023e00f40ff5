"""The pytest fixture `rollerrig_bench`. Every pytest run loads this file if rollerrig is installed.

Therefore it imports nothing but pytest until a test starts a bench. The report of a failed test
shows the state of its benches, the folders of their runs, and where a picture of each will be.
"""

import contextlib
import itertools
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

_BENCHES = pytest.StashKey["Benches"]()


class Benches:
    """Starts the benches of a test, each with a separate folder."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.folder = folder
        self.stack = stack
        self.begun: list[tuple[Any, Path]] = []  # the harness and the folder of each bench
        self.failed = False
        self._numbers = itertools.count(1)

    def __call__(self, scenario: str = "", **options: Any) -> Any:
        """Start a bench and return its harness. The options are those of `own_bench.start`."""
        from rollerrig.wsp_interface import own_bench

        folder = self.folder / f"run-{next(self._numbers)}"
        rig = self.stack.enter_context(own_bench.start(folder, scenario, **options))
        self.begun.append((rig, folder))
        return rig

    def judge(self, rig: Any, criteria: str = "stop") -> None:
        """Fail unless a bench meets every limit of a profile (configs/criteria).

        Limits that need a dry stop for comparison do not count. The message shows each failed
        figure with its limit. Raises AssertionError, RollerrigError.
        """
        __tracebackhide__ = True
        from rollerrig.wsp_interface.sequences import play

        (folder,) = (folder for harness, folder in self.begun if harness is rig)
        missed = play.missed(rig, folder, criteria)
        assert not missed, missed


@pytest.fixture
def rollerrig_bench(tmp_path: Any, request: Any) -> Iterator[Any]:
    """Start benches in lockstep: `rollerrig_bench(initial_speed_km_h=60.0, adhesion="soap")`.

    Yields `Benches`. The folders of the runs are `run-1`, `run-2` ... in the test's `tmp_path`. All
    benches end with the test. The test has an error if a run was not valid, for example because
    the unit was lost.
    """
    from rollerrig.wsp_interface import own_bench

    with contextlib.ExitStack() as stack:
        benches = Benches(tmp_path, stack)
        request.node.stash[_BENCHES] = benches
        yield benches
    for _, folder in benches.begun:
        if benches.failed:
            own_bench.draw(folder)
        own_bench.check_valid(own_bench.summary(folder))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: Any, call: Any) -> Generator[None, Any, Any]:
    """Add the state of the benches and the folders of their runs to the report of a failed test."""
    report = yield
    benches = item.stash.get(_BENCHES, None)
    if benches and call.when == "call" and report.failed:
        benches.failed = True
        for rig, folder in benches.begun:
            text = f"{rig!r}\nrun: {folder}\nplot: {folder / 'stop.svg'}"
            report.sections.append(("rollerrig", text))
    return report
