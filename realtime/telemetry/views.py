"""What a run looks like in Rerun: its entities, their colours, and how they are laid out.

All of it derives from the table of signals: a signal's path is its group and its name, its axles
are the series of one entity, and the groups are the plots. One colour means one axle in every
view (Okabe and Ito's palette, safe for the colour-blind). Source of the layout: the screens that
WSP engineers use in service, where one glance must show which axle slides and what its valve does.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint import encodings

from rollerrig.realtime.telemetry import colours
from rollerrig.realtime.telemetry.colours import Colour
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import SIGNALS, Signal

APPLICATION = "rollerrig"
TIMELINE = "t"
EVENTS = "/events"
RIG = "/rig"
VALVES = "/valves"
MORE = "/more"
REFERENCES = "/ref"

LEVELS = {"info": ("INFO", (170, 190, 210)), "warning": ("WARN", colours.YELLOW),
          "error": ("ERROR", colours.VERMILION)}

# groups whose axles are drawn each in a plot of its own: one entity a column
_BY_AXLE = ("adhesion",)
# how a signal differs from "all axles in their colours, 1.5 points wide"
_WIDTHS = {"adhesion": 2.5, "adhesion_degraded": 1.0, "adhesion_recovered": 1.0,
           "vehicle_speed": 2.5, "motor_torque_demand": 0.8}
_COLOURS = {"adhesion_degraded": colours.LIMIT, "adhesion_recovered": colours.LIMIT,
            "wsp_reference_speed": colours.REFERENCE, "brake_demand": colours.REFERENCE}
_LEGEND = {"adhesion_degraded": "f_d degraded", "adhesion_recovered": "f_r recovered",
           "adhesion": "f utilised", "wsp_reference_speed": "WSP reference"}
# groups with a place of their own, and those behind tabs; a new group gets a tab by itself
_COLUMNS = ("speeds", "sliding", "valves", "pressures", "adhesion", "transition")
_TABS = {"energy": "Dissipated energy W_sp (J/m)", "motors": "Roller motors (Nm)",
         "tracking": "Tracking error (m/s)", "torques": "Brake torques (Nm)", "loads": "Loads (N)",
         "acceleration": "Acceleration (m/s²)", "air": "Air used (NL)", "loop": "Loop (µs)"}
_SEVERAL = ("loop",)
_WINDOW_S = 20.0


class Lines(NamedTuple):
    """One entity of scalars: its path, the columns of a row it shows, and how each is drawn."""

    path: str
    columns: tuple[int, ...]
    names: tuple[str, ...]
    colours: tuple[Colour, ...]
    width: float


def lines() -> tuple[Lines, ...]:
    """Every recorded signal as an entity of scalars, but the valves, which are states.

    Signals without a group come under /more: recorded, and in no plot until somebody drags them in.
    """
    found: list[Lines] = []
    for signal in SIGNALS:
        if signal.name in ("time", "valve"):
            continue
        folder = f"/{signal.group}" if signal.group else MORE
        axles = range(1, signal.axles + 1)
        if signal.group in _BY_AXLE:
            found += [_lines(f"{folder}/{signal.name}_{axle}", signal, [axle]) for axle in axles]
        else:
            found.append(_lines(f"{folder}/{signal.name}", signal, list(axles)))
    return tuple(found)


def _lines(path: str, signal: Signal, axles: list[int]) -> Lines:
    return Lines(path, tuple(signals.column(signal.name, axle) for axle in axles),
                 tuple(_legend(signal, axle) for axle in axles),
                 tuple(_colour(signal, axle) for axle in axles), _WIDTHS.get(signal.name, 1.5))


def _legend(signal: Signal, axle: int) -> str:
    label = _LEGEND.get(signal.name, signal.name.replace("_", " "))
    if signal.axles == 1 or signal.group in _BY_AXLE:
        return label
    alone = sum(s.group == signal.group and s.axles > 1 for s in SIGNALS) == 1
    return f"axle {axle}" if alone else f"{label} {axle}"


def _colour(signal: Signal, axle: int) -> Colour:
    default = colours.VEHICLE if signal.axles == 1 else colours.AXLES[axle - 1]
    return _COLOURS.get(signal.name, default)


def valve_states(rows: np.ndarray, axle: int) -> np.ndarray:
    """Positions in colours.VALVE_STATES of an axle's dump valve in rows of all signals; int64 (n,)."""
    valve = np.nan_to_num(rows[:, signals.column("valve", axle)])
    return np.clip(valve, 0, len(colours.VALVE_STATES) - 1).astype(np.int64)


def style(stream: rr.RecordingStream, prefix: str = "", faint: bool = False) -> None:
    """Log the static styling of all entities under `prefix`; `faint` is for a run laid beneath."""
    run = prefix.rpartition("/")[2]
    for one in lines():
        stream.log(prefix + one.path, rr.SeriesLines(
            colors=[_faint(colour) if faint else colour for colour in one.colours],
            names=[f"{run}: {name}" if run else name for name in one.names],
            widths=[one.width * (0.6 if faint else 1.0)] * len(one.names),
            aggregation_policy=rr.components.AggregationPolicy.MinMax), static=True)
    names, shades = [name for name, _ in colours.VALVE_STATES], [shade for _, shade in colours.VALVE_STATES]
    for axle in range(1, signals.AXLES + 1):
        stream.log(f"{prefix}{VALVES}/valve_{axle}", rr.StateConfiguration(
            values=names, labels=names, colors=shades), static=True)


