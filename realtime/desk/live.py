"""The live part of the page: figures, the rig from the side, plots, and lanes of the valves.

Colours are those of every other view. The browser draws what moves with `desk.js`. It requests new
rows ten times a second, less often if it cannot draw that fast. `answer` makes the reply.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from nicegui import json, ui

from rollerrig.realtime.desk import reader, vehicle
from rollerrig.realtime.desk.desk import Desk
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.colours import Colour
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import Table

# time between two looks at the cars of a train
_FOLLOW_S = 0.5
# fault marks in the plots
_MOST_MARKS = 40

# a wheel is drawn as locked if it is slower than LOCKED_M_S while the vehicle is faster than
# MOVING_M_S
LOCKED_M_S = 0.1
MOVING_M_S = 0.5


class _Line(NamedTuple):
    """A signal of a plot: its columns, how the legend names it, and how it is drawn.

    A line of an axle has the colour and the kind of line of its axle, unless `colour` or `dashes`
    replaces it.
    """

    columns: tuple[str, ...]
    name: str  # "" for the names of the axles
    colour: Colour | None = None
    dashes: tuple[float, ...] | None = None  # in points; () is a solid line
    width: float = 1.3
    is_limit: bool = False  # does not scale the axis; its present value is in the title


class _Plot(NamedTuple):
    """One plot.

    scale: units of the plot for an SI unit.
    least: the vertical axis is at least so long, so that noise of an idle rig is not magnified.
    """

    title: str
    unit: str
    scale: float
    least: float
    lines: tuple[_Line, ...]


class _Figure(NamedTuple):
    """One figure: the id of its place in the page (desk-ID), its unit and its label."""

    id: str
    unit: str
    label: str


# height of the lane of a valve in pixels, and of the lanes of all axles
_LANE_PX = 21
_LEAST_LANE_PX = 9
_LANES_PX = 108
# rows of plots where the page is one view
_PLOT_ROWS = 2

_DOTS = (1.0, 2.0)
_DASHES = (6.0, 3.0)
# deadline misses and the latest cycle are at the light of the loop
_FIGURES = (
    _Figure("time", "", "simulated time"),
    _Figure("speed", "km/h", "vehicle"),
    _Figure("distance", "m", "distance from the start"),
    _Figure("braked", "m", "since the brake demand"),
    _Figure("demand", "bar", "brake demand"),
    _Figure("sliding", "m/s", "largest sliding"),
)


def plots_of(columns: reader.Columns) -> list[_Plot]:
    """The plots of a vehicle."""

    def of(name: str) -> tuple[str, ...]:
        return signals.columns(columns.table.by_name[name])

    kind = columns.table.kind
    # the reference speeds of the units of all groups
    of_units = [
        _Line(of(name), "WSP reference", colours.REFERENCE, _DASHES)
        for name in columns.table.reference_speeds
    ]
    plots = [
        _Plot(
            "Speeds",
            "km/h",
            3.6,
            10.0,
            (
                _Line(of("vehicle_speed"), "vehicle", colours.VEHICLE, (), 2.5),
                _Line(of("wheel_circumferential_speed"), ""),
                _Line(columns.measured, "measured by the sensors", dashes=_DOTS, width=1.0),
                *of_units,
            ),
        ),
        _Plot("Sliding", "m/s", 1.0, 1.0, (_Line(of("sliding"), ""),)),
        _Plot(
            "Adhesion used",
            "",
            1.0,
            0.05,
            (
                _Line(
                    of("adhesion_degraded"), "limit f_d as found", colours.LIMIT, _DOTS, 0.8, True
                ),
                _Line(
                    of("adhesion_recovered"), "limit f_r cleaned", colours.LIMIT, _DASHES, 0.8, True
                ),
                _Line(of("adhesion"), "", width=2.0),
            ),
        ),
        _Plot(
            "Brake cylinder pressures",
            "bar",
            1e-5,
            1.0,
            (
                _Line(of("cylinder_pressure"), ""),
                _Line(of("brake_demand"), "demand", colours.REFERENCE, _DASHES),
            ),
        ),
    ]
    if kind.dynamic_brake:
        plots += [
            _Plot(
                "Motors: braking torque",
                "kN m",
                1e-3,
                1.0,
                (
                    _Line(of("dynamic_torque"), "", width=2.0),
                    _Line(of("dynamic_torque_demand"), "demand", dashes=_DOTS, width=0.8),
                ),
            ),
            _Plot(
                "Motors: share that slide control permits",
                "%",
                100.0,
                100.0,
                (_Line(of("dynamic_share"), ""),),
            ),
        ]
    if kind.magnetic_track_brake:
        plots.append(
            _Plot(
                "Magnets: force of half a bogie",
                "kN",
                1e-3,
                1.0,
                (_Line(of("track_brake_force"), ""),),
            )
        )
    return plots


def answer(desk: Desk, bench_key: str, after: int, whole: bool) -> dict[str, Any]:
    """The reply to `desk.js`: the rows after a point, or the whole run, thinned.

    `bench_key` is the bench that the page knows; if another one runs now, the reply has all its
    rows. The page draws them if it shows their vehicle already.
    """
    bench = desk.bench
    doors = desk.doors
    if bench is None or doors is None:
        return {
            "vehicle": _key(desk.table),
            "bench": "",
            "points": 0,
            "rows": [],
            "newest": None,
            "braked_m": None,
            "held_m_s": None,
            "marks": [],
        }
    if whole:
        rows: Any = bench.whole
    else:
        rows = bench.since(after if bench_key == bench.key else 0)
    held_m_s = doors.values.get("vehicle_speed") if desk.held() else None
    moving = bench.points and held_m_s is None
    return {
        "vehicle": _key(bench.table),
        "bench": bench.key,
        "points": bench.points,
        "rows": _short(np.array(rows)) if len(rows) else [],
        "newest": _short(bench.newest) if moving else None,
        "braked_m": _finite(bench.braked_m) if moving else None,
        "held_m_s": held_m_s,
        "marks": bench.fault_marks[-_MOST_MARKS:],
    }


def _key(table: Table) -> str:
    """A text by which the page distinguishes vehicles."""
    return "-".join(map(str, table.kind))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _short(values: np.ndarray) -> np.ndarray:
    """Values with four decimals, which is more than a plot shows."""
    return np.ascontiguousarray(np.round(values, 4))


def build(desk: Desk) -> None:
    """Put figures, rig, plots and lanes of the valves into the page."""
    with ui.element("div").classes("desk-figures"):
        for figure in _FIGURES:
            ui.html(
                f'<div class="desk-figure"><b id="desk-{figure.id}">–</b> '
                f"<i>{figure.unit}</i><br><span>{figure.label}</span></div>",
                sanitize=False,
            )
    vehicle.build(desk, partial(_build_for_vehicle, desk))


def _build_for_vehicle(desk: Desk, table: Table) -> None:
    """Put what depends on the vehicle into the page, and let the browser draw it."""
    rig = f'<div id="desk-rig" data-vehicle="{_key(table)}"></div>'
    ui.html(rig, sanitize=False).classes("w-full desk-rig")
    _choices(desk, table)
    columns = reader.columns_of(table)
    declared = plots_of(columns)
    grid = ui.element("div").classes("desk-plots")
    grid.style(f"--plot-columns: {math.ceil(len(declared) / _PLOT_ROWS)}")
    with grid:
        plots = [_plot(plot) for plot in declared]
    _valves(table)

    settings = {
        "vehicle": _key(table),
        "columns": columns.names,
        "plots": plots,
        "span_s": reader.SPAN_S,
        "axles": [colours.as_hex(colour) for colour in colours.AXLES[: table.kind.axles]],
        "radius_m": reader.USUAL_RADIUS_M,
        "valves": [colours.as_hex(colour) for _, colour in colours.VALVE_STATES],
        "locked_m_s": LOCKED_M_S,
        "moving_m_s": MOVING_M_S,
        "motors": table.kind.dynamic_brake,
        "magnets": table.kind.magnetic_track_brake,
    }
    start = f"desk.begin({json.dumps(settings)})"
    ui.timer(0.2, lambda: ui.run_javascript(start), once=True)


def _choices(desk: Desk, table: Table) -> None:
    """The switches that choose axle and span of the plots; of a train also the car."""
    axle_names = {0: "all", **{axle: str(axle) for axle in table.axles}}
    with ui.row().classes("items-center gap-2"):
        _car_choice(desk)
        ui.label("Axles").classes("desk-small")
        axle_choice = ui.toggle(axle_names, value=0)
        axle_choice.props('dense no-caps size=sm padding="1px 8px" aria-label="axles shown"')
        whole_choice = ui.toggle({False: "last 60 s", True: "whole run"}, value=False)
        whole_choice.props('dense no-caps size=sm padding="1px 8px" aria-label="time shown"')

        def choose() -> None:
            whole = "true" if whole_choice.value else "false"
            ui.run_javascript(f"desk.show({axle_choice.value}, {whole})")

        axle_choice.on_value_change(choose)
        whole_choice.on_value_change(choose)


def _car_choice(desk: Desk) -> None:
    """The switch that chooses the car of a train, shown while the desk follows a train."""
    with ui.row().classes("items-center gap-2") as row:
        ui.label("Car").classes("desk-small")
        car = ui.toggle({0: ""}, value=0).mark("car-shown")
        car.props('dense no-caps size=sm padding="1px 8px" aria-label="car shown"')

    def follow() -> None:
        numbers = {one.car: str(one.car) for one in desk.cars if one.car}
        row.set_visibility(bool(numbers))
        shown = desk.bench.car if desk.bench else 0
        if numbers and (numbers != car.options or car.value != shown):
            car.set_options(numbers, value=shown)

    def choose() -> None:
        number = int(car.value or 0)
        if desk.bench and number != desk.bench.car:
            desk.show_car(number)

    car.on_value_change(choose)
    ui.timer(_FOLLOW_S, follow)
    follow()


def _valves(table: Table) -> None:
    """The lanes of the dump valves, which `desk.js` draws, under the names of their states."""
    # the heights are those of desk.js
    heights = ("low", "half", "whole lane")
    names = "".join(
        f'<span class="desk-swatch" style="background:{colours.as_hex(colour)}"></span>'
        f"{name} ({height})"
        for (name, colour), height in zip(colours.VALVE_STATES, heights, strict=True)
    )
    axles = table.kind.axles
    height = max(_LEAST_LANE_PX, min(_LANE_PX, _LANES_PX // axles)) * axles
    ui.html(
        f'<div class="desk-title">Dump valves {names}</div>'
        f'<canvas id="desk-valves" height="{height}" style="width:100%; height:{height}px" '
        'role="img" aria-label="states of the dump valves over time, a lane for each axle">'
        "</canvas>",
        sanitize=False,
    ).classes("w-full")


def _plot(plot: _Plot) -> dict[str, Any]:
    """Put an empty plot into the page; return what `desk.js` must know to fill it."""
    lines: list[dict[str, Any]] = []
    series: list[dict[str, Any]] = []
    for line in plot.lines:
        of_axles = len(line.columns) > 1
        for at, column in enumerate(line.columns):
            axle = at + 1 if of_axles else 0
            lines.append({"column": column, "axle": axle, "limit": line.is_limit})
            colour = line.colour or colours.AXLES[at]
            dashes = colours.AXLE_DASHES[at] if line.dashes is None else line.dashes
            series.append(
                {
                    "id": column,
                    # lines of one name are one entry of the legend
                    "name": line.name or f"axle {axle}",
                    "type": "line",
                    "showSymbol": False,
                    "data": [],
                    "silent": True,
                    "lineStyle": {
                        "width": line.width,
                        "type": list(dashes) if dashes else "solid",
                    },
                    "color": colours.as_hex(colour),
                }
            )
    title = f"{plot.title} ({plot.unit})" if plot.unit else plot.title
    chart = ui.echart(
        {
            "animation": False,
            "grid": {"left": 44, "right": 10, "top": 38, "bottom": 20},
            "title": title_of(title),
            "legend": legend(),
            "xAxis": axis("{value} s", ends=False),
            "yAxis": axis() | {"min": 0, "max": plot.least},
            "series": series,
        }
    )
    chart.classes("w-full desk-plot desk-chart").props(f'role=img aria-label="{title}"')
    return {
        "id": chart.id,
        "title": title,
        "lines": lines,
        "scale": plot.scale,
        "least": plot.least,
    }


def legend() -> dict[str, Any]:
    """The legend of a plot below its title, as ECharts declares it; `desk.js` colours its text."""
    return {
        "type": "scroll",
        "left": 4,
        "right": 4,
        "top": 18,
        "itemWidth": 20,
        "itemHeight": 8,
        "itemGap": 8,
        # the plots have lines without symbols
        "itemStyle": {"opacity": 0},
        "textStyle": {"fontSize": 11},
    }


def title_of(text: str) -> dict[str, Any]:
    """The title of a plot, as ECharts declares it."""
    style = {"fontSize": 12, "fontWeight": "normal"}
    return {"text": text, "textStyle": style, "left": 4, "top": 2}


def axis(formatter: str = "{value}", ends: bool = True) -> dict[str, Any]:
    """An axis of a plot, with or without its first and last label, as ECharts declares it."""
    return {
        "type": "value",
        "axisLabel": {
            "formatter": formatter,
            "fontSize": 11,
            "hideOverlap": True,
            "showMinLabel": ends,
            "showMaxLabel": ends,
        },
    }
