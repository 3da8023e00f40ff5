"""Draws the pictures of the report on braking runs.

They show where the base is wrong, what a cause does, where it matters, and what is gained.

The effect of a cause is shown without its form: the panel has what the model without the cause
leaves, in bins of the covariate that the cause depends on. The fitted law is drawn over it: the
difference that the cause makes to what is left. Bars are two standard errors from means of blocks
of 3 s, since neighbouring samples are not independent.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.panel import Panel, Series
from rollerrig.realtime.reports.hints.sizes import place_in_words
from rollerrig.realtime.reports.page import BASE, EXTENDED, GREY, INK, MEASURED
from rollerrig.rig.identify.base.by_run import Quantity
from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.causes.courses import covariate, of_axle, vehicle_samples
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import gain
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.identify.decide.gain import RunGain
from rollerrig.rig.identify.decide.side_by_side import SideBySide
from rollerrig.rig.identify.decide.thresholds import BLOCK_S, SLOWEST_M_S
from rollerrig.rig.identify.statistics.interval import Estimate
from rollerrig.rig.mechanisms.mechanism import COVARIATES, TORQUE, VEHICLE, arguments
from rollerrig.rig.mechanisms.table import BY_NAME

BINS = 12
LEAST_OF_BIN = 50  # samples of a bin; smaller bins are left out
GAP_SHARE = 0.1  # of the range of a covariate, without samples: no line crosses it
BAR_DEVIATIONS = 2.0  # half length of a bar in standard errors
STRETCH_S = 5.0  # length of the stretch that is shown in full
MOST_PANELS = 3
COLUMNS_OF_LEGEND = 6
BAR_HEIGHT = 0.36  # of a horizontal bar of the gains; bars of one run are BAR_PITCH apart
BAR_PITCH = 0.38
BLOCKS_OF_WHEEL = 10_000  # more than a run has
# measured adhesion is drawn for both models where they read it this far apart
LEAST_APART = 0.001

# half of a 95 % interval of a normal distribution, in standard errors
DEVIATIONS_OF_95 = Estimate(0.0, 1.0).half_width()
# axis titles of what is measured of each run
QUANTITY_TITLES = {
    Quantity.TORQUE: "torque over lost momentum",
    Quantity.LOAD: "loads over weight",
    Quantity.LOAD_OF_AXLE: "share of all loads",
    Quantity.ROLLING: "rolling wheelsets over vehicle",
    Quantity.ROLLING_OF_AXLE: "rolling over other wheelsets",
    Quantity.TO_FRONT: "load moved to the front",
    Quantity.FRICTION: "ln of friction while sliding",
    Quantity.NOISE: "ln of noise",
}

METRIC_TITLES = {
    gain.ADHESION: "adhesion that the model lacks (rms)",
    gain.FREE_RUN: "error of the speed 5 s ahead (rms), m/s",
}

# axis titles of covariates
_TITLES = {c.name: f"{c.word.replace('_', ' ')}, {c.unit}" for c in COVARIATES if c.word} | {
    "cleaned_J_m": "work of the wheels in front on this metre, J/m",
    "braked_rad": "angle turned while braked, rad",
    "brake_Nm": "brake torque, N m",
    "deceleration_m_s2": "deceleration, m/s²",
}
# the covariate that shows a remainder, by the word that the search has for it
_COVARIATE_OF_WORD = {c.word: c.name for c in COVARIATES if c.word} | {
    "deceleration": "deceleration_m_s2",
    "vehicle time": "time_s",
    "vehicle speed": "speed_m_s",
    "axle": "time_s",
    "acceleration": "sliding_m_s",
}
# shown where the remainder names fewer
_ALWAYS_OF_INTEREST = ("sliding_m_s", "speed_m_s", "time_s")


class Binned(NamedTuple):
    """Means in bins of a covariate, shape (bins,) each; NaN where the line breaks."""

    x: np.ndarray  # mean of the covariate
    mean: np.ndarray
    error: np.ndarray  # two standard errors, NaN where there is one block only


# --- panels ---


def binned(x: np.ndarray, y: np.ndarray, block: np.ndarray, edges: np.ndarray) -> Binned:
    """Return means of y in bins of x; samples with the same number in `block` belong together."""
    bins = len(edges) - 1
    bin_of = np.clip(np.digitize(x, edges) - 1, 0, bins - 1)
    mean_x = []
    mean_y = []
    error = []
    for k in range(bins):
        inside = bin_of == k
        if inside.sum() < LEAST_OF_BIN:
            continue
        _, block_of = np.unique(block[inside], return_inverse=True)
        block_means = np.bincount(block_of, y[inside]) / np.bincount(block_of)
        standard_error = np.nan
        if block_means.size > 1:
            standard_error = block_means.std(ddof=1) / np.sqrt(block_means.size)
        mean_x.append(x[inside].mean())
        mean_y.append(y[inside].mean())
        error.append(BAR_DEVIATIONS * standard_error)
    return _broken(Binned(np.array(mean_x), np.array(mean_y), np.array(error)), x)


def _broken(means: Binned, x: np.ndarray) -> Binned:
    """Return the means with a NaN where the samples at x have a gap between two of them."""
    ordered = np.sort(x)
    wide = np.diff(ordered) > GAP_SHARE * (ordered[-1] - ordered[0])
    begins = ordered[:-1][wide]
    ends = ordered[1:][wide]
    is_broken = [
        bool(((begins >= left) & (ends <= right)).any())
        for left, right in itertools.pairwise(means.x)
    ]
    at = np.flatnonzero(is_broken) + 1
    return Binned(*(np.insert(column, at, np.nan) for column in means))


def where(diagnosis: Diagnosis, against: list[str]) -> list[Panel]:
    """Return panels of the adhesion that the base lacks, along the covariates that show it most."""
    design = diagnosis.design
    left_by_base = _left(design, diagnosis.base)
    left_by_extended = _left(design, diagnosis.final)
    block = _blocks(design)
    axle_of = np.repeat(design.axle, np.diff(design.start))

    # a vehicle whose speed is wrong shows in no adhesion, so its speed is drawn
    panels = [_speed_panel(diagnosis, word) for word in against if word.startswith("vehicle ")]
    for name in _covariates_to_show(against)[: MOST_PANELS - len(panels)]:
        x = covariate(design, name)
        edges = _edges(x)
        series = []
        for axle in range(design.axles):
            on = axle_of == axle
            of_axle = binned(x[on], left_by_base[on], block[on], edges)
            series.append(Series(f"axle {axle + 1}", colours.AXLES[axle], *of_axle))
        if diagnosis.causes:
            of_all = binned(x, left_by_extended, block, edges)
            series.append(
                Series("extended, all axles", colours.EXTENDED, of_all.x, of_all.mean, None)
            )
        panels.append(
            Panel(
                title=_TITLES[name].partition(",")[0],
                x_label=_TITLES[name],
                y_label="measured less base model, adhesion",
                series=tuple(series),
            )
        )
    return panels


def _speed_panel(diagnosis: Diagnosis, word: str) -> Panel:
    """Return the panel of the error of the vehicle's speed along a covariate of the vehicle."""
    design = diagnosis.design
    name = _COVARIATE_OF_WORD[word]
    x = vehicle_samples(design, covariate(design, name))
    block = vehicle_samples(design, _blocks(design))
    of_base = binned(x, gain.free_running(design, diagnosis.base), block, _edges(x))
    series = [Series("base, vehicle", colours.MEASURED, *of_base)]
    if diagnosis.final is not diagnosis.base:
        left = gain.free_running(design, diagnosis.final)
        of_final = binned(x, left, block, _edges(x))
        series.append(Series("extended", colours.EXTENDED, of_final.x, of_final.mean, None))
    return Panel(
        title=f"speed of the vehicle, along {_TITLES[name].partition(',')[0]}",
        x_label=_TITLES[name],
        y_label="error of the speed 5 s ahead, m/s",
        series=tuple(series),
    )


