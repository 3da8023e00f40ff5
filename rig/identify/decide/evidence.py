"""Judges every cause and every smooth function by a score test, calibrated on null simulations.

The score of a cause is the likelihood that its coefficients would win. The same search runs on null
simulations: stops simulated from the fitted model with no further cause in them. There every
estimate has a bias and a spread that nominal errors do not contain. A cause counts if its estimate,
less the bias, is so far outside the spread that the false alarms of all causes together stay below
2 %.

    [E1] x = -S^-1 g, S and g the normal equations less what the base absorbs (Schur complement)
    [E2] T = (x - mean)' S (x - mean) / scale, scale the mean of the same over null simulations
Source: Engle, Wald, likelihood ratio and Lagrange multiplier tests, Handbook of Econometrics 2
(1984).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from rollerrig.rig.identify.causes import columns, table
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import fitting, thresholds

EULER_GAMMA = 0.5772  # mean of the standard Gumbel distribution

# owners of the columns that the search for windows adds up, as `columns` names them
PLACE_BINS = "place_bin"
TIME_BINS = "time_bin"
TIME_BINS_BEHIND = "time_bin behind"  # on all wheelsets but the first


class Scores(NamedTuple):
    """Scores of all columns: the normal equations less what the base absorbs [E1]."""

    S: np.ndarray  # (columns, columns) information
    g: np.ndarray  # (columns,) gradient


class ScoreTest(NamedTuple):
    """The score test of a cause, or of a smooth function, in its best shape."""

    name: str  # of the cause, or "along ..." of a smooth function
    axle: int  # 0: all axles, -n: bogie n
    shape: dict[str, float]  # parameters of the shape, in their units
    estimate: tuple[float, ...]  # coefficients less the bias, in the units of the cause
    bias: tuple[float, ...]  # mean of the estimates on null simulations
    deviation: tuple[float, ...]  # standard deviation of each coefficient
    statistic: float  # T of [E2]
    p_value: float
    expected: float  # mean of the statistic on null simulations before its correction
    spread: float  # standard deviation of a coefficient over its nominal one
    trials: int = 1  # number of shapes and axles of which this is the best
    near: tuple["ScoreTest", ...] = ()  # of the same cause in other shapes, nearly as significant
    # degrees of freedom of `deviation`: null simulations less 1
    freedom: float = math.inf
    smallest: float = math.nan  # size that these runs show in half of the cases (`decide.smallest`)

    @property
    def spread_by_chance(self) -> float:
        """The spread without the numerical errors of the filter (`floor`)."""
        nominal = self.deviation[0] / self.spread
        floor = table.BY_NAME[self.name].floor if self.name in table.BY_NAME else 0.0
        return math.sqrt(max(self.spread**2 - (floor / nominal) ** 2, 0.0))

    def cause(self) -> Cause:
        """Return the cause from which a fit starts."""
        return fitting.within_bounds(Cause(self.name, self.axle, self.shape, self.estimate))


class Window(NamedTuple):
    """Neighbouring bins, and the effect in them."""

    first: int  # number of the first bin
    end: int  # number behind the last bin
    coefficient: float  # ln of the friction
    statistic: float


def scores(
    normal: fitting.NormalEquations, keep: Sequence[str] = (), without: Sequence[int] = ()
) -> Scores:
    """Return the scores of all columns [E1]; causes in the model already (`keep`) join the base.

    The columns `without` of the base do not absorb anything.
    """
    kept = [c for c, column in enumerate(normal.matrix.columns) if column.cause in keep]
    base = [c for c in fitting.base_columns(normal.matrix) if c not in without] + kept
    A = normal.A
    b = normal.b

    # scaled columns: their sizes differ by many powers of ten
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A)[base], 1e-30))
    # equations of an unstable replay are not finite, which `goodness` checks
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = A[np.ix_(base, base)] * np.outer(scale, scale) + 1e-8 * np.eye(len(base))
        absorbed = np.linalg.solve(scaled, scale[:, None] * A[base])
        return Scores(
            S=A - (A[:, base] * scale) @ absorbed,
            g=b - absorbed.T @ (scale * b[base]),
        )


def estimated(s: Scores, at: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimates [E1] of some columns and their part of S.

    The scores are those of one data set, or of many that are stacked.
    """
    S = s.S[..., np.array(at)[:, None], at]
    g = s.g[..., at]

    # a data set in which the columns leave the range of the filter has no information: all are 0
    known = np.isfinite(S).all(axis=(-2, -1)) & np.isfinite(g).all(axis=-1)
    S = np.where(known[..., None, None], S, np.zeros_like(S))
    g = np.where(known[..., None], g, 0.0)

    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(S, axis1=-2, axis2=-1), 1e-30))
    scaled = S * (scale[..., :, None] * scale[..., None, :]) + 1e-6 * np.eye(len(at))
    return -scale * np.linalg.solve(scaled, (scale * g)[..., None])[..., 0], S


