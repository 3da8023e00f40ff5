"""Sends rows of signals and events to Rerun, in blocks of columns.

One call costs about 0.1 ms whatever its length, so rows are sent in blocks: one call for each
entity of `views.lines` and `derived.curves`, and states only where they change.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import rerun as rr

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.telemetry import derived, scene, views
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Event

_MARKS = "/speeds/marks"


class Drawing:
    """One run on a stream, beneath another by `prefix` and `faint`; `everything`: also signals of no group."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        scenario: Mapping[str, Any],
        prefix: str = "",
        faint: bool = False,
        everything: bool = True,
        unit: str = "",
    ) -> None:
        self._stream, self._prefix = stream, prefix
        self._lines = [
            one for one in views.lines() if everything or not one.path.startswith(views.MORE)
        ]
        self._curves = derived.curves(scenario, unit, band=not faint)
        self._changes = views.Changes(stream)
        self._turning, self._top = None, 3.6 * float(scenario.get("initial_speed_m_s", 0.0))
        marks = derived.Curve(_MARKS, ("fault, warning",), (colours.VERMILION,), 0.8, np.asarray)
        views.style(stream, prefix, faint, [*self._curves, marks])
        if not prefix:
            place = scene.scene(scenario)
            scene.draw(stream, place)
            self._turning = scene.Turning(stream, place)

    def rows(self, rows: np.ndarray) -> None:
        """Send rows of all signals, shape (n, columns), times rising."""
        if not len(rows):
            return
        time_s = rows[:, signals.column("time")]
        times = views.times(time_s)
        for one in self._lines:
            self._scalars(one.path, times, one.factor * rows[:, one.columns])
        for curve in self._curves:
            self._scalars(curve.path, times, curve.of(rows))
        for axle in range(1, signals.AXLES + 1):
            self._changes.send(
                views.valve(axle, self._prefix),
                time_s,
                views.valve_states(rows, axle),
                lambda states: rr.StateChange.columns(
                    state=[colours.VALVE_STATES[one][0] for one in states]
                ),
            )
        if self._turning:
            self._turning.rows(rows)

    def _scalars(self, path: str, times: rr.TimeColumn, values: np.ndarray) -> None:
        columns = rr.Scalars.columns(scalars=np.ascontiguousarray(values).ravel())
        if values.shape[1] > 1:
            columns = columns.partition([values.shape[1]] * len(values))
        self._stream.send_columns(self._prefix + path, [times], columns)

    def result(self, text: str, time_s: float | None = None) -> None:
        """Show Markdown in the box, from an instant on or always."""
        if time_s is not None:
            self._stream.set_time(views.TIMELINE, duration=time_s)
        self._stream.log(
            views.BOX,
            rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN),
            static=time_s is None,
        )

    def events(self, events: Iterable[Event]) -> None:
        """Send events: those of the network apart, faults and warnings also as marks."""
        events = list(events)
        for path, some in (
            (views.EVENTS, [one for one in events if not derived.of_network(one)]),
            (views.NETWORK, [one for one in events if derived.of_network(one)]),
        ):
            self._log(path, some)
        if at_s := [one.time_s for one in derived.marks(events)]:
            # an upright stroke: two points at an instant, and a gap behind it
            times = views.times(np.repeat(at_s, 3) + np.tile((0.0, 0.0, 1e-9), len(at_s)))
            self._scalars(
                _MARKS, times, np.tile((0.0, self._top, np.nan), len(at_s))[:, np.newaxis]
            )

    def _log(self, path: str, events: list[Event]) -> None:
        if not events:
            return
        levels = [views.LEVELS.get(one.level, views.LEVELS["info"]) for one in events]
        # the viewer's own column of times is too narrow to read
        run = self._prefix.rpartition("/")[2]
        texts = [f"{one.time_s:7.2f} s  {run}{': ' if run else ''}{one.text}" for one in events]
        self._stream.send_columns(
            self._prefix + path,
            [views.times(np.array([one.time_s for one in events]))],
            rr.TextLog.columns(
                text=texts,
                level=[name for name, _ in levels],
                color=[colour for _, colour in levels],
            ),
        )
