"""The pytest fixtures `rollerrig_bench` and `rollerrig_module_bench`.

Every pytest run loads this file if rollerrig is installed. Therefore it imports nothing but pytest
until a test starts a bench. The report of a failed test shows the state of its benches, the folders
of their runs, and where a picture of each will be.
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
    yield from _benches(tmp_path, request.node)


@pytest.fixture(scope="module")
def rollerrig_module_bench(tmp_path_factory: Any, request: Any) -> Iterator[Any]:
    """Start benches that all tests of a module share; they end with its last test.

    It is called as `rollerrig_bench`. A module starts its bench in a separate fixture:

        @pytest.fixture(scope="module")
        def rig(rollerrig_module_bench):
            return rollerrig_module_bench(initial_speed_km_h=60.0, adhesion="soap")
    """
    yield from _benches(tmp_path_factory.mktemp("rollerrig"), request.node)


def _benches(folder: Path, node: Any) -> Iterator[Benches]:
    """Yield the benches of a test or module, its node in pytest; end and check them afterwards."""
    from rollerrig.wsp_interface import own_bench

    with contextlib.ExitStack() as stack:
        benches = Benches(folder, stack)
        node.stash[_BENCHES] = benches
        yield benches
    for _, folder in benches.begun:
        if benches.failed:
            own_bench.draw(folder)
        own_bench.check_valid(own_bench.summary(folder))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: Any, call: Any) -> Generator[None, Any, Any]:
    """Add the state of the benches and the folders of their runs to the report of a failed test."""
    report = yield
    if call.when != "call" or not report.failed:
        return report
    # those of the module, and those of the test
    for node in item.listchain():
        benches = node.stash.get(_BENCHES, None)
        if benches is None:
            continue
        benches.failed = True
        for rig, folder in benches.begun:
            text = f"{rig!r}\nrun: {folder}\nplot: {folder / 'stop.svg'}"
            report.sections.append(("rollerrig", text))
    return report
