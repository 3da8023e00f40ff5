"""Estimates errors by drawing parts of the data anew, or by leaving parts out.

Neighbours in a recording share curves, slopes and noise. So they are drawn together, or left out
together. `scipy.stats.bootstrap` draws single values, which would make errors too small.
"""

import numpy as np

from rollerrig.rig.identify.statistics import robust_line

# samples of a bootstrap
REPLICATES = 300

# stretches of the data that are left out one after the other, values of each at least, and
# stretches at least
STRETCHES = 6
LEAST_PER_STRETCH = 2
LEAST_STRETCHES = 3


def drawn(
    parts: int, rng: np.random.Generator, replicates: int = REPLICATES, together: int = 1
) -> np.ndarray:
    """Return how often each part is in each replicate, (replicates, parts).

    So many successive parts are drawn together; the first one follows the last.
    """
    first = rng.integers(0, parts, (replicates, -(-parts // together)))
    places = np.concatenate([(first + k) % parts for k in range(together)], axis=1)
    return np.array([np.bincount(row, minlength=parts) for row in places])


def bootstrap_errors(columns: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the standard errors of the coefficients of a robust line, by a bootstrap of pairs.

    `columns` (n, k) belong to the coefficients; values and weights have the shape (n,).
    """
    rng = np.random.default_rng(1)
    coefficients = robust_line.fit(columns, values, weight)
    kept = robust_line.weights(weight * (values - columns @ coefficients)) * weight**2
    counts = drawn(values.size, rng, together=2)
    normal = np.einsum("rk,ki,kj->rij", counts * kept, columns, columns, optimize=True)
    right = np.einsum("rk,ki->ri", counts * kept * values, columns, optimize=True)
    replicates = np.einsum("rij,rj->ri", np.linalg.pinv(normal), right)
    # a few replicates may have no value of a column
    return np.array([robust_line.spread(column) for column in replicates.T])


def jackknife_errors(
    columns: np.ndarray, values: np.ndarray, weight: np.ndarray, stretches: int = STRETCHES
) -> np.ndarray:
    """Return the standard errors of the coefficients of a robust line, by leaving out stretches.

    The result is 0 if there are too few values, or if a stretch has all values of a column.
    """
    stretches = min(stretches, values.size // LEAST_PER_STRETCH)
    none = np.zeros(columns.shape[1])
    if stretches < LEAST_STRETCHES:
        return none
    coefficients = []
    for part in np.array_split(np.arange(values.size), stretches):
        kept = np.ones(values.size, bool)
        kept[part] = False
        if np.linalg.matrix_rank(columns[kept]) < columns.shape[1]:
            return none
        coefficients.append(robust_line.fit(columns[kept], values[kept], weight[kept]))
    deviation = np.std(np.array(coefficients), axis=0)
    return np.asarray(np.sqrt(stretches - 1.0) * deviation)


def error_of_level(values: np.ndarray) -> float:
    """Return the standard error of a median: of its values or of its stretches, the larger one."""
    of_values = robust_line.error_of_median(values)
    stretches = min(STRETCHES, values.size // LEAST_PER_STRETCH)
    if stretches < 2:
        return of_values
    medians = np.array([np.median(part) for part in np.array_split(values, stretches)])
    return max(of_values, robust_line.deviation(medians) / float(np.sqrt(stretches)))