def stacked(nulls: Sequence[Scores]) -> Scores:
    """Return the scores of many data sets as one, with the data sets along the first dimension."""
    return Scores(S=np.array([s.S for s in nulls]), g=np.array([s.g for s in nulls]))


def score_tests(
    design: Design,
    normal: fitting.NormalEquations,
    nulls: list[Scores],
    known: Sequence[str] = (),
) -> list[ScoreTest]:
    """Return the tests of all causes and smooth functions, the most significant one first.

    Each is in its best shape. `known` causes are in the model already and are left out.
    """
    measured = scores(normal, known)
    all_nulls = stacked(nulls)

    by_name: dict[str, list[ScoreTest]] = {}
    for variant in normal.matrix.variants:
        if variant.cause not in known:
            tests = by_name.setdefault(variant.cause, [])
            tests.append(_test_variant(measured, all_nulls, variant))
    for window in _test_windows(design, normal, measured, nulls):
        if window.name not in known:
            by_name[window.name] = [window]

    best_tests = []
    for tests in by_name.values():
        trials = len(tests)
        best = max(tests, key=lambda test: test.statistic)
        # the best of several shapes is less significant than one shape alone
        p_value = min(1.0, best.p_value * np.sqrt(trials))
        near = [
            test._replace(trials=trials)
            for test in tests
            if test is not best
            and test.axle == best.axle
            and test.statistic > thresholds.NEAR_SHAPE_SHARE * best.statistic
        ]
        best_tests.append(best._replace(p_value=p_value, trials=trials, near=tuple(near)))
    return sorted(best_tests, key=lambda test: (test.p_value, -test.statistic))


def most_promising(design: Design, normal: fitting.NormalEquations, count: int) -> list[Cause]:
    """Return the causes of the largest nominal score, one shape of each.

    Null simulations have not judged them yet.
    """
    measured = scores(normal)
    best: dict[str, tuple[float, Cause]] = {}
    for variant in normal.matrix.variants:
        if is_smooth_function(variant.cause):
            continue
        x, S = estimated(measured, list(variant.columns))
        statistic = 0.0
        if not _has_wrong_sign(variant.cause, float(x[0])):
            statistic = float(x @ S @ x)
        value = statistic - thresholds.PROMISING_COST * len(x)

        least = thresholds.PROMISING_FLOOR
        if variant.cause in best:
            least, _ = best[variant.cause]
        if value > least:
            coefficients = tuple(float(v) for v in x)
            cause = Cause(variant.cause, variant.axle, variant.shape, coefficients)
            best[variant.cause] = (value, cause)

    # windows are the best of many, so they have to win more; empty data sets replace the nulls
    nothing = [Scores(S=measured.S, g=np.zeros_like(measured.g))] * 2
    for window in _test_windows(design, normal, measured, nothing):
        if window.statistic > thresholds.PROMISING_WINDOW_FLOOR:
            value = window.statistic - thresholds.PROMISING_WINDOW_COST
            best[window.name] = (value, window.cause())

    ranked = sorted(best.values(), key=lambda pair: -pair[0])[:count]
    return [fitting.within_bounds(cause) for _, cause in ranked]


