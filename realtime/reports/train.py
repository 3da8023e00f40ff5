"""The report of a train, and its pictures: by car over time, its couplers, and the cleaned rail."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import write_text, writing
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record import cars, played, records
from rollerrig.realtime.record.cars import Car, Column
from rollerrig.realtime.record.records import Run
from rollerrig.realtime.reports import page
from rollerrig.wsp_interface import braking

REPORT = "report.html"
_CARS_HEAD = (
    "car",
    "vehicle",
    "mass, t",
    "axles",
    "brake demand from, s",
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
_STOP_SIZE_IN = (11.0, 8.0)
# a figure, or a part of it with plots of its own
AnyFigure = Figure | SubFigure

# friction mu_cd; a smaller difference is not drawn
_LEAST_SPREAD = 1e-6
_KM_H_PER_M_S = 3.6
_PA_PER_BAR = 1e5
_COLUMNS_OF_LEGEND = 10
_DEMAND: dict[str, Any] = {"color": page.GREY, "linestyle": "--", "linewidth": 1.3}


class Stop(NamedTuple):
    """What is drawn of a train: its channels until standstill, its cars and its summary."""

    column: Column
    cars: Sequence[Car]
    summary: Mapping[str, Any]
    has_pipe: bool

    @property
    def time_s(self) -> np.ndarray:
        """Shape (n,)."""
        return self.column("time_s")


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
    run = records.load(folder)
    return page.page(
        summary["title"] or summary["scenario"],
        page.paragraph(sentence(summary)),
        page.facts(played.of_summary(summary).facts() | conditions(summary, run.scenario)),
        *parts(run),
    )


def conditions(summary: Mapping[str, Any], scenario: Mapping[str, Any]) -> dict[str, str]:
    """Return the rows of what was braked, and on what, from the summary of a train's run."""
    train = summary["train"]
    control = train["control"].replace("_", " ")
    return {
        "train": f"{train['cars']} cars, {train['length_m']:.0f} m, {control}",
        "load": f"{1e-3 * train['mass_kg']:g} t in all",
        "initial speed": f"{_KM_H_PER_M_S * summary['initial_speed_m_s']:.0f} km/h",
        "adhesion": str(scenario.get("adhesion_set", played.NOT_STATED)),
    }


def parts(run: Run) -> list[page.Markup]:
    """Return tables and pictures of the cars, the couplers and the rail of a recorded train."""
    summary = run.summary
    stop = _stop_of(run)
    couplers: list[page.Markup] = []
    if len(stop.cars) > 1:
        couplers = [
            page.element("h2", "Couplers"),
            page.table(_COUPLERS_HEAD, _coupler_rows(summary)),
            page.picture(lambda figure: _draw_couplers(figure, stop), _SIZE_IN),
        ]
    return [
        page.element("h2", "Cars"),
        page.table(_CARS_HEAD, _car_rows(summary)),
        page.picture(lambda figure: _draw_stop(figure, stop), _STOP_SIZE_IN),
        *couplers,
        page.element("h2", "The rail under each axle"),
        page.paragraph(
            "The wheels ahead have cleaned the rail: means until standstill for each axle, from the "
            "first to the last. The adhesion used also depends on the load and the brake of the car."
        ),
        page.picture(lambda figure: _draw_axles(figure, stop), _SIZE_IN),
        *_rail(stop),
    ]


def _rail(stop: Stop) -> list[page.Markup]:
    """Return the part on the rail place by place; none where its friction is equal everywhere."""
    if not _is_cleaned(stop):
        return []
    return [
        page.element("h2", "The rail place by place"),
        page.paragraph(
            "A row is an axle. Its colour at a place is the friction of the contaminant that this axle "
            "met there, after all axles above it had passed. Without a colour, the axle has not been "
            "there."
        ),
        page.picture(lambda figure: _draw_rail(figure, stop), _SIZE_IN),
    ]


