"""The report of a recorder's data: verdict, what was found, where and how much, a picture of the largest of each."""

from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rollerrig.realtime.reports import page as html
from rollerrig.realtime.reports.page import EXTENDED, GREY, INK, RUNS, VERMILION
from rollerrig.rig.identify.train_recorder import rolling, verdict
from rollerrig.rig.identify.train_recorder.recording import Finding, Run
from rollerrig.rig.identify.train_recorder.verdict import NAMES, Account

_MOST_ROWS, _AROUND_S = 30, 6.0
_HEAD = ("what", "channels", "where", "size (95 %)", "in words")


def page(a: Account) -> str:
    """The HTML page, without outside parts."""
    told = [*a.findings, *a.unknown]
    rows = [_row(a, f) for f in told]
    looked = [
        text
        for name, text in NAMES.items()
        if name not in {f.name for f in told} and name != "unknown"
    ]
    return html.page(
        f"What the recorder tells: {a.recording.name}",
        html.paragraph(f"Verdict: {a.verdict}. {verdict.VERDICTS[a.verdict]}", kind="note"),
        *(html.paragraph(line) for line in verdict.story(a)[1:]),
        *(part for name in NAMES for part in _pictures(a, [f for f in told if f.name == name])),
        html.element("h2", "How far each wheel is from the vehicle"),
        html.paragraph("Medians of 5 s in which nobody brakes hard; bars are 95 % intervals."),
        html.picture(partial(_wheels, a=a), (8.0, 2.8)),
        *(
            (html.element("h2", "All that was found"), html.table(_HEAD, rows[:_MOST_ROWS]))
            if rows
            else ()
        ),
        *(
            (html.folded(f"{len(rows) - _MOST_ROWS} more", html.table(_HEAD, rows[_MOST_ROWS:])),)
            if len(rows) > _MOST_ROWS
            else ()
        ),
        *(
            (html.paragraph(f"Looked for and not found beyond chance: {', '.join(looked)}."),)
            if looked
            else ()
        ),
        html.paragraph(
            "Adhesion is the mean over all wheels, from the deceleration of the vehicle: level track (10 "
            "per mille uphill add 0.010), no other brake that acts on the rail, running resistance below "
            "0.05 m/s². Times are those after steps of the clock were put right."
        ),
    )


def _row(a: Account, f: Finding) -> tuple[str, ...]:
    where = (
        f"{f.run}, {f.start_s:.1f} to {f.end_s:.1f} s"
        if f.run
        else (f"{f.place_m[0]:.0f} to {f.place_m[1]:.0f} m" if f.place_m else f.date or "all runs")
    )
    return NAMES[f.name], verdict.channels(a, f), where, verdict.size(f), f.text


def _pictures(a: Account, mine: list[Finding]) -> list[html.Markup]:
    """The largest finding of one kind as a picture."""
    if not mine:
        return []
    worst = max(mine, key=lambda f: abs(f.size))
    draw: dict[str, tuple[str, Callable[..., None], tuple[float, float]]] = {
        "slide": (f"The largest slide: {worst.run}", _slide, (10.0, 4.2)),
        "slippery_place": ("Where runs slide", _places, (10.0, 2.8)),
        "speed_sensor_delay": (f"Late: {worst.channels[0]}", _late, (10.0, 3.2)),
    }
    radius = worst.name.startswith("wheel_radius")
    title, what, size = draw.get(
        worst.name,
        (
            f"{NAMES[worst.name].capitalize()}: {verdict.channels(a, worst)} in {worst.run}",
            _stretch,
            (10.0, 3.2),
        ),
    )
    return (
        []
        if radius or worst.name == "wrong_unit"
        else [html.element("h2", title), html.picture(partial(what, a=a, f=worst), size)]
    )


def _as_recorded(
    axes: Axes, run: Run, start_s: float, end_s: float, told: tuple[str, ...] = ()
) -> None:
    """Speeds as the file has them; those that a finding is about stand out."""
    for k, channel in enumerate(run.of("speed", "reference")):
        own = (channel.time_s >= start_s) & (channel.time_s <= end_s)
        reference = channel.quantity == "reference"
        some = 0 < len(told) < len(run.of("speed"))
        strong = channel.name in told and some
        axes.plot(
            channel.time_s[own],
            channel.values[own],
            color=INK if reference else RUNS[k % len(RUNS)],
            lw=2.2 if strong else 1.0,
            ls="--" if reference else "-",
            marker="o" if strong else "",
            ms=2.5,
            label=channel.name,
            zorder=3 if strong else 2,
        )
    axes.set(xlabel="time as recorded, s", ylabel="m/s")
    axes.legend(ncol=3)


