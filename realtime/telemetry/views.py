"""How a run looks in Rerun: its entities, their colours, and the layout of the views.

All of it follows from the table of signals. The path of an entity is the group and the name of its
signal, its series are the axles, and a group is a plot. A colour means the same axle in every view
(see `colours`). Source of the layout: the screens that WSP engineers use in service, where one
glance must show which axle slides and how its valve reacts.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint import encodings

from rollerrig.configs.vehicle import MOST_GROUPS
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.colours import Colour
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import Signal, Table

# name of the application in Rerun; the viewer stores a separate layout for each application
APPLICATION = "rollerrig"
TIMELINE = "t"

# paths of entities
EVENTS = "/events"
NETWORK = "/network"
RESULT = "/result"
RIG = "/rig"
VALVES = "/valves"
MORE = "/more"  # parent of the signals without a group, which no plot shows
REFERENCES = "/ref"  # parent of the reference runs, which are drawn faintly under the first run

# Rerun's level, and the colour, of each level of events
LEVELS = {
    "info": ("INFO", (96, 132, 168)),
    "warning": ("WARN", colours.YELLOW),
    "error": ("ERROR", colours.VERMILION),
}


# --- how a signal is drawn ---

# Groups in which each axle is a separate entity: a plot for each axle shows it.
_BY_AXLE = ("adhesion", "speeds", "pressures")


class Unit(NamedTuple):
    """A unit in which a group is drawn, and the factor from the recorded unit."""

    name: str
    factor: float


_AS_RECORDED = Unit("", 1.0)
UNITS = {
    "speeds": Unit("km/h", 3.6),
    "pressures": Unit("bar", 1e-5),
    "acceleration": Unit("m/s², braking positive", -1.0),
}

_REFERENCE_SPEEDS = tuple(map(signals.reference_speed_name, range(MOST_GROUPS)))

# width of a line in points, and the signals whose lines have another width
_WIDTH = 1.5
_WIDTHS = {
    "adhesion": 2.5,
    "adhesion_degraded": 1.0,
    "adhesion_recovered": 1.0,
    "vehicle_speed": 2.5,
    **dict.fromkeys(_REFERENCE_SPEEDS, 1.0),
    "motor_torque_demand": 0.8,
    "dynamic_torque_demand": 0.8,
    "track_brake_demand": 0.8,
}
# Signals with a fixed colour. The others have the colours of the axles, or that of the vehicle.
COLOUR_OF_SIGNAL = {
    "adhesion_degraded": colours.LIMIT,
    "adhesion_recovered": colours.LIMIT,
    **dict.fromkeys(_REFERENCE_SPEEDS, colours.REFERENCE),
    "brake_demand": colours.REFERENCE,
}
# legends of signals whose name, with spaces, would not be a good legend
_LEGENDS = {
    "adhesion_degraded": "f_d degraded",
    "adhesion_recovered": "f_r recovered",
    "vehicle_acceleration": "achieved",
    "adhesion": "f utilised",
    "wsp_reference_speed": "WSP reference",
    "vehicle_speed": "vehicle",
    "brake_demand": "demand",
    "friction_demand": "friction brake's part",
    "dynamic_torque": "motor",
    "dynamic_torque_demand": "demand",
    "dynamic_share": "share",
    "traction_demand": "traction",
    "track_brake_lowered": "magnets",
    "track_brake_demand": "demand",
    "reservoir_pressure": "reservoir",
}

# lines of a reference run: opacity (0 to 255), and width as a share of the usual one
_FAINT_OPACITY = 110
_FAINT_WIDTH = 0.6


# --- where a group is drawn ---

# groups that the large tabs show ("Axle by axle" and "All axles")
_IN_LARGE_TABS = (
    "speeds",
    "sliding",
    "valves",
    "pressures",
    "adhesion",
    "transition",
    "acceleration",
)
# groups that the tab "Motors and magnets" shows, with the titles of their plots; a vehicle that has
# none of them has no such tab
_OF_MOTORS_AND_MAGNETS = {
    "dynamic_torques": "Motors: torque, and thin its demand (Nm)",
    "dynamic_share": "Motors: share that slide control permits, demand of traction",
    "track_brake": "Magnets: force, half a bogie for each axle (N)",
    "track_brake_lowered": "Magnets: 0 raised, 1 on the rail; thin: demanded",
    "track_brake_cleaning": "Magnets: work on a metre of rail ahead of the axle (J/m)",
}
# Groups in the small tabs ("More"), with the titles of their tabs. A group that is in neither table
# gets a small tab too, with its name as the title.
_IN_SMALL_TABS = {
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
# groups in the small tabs that need a legend, because their series are not the axles
_WITH_LEGEND = ("loop",)

_SPEEDS_TITLE = "Speeds: vehicle, wheels, WSP reference, faults (km/h)"

# width of the time window of the live view
_WINDOW_S = 20.0

# so many samples of a wheel are enough for the median of the limit of adhesion
_ENOUGH_SAMPLES = 100_000

# a wheel counts as sliding above this sliding speed
_SLIDING_M_S = 1.0


# --- entities ---


class Lines(NamedTuple):
    """An entity of scalars: its path, the columns of a row that it shows, and their names.

    The values of the columns are drawn times `factor`.
    """

    path: str
    columns: tuple[int, ...]
    names: tuple[str, ...]
    colours: tuple[Colour, ...]
    width: float
    factor: float = 1.0


class Styled(Protocol):
    """An entity of scalars with the name and the colour of each of its series."""

    @property
    def path(self) -> str: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def colours(self) -> tuple[tuple[int, ...], ...]: ...
    @property
    def width(self) -> float: ...


def lines(table: Table) -> tuple[Lines, ...]:
    """Return every signal of a vehicle, except the valves, as an entity of scalars.

    Signals without a group are under `MORE`.
    """
    entities: list[Lines] = []
    for signal in table.signals:
        if signal.name in ("time", "valve"):
            continue
        folder = f"/{signal.group}" if signal.group else MORE
        path = f"{folder}/{signal.name}"
        axles = range(1, signal.axles + 1)
        if signal.group in _BY_AXLE and signal.axles > 1:
            for axle in axles:
                entities.append(_lines(table, f"{path}_{axle}", signal, [axle]))
        else:
            entities.append(_lines(table, path, signal, list(axles)))
    return tuple(entities)


def _lines(table: Table, path: str, signal: Signal, axles: list[int]) -> Lines:
    """Return the entity of some axles of a signal."""
    return Lines(
        path=path,
        columns=tuple(signals.column(signal.name, axle) for axle in axles),
        names=tuple(_legend(table, signal, axle) for axle in axles),
        colours=tuple(_colour(signal, axle) for axle in axles),
        width=_WIDTHS.get(signal.name, _WIDTH),
        factor=UNITS.get(signal.group, _AS_RECORDED).factor,
    )


def _colour(signal: Signal, axle: int) -> Colour:
    if signal.name in COLOUR_OF_SIGNAL:
        return COLOUR_OF_SIGNAL[signal.name]
    if signal.axles == 1:
        return colours.VEHICLE
    return colours.AXLES[axle - 1]


def _legend(table: Table, signal: Signal, axle: int) -> str:
    """Return the legend of an axle: the axle, the signal, or both, so that it is unique."""
    label = _LEGENDS.get(signal.name, signal.name.replace("_", " "))
    if signal.axles == 1:
        return label

    # the only signal of axles in its plot: the title of the plot describes it
    in_plot = [other for other in table.signals if other.group == signal.group]
    of_axles = [other for other in in_plot if other.axles > 1]
    if len(of_axles) == 1:
        return f"axle {axle}"

    # each axle has a plot, and the title of the plot contains the axle
    if signal.group in _BY_AXLE:
        return label
    return f"{label} {axle}"


def valve(axle: int, prefix: str = "") -> str:
    """Return the path of the dump valve of an axle. The view shows the last part of the path."""
    return f"{prefix}{VALVES}/axle_{axle}"


def valve_states(rows: np.ndarray, axle: int) -> np.ndarray:
    """Return the states of the dump valve of an axle, int64 (n,).

    `rows` are rows of all signals, shape (n, signals.WIDTH).
    """
    return states_of(rows[:, signals.column("valve", axle)])


def states_of(recorded: np.ndarray) -> np.ndarray:
    """Return recorded states of a dump valve, shape (n,), as places in `colours.VALVE_STATES`.

    NaN becomes state 0, and other values are limited to the table.
    """
    states = np.nan_to_num(recorded)
    return np.clip(states, 0, len(colours.VALVE_STATES) - 1).astype(np.int64)


def times(time_s: np.ndarray) -> rr.TimeColumn:
    """Return simulated times in s, shape (n,), on the timeline."""
    time_ns = np.rint(time_s * 1e9)
    return rr.TimeColumn(TIMELINE, duration=time_ns.astype("timedelta64[ns]"))


class Changes:
    """Sends states only where they change.

    It remembers the last state of each path between calls.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._last: dict[str, int] = {}

    def send(
        self,
        path: str,
        time_s: np.ndarray,
        states: np.ndarray,
        as_columns: Callable[[np.ndarray], Any],
    ) -> None:
        """Send states of shape (n,), which are 0 or more, at times of shape (n,) in s.

        `as_columns` converts the states that are sent.
        """
        # no state is -1, so the first state of a path is always sent
        before = self._last.get(path, -1)
        changes = np.flatnonzero(np.diff(states, prepend=before) != 0)
        self._last[path] = states[-1]
        if changes.size:
            columns = as_columns(states[changes])
            self._stream.send_columns(path, [times(time_s[changes])], columns)


