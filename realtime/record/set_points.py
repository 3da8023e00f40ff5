"""Events of the set-points that clients write: speed, brake demand and friction.

A client may write ten times a second, and most writes of a ramp say nothing new. So the first
change of a set-point is an event, and then only the value that has stayed for `QUIET_S`; while the
value does not stay, it is an event every `LONGEST_S`. A value that is written again is no event.
"""

from dataclasses import dataclass
from typing import Any

from rollerrig.wsp_interface.events import Code, OnEvent

QUIET_S = 0.5
LONGEST_S = 10.0
_NEVER_S = -1e9


@dataclass(frozen=True)
class Value:
    """The value of a set-point, as the code and the fields of its event."""

    code: Code
    fields: dict[str, Any]


@dataclass
class _SetPoint:
    """A set-point: its present value, the last one that was an event, and when each came."""

    present: Value | None = None
    reported: Value | None = None
    changed_s: float = _NEVER_S
    reported_s: float = _NEVER_S


class SetPoints:
    """The set-points of a run. Times are those of one clock, in s."""

    def __init__(self, on_event: OnEvent) -> None:
        self._on_event = on_event
        self._set_points: dict[str, _SetPoint] = {}
        self._pending: set[str] = set()

    def change(self, name: str, now_s: float, code: Code, **fields: Any) -> None:
        """Take a new value of a set-point, as the code and the fields of its event."""
        point = self._set_points.setdefault(name, _SetPoint())
        value = Value(code, fields)
        if value == point.present:
            return
        was_quiet = now_s - point.changed_s >= QUIET_S and name not in self._pending
        point.present = value
        point.changed_s = now_s
        if was_quiet:
            self._report(name, now_s)
        else:
            self._pending.add(name)

    def poll(self, now_s: float) -> None:
        """Report the values that have stayed, and those that have not been reported for long."""
        if not self._pending:
            return
        for name in sorted(self._pending):
            point = self._set_points[name]
            stays = now_s - point.changed_s >= QUIET_S
            if stays or now_s - point.reported_s >= LONGEST_S:
                self._report(name, now_s)

    def report_all(self) -> None:
        """Report the last values; call it at the end of the run."""
        for name in sorted(self._pending):
            self._report(name, self._set_points[name].changed_s)

    def _report(self, name: str, now_s: float) -> None:
        """Report the present value of a set-point, unless it was the last one reported."""
        self._pending.discard(name)
        point = self._set_points[name]
        if point.present == point.reported or point.present is None:
            return
        point.reported = point.present
        point.reported_s = now_s
        self._on_event(point.present.code, **point.present.fields)
