"""Spreads the sets of a benchmark over the cores, one set per core at a time."""

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import as_completed
from typing import Any

from rollerrig.configs.processes import children


def all_of(work: Callable[[Any], Any], jobs: Iterable[Any], alone: bool = False) -> Iterator[Any]:
    """Yield work(job) of all jobs in the order in which they finish.

    An interruption, or an error in the code that takes the results, ends the work immediately.
    With `alone` the jobs run one after another in this process, and each has all cores.
    """
    if alone:
        yield from map(work, jobs)
        return

    available = sorted(os.sched_getaffinity(0))
    cores = multiprocessing.get_context("spawn").Queue()
    for core in available:
        cores.put(core)

    with children.pool(len(available), _take_a_core, cores) as pool:
        futures = [pool.submit(work, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            # not by `cancel_futures` of the pool: if the pool is deleted before its thread looks at
            # that flag, nothing is cancelled
            for future in futures:
                future.cancel()
            pool.shutdown(wait=False)


def _take_a_core(cores: Any) -> None:
    """Keep this worker on one core of the queue, so that its libraries start no further threads."""
    from threadpoolctl import threadpool_limits

    os.sched_setaffinity(0, {cores.get()})
    threadpool_limits(1)
