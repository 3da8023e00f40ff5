"""The live part of the page: figures, the rig from the side, plots, valve lanes, in the colours of every other view.

What moves is drawn by `desk.js` in the browser, which asks for new rows ten times a second and less often where it
cannot draw as fast; `answer` is what it gets.
"""

from typing import Any

import numpy as np
from nicegui import json, ui

from rollerrig.realtime.desk import reader
from rollerrig.realtime.desk.desk import Desk
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.colours import Colour
from rollerrig.wsp_interface import signals

# a wheel is drawn as locked that turns no faster than this while the vehicle goes faster than that
LOCKED_M_S, MOVING_M_S, _RADIUS_M = 0.1, 0.5, 0.445
_PLOTS = (  # title, unit, scale, signals
    (
        "Speeds: vehicle, wheels, WSP reference",
        "km/h",
        3.6,
        ("vehicle_speed", "wheel_circumferential_speed", "wsp_reference_speed"),
    ),
    ("Sliding", "km/h", 3.6, ("sliding",)),
    (
        "Adhesion f between f_d and f_r",
        "",
        1.0,
        ("adhesion_degraded", "adhesion_recovered", "adhesion"),
    ),
    (
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
_WIDTHS = {
    "vehicle_speed": 2.5,
    "adhesion": 2.0,
    "adhesion_degraded": 0.8,
    "adhesion_recovered": 0.8,
}
_FIGURES = (
    ("time", "", "simulated time"),
    ("speed", "km/h", "vehicle"),
    ("distance", "m", "distance"),
    ("demand", "bar", "brake demand"),
    ("sliding", "km/h", "largest sliding"),
    ("missed", "", "ticks missed"),
    ("late", "us", "latest tick"),
)


def answer(desk: Desk, bench: str, after: int, whole: bool) -> dict[str, Any]:
    """Rows after a point, or of the whole run, thinned, for `desk.js`. `bench` is the one that a page knows."""
    now, doors = desk.bench, desk.doors
    if now is None or doors is None:
        return {"bench": "", "points": 0, "rows": [], "newest": None, "held_m_s": None}
    rows: Any = now.whole if whole else now.since(after if bench == now.key else 0)
    held = doors.values.get("vehicle_speed") if desk.held() else None
    return {
        "bench": now.key,
        "points": now.points,
        "rows": _short(np.array(rows)) if len(rows) else [],
        "newest": _short(now.newest) if now.points and held is None else None,
        "held_m_s": held,
    }


def _short(values: np.ndarray) -> np.ndarray:
    """Four decimals are more than a plot shows."""
    return np.ascontiguousarray(np.round(values, 4))


def build() -> None:
    """Put figures, rig, plots and lanes into the page."""
    with ui.row().classes("w-full items-end gap-6 no-wrap desk-figures"):
        for name, unit, text in _FIGURES:
            ui.html(
                f'<div class="desk-figure"><b id="desk-{name}">–</b> <i>{unit}</i><br><span>{text}</span></div>',
                sanitize=False,
            )
    ui.html('<div id="desk-rig"></div>', sanitize=False).classes("w-full")
    with ui.row().classes("items-center gap-4"):
        axle = ui.toggle(
            {0: "all axles", **{j: f"axle {j}" for j in range(1, signals.AXLES + 1)}}, value=0
        )
        span = ui.toggle({False: "last 60 s", True: "whole run"}, value=False)

        def choose() -> None:
            ui.run_javascript(f"desk.show({axle.value}, {str(span.value).lower()})")

        axle.on_value_change(choose)
        span.on_value_change(choose)
    plots = [_plot(*one) for one in _PLOTS]
    names = ", ".join(
        f'<b style="color:{colours.on_page(colour)}">{name}</b>'
        for name, colour in colours.VALVE_STATES
    )
    ui.html(
        f'<div class="desk-title">Dump valves: {names}</div>'
        '<canvas id="desk-valves" height="84" style="width:100%"></canvas>',
        sanitize=False,
    ).classes("w-full")
    given = {
        "columns": reader.COLUMNS,
        "plots": plots,
        "span_s": reader.SPAN_S,
        "axles": [colours.on_page(one) for one in colours.AXLES],
        "radius_m": _RADIUS_M,
        "valves": [colours.on_page(one) for _, one in colours.VALVE_STATES],
        "locked_m_s": LOCKED_M_S,
        "moving_m_s": MOVING_M_S,
    }
    ui.timer(0.2, lambda: ui.run_javascript(f"desk.begin({json.dumps(given)})"), once=True)


def _plot(title: str, unit: str, scale: float, names: tuple[str, ...]) -> dict[str, Any]:
    lines: list[dict[str, Any]] = []
    series: list[dict[str, Any]] = []
    for name in names:
        signal = signals.BY_NAME[name]
        shades = (colours.VEHICLE,) if signal.axles == 1 else colours.AXLES
        for axle, column in enumerate(signals.columns(signal), start=1):
            lines.append({"column": column, "axle": axle if signal.axles > 1 else 0})
            series.append(
                {
                    "id": column,
                    "name": column,
                    "type": "line",
                    "showSymbol": False,
                    "data": [],
                    "silent": True,
                    "lineStyle": {"width": _WIDTHS.get(name, 1.3)},
                    "color": colours.on_page(_COLOURS.get(name, shades[axle - 1])),
                }
            )
    chart = (
        ui.echart(
            {
                "animation": False,
                "grid": {"left": 56, "right": 14, "top": 28, "bottom": 24},
                "title": title_of(f"{title} ({unit})" if unit else title),
                "xAxis": axis("{value} s", ends=False),
                "yAxis": axis(),
                "series": series,
            }
        )
        .classes("w-full")
        .style("height: 170px")
    )
    return {"id": chart.id, "lines": lines, "scale": scale}


def title_of(text: str) -> dict[str, Any]:
    """How a plot is entitled."""
    style = {"fontSize": 12, "fontWeight": "normal", "color": "#c8ccd2"}
    return {"text": text, "textStyle": style, "left": 4, "top": 2}


def axis(formatter: str = "{value}", ends: bool = True) -> dict[str, Any]:
    """An axis of a plot, with or without its first and last label."""
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
