"""Runs the search on simulated stops with nothing new in them, on all cores of the machine.

Each clean set is simulated from the fitted explanation with its own seed, prepared and scored like
the measured one; the seeds and thus the decision repeat.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children
from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.decide import evidence, fitting, simulate
from rollerrig.rig.identify.decide.evidence import Scores

FEW = 20  # clean sets after which is asked whether more are wanted
RUNAWAY = 1.2  # normalised innovations of a simulated set above this: a wheel locked that did not in the stop
Progress = Callable[[str, float], None]


class Workspace(NamedTuple):
    """What is explained and with what: measured runs, prepared, and the processes that work on them."""

    data: Dataset
    measured: list[Run]
    design: Design
    pool: Executor
    progress: Progress

    def run_all(
        self, work: Callable[..., Any], tasks: Iterable[tuple[Any, ...]], title: str
    ) -> list[Any]:
        """work(*task) for all tasks, in order, with progress."""
        futures = [self.pool.submit(work, *task) for task in tasks]
        found = []
        for future in futures:
            found.append(future.result())
            self.progress(title, len(found) / len(futures))
        return found


class _When(Future[Any]):
    """Work that is done, in this process, when its result is asked for."""

    def __init__(self, work: Callable[[], Any]) -> None:
        super().__init__()
        self._work = work

    def result(self, timeout: float | None = None) -> Any:
        return self._work()


class _Here(Executor):
    """No process but this one."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return _When(partial(fn, *args, **kwargs))


def worker_pool() -> Executor:
    """A pool of processes, one a core, at most eight; none where this process may use one core only."""
    from threadpoolctl import threadpool_limits

    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    return children.pool(min(cores, 8), threadpool_limits, 1) if cores > 1 else _Here()


def simulate_and_score(
    data: Dataset,
    measured: list[Run],
    design: Design,
    explanation: Explanation,
    seed: int,
    known: Sequence[str],
) -> Scores | None:
    """Simulate, prepare, score one set; None where its wheels got out of hand."""
    made = simulate.runs(data, design, measured, explanation, np.random.default_rng(seed))
    found, linear, _ = fitting.normal_equations(prepare(data, made, design), explanation)
    finite = np.all(np.isfinite(found.A)) and np.all(np.isfinite(found.b))
    if np.mean(np.minimum(linear.nu**2 / linear.variance, 100.0)) > RUNAWAY or not finite:
        return None
    result = evidence.scores(found, known)
    return Scores(result.S.astype(np.float32), result.g)


def score_against_nulls(
    setting: Workspace, explanation: Explanation, most: int, seed: int, known: Sequence[str] = ()
) -> tuple[list[evidence.ScoreTest], fitting.NormalEquations, list[Scores]]:
    """What the measured stops show beside clean sets, their normal equations, the clean sets' scores; no `known` cause.

    Clean sets come by FEW until more would not change what counts, at most `most`. Raises ConfigError where less than
    half of them could be replayed.
    """
    # tolerances are drawn afresh: the fitted ones do not belong to the clean sets
    fresh = explanation._replace(
        base={k: v for k, v in explanation.base.items() if k.startswith("ln_")}
    )
    scored, clean = fitting.normal_equations(setting.design, explanation)[0], list[Scores]()
    for began in range(0, most, FEW):
        tasks = [
            (*setting[:3], fresh, seed * 100003 + k, known)
            for k in range(began, min(began + FEW, most))
        ]
        clean += [
            s for s in setting.run_all(simulate_and_score, tasks, "clean sets") if s is not None
        ]
        if 2 * len(clean) < began + len(tasks):
            raise ConfigError(
                f"only {len(clean)} of {began + len(tasks)} simulated clean sets could be replayed: the "
                "fitted model does not brake like the recording; check vehicle, loads and torques in "
                "dataset.toml"
            )
        found = evidence.score_tests(setting.design, scored, clean, known)
        if evidence.is_settled(found):
            break
    return found, scored, clean