# --- styles ---


def log_styles(
    stream: rr.RecordingStream,
    table: Table,
    prefix: str = "",
    faint: bool = False,
    curves: Sequence[Styled] = (),
) -> None:
    """Log the styles of all entities of a vehicle and of further curves.

    `prefix` is the path of a reference run, and is empty for the first run. `faint` is the style of
    reference runs.
    """
    # the name of a reference run is the last part of its path
    run = prefix.rpartition("/")[2]
    for entity in (*lines(table), *curves):
        style = series_style(entity, run, faint)
        stream.log(prefix + entity.path, style, static=True)

    names = [name for name, _ in colours.VALVE_STATES]
    shades = [colour for _, colour in colours.VALVE_STATES]
    states = rr.StateConfiguration(values=names, labels=names, colors=shades)
    for axle in table.axles:
        stream.log(valve(axle, prefix), states, static=True)


def series_style(entity: Styled, run: str, faint: bool) -> rr.SeriesLines:
    """Return the style of an entity. `run` is the name of a reference run, empty for the first."""
    names = list(entity.names)
    if run:
        names = [f"{run}: {name}" for name in names]

    shades = [list(colour) for colour in entity.colours]
    width = entity.width
    if faint:
        shades = [[*colour[:3], _FAINT_OPACITY] for colour in shades]
        width = entity.width * _FAINT_WIDTH

    return rr.SeriesLines(
        colors=shades,
        names=names,
        widths=[width] * len(names),
        # the default draws a spike of one sample at half its height
        aggregation_policy=rr.components.AggregationPolicy.MinMax,
    )


