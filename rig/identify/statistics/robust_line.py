"""Fits lines and levels to values among which some are far off."""

import numpy as np
from scipy.stats import median_abs_deviation

# repetitions of a robust fit
_STEPS = 12

# An error counts in full up to this multiple of the median error.
_FULL_WEIGHT = 1.5

# standard error of a median over that of a mean
_ERROR_OF_MEDIAN = 1.2533


def fit(columns: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return coefficients that minimise the weighted absolute errors, by repeated least squares."""
    robust = np.ones(values.size)
    coefficients = np.zeros(columns.shape[1])
    for _ in range(_STEPS):
        scaled = (weight * robust)[:, None]
        coefficients, *_ = np.linalg.lstsq(scaled * columns, weight * robust * values, rcond=None)
        robust = np.sqrt(weights(weight * (values - columns @ coefficients)))
    return coefficients


def weights(error: np.ndarray) -> np.ndarray:
    """Return the weights (n,) with which errors count in a robust fit, 0 to 1."""
    size = np.abs(error)
    usual = max(float(np.median(size)), 1e-9)
    return np.minimum(1.0, _FULL_WEIGHT * usual / np.maximum(size, 1e-12))


def spread(values: np.ndarray) -> float:
    """Return half the distance of the quantiles of one standard deviation."""
    low, high = np.quantile(values, (0.16, 0.84))
    return 0.5 * float(high - low)


def deviation(values: np.ndarray) -> float:
    """Return the standard deviation that the median absolute deviation shows."""
    return float(median_abs_deviation(values, scale="normal"))


def error_of_median(values: np.ndarray) -> float:
    """Return the standard error of the median of independent values."""
    return _ERROR_OF_MEDIAN * deviation(values) / float(np.sqrt(values.size))
