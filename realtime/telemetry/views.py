"""What a run looks like in Rerun: its entities, their colours, and how they are laid out.

All of it derives from the table of signals: a signal's path is its group and its name, its axles
are the series of one entity, and the groups are the plots. One colour means one axle in every
view (Okabe and Ito's palette, safe for the colour-blind). Source of the layout: the screens that
WSP engineers use in service, where one glance must show which axle slides and what its valve does.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint import encodings

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.colours import Colour
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import SIGNALS, Signal

APPLICATION = "rollerrig"
TIMELINE = "t"
EVENTS, NETWORK = "/events", "/network"
BOX = "/result"
RIG = "/rig"
VALVES = "/valves"
MORE = "/more"
REFERENCES = "/ref"

LEVELS = {
    "info": ("INFO", (96, 132, 168)),
    "warning": ("WARN", colours.YELLOW),
    "error": ("ERROR", colours.VERMILION),
}

# groups whose axles are entities of their own, each with a plot beside the one of all axles
_BY_AXLE = ("adhesion", "speeds", "pressures")
# the unit in which a group is drawn, and the factor from the recorded one
READ_IN = {
    "speeds": ("km/h", 3.6),
    "pressures": ("bar", 1e-5),
    "acceleration": ("m/s², braking positive", -1.0),
}
# how a signal differs from "all axles in their colours, 1.5 points wide"
_WIDTHS = {
    "adhesion": 2.5,
    "adhesion_degraded": 1.0,
    "adhesion_recovered": 1.0,
    "vehicle_speed": 2.5,
    "wsp_reference_speed": 1.0,
    "motor_torque_demand": 0.8,
}
_COLOURS = {
    "adhesion_degraded": colours.LIMIT,
    "adhesion_recovered": colours.LIMIT,
    "wsp_reference_speed": colours.REFERENCE,
    "brake_demand": colours.REFERENCE,
}
_LEGEND = {
    "adhesion_degraded": "f_d degraded",
    "adhesion_recovered": "f_r recovered",
    "vehicle_acceleration": "achieved",
    "adhesion": "f utilised",
    "wsp_reference_speed": "WSP reference",
    "vehicle_speed": "vehicle",
    "brake_demand": "demand",
    "reservoir_pressure": "reservoir",
}
# groups with a place of their own, and those behind tabs; a new group gets a tab by itself
_COLUMNS = ("speeds", "sliding", "valves", "pressures", "adhesion", "transition", "acceleration")
_TABS = {
    "energy": "Dissipated energy W_sp (J/m)",
    "motors": "Roller motors (Nm)",
    "tracking": "Tracking error (m/s)",
    "torques": "Brake torques (Nm)",
    "loads": "Loads (N)",
    "air": "Air used (NL)",
    "flats": "Wheel flats (m)",
    "sand": "Sand strewn (kg/s)",
    "sand_dose": "Sand under the wheels (kg/m)",
    "friction": "Friction mu_cd",
    "film": "Contaminant on the rollers (1: as prepared)",
    "loop": "Loop (µs)",
}
_SEVERAL = ("loop",)
_WINDOW_S = 20.0
_ENOUGH = 100_000


class Lines(NamedTuple):
    """One entity of scalars: its path, the columns of a row it shows times a factor, and how each is drawn."""

    path: str
    columns: tuple[int, ...]
    names: tuple[str, ...]
    colours: tuple[Colour, ...]
    width: float
    factor: float = 1.0


def lines() -> tuple[Lines, ...]:
    """Every recorded signal but the valves as an entity of scalars; without a group under /more, in no plot."""
    found: list[Lines] = []
    for signal in SIGNALS:
        if signal.name in ("time", "valve"):
            continue
        folder = f"/{signal.group}" if signal.group else MORE
        axles = range(1, signal.axles + 1)
        if signal.group in _BY_AXLE and signal.axles > 1:
            found += [_lines(f"{folder}/{signal.name}_{axle}", signal, [axle]) for axle in axles]
        else:
            found.append(_lines(f"{folder}/{signal.name}", signal, list(axles)))
    return tuple(found)


def _lines(path: str, signal: Signal, axles: list[int]) -> Lines:
    shades = (colours.VEHICLE,) if signal.axles == 1 else colours.AXLES
    return Lines(
        path,
        tuple(signals.column(signal.name, axle) for axle in axles),
        tuple(_legend(signal, axle) for axle in axles),
        tuple(_COLOURS.get(signal.name, shades[axle - 1]) for axle in axles),
        _WIDTHS.get(signal.name, 1.5),
        READ_IN.get(signal.group, ("", 1.0))[1],
    )


def _legend(signal: Signal, axle: int) -> str:
    label = _LEGEND.get(signal.name, signal.name.replace("_", " "))
    alone = sum(s.group == signal.group and s.axles > 1 for s in SIGNALS) == 1
    if signal.axles == 1 or (signal.group in _BY_AXLE and not alone):
        return label
    return f"axle {axle}" if alone else f"{label} {axle}"


def valve(axle: int, prefix: str = "") -> str:
    """Where the lane of an axle's dump valve is drawn; its last part is its name in the view."""
    return f"{prefix}{VALVES}/axle_{axle}"