# --- ends of axes ---


class AxisEnds(NamedTuple):
    """Upper ends of the vertical axes of adhesion and transition."""

    adhesion: float
    transition: float


_ENDS_OF_UNKNOWN_RUN = AxisEnds(adhesion=0.4, transition=1.0)


def axis_ends(table: Table, channels: Mapping[str, Any]) -> AxisEnds:
    """Return the upper ends of axes for channels by name, (n,) each; missing channels count as 0.

    The plots of adhesion contain the utilised adhesion. While a wheel slides, they also contain
    both limits (f_d degraded, f_r recovered). Where no wheel slides, f_r is far above the utilised
    adhesion and may be outside the plot.
    """
    used = _largest(table, channels, "adhesion")
    transition = _largest(table, channels, "transition")
    limit = float(np.median(_limit_while_sliding(table, channels)))
    # the factors leave room above the curves; an axis is never shorter than 0.1 or 0.2
    return AxisEnds(
        adhesion=max(0.1, 1.15 * limit, 1.4 * used),
        transition=min(1.0, max(0.2, 1.1 * transition)),
    )


def _channels_of(table: Table, channels: Mapping[str, Any], signal: str) -> list[np.ndarray]:
    """Return the recorded channels of a signal, with 0 for NaN."""
    names = signals.columns(table.by_name[signal])
    return [np.nan_to_num(np.asarray(channels[name])) for name in names if name in channels]