def _test_variant(measured: Scores, nulls: Scores, variant: columns.Variant) -> ScoreTest:
    """Return the test of a cause in one shape; `nulls` are stacked."""
    at = list(variant.columns)
    size = len(at)
    freedom = len(nulls.g) - 1
    x, S = estimated(measured, at)
    null_x, null_S = estimated(nulls, at)

    bias = null_x.mean(axis=0)
    nominal = np.sqrt(np.maximum(np.diag(np.linalg.pinv(S)), 1e-30))
    off = np.einsum("ki,kij,kj->k", null_x - bias, null_S, null_x - bias)
    scale = max(float(off.mean()) * len(off) / freedom / size, thresholds.LEAST_SCALE)
    if variant.cause in table.BY_NAME:
        # what the numerics of the filter can pretend
        scale += (table.BY_NAME[variant.cause].floor / nominal[0]) ** 2

    statistic = float((x - bias) @ S @ (x - bias)) / scale  # [E2]
    if _has_wrong_sign(variant.cause, float(x[0] - bias[0])):
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
        expected=float(np.einsum("ki,kij,kj->k", null_x, null_S, null_x).mean()),
        spread=float(np.sqrt(scale)),
        freedom=float(freedom),
    )


def score_test_of(
    normal: fitting.NormalEquations, nulls: list[Scores], cause: Cause
) -> ScoreTest | None:
    """Return the test of a cause in its present shape; None for a window, which has no columns."""
    variant = normal.matrix.variant_of(cause)
    if variant is None:
        return None
    return _test_variant(scores(normal), stacked(nulls), variant)


def _has_wrong_sign(cause: str, value: float) -> bool:
    """Return whether a coefficient is on the side of 0 where the cause does not exist."""
    row = table.BY_NAME.get(cause)
    if row is None or row.phase:
        return False
    return row.mechanism.parameters[0].low == 0.0 and value < 0.0


# --- causes that act in a window of place or time ---


def _test_windows(
    design: Design, normal: fitting.NormalEquations, measured: Scores, nulls: list[Scores]
) -> list[ScoreTest]:
    """Return the tests of a patch and of sand, each where it can be tested."""
    tests = [
        _test_patch(normal, measured, nulls),
        _test_sand(design, normal, measured, nulls),
    ]
    return [test for test in tests if test is not None]


def bins(normal: fitting.NormalEquations, owner: str) -> list[int]:
    """Return the numbers of the columns of bins."""
    return [c for c, column in enumerate(normal.matrix.columns) if column.cause == owner]


def runs_of_bins(normal: fitting.NormalEquations, at: Sequence[int]) -> list[int]:
    """Return the number of the run of each bin of time; `at` are the numbers of their columns."""
    return [int(normal.matrix.columns[c].label.split()[0]) for c in at]


def best_window(S: np.ndarray, g: np.ndarray, longest: int, sign: float) -> Window | None:
    """Return the neighbouring bins of the largest statistic whose coefficient has this sign."""
    best = None
    for low in range(len(g)):
        gradient = 0.0
        information = 0.0
        for high in range(low, min(low + longest, len(g))):
            gradient += g[high]
            information += S[high, high] + 2.0 * S[low:high, high].sum()
            if information > 1e-9 and -sign * gradient > 0.0:
                statistic = float(gradient * gradient / information)
                if best is None or statistic > best.statistic:
                    best = Window(low, high + 1, float(-gradient / information), statistic)
    return best