def valve_states(rows: np.ndarray, axle: int) -> np.ndarray:
    """Positions in colours.VALVE_STATES of an axle's dump valve in rows of all signals; int64 (n,)."""
    valve = np.nan_to_num(rows[:, signals.column("valve", axle)])
    return np.clip(valve, 0, len(colours.VALVE_STATES) - 1).astype(np.int64)


def times(time_s: np.ndarray) -> rr.TimeColumn:
    """Instants of the timeline, from simulated time in s, shape (n,)."""
    return rr.TimeColumn(TIMELINE, duration=np.rint(time_s * 1e9).astype("timedelta64[ns]"))


class Changes:
    """Sends states only where they change, and remembers the last one of each path."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._last: dict[str, int] = {}

    def send(
        self, path: str, time_s: np.ndarray, state: np.ndarray, content: Callable[[np.ndarray], Any]
    ) -> None:
        """States (n,) at their times (n,) in s; `content` makes columns of those that are sent."""
        change = np.flatnonzero(np.diff(state, prepend=self._last.get(path, -1)) != 0)
        self._last[path] = state[-1]
        if change.size:
            self._stream.send_columns(path, [times(time_s[change])], content(state[change]))


def style(
    stream: rr.RecordingStream, prefix: str = "", faint: bool = False, more: Sequence[Any] = ()
) -> None:
    """Log the static styling of all entities, and of `more` curves, under `prefix`; `faint`: for a run laid beneath."""
    run = prefix.rpartition("/")[2]
    for one in (*lines(), *more):
        stream.log(
            prefix + one.path,
            rr.SeriesLines(
                colors=[[*colour[:3], 110] if faint else colour for colour in one.colours],
                names=[f"{run}: {name}" if run else name for name in one.names],
                widths=[one.width * (0.6 if faint else 1.0)] * len(one.names),
                aggregation_policy=rr.components.AggregationPolicy.MinMax,
            ),
            static=True,
        )
    names, shades = (
        [name for name, _ in colours.VALVE_STATES],
        [shade for _, shade in colours.VALVE_STATES],
    )
    for axle in range(1, signals.AXLES + 1):
        stream.log(
            valve(axle, prefix),
            rr.StateConfiguration(values=names, labels=names, colors=shades),
            static=True,
        )


def tops(stored: Mapping[str, Any]) -> tuple[float, float]:
    """Upper ends of the axes of adhesion and transition, for channels by name, (n,) each; what lacks counts as 0.

    The plots of adhesion hold what was used, and both limits while a wheel slides; where nothing
    slides f_r is far above all that is used, and may leave the plot.
    """

    def of(name: str) -> list[np.ndarray]:
        found = (one for one in signals.columns(signals.BY_NAME[name]) if one in stored)
        return [np.nan_to_num(np.asarray(stored[one])) for one in found]

    # of a long run not every sample is needed
    slid = [
        upper[sliding > 1.0][:: 1 + upper.size // _ENOUGH]
        for upper, sliding in zip(of("adhesion_recovered"), of("sliding"), strict=False)
    ]
    limit = np.concatenate([[0.0] * (not any(one.size for one in slid)), *slid])
    used, transition = (
        max((float(one.max(initial=0.0)) for one in of(name)), default=0.0)
        for name in ("adhesion", "transition")
    )
    return max(0.1, 1.15 * float(np.median(limit)), 1.4 * used), min(
        1.0, max(0.2, 1.1 * transition)
    )


def blueprint(
    live: bool = False,
    bare: bool = False,
    eye: rrb.EyeControls3D | None = None,
    references: Sequence[str] = (),
    top: tuple[float, float] = (0.4, 1.0),
) -> rrb.Blueprint:
    """The layout: axle by axle or all together on one linked time axis, beside it the result, the rig, the events.

    `live` follows the newest sample in a window of 20 s; a recorded run is shown whole. `bare` leaves out the viewer's
    own bars, for pictures. `references` names runs laid beneath, `top` comes from `tops` where the run is known.
    """
    link = rrb.components.LinkAxis
    axis = rrb.TimeAxis(link=link.Independent if live else link.LinkToGlobal)
    window = (
        rrb.VisibleTimeRange(
            TIMELINE,
            start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_WINDOW_S),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        )
        if live
        else None
    )
    page = _Page(axis, window, ("", *(f"{REFERENCES}/{name}" for name in references)), top)
    panels: Literal["hidden", "collapsed"] = "hidden" if bare else "collapsed"
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(_axle_by_axle(page), _together(page), active_tab=0),
            _rig(page, eye),
            column_shares=[8, 2.6],
        ),
        rrb.TopPanel(state="hidden" if bare else "expanded"),
        rrb.TimePanel(
            state=panels, timeline=TIMELINE, play_state="following" if live else "paused"
        ),
        rrb.SelectionPanel(state=panels),
        rrb.BlueprintPanel(state=panels),
        auto_views=False,
        auto_layout=False,
    )


class _Page(NamedTuple):
    """What all views share: time axis, time window (None: all), paths of the runs, axis ends."""

    axis: rrb.TimeAxis
    window: rrb.VisibleTimeRange | None
    runs: tuple[str, ...]
    top: tuple[float, float]

    def contents(self, *paths: str) -> list[str]:
        return [run + path for run in self.runs for path in paths]


def _plot(
    page: _Page,
    name: str,
    group: str,
    legend: bool = False,
    contents: Sequence[str] = (),
    span: tuple[float, float] | None = None,
) -> rrb.TimeSeriesView:
    """A plot of a group; a legend only where the axles' colours do not say enough."""
    return rrb.TimeSeriesView(
        name=name,
        origin="/",
        contents=page.contents(*(contents or [f"/{group}/**"])),
        axis_x=page.axis,
        axis_y=rrb.ScalarAxis(range=span) if span else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
        time_ranges=page.window,
    )


