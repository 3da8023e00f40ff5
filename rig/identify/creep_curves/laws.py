"""Polach's law fitted to the points of a creep curve, and judged against their scatter.

    [L1] mu = mu_0 (A + (1 - A) exp(-gamma s)) exp(X beta), s = creepage x speed       Polach 2005
    [L2] k_S = ratio k_A, ratio within 0 .. 1, as Polach requires

The patch is computed, not measured. If k_A ends at 1 and the law fails, the contact may be stiffer
than the computed one: the law is fitted again with k_A up to `MOST_STIFF`.

beta has the conditions that matter. The law fits if its residual is not larger than the scatter of
the points about a smooth curve, by an F test; and if what it leaves beyond scatter is small.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import f as fisher

from rollerrig.rig.contact.patch import Patch
from rollerrig.rig.identify.creep_curves.conditions import Prepared
from rollerrig.rig.identify.creep_curves.shape import Shape
from rollerrig.rig.identify.data.runs import Curve
from rollerrig.rig.identify.paper import polach_fit

# The law fails if by chance a residual were as large in one of so many sets of data,
ALPHA = 0.001
# and if what it leaves beyond scatter is more than this share of the largest adhesion.
LEAST_MISFIT = 0.01

# A misfit below this share of the largest adhesion must be visible, else the law is not judged.
MOST_UNSEEN = 0.1
# Largest k_A of a contact that is stiffer than the computed one. Hertz's patch has this stiffness
# if both radii are about three times as large.
MOST_STIFF = 2.0

# A parameter this close to a bound, as a share of the range between the bounds, is at the bound.
AT_BOUND = 1e-3

REPLICATES = 60

# beta is within +- this
WIDEST_BETA = 20.0


class Bounded(NamedTuple):
    """A parameter, its 95 % interval, and the bound at which it is ("low", "high" or "")."""

    value: float
    low: float
    high: float
    bound: str


class Law(NamedTuple):
    """A fitted law. `modelled` (n,) is in the order of the sorted points."""

    has_fall: bool
    parameters: dict[str, Bounded]  # by the names of Polach's parameters
    x: np.ndarray  # in the order of `polach_fit.NAMES`
    beta: np.ndarray
    modelled: np.ndarray
    rms: float
    beyond_scatter: float  # rms of what is left beyond the scatter
    largest_deviation: float  # of a running mean of the residual
    deviation_creepage: float  # where it is
    p_value: float
    fits: bool
    is_exact: bool  # whether nothing but scatter is left
    smallest: float  # rms beyond the scatter that these data would have shown

    @property
    def is_stiffer(self) -> bool:
        """Whether the contact of the points is stiffer than the computed one."""
        return float(self.x[_K_A]) > 1.0 + AT_BOUND

    @property
    def needs_a_stiffer_contact(self) -> bool:
        """Whether the law fails with the largest stiffness of the computed contact."""
        return not self.fits and self.parameters["k_a"].bound == "high"


_K_A = polach_fit.NAMES.index("k_a")


def _with_ratio(part: np.ndarray, has_fall: bool) -> np.ndarray:
    """Return Polach's parameters of free ones: mu_0, [A, gamma,] k_A, ratio [L2]."""
    if has_fall:
        mu_0, falling, gamma, k_a, ratio = part
    else:
        mu_0, k_a, ratio = part
        falling, gamma = 1.0, 0.0
    return np.array([mu_0, falling, gamma, k_a, ratio * k_a])


def _bounds(has_fall: bool, most_k_a: float) -> tuple[np.ndarray, np.ndarray]:
    low = polach_fit.LOW.copy()
    high = polach_fit.HIGH.copy()
    high[_K_A] = most_k_a
    # the last free parameter is the ratio of k_S to k_A
    low[-1] = 0.0
    high[-1] = 1.0
    if not has_fall:
        keep = [0, 3, 4]
        return low[keep], high[keep]
    return low, high


