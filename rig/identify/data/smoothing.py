"""Smooths samples by polynomials over a moving window, and differentiates them the same way.

At both ends the polynomial of the first or last whole window is used. The result is that of
`scipy.signal.savgol_filter`. That package takes a second of processor time to import, in each
process, so it is not used here.

Source: Savitzky and Golay, Analytical Chemistry 36 (1964) 1627-1639.
"""

import math

import numpy as np
from scipy.ndimage import correlate1d


def smoothed(
    values: np.ndarray, window: int, order: int, derivative: int = 0, step: float = 1.0
) -> np.ndarray:
    """Return the smoothed values, or a derivative of them, with the shape of `values` (n, ...).

    `window` is an odd number of samples, at most n. `order` is that of the polynomial. `derivative`
    counts derivatives, to a variable that grows by `step` from sample to sample.
    """
    half = window // 2
    # a window covers -1 .. 1, in units of half a window
    t = np.linspace(-1.0, 1.0, window)
    unit = half * step

    # row k gives the coefficient of t^k, shape (order + 1, window)
    coefficients = np.linalg.pinv(np.vander(t, order + 1, increasing=True))
    powers = np.arange(derivative, order + 1)
    factors = [math.perm(power, derivative) / unit**derivative for power in powers]

    out = correlate1d(values, coefficients[derivative] * factors[0], axis=0, mode="nearest")
    at_each_t = (t[:, None] ** (powers - derivative) * factors) @ coefficients[derivative:]
    out[:half] = np.tensordot(at_each_t[:half], values[:window], 1)
    out[-half:] = np.tensordot(at_each_t[-half:], values[-window:], 1)
    return out
