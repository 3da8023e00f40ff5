"""Moves the edges of patches and sanding off the grid of bins on which they were searched.

A window that stands half a bin beside the true one leaves a remainder at both edges, which would
look like another cause. The edges are moved by ever smaller steps while the likelihood grows.
"""

from rollerrig.rig.identify import tuning
from rollerrig.rig.identify.candidates import Cause, Explanation
from rollerrig.rig.identify.preparation import Design

# first step of an edge in m or s, halved this often
_STEPS = {"contaminated_patch": 12.0, "sanding": 1.0}
_HALVINGS, _MOST_MOVES = 3, 8


def refined(design: Design, told: Explanation) -> Explanation:
    """The explanation with the windows of its causes where they fit best."""
    value = tuning.deviance(design, told)
    for at, cause in enumerate(told.causes):
        step = _STEPS.get(cause.name, 0.0)
        for _ in range(_HALVINGS if step else 0):
            for key in [k for k in cause.shape if k.startswith(("start_", "length_", "duration_"))]:
                for change in (step, -step):
                    told, value = _as_far_as_it_pays(design, told, value, at, key, change)
            step *= 0.5
    return told


def _as_far_as_it_pays(design: Design, told: Explanation, value: float, at: int, key: str,
                       change: float) -> tuple[Explanation, float]:
    for _ in range(_MOST_MOVES):
        tried = _with(told, at, _moved(told.causes[at], key, change))
        better = tuning.deviance(design, tried)
        if better >= value:
            break
        told, value = tried, better
    return told, value


def _moved(cause: Cause, key: str, change: float) -> Cause:
    """A cause with one edge moved; a moved start keeps the end where it was."""
    shape = dict(cause.shape)
    shape[key] += change
    if key.startswith("start_"):
        end = key.replace("start_s", "duration_s").replace("start_m", "length_m")
        shape[end] = max(shape[end] - change, 0.0)
    return cause._replace(shape={k: v if k == "start_m" else max(v, 0.0) for k, v in shape.items()})


def _with(told: Explanation, at: int, cause: Cause) -> Explanation:
    return told._replace(causes=(*told.causes[:at], cause, *told.causes[at + 1:]))
