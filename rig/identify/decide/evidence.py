"""Decides what the data supports: scores of all causes, judged by clean data of the same design.

Every cause has a score: how much likelihood its coefficients would win. The same search runs on
stops simulated from the fitted model, with nothing else in them; there every estimate has a bias
and a spread of its own, which nominal errors do not know. A cause counts when its estimate, less
that bias, lies outside that spread so far that among all causes a false alarm stays below 2 %.

    [E1] x = -S^-1 g, S and g the normal equations less what the base takes up (Schur complement)
    [E2] T = (x - mean)' S (x - mean) / scale, scale the mean of the same over clean sets
Source: Engle, Wald, likelihood ratio and Lagrange multiplier tests, Handbook of Econometrics 2 (1984).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from rollerrig.rig.identify.causes import columns, table
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import fitting

ALPHA_GENERIC = 0.005 / 13.0
FLOOR = 12.0
STANDS_OUT, NEAR_ALPHA = 4.0, 10.0  # times FLOOR; times the p-value that counts
MOST_BINS = 10


class Scores(NamedTuple):
    """Schur complement of all columns on the base: S (p, p), g (p,)."""

    S: np.ndarray
    g: np.ndarray


class ScoreTest(NamedTuple):
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
        return fitting.within_bounds(Cause(self.name, self.axle, self.shape, self.estimate))


def scores(normal: fitting.NormalEquations, keep: Sequence[str] = ()) -> Scores:
    """Scores of all columns [E1]; causes already in the explanation (`keep`) join the base."""
    base = fitting.base_columns(normal.matrix) + [
        c for c, column in enumerate(normal.matrix.columns) if column.cause in keep
    ]
    A, b = normal.A, normal.b
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A)[base], 1e-30))
    small = A[np.ix_(base, base)] * np.outer(scale, scale) + 1e-8 * np.eye(len(base))
    taken = np.linalg.solve(small, scale[:, None] * A[base])
    return Scores(A - (A[:, base] * scale) @ taken, b - taken.T @ (scale * b[base]))


def _coefficients(s: Scores, at: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Estimates [E1] of some columns and their part of S, of one set or of many at once."""
    S, g = s.S[..., np.array(at)[:, None], at], s.g[..., at]
    # out of the filter's range: says nothing
    known = np.isfinite(S).all(axis=(-2, -1)) & np.isfinite(g).all(axis=-1)
    S, g = np.where(known[..., None, None], S, np.zeros_like(S)), np.where(known[..., None], g, 0.0)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(S, axis1=-2, axis2=-1), 1e-30))
    scaled = S * (scale[..., :, None] * scale[..., None, :]) + 1e-6 * np.eye(len(at))
    return -scale * np.linalg.solve(scaled, (scale * g)[..., None])[..., 0], S


def _together(clean: Sequence[Scores]) -> Scores:
    return Scores(np.array([s.S for s in clean]), np.array([s.g for s in clean]))


def score_tests(
    design: Design, normal: fitting.NormalEquations, clean: list[Scores], known: Sequence[str] = ()
) -> list[ScoreTest]:
    """Best shape of every cause and smooth function, most significant first; `known` left out."""
    real = scores(normal, known)
    judged: dict[str, list[ScoreTest]] = {}
    together = _together(clean)
    for variant in normal.matrix.variants:
        if variant.cause not in known:
            judged.setdefault(variant.cause, []).append(_judge(real, together, variant))
    for window in (_patch(normal, real, clean), _sand(design, normal, real, clean)):
        if window is not None and window.name not in known:
            judged[window.name] = [window]
    best = [(max(shapes, key=lambda f: f.statistic), len(shapes)) for shapes in judged.values()]
    chosen = [
        f._replace(p_value=min(1.0, f.p_value * np.sqrt(trials)), trials=trials)
        for f, trials in best
    ]
    return sorted(chosen, key=lambda f: (f.p_value, -f.statistic))


