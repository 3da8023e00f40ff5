"""What tune, validate and explain found, as a Rerun recording beside their HTML.

One entity a quantity, the time of each run as the timeline "t" (runs stand side by side under their
names); scatter plots are points in the plane.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rollerrig.realtime.telemetry import colours
from rollerrig.realtime.telemetry.colours import BLUE, GREY, Colour
from rollerrig.realtime.telemetry.views import APPLICATION, TIMELINE
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper.tuning import Tuned
from rollerrig.rig.identify.paper.validation import Verdict

_MODELS = {"measured": colours.MEASURED, "new": colours.EXTENDED, "classic": colours.BASE}


@contextmanager
def _recording(path: Path, name: str) -> Iterator[rr.RecordingStream]:
    with rr.RecordingStream(APPLICATION, recording_id=name) as recording:
        recording.save(path)
        yield recording


def _scalars(recording: rr.RecordingStream, path: str, time_s: np.ndarray, values: np.ndarray,
             shades: Sequence[Colour], names: Sequence[str]) -> None:
    """Values (n,) or (n, names) as one entity."""
    recording.log(path, rr.SeriesLines(colors=shades, names=names), static=True)
    times = rr.TimeColumn(TIMELINE, duration=np.rint(time_s * 1e9).astype("timedelta64[ns]"))
    recording.send_columns(path, [times], rr.Scalars.columns(scalars=values))


def tuned(path: Path, data: Dataset, found: Tuned) -> None:
    """Write the courses of transition and adhesion of wheelset 1 in each tuning run, and the plane."""
    s = found.samples
    spread = np.maximum(found.recovered - found.degraded, 1e-9)
    with _recording(path, f"tune {data.name}") as recording:
        for i, run in enumerate(data.group("tune")):
            own = (s.run == i) & (s.axle == 0)
            for entity, values, shade in (
                ("transition/{}/measured", found.transition, colours.MEASURED),
                ("transition/{}/model", (found.model - found.degraded) / spread, BLUE),
                ("adhesion/{}/measured", s.adhesion, colours.MEASURED),
                ("adhesion/{}/model", found.model, BLUE), ("adhesion/{}/degraded", found.degraded, GREY),
            ):
                _scalars(recording, entity.format(run.name), s.time_s[own], values[own], [shade],
                         [entity.rpartition("/")[2]])
        # one unit of lambda as high as 100 J/m is wide
        plane = np.column_stack([found.energy_J_m / 100.0, -found.transition])
        recording.log("plane/measured", rr.Points2D(plane, radii=0.01, colors=[GREY]), static=True)
        grid = np.linspace(0.0, float(np.percentile(found.energy_J_m, 99.5)), 200)
        line = np.column_stack([grid / 100.0, np.expm1(-found.tau_m_J.value * grid)])
        recording.log("plane/tuned", rr.LineStrips2D([line], colors=[BLUE]), static=True)
        recording.send_blueprint(rrb.Blueprint(rrb.Horizontal(
            rrb.Vertical(rrb.TimeSeriesView(origin="/transition", name="transition, wheelset 1"),
                         rrb.TimeSeriesView(origin="/adhesion", name="adhesion, wheelset 1")),
            rrb.Spatial2DView(origin="/plane", name="transition against W_sp / (100 J/m)")),
            collapse_panels=True))


def validated(path: Path, data: Dataset, verdicts: list[Verdict]) -> None:
    """Write vehicle speed and sliding of wheelset 1: measured, with and without recovery."""
    with _recording(path, f"validate {data.name}") as recording:
        for v in verdicts:
            for name, shade in _MODELS.items():
                _scalars(recording, f"speed/{v.run}/{name}", v.time_s, v.speed_m_s[name], [shade], [name])
                _scalars(recording, f"sliding/{v.run}/{name}", v.time_s, v.sliding_m_s[name][:, 0], [shade],
                         [name])
        recording.send_blueprint(rrb.Blueprint(rrb.Tabs(*(
            rrb.Vertical(rrb.TimeSeriesView(origin=f"/speed/{v.run}", name="vehicle speed, m/s"),
                         rrb.TimeSeriesView(origin=f"/sliding/{v.run}", name="sliding of wheelset 1, m/s"),
                         name=v.run) for v in verdicts)), collapse_panels=True))


def explained(path: Path, name: str, courses: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Measured, base and extended adhesion of every wheelset: path -> (time s, values (n, 3))."""
    with _recording(path, f"explain {name}") as recording:
        for entity, (time_s, values) in courses.items():
            _scalars(recording, entity, time_s, values, (colours.MEASURED, colours.BASE, colours.EXTENDED),
                     ("measured", "base", "extended"))


def creep_points(path: Path, data: Dataset) -> None:
    """The points of a measured creep curve, both axes in percent."""
    assert data.curve is not None
    points = np.column_stack([100.0 * data.curve.creepage, -100.0 * data.curve.adhesion])
    with _recording(path, f"explain {data.name}") as recording:
        recording.log("creep_curve/measured", rr.Points2D(points), static=True)
