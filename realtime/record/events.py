"""The events of a run that stay in memory: the first ones, the last ones, and a count by level."""

from collections import Counter, deque
from collections.abc import Iterator

from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.events import Code, Event

KEPT = 500


class Events:
    """A list of events that stays short: the first and the last `KEPT` of them.

    Iterating yields these, and between them one event with the number of those left out. `counts`
    has the number of all events by level.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._first: list[Event] = []
        self._last: deque[Event] = deque(maxlen=KEPT)

    def add(self, event: Event) -> None:
        """Append an event."""
        self.counts[event.level] += 1
        if len(self._first) < KEPT:
            self._first.append(event)
        else:
            self._last.append(event)

    @property
    def left_out(self) -> int:
        """How many events are no longer in memory."""
        return self.counts.total() - len(self._first) - len(self._last)

    def __iter__(self) -> Iterator[Event]:
        yield from self._first
        if self.left_out:
            next_s = self._last[0].time_s
            yield events.make(next_s, Code.EVENTS_LEFT_OUT, events=self.left_out)
        yield from self._last
