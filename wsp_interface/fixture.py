"""The pytest fixture `rollerrig_bench`; every pytest run where rollerrig is installed loads this file.

So it imports nothing but pytest until a test asks for a bench. A test that fails tells how its benches stand, where
their runs are recorded, and where a picture of each is drawn when they have ended.
"""

import contextlib
import itertools
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

_BENCHES = pytest.StashKey["Benches"]()


class Benches:
    """Starts the benches of a test, each with a folder of its own."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.folder, self.stack = folder, stack
        # each bench's harness and folder
        self.begun: list[tuple[Any, Path]] = []
        self.failed = False
        self._numbers = itertools.count(1)

    def __call__(self, scenario: str = "", **asked: Any) -> Any:
        """A joined Harness on a new bench; takes what `own_bench.start` takes."""
        from rollerrig.wsp_interface import own_bench

        folder = self.folder / f"run-{next(self._numbers)}"
        rig = self.stack.enter_context(own_bench.start(folder, scenario, **asked))
        self.begun.append((rig, folder))
        return rig

    def judge(self, rig: Any, criteria: str = "stop") -> None:
        """Fail unless a bench has kept to every limit of a profile (configs/criteria), but those on a dry stop.

        The message has each figure against its limit. Raises AssertionError, RollerrigError.
        """
        __tracebackhide__ = True
        from rollerrig.wsp_interface.sequences import play

        wrong = play.missed(rig, next(folder for one, folder in self.begun if one is rig), criteria)
        assert not wrong, wrong


@pytest.fixture
def rollerrig_bench(tmp_path: Any, request: Any) -> Iterator[Any]:
    """Start benches in lockstep: `rollerrig_bench(initial_speed_km_h=60.0, adhesion="soap")`.

    Gives `Benches`; the run's folders are `run-1`, `run-2` ... of the test's `tmp_path`. Everything ends with the test,
    which has an error where a run was not valid: unit lost, recorder ended.
    """
    from rollerrig.wsp_interface import own_bench

    with contextlib.ExitStack() as stack:
        benches = request.node.stash[_BENCHES] = Benches(tmp_path, stack)
        yield benches
    for _, folder in benches.begun:
        if benches.failed:
            own_bench.draw(folder)
        own_bench.check_valid(own_bench.summary(folder))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: Any, call: Any) -> Generator[None, Any, Any]:
    """Add to a failed test how its benches stand and where their records are."""
    report = yield
    benches = item.stash.get(_BENCHES, None)
    if benches and call.when == "call" and report.failed:
        benches.failed = True
        report.sections += [
            ("rollerrig", f"{rig!r}\nrun: {folder}\nplot: {folder / 'stop.svg'}")
            for rig, folder in benches.begun
        ]
    return report
