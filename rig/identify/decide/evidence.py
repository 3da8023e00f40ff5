"""Decides what the data supports: scores of all causes, judged by clean data of the same design.

Every cause has a score: how much likelihood its coefficients would win. The same search runs on
stops simulated from the fitted model, with nothing else in them; there every estimate has a bias
and a spread of its own, which nominal errors do not know. A cause counts when its estimate, less
that bias, lies outside that spread so far that among all causes a false alarm stays below 2 %.

    [E1] x = -S^-1 g, S and g the normal equations less what the base takes up (Schur complement)
    [E2] T = (x - mean)' S (x - mean) / scale, scale the mean of the same over clean sets
Source: Engle, Wald, likelihood ratio and Lagrange multiplier tests, Handbook of Econometrics 2
(1984).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from rollerrig.rig.identify.causes import columns, table
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.causes.columns import Variant
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import tuning
from rollerrig.rig.identify.decide.tuning import Normal

ALPHA_GENERIC = 0.005 / 13.0
FLOOR = 12.0
MOST_BINS = 10


class Scores(NamedTuple):
    """Schur complement of all columns on the base: S (p, p), g (p,)."""

    S: np.ndarray
    g: np.ndarray


class Finding(NamedTuple):
    """A cause in its best shape: statistic T with its p-value, estimate less bias, its deviation."""

    name: str
    axle: int
    shape: dict[str, float]
    estimate: tuple[float, ...]
    bias: tuple[float, ...]
    deviation: tuple[float, ...]
    statistic: float
    p_value: float
    expected: float  # mean of the uncorrected statistic on clean sets
    spread: float  # deviation of a coefficient over its nominal one
    trials: int = 1  # shapes and axles among which this one is the best

    def cause(self) -> Cause:
        """The cause to begin a fit with."""
        return tuning.bounded(Cause(self.name, self.axle, self.shape, self.estimate))


def scores(normal: Normal, keep: Sequence[str] = ()) -> Scores:
    """Scores of all columns [E1]; causes already in the explanation (`keep`) join the base."""
    base = tuning.base_columns(normal.matrix) + [
        c for c, column in enumerate(normal.matrix.columns) if column.cause in keep]
    A, b = normal.A, normal.b
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-30))
    small = A[np.ix_(base, base)] * np.outer(scale[base], scale[base])
    small += 1e-8 * np.eye(len(base))
    taken = np.linalg.solve(small, scale[base][:, None] * A[base])
    left = A[:, base] * scale[base]
    return Scores(A - left @ taken, b - taken.T @ (scale[base] * b[base]))


def _coefficients(s: Scores, at: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    S, g = s.S[np.ix_(at, at)], s.g[list(at)]
    if not (np.all(np.isfinite(S)) and np.all(np.isfinite(g))):
        return np.zeros(len(at)), np.zeros_like(S)  # out of the filter's range: says nothing
    scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-30))
    scaled = S * np.outer(scale, scale) + 1e-6 * np.eye(len(at))
    return -scale * np.linalg.solve(scaled, scale * g), S


def findings(design: Design, normal: Normal, clean: list[Scores],
             known: Sequence[str] = ()) -> list[Finding]:
    """Best shape of every cause and smooth function, most significant first; `known` left out."""
    real = scores(normal, known)
    best: dict[str, Finding] = {}
    trials: dict[str, int] = {}
    for variant in normal.matrix.variants:
        if variant.cause in known:
            continue
        found = _judge(real, clean, variant)
        trials[found.name] = trials.get(found.name, 0) + 1
        if found.name not in best or found.statistic > best[found.name].statistic:
            best[found.name] = found
    for window in (_patch(normal, real, clean), _sand(design, normal, real, clean)):
        if window is not None and window.name not in known:
            best[window.name], trials[window.name] = window, 1
    chosen = [f._replace(p_value=min(1.0, f.p_value * np.sqrt(trials[f.name])), trials=trials[f.name])
              for f in best.values()]
    return sorted(chosen, key=lambda f: (f.p_value, -f.statistic))


def likely(design: Design, normal: Normal, count: int) -> list[Cause]:
    """Causes of greatest nominal score, one shape of each, not yet judged by clean sets."""
    real = scores(normal)
    best: dict[str, tuple[float, Cause]] = {}
    for variant in normal.matrix.variants:
        if generic(variant.cause):
            continue
        x, S = _coefficients(real, list(variant.columns))
        value = 0.0 if _wrong_sign(variant.cause, float(x[0])) else float(x @ S @ x)
        value -= 3.0 * len(x)
        if value > (best[variant.cause][0] if variant.cause in best else 10.0):
            best[variant.cause] = (value, Cause(variant.cause, variant.axle, variant.shape,
                                                tuple(float(v) for v in x)))
    # windows are searched, so they have to earn more
    still = [Scores(real.S, np.zeros_like(real.g))] * 2
    for window in (_patch(normal, real, still), _sand(design, normal, real, still)):
        if window is not None and window.statistic > 50.0:
            best[window.name] = (window.statistic - 40.0, window.cause())
    ranked = sorted(best.values(), key=lambda pair: -pair[0])[:count]
    return [tuning.bounded(cause) for _, cause in ranked]


def _judge(real: Scores, clean: list[Scores], variant: Variant) -> Finding:
    at, size = list(variant.columns), len(variant.columns)
    x, S = _coefficients(real, at)
    null = [_coefficients(s, at) for s in clean]
    drawn = np.array([n[0] for n in null])
    bias = drawn.mean(axis=0)
    nominal = np.sqrt(np.maximum(np.diag(np.linalg.pinv(S)), 1e-30))
    off = np.array([(n - bias) @ T @ (n - bias) for n, T in null])
    freedom = len(clean) - 1
    scale = max(float(off.mean()) * len(clean) / freedom / size, 0.7)
    if variant.cause in table.OF:
        scale += (table.OF[variant.cause].floor / nominal[0]) ** 2
    statistic = float((x - bias) @ S @ (x - bias)) / scale
    raw = float(np.mean([n @ T @ n for n, T in null]))
    if _wrong_sign(variant.cause, float(x[0] - bias[0])):
        statistic = 0.0
    p_value = float(stats.f.sf(statistic / size, size, freedom))
    return Finding(variant.cause, variant.axle, variant.shape, tuple(x - bias), tuple(bias),
                   tuple(nominal * np.sqrt(scale)), statistic, p_value, raw, float(np.sqrt(scale)))


def finding_of(normal: Normal, clean: list[Scores], cause: Cause) -> Finding | None:
    """The finding of a cause in one given shape; None for a window."""
    for variant in normal.matrix.variants:
        if (variant.cause, variant.axle, variant.shape) == (cause.name, cause.axle, cause.shape):
            return _judge(scores(normal), clean, variant)
    return None


def _wrong_sign(cause: str, value: float) -> bool:
    """Whether a coefficient lies on the side of 0 where the cause does not exist."""
    row = table.OF.get(cause)
    return row is not None and row.mechanism.parameters[0].low == 0.0 and value < 0.0 and not row.phase


def _bins(normal: Normal, owner: str) -> list[int]:
    return [c for c, column in enumerate(normal.matrix.columns) if column.cause == owner]


def _windows(S: np.ndarray, g: np.ndarray, first: int, longest: int) -> np.ndarray:
    """(from, to, coefficient, T) of all windows of neighbouring bins with enough weight."""
    found = []
    for low in range(len(g)):
        total, weight = 0.0, 0.0
        for high in range(low, min(low + longest, len(g))):
            total += g[high]
            weight += S[high, high] + 2.0 * S[low:high, high].sum()
            if high - low + 1 >= first and weight > 1e-9:
                found.append((low, high + 1, -total / weight, total * total / weight))
    return np.array(found) if found else np.zeros((0, 4))


def _tail(value: float, null: np.ndarray) -> float:
    """Probability of a larger maximum, by a Gumbel law with the moments of the clean sets."""
    width = max(float(null.std(ddof=1)) * np.sqrt(6.0) / np.pi, 0.15 * float(null.mean()) + 0.3)
    return float(stats.gumbel_r.sf(value, float(null.mean()) - 0.5772 * width, width))


def _lowered(windows: np.ndarray) -> np.ndarray:
    return windows[windows[:, 2] < 0.0]


def _patch(normal: Normal, real: Scores, clean: list[Scores]) -> Finding | None:
    at = _bins(normal, "place_bin")
    if len(at) < 4:
        return None
    grid = np.ix_(at, at)
    bias = np.mean([s.g[at] for s in clean], axis=0)
    null = np.array([_lowered(_windows(s.S[grid], s.g[at] - bias, 1, MOST_BINS))[:, 3].max(initial=0.0)
                     for s in clean])
    seen = _lowered(_windows(real.S[grid], real.g[at] - bias, 1, MOST_BINS))
    if not len(seen):
        return None
    low, high, x, T = seen[np.argmax(seen[:, 3])]
    label = float(normal.matrix.columns[at[int(low)]].label)
    length = (high - low) * columns.PLACE_BIN_M
    spread = max(float(np.sqrt(null.mean() / 8.0)), 1.0)
    return Finding("contaminated_patch", 0, {"start_m": label, "length_m": float(length)}, (-x,),
                   (0.0,), (spread * abs(x) / np.sqrt(max(T, 1e-9)),), float(T),
                   _tail(float(T), null), float(null.mean()), spread)


def _sand(design: Design, normal: Normal, real: Scores, clean: list[Scores]) -> Finding | None:
    """Sand under all wheelsets, or not under the first: the better of both."""
    found = [_sand_on(design, normal, real, clean, owner, shape)
             for owner, shape in (("time_bin", {}), ("time_bin behind", {"behind": 1.0}))]
    return max((f for f in found if f is not None), key=lambda f: f.statistic - f.expected,
               default=None)


def _sand_on(design: Design, normal: Normal, real: Scores, clean: list[Scores], owner: str,
             shape: dict[str, float]) -> Finding | None:
    at = _bins(normal, owner)
    runs = [int(normal.matrix.columns[c].label.split()[0]) for c in at]
    bias = np.mean([s.g[at] for s in clean], axis=0)

    def scan(s: Scores) -> tuple[float, dict[int, np.ndarray]]:
        chosen, total = {}, 0.0
        for run in range(design.mass_kg.size):
            own = [k for k, r in enumerate(runs) if r == run]
            picked = [at[k] for k in own]
            windows = _windows(s.S[np.ix_(picked, picked)], s.g[picked] - bias[own], 1, 6)
            windows = windows[windows[:, 2] > 0.0] if len(windows) else windows
            if len(windows):
                chosen[run] = windows[np.argmax(windows[:, 3])]
                total += chosen[run][3]
        return total, chosen

    if not at:
        return None
    null = np.array([scan(s)[0] for s in clean])
    T, chosen = scan(real)
    shape, weights, sizes = dict(shape), [], []
    for run, (low, high, x, t) in chosen.items():
        if t > 0.15 * T:
            shape[f"start_s {design.names[run]}"] = float(low * columns.TIME_BIN_S)
            shape[f"duration_s {design.names[run]}"] = float((high - low) * columns.TIME_BIN_S)
            weights.append(t / max(x * x, 1e-12))
            sizes.append(x)
    if not sizes:
        return None
    x = float(np.average(sizes, weights=weights))
    spread = max(float(np.sqrt(null.mean() / (6.0 * len(sizes)))), 1.0)
    return Finding("sanding", 0, shape, (x,), (0.0,), (spread / np.sqrt(sum(weights)),), float(T),
                   _tail(T, null), float(null.mean()), spread)


def generic(name: str) -> bool:
    """Whether a finding is a smooth function and not a cause."""
    return name.startswith("along ")


def against(found: Finding) -> str:
    """What a smooth function goes along, in words; which wheelset where it is that of one."""
    name = found.name.removeprefix("along ")
    return name.replace("one axle", f"axle {found.axle}") if found.axle else name


def significant(found: Finding, floor: float = FLOOR) -> bool:
    """Whether a finding counts by itself."""
    limit = ALPHA_GENERIC if generic(found.name) else table.OF[found.name].alpha
    return found.p_value < limit and found.statistic - len(found.estimate) > floor
