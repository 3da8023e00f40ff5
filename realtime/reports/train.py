"""The report of a train: distance, forces in the couplers, sliding by car, and the cleaned rail."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import write_text, writing
from rollerrig.realtime.record import channels, played, records
from rollerrig.realtime.reports import page
from rollerrig.wsp_interface import braking

REPORT = "report.html"
_CARS_HEAD = (
    "car",
    "vehicle",
    "mass, t",
    "axles",
    "brake demand, s",
    "mean sliding, m/s",
    "largest, m/s",
    "longest lock, s",
    "mean adhesion",
    "energy of sliding, MJ",
    "vents",
)
_COUPLERS_HEAD = (
    "coupler",
    "tension, kN",
    "compression, kN",
    "stretched, mm",
    "compressed, mm",
    "work, kJ",
)
# columns of the table of cars that a terminal has room for
_SHOWN = (0, 1, 5, 6, 7, 8, 10)
_SIZE_IN = (11.0, 4.0)
_COLUMNS_OF_LEGEND = 8


def write(folder: Path) -> Path:
    """Write the report of a train's run into its folder, and return its path.

    Raises ConfigError for a folder that is not of a train.
    """
    summary = records.summary(folder)
    if "couplers" not in summary:
        raise ConfigError(f"{folder} is not the run of a train; give the folder of a train's run")
    with writing(folder):
        write_text(folder / REPORT, _page(folder, summary))
    return folder / REPORT


def tables(summary: Mapping[str, Any]) -> list[Any]:
    """Return the result of a train for the terminal: a line, and the tables of its report."""
    shown = [[row[at] for at in _SHOWN] for row in _car_rows(summary)]
    return [
        sentence(summary),
        ("cars", tuple(_CARS_HEAD[at] for at in _SHOWN), shown),
        ("couplers", _COUPLERS_HEAD[:3], [row[:3] for row in _coupler_rows(summary)]),
    ]


def sentence(summary: Mapping[str, Any]) -> str:
    """Return the stop of a train in words, with that of its first car alone."""
    train = summary["train"]
    name = f"{summary['scenario']}: {train['cars']} cars, {1e-3 * train['mass_kg']:.0f} t"
    if summary["braking_distance_m"] is None:
        return f"{name}: not stopped after a brake demand in {summary['duration_s']:.1f} s"
    text = (
        f"{name}: stopped from {summary['initial_speed_m_s']:.1f} m/s in "
        f"{summary['braking_time_s']:.2f} s and {summary['braking_distance_m']:.1f} m"
    )
    alone_m = (summary["alone"] or {}).get("braking_distance_m")
    if alone_m is None:
        return text
    change = 100.0 * (summary["braking_distance_m"] / alone_m - 1.0)
    return f"{text}; its car {summary['alone']['car']} alone: {alone_m:.1f} m ({change:+.1f} %)"


def _page(folder: Path, summary: Mapping[str, Any]) -> str:
    columns = channels.Columns(folder)
    return page.page(
        summary["title"] or summary["scenario"],
        page.paragraph(sentence(summary)),
        page.facts(played.of_summary(summary).facts()),
        page.element("h2", "Cars"),
        page.table(_CARS_HEAD, _car_rows(summary)),
        page.picture(lambda figure: _draw_sliding(figure, columns, summary), _SIZE_IN),
        page.element("h2", "Couplers"),
        page.table(_COUPLERS_HEAD, _coupler_rows(summary)),
        page.picture(lambda figure: _draw_couplers(figure, columns, summary), _SIZE_IN),
        page.element("h2", "The rail under each axle"),
        page.paragraph(
            "Mean friction of the contaminant under each axle, from the first to the last: the wheels "
            "ahead have cleaned the rail."
        ),
        page.picture(lambda figure: _draw_rail(figure, columns, summary), _SIZE_IN),
    )


def _car_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for number, car in enumerate(summary["cars"], start=1):
        begins_s = car["demand_begins_s"]
        rows.append(
            [
                str(number),
                car["vehicle"],
                f"{1e-3 * car['mass_kg']:.1f}",
                f"{car['axles'][0]} to {car['axles'][1]}",
                "-" if begins_s is None else f"{begins_s:.2f}",
                f"{car['sliding_mean_m_s']:.2f}",
                f"{car['sliding_max_m_s']:.2f}",
                f"{car['longest_lock_s']:.2f}",
                f"{car['adhesion_mean']:.3f}",
                f"{1e-6 * car['dissipated_energy_J']:.2f}",
                f"{car['vents']}",
            ]
        )
    return rows


def _coupler_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for number, one in enumerate(summary["couplers"], start=1):
        rows.append(
            [
                f"{number}",
                f"{1e-3 * one['tension_max_N']:z.1f}",
                f"{1e-3 * one['compression_max_N']:z.1f}",
                f"{1e3 * one['stretched_max_m']:z.1f}",
                f"{1e3 * one['compressed_max_m']:z.1f}",
                f"{1e-3 * one['work_J']:z.2f}",
            ]
        )
    return rows


def _lines(
    plot: Axes, time_s: np.ndarray, curves: Sequence[tuple[str, np.ndarray]], unit: str
) -> None:
    """Draw curves over time, with a legend beside them."""
    for number, (name, values) in enumerate(curves):
        colour = page.RUNS[number % len(page.RUNS)]
        style = ("-", "--", ":")[number // len(page.RUNS) % 3]
        plot.plot(time_s, values, color=colour, linestyle=style, label=name)
    plot.set_xlabel("time, s")
    plot.set_ylabel(unit)
    if curves:
        plot.legend(ncols=_COLUMNS_OF_LEGEND, loc="lower left", bbox_to_anchor=(0.0, 1.0))


def _until_standstill(columns: channels.Columns) -> tuple[np.ndarray, slice]:
    """Return the times of a stop, and the samples until standstill."""
    speed_m_s = channels.values(columns["vehicle_speed_m_s"])
    end = braking.standstill(speed_m_s)
    kept = slice(0, end + 1) if end else slice(None)
    return channels.values(columns["time_s"])[kept], kept


def _draw_sliding(figure: Figure, columns: channels.Columns, summary: Mapping[str, Any]) -> None:
    time_s, kept = _until_standstill(columns)
    curves = []
    for number, car in enumerate(summary["cars"], start=1):
        axles = range(car["axles"][0], car["axles"][1] + 1)
        of_axles = [channels.values(columns[f"sliding_{axle}_m_s"])[kept] for axle in axles]
        curves.append((f"car {number}", np.mean(of_axles, axis=0)))
    _lines(figure.subplots(), time_s, curves, "mean sliding, m/s")


def _draw_couplers(figure: Figure, columns: channels.Columns, summary: Mapping[str, Any]) -> None:
    time_s, kept = _until_standstill(columns)
    curves = []
    for number in range(1, len(summary["couplers"]) + 1):
        force_N = channels.values(columns[f"coupler_{number}_N"])[kept]
        curves.append((f"coupler {number}", 1e-3 * force_N))
    _lines(figure.subplots(), time_s, curves, "force, kN (tension positive)")


def _draw_rail(figure: Figure, columns: channels.Columns, summary: Mapping[str, Any]) -> None:
    _, kept = _until_standstill(columns)
    axles = range(1, len(summary["axles"]) + 1)
    means = [
        float(np.mean(channels.values(columns[f"friction_degraded_{axle}"])[kept]))
        for axle in axles
    ]
    plot = figure.subplots()
    plot.bar(list(axles), means, color=page.BASE)
    plot.set_xlabel("axle")
    # no halves of axles
    plot.xaxis.set_major_locator(MaxNLocator(integer=True))
    plot.set_ylabel("mean friction of the contaminant")