def _covariates_to_show(against: list[str]) -> list[str]:
    """Return the covariates that show a remainder, and others of interest, each once."""
    names = []
    for word in against:
        plain = "time" if word.startswith("time of") else word
        names.append(_COVARIATE_OF_WORD.get(plain, "time_s"))
    return list(dict.fromkeys([*names, *_ALWAYS_OF_INTEREST]))[:MOST_PANELS]


def cause(diagnosis: Diagnosis, identified: IdentifiedCause) -> Panel:
    """Return the panel of what the model without a cause leaves, along the cause's covariate."""
    design = diagnosis.design
    mechanism = BY_NAME[identified.cause.name]
    axle = identified.cause.axle
    others = tuple(c for c in diagnosis.final.causes if c.name != identified.cause.name)
    without = diagnosis.final._replace(causes=others)

    # a wrong torque hides in the friction level of each run, but not from the vehicle
    is_of_vehicle = mechanism.acts_on in (VEHICLE, TORQUE)
    left = gain.free_running if is_of_vehicle else _left
    left_without = left(design, without)
    left_with = left(design, diagnosis.final)

    name = _covariate_of(identified)
    x = covariate(design, name)
    block = _blocks(design)
    if is_of_vehicle:
        x = vehicle_samples(design, x)
        block = vehicle_samples(design, block)
    # a cause on one axle shows there; a cause on all axles is shown together
    on = np.full(x.size, True)
    if axle and not is_of_vehicle:
        on = of_axle(design, axle) > 0.0
    edges = _edges(x[on])
    points = binned(x[on], left_without[on], block[on], edges)
    law = binned(x[on], (left_without - left_with)[on], block[on], edges)

    return Panel(
        title=mechanism.text + (f", {place_in_words(axle)}" if axle else ""),
        x_label=_TITLES[name],
        y_label="error of the speed 5 s ahead, m/s" if is_of_vehicle else "adhesion",
        series=(
            Series("left without it, ± 2 standard errors", colours.MEASURED, *points),
            Series("the fitted law", colours.EXTENDED, law.x, law.mean, None),
        ),
    )


