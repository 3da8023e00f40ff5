"""Spreads the sets of a benchmark over the cores, one set a core at a time."""

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import as_completed
from typing import Any

from rollerrig.configs.processes import children


def all_of(one: Callable[[Any], Any], jobs: Iterable[Any], alone: bool = False) -> Iterator[Any]:
    """one(job) of all jobs as they end; an interruption, or an error of who asks, leaves at once.

    With `alone` they come one after another in this process, and each has all cores.
    """
    if alone:
        yield from map(one, jobs)
        return
    own, cores = sorted(os.sched_getaffinity(0)), multiprocessing.get_context("spawn").Queue()
    for core in own:
        cores.put(core)
    with children.pool(len(own), _keep_to, cores) as pool:
        futures = [pool.submit(one, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            # not by `cancel_futures`: a pool that is gone before its thread looks has cancelled nothing
            for future in futures:
                future.cancel()
            pool.shutdown(wait=False)


def _keep_to(cores: Any) -> None:
    """Keep this process to one core, so that what it calls starts no others."""
    from threadpoolctl import threadpool_limits

    os.sched_setaffinity(0, {cores.get()})
    threadpool_limits(1)
