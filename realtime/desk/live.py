"""The live part of the page: figures, the rig from the side, plots, and lanes of the valves.

Colours are those of every other view. The browser draws what moves with `desk.js`. It requests new
rows ten times a second, less often if it cannot draw that fast. `answer` makes the reply.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from nicegui import json, ui

from rollerrig.realtime.desk import reader
from rollerrig.realtime.desk.desk import Desk
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.colours import Colour
from rollerrig.wsp_interface import signals

# a wheel is drawn as locked if it is slower than LOCKED_M_S while the vehicle is faster than
# MOVING_M_S
LOCKED_M_S = 0.1
MOVING_M_S = 0.5
_RADIUS_M = 0.445  # radius of the drawn wheels (the coach UIC-Z1: Table 1 of the paper)


class _Plot(NamedTuple):
    """One plot: title, unit, units of the plot for an SI unit, and the signals in it."""

    title: str
    unit: str
    scale: float
    signals: tuple[str, ...]


class _Figure(NamedTuple):
    """One figure: the id of its place in the page (desk-ID), its unit and its label."""

    id: str
    unit: str
    label: str


_PLOTS = (
    _Plot(
        "Speeds: vehicle, wheels, WSP reference",
        "km/h",
        3.6,
        ("vehicle_speed", "wheel_circumferential_speed", "wsp_reference_speed"),
    ),
    _Plot("Sliding", "km/h", 3.6, ("sliding",)),
    _Plot(
        "Adhesion f between f_d and f_r",
        "",
        1.0,
        ("adhesion_degraded", "adhesion_recovered", "adhesion"),
    ),
    _Plot(
        "Brake cylinder pressures, demand in yellow",
        "bar",
        1e-5,
        ("cylinder_pressure", "brake_demand"),
    ),
)
_COLOURS: dict[str, Colour] = {
    "vehicle_speed": colours.VEHICLE,
    "wsp_reference_speed": colours.REFERENCE,
    "brake_demand": colours.REFERENCE,
    "adhesion_degraded": colours.LIMIT,
    "adhesion_recovered": colours.LIMIT,
}
_USUAL_WIDTH = 1.3
_WIDTHS = {
    "vehicle_speed": 2.5,
    "adhesion": 2.0,
    "adhesion_degraded": 0.8,
    "adhesion_recovered": 0.8,
}
_FIGURES = (
    _Figure("time", "", "simulated time"),
    _Figure("speed", "km/h", "vehicle"),
    _Figure("distance", "m", "distance from the start"),
    _Figure("braked", "m", "since the brake demand"),
    _Figure("demand", "bar", "brake demand"),
    _Figure("sliding", "km/h", "largest sliding"),
    _Figure("missed", "", "ticks missed"),
    _Figure("late", "us", "latest tick"),
)


def answer(desk: Desk, bench_key: str, after: int, whole: bool) -> dict[str, Any]:
    """The reply to `desk.js`: the rows after a point, or the whole run, thinned.

    `bench_key` is the bench that the page knows; if another one runs now, the reply has all its
    rows.
    """
    bench = desk.bench
    doors = desk.doors
    if bench is None or doors is None:
        return {
            "bench": "",
            "points": 0,
            "rows": [],
            "newest": None,
            "braked_m": None,
            "held_m_s": None,
        }
    if whole:
        rows: Any = bench.whole
    else:
        rows = bench.since(after if bench_key == bench.key else 0)
    held_m_s = doors.values.get("vehicle_speed") if desk.held() else None
    moving = bench.points and held_m_s is None
    return {
        "bench": bench.key,
        "points": bench.points,
        "rows": _short(np.array(rows)) if len(rows) else [],
        "newest": _short(bench.newest) if moving else None,
        "braked_m": _finite(bench.braked_m) if moving else None,
        "held_m_s": held_m_s,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _short(values: np.ndarray) -> np.ndarray:
    """Values with four decimals, which is more than a plot shows."""
    return np.ascontiguousarray(np.round(values, 4))


def build() -> None:
    """Put figures, rig, plots and lanes of the valves into the page."""
    with ui.row().classes("w-full items-end gap-6 no-wrap desk-figures"):
        for figure in _FIGURES:
            ui.html(
                f'<div class="desk-figure"><b id="desk-{figure.id}">–</b> '
                f"<i>{figure.unit}</i><br><span>{figure.label}</span></div>",
                sanitize=False,
            )
    ui.html('<div id="desk-rig"></div>', sanitize=False).classes("w-full")
    _choices()
    plots = [_plot(plot) for plot in _PLOTS]
    _valves()

    settings = {
        "columns": reader.COLUMNS,
        "plots": plots,
        "span_s": reader.SPAN_S,
        "axles": [colours.as_hex(colour) for colour in colours.AXLES],
        "radius_m": _RADIUS_M,
        "valves": [colours.as_hex(colour) for _, colour in colours.VALVE_STATES],
        "locked_m_s": LOCKED_M_S,
        "moving_m_s": MOVING_M_S,
    }
    start = f"desk.begin({json.dumps(settings)})"
    ui.timer(0.2, lambda: ui.run_javascript(start), once=True)


def _choices() -> None:
    """The switches that choose axle and span of the plots."""
    axle_names = {0: "all axles"}
    for axle in range(1, signals.AXLES + 1):
        axle_names[axle] = f"axle {axle}"
    with ui.row().classes("items-center gap-4"):
        axle_choice = ui.toggle(axle_names, value=0)
        whole_choice = ui.toggle({False: "last 60 s", True: "whole run"}, value=False)

        def choose() -> None:
            whole = "true" if whole_choice.value else "false"
            ui.run_javascript(f"desk.show({axle_choice.value}, {whole})")

        axle_choice.on_value_change(choose)
        whole_choice.on_value_change(choose)


def _valves() -> None:
    """The lanes of the dump valves, which `desk.js` draws, under the names of their states."""
    names = ", ".join(
        f'<b style="color:{colours.as_hex(colour)}">{name}</b>'
        for name, colour in colours.VALVE_STATES
    )
    ui.html(
        f'<div class="desk-title">Dump valves: {names}</div>'
        '<canvas id="desk-valves" height="84" style="width:100%"></canvas>',
        sanitize=False,
    ).classes("w-full")


def _plot(plot: _Plot) -> dict[str, Any]:
    """Put an empty plot into the page; return what `desk.js` must know to fill it."""
    lines: list[dict[str, Any]] = []
    series: list[dict[str, Any]] = []
    for name in plot.signals:
        signal = signals.BY_NAME[name]
        of_vehicle = signal.axles == 1
        shades = (colours.VEHICLE,) if of_vehicle else colours.AXLES
        for axle, column in enumerate(signals.columns(signal), start=1):
            lines.append({"column": column, "axle": 0 if of_vehicle else axle})
            colour = _COLOURS.get(name, shades[axle - 1])
            series.append(
                {
                    "id": column,
                    "name": column,
                    "type": "line",
                    "showSymbol": False,
                    "data": [],
                    "silent": True,
                    "lineStyle": {"width": _WIDTHS.get(name, _USUAL_WIDTH)},
                    "color": colours.as_hex(colour),
                }
            )
    chart = ui.echart(
        {
            "animation": False,
            "grid": {"left": 56, "right": 14, "top": 28, "bottom": 24},
            "title": title_of(f"{plot.title} ({plot.unit})" if plot.unit else plot.title),
            "xAxis": axis("{value} s", ends=False),
            "yAxis": axis(),
            "series": series,
        }
    )
    chart.classes("w-full").style("height: 170px")
    return {"id": chart.id, "lines": lines, "scale": plot.scale}


def title_of(text: str) -> dict[str, Any]:
    """The title of a plot, as ECharts declares it."""
    style = {"fontSize": 12, "fontWeight": "normal", "color": "#c8ccd2"}
    return {"text": text, "textStyle": style, "left": 4, "top": 2}


def axis(formatter: str = "{value}", ends: bool = True) -> dict[str, Any]:
    """An axis of a plot, with or without its first and last label, as ECharts declares it."""
    return {
        "type": "value",
        "splitLine": {"lineStyle": {"color": "#2c3138"}},
        "axisLabel": {
            "formatter": formatter,
            "color": "#9aa0a8",
            "showMinLabel": ends,
            "showMaxLabel": ends,
        },
    }
