"""Runs the search on simulated stops with nothing new in them, on all cores of the machine.

Each clean set is simulated from the fitted explanation with its own seed, prepared and scored like
the measured one; the seeds and thus the decision repeat.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.data import preparation
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.decide import evidence, simulate, tuning
from rollerrig.rig.identify.decide.evidence import Scores

# normalised innovations of a simulated set above this: a wheel locked that did not in the stop
RUNAWAY = 1.2
Progress = Callable[[str, float], None]
Pool = ProcessPoolExecutor | None


class Setting(NamedTuple):
    """What is explained and with what: measured runs, prepared, and the processes that work on them."""

    data: Dataset
    measured: list[Run]
    design: Design
    pool: Pool
    progress: Progress

    def run_all(self, work: Callable[[Any], Any], tasks: Sequence[Any], title: str) -> list[Any]:
        """work(task) for all tasks, in order, with progress."""
        if self.pool is None:
            results: Iterator[Any] = map(work, tasks)
        else:
            futures: list[Future[Any]] = [self.pool.submit(work, task) for task in tasks]
            results = (future.result() for future in futures)
        found = []
        for result in results:
            found.append(result)
            self.progress(title, len(found) / len(tasks))
        return found


class Task(NamedTuple):
    """One clean set to make."""

    data: Dataset
    measured: list[Run]
    explanation: Explanation
    seed: int
    known: tuple[str, ...]


@contextmanager
def workers() -> Iterator[Pool]:
    """A pool of processes, or None on a single core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if (cores or 1) < 2:
        yield None
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(cores or 1, 8), context, initializer=_single) as pool:
        yield pool


def _single() -> None:
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)


def one(task: Task) -> Scores | None:
    """Simulate, prepare, score one set; None where its wheels got out of hand."""
    design = preparation.prepare(task.data, task.measured)
    rng = np.random.default_rng(task.seed)
    made = simulate.runs(task.data, design, task.measured, task.explanation, rng)
    prepared = preparation.prepare(task.data, made, design)
    found, linear, _, _ = tuning.normal(prepared, task.explanation)
    if np.mean(np.minimum(linear.nu**2 / linear.variance, 100.0)) > RUNAWAY:
        return None
    if not (np.all(np.isfinite(found.A)) and np.all(np.isfinite(found.b))):
        return None
    result = evidence.scores(found, task.known)
    return Scores(result.S.astype(np.float32), result.g)


def null_sets(setting: Setting, explanation: Explanation, count: int, seed: int, known: Sequence[str]) -> list[Scores]:
    """Scores of `count` clean sets."""
    # tolerances are drawn afresh: the fitted ones do not belong to the clean sets
    fresh = explanation._replace(base={k: v for k, v in explanation.base.items() if k.startswith("ln_")})
    tasks = [Task(setting.data, setting.measured, fresh, seed * 100003 + k, tuple(known)) for k in range(count)]
    return [s for s in setting.run_all(one, tasks, "clean sets") if s is not None]
