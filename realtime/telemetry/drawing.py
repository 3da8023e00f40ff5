"""Sends rows of signals and events to Rerun, in blocks of columns.

A call takes about 0.1 ms whatever its length, so rows are sent in blocks: one call for each entity
of `views.lines` and `derived.curves`, and states only where they change.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.telemetry import derived, scene, views
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Event
from rollerrig.wsp_interface.signals import Table

_MARKS = "/speeds/marks"

_KM_H_PER_M_S = 3.6

# s. The gap after a mark follows its two points at the shortest time that the timeline can hold.
_GAP_S = 1e-9


class Drawing:
    """A run on a Rerun stream. `table` has the signals of its vehicle.

    Another run has a `prefix` before its paths, and is drawn `faint`. `everything` also draws the
    signals that belong to no group. `unit` is the WSP unit that protects the run.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        table: Table,
        scenario: Mapping[str, Any],
        prefix: str = "",
        faint: bool = False,
        everything: bool = True,
        unit: str = "",
    ) -> None:
        self._stream = stream
        self._table = table
        self._prefix = prefix
        self._lines = [
            line
            for line in views.lines(table)
            if everything or not line.path.startswith(views.MORE)
        ]
        self._curves = derived.curves(table, scenario, unit, band=not faint)
        self._changes = views.Changes(stream)
        # marks reach up to the initial speed
        self._mark_height_km_h = _KM_H_PER_M_S * float(scenario.get("initial_speed_m_s", 0.0))

        marks = derived.Curve(
            path=_MARKS,
            names=("fault, warning",),
            colours=(colours.VERMILION,),
            width=0.8,
            values=np.asarray,
        )
        views.log_styles(stream, table, prefix, faint, [*self._curves, marks])

        # only the first run shows its rig
        self._rotation: scene.Rotation | None = None
        if not prefix:
            geometry = scene.geometry(table.kind, scenario)
            scene.draw(stream, geometry)
            self._rotation = scene.Rotation(stream, geometry)

    def rows(self, rows: np.ndarray) -> None:
        """Send rows of all signals, shape (n, signals.WIDTH), times rising."""
        if not len(rows):
            return
        time_s = rows[:, signals.column("time")]
        times = views.times(time_s)
        for line in self._lines:
            self._send_scalars(line.path, times, line.factor * rows[:, line.columns])
        for curve in self._curves:
            self._send_scalars(curve.path, times, curve.values(rows))
        for axle in self._table.axles:
            self._changes.send(
                views.valve(axle, self._prefix),
                time_s,
                views.valve_states(rows, axle),
                valve_columns,
            )
        if self._rotation:
            self._rotation.rows(rows)

    def _send_scalars(self, path: str, times: rr.TimeColumn, values: np.ndarray) -> None:
        """Send values of shape (n, series) as one entity."""
        count, series = values.shape
        columns = rr.Scalars.columns(scalars=np.ascontiguousarray(values).ravel())
        if series > 1:
            columns = columns.partition([series] * count)
        self._stream.send_columns(self._prefix + path, [times], columns)

    def result(self, text: str, time_s: float | None = None) -> None:
        """Show Markdown in the view of the result: from a time on, or always."""
        if time_s is not None:
            self._stream.set_time(views.TIMELINE, duration=time_s)
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._stream.log(views.RESULT, document, static=time_s is None)

    def events(self, events: Iterable[Event]) -> None:
        """Send events, and a mark for each fault, warning and error.

        Events of the network have a separate path.
        """
        events = list(events)
        of_run = []
        of_network = []
        for event in events:
            if derived.is_of_network(event):
                of_network.append(event)
            else:
                of_run.append(event)
        self._send_texts(views.EVENTS, of_run)
        self._send_texts(views.NETWORK, of_network)
        self._send_marks(derived.to_be_marked(events))

    def _send_marks(self, marked: list[Event]) -> None:
        """Send a vertical stroke for each event: two points at its time, and a gap after them."""
        if not marked:
            return
        of_stroke = np.array([0.0, self._mark_height_km_h, np.nan])
        offset_s = np.array([0.0, 0.0, _GAP_S])
        at_s = np.repeat([event.time_s for event in marked], len(of_stroke))
        times = views.times(at_s + np.tile(offset_s, len(marked)))
        heights_km_h = np.tile(of_stroke, len(marked))
        self._send_scalars(_MARKS, times, heights_km_h[:, np.newaxis])

    def _send_texts(self, path: str, events: list[Event]) -> None:
        if not events:
            return
        texts = [self._text(event) for event in events]
        send_texts(self._stream, self._prefix + path, events, texts)

    def _text(self, event: Event) -> str:
        """Return the time, run and text of an event; the viewer's column of times is too narrow."""
        run = self._prefix.rpartition("/")[2]
        if run:
            return f"{event.time_s:7.2f} s  {run}: {event.text}"
        return f"{event.time_s:7.2f} s  {event.text}"


def send_texts(
    stream: rr.RecordingStream, path: str, events: Sequence[Event], texts: Sequence[str]
) -> None:
    """Send events with a text for each, in the colours of their levels."""
    levels = [views.LEVELS.get(event.level, views.LEVELS["info"]) for event in events]
    stream.send_columns(
        path,
        [views.times(np.array([event.time_s for event in events]))],
        rr.TextLog.columns(
            text=list(texts),
            level=[name for name, _ in levels],
            color=[colour for _, colour in levels],
        ),
    )


def valve_columns(states: np.ndarray) -> Any:
    """Return the names of valve states as columns for Rerun."""
    names = [colours.VALVE_STATES[state][0] for state in states]
    return rr.StateChange.columns(state=names)
