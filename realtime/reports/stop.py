"""The picture and the table of one stop: what each axle did, with the steps of its test and its faults marked."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record.files import replaced
from rollerrig.realtime.record.records import Run
from rollerrig.realtime.reports import page
from rollerrig.realtime.reports.page import Markup
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.sequences.measures import Record
from rollerrig.wsp_interface.signals import AXLES

Column = Callable[[str], np.ndarray]
STEP, FAULT = "step", "fault"
Mark = tuple[float, str, str]  # at s, STEP or FAULT, what stands beside it
_SLOWEST_M_S = 1.0
# how slip is drawn of sensors that tell nonsense
_SLIP_PERCENT = (-10.0, 105.0)


def write(run: Run, out: Path) -> list[Path]:
    """Write the picture of a recorded run; the file written. Raises OSError."""
    faults = (Code.FAULT_BEGINS, Code.FAULT_LIFTED)
    marks = [(event.time_s, FAULT, "") for event in run.events if event.code in faults]
    with replaced(out) as new:
        new.write_text(
            str(picture(run.column, run.scenario["vehicle"]["wheel_radius_m"], marks)),
            encoding="utf-8",
        )
    return [out]


def picture(column: Column, radius_m: float, marks: Sequence[Mark]) -> Markup:
    """Speeds, slip, pressures, adhesion and valves over time, as SVG."""
    return page.picture(lambda figure: _draw(figure, column, radius_m, marks), (11.0, 9.5))


def slip_percent(column: Column, radius_m: float, axle: int) -> np.ndarray:
    """Slip of an axle as its sensor tells it, % of the vehicle's speed, (n,); NaN where that is below 1 m/s."""
    speed = column("vehicle_speed_m_s")
    speed = np.where(speed >= _SLOWEST_M_S, speed, np.nan)
    return 100.0 * (1.0 - radius_m * column(f"measured_speed_{axle}_rad_s") / speed)


def axles(record: Record) -> tuple[tuple[str, ...], list[list[str]]]:
    """Head and rows of what each axle did over the braking."""
    radius_m = record.scenario["vehicle"]["wheel_radius_m"]
    rows = []
    for axle in range(1, AXLES + 1):
        sliding = record.braked("vehicle_speed_m_s") - radius_m * record.braked(
            f"measured_speed_{axle}_rad_s"
        )
        slip = slip_percent(record.braked, radius_m, axle)
        pressure = record.braked(f"cylinder_pressure_{axle}_Pa") / 1e5
        rows.append(
            [
                str(axle),
                f"{3.6 * sliding.mean():z.1f}",
                f"{3.6 * sliding.max():z.1f}",
                f"{np.nanmax(slip, initial=0.0):.0f}",
                _final(record.finals, "longest_lock", axle, 1.0, 2),
                f"{pressure.mean():.2f}",
                f"{record.braked(f'adhesion_{axle}').mean():.3f}",
                _final(record.finals, "vents", axle, 1.0, 0),
                _final(record.finals, "sliding_work", axle, 1e-6, 2),
                _final(record.finals, "flat_length", axle, 1e3, 1),
            ]
        )
    return (
        "axle",
        "mean sliding, km/h",
        "largest, km/h",
        "largest slip, %",
        "longest lock, s",
        "mean cylinder, bar",
        "mean adhesion",
        "vents",
        "energy of sliding, MJ",
        "flat, mm",
    ), rows


def _final(finals: Mapping[str, Any], name: str, axle: int, factor: float, places: int) -> str:
    return f"{factor * finals[name][axle - 1]:.{places}f}" if name in finals else "-"


def _draw(figure: Figure, column: Column, radius_m: float, marks: Sequence[Mark]) -> None:
    time_s = column("time_s")
    plots = figure.subplots(5, 1, sharex=True, height_ratios=(3, 2.4, 3, 3, 2))
    speed, slip, pressure, adhesion, valves = plots
    for axle, colour in enumerate(page.AXLES, start=1):
        speed.plot(
            time_s,
            3.6 * radius_m * column(f"measured_speed_{axle}_rad_s"),
            color=colour,
            label=f"axle {axle}",
        )
        slip.plot(time_s, slip_percent(column, radius_m, axle), color=colour)
        pressure.plot(time_s, 1e-5 * column(f"cylinder_pressure_{axle}_Pa"), color=colour)
        adhesion.plot(time_s, column(f"adhesion_{axle}"), color=colour)
        for state, (_, shade) in enumerate(colours.VALVE_STATES[1:], start=1):
            # the edge keeps a pulse of one cycle in sight
            valves.fill_between(
                time_s,
                axle - 0.4,
                axle + 0.4,
                column(f"valve_{axle}") == state,
                step="post",
                color=colours.on_page(shade),
                linewidth=0.5,
            )
    speed.plot(
        time_s,
        3.6 * column("wsp_reference_speed_m_s"),
        "--",
        color=page.GREY,
        label="WSP reference, brake demand",
    )
    speed.plot(time_s, 3.6 * column("vehicle_speed_m_s"), color=page.INK, label="vehicle")
    pressure.plot(time_s, 1e-5 * column("brake_demand_Pa"), "--", color=page.GREY)
    for plot, title in zip(
        plots,
        ("speeds, km/h", "slip, %", "brake cylinders, bar", "adhesion used", "valve of axle"),
        strict=True,
    ):
        plot.set_ylabel(title)
        for at_s, kind, _ in marks:
            plot.axvline(at_s, linestyle=":", color=page.VERMILION if kind == FAULT else page.GREY)
    _name(speed, marks)
    slip.set_ylim(*_SLIP_PERCENT)
    adhesion.set_ylim(0.0, None)
    figure.align_ylabels()
    valves.set(yticks=range(1, AXLES + 1), ylim=(AXLES + 0.5, 0.5), xlabel="time, s")
    lines, _ = speed.get_legend_handles_labels()
    states = [
        Patch(color=colours.on_page(shade), label=name) for name, shade in colours.VALVE_STATES[1:]
    ]
    figure.legend(handles=[*lines, *states], loc="outside upper center", ncols=8)


def _name(plot: Axes, marks: Sequence[Mark]) -> None:
    """Put what a mark is called above the plot; those of one instant share a place."""
    named: dict[float, list[Mark]] = {}
    for mark in marks:
        named.setdefault(round(mark[0], 2), []).append(mark)
    for number, (at_s, some) in enumerate(named.items()):
        if text := ", ".join(name for _, _, name in some if name):
            # neighbours stand at different heights
            plot.annotate(
                text,
                (at_s, 1.0),
                (0, 3 + 10 * (number % 3)),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                fontsize=8,
                ha="center",
                color=page.VERMILION if any(kind == FAULT for _, kind, _ in some) else page.GREY,
            )