def most_promising(design: Design, normal: fitting.NormalEquations, count: int) -> list[Cause]:
    """Causes of greatest nominal score, one shape of each, not yet judged by clean sets."""
    real = scores(normal)
    best: dict[str, tuple[float, Cause]] = {}
    for variant in normal.matrix.variants:
        if is_smooth_function(variant.cause):
            continue
        x, S = _coefficients(real, list(variant.columns))
        value = (0.0 if _wrong_sign(variant.cause, float(x[0])) else float(x @ S @ x)) - 3.0 * len(
            x
        )
        if value > (best[variant.cause][0] if variant.cause in best else 10.0):
            best[variant.cause] = (
                value,
                Cause(variant.cause, variant.axle, variant.shape, tuple(float(v) for v in x)),
            )
    # windows are searched, so they have to earn more
    still = [Scores(real.S, np.zeros_like(real.g))] * 2
    for window in (_patch(normal, real, still), _sand(design, normal, real, still)):
        if window is not None and window.statistic > 50.0:
            best[window.name] = (window.statistic - 40.0, window.cause())
    ranked = sorted(best.values(), key=lambda pair: -pair[0])[:count]
    return [fitting.within_bounds(cause) for _, cause in ranked]


def _judge(real: Scores, clean: Scores, variant: columns.Variant) -> ScoreTest:
    at, size, freedom = list(variant.columns), len(variant.columns), len(clean.g) - 1
    x, S = _coefficients(real, at)
    null, T = _coefficients(clean, at)
    bias = null.mean(axis=0)
    nominal = np.sqrt(np.maximum(np.diag(np.linalg.pinv(S)), 1e-30))
    off = np.einsum("ki,kij,kj->k", null - bias, T, null - bias)
    scale = max(float(off.mean()) * len(off) / freedom / size, 0.7)
    if variant.cause in table.BY_NAME:
        scale += (table.BY_NAME[variant.cause].floor / nominal[0]) ** 2
    statistic = float((x - bias) @ S @ (x - bias)) / scale
    if _wrong_sign(variant.cause, float(x[0] - bias[0])):
        statistic = 0.0
    return ScoreTest(
        name=variant.cause,
        axle=variant.axle,
        shape=variant.shape,
        estimate=tuple(x - bias),
        bias=tuple(bias),
        deviation=tuple(nominal * np.sqrt(scale)),
        statistic=statistic,
        p_value=float(fdtrc(size, freedom, max(statistic, 0.0) / size)),
        expected=float(np.einsum("ki,kij,kj->k", null, T, null).mean()),
        spread=float(np.sqrt(scale)),
    )


def score_test_of(
    normal: fitting.NormalEquations, clean: list[Scores], cause: Cause
) -> ScoreTest | None:
    """The finding of a cause in one given shape; None for a window."""
    same = normal.matrix.variant_of(cause)
    return None if same is None else _judge(scores(normal), _together(clean), same)


def _wrong_sign(cause: str, value: float) -> bool:
    """Whether a coefficient lies on the side of 0 where the cause does not exist."""
    row = table.BY_NAME.get(cause)
    return (
        row is not None and row.mechanism.parameters[0].low == 0.0 and value < 0.0 and not row.phase
    )


def _bins(normal: fitting.NormalEquations, owner: str) -> list[int]:
    return [c for c, column in enumerate(normal.matrix.columns) if column.cause == owner]


def _best_window(
    S: np.ndarray, g: np.ndarray, longest: int, sign: float
) -> tuple[int, int, float, float] | None:
    """(from, to, coefficient, T) of neighbouring bins of greatest T, among those whose coefficient has this sign."""
    found = []
    for low in range(len(g)):
        total, weight = 0.0, 0.0
        for high in range(low, min(low + longest, len(g))):
            total += g[high]
            weight += S[high, high] + 2.0 * S[low:high, high].sum()
            if weight > 1e-9 and -sign * total > 0.0:
                found.append((low, high + 1, float(-total / weight), float(total * total / weight)))
    return max(found, key=lambda window: window[3], default=None)


def _tail(value: float, null: np.ndarray) -> float:
    """Probability of a larger maximum, by a Gumbel law with the moments of the clean sets."""
    width = max(float(null.std(ddof=1)) * np.sqrt(6.0) / np.pi, 0.15 * float(null.mean()) + 0.3)
    return float(-np.expm1(-np.exp(-(value - (float(null.mean()) - 0.5772 * width)) / width)))


def _patch(normal: fitting.NormalEquations, real: Scores, clean: list[Scores]) -> ScoreTest | None:
    at = _bins(normal, "place_bin")
    if len(at) < 4:
        return None
    bias = np.mean([s.g[at] for s in clean], axis=0)
    seen, *ordinary = (
        _best_window(s.S[np.ix_(at, at)], s.g[at] - bias, MOST_BINS, -1.0) for s in (real, *clean)
    )
    if seen is None:
        return None
    null = np.array([window[3] if window else 0.0 for window in ordinary])
    low, high, x, T = seen
    shape = table.CONTAMINANT_ALONE | {
        "start_m": float(normal.matrix.columns[at[low]].label),
        "length_m": float((high - low) * columns.PLACE_BIN_M),
    }
    spread = max(float(np.sqrt(null.mean() / 8.0)), 1.0)
    return ScoreTest(
        "contaminated_patch",
        0,
        shape,
        (-x,),
        (0.0,),
        (spread * abs(x) / np.sqrt(max(T, 1e-9)),),
        T,
        _tail(T, null),
        float(null.mean()),
        spread,
    )


