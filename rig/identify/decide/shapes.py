"""Moves the shape of causes off the grid of the search.

The search knows only windows of whole bins and a few scales of speed, time, work or heat. A window
that is half a bin away from the true one leaves a remainder at both edges, and a wrong scale leaves
one too. This remainder would look like another cause.

Edges are moved by ever smaller steps while the likelihood grows. Scales are multiplied by factors,
and the coefficients are fitted again after each move. Two other forms of a window are tried: a
patch that begins and ends slowly, and a patch or sand that acts on the clean rail too.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation, untuned
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import fitting, thresholds

# number of step sizes for an edge; each is half of the one before
_EDGE_STEPS = 5
# an edge or a scale is moved at most this number of times by the same step
_MOST_MOVES = 8
# first steps of an edge, as shares of the step in the table of causes
_FIRST_STEP = 1.0
_FIRST_STEP_ON_SMOOTHER_RAIL = 0.25
_FIRST_STEP_OF_SLOW_EDGES = 0.5
# factors by which scales are moved
_FACTORS = (1.5, 1.0 / 1.5, 1.2, 1.0 / 1.2)
# Irregularity of the rail with which `restarted` begins: on a rough rail a fit can
# reach friction levels that are far from its start.
_ROUGH_START = 0.06


class _SlowEdges(NamedTuple):
    """A patch that begins and ends slowly."""

    ramp: float  # share of its length
    deeper: float  # factor by which its depth must grow for about the same effect


_SLOW_EDGES = (_SlowEdges(ramp=0.5, deeper=1.1), _SlowEdges(ramp=1.0, deeper=1.3))


class _Shaped(NamedTuple):
    """An explanation with moved shapes."""

    explanation: Explanation
    deviance: float


def refine_windows(design: Design, explanation: Explanation) -> Explanation:
    """Return the explanation with the windows of its causes where they fit best.

    At least one of the causes must act in a window.
    """
    # The base was fitted without the window, so its rail is too rough: it took the effect of the
    # window for irregularity. On a rough rail the edges hardly show. So they are searched on a
    # smoother rail too, and there the irregularity is fitted again only when the edges are right.
    sigma = thresholds.SMOOTHER_RAIL_SHARE * explanation.sigma
    smooth = explanation._replace(sigma=sigma)
    smooth = fitting.fit(design, smooth, steps=4, noise=False).explanation
    smooth = _move_edges(design, smooth, _FIRST_STEP).explanation
    smooth = fitting.fit(design, smooth, steps=4).explanation
    best = min(
        _move_edges(design, explanation, _FIRST_STEP),
        _move_edges(design, smooth, _FIRST_STEP_ON_SMOOTHER_RAIL),
        key=_deviance,
    )

    others = [
        *_with_slow_edges(design, best.explanation),
        *_on_clean_rail_too(design, best.explanation),
    ]
    other = min(others, key=_deviance)
    if other.deviance < best.deviance - thresholds.RATIO_OF_OTHER_WINDOW:
        return other.explanation
    return best.explanation


def _deviance(shaped: _Shaped) -> float:
    return shaped.deviance


def patch_by_run(design: Design, explanation: Explanation, at: int) -> Explanation:
    """Return the explanation with the edges of patch number `at` moved in each run alone."""
    patch = explanation.causes[at]
    shape = {}
    for key, value in patch.shape.items():
        if key in ("start_m", "length_m"):
            for run in design.names:
                shape[f"{key} {run}"] = value
        else:
            shape[key] = value
    by_run = explanation.with_cause(at, patch._replace(shape=shape))
    return _move_edges(design, by_run, _FIRST_STEP).explanation


def _with_slow_edges(design: Design, explanation: Explanation) -> list[_Shaped]:
    """Return one explanation per patch and form of slow edges, with this patch changed."""
    shaped = []
    for at, cause in enumerate(explanation.causes):
        if cause.name != "contaminated_patch":
            continue
        for edges in _SLOW_EDGES:
            slow = explanation.with_cause(at, _slow_patch(cause, edges))
            shaped.append(_move_edges(design, slow, _FIRST_STEP_OF_SLOW_EDGES))
    return shaped


def _on_clean_rail_too(design: Design, explanation: Explanation) -> list[_Shaped]:
    """Return one explanation per window, in which this window acts on the clean rail too."""
    # `contaminant_alone` is a switch of a shape: 1 for the contaminant only, 0 for both
    contaminant_and_clean_rail = dict.fromkeys(table.CONTAMINANT_ALONE, 0.0)
    shaped = []
    for at, cause in enumerate(explanation.causes):
        if table.BY_NAME[cause.name].edge_step:
            other = cause._replace(shape=cause.shape | contaminant_and_clean_rail)
            changed = explanation.with_cause(at, other)
            fit = fitting.fit(design, changed, steps=3, noise=False)
            shaped.append(_Shaped(fit.explanation, fit.deviance))
    return shaped


def restarted(design: Design, explanation: Explanation, name: str) -> Explanation:
    """Return the explanation with a cause in its most likely shape, fitted from an untuned base.

    `name` is that of the cause. The base was fitted without it, so it explains its effect wrongly:
    by no recovery and by a rough rail. Small steps do not lead from there to the right values.
    """
    fits = []
    for shape in table.BY_NAME[name].shapes:
        causes = [
            cause._replace(shape=shape) if cause.name == name else cause
            for cause in explanation.causes
        ]
        begin = untuned(design)._replace(sigma=_ROUGH_START, causes=tuple(causes))
        # of the base only the friction levels are fitted
        fits.append(fitting.fit(design, begin, steps=5, noise=False, free=("ln_mu",)))
    return min(fits, key=lambda fit: fit.deviance).explanation


def refine_scales(design: Design, explanation: Explanation) -> Explanation:
    """Return the explanation with the scales of its causes where they fit best."""
    best = _Shaped(explanation, fitting.deviance(design, explanation))
    for at, cause in enumerate(explanation.causes):
        for key in cause.shape:
            if key not in table.BY_NAME[cause.name].scales:
                continue
            for factor in _FACTORS:
                move = partial(_with_scale, key, factor)
                best = _move_while_it_pays(
                    design, best, at, move, thresholds.RATIO_OF_SCALE_MOVE, fits_again=True
                )
    return best.explanation


def _move_while_it_pays(
    design: Design,
    best: _Shaped,
    at: int,
    move: Callable[[Cause], Cause],
    least_ratio: float,
    fits_again: bool,
) -> _Shaped:
    """Return the best explanation after the same move of cause number `at` is repeated.

    The moves stop when one reduces the deviance by `least_ratio` or less. With `fits_again` the
    coefficients are fitted again after each move; else they stay as they are.
    """
    for _ in range(_MOST_MOVES):
        cause = best.explanation.causes[at]
        moved = best.explanation.with_cause(at, move(cause))
        if moved == best.explanation:
            break  # the move is out of bounds
        if fits_again:
            fit = fitting.fit(design, moved, steps=2, noise=False)
            shaped = _Shaped(fit.explanation, fit.deviance)
        else:
            shaped = _Shaped(moved, fitting.deviance(design, moved))
        if shaped.deviance >= best.deviance - least_ratio:
            break
        best = shaped
    return best


def _with_scale(key: str, factor: float, cause: Cause) -> Cause:
    """Return a cause with another scale, or the same cause if that is out of bounds."""
    low, high = table.BY_NAME[cause.name].scales[key]
    scale = cause.shape[key] * factor
    if low <= scale <= high:
        return cause._replace(shape={**cause.shape, key: scale})
    return cause


def _slow_patch(cause: Cause, edges: _SlowEdges) -> Cause:
    """Return a patch with slow edges and about the same effect.

    Its mean depth over both slow edges is half, so it is wider at each end: its length times
    (1 - ramp / 2) is the length of the given patch.
    """
    wider_m = cause.shape["length_m"] * 0.5 * edges.ramp / (2.0 - edges.ramp)
    shape = {
        "start_m": cause.shape["start_m"] - wider_m,
        "length_m": cause.shape["length_m"] + 2.0 * wider_m,
        "ramp": edges.ramp,
    }
    depth = cause.values[0] * edges.deeper
    return fitting.within_bounds(cause._replace(shape=shape, values=(depth,)))


def _move_edges(design: Design, explanation: Explanation, first_step: float) -> _Shaped:
    """Return the best explanation after the edges of its windows are moved.

    `first_step` is the first size of a move, as a share of `edge_step` in the table of causes. A
    cause without a window has no step there and is skipped.
    """
    best = _Shaped(explanation, fitting.deviance(design, explanation))
    for at, cause in enumerate(explanation.causes):
        step = first_step * table.BY_NAME[cause.name].edge_step  # m or s
        if step == 0.0:
            continue
        edges = [key for key in cause.shape if key.startswith(("start_", "length_", "duration_"))]
        for _ in range(_EDGE_STEPS):
            for key in edges:
                for change in (step, -step):
                    move = partial(_with_edge, key, change)
                    best = _move_while_it_pays(
                        design, best, at, move, least_ratio=0.0, fits_again=False
                    )
            step *= 0.5
    return best


def _with_edge(key: str, change: float, cause: Cause) -> Cause:
    """Return a cause with one edge moved. A moved start keeps the end where it is."""
    shape = dict(cause.shape)
    shape[key] += change
    if key.startswith("start_"):
        # keys of sand end with the name of a run, as in "start_s A1": the rest of the key stays
        extent = key.replace("start_s", "duration_s").replace("start_m", "length_m")
        shape[extent] = max(shape[extent] - change, 0.0)

    # only the start of a patch may be negative: a place before the start of the run
    for name, value in shape.items():
        if not name.startswith("start_m"):
            shape[name] = max(value, 0.0)
    return cause._replace(shape=shape)
