"""What tune and validate found, as a Rerun recording beside their HTML.

One entity a quantity, the time of each run as the timeline "t" (runs stand side by side under their
names); scatter plots of the transition are points in the plane.
"""

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rollerrig.realtime.telemetry.views import APPLICATION, TIMELINE
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper.tuning import Tuned
from rollerrig.rig.identify.paper.validation import Verdict

_GREY, _BLUE, _RED = (150, 150, 150), (86, 180, 233), (213, 94, 0)
_COLOURS = {"measured": (235, 235, 235), "new": _BLUE, "classic": _RED}


def _scalars(recording: rr.RecordingStream, path: str, time_s: np.ndarray, values: np.ndarray,
             colour: tuple[int, int, int], name: str) -> None:
    recording.log(path, rr.SeriesLines(colors=[colour], names=[name]), static=True)
    recording.send_columns(path, indexes=[rr.TimeColumn(TIMELINE, duration=time_s)],
                           columns=rr.Scalars.columns(scalars=values))


def tuned(path: Path, data: Dataset, found: Tuned) -> None:
    """Write the courses of transition and adhesion of wheelset 1 in each tuning run, and the plane."""
    recording = rr.RecordingStream(APPLICATION, recording_id=f"tune {data.name}")
    recording.save(path)
    s = found.samples
    spread = np.maximum(found.recovered - found.degraded, 1e-9)
    for i, run in enumerate(data.group("tune")):
        own = (s.run == i) & (s.axle == 0)
        for name, values, colour in (
            ("measured", found.transition, _COLOURS["measured"]),
            ("model", (found.model - found.degraded) / spread, _BLUE),
        ):
            _scalars(recording, f"/transition/{run.name}/{name}", s.time_s[own], values[own], colour, name)
        for name, values, colour in (("measured", s.adhesion, _COLOURS["measured"]),
                                     ("model", found.model, _BLUE), ("degraded", found.degraded, _GREY)):
            _scalars(recording, f"/adhesion/{run.name}/{name}", s.time_s[own], values[own], colour, name)
    # one unit of lambda as high as 100 J/m is wide
    plane = np.column_stack([found.energy_J_m / 100.0, -found.transition])
    recording.log("/plane/measured", rr.Points2D(plane, radii=0.01, colors=[_GREY]), static=True)
    grid = np.linspace(0.0, float(np.percentile(found.energy_J_m, 99.5)), 200)
    line = np.column_stack([grid / 100.0, np.expm1(-found.tau_m_J.value * grid)])
    recording.log("/plane/tuned", rr.LineStrips2D([line], colors=[_BLUE]), static=True)
    recording.send_blueprint(rrb.Blueprint(rrb.Horizontal(
        rrb.Vertical(rrb.TimeSeriesView(origin="/transition", name="transition, wheelset 1"),
                     rrb.TimeSeriesView(origin="/adhesion", name="adhesion, wheelset 1")),
        rrb.Spatial2DView(origin="/plane", name="transition against W_sp / (100 J/m)")),
        collapse_panels=True))
    recording.disconnect()


def validated(path: Path, data: Dataset, verdicts: list[Verdict]) -> None:
    """Write vehicle speed and sliding of wheelset 1: measured, with and without recovery."""
    recording = rr.RecordingStream(APPLICATION, recording_id=f"validate {data.name}")
    recording.save(path)
    for v in verdicts:
        for name, colour in _COLOURS.items():
            _scalars(recording, f"/speed/{v.run}/{name}", v.time_s, v.speed_m_s[name], colour, name)
            _scalars(recording, f"/sliding/{v.run}/{name}", v.time_s, v.sliding_m_s[name][:, 0], colour,
                     name)
    recording.send_blueprint(rrb.Blueprint(rrb.Tabs(*(
        rrb.Vertical(rrb.TimeSeriesView(origin=f"/speed/{v.run}", name="vehicle speed, m/s"),
                     rrb.TimeSeriesView(origin=f"/sliding/{v.run}", name="sliding of wheelset 1, m/s"),
                     name=v.run) for v in verdicts)), collapse_panels=True))
    recording.disconnect()


def explained(path: Path, courses: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Measured, base and extended adhesion of every wheelset: path -> (time s, values (n, 3))."""
    with rr.RecordingStream("rollerrig_explain") as recording:
        recording.save(path)
        for entity, (time_s, values) in courses.items():
            recording.log(entity, rr.SeriesLines(
                names=["measured", "base", "extended"],
                colors=[[34, 34, 34], [213, 94, 0], [0, 114, 178]]), static=True)
            stamps = (time_s * 1e9).astype("int64").astype("timedelta64[ns]")
            recording.send_columns(entity, [rr.TimeColumn("time", duration=stamps)],
                                   rr.Scalars.columns(scalars=values))


def creep_points(path: Path, data: Dataset) -> None:
    """The points of a measured creep curve, both axes in percent."""
    assert data.curve is not None
    with rr.RecordingStream("rollerrig_explain") as recording:
        recording.save(path)
        points = np.column_stack([100.0 * data.curve.creepage, -100.0 * data.curve.adhesion])
        recording.log("/creep_curve/measured", rr.Points2D(points), static=True)
