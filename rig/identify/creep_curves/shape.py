"""The shape of a creep curve without a law: a smooth curve, and whether adhesion falls.

Each group of equal conditions has a curve of its creepage. The smooth curve shows the scatter of
the points. It is a cubic spline, or straight lines between the creepages where these are few and
repeated. Whether adhesion falls is judged without it, by the means m_b of n_b neighbours:

    [H1] T = sum_b n_b (m_b - i_b)^2, i_b: the best sequence that never falls (isotonic regression)

If adhesion never falls then the expected means never fall either, however sharply the curve bends.
T is compared with that of means i_b with errors as measured. Where neighbours share no errors these
are residuals with random signs (wild bootstrap), so errors may differ in size. Few residuals do not
show how errors differ in size. There the errors are normal, with the scatter of all points. Where
neighbours share errors these are an autoregressive series of the measured size:

    [H2] e_i = size_i z_i, z_i = r z_(i-1) + sqrt(1 - r^2) w_i, w_i normal

The size of errors is known from nu degrees of freedom only. So each series of errors is multiplied
by sqrt(nu / chi^2_nu), as in Student's t.

The smooth curve follows shared errors. So errors at large creepage are those about a parabola.
How far adhesion falls is taken from the smooth curve: from its maximum to the largest creepage.
Source: Barlow, Bartholomew, Bremner and Brunk, Statistical Inference under Order Restrictions
(1972); Wu, Annals of Statistics 14 (1986) 1261-1295 (wild bootstrap).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import isotonic_regression
from scipy.signal import lfilter

from rollerrig.rig.identify.statistics import simulated_test

# Groups with fewer points or fewer creepages share one curve.
LEAST_GROUP_POINTS = 16
LEAST_GROUP_CREEPAGES = 5

# Creepages are few if there are at most so many clusters, each narrow beside the gaps.
MOST_CLUSTERS = 12
CLUSTER_GAP = 0.02  # of the range of creepage
CLUSTER_WIDTH = 0.2  # of the smallest gap

# Numbers of inner knots of the spline that are tried. They are denser at small creepage, where
# curves bend: this is the exponent of their places among the points.
KNOTS = (1, 2, 3, 5, 8, 12)
DENSER = 1.5
POINTS_PER_COEFFICIENT = 3

# Means [H1] are of so many neighbours, or of fewer where there would be too few means; and there
# are at most so many means.
MEAN_POINTS = 4
LEAST_MEANS = 12
MOST_MEANS = 20

# Large creepage, where a parabola shows the errors, begins at this share of the largest creepage.
PARABOLA_FROM = 1.0 / 3.0
LEAST_PARABOLA_POINTS = 12
_PARABOLA_COEFFICIENTS = 3

# A fall is significant if by chance T were as large in one of 500 sets of data.
FALL_ALPHA = 0.002
# Replicates of the test; fewer if so many of them were by chance as large (`simulated_test`).
# Replicates of intervals, and of the smallest fall that is seen.
REPLICATES = 999
LEAST_REPLICATES = 199
ENOUGH_BY_CHANCE = 10
INTERVAL_REPLICATES = 200
SMALLEST_REPLICATES = 50
# share of sets of data in which the smallest fall would have been shown
POWER = 0.8
# fewer degrees of freedom do not show how errors differ in size
LEAST_WILD_FREEDOM = 60
# An autocorrelation above this, in standard deviations, counts. It is taken one deviation larger.
SHARED_ERRORS = 2.0
LARGEST_SHARED = 0.95
# points over which the size of shared errors is averaged
SIZE_POINTS = 15

# the rise towards the end begins at this share of the largest creepage
LATE = 2.0 / 3.0

# no smaller fall is sought
SMALLEST_FALL = 0.002
# the size of errors is taken as known from at least so many degrees of freedom
LEAST_FREEDOM = 5.0

# The scatter is at least this share of the largest adhesion, so that computed curves have one too.
LEAST_SCATTER = 0.001


class Group(NamedTuple):
    """The points of one curve, sorted by creepage, and the matrices of its fits."""

    points: np.ndarray  # places in the sorted curve
    creepage: np.ndarray
    basis: np.ndarray  # (n, m): functions that rise from 0 to 1
    nuisance: np.ndarray  # (n, k): the constant, and factors of conditions that vary within it
    hat: np.ndarray  # (n, n) of the free fit
    curve_hat: np.ndarray  # (n, n) of the curve in it, without the factors of conditions
    averaging: np.ndarray  # (means, n): weights of the points in the means [H1]
    counts: np.ndarray  # (means,): points of each mean


class Fall(NamedTuple):
    """Whether curves fall, from the test [H1], and how far."""

    p_value: float
    size: float  # share of the maximum that is lost at the end, mean over the curves
    low: float  # 95 % interval; 0 is in it unless the test [H1] rejects that nothing falls
    high: float
    smallest: float  # fall that these data would have shown
    peak_creepage: float
    points_beyond: int  # points beyond the maximum
    points_before: int
    rise: float  # share by which adhesion still rises over the last third of the range
    rise_low: float
    rise_high: float


class Shape(NamedTuple):
    """The smooth curves of all groups. Arrays (n,) in the order of the sorted points."""

    groups: list[Group]
    fitted: np.ndarray
    residual: np.ndarray
    error: np.ndarray  # residuals that no curve has followed
    coefficients: int
    scatter: float  # standard deviation of the points about their curve
    order: np.ndarray  # places of the points in the order in which neighbours share errors
    shared: float  # autocorrelation r of errors in this order [H2]; 0: they share none
    size: np.ndarray  # of the errors [H2], in the order of the points
    other_groups: list[Group]  # the same curves with other knots; without: the same knots

    @property
    def inflation(self) -> float:
        """Inflation of the variance of means by shared errors."""
        return (1.0 + self.shared) / (1.0 - self.shared)

    def errors(self, rng: np.random.Generator) -> np.ndarray:
        """Return errors as the measured ones, but drawn anew, (n,)."""
        known_from = max(self.freedom / self.inflation, LEAST_FREEDOM)
        unknown_size = math.sqrt(known_from / float(rng.chisquare(known_from)))
        return unknown_size * self._errors_of_measured_size(rng)

    def _errors_of_measured_size(self, rng: np.random.Generator) -> np.ndarray:
        if self.shared == 0.0 and self.freedom < LEAST_WILD_FREEDOM:
            return self.scatter * rng.standard_normal(self.error.size)
        if self.shared == 0.0:
            return rng.choice((-1.0, 1.0), size=self.error.size) * self.error
        white = rng.standard_normal(self.error.size)
        white[1:] *= math.sqrt(1.0 - self.shared**2)
        series = lfilter([1.0], [1.0, -self.shared], white)
        drawn = np.empty_like(series)
        drawn[self.order] = series
        return drawn * self.size

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the scatter."""
        return self.residual.size - self.coefficients


