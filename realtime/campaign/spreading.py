"""Spreads the chunks of a campaign over processes of this machine, or over a Dask cluster.

Only a window of chunks is in work: a chunk begins when the oldest unfinished one is at most WINDOW
chunks per worker behind it. The memory therefore does not grow with the campaign, and who merges
chunks in their order holds back at most a window of them.
"""

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


def on_a_cluster(work: Work, chunks: Sequence[int], address: str) -> Iterator[tuple[int, Any]]:
    """Do chunks on a Dask cluster; yield each with its result when it is done.

    The work of a worker that dies goes to another worker. Raises ConfigError without Dask or a
    scheduler, and RollerrigError if the cluster fails.
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

        try:
            all_completed = completed(begin(), with_results=True)
            for future, result in all_completed:
                chunk = futures.pop(future)
                del window.left[chunk]
                yield chunk, result
                future.release()
                all_completed.update(begin())
        except (KilledWorker, CommClosedError, CancelledError, OSError) as error:
            raise RollerrigError(
                f"--scheduler {address}: the cluster failed ({error}); finished chunks are kept: "
                "repeat the command to continue"
            ) from None


def _threads(client: Any) -> int:
    """Return the number of threads of all workers of a cluster, at least 1."""
    return max(sum(client.nthreads().values()), 1)