def _car_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for number, car in enumerate(summary["cars"], start=1):
        begins_s = car["demand_begins_s"]
        begins = "-" if begins_s is None else f"{begins_s:.2f}"
        rows.append(
            [
                str(number),
                car["vehicle"],
                f"{1e-3 * car['mass_kg']:.1f}",
                f"{car['axles'][0]} to {car['axles'][1]}",
                "isolated" if car.get("isolated") else begins,
                f"{car['sliding_mean_m_s']:z.2f}",
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


# --- pictures ---


def _stop_of(run: Run) -> Stop:
    """Return what is drawn of a recorded train. Raises ConfigError for another run."""
    of_train = cars.cars(run.summary)
    end = braking.standstill(run.column("vehicle_speed_m_s"))
    kept = slice(0, end + 1) if end else slice(None)
    return Stop(
        lambda name: run.column(name)[kept],
        of_train,
        run.summary,
        "car_1_brake_pipe_Pa" in run.table.column_names,
    )


def write_picture(run: Run, out: Path) -> list[Path]:
    """Write the picture of a train's run as SVG, and return its path. Raises ConfigError."""
    write_text(out, str(page.picture(lambda figure: draw(figure, run), (11.0, 11.0))))
    return [out]


def draw(figure: Figure, run: Run) -> None:
    """Draw a train's stop, its couplers, and the rail under its axles in one picture."""
    stop = _stop_of(run)
    over_time, along = figure.subfigures(2, 1, height_ratios=(5, 2))
    plots = _plots_over_time(over_time, stop, with_couplers=len(stop.cars) > 1)
    _legend(over_time, stop, plots, str(run.summary["scenario"]))
    # the legend above has the colours of the cars
    _draw_axles(along, stop, with_legend=False)


def _draw_stop(figure: Figure, stop: Stop) -> None:
    """Draw speed, sliding, cylinder pressures and adhesion by car over time."""
    plots = _plots_over_time(figure, stop, with_couplers=False)
    _legend(figure, stop, plots)


def _draw_couplers(figure: Figure, stop: Stop) -> None:
    """Draw the force of each coupler over time."""
    plot = figure.subplots()
    for car in stop.cars[:-1]:
        force_N = stop.column(f"coupler_{car.number}_N")
        name = f"cars {car.number} and {car.number + 1}"
        plot.plot(stop.time_s, 1e-3 * force_N, label=name, **_line(car))
    plot.set(
        xlim=(stop.time_s[0], stop.time_s[-1]),
        xlabel="time, s",
        ylabel="force, kN,\ntension positive",
    )
    if len(stop.cars) > 1:
        figure.legend(loc="outside upper center", ncols=_COLUMNS_OF_LEGEND // 2)


def _draw_axles(figure: AnyFigure, stop: Stop, with_legend: bool = True) -> None:
    """Draw the mean friction of the contaminant and the adhesion used, by axle."""
    friction, adhesion = figure.subplots(2, 1, sharex=True)
    for car in stop.cars:
        axles = list(car.axles)
        colour = colours.as_hex(colours.CARS[car.number - 1])
        met = [float(np.mean(stop.column(f"friction_degraded_{axle}"))) for axle in axles]
        used = [stop.summary["axles"][axle - 1]["adhesion_mean"] for axle in axles]
        friction.bar(axles, met, color=colour, label=f"car {car.number}")
        adhesion.bar(axles, used, color=colour)
    friction.set_ylabel("mean friction of\nthe contaminant")
    adhesion.set(ylabel="mean adhesion\nused", xlabel="axle, from the front of the train")
    last = stop.cars[-1].axles[-1]
    adhesion.set_xlim(0.4, last + 0.6)
    adhesion.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.align_ylabels()
    if with_legend:
        figure.legend(loc="outside upper center", ncols=_COLUMNS_OF_LEGEND)


def _is_cleaned(stop: Stop) -> bool:
    """Return whether the friction that axles met differs: only then a picture shows anything."""
    friction = cars.rail(stop.column, list(stop.cars)).friction
    return float(np.nanmax(friction) - np.nanmin(friction)) > _LEAST_SPREAD


def _draw_rail(figure: Figure, stop: Stop) -> None:
    """Draw the friction that each axle has met at each place of the rail."""
    rail = cars.rail(stop.column, list(stop.cars))
    plot = figure.subplots()
    axles = len(rail.friction)
    image = plot.imshow(
        rail.friction,
        aspect="auto",
        interpolation="nearest",
        extent=(rail.place_m[0], rail.place_m[-1], axles + 0.5, 0.5),
        cmap="cividis",
    )
    figure.colorbar(image, ax=plot, label="friction of the contaminant mu_cd", pad=0.01)
    for car in stop.cars[1:]:
        plot.axhline(car.axles[0] - 0.5, color="white", linewidth=0.6)
    plot.grid(visible=False)
    plot.yaxis.set_major_locator(MaxNLocator(integer=True))
    plot.set(xlabel="place on the rail, m", ylabel="axle, in the order of passing")


def _line(car: Car) -> dict[str, Any]:
    """Return how the lines of a car are drawn: colour, and kind where colours repeat."""
    dashes = colours.CAR_DASHES[car.number - 1]
    colour = colours.as_hex(colours.CARS[car.number - 1])
    return {"color": colour, "linestyle": (0, dashes) if dashes else "-"}


def _plots_over_time(figure: AnyFigure, stop: Stop, with_couplers: bool) -> list[Axes]:
    """Draw quantities by car over time, one below another; return the plots."""
    titles = ["speed,\nkm/h", "mean sliding,\nm/s", "mean cylinder,\nbar", "mean adhesion\nused"]
    if stop.has_pipe:
        titles.append("brake pipe,\nbar")
    if with_couplers:
        titles.append("couplers, kN,\ntension positive")
    plots = list(figure.subplots(len(titles), 1, sharex=True))
    speed, sliding, pressure, adhesion, *further = plots
    for plot, title in zip(plots, titles, strict=True):
        plot.set_ylabel(title)

    column = stop.column
    time_s = stop.time_s
    for car in stop.cars:
        line = _line(car)
        speed.plot(time_s, _KM_H_PER_M_S * column(f"car_{car.number}_speed_m_s"), **line)
        sliding.plot(time_s, car.mean(column, "sliding", "m_s"), **line)
        cylinder_Pa = car.mean(column, "cylinder_pressure", "Pa")
        pressure.plot(time_s, cylinder_Pa / _PA_PER_BAR, **line)
        adhesion.plot(time_s, car.mean(column, "adhesion"), **line)
        if stop.has_pipe:
            pipe_Pa = column(f"car_{car.number}_brake_pipe_Pa")
            further[0].plot(time_s, pipe_Pa / _PA_PER_BAR, **line)
        if with_couplers and car is not stop.cars[-1]:
            further[-1].plot(time_s, 1e-3 * column(f"coupler_{car.number}_N"), **line)
    train_kmh = _KM_H_PER_M_S * column("vehicle_speed_m_s")
    speed.plot(time_s, train_kmh, color=page.INK, linewidth=0.6)
    for number in sorted({1, len(stop.cars)}):
        demand_Pa = column(f"car_{number}_brake_demand_Pa")
        pressure.plot(time_s, demand_Pa / _PA_PER_BAR, **_DEMAND)
    plots[-1].set(xlabel="time, s", xlim=(time_s[0], time_s[-1]))
    figure.align_ylabels()
    return plots


def _legend(figure: AnyFigure, stop: Stop, plots: Sequence[Axes], title: str = "") -> None:
    """Write one legend for all plots: the cars, and what is not of a car."""
    handles = [Line2D([], [], label=f"car {car.number}", **_line(car)) for car in stop.cars]
    handles += [
        Line2D([], [], color=page.INK, linewidth=0.6, label="train"),
        Line2D([], [], label="brake demand, first and last car", **_DEMAND),
    ]
    if title:
        title = f"{title}; a coupler has the colour of the car ahead of it"
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=_COLUMNS_OF_LEGEND,
        title=title or None,
    )
