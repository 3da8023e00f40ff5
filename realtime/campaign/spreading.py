"""Spreads the chunks of a campaign over processes of this machine, or over a Dask cluster.

Only a window of chunks is in work: a chunk begins when the oldest unfinished one is at most WINDOW
chunks per worker behind it. The memory therefore does not grow with the campaign, and who merges
chunks in their order holds back at most a window of them.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.processes import children

# chunks per worker, from the oldest unfinished one to the newest that may begin
WINDOW = 8
# after worker processes have died so often without any chunk that was done in between, a campaign
# stops with an error
DEATHS = 4

# a cluster without any worker is reported after this time, and again at this interval
REPORT_AFTER_S = 2.0
REPORT_EVERY_S = 60.0
_LOOK_EVERY_S = 0.02

# returns a function and its arguments, whose call does a chunk
Work = Callable[[int], tuple[Any, ...]]


class _Window:
    """The chunks that are left, and which of them may begin."""

    def __init__(self, chunks: Sequence[int], workers: int) -> None:
        self.left = dict.fromkeys(sorted(chunks))
        self._waiting = iter(list(self.left))
        self._next = next(self._waiting, None)
        self.size = WINDOW * workers

    def begin_again(self) -> None:
        """Let all unfinished chunks wait again."""
        self._waiting = iter(list(self.left))
        self._next = next(self._waiting, None)

    def ready(self) -> Iterator[int]:
        """Yield the chunks that may begin now."""
        while self._next is not None and self._next - next(iter(self.left)) < self.size:
            chunk = self._next
            self._next = next(self._waiting, None)
            yield chunk


def on_this_machine(work: Work, chunks: Sequence[int], workers: int) -> Iterator[tuple[int, Any]]:
    """Do chunks in processes of this machine; yield each with its result when it is done.

    Only one of the processes compiles kernels at a time. If a process dies, the chunks in work are
    done again. Raises RollerrigError after DEATHS such
    failures without progress.
    """
    window = _Window(chunks, workers)
    deaths = 0
    while deaths < DEATHS:
        window.begin_again()
        with children.pool(workers) as pool:
            futures: dict[Any, int] = {}
            try:
                while window.left:
                    for chunk in window.ready():
                        futures[pool.submit(*work(chunk))] = chunk
                    for future in wait(futures, return_when=FIRST_COMPLETED).done:
                        result = future.result()
                        chunk = futures.pop(future)
                        del window.left[chunk]
                        deaths = 0
                        yield chunk, result
                return
            except BrokenProcessPool:
                deaths += 1
    raise RollerrigError(
        f"worker processes died {DEATHS} times without a finished chunk (killed, or out of memory?): "
        f"{len(window.left)} chunks are left, and finished chunks are kept; repeat the command with "
        "fewer --workers to continue"
    )


def _silent(message: str) -> None:
    """Report nothing."""


def on_a_cluster(
    work: Work, chunks: Sequence[int], address: str, report: Callable[[str], None] = _silent
) -> Iterator[tuple[int, Any]]:
    """Do chunks on a Dask cluster; yield each with its result when it is done.

    The work of a worker that dies goes to another worker. `report` gets a sentence while no worker
    is connected. Raises ConfigError without Dask or a scheduler, or if a worker cannot load
    rollerrig, and RollerrigError if the cluster fails.
    """
    try:
        from distributed import CancelledError, Client, KilledWorker
        from distributed import as_completed as completed
        from distributed.comm import CommClosedError
    except ImportError:
        raise ConfigError("--scheduler needs Dask: pip install 'rollerrig[cluster]'") from None
    try:
        client = Client(address, timeout=10)
    except OSError as error:
        raise ConfigError(
            f"--scheduler {address}: no Dask scheduler answers ({error}); start one with "
            "'dask scheduler --host 127.0.0.1' and workers with 'dask worker ADDRESS'"
        ) from None
    with client:
        window = _Window(chunks, _threads(client))
        futures: dict[Any, int] = {}

        def begin() -> list[Any]:
            # workers may have joined
            window.size = max(window.size, WINDOW * _threads(client))
            new = []
            for chunk in window.ready():
                # nothing is scattered: data that only a lost worker had would be lost with it
                future = client.submit(*work(chunk), pure=False, retries=3)
                futures[future] = chunk
                new.append(future)
            return new

        watch = _Watch(client, address, report)
        try:
            all_completed = completed(begin(), with_results=True)
            while window.left:
                while not all_completed.has_ready():
                    watch.look()
                future, result = next(all_completed)
                chunk = futures.pop(future)
                del window.left[chunk]
                yield chunk, result
                future.release()
                all_completed.update(begin())
        except ImportError as error:
            raise ConfigError(
                f"--scheduler {address}: a worker cannot load what it needs ({error}); install the same "
                "version of rollerrig on all machines, and repeat the command"
            ) from None
        except (KilledWorker, CommClosedError, CancelledError, OSError) as error:
            raise RollerrigError(
                f"--scheduler {address}: the cluster failed ({error}); finished chunks are kept: "
                "repeat the command to continue"
            ) from None


class _Watch:
    """Waits for the results of a cluster, and reports while no worker is connected."""

    def __init__(self, client: Any, address: str, report: Callable[[str], None]) -> None:
        self._client = client
        self._address = address
        self._report = report
        self._report_at_s = time.monotonic() + REPORT_AFTER_S

    def look(self) -> None:
        """Wait a moment; report a cluster without workers if that is due."""
        time.sleep(_LOOK_EVERY_S)
        now_s = time.monotonic()
        if now_s < self._report_at_s:
            return
        if self._client.nthreads():
            self._report_at_s = now_s + REPORT_AFTER_S
            return
        self._report_at_s = now_s + REPORT_EVERY_S
        self._report(
            f"no worker is connected to {self._address}, so nothing is computed; start one with "
            f"'dask worker {self._address}' (Ctrl-C stops, and finished chunks are kept)"
        )


def _threads(client: Any) -> int:
    """Return the number of threads of all workers of a cluster, at least 1."""
    return max(sum(client.nthreads().values()), 1)
