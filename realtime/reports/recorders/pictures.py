"""Draws pictures of a train recording.

They show a stretch with a fault, a slide, the places of slides, a delay, and the wheels.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rollerrig.realtime.pictures import gaps
from rollerrig.realtime.reports.page import EXTENDED, GREY, INK, RUNS, VERMILION
from rollerrig.rig.identify.train_recorder import scales, thresholds
from rollerrig.rig.identify.train_recorder.alignment import Aligned, slope
from rollerrig.rig.identify.train_recorder.findings import Finding
from rollerrig.rig.identify.train_recorder.recording import Run
from rollerrig.rig.identify.train_recorder.verdict import Account

# s. What is shown on both sides of a finding, of a slide and of a delay.
_AROUND_S = 6.0
_AROUND_SLIDE_S = 3.0
_AROUND_DELAY_S = 5.0

_COLUMNS_OF_LEGEND = 6

# s. Of a longer finding only the beginning is shown.
_LONGEST_S = 60.0


def stretch(figure: Figure, account: Account, finding: Finding, title: str) -> None:
    """Draw the speeds as recorded around a finding."""
    axes = figure.subplots()
    end_s = min(finding.end_s, finding.start_s + _LONGEST_S)
    if finding.name == "clock_step":
        # only the moment of the step
        end_s = finding.start_s + 1.0
    _as_recorded(
        axes,
        _run(account, finding.run),
        finding.start_s - _AROUND_S,
        end_s + _AROUND_S,
        finding.channels,
    )
    axes.axvspan(finding.start_s, end_s, color=VERMILION, alpha=0.15, lw=0)
    axes.set_title(title, fontsize="medium")


def slide(figure: Figure, account: Account, finding: Finding, title: str) -> None:
    """Draw the corrected speeds and the vehicle's over one slide."""
    number_of_run = next(s.run for s in account.slides if s.finding == finding)
    aligned = account.aligned[number_of_run]
    vehicle = account.vehicle[number_of_run]
    shown = (aligned.time_s > finding.start_s - _AROUND_SLIDE_S) & (
        aligned.time_s < finding.end_s + _AROUND_SLIDE_S
    )
    stamps_s = aligned.time_s[shown]
    longest_s = thresholds.gap_s(float(np.median(np.diff(aligned.time_s))))

    axes = figure.subplots()
    for k, name in enumerate(aligned.names):
        time_s, speed_m_s = gaps.with_breaks(stamps_s, longest_s, aligned.speed[shown, k])
        axes.plot(time_s, speed_m_s, color=RUNS[k % len(RUNS)], label=name)
    time_s, vehicle_m_s = gaps.with_breaks(stamps_s, longest_s, vehicle[shown])
    axes.plot(time_s, vehicle_m_s, color=INK, lw=1.8, label="vehicle")
    axes.axvspan(finding.start_s, finding.end_s, color=VERMILION, alpha=0.1, lw=0)
    axes.set(xlabel="time, s", ylabel="speed (delay and radius corrected), m/s")
    axes.set_title(title, fontsize="medium")
    _legend_below(axes)


def places(figure: Figure, account: Account, finding: Finding, title: str) -> None:
    """Draw the track of every run as a thin line and its slides as thick lines.

    The place of the finding, where several runs slide, is shaded.
    """
    axes = figure.subplots()
    for number_of_run, aligned in enumerate(account.aligned):
        track = [np.nanmin(aligned.position), np.nanmax(aligned.position)]
        axes.plot(track, [number_of_run, number_of_run], color=GREY, lw=1.0)
    for episode in account.slides:
        position = account.aligned[episode.run].position[[episode.first, episode.last]]
        axes.plot(
            position,
            [episode.run, episode.run],
            color=VERMILION,
            lw=6.0,
            solid_capstyle="butt",
        )
    if finding.place_m is not None:
        axes.axvspan(*finding.place_m, color=EXTENDED, alpha=0.25, lw=0)
    names = [aligned.run.name for aligned in account.aligned]
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="position, m; thick: slides")
    axes.set_title(title, fontsize="medium")


