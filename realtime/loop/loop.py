"""The real-time loop: one compiled call that gives every tick an absolute deadline.

It holds no GIL, allocates nothing and logs nothing. Each tick sleeps until its deadline, notes how
late it begins, runs, and wakes the bus thread when a SYNC is due. On a core of its own it sleeps
until shortly before the deadline, and then waits awake: the kernel takes some time to wake a
thread, which then counts no longer. A tick that starts after the next
one was due counts as missed, and the loop then catches up. After a stall of more than a hundred
ticks it sets its next deadline from the present time instead. From then on simulated time is behind
the clock of the bus, by the sum in STALLED_NS.
"""

import contextlib
import os
import resource
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from rollerrig.configs.processes import memory
from rollerrig.realtime.loop import held_rig, tick
from rollerrig.realtime.loop.clock import now_ns, sleep_until, wake
from rollerrig.realtime.loop.tick import (
    BUSY_NS,
    DONE,
    HELD,
    LATE_NS,
    MISSED,
    STALLED_NS,
    STOP,
    TICK,
    WORST_NS,
)
from rollerrig.rig.compiled.kernel import kernel

# histogram of lateness: bins of 1 us, the last one holds all that is later
BINS = 20_000
_STALL_TICKS = 100
# The largest share of a tick in which the thread is awake while it waits for the deadline. The
# kernel takes the core from a real-time thread that is awake for more than 95 % of a second.
_AWAKE_SHARE = 0.8
# counters of getrusage(2) by their names in the summary
INTERRUPTIONS = {"page_faults": "ru_minflt", "pages_read": "ru_majflt", "preempted": "ru_nivcsw"}
# the bus thread has this share of the real-time thread's priority
BUS_SHARE = 0.75
# the unit of the bench has less: a unit that hangs in a computation must not stop the bus where
# they share a core
UNIT_SHARE = 0.5
_PERCENTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}