def gumbel_tail(value: float, null: np.ndarray) -> float:
    """Return the probability of a larger maximum, by a Gumbel law with the moments of the nulls."""
    mean = float(null.mean())
    least_width = thresholds.LEAST_GUMBEL_SHARE * mean + thresholds.LEAST_GUMBEL_WIDTH
    width = max(float(null.std(ddof=1)) * np.sqrt(6.0) / np.pi, least_width)
    mode = mean - EULER_GAMMA * width
    return float(-np.expm1(-np.exp(-(value - mode) / width)))


def best_patch(s: Scores, at: Sequence[int], bias: np.ndarray) -> Window | None:
    """Return the best patch, where friction is lower; `at` are the numbers of the bins of place."""
    places = np.ix_(at, at)
    return best_window(s.S[places], s.g[at] - bias, thresholds.MOST_PATCH_BINS, sign=-1.0)


def _test_patch(
    normal: fitting.NormalEquations, measured: Scores, nulls: list[Scores]
) -> ScoreTest | None:
    """Return the test of a contaminated patch, None if the runs are too short for a patch."""
    at = bins(normal, PLACE_BINS)
    if len(at) < 4:
        return None
    bias = np.mean([s.g[at] for s in nulls], axis=0)

    window = best_patch(measured, at, bias)
    if window is None:
        return None
    null_statistics = []
    for null_scores in nulls:
        null_window = best_patch(null_scores, at, bias)
        null_statistics.append(0.0 if null_window is None else null_window.statistic)
    null = np.array(null_statistics)

    spread = max(float(np.sqrt(null.mean() / thresholds.ORDINARY_PATCH_STATISTIC)), 1.0)
    deviation = spread * abs(window.coefficient) / np.sqrt(max(window.statistic, 1e-9))
    shape = table.CONTAMINANT_ALONE | {
        "start_m": float(normal.matrix.columns[at[window.first]].label),
        "length_m": float((window.end - window.first) * columns.PLACE_BIN_M),
    }
    return ScoreTest(
        name="contaminated_patch",
        axle=0,
        shape=shape,
        estimate=(-window.coefficient,),
        bias=(0.0,),
        deviation=(deviation,),
        statistic=window.statistic,
        p_value=gumbel_tail(window.statistic, null),
        expected=float(null.mean()),
        spread=spread,
        freedom=float(len(nulls) - 1),
    )


def _test_sand(
    design: Design, normal: fitting.NormalEquations, measured: Scores, nulls: list[Scores]
) -> ScoreTest | None:
    """Return the better test of two: sand under all wheelsets, or under all but the first."""
    under_all = _test_sand_on(design, normal, measured, nulls, TIME_BINS, table.CONTAMINANT_ALONE)
    behind_first = _test_sand_on(
        design, normal, measured, nulls, TIME_BINS_BEHIND, table.CONTAMINANT_ALONE | {"behind": 1.0}
    )
    tests = [test for test in (under_all, behind_first) if test is not None]
    return max(tests, key=lambda test: test.statistic - test.expected, default=None)


def best_sand(
    s: Scores, at: Sequence[int], run_of_bin: Sequence[int], bias: np.ndarray
) -> dict[int, Window]:
    """Return the best window of each run, where friction is higher.

    `at` are the numbers of the bins of time, `run_of_bin` and `bias` their runs and biases.
    """
    windows = {}
    for run in sorted(set(run_of_bin)):
        places = [k for k, of_run in enumerate(run_of_bin) if of_run == run]
        picked = [at[k] for k in places]
        window = best_window(
            s.S[np.ix_(picked, picked)],
            s.g[picked] - bias[places],
            thresholds.MOST_SAND_BINS,
            sign=1.0,
        )
        if window is not None:
            windows[run] = window
    return windows