def _lane(page: _Page, name: str, *axles: int) -> rrb.StateTimelineView:
    return rrb.StateTimelineView(
        name=name,
        origin=VALVES,
        contents=page.contents(*map(valve, axles)),
        time_view=page.axis,
        time_ranges=page.window,
    )


def _axle_by_axle(page: _Page) -> rrb.Vertical:
    """The vehicle above, a column for each axle below, all four on the same scales."""
    whole = rrb.Horizontal(
        _plot(page, "Speeds: vehicle, wheels, WSP reference, faults (km/h)", "speeds"),
        _plot(page, "Deceleration, demanded and achieved (m/s²)", "acceleration", legend=True),
    )
    return rrb.Vertical(
        whole,
        rrb.Horizontal(*(_axle(page, axle) for axle in range(1, signals.AXLES + 1))),
        row_shares=[1, 4],
        name="Axle by axle",
    )


def _axle(page: _Page, axle: int) -> rrb.Vertical:
    def of(group: str, *names: str) -> list[str]:
        return [f"/{group}/{name}" for name in names]

    return rrb.Vertical(
        _plot(
            page,
            f"Axle {axle}: speed (km/h)",
            "",
            legend=axle == 1,
            contents=of(
                "speeds",
                "vehicle_speed",
                "wsp_reference_speed",
                f"wheel_circumferential_speed_{axle}",
            ),
        ),
        _plot(
            page,
            f"Axle {axle}: slip (% of reference)",
            "",
            span=(-5.0, 105.0),
            contents=of("slip", f"axle_{axle}", "bands"),
        ),
        _plot(
            page,
            f"Axle {axle}: adhesion f, f_d, f_r",
            "",
            span=(0.0, page.top[0]),
            contents=of(
                "adhesion",
                *(
                    f"{name}_{axle}"
                    for name in ("adhesion_degraded", "adhesion_recovered", "adhesion", "band")
                ),
            ),
        ),
        _plot(
            page,
            f"Axle {axle}: cylinder (bar)",
            "",
            contents=of("pressures", "brake_demand", f"cylinder_pressure_{axle}"),
        ),
        _lane(page, f"Axle {axle}: dump valve", axle),
        row_shares=[3, 3, 3, 3, 0.8 + 0.8 * len(page.runs)],
    )


