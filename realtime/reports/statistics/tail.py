"""The part of a campaign's page about its inputs, its longest stops, and what drives them."""

import math
from functools import partial

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure

from rollerrig.realtime.campaign import campaign, design, stopping
from rollerrig.realtime.campaign.outcome import Outcome
from rollerrig.realtime.campaign.statistics import draws, drivers, strata, tail
from rollerrig.realtime.reports import page

# shares that the curve of the law is drawn for
_CURVE = 60
# draws that a picture shows
_POINTS = 5_000


def parts(plan: campaign.Plan, outcome: Outcome) -> list[page.Markup]:
    """Return the part of the page; it is empty for a matrix, which is not a sample."""
    if plan.head["design"] == design.MATRIX:
        return []
    found = [*_inputs(plan), *_indices(plan, outcome.rows)]
    if not isinstance(outcome.distance_m, strata.Sample):
        found += _tail(plan, outcome.distance_m)
    return found


def _inputs(plan: campaign.Plan) -> list[page.Markup]:
    """Return the laws of the inputs with their sources."""
    if not plan.sources:
        return []
    return [
        page.element("h2", "Inputs"),
        page.table(("input", "law", "source"), plan.sources),
    ]


def _indices(plan: campaign.Plan, table: pa.Table) -> list[page.Markup]:
    """Return the Sobol indices of a saltelli design."""
    if plan.head["design"] != design.SALTELLI:
        return []
    indices = stopping.sobol_indices(plan, table)
    if not indices:
        text = (
            f"No Sobol indices: fewer than {drivers.FEWEST_BLOCKS} blocks have a stopping distance "
            "in all their runs, or all distances are equal."
        )
        return [page.paragraph(text, kind="note")]
    ordered = sorted(indices.items(), key=lambda item: -item[1].total.value)
    distance_m = table.sort_by("run")["braking_distance_m"].to_numpy().astype(float)
    left_out = drivers.left_out_blocks(distance_m, len(plan.axes))
    return [
        page.element("h2", "Share of the variance of the stopping distance"),
        page.paragraph(
            "Sobol indices by SALib, with intervals of 95 %. The total index includes interactions "
            f"with other inputs. {left_out} blocks with a run that did not stop are left out."
        ),
        page.table(
            ("input", "first order", "interval", "total", "interval"),
            [
                (
                    name,
                    f"{of_input.first.value:.3f}",
                    _interval(of_input.first),
                    f"{of_input.total.value:.3f}",
                    _interval(of_input.total),
                )
                for name, of_input in ordered
            ],
        ),
    ]


def _interval(estimate: drivers.Estimate) -> str:
    return f"{estimate.low:.3f} to {estimate.high:.3f}"


def shown_ranks(size: int) -> np.ndarray:
    """Return the ranks of the draws that a curve shows: all, or more of the largest ones."""
    if size <= _POINTS:
        return np.arange(1, size + 1)
    from_largest = np.unique(np.geomspace(1.0, size, _POINTS).astype(np.int64))
    return size + 1 - from_largest[::-1]


def _tail(plan: campaign.Plan, distance_m: draws.Draws) -> list[page.Markup]:
    """Return the extrapolation of the longest stops, or why there is none."""
    if distance_m.size < stopping.FEWEST:
        return []
    found = stopping.extrapolation(plan, distance_m)
    title = page.element("h2", "Stops longer than those of this campaign")
    if found.law is None:
        return [title, page.paragraph(f"No extrapolation: {found.reason}.", kind="note")]
    law = found.law
    return [
        title,
        page.paragraph(
            f"A generalised Pareto law for the longest {100 * law.share:.3g} % ({law.excesses.size} "
            f"runs above {law.threshold:.1f} m): shape {law.shape:+.3f}, scale {law.scale:.2f} m. "
            "Intervals of 95 % from the profile likelihood. They hold if the tail follows this law, "
            "which no sample can prove; they do not include errors of the plant or of the laws of "
            "the inputs. This is not a certificate.",
            kind="note",
        ),
        page.table(
            ("one run in", "estimate, m", "interval of 95 %, m", "upper bound of 95 %, m"),
            [
                (
                    f"{1.0 / value.exceeded:,.0f}",
                    f"{value.estimate:.1f}",
                    f"{value.low:.1f} to {value.high:.1f}",
                    f"{value.bound:.1f}",
                )
                for value in found.values
            ],
        ),
        page.table(
            (
                "share of the runs above the threshold",
                "shape",
                f"one run in {1.0 / stopping.EXCEEDED[-1]:,.0f}, m",
            ),
            [
                (f"{100 * row.share:g} %", f"{row.shape:+.3f}", f"{row.estimate:.1f}")
                for row in found.stability
            ],
        ),
        page.paragraph(
            "If the rows of the second table differ by more than the interval of the first one, the "
            "law does not describe this tail: make more runs."
        ),
        page.picture(partial(_draw, found=found, distance_m=distance_m), (11.0, 4.5)),
    ]


def _draw(drawn: Figure, found: stopping.Extrapolation, distance_m: draws.Draws) -> None:
    """Draw the share of the runs that go further, the law of the tail, and its intervals."""
    law = found.law
    if law is None:
        return
    ranks = shown_ranks(distance_m.size)
    values_m = [distance_m.at(rank) for rank in ranks.tolist()]
    share = 1.0 - (ranks - 0.5) / distance_m.size
    plot = drawn.subplots()
    plot.plot(values_m, share, ".", markersize=3, label="runs")

    lowest = math.log10(stopping.EXCEEDED[-1])
    shares = np.logspace(math.log10(law.share), lowest, _CURVE)
    curve_m = [law.threshold + tail.excess(law, exceeded) for exceeded in shares.tolist()]
    plot.plot(curve_m, shares, color=page.VERMILION, label="generalised Pareto law")
    for value in found.values:
        if math.isfinite(value.high):
            ends_m = (value.low, value.high)
            plot.plot(ends_m, (value.exceeded, value.exceeded), "|-", color=page.VERMILION)
    plot.set(xlabel="stopping distance, m", ylabel="share of runs that go further", yscale="log")
    page.plain_logarithm(plot.yaxis)
    plot.legend()