def _largest(table: Table, channels: Mapping[str, Any], signal: str) -> float:
    """Return the largest recorded value of a signal, at least 0."""
    values = [float(channel.max(initial=0.0)) for channel in _channels_of(table, channels, signal)]
    return max(values, default=0.0)


def _limit_while_sliding(table: Table, channels: Mapping[str, Any]) -> np.ndarray:
    """Return samples of f_r while wheels slide; a single 0 if no wheel slides."""
    limits = _channels_of(table, channels, "adhesion_recovered")
    slidings = _channels_of(table, channels, "sliding")
    samples = []
    # both lists have an item for each axle; either is empty if the signal is not recorded
    for limit, sliding in zip(limits, slidings, strict=False):
        while_sliding = limit[sliding > _SLIDING_M_S]
        # a long run has more samples than the median needs, so only every n-th one is used
        every = 1 + limit.size // _ENOUGH_SAMPLES
        samples.append(while_sliding[::every])
    if not any(some.size for some in samples):
        return np.zeros(1)
    return np.concatenate(samples)


# --- the layout ---


def blueprint(
    table: Table,
    live: bool = False,
    bare: bool = False,
    eye: rrb.EyeControls3D | None = None,
    references: Sequence[str] = (),
    ends: AxisEnds = _ENDS_OF_UNKNOWN_RUN,
) -> rrb.Blueprint:
    """Return the layout: the axles in columns or together on a common time axis, and the rig.

    The result, the rig and the events are to the right of the plots.

    Args:
        table: the signals of the vehicle.
        live: follow the newest sample in a window of 20 s; otherwise show the whole run.
        bare: leave out the bars of the viewer, for pictures.
        eye: the view of the rig.
        references: names of the reference runs, which are drawn under the first run.
        ends: upper ends of axes, see `axis_ends`.
    """
    page = _Page(
        table=table,
        axis=time_axis(live),
        window=_window() if live else None,
        runs=("", *(f"{REFERENCES}/{name}" for name in references)),
        ends=ends,
    )
    by_axle = [_axle_by_axle(page, group) for group in range(table.kind.groups)]
    equipment = _motors_and_magnets(page)
    plots = rrb.Tabs(*by_axle, _all_axles(page), *equipment, active_tab=0)
    return framed(
        rrb.Horizontal(plots, _right_column(page, eye), column_shares=[8, 2.6]), live, bare
    )


def framed(content: rrb.Container, live: bool = False, bare: bool = False) -> rrb.Blueprint:
    """Return a layout with the bars of the viewer; `live` and `bare` as for `blueprint`."""
    panels: Literal["hidden", "collapsed"] = "hidden" if bare else "collapsed"
    return rrb.Blueprint(
        content,
        rrb.TopPanel(state="hidden" if bare else "expanded"),
        rrb.TimePanel(
            state=panels,
            timeline=TIMELINE,
            play_state="following" if live else "paused",
        ),
        rrb.SelectionPanel(state=panels),
        rrb.BlueprintPanel(state=panels),
        auto_views=False,
        auto_layout=False,
    )


def time_axis(live: bool) -> rrb.TimeAxis:
    """Return the time axis of a plot: a separate one if live, else one that all plots share."""
    link = rrb.components.LinkAxis
    return rrb.TimeAxis(link=link.Independent if live else link.LinkToGlobal)