def _together(page: _Page) -> rrb.Horizontal:
    """All axles over one another."""
    left = rrb.Vertical(
        _plot(page, "Speeds: vehicle, wheels, WSP reference, faults (km/h)", "speeds", legend=True),
        _plot(page, "Slip (% of the reference)", "slip"),
        _plot(page, "Sliding (m/s)", "sliding"),
        row_shares=[3, 2, 2],
    )
    right = rrb.Vertical(
        _plot(page, "Brake cylinders, demand, reservoir (bar)", "pressures"),
        _lane(page, "Dump valves: fill grey, hold yellow, vent red", *range(1, signals.AXLES + 1)),
        _plot(page, "Transition λ: 0 degraded, 1 recovered", "transition", span=(0.0, page.top[1])),
        row_shares=[3, 2.2, 2],
    )
    return rrb.Horizontal(left, right, name="All axles")


def _rig(page: _Page, eye: rrb.EyeControls3D | None) -> rrb.Vertical:
    kinds = encodings.TextLogColumnKind.LogLevel, encodings.TextLogColumnKind.Body
    columns = rrb.TextLogColumns(
        timeline_columns=[encodings.TimelineColumn(TIMELINE)],
        text_log_columns=[encodings.TextLogColumn(kind) for kind in kinds],
    )
    groups = [*_TABS, *sorted({s.group for s in SIGNALS if s.group} - {*_TABS, *_COLUMNS})]
    more = rrb.Tabs(
        *(
            _plot(page, _TABS.get(group, group.capitalize()), group, legend=group in _SEVERAL)
            for group in groups
        ),
        name="More",
    )
    events = rrb.Tabs(
        *(
            rrb.TextLogView(name=name, origin="/", contents=page.contents(path), columns=columns)
            for name, path in (("Events", EVENTS), ("Network", NETWORK))
        ),
        active_tab=0,
    )
    return rrb.Vertical(
        rrb.TextDocumentView(name="Result", origin="/", contents=[BOX]),
        rrb.Spatial3DView(
            name="Rig, 20 times slower; red spokes: locked",
            origin=RIG,
            eye_controls=eye,
            background=(24, 27, 31),
            line_grid=False,
        ),
        more,
        events,
        row_shares=[1.7, 2.3, 2, 2],
    )