class _Problem(NamedTuple):
    """The least-squares fit of the law to adhesions at the points of a curve."""

    curve: Curve
    columns: np.ndarray
    patch: Patch
    has_fall: bool
    most_k_a: float

    def split(self, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Polach's parameters (5,) and beta (k,) of the free parameters."""
        count = free.size - self.columns.shape[1]
        return _with_ratio(free[:count], self.has_fall), free[count:]

    def solve(self, adhesion: np.ndarray, starts: list[np.ndarray]) -> np.ndarray:
        """Return the free parameters of the best fit of all starts."""
        low, high = _bounds(self.has_fall, self.most_k_a)
        wide = np.full(self.columns.shape[1], WIDEST_BETA)
        low = np.concatenate([low, -wide])
        high = np.concatenate([high, wide])

        def residual(free: np.ndarray) -> np.ndarray:
            x, beta = self.split(free)
            return modelled(x, beta, self.columns, self.curve, self.patch) - adhesion

        fits = [
            least_squares(residual, np.clip(start, low, high), bounds=(low, high), x_scale=high)
            for start in starts
        ]
        best = min(fits, key=lambda solution: solution.cost)
        return best.x


def modelled(
    x: np.ndarray, beta: np.ndarray, columns: np.ndarray, curve: Curve, patch: Patch
) -> np.ndarray:
    """Return the adhesion [L1] at the points of a curve; `columns` (n, k) belong to beta (k,)."""
    factor = np.exp(np.clip(columns @ beta, -WIDEST_BETA, WIDEST_BETA))
    return polach_fit.model(x, curve, patch, factor)


def fit(
    prepared: Prepared,
    columns: np.ndarray,
    beta_start: np.ndarray,
    patch: Patch,
    smooth: Shape,
    has_fall: bool,
    seed: int,
    most_k_a: float = 1.0,
) -> Law:
    """Return Polach's law with or without falling friction, fitted and judged."""
    curve = prepared.curve._replace(creepage=prepared.creepage)
    problem = _Problem(curve, columns, patch, has_fall, most_k_a)
    top = float(np.max(prepared.adhesion))
    starts = []
    for start in polach_fit.STARTS:
        for level in (start.mu_0, 1.1 * top):
            first = [level, start.A, start.gamma_s_m, start.k_a, min(start.k_s / start.k_a, 1.0)]
            if not has_fall:
                first = [first[0], first[3], first[4]]
            starts.append(np.concatenate([first, beta_start]))
    best = problem.solve(prepared.adhesion, starts)
    x, beta = problem.split(best)
    model = modelled(x, beta, columns, curve, patch)
    residual = model - prepared.adhesion

    # replicates: the law with errors as those about the smooth curve
    rng = np.random.default_rng(seed)
    replicates = np.empty((REPLICATES, len(polach_fit.NAMES)))
    for i in range(REPLICATES):
        again = problem.solve(model + smooth.errors(rng), [best])
        replicates[i], _ = problem.split(again)

    rms = float(np.sqrt(np.mean(residual**2)))
    squares = float(residual @ residual)
    free_squares = smooth.scatter**2 * max(smooth.freedom, 1)
    freer = max(smooth.coefficients - best.size, 1)
    ratio = max(squares - free_squares, 0.0) / freer / (smooth.scatter**2 * smooth.inflation)
    p_value = float(fisher.sf(ratio, freer, max(smooth.freedom, 1)))
    beyond = math.sqrt(max(squares - free_squares, 0.0) / residual.size)
    critical = float(fisher.isf(ALPHA, freer, max(smooth.freedom, 1)))
    smallest = smooth.scatter * math.sqrt(smooth.inflation * critical * freer / residual.size)
    deviation, place = _largest_deviation(prepared, residual)
    return Law(
        has_fall=has_fall,
        parameters=_with_bounds(x, replicates, has_fall, most_k_a),
        x=x,
        beta=beta,
        modelled=model,
        rms=rms,
        beyond_scatter=beyond,
        largest_deviation=deviation,
        deviation_creepage=place,
        p_value=p_value,
        fits=not (p_value < ALPHA and beyond > LEAST_MISFIT * top),
        is_exact=p_value >= ALPHA,
        smallest=max(smallest, LEAST_MISFIT * top),
    )


def _largest_deviation(prepared: Prepared, residual: np.ndarray) -> tuple[float, float]:
    """Return the largest mean of the residual over neighbours in creepage, and its creepage."""
    width = max(residual.size // 12, 3)
    kernel = np.ones(width) / width
    means = np.convolve(residual, kernel, "valid")
    places = np.convolve(prepared.creepage, kernel, "valid")
    k = int(np.argmax(np.abs(means)))
    return float(means[k]), float(places[k])


def _with_bounds(
    x: np.ndarray, replicates: np.ndarray, has_fall: bool, most_k_a: float
) -> dict[str, Bounded]:
    """Return the parameters with intervals, and the bound at which one is."""
    low, high = np.percentile(replicates, (2.5, 97.5), axis=0)
    found = {}
    for i, name in enumerate(polach_fit.NAMES):
        if not has_fall and name in ("A", "gamma_s_m"):
            continue
        bound = polach_fit.bound_of(name, float(x[i]))
        if name == "k_s":
            # [L2]: its bounds are 0 and k_A
            share = float(x[i]) / max(float(x[_K_A]), 1e-12)
            bound = "low" if share < AT_BOUND else "high" if share > 1.0 - AT_BOUND else ""
        if name == "k_a" and bound == "high" and float(x[i]) < most_k_a * (1.0 - AT_BOUND):
            bound = ""
        found[name] = Bounded(float(x[i]), float(low[i]), float(high[i]), bound)
    return found