def _test_sand_on(
    design: Design,
    normal: fitting.NormalEquations,
    measured: Scores,
    nulls: list[Scores],
    owner: str,
    shape: dict[str, float],
) -> ScoreTest | None:
    """Return the test of sand at one time in each run, None if friction is higher nowhere."""
    at = bins(normal, owner)
    if not at:
        return None
    run_of_bin = runs_of_bins(normal, at)
    bias = np.mean([s.g[at] for s in nulls], axis=0)
    runs = design.mass_kg.size

    def search(s: Scores) -> dict[int, Window]:
        return best_sand(s, at, run_of_bin, bias)

    def total(windows: dict[int, Window]) -> float:
        return float(sum(window.statistic for window in windows.values()))

    windows = search(measured)
    statistic = total(windows)
    null = np.array([total(search(s)) for s in nulls])

    # sand is in the runs that have their share of the evidence
    shape = dict(shape)
    coefficients: list[float] = []
    weights: list[float] = []
    for run, window in windows.items():
        if window.statistic > thresholds.SAND_SHARE_OF_RUN * statistic / runs:
            name = design.names[run]
            shape[f"start_s {name}"] = float(window.first * columns.TIME_BIN_S)
            shape[f"duration_s {name}"] = float((window.end - window.first) * columns.TIME_BIN_S)
            coefficients.append(window.coefficient)
            weights.append(window.statistic / max(window.coefficient * window.coefficient, 1e-12))
    if not coefficients:
        return None

    ordinary = thresholds.ORDINARY_SAND_STATISTIC * len(coefficients)
    spread = max(float(np.sqrt(null.mean() / ordinary)), 1.0)
    return ScoreTest(
        name="sanding",
        axle=0,
        shape=shape,
        estimate=(float(np.average(coefficients, weights=weights)),),
        bias=(0.0,),
        deviation=(spread / np.sqrt(sum(weights)),),
        statistic=statistic,
        p_value=gumbel_tail(statistic, null),
        expected=float(null.mean()),
        spread=spread,
        freedom=float(len(nulls) - 1),
    )


# --- which tests count ---


def is_smooth_function(name: str) -> bool:
    """Return whether a name is that of a smooth function, not of a cause."""
    return name.startswith("along ")


def is_significant(test: ScoreTest, floor: float = thresholds.SCORE_FLOOR) -> bool:
    """Return whether a test counts by itself."""
    return test.p_value < alpha_of(test) and test.statistic - len(test.estimate) > floor


def alpha_of(test: ScoreTest) -> float:
    """Return the largest p-value with which a test counts."""
    if is_smooth_function(test.name):
        return thresholds.ALPHA_SMOOTH_FUNCTION
    return table.BY_NAME[test.name].alpha


def is_settled(tests: Sequence[ScoreTest]) -> bool:
    """Return whether more null simulations would hardly change what counts.

    Either one test is clearly significant, or none is near its limit. A clear test of a window
    does not suffice: its p-value does not take into account how few null simulations there are.
    """
    near = [test for test in tests if _is_near_limit(test)]
    if not near:
        return True

    clear_statistic = 0.0
    window_statistic = 0.0
    for test in near:
        if _is_window(test):
            window_statistic = max(window_statistic, test.statistic)
        elif is_significant(test, thresholds.CLEAR_FACTOR * thresholds.SCORE_FLOOR):
            clear_statistic = max(clear_statistic, test.statistic)
    is_clear = clear_statistic > 0.0
    return is_clear and clear_statistic > thresholds.CLEAR_OF_WINDOWS * window_statistic


def _is_near_limit(test: ScoreTest) -> bool:
    """Return whether more null simulations could change whether a test counts."""
    least = thresholds.NEAR_SHARE * thresholds.SCORE_FLOOR
    is_likely = test.p_value < thresholds.NEAR_FACTOR * alpha_of(test)
    return is_likely and test.statistic - len(test.estimate) > least


def _is_window(test: ScoreTest) -> bool:
    return not is_smooth_function(test.name) and table.BY_NAME[test.name].edge_step > 0.0