def _window() -> rrb.VisibleTimeRange:
    """Return the time window that ends at the cursor."""
    return rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )


class _Page(NamedTuple):
    """The settings that all views share."""

    table: Table
    axis: rrb.TimeAxis
    window: rrb.VisibleTimeRange | None  # None: the whole run
    runs: tuple[str, ...]  # paths of the runs; that of the first run is empty
    ends: AxisEnds

    def contents(self, *paths: str) -> list[str]:
        """Return the given paths of every run."""
        contents = []
        for run in self.runs:
            for path in paths:
                contents.append(run + path)
        return contents


def _plot(
    page: _Page,
    name: str,
    contents: Sequence[str],
    legend: bool = False,
    span: tuple[float, float] | None = None,
) -> rrb.TimeSeriesView:
    """Return a plot of paths. It needs a legend only where the colours of axles are not enough."""
    return rrb.TimeSeriesView(
        name=name,
        origin="/",
        contents=page.contents(*contents),
        axis_x=page.axis,
        axis_y=rrb.ScalarAxis(range=span) if span else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
        time_ranges=page.window,
    )


def _plot_of_group(
    page: _Page,
    name: str,
    group: str,
    legend: bool = False,
    span: tuple[float, float] | None = None,
) -> rrb.TimeSeriesView:
    """Return a plot of all entities of a group."""
    return _plot(page, name, [f"/{group}/**"], legend, span)


def _valve_lanes(page: _Page, name: str, *axles: int) -> rrb.StateTimelineView:
    """Return a view with a lane for the dump valve of each axle."""
    return rrb.StateTimelineView(
        name=name,
        origin=VALVES,
        contents=page.contents(*(valve(axle) for axle in axles)),
        time_view=page.axis,
        time_ranges=page.window,
    )


def _axle_by_axle(page: _Page, group: int) -> rrb.Vertical:
    """Return the tab with the vehicle above and a column for each axle of a group below.

    Their scales are equal. A vehicle with several groups has a tab for each of them.
    """
    numbers = page.table.axles_of(group)
    name = "Axle by axle"
    if page.table.kind.groups > 1:
        name = f"Axles {numbers[0]} to {numbers[-1]}"
    vehicle = rrb.Horizontal(
        _plot_of_group(page, _SPEEDS_TITLE, "speeds"),
        _plot_of_group(
            page,
            "Deceleration, demanded and achieved (m/s²)",
            "acceleration",
            legend=True,
        ),
    )
    axles = rrb.Horizontal(*(_axle(page, axle) for axle in numbers))
    return rrb.Vertical(vehicle, axles, row_shares=[1, 4], name=name)


def _motors_and_magnets(page: _Page) -> list[rrb.Horizontal]:
    """Return the tab with the motors beside the magnets; no tab for a vehicle without them."""
    present = {signal.group for signal in page.table.signals}
    columns = []
    for prefix in ("dynamic_", "track_brake"):
        plots = [
            _plot_of_group(page, title, group, legend=group.startswith("dynamic_"))
            for group, title in _OF_MOTORS_AND_MAGNETS.items()
            if group in present and group.startswith(prefix)
        ]
        if plots:
            columns.append(rrb.Vertical(*plots))
    return [rrb.Horizontal(*columns, name="Motors and magnets")] if columns else []


