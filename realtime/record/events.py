"""The events of a run that are kept in memory: the first, the last, and how many there were of each level."""

from collections import Counter, deque
from collections.abc import Iterator
from typing import Any

KEPT = 500


class Events:
    """Takes any number of events; iterating gives the first and last KEPT of them as a summary has them."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._first: list[dict[str, Any]] = []
        self._last: deque[dict[str, Any]] = deque(maxlen=KEPT)

    def add(self, time_s: float, level: str, text: str) -> None:
        """Append an event (info, warning, error)."""
        self.counts[level] += 1
        (self._first if len(self._first) < KEPT else self._last).append(
            {"time_s": time_s, "level": level, "text": text}
        )

    @property
    def left_out(self) -> int:
        """How many events are no longer kept."""
        return self.counts.total() - len(self._first) - len(self._last)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        yield from self._first
        if self.left_out:
            yield {
                "time_s": self._last[0]["time_s"],
                "level": "warning",
                "text": f"{self.left_out} events are left out before this one; events.jsonl has what was recorded",
            }
        yield from self._last

    def rows(self) -> list[tuple[float, str, str]]:
        """The same as (time_s, level, text)."""
        return [(one["time_s"], one["level"], one["text"]) for one in self]
