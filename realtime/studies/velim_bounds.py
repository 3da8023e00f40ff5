"""How well the sliding of group B can be predicted at all from group A and the initial speeds.

Table 5's speed is all that is printed of a test before it runs, so whatever a model is, its prediction
for group B is a function of speed found on the three tests of group A. Here such functions are fitted
to the measured numbers themselves, as a model without any error of its own would, and judged on group B
by the mean absolute error. No model of the stop takes part.

Source: paper Tables 5 and 6. Least absolute values is the robust fit: it lets go of A3, which was
measured 1.3 m/s below B1 at the same speed.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import isotonic_regression

Rule = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Bound(NamedTuple):
    """A rule, what it predicts for group B and its mean absolute error there, in m/s."""

    name: str
    predicted_m_s: tuple[float, ...]
    error_m_s: float


def _robust_line(v: np.ndarray, s: np.ndarray, at: np.ndarray) -> np.ndarray:
    # a line of least absolute values runs through two of the points
    pairs = [[i, j] for i in range(len(v)) for j in range(i) if v[i] != v[j]]
    lines = [np.polyfit(v[pair], s[pair], 1) for pair in pairs]
    return np.polyval(min(lines, key=lambda line: float(np.abs(np.polyval(line, v) - s).sum())), at)


def _monotone(sign: float) -> Rule:
    def rule(v: np.ndarray, s: np.ndarray, at: np.ndarray) -> np.ndarray:
        order = np.argsort(v)
        return sign * np.interp(at, v[order], isotonic_regression(sign * s[order]).x)
    return rule


RULES: tuple[tuple[str, Rule], ...] = (
    ("one value, least squares (the mean)", lambda v, s, at: np.full(len(at), s.mean())),
    ("one value, least absolute (the median)", lambda v, s, at: np.full(len(at), np.median(s))),
    ("a line, least squares", lambda v, s, at: np.polyval(np.polyfit(v, s, 1), at)),
    ("a line, least absolute", _robust_line),
    ("rising with speed, least squares", _monotone(1.0)),
    ("falling with speed, least squares", _monotone(-1.0)),
    ("through all of group A", lambda v, s, at: np.interp(at, np.sort(v), s[np.argsort(v)])),
    ("the largest of group A, for all", lambda v, s, at: np.full(len(at), s.max())),
)


def bounds(speeds_m_s: Mapping[str, float], measured: Mapping[str, float], known: Sequence[str],
           predicted: Sequence[str]) -> list[Bound]:
    """Every rule found on the tests `known` and judged on the tests `predicted`; m/s."""
    v, s = (np.array([table[test] for test in known]) for table in (speeds_m_s, measured))
    at, truth = (np.array([table[test] for test in predicted]) for table in (speeds_m_s, measured))
    values = [(name, rule(v, s, at)) for name, rule in RULES]
    return [Bound(name, tuple(map(float, one)), float(np.abs(one - truth).mean())) for name, one in values]
