"""The core of the real-time loop: claimed for one bench, and left by all else that the bench runs.

On a separate core, the loop's thread is not delayed by the bench's other threads, nor by the data
that they leave in the caches. Two benches claim different cores, and leave at least one that nobody
claims. A claim is an abstract Unix socket with the name of the core, which the system frees when
its process ends, however it ends.

Interrupts of devices are kept off the core as far as the user may (root). Those of the loopback are
served where its packets are sent, so they leave the core together with the threads that send.
"""

import contextlib
import os
import socket
from pathlib import Path

# loop.cpu of a scenario: the bench claims a core, or the loop runs on any
CLAIM = -1
ANY = -2

_CLAIM_NAME = "rollerrig loop on core "
_ABSTRACT = "\0"  # begins the names of sockets that are no files
_SOCKETS = Path("/proc/net/unix")
_PROCESSES = Path("/proc")
_TASKS = "/proc/{pid}/task"
INTERRUPTS = Path("/proc/irq")
ALLOWED = "smp_affinity_list"  # file of an interrupt with the cores that may serve it
_COUNTS = Path("/proc/interrupts")
# looks for threads that have started while others left their core
_MOST_LOOKS = 10


class Claim:
    """The core of a loop until `close`. Its number is -1 if the loop runs on any core."""

    def __init__(self, number: int = -1, held: socket.socket | None = None) -> None:
        self.number = number
        self._held = held

    @property
    def owned(self) -> bool:
        """Whether no other bench has claimed this core."""
        return self._held is not None

    def close(self) -> None:
        """Give the core back."""
        if self._held is not None:
            self._held.close()


def claim(wanted: int) -> Claim:
    """Claim a core for the loop; `wanted` is `loop.cpu`.

    With `CLAIM` it is the allowed core that has served the fewest interrupts of devices, of those
    that no other bench has claimed. A core that is named is taken even if another bench has claimed
    it. The claim does not own a core that is the only allowed one, because no thread can leave it.
    """
    if wanted == ANY:
        return Claim()
    allowed = os.sched_getaffinity(0)
    if wanted != CLAIM:
        others = allowed - {wanted}
        return Claim(wanted, _hold(wanted) if others else None)
    free = allowed - claimed()
    served = _interrupts_served()
    # the core with the most interrupts remains for all other threads
    for core in sorted(free, key=lambda core: served.get(core, 0))[:-1]:
        held = _hold(core)
        if held is not None:
            return Claim(core, held)
    return Claim()


def _hold(core: int) -> socket.socket | None:
    """Return the socket that claims a core; None if another process has claimed it."""
    held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        held.bind(f"{_ABSTRACT}{_CLAIM_NAME}{core}")
    except OSError:
        held.close()
        return None
    return held


def claimed() -> set[int]:
    """Return the cores that the loops of running benches have claimed."""
    try:
        text = _SOCKETS.read_text(errors="replace")
    except OSError:
        return set()
    # the kernel writes an abstract name with @ in front
    names = [line.rpartition("@")[2] for line in text.splitlines()]
    numbers = [name.removeprefix(_CLAIM_NAME) for name in names if name.startswith(_CLAIM_NAME)]
    return {int(number) for number in numbers if number.isdecimal()}


def leave(left: set[int], pid: int) -> dict[int, set[int]]:
    """Keep all threads of a process off some cores; return their cores before, by thread.

    A thread that may run on no other core stays. Threads that these start
    later inherit their cores.
    """
    before: dict[int, set[int]] = {}
    # again until nothing is found: a thread may have started another one before it left
    for _ in range(_MOST_LOOKS):
        found = _leave_once(left, pid)
        if not found:
            break
        before = found | before
    return before


def _leave_once(left: set[int], pid: int) -> dict[int, set[int]]:
    """Keep the present threads off some cores; return the cores before of those that were there."""
    before = {}
    for thread in _threads(pid):
        # the thread may have ended in the meantime
        with contextlib.suppress(OSError):
            allowed = os.sched_getaffinity(thread)
            if allowed & left and allowed - left:
                os.sched_setaffinity(thread, allowed - left)
                before[thread] = allowed
    return before


def restore(before: dict[int, set[int]]) -> None:
    """Let threads run again where they ran before `leave`."""
    for thread, allowed in before.items():
        with contextlib.suppress(OSError):
            os.sched_setaffinity(thread, allowed)


def family(pid: int) -> list[int]:
    """Return a process and all processes that it and its children have started."""
    children: dict[int, list[int]] = {}
    for folder in _PROCESSES.glob("[0-9]*"):
        # the process may have ended in the meantime
        with contextlib.suppress(OSError):
            # the name in brackets may contain spaces; the state and the parent follow it
            after_name = (folder / "stat").read_text(errors="replace").rpartition(")")[2]
            parent = int(after_name.split()[1])
            children.setdefault(parent, []).append(int(folder.name))
    found = [pid]
    for process in found:  # it grows while it is read
        found += children.get(process, [])
    return found


def _threads(pid: int) -> list[int]:
    try:
        return [int(name) for name in os.listdir(_TASKS.format(pid=pid))]
    except OSError:
        return []


def interrupts_on(core: int) -> list[str]:
    """Return the numbers of the interrupts of devices that are served on a core.

    An interrupt that was moved is served in its former place once more at most.
    """
    found = []
    for folder in sorted(INTERRUPTS.glob("[0-9]*"), key=lambda folder: int(folder.name)):
        with contextlib.suppress(OSError, ValueError):
            in_use = any(path.is_dir() for path in folder.iterdir())
            allowed = cores_of((folder / ALLOWED).read_text())
            served = cores_of((folder / "effective_affinity_list").read_text())
            if in_use and core in allowed & served:
                found.append(folder.name)
    return found


def _interrupts_served() -> dict[int, int]:
    """Return how many interrupts of devices each core has served since the machine was started.

    The result is empty where the system hides them, as some containers do.
    """
    try:
        lines = _COUNTS.read_text().splitlines()
    except OSError:
        return {}
    if not lines:
        return {}
    cores = [int(word.removeprefix("CPU")) for word in lines[0].split()]
    served = dict.fromkeys(cores, 0)
    for line in lines[1:]:
        words = line.split()
        # interrupts of devices have numbers, those of the cores themselves have letters
        if words and words[0].rstrip(":").isdecimal():
            for core, count in zip(cores, words[1:], strict=False):
                served[core] += int(count) if count.isdecimal() else 0
    return served


def cores_of(text: str) -> set[int]:
    """Return the cores of a list of the kernel, as in "0-3,7". Raises ValueError."""
    found: set[int] = set()
    for part in text.strip().split(","):
        if part:
            first, _, last = part.partition("-")
            found.update(range(int(first), int(last or first) + 1))
    return found
