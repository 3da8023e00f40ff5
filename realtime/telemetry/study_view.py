"""What tune, validate and explain find, as a Rerun recording next to their HTML.

Each quantity is an entity, under the name of its run. The time of each run is the timeline "t".
Scatter plots are points in the plane.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rollerrig.configs.output_files import write_bytes
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.colours import BLUE, GREY, Colour
from rollerrig.realtime.pictures.panel import Panel, Series
from rollerrig.realtime.telemetry.views import APPLICATION, times
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper.tuning import Tuned
from rollerrig.rig.identify.paper.validation import Verdict

_MODELS = {"measured": colours.MEASURED, "new": colours.EXTENDED, "classic": colours.BASE}

# f_r - f_d is taken as at least this where something is divided by it
_LEAST_SPREAD = 1e-9

# J/m that are as wide as one unit of lambda is high
_ENERGY_UNIT_J_M = 100.0

# A panel is drawn in a frame of this width and of height 1; y points down.
_PANEL_WIDTH = 1.6


@contextmanager
def _recording(path: Path, name: str) -> Iterator[rr.RecordingStream]:
    """A recording that is written to a file at the end. Raises OSError, and ConfigError."""
    with rr.RecordingStream(APPLICATION, recording_id=name) as recording:
        # in memory: when the disk is full, Rerun would wait for it for ever
        memory = recording.memory_recording()
        yield recording
        write_bytes(path, memory.drain_as_bytes())


def _log_scalars(
    recording: rr.RecordingStream,
    path: str,
    time_s: np.ndarray,
    values: np.ndarray,
    shades: Sequence[Colour],
    names: Sequence[str],
) -> None:
    """Write values (n,) or (n, names) as one entity."""
    recording.log(path, rr.SeriesLines(colors=shades, names=names), static=True)
    recording.send_columns(path, [times(time_s)], rr.Scalars.columns(scalars=values))


def _send_views(recording: rr.RecordingStream, view: rrb.Container) -> None:
    """Set the views that the viewer opens."""
    recording.send_blueprint(rrb.Blueprint(view, collapse_panels=True))


# --- tune and validate ---


def tuned(path: Path, data: Dataset, result: Tuned) -> None:
    """Write transition and adhesion of wheelset 1 in each tuning run, and transition against
    energy.
    """
    s = result.samples
    spread = np.maximum(result.recovered - result.degraded, _LEAST_SPREAD)
    model_transition = (result.model - result.degraded) / spread
    with _recording(path, f"tune {data.name}") as recording:
        for i, run in enumerate(data.group("tune")):
            shown = (s.run == i) & (s.axle == 0)
            for entity, values, shade in (
                (f"transition/{run.name}/measured", result.transition, colours.MEASURED),
                (f"transition/{run.name}/model", model_transition, BLUE),
                (f"adhesion/{run.name}/measured", s.adhesion, colours.MEASURED),
                (f"adhesion/{run.name}/model", result.model, BLUE),
                (f"adhesion/{run.name}/degraded", result.degraded, GREY),
            ):
                name = entity.rpartition("/")[2]
                _log_scalars(recording, entity, s.time_s[shown], values[shown], [shade], [name])

        # y points down in the plane
        points = np.column_stack([s.energy_J_m / _ENERGY_UNIT_J_M, -result.transition])
        recording.log("plane/measured", rr.Points2D(points, radii=0.01, colors=[GREY]), static=True)
        grid = np.linspace(0.0, float(np.percentile(s.energy_J_m, 99.5)), 200)
        exponential = np.expm1(-result.tau_m_J.value * grid)
        line = np.column_stack([grid / _ENERGY_UNIT_J_M, exponential])
        recording.log("plane/tuned", rr.LineStrips2D([line], colors=[BLUE]), static=True)

        courses = rrb.Vertical(
            rrb.TimeSeriesView(origin="/transition", name="transition, wheelset 1"),
            rrb.TimeSeriesView(origin="/adhesion", name="adhesion, wheelset 1"),
        )
        plane = rrb.Spatial2DView(origin="/plane", name="transition against W_sp / (100 J/m)")
        _send_views(recording, rrb.Horizontal(courses, plane))


def validated(path: Path, data: Dataset, verdicts: list[Verdict]) -> None:
    """Write vehicle speed and sliding of wheelset 1: measured, with and without recovery."""
    with _recording(path, f"validate {data.name}") as recording:
        tabs = []
        for verdict in verdicts:
            run = verdict.run
            for name, shade in _MODELS.items():
                time_s = verdict.time_s
                speed = verdict.speed_m_s[name]
                sliding = verdict.sliding_m_s[name][:, 0]
                _log_scalars(recording, f"speed/{run}/{name}", time_s, speed, [shade], [name])
                _log_scalars(recording, f"sliding/{run}/{name}", time_s, sliding, [shade], [name])
            tabs.append(
                rrb.Vertical(
                    rrb.TimeSeriesView(origin=f"/speed/{run}", name="vehicle speed, m/s"),
                    rrb.TimeSeriesView(origin=f"/sliding/{run}", name="sliding of wheelset 1, m/s"),
                    name=run,
                )
            )
        _send_views(recording, rrb.Tabs(*tabs))


# --- explain ---


def explained(
    path: Path,
    name: str,
    words: str,
    where: Sequence[Panel],
    causes: Sequence[Panel],
    courses: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> None:
    """Write an explanation: its words (Markdown), where it shows, the causes, the adhesion of every
    wheelset.

    `courses`: /run/adhesion_axle -> (time s, measured, base and extended values (n, 3)).
    """
    with _recording(path, f"explain {name}") as recording:
        document = rr.TextDocument(words, media_type=rr.MediaType.MARKDOWN)
        recording.log("words", document, static=True)
        where_views = [
            _log_panel(recording, f"where/{k}", panel) for k, panel in enumerate(where, start=1)
        ]
        cause_views = [
            _log_panel(recording, f"cause/{k}", panel) for k, panel in enumerate(causes, start=1)
        ]
        for entity, (time_s, values) in courses.items():
            _log_scalars(
                recording,
                f"courses{entity}",
                time_s,
                values,
                (colours.MEASURED, colours.BASE, colours.EXTENDED),
                ("measured", "base", "extended"),
            )

        verdict_view = rrb.TextDocumentView(origin="/words", name="verdict")
        tabs: list[rrb.Container] = [
            rrb.Horizontal(verdict_view, *cause_views, name="verdict"),
            rrb.Horizontal(*where_views, name="where it shows"),
        ]
        for run, entities in _by_run(courses).items():
            views = [
                rrb.TimeSeriesView(origin=f"/courses{entity}", name=entity.rpartition("/")[2])
                for entity in entities
            ]
            tabs.append(rrb.Vertical(*views, name=run))
        _send_views(recording, rrb.Tabs(*tabs))


def _by_run(entities: Mapping[str, object]) -> dict[str, list[str]]:
    """Return entities by their run, which is the first part of their path."""
    by_run: dict[str, list[str]] = {}
    for entity in entities:
        by_run.setdefault(entity.split("/")[1], []).append(entity)
    return by_run


class _Frame(NamedTuple):
    """The ends of the axes of a panel."""

    left: float
    right: float
    low: float
    high: float

    def placed(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return points (n, 2) in the frame of the panel."""
        width = max(self.right - self.left, 1e-12)
        height = max(self.high - self.low, 1e-12)
        return np.column_stack([_PANEL_WIDTH * (x - self.left) / width, (self.high - y) / height])


