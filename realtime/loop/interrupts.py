"""Keeps the interrupts of devices off the cores of all running loops, and brings them back.

Only root may move interrupts. Several benches move the same ones, and a bench may be killed. So
their cores before are in a file of root that lasts until the machine is started again. Each bench
that begins or ends computes anew, from this file and from the cores that running benches claim,
where each interrupt may be served. The claim of a killed bench is gone with it, so the next bench
brings its interrupts back. An interrupt that somebody else has moved in the meantime stays there.
"""

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rollerrig.realtime.loop import cores

_RECORD = Path("/run/rollerrig-interrupts.json")
_MOST_BYTES = 1_000_000


class Moved(NamedTuple):
    """The cores of an interrupt before it was moved, and after: lists as the kernel has them."""

    before: str
    after: str


@contextlib.contextmanager
def kept_off(claim: cores.Claim) -> Iterator[list[str]]:
    """Keep interrupts off the core of a claim inside the block, and close the claim at its end.

    Yields the numbers of the interrupts that stay on the core.
    """
    settle({claim.number})
    try:
        yield cores.interrupts_on(claim.number)
    finally:
        claim.close()
        settle(set())


def settle(also: set[int]) -> None:
    """Move interrupts off the cores of running loops and off some others; bring back all the rest.

    Without the right to, it does nothing.
    """
    with contextlib.suppress(OSError), _record() as descriptor:
        moved = _read(descriptor)
        taken = cores.claimed() | also
        numbers = {number for core in taken for number in cores.interrupts_on(core)}
        wanted: dict[str, Moved] = {}
        for number in sorted({*moved, *numbers}):
            # the interrupt may have disappeared
            with contextlib.suppress(OSError, ValueError):
                wanted[number] = _planned(number, moved.get(number), taken)

        # before and after, because this process may be killed in between
        _write(descriptor, moved | wanted)
        for number, plan in wanted.items():
            # the kernel keeps some interrupts
            with contextlib.suppress(OSError):
                (cores.INTERRUPTS / number / cores.ALLOWED).write_text(plan.after)
        _write(descriptor, {n: plan for n, plan in wanted.items() if plan.before != plan.after})


def _planned(number: str, moved: Moved | None, taken: set[int]) -> Moved:
    """Return where an interrupt was and where it shall be; both are equal if it shall be back.

    Raises OSError or ValueError if the system does not report it.
    """
    before = (cores.INTERRUPTS / number / cores.ALLOWED).read_text().strip()
    if moved is not None and _same(moved.after, before):
        before = moved.before
    allowed = cores.cores_of(before)
    others = allowed - taken or set(range(os.cpu_count() or 1)) - taken
    if not others or others == allowed:
        return Moved(before, before)
    return Moved(before, ",".join(map(str, sorted(others))))


def _same(one: str, other: str) -> bool:
    """Return whether two lists have the same cores."""
    return cores.cores_of(one) == cores.cores_of(other)


@contextlib.contextmanager
def _record() -> Iterator[int]:
    """Yield the descriptor of the record, which no other process uses meanwhile. Raises OSError."""
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    descriptor = os.open(_RECORD, flags, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)


def _read(descriptor: int) -> dict[str, Moved]:
    """Return the interrupts that are moved; none if the record is empty or damaged."""
    try:
        content = json.loads(os.pread(descriptor, _MOST_BYTES, 0))
        moved = {number: Moved(*lists) for number, lists in content.items()}
        for one in moved.values():
            cores.cores_of(one.before)
            cores.cores_of(one.after)
        return moved
    except (ValueError, TypeError, AttributeError):
        return {}


def _write(descriptor: int, moved: dict[str, Moved]) -> None:
    content = json.dumps(moved).encode()
    os.pwrite(descriptor, content, 0)
    os.ftruncate(descriptor, len(content))