def _run(a: Account, name: str) -> Run:
    return next((run for run in a.recording.runs if run.name == name), a.recording.runs[0])


def _stretch(figure: Figure, a: Account, f: Finding) -> None:
    axes = figure.subplots()
    # of a step of the clock, the moment of it
    end_s = f.start_s + 1.0 if f.name == "clock_step" else min(f.end_s, f.start_s + 60.0)
    _as_recorded(axes, _run(a, f.run), f.start_s - _AROUND_S, end_s + _AROUND_S, f.channels)
    axes.axvspan(f.start_s, end_s, color=VERMILION, alpha=0.15, lw=0)
    axes.set_title(f.text, fontsize="medium")


def _slide(figure: Figure, a: Account, f: Finding) -> None:
    one = next(s for s in a.slides if s.finding == f)
    aligned, v = a.aligned[one.run], a.vehicle[one.run]
    own = (aligned.time_s > f.start_s - 3.0) & (aligned.time_s < f.end_s + 3.0)
    axes = figure.subplots()
    for k, name in enumerate(aligned.names):
        axes.plot(aligned.time_s[own], aligned.speed[own, k], color=RUNS[k % len(RUNS)], label=name)
    axes.plot(aligned.time_s[own], v[own], color=INK, lw=1.8, label="vehicle")
    axes.axvspan(f.start_s, f.end_s, color=VERMILION, alpha=0.1, lw=0)
    axes.set(xlabel="time, s", ylabel="m/s, delay and radius put right")
    axes.set_title(f.text, fontsize="medium")
    axes.legend(ncol=3)


def _places(figure: Figure, a: Account, f: Finding) -> None:
    axes = figure.subplots()
    for r, aligned in enumerate(a.aligned):
        axes.plot(
            [np.nanmin(aligned.position), np.nanmax(aligned.position)], [r, r], color=GREY, lw=1.0
        )
    for s in a.slides:
        way = a.aligned[s.run].position[[s.first, s.last]]
        axes.plot(way, [s.run, s.run], color=VERMILION, lw=6.0, solid_capstyle="butt")
    if f.place_m:
        axes.axvspan(*f.place_m, color=EXTENDED, alpha=0.25, lw=0)
    axes.set_yticks(range(len(a.aligned)), [one.run.name for one in a.aligned])
    axes.set(xlabel="position, m; thick: slides")
    axes.set_title(f.text, fontsize="medium")


def _late(figure: Figure, a: Account, f: Finding) -> None:
    best = max(
        a.aligned,
        key=lambda one: float(np.nanmax(np.abs(rolling.slope(one.time_s, one.vehicle, 2.0)))),
    )
    middle = best.time_s[int(np.nanargmax(np.abs(rolling.slope(best.time_s, best.vehicle, 2.0))))]
    axes = figure.subplots()
    _as_recorded(axes, _run(a, best.run.name), middle - 5.0, middle + 5.0, f.channels)
    axes.set_title(f"{best.run.name}, where the speed changes most", fontsize="medium")


def _wheels(figure: Figure, a: Account) -> None:
    """Radius of every speed at every date, as the recording has it."""
    axes = figure.subplots()
    groups = sorted({(one.run.vehicle_id, one.run.date) for one in a.aligned})
    names = list(dict.fromkeys(name for one in a.aligned for name in one.names))
    for g, key in enumerate(groups):
        wheels = rolling.wheels(
            [one.as_recorded() for one in a.aligned if (one.run.vehicle_id, one.run.date) == key]
        )
        for k, name in enumerate(names):
            if name in wheels:
                at = g + 0.12 * (k - 0.5 * (len(names) - 1))
                axes.errorbar(
                    at,
                    -100.0 * wheels[name].radius,
                    200.0 * wheels[name].error,
                    color=RUNS[k % len(RUNS)],
                    marker="o",
                    label=name if g == 0 else "_",
                )
    axes.axhline(0.0, color=GREY)
    axes.set_xticks(
        range(len(groups)), [" ".join(filter(None, key)) or "all runs" for key in groups]
    )
    axes.set_xlim(-0.7, len(groups) - 0.3)
    axes.set_ylabel("radius less setting, %")
    if axes.get_legend_handles_labels()[1]:
        axes.legend(ncol=4)


def courses(a: Account) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Rerun path -> (time s, values by name): speeds put right, and sliding."""
    found = {}
    for aligned, v in zip(a.aligned, a.vehicle, strict=True):
        speeds = dict(zip(aligned.names, aligned.speed.T, strict=True))
        found[f"/{aligned.run.name}/speed"] = (aligned.time_s, speeds | {"vehicle": v})
        found[f"/{aligned.run.name}/sliding"] = (
            aligned.time_s,
            {name: v - one for name, one in speeds.items()},
        )
    return found