def fit(
    creepage: np.ndarray,
    adhesion: np.ndarray,
    group: np.ndarray,
    within: np.ndarray,
    file_order: np.ndarray,
) -> Shape:
    """Return the smooth curve of each group; all arrays are sorted by creepage.

    `within` (n, k) are columns of conditions that vary within a group; their products with the
    curve are fitted too.
    """
    members = [np.flatnonzero(group == number) for number in np.unique(group)]
    clusters = _clusters(creepage)
    tried: list[Shape] = []
    scores: list[float] = []
    for knots in KNOTS:
        smallest = min(part.size for part in members)
        if tried and smallest < POINTS_PER_COEFFICIENT * (knots + 4):
            break
        level = _level(creepage, adhesion)
        groups = [
            _group(part, creepage[part], clusters, knots, within[part] * level[part, None])
            for part in members
        ]
        shape = _smooth(groups, adhesion, file_order, are_clusters=clusters is not None)
        points = adhesion.size
        least = LEAST_SCATTER * float(np.max(np.abs(adhesion)))
        error = max(float(np.mean(shape.residual**2)), least**2)
        tried.append(shape)
        scores.append(points * math.log(error) + shape.coefficients * math.log(points))
        if clusters is not None:
            break
    best = int(np.argmin(scores))
    # the next finer curve; for the finest one the next coarser
    other = best + 1 if best + 1 < len(tried) else max(best - 1, 0)
    return tried[best]._replace(other_groups=tried[other].groups)


