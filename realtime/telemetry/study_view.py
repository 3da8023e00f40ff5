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

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.colours import BLUE, GREY, Colour
from rollerrig.realtime.pictures.panel import Panel
from rollerrig.realtime.telemetry.views import APPLICATION, times
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper.tuning import Tuned
from rollerrig.rig.identify.paper.validation import Verdict

_MODELS = {"measured": colours.MEASURED, "new": colours.EXTENDED, "classic": colours.BASE}


@contextmanager
def _recording(path: Path, name: str) -> Iterator[rr.RecordingStream]:
    with rr.RecordingStream(APPLICATION, recording_id=name) as recording:
        recording.save(path)
        yield recording


def _scalars(
    recording: rr.RecordingStream,
    path: str,
    time_s: np.ndarray,
    values: np.ndarray,
    shades: Sequence[Colour],
    names: Sequence[str],
) -> None:
    """Values (n,) or (n, names) as one entity."""
    recording.log(path, rr.SeriesLines(colors=shades, names=names), static=True)
    recording.send_columns(path, [times(time_s)], rr.Scalars.columns(scalars=values))


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
                ("adhesion/{}/model", found.model, BLUE),
                ("adhesion/{}/degraded", found.degraded, GREY),
            ):
                _scalars(
                    recording,
                    entity.format(run.name),
                    s.time_s[own],
                    values[own],
                    [shade],
                    [entity.rpartition("/")[2]],
                )
        # one unit of lambda as high as 100 J/m is wide
        plane = np.column_stack([s.energy_J_m / 100.0, -found.transition])
        recording.log("plane/measured", rr.Points2D(plane, radii=0.01, colors=[GREY]), static=True)
        grid = np.linspace(0.0, float(np.percentile(s.energy_J_m, 99.5)), 200)
        line = np.column_stack([grid / 100.0, np.expm1(-found.tau_m_J.value * grid)])
        recording.log("plane/tuned", rr.LineStrips2D([line], colors=[BLUE]), static=True)
        recording.send_blueprint(
            rrb.Blueprint(
                rrb.Horizontal(
                    rrb.Vertical(
                        rrb.TimeSeriesView(origin="/transition", name="transition, wheelset 1"),
                        rrb.TimeSeriesView(origin="/adhesion", name="adhesion, wheelset 1"),
                    ),
                    rrb.Spatial2DView(origin="/plane", name="transition against W_sp / (100 J/m)"),
                ),
                collapse_panels=True,
            )
        )


def validated(path: Path, data: Dataset, verdicts: list[Verdict]) -> None:
    """Write vehicle speed and sliding of wheelset 1: measured, with and without recovery."""
    with _recording(path, f"validate {data.name}") as recording:
        for v in verdicts:
            for name, shade in _MODELS.items():
                _scalars(
                    recording, f"speed/{v.run}/{name}", v.time_s, v.speed_m_s[name], [shade], [name]
                )
                _scalars(
                    recording,
                    f"sliding/{v.run}/{name}",
                    v.time_s,
                    v.sliding_m_s[name][:, 0],
                    [shade],
                    [name],
                )
        recording.send_blueprint(
            rrb.Blueprint(
                rrb.Tabs(
                    *(
                        rrb.Vertical(
                            rrb.TimeSeriesView(origin=f"/speed/{v.run}", name="vehicle speed, m/s"),
                            rrb.TimeSeriesView(
                                origin=f"/sliding/{v.run}", name="sliding of wheelset 1, m/s"
                            ),
                            name=v.run,
                        )
                        for v in verdicts
                    )
                ),
                collapse_panels=True,
            )
        )


