"""Smooths by polynomials over a window, and differentiates so; at the ends by that of the first or last window.

Source: Savitzky and Golay, Analytical Chemistry 36 (1964) 1627-1639. It does what `scipy.signal.savgol_filter` does,
whose package takes a second of processor time to import, in each process.
"""

import math

import numpy as np
from scipy.ndimage import correlate1d


def smoothed(
    values: np.ndarray, window: int, order: int, derivative: int = 0, step: float = 1.0
) -> np.ndarray:
    """Values (n, ...) or their derivative, over an odd window of samples, n at least as many, by a polynomial."""
    half = window // 2
    t, step = np.linspace(-1.0, 1.0, window), half * step
    fit = np.linalg.pinv(
        np.vander(t, order + 1, increasing=True)
    )  # its coefficients, (order + 1, window)
    powers = np.arange(derivative, order + 1)
    factors = [math.perm(power, derivative) / step**derivative for power in powers]
    out = correlate1d(values, fit[derivative] * factors[0], axis=0, mode="nearest")
    ends = (t[:, None] ** (powers - derivative) * factors) @ fit[derivative:]
    out[:half] = np.tensordot(ends[:half], values[:window], 1)
    out[-half:] = np.tensordot(ends[-half:], values[-window:], 1)
    return out
