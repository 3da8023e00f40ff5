"""The picture and the table of one stop: what each axle did, with steps of the test and faults
marked.

Both show the true motion. Where the measured speed of an axle differs from it, the picture has the
measured speed as a thin dotted line. The table has separate rows of what follows from the measured
speeds; these are marked as measured.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.textpath import TextPath

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, write_bytes, write_text, writing
from rollerrig.configs.vehicle import Kind
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record import brake_work, run_folder
from rollerrig.realtime.record.records import Run
from rollerrig.realtime.reports import friction_changes, page, train
from rollerrig.realtime.reports.friction_changes import AnyEvent
from rollerrig.realtime.reports.page import Markup
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.sequences import measures
from rollerrig.wsp_interface.sequences.record import Record

# a recorded signal by name
Column = Callable[[str], np.ndarray]

# kinds of marks
STEP = "step"
FAULT = "fault"
FRICTION = "friction"

# what the legend says of each kind of mark
_MARK_TITLES = {
    STEP: "step of the test",
    FAULT: "fault begins, or is lifted",
    FRICTION: "friction of the rail changes",
}
# colour and kind of line of each kind of mark
_MARK_LINES: dict[str, tuple[str, Any]] = {
    STEP: (page.GREY, ":"),
    FAULT: (page.VERMILION, ":"),
    FRICTION: (colours.as_hex(colours.BROWN), "-."),
}

# m/s. Below it slip is not shown.
_SLOWEST_M_S = 1.0

# kinds of files of a picture, and the pixels of an inch of a PNG
_PICTURE_KINDS = ("png", "svg", "pdf")
_SCREEN_DPI = 100

# m/s. A sound sensor differs less from its wheel: a count on the bus, and the lag of a pole wheel.
_MEASURED_DIFFERS_M_S = 0.5
_MEASURED_LINE: dict[str, Any] = {"linestyle": ":", "linewidth": 0.8}
_MEASURED_TITLE = "measured speed, where it differs"

# share of the largest braking force; below it the shares of the brakes are not shown
_LEAST_FORCE_SHARE = 0.02

# s. The time axis is at least so long.
_LEAST_S = 0.1

# %. The slip axis ends here.
_SLIP_PERCENT = (-10.0, 105.0)

# names of marks, in points: their size, the first row above the plot, the next rows, and a gap
_NAME_PT = 8.0
_NAME_FOOT_PT = 3.0
_NAME_ROW_PT = 11.0
_NAME_GAP_PT = 6.0
_NAME_CHARACTERS = 90

# a browser may show another font, which is wider by at most this factor
_FONT_RESERVE = 1.15

# width of the plots in points: the picture without what is left of them, for a picture of 11 in
_PLOT_PT = 735.0

_AXLES_HEAD = (
    "axle",
    "mean sliding, m/s",
    "largest, m/s",
    f"largest slip above {_SLOWEST_M_S:g} m/s, %",
    "longest lock above {lock:g} m/s, s",
    "mean cylinder, bar",
    "mean adhesion",
    "vents",
    "energy of sliding, MJ",
    "flat, mm",
)


_BRAKES_HEAD = ("brake", "work, MJ", "share of the work, %", "largest force, kN")
# colour and kind of line of each brake: they are those of no axle
_BRAKE_LINES = {
    brake_work.FRICTION: (colours.VERMILION, "-"),
    brake_work.MOTORS: (colours.BLUE, "--"),
    brake_work.MAGNETS: (colours.BROWN, "-."),
}

# height in inches of the picture of a stop with four axles; of each further axle, and of the plot
# of brakes
_HEIGHT_IN = 9.5
_HEIGHT_OF_AXLE_IN = 0.25
_HEIGHT_OF_BRAKES_IN = 1.6
_AXLES_OF_HEIGHT = 4


class Mark(NamedTuple):
    """A vertical line in the picture."""

    time_s: float
    kind: str  # STEP, FAULT or FRICTION
    name: str


class Motion(NamedTuple):
    """What is drawn of a stop: the kind of its vehicle, its channels, the radius of its wheels."""

    kind: Kind
    column: Column
    radius_m: float

    @property
    def axles(self) -> range:
        """The axles of the vehicle, counted from 1."""
        return range(1, self.kind.axles + 1)

    @property
    def forces_N(self) -> dict[str, np.ndarray]:
        """The force of each brake on the vehicle, shape (n,)."""
        return brake_work.forces_N(self.kind, self.column, self.radius_m)

    @property
    def has_brakes(self) -> bool:
        """Whether these channels have the forces of motors or magnets."""
        if not brake_work.brakes(self.kind):
            return False
        try:
            brake_work.forces_N(self.kind, self.column, 1.0)
        except (KeyError, ConfigError):
            return False  # a harness does not receive these channels
        return True


def motion_of(run: Run) -> Motion:
    """Return what is drawn of a recorded run."""
    return Motion(run.kind, run.column, run.scenario["vehicle"]["wheel_radius_m"])


def motion_of_record(record: Record) -> Motion:
    """Return what is drawn of a sequence that was played."""
    radius_m = record.scenario["vehicle"]["wheel_radius_m"]
    return Motion(record.kind, record.columns.__getitem__, radius_m)


def write(run: Run, out: Path) -> list[Path]:
    """Write the picture of a recorded run, and return its path. Raises OSError."""
    if run.is_train:
        return train.write_picture(run, out)
    write_text(out, str(picture(motion_of(run), _marks_of(run))))
    return [out]


def picture(motion: Motion, marks: Sequence[Mark]) -> Markup:
    """Return speeds, slip, pressures, adhesion and valves over time, as SVG."""
    height_in = _HEIGHT_IN + _HEIGHT_OF_AXLE_IN * max(motion.kind.axles - _AXLES_OF_HEIGHT, 0)
    if motion.has_brakes:
        height_in += _HEIGHT_OF_BRAKES_IN
    return page.picture(lambda figure: draw(figure, motion, marks), (11.0, height_in))


def brakes(summary: Mapping[str, Any]) -> tuple[tuple[str, ...], list[list[str]]]:
    """Return head and rows of what each brake of a summary did.

    There are no rows for a vehicle that has friction brakes only.
    """
    rows = []
    for brake, figures in (summary.get("brakes") or {}).items():
        rows.append(
            [
                brake_work.TITLES[brake],
                _scaled(figures["work_J"], 1e-6, 2),
                _scaled(figures["share"], 100.0, 0),
                _scaled(figures["force_max_N"], 1e-3, 1),
            ]
        )
    return _BRAKES_HEAD, rows


def brakes_picture(motion: Motion) -> Markup:
    """Return the force and the share of each brake over time, as SVG."""
    return page.picture(lambda figure: _draw_brakes_alone(figure, motion), (11.0, 4.5))


def _scaled(value: float | None, factor: float, places: int) -> str:
    return "-" if value is None else f"{factor * value:.{places}f}"


def slip_percent(sliding_m_s: np.ndarray, vehicle_m_s: np.ndarray) -> np.ndarray:
    """Return the slip in % of the vehicle's speed, shape (n,).

    It is NaN where the vehicle is slower than 1 m/s.
    """
    speed_m_s = np.where(vehicle_m_s >= _SLOWEST_M_S, vehicle_m_s, np.nan)
    return 100.0 * sliding_m_s / speed_m_s


# --- table ---


def axles(record: Record) -> tuple[tuple[str, ...], list[list[str]], list[str]]:
    """Return head, rows and classes of the rows of what each axle did during the braking.

    The rows of all axles are followed by those of what the speed sensors measured.
    """
    true_m_s = measures.sliding(record)
    measured_m_s = measures.measured_sliding(record)
    rows = []
    classes = []
    for axle, sliding_m_s in enumerate(true_m_s, start=1):
        slid = _sliding_cells(record, sliding_m_s)
        rows.append([str(axle), *slid, *_other_cells(record, axle)])
        classes.append("")
    for axle, sliding_m_s in enumerate(measured_m_s, start=1):
        slid = _sliding_cells(record, sliding_m_s)
        no_others = ["-"] * (len(_AXLES_HEAD) - 1 - len(slid))
        rows.append([f"{axle}, as measured", *slid, *no_others])
        classes.append("void")
    lock_above_m_s = record.scenario["rig"]["lock_above_m_s"]
    head = tuple(title.format(lock=lock_above_m_s) for title in _AXLES_HEAD)
    return head, rows, classes


def lock_note(record: Record) -> str:
    """Return why a wheel may have a slip of 100 % and no lock in the table of axles."""
    lock_above_m_s = record.scenario["rig"]["lock_above_m_s"]
    return (
        f"Slip counts while the vehicle is faster than {_SLOWEST_M_S:g} m/s, a lock only while it is "
        f"faster than {lock_above_m_s:g} m/s: a wheel that locks below {lock_above_m_s:g} m/s has a "
        "slip of 100 % and no lock."
    )


def _sliding_cells(record: Record, sliding_m_s: np.ndarray) -> list[str]:
    """Return mean and largest sliding, and the largest slip.

    There are none while a sensor has sent nothing.
    """
    if np.isnan(sliding_m_s).all():
        return ["-"] * 3
    slip = slip_percent(sliding_m_s, record.braked("vehicle_speed_m_s"))
    return [
        f"{np.nanmean(sliding_m_s):z.2f}",
        f"{np.nanmax(sliding_m_s):z.2f}",
        f"{np.nanmax(slip, initial=0.0):.0f}",
    ]


def _other_cells(record: Record, axle: int) -> list[str]:
    """Return the cells of an axle that are not about sliding."""
    pressure_bar = record.braked(f"cylinder_pressure_{axle}_Pa") / 1e5
    adhesion = record.braked(f"adhesion_{axle}")
    return [
        _final(record.finals, "longest_lock", axle, 1.0, 2),
        f"{pressure_bar.mean():.2f}",
        f"{adhesion.mean():.3f}",
        _final(record.finals, "vents", axle, 1.0, 0),
        _final(record.finals, "sliding_work", axle, 1e-6, 2),
        _final(record.finals, "flat_length", axle, 1e3, 1),
    ]


def _final(finals: Mapping[str, Any], name: str, axle: int, factor: float, places: int) -> str:
    """Return the final value of an axle, scaled; "-" if it was not recorded."""
    if name not in finals:
        return "-"
    return f"{factor * finals[name][axle - 1]:.{places}f}"


# --- picture ---


class _Look(NamedTuple):
    """How one run is drawn among others."""

    width: float  # of its lines, in points
    marker: str  # on its lines; "" for none
    lane: float  # where its valves begin in the lane of an axle, from -0.4 to 0.4
    lane_height: float


_ALONE = _Look(width=1.0, marker="", lane=-0.4, lane_height=0.8)
# markers of the second and the next runs; the lines of the first run are bold and have none
_RUN_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
# how to distinguish several runs, above the legend
_RUNS_TITLE = (
    "bold lines: first run; lines with a marker: the others (names in grey)\n"
    "each row of a valve has one part for each run, the first at the top"
)
_BOLD_PT = 1.6
_FINE_PT = 0.8
_MARKS_ON_A_LINE = 12


def write_runs(runs: Sequence[Run], out: Path, size: tuple[int, int]) -> Path:
    """Write a picture of one run or several, for reports, and return its path.

    The picture is light and has a legend that names the runs. The suffix of `out` is .png, .svg or
    .pdf; `size` is width and height in pixels of a PNG. Raises ConfigError, OSError.
    """
    kind = out.suffix.lower().removeprefix(".")
    if kind not in _PICTURE_KINDS:
        allowed = ", ".join(f".{name}" for name in _PICTURE_KINDS)
        raise ConfigError(f"{out}: a picture of this kind cannot be written; allowed are {allowed}")
    trains = [run for run in runs if run.is_train]
    if trains and len(runs) > 1:
        raise ConfigError(
            f"{trains[0].folder} is the run of a train, which is drawn alone; allowed with other runs "
            "are its cars, in the folders car_1, car_2 ..."
        )
    width, height = size
    inches = (width / _SCREEN_DPI, height / _SCREEN_DPI)

    def draw_all(figure: Figure) -> None:
        if trains:
            train.draw(figure, trains[0])
        else:
            draw_runs(figure, runs)

    content = page.picture_file(draw_all, inches, kind, _SCREEN_DPI)
    with writing(out, "give another file with --png"):
        make_folder(out.parent)
        write_bytes(out, content)
    return out


def draw_runs(figure: Figure, runs: Sequence[Run]) -> None:
    """Draw one run or several over one another, with a legend that names each."""
    motions = [motion_of(run) for run in runs]
    axles = max(motion.kind.axles for motion in motions)
    plots = _plots(figure, axles, all(motion.has_brakes for motion in motions))
    looks = _looks(len(runs))
    for run, motion, look in zip(runs, motions, looks, strict=True):
        _draw_run(plots, motion, look)
        _draw_marks(plots, _marks_of(run))
    longest = max(runs, key=lambda run: float(run.column("time_s").max(initial=0.0)))
    marks = _marks_of(runs[0]) if len(runs) == 1 else []
    _finish(plots, axles, longest.column("time_s"), marks)

    names = _run_names(runs)
    handles = _handles(plots, [mark for run in runs for mark in _marks_of(run)])
    # the name of a single run is the title of the legend: a title of the figure would be drawn over
    # the legend
    title = names[0]
    if len(runs) > 1:
        title = _RUNS_TITLE
        for name, look in zip(names, looks, strict=True):
            # grey, because black is the line of the vehicle
            handles.append(
                Line2D([], [], color=page.GREY, lw=look.width, marker=look.marker, label=name)
            )
    figure.legend(handles=handles, loc="outside upper center", ncols=6, title=title)


def fault_marks(events: Iterable[AnyEvent]) -> list[Mark]:
    """Return when faults began and were lifted, by the events of the bench."""
    found = []
    for event in events:
        if event.code == Code.FAULT_BEGINS:
            found.append(Mark(event.time_s, FAULT, fault_words(event.fields["fault"])))
        elif event.code == Code.FAULT_LIFTED:
            words = fault_words(event.fields["fault"])
            found.append(Mark(event.time_s, FAULT, f"{words} lifted"))
    return found


def fault_words(text: str) -> str:
    """Return a fault, written as in a scenario, in words: "speed sensor stuck, axle 2"."""
    fault, *values = text.split(" ")
    words = [value.replace("=", " ").replace("_", " ") for value in values]
    return ", ".join([fault.replace("_", " "), *words])


def friction_marks(
    scenario: Mapping[str, Any], events: Iterable[AnyEvent], column: Column
) -> list[Mark]:
    """Return when the friction of the rail changed, for a resolved scenario."""
    found = []
    for change in friction_changes.changes(scenario, events, column):
        if np.isfinite(change.time_s):
            found.append(Mark(change.time_s, FRICTION, change.name))
    return found


def _marks_of(run: Run) -> list[Mark]:
    """Return the marks of a recorded run: its faults and the changes of its friction."""
    return [*fault_marks(run.events), *friction_marks(run.scenario, run.events, run.column)]


def _draw_marks(plots: Iterable[Axes], marks: Iterable[Mark]) -> None:
    """Draw a vertical line through all plots for each mark."""
    for mark in marks:
        colour, kind = _MARK_LINES[mark.kind]
        for plot in plots:
            plot.axvline(mark.time_s, linestyle=kind, linewidth=1.0, color=colour)


def _looks(count: int) -> list[_Look]:
    """Return how each of some runs is drawn."""
    if count == 1:
        return [_ALONE]
    height = 0.8 / count
    looks = []
    for number in range(count):
        marker = _RUN_MARKERS[(number - 1) % len(_RUN_MARKERS)] if number else ""
        width = _FINE_PT if number else _BOLD_PT
        looks.append(_Look(width, marker, -0.4 + height * number, 0.9 * height))
    return looks


def _run_names(runs: Sequence[Run]) -> list[str]:
    """Return what the legend says of each run: its folder, scenario and unit."""
    names = run_folder.short_names([run.folder for run in runs])
    described = []
    for name, run in zip(names, runs, strict=True):
        wsp = run.summary.get("wsp") or {}
        words = [str(run.summary.get("scenario") or ""), f"unit {wsp.get('unit') or '-'}"]
        if run.summary.get("valid") is False:
            words.append("not valid")
        described.append(f"{name} ({', '.join(filter(None, words))})")
    return described


def draw(figure: Figure, motion: Motion, marks: Sequence[Mark]) -> None:
    """Draw speeds, slip, pressures, adhesion and valves over time."""
    axles = motion.kind.axles
    plots = _plots(figure, axles, motion.has_brakes)
    _draw_run(plots, motion, _ALONE)
    _draw_marks(plots, marks)
    _finish(plots, axles, motion.column("time_s"), marks)
    figure.legend(handles=_handles(plots, marks), loc="outside upper center", ncols=7)


def _plots(figure: Figure, axles: int, with_brakes: bool) -> list[Axes]:
    """Return the empty plots: speeds, slip, pressures, adhesion, valves, and that of the brakes."""
    valves_share = 2.0 * max(axles / _AXLES_OF_HEIGHT, 1.0)
    ratios = [3.0, 2.4, 3.0, 3.0, valves_share]
    if not with_brakes:
        return list(figure.subplots(5, 1, sharex=True, height_ratios=ratios))
    # the forces of the brakes are below the pressures
    ratios.insert(3, 3.0)
    speed, slip, pressure, brakes_plot, adhesion, valves = figure.subplots(
        6, 1, sharex=True, height_ratios=ratios
    )
    return [speed, slip, pressure, adhesion, valves, brakes_plot]


def _draw_brakes_alone(figure: Figure, motion: Motion) -> None:
    """Draw the force of each brake, and below it the share of each."""
    forces, shares = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    time_s = motion.column("time_s")
    _draw_brakes(forces, motion, _ALONE)
    found = motion.forces_N
    total_N = np.sum(list(found.values()), axis=0)
    braking = total_N > _LEAST_FORCE_SHARE * np.max(total_N, initial=0.0)
    for brake, force_N in found.items():
        colour, kind = _BRAKE_LINES[brake]
        share_percent = np.full(len(time_s), np.nan)
        share_percent[braking] = 100.0 * force_N[braking] / total_N[braking]
        shares.plot(time_s, share_percent, kind, color=colours.as_hex(colour), lw=_ALONE.width)
    forces.set_ylabel("brake forces, kN")
    shares.set(ylabel="share, %", ylim=(-5.0, 105.0), xlabel="time, s")
    figure.align_ylabels()
    figure.legend(handles=_handles_of_brakes(forces), loc="outside upper center", ncols=4)


def _draw_brakes(plot: Axes, motion: Motion, look: _Look) -> None:
    """Draw the force of each brake on the vehicle."""
    time_s = motion.column("time_s")
    every = max(len(time_s) // _MARKS_ON_A_LINE, 1)
    for brake, force_N in motion.forces_N.items():
        colour, kind = _BRAKE_LINES[brake]
        plot.plot(
            time_s,
            1e-3 * force_N,
            kind,
            color=colours.as_hex(colour),
            label=brake_work.TITLES[brake],
            lw=look.width,
            marker=look.marker,
            ms=4,
            markevery=every,
        )


def _handles_of_brakes(plot: Axes) -> list[Any]:
    """Return the entries of the legend for the brakes, one for each."""
    lines, labels = plot.get_legend_handles_labels()
    first = {label: line for line, label in zip(reversed(lines), reversed(labels), strict=True)}
    return [first[label] for label in dict.fromkeys(labels)]


def _draw_run(plots: Any, motion: Motion, look: _Look) -> None:
    """Draw what the axles did in one run; each axle has a colour and a kind of line."""
    speed, slip, pressure, adhesion, valves, *brakes_plots = plots
    for plot in brakes_plots:
        _draw_brakes(plot, motion, look)
    column = motion.column
    time_s = column("time_s")
    vehicle_m_s = column("vehicle_speed_m_s")
    every = max(len(time_s) // _MARKS_ON_A_LINE, 1)
    common: dict[str, Any] = {"lw": look.width, "marker": look.marker, "ms": 4}
    for axle in motion.axles:
        colour = page.AXLES[axle - 1]
        dashes = colours.AXLE_DASHES[axle - 1]
        first_marker = every * axle // (motion.kind.axles + 1)
        line = common | {
            "color": colour,
            "ls": (0, dashes) if dashes else "-",
            "markevery": (first_marker, every),
        }
        wheel_m_s = column(f"wheel_circumferential_speed_{axle}_m_s")
        measured_m_s = motion.radius_m * column(f"measured_speed_{axle}_rad_s")
        sliding_m_s = column(f"sliding_{axle}_m_s")
        speed.plot(time_s, 3.6 * wheel_m_s, label=f"axle {axle}", **line)
        _draw_measured(speed, time_s, wheel_m_s, measured_m_s, colour)
        slip.plot(time_s, slip_percent(sliding_m_s, vehicle_m_s), **line)
        pressure.plot(time_s, 1e-5 * column(f"cylinder_pressure_{axle}_Pa"), **line)
        adhesion.plot(time_s, column(f"adhesion_{axle}"), **line)
        _draw_valve(valves, time_s, column(f"valve_{axle}"), axle, look)

    line = common | {"markevery": every}
    reference_kmh = 3.6 * column("wsp_reference_speed_m_s")
    name = "reference speed of the unit"
    speed.plot(time_s, reference_kmh, "--", color=page.GREY, label=name, **line)
    speed.plot(time_s, 3.6 * vehicle_m_s, color=page.INK, label="vehicle", **line)
    demand_bar = 1e-5 * column("brake_demand_Pa")
    pressure.plot(time_s, demand_bar, "-.", color=page.GREY, label="brake demand", **line)


def _finish(plots: Any, axles: int, time_s: np.ndarray, marks: Sequence[Mark]) -> None:
    """Name the axes, set their ranges and write the names of the marks."""
    speed, slip, _, adhesion, valves, *_ = plots
    titles = (
        *("speeds, km/h", "slip, %", "brake cylinders, bar", "adhesion used", "valve of axle"),
        "brake forces, kN",
    )
    # the last plot is there only if the vehicle has motors or magnets
    for plot, title in zip(plots, titles, strict=False):
        plot.set_ylabel(title)
    if len(time_s):
        speed.set_xlim(time_s[0], max(time_s[-1], time_s[0] + _LEAST_S))
    _write_names(speed, marks)
    slip.set_ylim(*_SLIP_PERCENT)
    adhesion.set_ylim(0.0, None)
    speed.figure.align_ylabels()
    valves.set(yticks=range(1, axles + 1), ylim=(axles + 0.5, 0.5), xlabel="time, s")


def _handles(plots: Any, marks: Iterable[Mark]) -> list[Any]:
    """Return the entries of the legend that all runs share, one for each kind of line."""
    lines, labels = plots[0].get_legend_handles_labels()
    of_pressures, names_of_pressures = plots[2].get_legend_handles_labels()
    lines += of_pressures
    labels += names_of_pressures
    first = {label: line for line, label in zip(reversed(lines), reversed(labels), strict=True)}
    # the entry of the measured speeds is the last one
    names = sorted(dict.fromkeys(labels), key=lambda name: name == _MEASURED_TITLE)
    if _MEASURED_TITLE in first:
        # each axle has such a line, in its colour: the legend has one entry for all
        first[_MEASURED_TITLE] = Line2D(
            [], [], color=page.GREY, label=_MEASURED_TITLE, **_MEASURED_LINE
        )
    shown: list[Any] = [first[name] for name in names]
    for plot in plots[5:]:
        shown += _handles_of_brakes(plot)
    kinds = {mark.kind for mark in marks}
    for kind, title in _MARK_TITLES.items():
        if kind in kinds:
            colour, line = _MARK_LINES[kind]
            shown.append(Line2D([], [], color=colour, linestyle=line, label=title))
    states = colours.VALVE_STATES[1:]
    return shown + [Patch(color=colours.as_hex(shade), label=name) for name, shade in states]


def _draw_measured(
    plot: Axes, time_s: np.ndarray, wheel_m_s: np.ndarray, measured_m_s: np.ndarray, colour: str
) -> None:
    """Draw a measured speed where it clearly differs from the speed of the wheel."""
    differs = np.abs(measured_m_s - wheel_m_s) > _MEASURED_DIFFERS_M_S
    if differs.any():
        shown_m_s = np.where(differs, measured_m_s, np.nan)
        plot.plot(time_s, 3.6 * shown_m_s, color=colour, label=_MEASURED_TITLE, **_MEASURED_LINE)


def _draw_valve(plot: Axes, time_s: np.ndarray, valve: np.ndarray, axle: int, look: _Look) -> None:
    """Draw where the valve of an axle holds and vents; filling is not drawn."""
    for state, (_, shade) in enumerate(colours.VALVE_STATES[1:], start=1):
        # the edge keeps a pulse of one cycle visible
        plot.fill_between(
            time_s,
            axle + look.lane,
            axle + look.lane + look.lane_height,
            valve == state,
            step="post",
            color=colours.as_hex(shade),
            linewidth=0.5,
        )


def _write_names(plot: Axes, marks: Sequence[Mark]) -> None:
    """Write the names of the marks above the plot; marks of one instant share a place.

    No two names overlap: each is in the lowest row where it has room.
    """
    marks_at: dict[float, list[Mark]] = {}
    first_s, last_s = plot.get_xlim()
    for mark in marks:
        if mark.name and first_s <= mark.time_s <= last_s:
            marks_at.setdefault(round(mark.time_s, 2), []).append(mark)

    # for each row of names, where its last name ends, in points from the left edge of the plot
    ends_pt: list[float] = []
    for time_s, together in sorted(marks_at.items()):
        text = _shortened(", ".join(mark.name for mark in together))
        width_pt = _width_pt(text)
        mark_pt = _PLOT_PT * (time_s - first_s) / (last_s - first_s)
        begin_pt = _begin_pt(mark_pt, width_pt)
        row = next(
            (row for row, end_pt in enumerate(ends_pt) if begin_pt > end_pt + _NAME_GAP_PT),
            len(ends_pt),
        )
        if row == len(ends_pt):
            ends_pt.append(0.0)
        ends_pt[row] = begin_pt + width_pt
        kinds = {mark.kind for mark in together}
        most_important = next(kind for kind in (FAULT, FRICTION, STEP) if kind in kinds)
        plot.annotate(
            text,
            (time_s, 1.0),
            (begin_pt - mark_pt, _NAME_FOOT_PT + _NAME_ROW_PT * row),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            fontsize=_NAME_PT,
            ha="left",
            color=_MARK_LINES[most_important][0],
        )


def _begin_pt(mark_pt: float, width_pt: float) -> float:
    """Return where the name of a mark begins: at its line, or so that it ends there.

    A name that has no room on either side of its line ends at the right edge of the plot, and
    begins no further left than the left edge.
    """
    if mark_pt + width_pt <= _PLOT_PT:
        return mark_pt
    if width_pt <= mark_pt:
        return mark_pt - width_pt
    return max(_PLOT_PT - width_pt, 0.0)


def _shortened(text: str) -> str:
    """Return a name that fits the picture."""
    return text if len(text) <= _NAME_CHARACTERS else f"{text[: _NAME_CHARACTERS - 3]}..."


def _width_pt(text: str) -> float:
    """Return the width of a name in points, with a reserve for another font."""
    path = TextPath((0.0, 0.0), text, size=_NAME_PT)
    return _FONT_RESERVE * float(path.get_extents().width)