class _PanelWriter:
    """Writes points, lines and words of one panel under its entity."""

    def __init__(self, recording: rr.RecordingStream, entity: str) -> None:
        self._recording = recording
        self._entity = entity

    def words(self, name: str, where: list[list[float]], labels: list[str], colour: Colour) -> None:
        shape = rr.Points2D(where, radii=1e-4, colors=[colour], labels=labels, show_labels=True)
        self._recording.log(f"{self._entity}/{name}", shape, static=True)

    def lines(self, name: str, strips: Sequence[np.ndarray], colour: Colour, radius: float) -> None:
        shape = rr.LineStrips2D(strips, colors=[colour], radii=radius)
        self._recording.log(f"{self._entity}/{name}", shape, static=True)

    def points(self, name: str, points: np.ndarray, colour: Colour) -> None:
        shape = rr.Points2D(points, radii=0.012, colors=[colour])
        self._recording.log(f"{self._entity}/{name}", shape, static=True)

    def series(self, k: int, series: Series, frame: _Frame) -> None:
        """Write a series: a line, or points with error bars."""
        self.words(f"names/{k}", [[0.8, -0.32 + 0.06 * k]], [series.label], series.colour)
        points = frame.placed(series.x, series.y)
        # a line breaks where there is no number
        known = np.isfinite(series.x)
        if series.error is None:
            parts = np.split(points, np.flatnonzero(~known))
            strips = [part[np.isfinite(part[:, 0])] for part in parts]
            self.lines(f"series/{k}", strips, series.colour, 0.005)
            return
        self.points(f"series/{k}", points[known], series.colour)
        error = np.nan_to_num(series.error)
        lower = frame.placed(series.x, series.y - error)[known]
        upper = frame.placed(series.x, series.y + error)[known]
        self.lines(f"bars/{k}", list(np.stack((lower, upper), axis=1)), series.colour, 0.002)