def _faint(colour: Colour) -> Colour:
    red, green, blue = (round(0.55 * part) for part in colour)
    return red, green, blue


def tops(rows: np.ndarray) -> tuple[float, float]:
    """Upper ends of the axes of adhesion and transition, for rows of all signals (n, columns).

    The plots of adhesion hold what was used, and both limits while a wheel slides; where nothing
    slides f_r is far above all that is used, and may leave the plot.
    """
    used, upper, sliding, transition = (
        np.nan_to_num(rows[:, signals.span(name)])
        for name in ("adhesion", "adhesion_recovered", "sliding", "transition"))
    slid = upper[sliding > 1.0]
    limit = float(np.median(slid)) if slid.size else 0.0
    return (max(0.1, 1.15 * limit, 1.4 * float(used.max(initial=0.0))),
            min(1.0, max(0.2, 1.1 * float(transition.max(initial=0.0)))))


def blueprint(live: bool = False, bare: bool = False, eye: rrb.EyeControls3D | None = None,
              references: Sequence[str] = (), top: tuple[float, float] = (0.4, 1.0)
              ) -> rrb.Blueprint:
    """The layout: plots on one linked time axis, the adhesion of each axle, the rig, the events.

    `live` follows the newest sample in a window of 20 s; a recorded run is shown whole. `bare`
    leaves out the viewer's own bars, for pictures. `references` names runs laid beneath, `top`
    comes from `tops` where the run is known.
    """
    axis = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    window = None
    if live:
        axis = rrb.TimeAxis(link=rrb.components.LinkAxis.Independent)
        window = rrb.VisibleTimeRange(
            TIMELINE, start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_WINDOW_S),
            end=rrb.TimeRangeBoundary.cursor_relative())
    page = _Page(axis, window, ("", *(f"{REFERENCES}/{name}" for name in references)), top)
    panels: Literal["hidden", "collapsed"] = "hidden" if bare else "collapsed"
    return rrb.Blueprint(
        rrb.Horizontal(_stop(page), _contact(page), _rig(page, eye), column_shares=[4, 4, 3.2]),
        rrb.TopPanel(state="hidden" if bare else "expanded"),
        rrb.TimePanel(state=panels, timeline=TIMELINE,
                      play_state="following" if live else "paused"),
        rrb.SelectionPanel(state=panels), rrb.BlueprintPanel(state=panels),
        auto_views=False, auto_layout=False)


class _Page(NamedTuple):
    """What all views share: time axis, time window (None: all), paths of the runs, axis ends."""

    axis: rrb.TimeAxis
    window: rrb.VisibleTimeRange | None
    runs: tuple[str, ...]
    top: tuple[float, float]

    def contents(self, *paths: str) -> list[str]:
        return [run + path for run in self.runs for path in paths]


def _plot(page: _Page, name: str, group: str, legend: bool = False, contents: Sequence[str] = (),
          span: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
    """A plot of a group; a legend only where the axles' colours do not say enough."""
    return rrb.TimeSeriesView(
        name=name, origin="/", contents=page.contents(*(contents or [f"/{group}/**"])),
        axis_x=page.axis, axis_y=rrb.ScalarAxis(range=span) if span else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend), time_ranges=page.window)


def _stop(page: _Page) -> rrb.Vertical:
    # of this run only: lanes cannot be laid over one another
    valves = rrb.StateTimelineView(name="Dump valves", origin=VALVES, time_view=page.axis,
                                   time_ranges=page.window)
    return rrb.Vertical(
        _plot(page, "Speeds: vehicle, wheels, WSP reference (m/s)", "speeds", legend=True),
        _plot(page, "Sliding (m/s)", "sliding"), valves,
        _plot(page, "Brake cylinder pressures, demand in yellow (Pa)", "pressures"),
        row_shares=[3, 2, 2.05, 2])


def _contact(page: _Page) -> rrb.Vertical:
    names = ("adhesion_degraded", "adhesion_recovered", "adhesion")
    axles = [_plot(page, f"Axle {axle}: adhesion f between f_d and f_r", "adhesion",
                   contents=[f"/adhesion/{name}_{axle}" for name in names],
                   span=(0.0, page.top[0]))
             for axle in range(1, signals.AXLES + 1)]
    return rrb.Vertical(*axles, _plot(page, "Transition λ: 0 degraded, 1 recovered", "transition",
                                      span=(0.0, page.top[1])))


def _rig(page: _Page, eye: rrb.EyeControls3D | None) -> rrb.Vertical:
    columns = rrb.TextLogColumns(
        timeline_columns=[encodings.TimelineColumn(TIMELINE)],
        text_log_columns=[encodings.TextLogColumn(kind) for kind in (
            encodings.TextLogColumnKind.LogLevel, encodings.TextLogColumnKind.Body)])
    groups = [*_TABS, *sorted({s.group for s in SIGNALS if s.group} - {*_TABS, *_COLUMNS})]
    more = rrb.Tabs(*(_plot(page, _TABS.get(group, group.capitalize()), group,
                            legend=group in _SEVERAL) for group in groups))
    return rrb.Vertical(
        rrb.Spatial3DView(name="Rig, 20 times slower; red spokes: locked", origin=RIG,
                          eye_controls=eye, background=(24, 27, 31), line_grid=False),
        more, rrb.TextLogView(name="Events", origin="/", contents=page.contents(EVENTS),
                              columns=columns),
        row_shares=[2.6, 2.4, 2])
