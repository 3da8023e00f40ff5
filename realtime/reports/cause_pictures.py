"""The pictures of an explanation: where the base is wrong, what a cause does, where it matters, what is gained.

The effect of a cause is shown without its form: what the model without it leaves, in bins of what the cause goes by.
The fitted law, the difference that the cause makes to what is left, is drawn over it. Bars are two standard errors
from means of blocks of 3 s, since neighbouring samples are not independent.
"""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.panel import Panel, Series
from rollerrig.realtime.reports.page import BASE, EXTENDED, GREY, INK, MEASURED
from rollerrig.rig.identify.causes.courses import covariate, vehicle_samples
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import gain
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.mechanisms.mechanism import COVARIATES, VEHICLE, arguments
from rollerrig.rig.mechanisms.table import BY_NAME

BINS, LEAST_OF_BIN, STRETCH_S = 12, 50, 5.0
_WORDS = {c.name: f"{c.word.replace('_', ' ')}, {c.unit}" for c in COVARIATES if c.word} | {
    "cleaned_J_m": "work of the wheels before on this metre, J/m",
    "braked_rad": "angle turned braked, rad",
    "brake_Nm": "brake torque, N m",
    "deceleration_m_s2": "deceleration, m/s²",
}
# what a remainder goes along, as the search calls it, and the covariate that shows it
_ALONG = {c.word: c.name for c in COVARIATES if c.word} | {
    "deceleration": "deceleration_m_s2",
    "vehicle time": "time_s",
    "vehicle speed": "speed_m_s",
    "axle": "time_s",
    "acceleration": "sliding_m_s",
}


class Binned(NamedTuple):
    """Means in bins of a covariate with two standard errors."""

    at: np.ndarray
    mean: np.ndarray
    bar: np.ndarray


def binned(x: np.ndarray, y: np.ndarray, block: np.ndarray, edges: np.ndarray) -> Binned:
    """Means of y in bins of x; `block` tells which samples belong together."""
    of, found = np.clip(np.digitize(x, edges) - 1, 0, len(edges) - 2), []
    for k in range(len(edges) - 1):
        inside = of == k
        if inside.sum() < LEAST_OF_BIN:
            continue
        _, own = np.unique(block[inside], return_inverse=True)
        means = np.bincount(own, y[inside]) / np.bincount(own)
        bar = 2.0 * means.std(ddof=1) / np.sqrt(means.size) if means.size > 1 else np.nan
        found.append((x[inside].mean(), y[inside].mean(), bar))
    return Binned(*np.array(found).T) if found else Binned(*np.zeros((3, 0)))


def where(a: Diagnosis, against: list[str]) -> list[Panel]:
    """What the base leaves of the adhesion, against what shows it most, each axle."""
    d = a.design
    left, better = (_left(d, one) for one in (a.base, a.final))
    names = list(
        dict.fromkeys(
            [_ALONG.get(_plain(word), "time_s") for word in against]
            + ["sliding_m_s", "speed_m_s", "time_s"]
        )
    )[:3]
    block, axle = _blocks(d), np.repeat(d.axle, np.diff(d.start))
    found = []
    for name in names:
        x = covariate(d, name)
        edges = _edges(x)
        series = [
            Series(f"axle {j + 1}", colour, *binned(x[on], left[on], block[on], edges))
            for j, colour in enumerate(colours.AXLES)
            for on in [axle == j]
        ]
        if a.causes:
            at, mean, _ = binned(x, better, block, edges)
            series.append(Series("extended, all axles", colours.EXTENDED, at, mean, None))
        found.append(
            Panel(
                _WORDS[name].partition(",")[0],
                _WORDS[name],
                "measured less base model, adhesion",
                tuple(series),
            )
        )
    return found


def cause(a: Diagnosis, named: IdentifiedCause) -> Panel:
    """What the model without a cause leaves along what the cause goes by, and the fitted law over it."""
    d, row = a.design, BY_NAME[named.cause.name]
    without = a.final._replace(
        causes=tuple(c for c in a.final.causes if c.name != named.cause.name)
    )
    vehicle = row.acts_on == VEHICLE
    left = gain.free_running if vehicle else _left
    lacking, rest = left(d, without), left(d, a.final)
    goes_by = [c for course in row.courses for c in arguments(course, 0) if c in _WORDS]
    name = goes_by[0] if goes_by else "speed_m_s" if vehicle else "sliding_m_s"
    x, block, axle = covariate(d, name), _blocks(d), np.repeat(d.axle, np.diff(d.start))
    if vehicle:
        x, block, axle = vehicle_samples(d, x), vehicle_samples(d, block), np.zeros(lacking.size)
    # a cause of one axle shows there; one of all is shown together
    on = np.full(x.size, True) if vehicle or not named.cause.axle else axle == named.cause.axle - 1
    edges = _edges(x[on])
    b, law = (binned(x[on], y[on], block[on], edges) for y in (lacking, lacking - rest))
    place = f", axle {named.cause.axle}" if named.cause.axle else ""
    return Panel(
        f"{row.text}{place}",
        _WORDS[name],
        "error of the speed 5 s ahead, m/s" if vehicle else "adhesion",
        (
            Series("left without it, ± 2 standard errors", colours.MEASURED, *b),
            Series("the fitted law", colours.EXTENDED, law.at, law.mean, None),
        ),
    )


