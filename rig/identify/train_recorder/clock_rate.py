"""Finds a reference whose stamps run at another rate than those of the wheels.

    [C1] reference(t) = V((t - d) / rate), V the median of the wheels

There are two kinds. A file is decimated for some channels only: rates are ratios of small whole
numbers, and the delay d is 0. Or one of two clocks is a little fast: rates are near 1. Such a drift
shows only if it grows by more than a delay explains, so the best delay at equal rates is its rival.
"""

from fractions import Fraction
from itertools import product
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.statistics import resampling
from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.findings import ClockRate, Finding
from rollerrig.rig.identify.train_recorder.recording import Run

# rates that are tried: ratios of these numbers, and of ten
_NUMBERS = (1, 2, 3, 4, 5, 10)
RATES = sorted({float(Fraction(p, q)) for p, q in product(_NUMBERS, _NUMBERS) if p != q})

# s. The series are compared at this step or at the step of the wheels.
_STEP_S = 0.2

# steps. Shorter series show no rate.
_LEAST_STEPS = 50

# share of the series that both channels must cover
_COVERED_SHARE = 0.4

# share of the spread of the speed that the error at equal rates must exceed. Chosen.
_WRONG_SHARE = 0.2

# share. Rates are known to this.
_RATE_ERROR = 0.002

# Drifts are searched up to this share, in steps that shift the end of the recording by so many
# seconds: first in coarse steps, then in fine steps around the best.
_MOST_DRIFT = 0.05
_COARSE_S = 0.5
_FINE_S = 0.1

# s. Delays that are tried beside a drift.
_DELAYS_S = np.arange(-limit.LATEST_S, limit.LATEST_S + 0.01, _COARSE_S)

# m/s^2. Below this change of speed a drift does not show.
_CHANGING_M_S2 = 0.15

# samples of a drift at most and at least, and blocks of the bootstrap of its interval
_MOST_SAMPLES = 3000
_LEAST_CHANGING = 100
_DRIFT_BLOCKS = 20


def find(run: Run) -> Finding | None:
    """Return the finding that the reference runs at another rate than the wheels; None if not."""
    references = run.of("reference")
    if not references:
        return None
    rate = _ratio(run) or _drift(run)
    if rate is None:
        return None
    return Finding(
        name="clock_rate",
        channels=(references[0].name,),
        run=run.name,
        start_s=0.0,
        end_s=float(references[0].time_s[-1]),
        size=rate.value,
        low=rate.low,
        high=rate.high,
        unit="times",
        details=ClockRate(references[0].name),
    )


def corrected(run: Run, rate: float) -> Run:
    """Return a run with the stamps of its reference at the rate of the wheels."""
    reference = run.of("reference")[0]
    right = reference._replace(time_s=reference.time_s / rate)
    return run._replace(channels={**run.channels, reference.name: right})


class _Rate(NamedTuple):
    """A rate with its 95 % interval."""

    value: float
    low: float
    high: float


def _ratio(run: Run) -> _Rate | None:
    """Return the ratio of whole numbers at which the reference runs; None if it is 1 or unknown."""
    errors = errors_by_rate(run)
    if errors is None:
        return None
    at_equal_rates, spread, by_rate = errors
    rate = min(by_rate, key=lambda candidate: by_rate[candidate])
    is_wrong = at_equal_rates > max(_WRONG_SHARE * spread, limit.SLIDE_M_S)
    if not is_wrong or by_rate[rate] > limit.RATE_SHARE * at_equal_rates:
        return None
    return _Rate(rate, rate * (1.0 - _RATE_ERROR), rate * (1.0 + _RATE_ERROR))


def errors_by_rate(run: Run) -> tuple[float, float, dict[float, float]] | None:
    """Return the error at equal rates, the spread of the speed, and the error by rate, m/s.

    Errors are medians of absolute differences. The result is None if the series are too short, or
    if the speed hardly changes.
    """
    reference = run.of("reference")[0]
    wheels = run.of("speed")
    step_s = max(_STEP_S, wheels[0].step_s, reference.step_s)
    if not np.isfinite(step_s):
        return None
    time_s = np.arange(reference.time_s[0], reference.time_s[-1], step_s)
    recorded = sampling.at(reference, time_s)

    def error(rate: float) -> float | None:
        speed = sampling.median(np.array([sampling.at(wheel, time_s / rate) for wheel in wheels]))
        good = np.isfinite(speed) & np.isfinite(recorded)
        # a reference whose clock is slow ends before the wheels do
        if good.sum() < max(_LEAST_STEPS, _COVERED_SHARE * time_s.size * min(rate, 1.0)):
            return None
        return float(np.median(np.abs(speed[good] - recorded[good])))

    at_equal_rates = error(1.0)
    if at_equal_rates is None:
        return None
    spread = float(np.nanstd(recorded))
    if spread < limit.JUMP_M_S:
        return None
    by_rate = {}
    for rate in RATES:
        found = error(rate)
        if found is not None:
            by_rate[rate] = found
    if not by_rate:
        return None
    return at_equal_rates, spread, by_rate


# --- drifts ---


def smallest_drift(run: Run) -> float | None:
    """Return the smallest share by which a fast or slow clock of the reference would show.

    The result is None if the run is too short, or if its speed changes too little.
    """
    series = _Series.of(run)
    if series is None:
        return None
    share = limit.LEAST_DRIFT_S / series.duration_s
    return share if share < _MOST_DRIFT else None