def _axle(page: _Page, axle: int) -> rrb.Vertical:
    """Return the column of an axle."""
    speed = _plot(
        page,
        f"Axle {axle}: speed (km/h)",
        [
            "/speeds/vehicle_speed",
            f"/speeds/{signals.reference_speed_name(signals.group_of_axle(axle))}",
            f"/speeds/wheel_circumferential_speed_{axle}",
        ],
        legend=axle == 1,
    )
    slip = _plot(
        page,
        f"Axle {axle}: slip (% of reference)",
        [f"/slip/axle_{axle}", "/slip/bands"],
        span=(-5.0, 105.0),
    )
    adhesion = _plot(
        page,
        f"Axle {axle}: adhesion f, f_d, f_r",
        [
            f"/adhesion/adhesion_degraded_{axle}",
            f"/adhesion/adhesion_recovered_{axle}",
            f"/adhesion/adhesion_{axle}",
            f"/adhesion/band_{axle}",
        ],
        span=(0.0, page.ends.adhesion),
    )
    pressures = ["/pressures/brake_demand", f"/pressures/cylinder_pressure_{axle}"]
    if page.table.kind.dynamic_brake:
        pressures.append(f"/pressures/friction_demand_{axle}")
    cylinder = _plot(page, f"Axle {axle}: cylinder (bar)", pressures)
    lanes = _valve_lanes(page, f"Axle {axle}: dump valve", axle)
    # every run has a lane, so more runs need more height
    lanes_share = 0.8 + 0.8 * len(page.runs)
    return rrb.Vertical(
        speed,
        slip,
        adhesion,
        cylinder,
        lanes,
        row_shares=[3, 3, 3, 3, lanes_share],
    )


def _all_axles(page: _Page) -> rrb.Horizontal:
    """Return the tab with all axles in the same plots."""
    left = rrb.Vertical(
        _plot_of_group(page, _SPEEDS_TITLE, "speeds", legend=True),
        _plot_of_group(page, "Slip (% of the reference)", "slip"),
        _plot_of_group(page, "Sliding (m/s)", "sliding"),
        row_shares=[3, 2, 2],
    )
    right = rrb.Vertical(
        _plot_of_group(page, "Brake cylinders, demand, reservoir (bar)", "pressures"),
        _valve_lanes(
            page,
            "Dump valves: fill grey, hold yellow, vent red",
            *page.table.axles,
        ),
        _plot_of_group(
            page,
            "Transition λ: 0 degraded, 1 recovered",
            "transition",
            span=(0.0, page.ends.transition),
        ),
        row_shares=[3, 2.2, 2],
    )
    return rrb.Horizontal(left, right, name="All axles")


def _right_column(page: _Page, eye: rrb.EyeControls3D | None) -> rrb.Vertical:
    """Return the column with the result, the rig, further plots and the events."""
    result = rrb.TextDocumentView(name="Result", origin="/", contents=[RESULT])
    rig = rrb.Spatial3DView(
        name="Rig, 20 times slower; red spokes: locked",
        origin=RIG,
        eye_controls=eye,
        background=(24, 27, 31),
        line_grid=False,
    )
    return rrb.Vertical(
        result,
        rig,
        _further_plots(page),
        _event_lists(page),
        row_shares=[1.7, 2.3, 2, 2],
    )


def _further_plots(page: _Page) -> rrb.Tabs:
    """Return a tab for each group that no other view shows."""
    all_groups = {signal.group for signal in page.table.signals if signal.group}
    without_place = sorted(all_groups - {*_IN_SMALL_TABS, *_IN_LARGE_TABS, *_OF_MOTORS_AND_MAGNETS})
    plots = []
    for group in [*_IN_SMALL_TABS, *without_place]:
        title = _IN_SMALL_TABS.get(group, group.capitalize())
        plots.append(_plot_of_group(page, title, group, legend=group in _WITH_LEGEND))
    return rrb.Tabs(*plots, name="More")


def _event_lists(page: _Page) -> rrb.Tabs:
    """Return a tab with the events of the run, and one with those of the network."""
    lists = [
        event_list(name, page.contents(path))
        for name, path in (("Events", EVENTS), ("Network", NETWORK))
    ]
    return rrb.Tabs(*lists, active_tab=0)


def event_list(name: str, contents: list[str]) -> rrb.TextLogView:
    """Return a view with the events of paths."""
    level = encodings.TextLogColumn(encodings.TextLogColumnKind.LogLevel)
    text = encodings.TextLogColumn(encodings.TextLogColumnKind.Body)
    columns = rrb.TextLogColumns(
        timeline_columns=[encodings.TimelineColumn(TIMELINE)],
        text_log_columns=[level, text],
    )
    return rrb.TextLogView(name=name, origin="/", contents=contents, columns=columns)
