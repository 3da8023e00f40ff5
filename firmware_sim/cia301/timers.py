"""Named alarms on a time that somebody else tells.

A node owns no clock: whoever runs it says what time it is, in simulated or in wall nanoseconds.
Nothing is done before the earliest alarm is due, so an idle poll costs one comparison.
"""

from collections.abc import Callable

NEVER = 1 << 62
MS = 1_000_000


class Timers:
    """A few named alarms; setting a name again moves its alarm."""

    def __init__(self) -> None:
        self._due: dict[str, tuple[int, Callable[[], None]]] = {}
        self.next_ns = NEVER

    def set(self, name: str, due_ns: int, call: Callable[[], None]) -> None:
        """Call once at `due_ns`."""
        self._due[name] = (due_ns, call)
        self.next_ns = min(self.next_ns, due_ns)

    def cancel(self, name: str) -> None:
        """Forget an alarm; a name that is not set is no error."""
        self._due.pop(name, None)

    def clear(self) -> None:
        """Forget every alarm."""
        self._due.clear()
        self.next_ns = NEVER

    def running(self, name: str) -> bool:
        """Whether an alarm of this name waits."""
        return name in self._due

    def poll(self, now_ns: int) -> None:
        """Call every alarm that is due, the earliest first."""
        if now_ns < self.next_ns:
            return
        due = sorted((at, name) for name, (at, _) in self._due.items() if at <= now_ns)
        for at, name in due:
            # an earlier alarm may have cancelled or moved this one
            waiting = self._due.get(name)
            if waiting is not None and waiting[0] == at:
                del self._due[name]
                waiting[1]()
        self.next_ns = min((at for at, _ in self._due.values()), default=NEVER)