class _Series(NamedTuple):
    """The speed of the wheels on even steps, and samples of the reference while it changes."""

    start_s: float
    step_s: float
    wheels: np.ndarray
    time_s: np.ndarray
    reference: np.ndarray
    duration_s: float

    @classmethod
    def of(cls, run: Run) -> "_Series | None":
        """Return the series of a run; None if too few samples show a drift."""
        references = run.of("reference")
        wheels = run.of("speed")
        if not references or not wheels:
            return None
        reference = references[0]
        step_s = max(_STEP_S, wheels[0].step_s, reference.step_s)
        if not np.isfinite(step_s):
            return None
        grid_s = np.arange(wheels[0].time_s[0], wheels[0].time_s[-1], step_s)
        speed = sampling.median(np.array([sampling.at(wheel, grid_s) for wheel in wheels]))
        time_s = np.arange(reference.time_s[0], reference.time_s[-1], step_s)
        recorded = sampling.at(reference, time_s)
        changes_m_s2 = np.gradient(recorded, step_s) if time_s.size > 1 else np.zeros(time_s.size)
        picked = np.flatnonzero(np.abs(np.nan_to_num(changes_m_s2)) > _CHANGING_M_S2)
        picked = picked[:: max(picked.size // _MOST_SAMPLES, 1)]
        picked = picked[np.isfinite(recorded[picked])]
        if picked.size < _LEAST_CHANGING:
            return None
        return cls(
            start_s=float(grid_s[0]),
            step_s=step_s,
            wheels=speed,
            time_s=time_s[picked],
            reference=recorded[picked],
            duration_s=float(time_s[picked[-1]] - time_s[picked[0]]),
        )

    def errors(self, rate: float, delay_s: float) -> np.ndarray:
        """Return the capped error of each sample (n,), m/s [C1]; NaN without a wheel."""
        place = ((self.time_s - delay_s) / rate - self.start_s) / self.step_s
        first = np.floor(place).astype(int)
        within = (first >= 0) & (first < self.wheels.size - 1)
        first = np.clip(first, 0, self.wheels.size - 2)
        after = place - first
        speed = (1.0 - after) * self.wheels[first] + after * self.wheels[first + 1]
        error = np.minimum(np.abs(speed - self.reference), limit.CAP_M_S)
        return np.where(within, error, np.nan)

    def best_delay(self, rate: float, delays_s: np.ndarray) -> tuple[float, float]:
        """Return the least mean error over the delays, m/s, and its delay, s."""
        means = [_mean(self.errors(rate, float(delay_s))) for delay_s in delays_s]
        best = int(np.argmin(means))
        return means[best], float(delays_s[best])


def _mean(errors: np.ndarray) -> float:
    """Return the mean of the known errors; infinite if most are unknown."""
    known = np.isfinite(errors)
    return float(errors[known].mean()) if known.mean() > 0.5 else np.inf


def _drift(run: Run) -> _Rate | None:
    """Return the rate of a clock that is a little fast or slow; None if a delay fits as well."""
    series = _Series.of(run)
    if series is None or _MOST_DRIFT * series.duration_s < limit.LEAST_DRIFT_S:
        return None

    coarse = _COARSE_S / series.duration_s
    steps = int(_MOST_DRIFT / coarse)
    rates = 1.0 + coarse * np.arange(-steps, steps + 1)
    found = [series.best_delay(float(rate), _DELAYS_S) for rate in rates]
    best = int(np.argmin([error for error, _ in found]))
    if best in (0, rates.size - 1):
        return None
    fine = _FINE_S / series.duration_s
    near_rates = rates[best] + fine * np.arange(-6, 7)
    near_delays_s = found[best][1] + _FINE_S * np.arange(-6, 7)
    refined = [series.best_delay(float(rate), near_delays_s) for rate in near_rates]
    k = int(np.argmin([error for error, _ in refined]))
    rate = float(near_rates[k])
    error, delay_s = refined[k]

    delays_s = np.arange(_DELAYS_S[0], _DELAYS_S[-1] + 0.01, _FINE_S)
    error_of_delay, _ = series.best_delay(1.0, delays_s)
    is_large = abs(rate - 1.0) * series.duration_s > limit.LEAST_DRIFT_S
    fits = error < min(limit.DRIFT_SHARE * error_of_delay, _WRONG_SHARE * np.std(series.reference))
    if not (is_large and fits):
        return None
    return _with_interval(series, rate, delay_s)


def _with_interval(series: _Series, rate: float, delay_s: float) -> _Rate:
    """Return a rate with its interval, by a bootstrap over blocks of the recording."""
    step = 0.5 * _FINE_S / series.duration_s
    rates = rate + step * np.arange(-20, 21)
    block = np.minimum(
        (series.time_s - series.time_s[0]) / series.duration_s * _DRIFT_BLOCKS, _DRIFT_BLOCKS - 1
    ).astype(int)
    # a rate turns about the middle of the recording, so that delay and rate are independent
    middle_s = 0.5 * (series.time_s[0] + series.time_s[-1])
    sums = []
    for candidate in rates:
        delay_about_middle_s = middle_s - (middle_s - delay_s) / rate * candidate
        errors = np.nan_to_num(series.errors(float(candidate), float(delay_about_middle_s)))
        sums.append(np.bincount(block, errors, minlength=_DRIFT_BLOCKS))
    costs = np.array(sums)
    rng = np.random.default_rng(1)
    counts = resampling.drawn(_DRIFT_BLOCKS, rng)
    least = rates[np.argmin(costs @ counts.T, axis=0)]
    low, high = np.quantile(least, (0.025, 0.975))
    return _Rate(rate, float(min(low, rate) - step), float(max(high, rate) + step))
