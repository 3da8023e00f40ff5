"""Sends rows of signals and events to Rerun, in blocks of columns.

One call costs about 0.1 ms whatever its length, so rows are sent in blocks: one call for each
entity of `views.lines`, and states only where they change.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import rerun as rr

from rollerrig.realtime.telemetry import colours, scene, views
from rollerrig.wsp_interface import signals

Event = tuple[float, str, str]


class Drawing:
    """One run on a stream: styles it, and remembers what the last block left behind.

    `prefix` and `faint` lay a run beneath another; `everything` also sends signals of no group.
    """

    def __init__(self, stream: rr.RecordingStream, scenario: Mapping[str, Any], prefix: str = "",
                 faint: bool = False, everything: bool = True) -> None:
        self._stream, self._prefix = stream, prefix
        self._lines = [one for one in views.lines()
                       if everything or not one.path.startswith(views.MORE)]
        self._valve = np.full(signals.AXLES, -1)
        self._turning = None
        views.style(stream, prefix, faint)
        if not prefix:
            place = scene.scene(scenario)
            scene.draw(stream, place)
            self._turning = scene.Turning(stream, place)

    def rows(self, rows: np.ndarray) -> None:
        """Send rows of all signals, shape (n, columns), times rising."""
        if not len(rows):
            return
        ns = np.rint(rows[:, signals.column("time")] * 1e9).astype("timedelta64[ns]")
        times = rr.TimeColumn(views.TIMELINE, duration=ns)
        for one in self._lines:
            columns = rr.Scalars.columns(scalars=np.ascontiguousarray(rows[:, one.columns]).ravel())
            if len(one.columns) > 1:
                columns = columns.partition([len(one.columns)] * len(rows))
            self._stream.send_columns(self._prefix + one.path, [times], columns)
        self._valves(rows, ns)
        if self._turning:
            self._turning.rows(rows, ns)

    def _valves(self, rows: np.ndarray, ns: np.ndarray) -> None:
        names = [name for name, _ in colours.VALVE_STATES]
        for j in range(signals.AXLES):
            state = views.valve_states(rows, j + 1)
            change = np.flatnonzero(np.diff(state, prepend=self._valve[j]) != 0)
            self._valve[j] = state[-1]
            if change.size:
                self._stream.send_columns(
                    f"{self._prefix}{views.VALVES}/valve_{j + 1}",
                    [rr.TimeColumn(views.TIMELINE, duration=ns[change])],
                    rr.StateChange.columns(state=[names[k] for k in state[change]]))

    def events(self, events: Iterable[Event]) -> None:
        """Send events: (time in s, level, text)."""
        events = list(events)
        if not events:
            return
        ns = np.array([round(e[0] * 1e9) for e in events], dtype="timedelta64[ns]")
        levels = [views.LEVELS.get(level, views.LEVELS["info"]) for _, level, _ in events]
        # the viewer's own column of times is too narrow to read
        texts = [f"{time_s:7.2f} s  {text}" for time_s, _, text in events]
        self._stream.send_columns(
            self._prefix + views.EVENTS, [rr.TimeColumn(views.TIMELINE, duration=ns)],
            rr.TextLog.columns(text=texts, level=[name for name, _ in levels],
                               color=[colour for _, colour in levels]))
