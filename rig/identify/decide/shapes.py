"""Moves the shape of causes off the grid on which they were searched.

A window that stands half a bin beside the true one leaves a remainder at both edges, which would
look like another cause; so does a wrong scale of speed, time, work or heat. Edges are moved by ever
smaller steps while the likelihood grows, scales by factors, each with the coefficients fitted again.
A patch may also rise and fall slowly, and patch or sand act on the clean rail too, where that is the likelier form.
"""

from collections.abc import Callable
from functools import partial

from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation, untuned
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import fitting

_HALVINGS, _MOST_MOVES = 5, 8  # the first step of an edge is halved this often
_SMOOTHER = 0.3  # irregularity of the rail, of the base's, on which edges are sought first
# a patch with edges of this share of its length, and what its depth has to be for the same effect
_RAMPS = ((0.5, 1.1), (1.0, 1.3))
_RAMP_EARNS = 4.0  # likelihood that such edges must earn, or another friction
_FACTORS, _SCALE_EARNS = (1.5, 1.0 / 1.5, 1.2, 1.0 / 1.2), 1.0  # factors by which scales are moved
_BEGINS_ROUGH = (
    0.06  # irregularity with which a base is begun anew, so that all levels are in reach
)


def refine_windows(design: Design, explanation: Explanation) -> Explanation:
    """The explanation with the windows of its causes where they fit best."""
    # what a window explains has roughened the rail of the base, on which its edges hardly show: first on a smoother one
    smooth = fitting.fit(
        design, explanation._replace(sigma=_SMOOTHER * explanation.sigma), 4, False
    )[0]
    smooth = fitting.fit(design, _edges_moved(design, smooth, 1.0)[0], 4)[0]
    explanation, value = min(
        (_edges_moved(design, explanation, 1.0), _edges_moved(design, smooth, 0.25)),
        key=lambda pair: pair[1],
    )
    tried = [
        _edges_moved(design, explanation.with_cause(at, _ramped(cause, ramp, deeper)), 0.5)
        for at, cause in enumerate(explanation.causes)
        if cause.name == "contaminated_patch"
        for ramp, deeper in _RAMPS
    ]
    both = dict.fromkeys(table.CONTAMINANT_ALONE, 0.0)
    tried += [
        fitting.fit(
            design, explanation.with_cause(at, cause._replace(shape=cause.shape | both)), 3, False
        )[:2]
        for at, cause in enumerate(explanation.causes)
        if table.BY_NAME[cause.name].edge_step
    ]
    better, least = min(tried, key=lambda pair: pair[1])
    return better if least < value - _RAMP_EARNS else explanation


def restarted(design: Design, explanation: Explanation) -> Explanation:
    """The explanation with a memory in its likeliest form, its base begun anew: no small step leads there."""
    begun = [
        untuned(design)._replace(
            sigma=_BEGINS_ROUGH,
            causes=tuple(
                c._replace(shape=shape) if c.name == fitting.MEMORY else c
                for c in explanation.causes
            ),
        )
        for shape in table.BY_NAME[fitting.MEMORY].shapes
    ]
    return min(
        (fitting.fit(design, one, 5, False, free=("ln_mu",)) for one in begun),
        key=lambda fit: fit[1],
    )[0]


def refine_scales(design: Design, explanation: Explanation) -> Explanation:
    """The explanation with the scales of its causes where they fit best."""
    value = fitting.deviance(design, explanation)
    for at, cause in enumerate(explanation.causes):
        for key in [k for k in cause.shape if k in table.BY_NAME[cause.name].scales]:
            for by in _FACTORS:
                explanation, value = _while_it_pays(
                    design, explanation, value, at, partial(_scaled, key, by), True
                )
    return explanation


def _while_it_pays(
    design: Design,
    explanation: Explanation,
    value: float,
    at: int,
    moved: Callable[[Cause], Cause],
    fits: bool,
) -> tuple[Explanation, float]:
    """One cause moved again and again, with the coefficients fitted again or not."""
    for _ in range(_MOST_MOVES):
        tried = explanation.with_cause(at, moved(explanation.causes[at]))
        if tried == explanation:
            break
        tried, better = (
            fitting.fit(design, tried, 2, False)[:2]
            if fits
            else (tried, fitting.deviance(design, tried))
        )
        if better >= value - fits * _SCALE_EARNS:
            break
        explanation, value = tried, better
    return explanation, value


def _scaled(key: str, by: float, cause: Cause) -> Cause:
    """A cause with another scale, itself where that would be out of bounds."""
    low, high = table.BY_NAME[cause.name].scales[key]
    scale = cause.shape[key] * by
    return cause._replace(shape={**cause.shape, key: scale}) if low <= scale <= high else cause


def _ramped(cause: Cause, ramp: float, deeper: float) -> Cause:
    """A patch with slow edges about where it was."""
    wider = cause.shape["length_m"] * 0.5 * ramp / (2.0 - ramp)
    shape = {
        "start_m": cause.shape["start_m"] - wider,
        "length_m": cause.shape["length_m"] + 2.0 * wider,
        "ramp": ramp,
    }
    return fitting.within_bounds(cause._replace(shape=shape, values=(cause.values[0] * deeper,)))


def _edges_moved(
    design: Design, explanation: Explanation, first: float
) -> tuple[Explanation, float]:
    """Edges by steps that begin with a share `first` of the table's."""
    value = fitting.deviance(design, explanation)
    for at, cause in enumerate(explanation.causes):
        step = first * table.BY_NAME[cause.name].edge_step
        for _ in range(_HALVINGS if step else 0):
            for key in [k for k in cause.shape if k.startswith(("start_", "length_", "duration_"))]:
                for by in (step, -step):
                    explanation, value = _while_it_pays(
                        design, explanation, value, at, partial(_moved, key, by), False
                    )
            step *= 0.5
    return explanation, value


def _moved(key: str, change: float, cause: Cause) -> Cause:
    """A cause with one edge moved; a moved start keeps the end where it was."""
    shape = dict(cause.shape)
    shape[key] += change
    if key.startswith("start_"):
        end = key.replace("start_s", "duration_s").replace("start_m", "length_m")
        shape[end] = max(shape[end] - change, 0.0)
    return cause._replace(shape={k: v if k == "start_m" else max(v, 0.0) for k, v in shape.items()})