@kernel
def wall(m, tick_ns, sync_ticks, early_ns, descriptor, histogram, scratch, begin_ns):
    """Run ticks on their deadlines until the run is done or stopped.

    Tick k (from 0) begins at begin_ns + (k + 1) tick_ns. The thread wakes at most `early_ns` before
    that. `histogram` int64 (BINS,) takes the lateness in us, `scratch` int64 (3,); `descriptor` is
    the eventfd of the bus thread.
    """
    spec = scratch[:2]
    one = scratch[2:]
    one[0] = 1
    deadline = begin_ns + tick_ns
    took = 0
    while m.control[STOP] == 0 and m.control[DONE] == 0:
        began = wait(deadline, tick_ns, early_ns, took, spec)
        late = began - deadline
        histogram[min(late // 1000, histogram.size - 1)] += 1
        note(m.control, late, tick_ns)
        if is_stall(late, tick_ns):
            deadline = began
        if held_rig.is_held(m, sync_ticks):
            held_rig.roll(m)
        else:
            tick.run_tick(m)
        if (m.control[TICK] + m.control[HELD]) % sync_ticks == 0:
            wake(descriptor, one)
        took = now_ns(spec) - began
        m.control[BUSY_NS] = max(m.control[BUSY_NS], took)
        deadline += tick_ns
    wake(descriptor, one)


@kernel
def wait(deadline, tick_ns, early_ns, took, spec):
    """Wait for the deadline of a tick in ns; return when it begins, at the deadline or later.

    `early_ns` as for `wall`, `took` the duration of the tick before, `spec` int64 (2,) scratch.
    """
    sleep_until(deadline - max(min(early_ns, int(_AWAKE_SHARE * tick_ns) - took), 0), spec)
    began = now_ns(spec)
    while began < deadline:
        began = now_ns(spec)
    return began


@kernel
def is_stall(late, tick_ns):
    """Return whether a tick begins so late that the loop does not catch up."""
    return late > _STALL_TICKS * tick_ns


@kernel
def note(control, late, tick_ns):
    """Note in the control array of a vehicle how many ns late a tick begins."""
    control[WORST_NS] = max(control[WORST_NS], late)
    control[LATE_NS] = max(control[LATE_NS], late)
    if late >= tick_ns:
        control[MISSED] += 1
        if is_stall(late, tick_ns):
            control[MISSED] += late // tick_ns - 1
            control[STALLED_NS] += late


def ask_for_priority(priority: int, cpu: int) -> list[str]:
    """Request SCHED_FIFO, locked memory and a core for this thread; return what the system refused.

    A priority of 0 requests neither SCHED_FIFO nor locked memory, a core of -1 any core.
    """
    refused: list[str] = []
    # First the core: with its priority this thread would keep those threads from running that share
    # its core and hold what it waits for.
    if cpu >= 0:
        try:
            os.sched_setaffinity(0, {cpu})
        except OSError as error:
            refused.append(
                f"core {cpu} ({error.strerror}): set loop.cpu to one of "
                f"{sorted(os.sched_getaffinity(0))} or -1"
            )
    if priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as error:
            refused.append(
                f"SCHED_FIFO priority {priority} ({error.strerror}): allow it with "
                "'ulimit -r 90' (rtprio in /etc/security/limits.conf) or CAP_SYS_NICE"
            )
        reason = memory.lock()
        if reason:
            refused.append(
                f"locked memory ({reason}): allow it with 'ulimit -l unlimited' "
                "(memlock in /etc/security/limits.conf) or CAP_IPC_LOCK"
            )
    return refused


def priority_refused(priority: int) -> str:
    """Return "" or the reason why the system grants no thread SCHED_FIFO with this priority."""
    # 0 means the calling thread; a thread of a pool is used so that this one keeps its priority
    with ThreadPoolExecutor(1) as pool:
        parameters = os.sched_param(priority)
        error = pool.submit(os.sched_setscheduler, 0, os.SCHED_FIFO, parameters).exception()
    if error is None:
        return ""
    return getattr(error, "strerror", None) or "refused"


def prefer_bus_thread(priority: int) -> str:
    """Let the calling thread run below the real-time thread and before all others.

    Returns "" or the reason why that is not possible. `priority` is that of the real-time thread; 0
    makes the calling thread an ordinary thread again. On a busy machine an ordinary bus thread
    loses SYNCs: every third was lost at 1 kHz, and none with priority. Processes and threads that
    this thread starts do not inherit the priority.
    """
    if priority:
        below = max(int(BUS_SHARE * priority), 1)
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    else:
        below = 0
        policy = os.SCHED_OTHER
    try:
        os.sched_setscheduler(0, policy, os.sched_param(below))
    except OSError as error:
        return error.strerror or "refused"
    return ""


@contextlib.contextmanager
def interruptions(found: dict[str, int]) -> Iterator[None]:
    """Add to `found` the page faults and preemptions of the calling thread inside the block."""
    before = resource.getrusage(resource.RUSAGE_THREAD)
    yield
    after = resource.getrusage(resource.RUSAGE_THREAD)
    for name, counter in INTERRUPTIONS.items():
        found[name] = found.get(name, 0) + getattr(after, counter) - getattr(before, counter)


def percentiles(histogram: np.ndarray, worst_ns: int) -> dict[str, float]:
    """Return the lateness in us at 50, 99 and 99.9 % of the ticks, and the largest.

    A percentile is the upper edge of its bin.
    """
    worst_us = worst_ns / 1000.0
    counted = np.cumsum(histogram)
    if counted[-1]:
        shares = np.array(tuple(_PERCENTILES.values()))
        edges_us = np.searchsorted(counted, shares * counted[-1]) + 1
    else:
        edges_us = np.zeros(len(_PERCENTILES))
    found = dict(zip(_PERCENTILES, np.minimum(edges_us, worst_us).tolist(), strict=True))
    found["max"] = worst_us
    return found