def _log_panel(recording: rr.RecordingStream, entity: str, panel: Panel) -> rrb.Spatial2DView:
    """Write a panel in a frame 1.6 wide and 1 high, with the values at the ends of its axes."""
    x = np.concatenate([series.x for series in panel.series])
    y = np.concatenate([series.y for series in panel.series])
    frame = _Frame(np.nanmin(x), np.nanmax(x), min(np.nanmin(y), 0.0), max(np.nanmax(y), 0.0))

    writer = _PanelWriter(recording, entity)
    for k, series in enumerate(panel.series):
        writer.series(k, series, frame)
    zero = frame.placed(np.array([frame.left, frame.right]), np.zeros(2))
    writer.lines("zero", [zero], GREY, 0.002)
    writer.words(
        "axes",
        [[0.0, 1.1], [_PANEL_WIDTH, 1.1], [0.8, 1.2], [-0.2, 1.0], [-0.2, 0.0], [0.0, -0.1]],
        [
            f"{frame.left:.3g}",
            f"{frame.right:.3g}",
            panel.x_label,
            f"{frame.low:.2g}",
            f"{frame.high:.2g}",
            panel.y_label,
        ],
        GREY,
    )
    return rrb.Spatial2DView(
        origin=f"/{entity}",
        name=panel.title,
        visual_bounds=rrb.VisualBounds2D(x_range=(-0.4, 1.9), y_range=(-0.4, 1.3)),
    )


def creep_points(path: Path, data: Dataset) -> None:
    """Write the points of a measured creep curve, both axes in percent."""
    assert data.curve is not None
    points = np.column_stack([100.0 * data.curve.creepage, -100.0 * data.curve.adhesion])
    with _recording(path, f"explain {data.name}") as recording:
        recording.log("creep_curve/measured", rr.Points2D(points), static=True)


def recorded(
    path: Path,
    name: str,
    courses: Mapping[str, tuple[np.ndarray, Mapping[str, np.ndarray]]],
    remarks: Sequence[tuple[str, float, str]],
) -> None:
    """Write a train recording: a tab for each run, with speeds, sliding and what was found.

    `courses`: /run/speed and /run/sliding -> (time s, values (n,) by name). `remarks`: run, time s,
    sentence; the run is "" where a remark holds for all.
    """
    with _recording(path, f"explain {name}") as recording:
        for entity, (time_s, values) in courses.items():
            shades = [colours.AXLES[k % len(colours.AXLES)] for k in range(len(values))]
            columns = np.column_stack(list(values.values()))
            _log_scalars(recording, entity, time_s, columns, shades, list(values))
        for run, at_s, text in remarks:
            recording.set_time("t", duration=at_s)
            recording.log(f"/{run}/findings" if run else "/findings", rr.TextLog(text))

        tabs = []
        for run in _by_run(courses):
            tabs.append(
                rrb.Vertical(
                    rrb.TimeSeriesView(origin=f"/{run}/speed", name="speed, m/s"),
                    rrb.TimeSeriesView(origin=f"/{run}/sliding", name="below the vehicle, m/s"),
                    rrb.TextLogView(origin=f"/{run}/findings", name="found"),
                    name=run,
                )
            )
        _send_views(recording, rrb.Tabs(*tabs))