def explained(
    path: Path,
    name: str,
    words: str,
    where: Sequence[Panel],
    causes: Sequence[Panel],
    courses: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> None:
    """Write an explanation: its words (Markdown), where it shows, the causes, and the adhesion of every wheelset.

    `courses`: /run/adhesion_axle -> (time s, measured, base and extended values (n, 3)).
    """
    with _recording(path, f"explain {name}") as recording:
        recording.log(
            "words", rr.TextDocument(words, media_type=rr.MediaType.MARKDOWN), static=True
        )
        shown = [
            [_panel(recording, f"{kind}/{k}", panel) for k, panel in enumerate(panels, start=1)]
            for kind, panels in (("where", where), ("cause", causes))
        ]
        for entity, (time_s, values) in courses.items():
            _scalars(
                recording,
                f"courses{entity}",
                time_s,
                values,
                (colours.MEASURED, colours.BASE, colours.EXTENDED),
                ("measured", "base", "extended"),
            )
        runs = dict.fromkeys(entity.split("/")[1] for entity in courses)
        recording.send_blueprint(
            rrb.Blueprint(
                rrb.Tabs(
                    rrb.Horizontal(
                        rrb.TextDocumentView(origin="/words", name="verdict"),
                        *shown[1],
                        name="verdict",
                    ),
                    rrb.Horizontal(*shown[0], name="where it shows"),
                    *(
                        rrb.Vertical(
                            *(
                                rrb.TimeSeriesView(
                                    origin=f"/courses{entity}", name=entity.rpartition("/")[2]
                                )
                                for entity in courses
                                if entity.split("/")[1] == run
                            ),
                            name=run,
                        )
                        for run in runs
                    ),
                ),
                collapse_panels=True,
            )
        )


def _panel(recording: rr.RecordingStream, entity: str, panel: Panel) -> rrb.Spatial2DView:
    """A panel in a frame 1.6 wide and 1 high, with the values at the ends of its axes."""
    at, mean = (np.concatenate([getattr(s, of) for s in panel.series]) for of in ("at", "mean"))
    left, right, low, high = at.min(), at.max(), min(mean.min(), 0.0), max(mean.max(), 0.0)

    def placed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.column_stack(
            [1.6 * (x - left) / max(right - left, 1e-12), (high - y) / max(high - low, 1e-12)]
        )

    def words(name: str, where: list[list[float]], labels: list[str], colour: Colour) -> None:
        recording.log(
            f"{entity}/{name}",
            rr.Points2D(where, radii=1e-4, colors=[colour], labels=labels, show_labels=True),
            static=True,
        )

    def lines(name: str, strips: Sequence[np.ndarray], colour: Colour, radius: float) -> None:
        recording.log(
            f"{entity}/{name}", rr.LineStrips2D(strips, colors=[colour], radii=radius), static=True
        )

    for k, s in enumerate(panel.series):
        words(f"names/{k}", [[0.8, -0.32 + 0.06 * k]], [s.label], s.colour)
        if s.bar is None:
            lines(f"series/{k}", [placed(s.at, s.mean)], s.colour, 0.005)
            continue
        recording.log(
            f"{entity}/series/{k}",
            rr.Points2D(placed(s.at, s.mean), radii=0.012, colors=[s.colour]),
            static=True,
        )
        bar = np.nan_to_num(s.bar)
        ends = placed(s.at, s.mean - bar), placed(s.at, s.mean + bar)
        lines(f"bars/{k}", list(np.stack(ends, axis=1)), s.colour, 0.002)
    lines("zero", [placed(np.array([left, right]), np.zeros(2))], GREY, 0.002)
    words(
        "axes",
        [[0.0, 1.1], [1.6, 1.1], [0.8, 1.2], [-0.2, 1.0], [-0.2, 0.0], [0.0, -0.1]],
        [f"{left:.3g}", f"{right:.3g}", panel.along, f"{low:.2g}", f"{high:.2g}", panel.upwards],
        GREY,
    )
    return rrb.Spatial2DView(
        origin=f"/{entity}",
        name=panel.title,
        visual_bounds=rrb.VisualBounds2D(x_range=(-0.4, 1.9), y_range=(-0.4, 1.3)),
    )


def creep_points(path: Path, data: Dataset) -> None:
    """The points of a measured creep curve, both axes in percent."""
    assert data.curve is not None
    points = np.column_stack([100.0 * data.curve.creepage, -100.0 * data.curve.adhesion])
    with _recording(path, f"explain {data.name}") as recording:
        recording.log("creep_curve/measured", rr.Points2D(points), static=True)


def recorded(
    path: Path,
    name: str,
    courses: Mapping[str, tuple[np.ndarray, Mapping[str, np.ndarray]]],
    said: Sequence[tuple[str, float, str]],
) -> None:
    """Courses of a recorder, path -> (time s, values (n,) by name), and what is said of them: run, time s, sentence.

    A tab for each run, with speeds over sliding.
    """
    with _recording(path, f"explain {name}") as recording:
        for entity, (time_s, values) in courses.items():
            shades = [colours.AXLES[k % len(colours.AXLES)] for k in range(len(values))]
            _scalars(
                recording,
                entity,
                time_s,
                np.column_stack(list(values.values())),
                shades,
                list(values),
            )
        for run, at_s, text in said:
            recording.set_time("t", duration=at_s)
            recording.log(f"/{run}/findings" if run else "/findings", rr.TextLog(text))
        runs = list(dict.fromkeys(entity.split("/")[1] for entity in courses))
        recording.send_blueprint(
            rrb.Blueprint(
                rrb.Tabs(
                    *(
                        rrb.Vertical(
                            rrb.TimeSeriesView(origin=f"/{run}/speed", name="speed, m/s"),
                            rrb.TimeSeriesView(
                                origin=f"/{run}/sliding", name="below the vehicle, m/s"
                            ),
                            rrb.TextLogView(origin=f"/{run}/findings", name="found"),
                            name=run,
                        )
                        for run in runs
                    )
                ),
                collapse_panels=True,
            )
        )
