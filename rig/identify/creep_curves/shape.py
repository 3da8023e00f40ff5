"""The shape of a creep curve without a law: a smooth curve, and whether adhesion falls.

Each group of equal conditions has a curve of its creepage. The smooth curve shows the scatter of
the points. It is a cubic spline, or straight lines between the creepages where these are few and
repeated. Whether adhesion falls is judged without it, by the means m_b of n_b neighbours:

    [H1] T = sum_b n_b (m_b - i_b)^2, i_b: the best sequence that never falls (isotonic regression)

If adhesion never falls then the expected means never fall either, however sharply the curve bends.
T is compared with that of means i_b with errors as measured. Where neighbours share no errors these
are residuals with random signs (wild bootstrap), so errors may differ in size. Where neighbours
share errors these are an autoregressive series of the measured size:

    [H2] e_i = size_i z_i, z_i = r z_(i-1) + sqrt(1 - r^2) w_i, w_i normal

The smooth curve follows shared errors. So errors at large creepage are those about a parabola.
Source: Barlow, Bartholomew, Bremner and Brunk, Statistical Inference under Order Restrictions
(1972); Wu, Annals of Statistics 14 (1986) 1261-1295 (wild bootstrap).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.optimize import isotonic_regression
from scipy.signal import lfilter

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

# Means [H1] are of at least so many neighbours, and there are at most so many means.
LEAST_MEAN_POINTS = 4
MOST_MEANS = 20
# the maximum is the largest mean over so many successive means
PEAK_MEANS = 3

# Large creepage, where a parabola shows the errors, begins at this share of the largest creepage.
PARABOLA_FROM = 1.0 / 3.0
LEAST_PARABOLA_POINTS = 12
_PARABOLA_COEFFICIENTS = 3

# Replicates of the test; fewer if so many of them were by chance as large (Besag and Clifford,
# Biometrika 78 (1991) 301-304). Replicates of intervals.
REPLICATES = 999
ENOUGH_BY_CHANCE = 10
INTERVAL_REPLICATES = 200
# An autocorrelation above this, in standard deviations, counts. It is taken one deviation larger.
SHARED_ERRORS = 2.0
LARGEST_SHARED = 0.95
# points over which the size of shared errors is averaged
SIZE_POINTS = 15

# the end of a curve: this share of its points, at least two
END_SHARE = 0.1
# the rise towards the end begins at this share of the largest creepage
LATE = 2.0 / 3.0

# deviations by which a size is beyond chance in 99 %, and is seen in 80 % of sets of data
_DEVIATIONS = 2.6 + 0.84

# The scatter is at least this share of the largest adhesion, so that computed curves have one too.
LEAST_SCATTER = 0.001


class Group(NamedTuple):
    """The points of one curve, sorted by creepage, and the matrices of its fits."""

    points: np.ndarray  # places in the sorted curve
    creepage: np.ndarray
    basis: np.ndarray  # (n, m): functions that rise from 0 to 1
    nuisance: np.ndarray  # (n, k): the constant, and factors of conditions that vary within it
    hat: np.ndarray  # (n, n) of the free fit
    averaging: np.ndarray  # (means, n): weights of the points in the means [H1]
    counts: np.ndarray  # (means,): points of each mean
    window: int  # successive means of which the largest is the maximum


class Fall(NamedTuple):
    """Whether curves fall, from the test [H1], and how far."""

    p_value: float
    size: float  # share of the maximum that is lost at the end, mean over the curves
    low: float  # 95 % interval
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

    @property
    def inflation(self) -> float:
        """Inflation of the variance of means by shared errors."""
        return (1.0 + self.shared) / (1.0 - self.shared)

    def errors(self, rng: np.random.Generator) -> np.ndarray:
        """Return errors as the measured ones, but drawn anew, (n,)."""
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
    best: Shape | None = None
    best_score = math.inf
    for knots in KNOTS:
        smallest = min(part.size for part in members)
        if best is not None and smallest < POINTS_PER_COEFFICIENT * (knots + 4):
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
        score = points * math.log(error) + shape.coefficients * math.log(points)
        if score < best_score:
            best, best_score = shape, score
        if clusters is not None:
            break
    assert best is not None
    return best


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
    return Group(
        points=points,
        creepage=creepage,
        basis=basis,
        nuisance=nuisance,
        hat=everything @ np.linalg.pinv(everything, rcond=1e-10),
        averaging=averaging,
        counts=np.count_nonzero(averaging, axis=1),
        window=1 if clusters is not None else PEAK_MEANS,
    )


def _averaging(creepage: np.ndarray, clusters: np.ndarray | None) -> np.ndarray:
    """Return the weights of points in the means of neighbours (means, n); creepage is sorted."""
    if clusters is not None:
        number = np.argmin(np.abs(creepage[:, None] - clusters), axis=1)
    else:
        means = int(np.clip(creepage.size // LEAST_MEAN_POINTS, 1, MOST_MEANS))
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
    level = adhesion - _factors_within(shape)
    means = [part.averaging @ level[part.points] for part in shape.groups]
    never = [_never_falling(part, m) for part, m in zip(shape.groups, means, strict=True)]
    statistic = _statistic(shape.groups, means)

    def varied_errors() -> list[np.ndarray]:
        error = shape.errors(rng)
        return [part.averaging @ error[part.points] for part in shape.groups]

    by_chance = 0
    replicates = 0
    while replicates < REPLICATES and by_chance < ENOUGH_BY_CHANCE:
        again = [n + e for n, e in zip(never, varied_errors(), strict=True)]
        by_chance += _statistic(shape.groups, again) >= statistic
        replicates += 1
    is_stopped = by_chance == ENOUGH_BY_CHANCE
    p_value = by_chance / replicates if is_stopped else (1 + by_chance) / (1 + replicates)

    measured = _falls_and_rises(shape.groups, means, None)
    varied = []
    for _ in range(INTERVAL_REPLICATES):
        again = [m + e for m, e in zip(means, varied_errors(), strict=True)]
        varied.append(_falls_and_rises(shape.groups, again, measured.peaks))
    falls = np.array([one.fall for one in varied])
    rises = np.array([one.rise for one in varied])
    return Fall(
        p_value=p_value,
        size=measured.fall,
        low=2.0 * measured.fall - float(np.percentile(falls, 97.5)),
        high=2.0 * measured.fall - float(np.percentile(falls, 2.5)),
        # a fall over the last third of the range, wherever the maximum is
        smallest=_DEVIATIONS * float(np.std(rises)),
        peak_creepage=measured.peak_creepage,
        points_beyond=measured.beyond,
        points_before=measured.before,
        rise=measured.rise,
        rise_low=2.0 * measured.rise - float(np.percentile(rises, 97.5)),
        rise_high=2.0 * measured.rise - float(np.percentile(rises, 2.5)),
    )


def _factors_within(shape: Shape) -> np.ndarray:
    """Return what conditions that vary within groups add to the smooth curves (n,)."""
    added = np.zeros_like(shape.fitted)
    for part in shape.groups:
        if part.nuisance.shape[1] > 1:
            everything = np.column_stack([part.nuisance, part.basis])
            coefficients = np.linalg.lstsq(everything, shape.fitted[part.points], rcond=None)[0]
            within = part.nuisance[:, 1:]
            added[part.points] = within @ coefficients[1 : part.nuisance.shape[1]]
    return added


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
    """Falls and rises of curves, as means over the groups; the place of each maximum."""

    fall: float
    rise: float
    peaks: list[int]
    peak_creepage: float
    beyond: int
    before: int


def _falls_and_rises(
    groups: list[Group], means: list[np.ndarray], peaks: list[int] | None
) -> _Sizes:
    """Return the sizes of falls and rises; `peaks` gives the first means of the maxima if known."""
    falls = []
    rises = []
    weights = []
    found_peaks = []
    creepages = []
    beyond = 0
    before = 0
    for k, part in enumerate(groups):
        window = min(part.window, part.counts.size)
        counts = part.counts.astype(float)
        sums = np.convolve(means[k] * counts, np.ones(window), "valid")
        smoothed = sums / np.convolve(counts, np.ones(window), "valid")
        peak = int(np.argmax(smoothed)) if peaks is None else peaks[k]
        ending = max(round(END_SHARE * part.counts.size), 1)
        end = float(np.average(means[k][-ending:], weights=counts[-ending:]))
        level = max(abs(float(smoothed[peak])), 1e-12)

        # a maximum in the end of the curve is no fall
        is_inside = peak + window <= part.counts.size - ending
        falls.append((float(smoothed[peak]) - end) / level if is_inside else 0.0)
        places = part.averaging @ part.creepage
        begin = float(np.interp(LATE * part.creepage[-1], places, means[k]))
        rises.append((end - begin) / level)

        weights.append(float(part.creepage.size))
        found_peaks.append(peak)
        at = part.averaging[peak : peak + window].mean(axis=0) @ part.creepage
        creepages.append(float(at))
        beyond += int(part.counts[peak + window :].sum())
        before += int(part.counts[:peak].sum())
    return _Sizes(
        fall=float(np.average(falls, weights=weights)),
        rise=float(np.average(rises, weights=weights)),
        peaks=found_peaks,
        peak_creepage=float(np.median(creepages)),
        beyond=beyond,
        before=before,
    )