def _sand(
    design: Design, normal: fitting.NormalEquations, real: Scores, clean: list[Scores]
) -> ScoreTest | None:
    """Sand under all wheelsets, or not under the first: the better of both."""
    found = [
        _sand_on(design, normal, real, clean, owner, shape)
        for owner, shape in (
            ("time_bin", table.CONTAMINANT_ALONE),
            ("time_bin behind", table.CONTAMINANT_ALONE | {"behind": 1.0}),
        )
    ]
    return max(
        (f for f in found if f is not None), key=lambda f: f.statistic - f.expected, default=None
    )


def _sand_on(
    design: Design,
    normal: fitting.NormalEquations,
    real: Scores,
    clean: list[Scores],
    owner: str,
    shape: dict[str, float],
) -> ScoreTest | None:
    at = _bins(normal, owner)
    runs = [int(normal.matrix.columns[c].label.split()[0]) for c in at]
    bias = np.mean([s.g[at] for s in clean], axis=0)

    def scan(s: Scores) -> dict[int, tuple[int, int, float, float]]:
        chosen = {}
        for run in range(design.mass_kg.size):
            own = [k for k, r in enumerate(runs) if r == run]
            picked = [at[k] for k in own]
            window = _best_window(s.S[np.ix_(picked, picked)], s.g[picked] - bias[own], 6, 1.0)
            if window is not None:
                chosen[run] = window
        return chosen

    if not at:
        return None
    T, *ordinary = (float(sum(t for *_, t in scan(s).values())) for s in (real, *clean))
    null, shape, weights, sizes = np.array(ordinary), dict(shape), [], []
    for run, (low, high, x, t) in scan(real).items():
        if t > 0.5 * T / design.mass_kg.size:
            shape[f"start_s {design.names[run]}"] = float(low * columns.TIME_BIN_S)
            shape[f"duration_s {design.names[run]}"] = float((high - low) * columns.TIME_BIN_S)
            weights.append(t / max(x * x, 1e-12))
            sizes.append(x)
    if not sizes:
        return None
    x = float(np.average(sizes, weights=weights))
    spread = max(float(np.sqrt(null.mean() / (6.0 * len(sizes)))), 1.0)
    return ScoreTest(
        "sanding",
        0,
        shape,
        (x,),
        (0.0,),
        (spread / np.sqrt(sum(weights)),),
        T,
        _tail(T, null),
        float(null.mean()),
        spread,
    )


def is_smooth_function(name: str) -> bool:
    """Whether a finding is a smooth function and not a cause."""
    return name.startswith("along ")


def against(found: ScoreTest) -> str:
    """What a smooth function goes along, in words; which wheelset where it is that of one."""
    return found.name.removeprefix("along ").replace("one axle", f"axle {found.axle}")


def is_settled(found: Sequence[ScoreTest]) -> bool:
    """Whether more clean sets would hardly change what counts: one finding stands out, or none comes near its limit.

    A window may not be the one: its p-value does not know of how few clean sets it is.
    """
    near = [
        f
        for f in found
        if f.p_value < NEAR_ALPHA * _limit(f) and f.statistic - len(f.estimate) > 0.5 * FLOOR
    ]
    out = max(
        (f.statistic for f in near if is_significant(f, STANDS_OUT * FLOOR) and not _is_window(f)),
        default=0.0,
    )
    return not near or 0.0 < out > 2.0 * max(
        (f.statistic for f in near if _is_window(f)), default=0.0
    )


def _is_window(found: ScoreTest) -> bool:
    return not is_smooth_function(found.name) and table.BY_NAME[found.name].edge_step > 0.0


def is_significant(found: ScoreTest, floor: float = FLOOR) -> bool:
    """Whether a finding counts by itself."""
    return found.p_value < _limit(found) and found.statistic - len(found.estimate) > floor


def _limit(found: ScoreTest) -> float:
    return ALPHA_GENERIC if is_smooth_function(found.name) else table.BY_NAME[found.name].alpha