def draw(figure: Figure, panels: list[Panel]) -> None:
    """Panels beside one another, with the same measure upwards."""
    for k, (axes, panel) in enumerate(
        zip(np.atleast_1d(figure.subplots(1, len(panels), sharey=True)), panels, strict=True)
    ):
        for one in panel.series:
            colour = INK if one.colour == colours.MEASURED else colours.on_page(one.colour)
            if one.bar is None:
                axes.plot(one.at, one.mean, color=colour, lw=2.0, label=one.label)
            else:
                axes.errorbar(
                    one.at,
                    one.mean,
                    one.bar,
                    color=colour,
                    marker="o",
                    ms=3,
                    lw=0.8,
                    label=one.label,
                )
        axes.axhline(0.0, color=GREY)
        axes.set_xlabel(panel.along)
        if k == 0:
            axes.set_ylabel(panel.upwards)
        if len(panels) == 1:
            axes.set_title(panel.title, fontsize="medium")
    axes.legend()


def stretch(figure: Figure, a: Diagnosis) -> None:
    """Measured, base and extended adhesion over one another, for the seconds and the axle where the two differ most."""
    d = a.design
    (measured, base, sliding), (_, better, _) = gain.adhesion(d, a.base), gain.adhesion(d, a.final)
    length = int(STRETCH_S / d.step_s)
    best, at = -1.0, slice(0, length)
    s = 0
    for segment in range(d.segments):
        own = d.span(segment)
        differ = np.convolve(
            np.abs(better[own] - base[own]) * (d.speed_m_s[own] > gain.SLOWEST_M_S),
            np.ones(length),
            "valid",
        )
        if differ.size and differ.max() > best:
            best, low, s = float(differ.max()), own.start + int(differ.argmax()), segment
            at = slice(low, low + length)
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    for values, colour, label, width in (
        (measured, MEASURED, "measured", 0.8),
        (base, BASE, "base", 1.6),
        (better, EXTENDED, "extended", 1.6),
    ):
        top.plot(d.time_s[at], values[at], color=colour, label=label, lw=width)
    top.set_ylabel("adhesion")
    top.set_title(f"run {d.names[int(d.run[s])]}, axle {int(d.axle[s]) + 1}", fontsize="medium")
    top.legend(ncol=3)
    below.plot(d.time_s[at], sliding[at], color=INK)
    below.set_ylabel("sliding, m/s")
    below.set_xlabel("time, s")


def gains(axes: Axes, by_run: dict[str, tuple[float, float, float, float]], metric: str) -> None:
    """The error on each run that was never fitted, before and after, and the share that went away with its interval."""
    places = np.arange(len(by_run))
    for k, (colour, label) in enumerate(((BASE, "base"), (EXTENDED, "extended"))):
        axes.barh(
            places + 0.38 * k,
            [errors[k] for errors in by_run.values()],
            0.36,
            color=colour,
            label=label,
        )
    axes.set_yticks(
        places + 0.19,
        [
            f"{run}: {1.0 - after / before:.0%}\n({low:.0%} to {high:.0%})"
            for run, (before, after, low, high) in by_run.items()
        ],
    )
    axes.invert_yaxis()
    axes.set_xlabel(metric.replace("_", " "))
    axes.legend()


def _left(d: Design, explanation: Any) -> np.ndarray:
    measured, model, _ = gain.adhesion(d, explanation)
    return np.where(d.speed_m_s > gain.SLOWEST_M_S, measured - model, 0.0)


def _plain(word: str) -> str:
    return "time" if word.startswith("time of") else word


def _edges(x: np.ndarray) -> np.ndarray:
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, BINS + 1)))
    return edges if edges.size > 2 else np.array([x.min() - 1.0, x.max() + 1.0])


def _blocks(d: Design) -> np.ndarray:
    """A number for each block of 3 s of each wheel, shape (n,)."""
    wheel = np.repeat(np.arange(d.segments), np.diff(d.start))
    return wheel * 10_000 + (d.time_s // gain.BLOCK_S).astype(int)