def _level(creepage: np.ndarray, adhesion: np.ndarray) -> np.ndarray:
    """Return a rough curve of all points: running means of neighbours."""
    width = max(adhesion.size // 10, 3)
    kernel = np.ones(width)
    count = np.convolve(np.ones(adhesion.size), kernel, "same")
    return np.convolve(adhesion, kernel, "same") / count


def _clusters(creepage: np.ndarray) -> np.ndarray | None:
    """Return the mean creepages of few repeated ones (m,); None where they are not few."""
    span = float(np.ptp(creepage))
    new = np.diff(creepage) > CLUSTER_GAP * span
    number = np.concatenate(([0], np.cumsum(new)))
    count = int(number[-1]) + 1
    if not 2 <= count <= MOST_CLUSTERS:
        return None
    means = np.array([creepage[number == k].mean() for k in range(count)])
    widths = np.array([np.ptp(creepage[number == k]) for k in range(count)])
    if widths.max() > CLUSTER_WIDTH * np.diff(means).min():
        return None
    return means


def distinct(creepage: np.ndarray) -> int:
    """Return how many different creepages there are."""
    clusters = _clusters(np.sort(creepage))
    if clusters is not None:
        return clusters.size
    return int(np.unique(creepage).size)


def _group(
    points: np.ndarray,
    creepage: np.ndarray,
    clusters: np.ndarray | None,
    knots: int,
    within: np.ndarray,
) -> Group:
    basis = _rising(creepage, clusters) if clusters is not None else _splines(creepage, knots)
    nuisance = np.column_stack([np.ones(creepage.size), within])
    everything = np.column_stack([nuisance, basis])
    averaging = _averaging(creepage, clusters)
    of_points = np.linalg.pinv(everything, rcond=1e-10)
    of_curve = of_points.copy()
    of_curve[1 : nuisance.shape[1]] = 0.0
    return Group(
        points=points,
        creepage=creepage,
        basis=basis,
        nuisance=nuisance,
        hat=everything @ of_points,
        curve_hat=everything @ of_curve,
        averaging=averaging,
        counts=np.count_nonzero(averaging, axis=1),
    )


def _averaging(creepage: np.ndarray, clusters: np.ndarray | None) -> np.ndarray:
    """Return the weights of points in the means of neighbours (means, n); creepage is sorted."""
    if clusters is not None:
        number = np.argmin(np.abs(creepage[:, None] - clusters), axis=1)
    else:
        least = min(creepage.size, LEAST_MEANS)
        means = int(np.clip(creepage.size // MEAN_POINTS, least, MOST_MEANS))
        number = np.arange(creepage.size) * means // creepage.size
        # equal creepages belong to one mean
        first_place = np.searchsorted(creepage, creepage, side="left")
        number = number[first_place]
    belongs = (np.unique(number)[:, None] == number).astype(float)
    return belongs / belongs.sum(axis=1, keepdims=True)


def _rising(creepage: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return ramps from node to node (n, nodes - 1); those without points inside are left out."""
    near = np.unique(np.argmin(np.abs(creepage[:, None] - nodes), axis=1))
    nodes = nodes[near]
    ramps = (creepage[:, None] - nodes[:-1]) / np.diff(nodes)
    return np.clip(ramps, 0.0, 1.0)


def _splines(creepage: np.ndarray, knots: int) -> np.ndarray:
    """Return rising splines (n, m) over equal numbers of points between knots [H1]."""
    places = np.linspace(0.0, 1.0, knots + 2)[1:-1] ** DENSER
    inner = np.unique(np.quantile(creepage, places))
    low = float(creepage[0])
    high = float(creepage[-1])
    inner = inner[(inner > low) & (inner < high)]
    knot_row = np.concatenate(([low] * 4, inner, [high] * 4))
    basis = BSpline.design_matrix(creepage, knot_row, 3).toarray()
    # sums of all later ones rise from 0 to 1
    return np.cumsum(basis[:, ::-1], axis=1)[:, ::-1][:, 1:]


def _smooth(
    groups: list[Group], adhesion: np.ndarray, file_order: np.ndarray, are_clusters: bool
) -> Shape:
    fitted = np.empty_like(adhesion)
    error = np.empty_like(adhesion)
    late = np.zeros(adhesion.size, dtype=bool)
    coefficients = 0
    for part in groups:
        here = adhesion[part.points]
        fitted[part.points] = part.hat @ here
        leverage = np.diag(part.hat)
        error[part.points] = (here - part.hat @ here) / np.sqrt(np.maximum(1.0 - leverage, 0.1))
        coefficients += round(float(np.trace(part.hat)))
        if are_clusters:
            continue
        is_late = part.creepage >= PARABOLA_FROM * part.creepage[-1]
        if is_late.sum() >= LEAST_PARABOLA_POINTS:
            places = part.points[is_late]
            error[places] = _about_a_parabola(part, is_late, here)
            late[places] = True

    residual = adhesion - fitted
    freedom = max(adhesion.size - coefficients, 1)
    scatter = math.sqrt(float(np.sum(residual**2)) / freedom)
    counted = late if late.any() else ~late
    followed_by = _PARABOLA_COEFFICIENTS if late.any() else 0
    order, shared = _shared(groups, error, counted, file_order, followed_by)
    size = np.empty_like(error)
    size[order] = _running_size(error[order])
    if shared > 0.0:
        # a parabola has followed some of the shared errors
        followed = followed_by * (1.0 + shared) / (1.0 - shared) / int(counted.sum())
        size /= math.sqrt(max(1.0 - followed, 0.25))
    return Shape(
        groups=groups,
        fitted=fitted,
        residual=residual,
        error=error,
        coefficients=coefficients,
        scatter=max(scatter, LEAST_SCATTER * float(np.max(np.abs(adhesion)))),
        order=order,
        shared=shared,
        size=size,
        other_groups=groups,
    )


def _about_a_parabola(part: Group, chosen: np.ndarray, adhesion: np.ndarray) -> np.ndarray:
    """Return the residuals of the chosen points of a group about a parabola of creepage."""
    creepage = part.creepage[chosen] / part.creepage[-1]
    columns = np.column_stack([creepage, creepage**2, part.nuisance[chosen]])
    hat = columns @ np.linalg.pinv(columns)
    left = adhesion[chosen] - hat @ adhesion[chosen]
    return left / np.sqrt(np.maximum(1.0 - np.diag(hat), 0.1))


def _running_size(error: np.ndarray) -> np.ndarray:
    """Return the root of the running mean of squares (n,)."""
    kernel = np.ones(min(SIZE_POINTS, error.size))
    count = np.convolve(np.ones(error.size), kernel, "same")
    return np.sqrt(np.convolve(error**2, kernel, "same") / count)


def _shared(
    groups: list[Group],
    error: np.ndarray,
    chosen: np.ndarray,
    file_order: np.ndarray,
    followed_by: int,
) -> tuple[np.ndarray, float]:
    """Return the order in which neighbours share errors, and their autocorrelation.

    Neighbours along the creepage of a group and along the file are tried. Only the chosen points
    (mask) count. A parabola, which has followed errors by 3 coefficients, lowers an autocorrelation
    r by about 3 (1 + 3 r) / n, which is added again (Marriott and Pope, Biometrika 41 (1954)
    390-402).
    """
    along_creepage = np.concatenate([part.points for part in groups])
    along_file = np.argsort(file_order)
    best_order = along_creepage
    best = 0.0
    deviation = 1.0 / math.sqrt(int(chosen.sum()))
    for order in (along_creepage, along_file):
        e = error[order[chosen[order]]]
        power = float(np.sum(e * e))
        shared = float(np.sum(e[1:] * e[:-1])) / power if power > 0.0 else 0.0
        if shared > 0.0:
            shared += followed_by * (1.0 + 3.0 * shared) / e.size
        if shared > best:
            best = shared
            best_order = order
    if best < SHARED_ERRORS * deviation:
        return best_order, 0.0
    return best_order, min(best + deviation, LARGEST_SHARED)


def fall(shape: Shape, adhesion: np.ndarray, seed: int) -> Fall:
    """Return whether the curves fall, how far, and what these data would have shown."""
    rng = np.random.default_rng(seed)
    curves = [part.curve_hat @ adhesion[part.points] for part in shape.groups]
    level = adhesion.copy()
    for part, curve in zip(shape.groups, curves, strict=True):
        # without the factors of conditions that vary within the group
        level[part.points] -= part.hat @ adhesion[part.points] - curve
    means = [part.averaging @ level[part.points] for part in shape.groups]
    never = [_never_falling(part, m) for part, m in zip(shape.groups, means, strict=True)]
    statistic = _statistic(shape.groups, means)

    def drawn_means() -> list[np.ndarray]:
        error = shape.errors(rng)
        return [part.averaging @ error[part.points] for part in shape.groups]

    def by_chance() -> float:
        again = [n + e for n, e in zip(never, drawn_means(), strict=True)]
        return _statistic(shape.groups, again)

    tested = simulated_test.p_value(
        statistic, by_chance, REPLICATES, LEAST_REPLICATES, ENOUGH_BY_CHANCE
    )
    drawn = [drawn_means() for _ in range(SMALLEST_REPLICATES)]

    measured = _falls_and_rises(shape.groups, curves)
    varied = []
    for _ in range(INTERVAL_REPLICATES):
        error = shape.errors(rng)
        again = [
            curve + part.curve_hat @ error[part.points]
            for part, curve in zip(shape.groups, curves, strict=True)
        ]
        varied.append(_falls_and_rises(shape.groups, again))
    falls = np.array([one.fall for one in varied])
    rises = np.array([one.rise for one in varied])
    # what another number of knots would have shown belongs to the intervals
    other_curves = [part.curve_hat @ adhesion[part.points] for part in shape.other_groups]
    other = _falls_and_rises(shape.other_groups, other_curves)
    by_knots = abs(other.fall - measured.fall)
    rise_by_knots = abs(other.rise - measured.rise)
    low = 2.0 * measured.fall - float(np.percentile(falls, 97.5)) - by_knots
    if tested.p_value > FALL_ALPHA:
        # no fall is what the test [H1] does not reject: it belongs to the interval
        low = min(low, 0.0)
    return Fall(
        p_value=tested.p_value,
        size=measured.fall,
        low=low,
        high=2.0 * measured.fall - float(np.percentile(falls, 2.5)) + by_knots,
        smallest=_smallest_fall(shape.groups, never, drawn, tested.critical(FALL_ALPHA)),
        peak_creepage=measured.peak_creepage,
        points_beyond=measured.beyond,
        points_before=measured.before,
        rise=measured.rise,
        rise_low=2.0 * measured.rise - float(np.percentile(rises, 97.5)) - rise_by_knots,
        rise_high=2.0 * measured.rise - float(np.percentile(rises, 2.5)) + rise_by_knots,
    )


def _smallest_fall(
    groups: list[Group],
    never: list[np.ndarray],
    drawn: list[list[np.ndarray]],
    critical: float,
) -> float:
    """Return the fall over the last third of the range that T [H1] would have shown.

    Such a curve rises no further from there on, and falls linearly in creepage by a share of its
    maximum. The result is inf where not even a fall to 0 is shown. `drawn` are errors of the means.
    T counts as shown above `critical`.
    """
    flat = []
    ramps = []
    for part, means in zip(groups, never, strict=True):
        begin = LATE * part.creepage[-1]
        places = part.averaging @ part.creepage
        along = np.clip((places - begin) / max(part.creepage[-1] - begin, 1e-12), 0.0, 1.0)
        top = float(np.interp(begin, places, means))
        flat.append(np.minimum(means, top))
        ramps.append(top * along)

    def is_shown(size: float) -> bool:
        shown = 0
        for errors in drawn:
            falling = [f - size * ramp + e for f, ramp, e in zip(flat, ramps, errors, strict=True)]
            shown += _statistic(groups, falling) > critical
        return shown >= POWER * len(drawn)

    low, high = 0.0, 1.0
    if not is_shown(high):
        return math.inf
    while high - low > 0.02 * high and high > SMALLEST_FALL:
        middle = 0.5 * (low + high)
        if is_shown(middle):
            high = middle
        else:
            low = middle
    return high


def _never_falling(part: Group, means: np.ndarray) -> np.ndarray:
    """Return the best sequence that never falls [H1]."""
    return isotonic_regression(means, weights=part.counts.astype(float)).x


def _statistic(groups: list[Group], means: list[np.ndarray]) -> float:
    """Return T [H1], summed over the groups."""
    total = 0.0
    for part, of_group in zip(groups, means, strict=True):
        left = of_group - _never_falling(part, of_group)
        total += float(part.counts @ left**2)
    return total


class _Sizes(NamedTuple):
    """Falls and rises of curves, as means over the groups; the place of the maximum."""

    fall: float
    rise: float
    peak_creepage: float
    beyond: int
    before: int


def _falls_and_rises(groups: list[Group], curves: list[np.ndarray]) -> _Sizes:
    """Return the sizes of falls and rises of the curves of all groups, each (n,)."""
    falls = []
    rises = []
    creepages = []
    beyond = 0
    before = 0
    for part, curve in zip(groups, curves, strict=True):
        peak = int(np.argmax(curve))
        level = max(abs(float(curve[peak])), 1e-12)
        end = float(curve[-1])
        begin = float(np.interp(LATE * part.creepage[-1], part.creepage, curve))
        falls.append((float(curve[peak]) - end) / level)
        rises.append((end - begin) / level)
        creepages.append(float(part.creepage[peak]))
        beyond += int(np.sum(part.creepage > part.creepage[peak]))
        before += int(np.sum(part.creepage < part.creepage[peak]))
    weights = [part.creepage.size for part in groups]
    return _Sizes(
        fall=float(np.average(falls, weights=weights)),
        rise=float(np.average(rises, weights=weights)),
        peak_creepage=float(np.median(creepages)),
        beyond=beyond,
        before=before,
    )