def delay(figure: Figure, account: Account, finding: Finding, title: str) -> None:
    """Draw the speeds as recorded where the speed of the vehicle changes most."""
    changes = [_change_m_s2(aligned) for aligned in account.aligned]
    best = int(np.argmax([np.nanmax(change) for change in changes]))
    aligned = account.aligned[best]
    middle_s = aligned.time_s[int(np.nanargmax(changes[best]))]

    axes = figure.subplots()
    _as_recorded(
        axes,
        _run(account, aligned.run.name),
        middle_s - _AROUND_DELAY_S,
        middle_s + _AROUND_DELAY_S,
        finding.channels,
    )
    axes.set_title(f"{aligned.run.name}, where the speed changes most: {title}", fontsize="medium")


def _change_m_s2(aligned: Aligned) -> np.ndarray:
    """Return how fast the speed of the vehicle changes, (n,)."""
    return np.abs(slope(aligned.time_s, aligned.vehicle, 2.0))


def wheels(figure: Figure, account: Account) -> None:
    """Draw the radius of every speed at every date, without corrections."""
    axes = figure.subplots()
    groups = sorted({_group(aligned) for aligned in account.aligned})
    names = list(dict.fromkeys(name for aligned in account.aligned for name in aligned.names))
    unnamed = set(names)
    for g, group in enumerate(groups):
        of_group = [
            aligned.as_recorded() for aligned in account.aligned if _group(aligned) == group
        ]
        found = {fit.name: fit.dates for fit in scales.fit_channels(of_group)}
        for k, name in enumerate(names):
            dates = found.get(name, {})
            if not dates:
                continue
            wheel = next(iter(dates.values()))
            # the speeds of a date are next to each other
            at = g + 0.12 * (k - 0.5 * (len(names) - 1))
            axes.errorbar(
                at,
                -100.0 * wheel.radius,
                100.0 * wheel.half_width,
                color=RUNS[k % len(RUNS)],
                marker="o",
                label=name if name in unnamed else "_",
            )
            unnamed.discard(name)
    axes.axhline(0.0, color=GREY)
    labels = [" ".join(filter(None, group)) or "all runs" for group in groups]
    axes.set_xticks(range(len(groups)), labels)
    axes.set_xlim(-0.7, len(groups) - 0.3)
    axes.set_ylabel("radius less setting, %")
    if axes.get_legend_handles_labels()[1]:
        _legend_below(axes)


def _group(aligned: Aligned) -> tuple[str, str]:
    """Return vehicle and date: runs of both have the same wheels."""
    return aligned.run.vehicle_id, aligned.run.date


def _run(account: Account, name: str) -> Run:
    """Return the recorded run of a name; the first one for findings of all runs."""
    for run in account.recording.runs:
        if run.name == name:
            return run
    return account.recording.runs[0]


def _as_recorded(
    axes: Axes, run: Run, start_s: float, end_s: float, marked: tuple[str, ...]
) -> None:
    """Draw speeds and references as in the file.

    The speeds `marked` by the finding are drawn strong. If it marks all speeds, none is strong.
    """
    some_are_marked = 0 < len(marked) < len(run.of("speed"))
    for k, channel in enumerate(run.of("speed", "reference")):
        if channel.quantity == "reference":
            style: dict[str, Any] = {"color": INK, "ls": "--"}
        else:
            style = {"color": RUNS[k % len(RUNS)], "ls": "-"}

        emphasis: dict[str, Any] = {"lw": 1.0, "marker": "", "zorder": 2}
        if some_are_marked and channel.name in marked:
            emphasis = {"lw": 2.2, "marker": "o", "zorder": 3}

        shown = (channel.time_s >= start_s) & (channel.time_s <= end_s)
        # rows of other channels have no value of this one
        shown &= np.isfinite(channel.values)
        time_s, values = gaps.with_breaks(
            channel.time_s[shown], thresholds.gap_s(channel.step_s), channel.values[shown]
        )
        axes.plot(
            time_s,
            values,
            ms=2.5,
            label=channel.name,
            **style,
            **emphasis,
        )
    axes.set(xlabel="time as recorded, s", ylabel="speed, m/s")
    _legend_below(axes)


def _legend_below(axes: Axes) -> None:
    """Add a legend below the picture, where it covers no line."""
    axes.figure.legend(loc="outside lower center", ncols=_COLUMNS_OF_LEGEND)