def _covariate_of(identified: IdentifiedCause) -> str:
    """Return the covariate that a cause depends on, or one that usually shows its effect."""
    mechanism = BY_NAME[identified.cause.name]
    for course in mechanism.courses:
        for name in arguments(course, 0):
            if name in _TITLES:
                return name
    return "speed_m_s" if mechanism.acts_on == VEHICLE else "sliding_m_s"


def _left(design: Design, explanation: Explanation) -> np.ndarray:
    """Return measured less modelled adhesion at every sample, 0 below SLOWEST_M_S."""
    measured, model, _ = gain.adhesion(design, explanation)
    return np.where(design.speed_m_s > SLOWEST_M_S, measured - model, 0.0)


def _edges(x: np.ndarray) -> np.ndarray:
    """Return the edges of bins of about equally many samples; of one bin if x does not vary."""
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, BINS + 1)))
    if edges.size > 2:
        return edges
    return np.array([x.min() - 1.0, x.max() + 1.0])


def _blocks(design: Design) -> np.ndarray:
    """Return a number for each block of 3 s of each wheel, shape (n,)."""
    wheel = np.repeat(np.arange(design.segments), np.diff(design.start))
    return wheel * BLOCKS_OF_WHEEL + (design.time_s // BLOCK_S).astype(int)


# --- figures ---


def draw(figure: Figure, panels: list[Panel]) -> None:
    """Draw panels next to each other, with the same vertical axis if they show the same."""
    is_shared = len({panel.y_label for panel in panels}) == 1
    all_axes = np.atleast_1d(figure.subplots(1, len(panels), sharey=is_shared))
    for axes, panel in zip(all_axes, panels, strict=True):
        for series in panel.series:
            _draw_series(axes, series)
        axes.axhline(0.0, color=GREY)
        axes.set_xlabel(panel.x_label)
        if not is_shared:
            axes.set_ylabel(panel.y_label)
    all_axes[0].set_ylabel(panels[0].y_label)
    if len(panels) == 1:
        all_axes[0].set_title(panels[0].title, fontsize="medium")
    # one entry for each kind of line, below the panels, where it covers no point
    handles: dict[str, Any] = {}
    for axes in all_axes:
        lines, labels = axes.get_legend_handles_labels()
        handles |= dict(zip(labels, lines, strict=True))
    figure.legend(
        handles=list(handles.values()),
        labels=list(handles),
        loc="outside lower center",
        ncols=COLUMNS_OF_LEGEND,
    )


def _draw_series(axes: Axes, series: Series) -> None:
    """Draw points with bars, or a line."""
    colour = colours.as_hex(series.colour)
    if series.colour == colours.MEASURED:
        colour = INK
    if series.error is None:
        axes.plot(series.x, series.y, color=colour, lw=2.0, label=series.label)
        return
    axes.errorbar(
        series.x,
        series.y,
        series.error,
        color=colour,
        marker="o",
        ms=3,
        lw=0.8,
        label=series.label,
    )


def stretch(figure: Figure, diagnosis: Diagnosis) -> None:
    """Draw measured, base and extended adhesion where the models differ most, on one axle.

    Measured adhesion follows from inertia, torque, radius and load. Where a cause changes these,
    each model has its measured curve.
    """
    design = diagnosis.design
    measured_by_base, base, sliding = gain.adhesion(design, diagnosis.base)
    measured, extended, _ = gain.adhesion(design, diagnosis.final)
    segment, at = _where_they_differ(design, base - measured_by_base, extended - measured)

    top, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    top.plot(design.time_s[at], measured[at], color=MEASURED, label="measured", lw=0.8)
    apart = float(np.abs(measured - measured_by_base)[at].max())
    if apart > LEAST_APART:
        top.plot(
            design.time_s[at],
            measured_by_base[at],
            color=GREY,
            label="measured, as the base reads it",
            lw=0.8,
        )
    top.plot(design.time_s[at], base[at], color=BASE, label="base", lw=1.6)
    top.plot(design.time_s[at], extended[at], color=EXTENDED, label="extended", lw=1.6)
    run = design.names[int(design.run[segment])]
    axle = int(design.axle[segment]) + 1
    top.set_ylabel("adhesion")
    top.set_title(f"run {run}, axle {axle}", fontsize="medium")
    figure.legend(loc="outside lower center", ncols=COLUMNS_OF_LEGEND)
    below.plot(design.time_s[at], sliding[at], color=INK)
    below.set_ylabel("sliding, m/s")
    below.set_xlabel("time, s")


def _where_they_differ(design: Design, base: np.ndarray, extended: np.ndarray) -> tuple[int, slice]:
    """Return the segment and the STRETCH_S in which two courses of an error differ most."""
    length = int(STRETCH_S / design.step_s)
    best_segment = 0
    best = slice(0, length)
    most = -1.0
    for segment in range(design.segments):
        at = design.span(segment)
        is_judged = design.speed_m_s[at] > SLOWEST_M_S
        difference = np.abs(extended[at] - base[at]) * is_judged
        in_stretch = np.convolve(difference, np.ones(length), "valid")
        if in_stretch.size and in_stretch.max() > most:
            most = float(in_stretch.max())
            best_segment = segment
            first = at.start + int(in_stretch.argmax())
            best = slice(first, first + length)
    return best_segment, best


def gains(axes: Axes, by_run: dict[str, RunGain], metric: str) -> None:
    """Draw the error on each run that was never fitted, before and after, and its reduction."""
    places = np.arange(len(by_run))
    before = [gain_of_run.before for gain_of_run in by_run.values()]
    after = [gain_of_run.after for gain_of_run in by_run.values()]
    axes.barh(places, before, BAR_HEIGHT, color=BASE, label="base")
    axes.barh(places + BAR_PITCH, after, BAR_HEIGHT, color=EXTENDED, label="extended")

    labels = []
    for run, gain_of_run in by_run.items():
        reduction = 1.0 - gain_of_run.after / gain_of_run.before
        labels.append(f"{run}: {reduction:.0%}\n({gain_of_run.low:.0%} to {gain_of_run.high:.0%})")
    axes.set_yticks(places + 0.5 * BAR_PITCH, labels)
    axes.invert_yaxis()
    axes.set_xlabel(METRIC_TITLES.get(metric, metric.replace("_", " ")))
    axes.figure.legend(loc="outside lower center", ncols=COLUMNS_OF_LEGEND)


# --- runs side by side ---


def runs(figure: Figure, compared: SideBySide) -> None:
    """Draw the size of the nearest cause, and quantities, of each run with 95 % intervals.

    Runs that differ have another colour. Quantities that differ come first.
    """
    shown = _rows_to_show(compared)
    places = np.arange(len(compared.runs))
    apart = set(compared.apart[0].runs) if compared.apart else set()
    is_apart = np.array([name in apart for name in compared.runs])
    for axes, row in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        half = DEVIATIONS_OF_95 * row.errors
        for chosen, colour, label in (
            (~is_apart, BASE, "runs"),
            (is_apart, EXTENDED, "runs that differ"),
        ):
            if chosen.any():
                axes.errorbar(
                    row.sizes[chosen],
                    places[chosen],
                    xerr=half[chosen],
                    fmt="o",
                    color=colour,
                    label=label,
                )
        axes.set_yticks(places, compared.runs)
        axes.invert_yaxis()
        axes.set_xlabel(row.title)
    if is_apart.any():
        lines, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(
            handles=lines, labels=labels, loc="outside lower center", ncols=COLUMNS_OF_LEGEND
        )


class _Row(NamedTuple):
    """A quantity of each run, shape (runs,)."""

    title: str
    sizes: np.ndarray
    errors: np.ndarray


def _rows_to_show(compared: SideBySide) -> list[_Row]:
    """Return the nearest cause, then quantities that differ, then others, at most MOST_PANELS."""
    rows = []
    if compared.cause is not None:
        name = compared.cause.cause.name
        first = BY_NAME[name].parameters[0]
        title = f"{first.name} of {name}".replace("_", " ")
        rows.append(_Row(title, compared.cause.sizes, compared.cause.errors))
    differing = {
        (one.quantity, one.channel) for apart in compared.apart for one in apart.differences
    }
    ordered = sorted(
        compared.quantities, key=lambda one: (one.quantity, one.channel) not in differing
    )
    for one in ordered:
        if np.isfinite(one.sizes).any():
            title = f"{QUANTITY_TITLES[one.quantity]} {one.channel}".strip()
            rows.append(_Row(title, one.sizes, one.errors))
    return rows[:MOST_PANELS]
