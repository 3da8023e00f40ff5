"""Finds a reference whose stamps run at another rate than those of the wheels.

    [C1] reference(t) = V(t / rate), V the median of the wheels

This happens if a file is decimated for some channels only. Rates are ratios of small whole numbers.
"""

from fractions import Fraction
from itertools import product

import numpy as np

from rollerrig.rig.identify.train_recorder import faults
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.findings import ClockRate, Finding
from rollerrig.rig.identify.train_recorder.recording import Run

# rates that are tried: ratios of these numbers, and of ten
_NUMBERS = (1, 2, 3, 4, 5, 10)
RATES = sorted({float(Fraction(p, q)) for p, q in product(_NUMBERS, _NUMBERS) if p != q})

# s. The series are compared at this step or at the step of the wheels.
_STEP_S = 0.2

# steps. Shorter series show no rate.
_LEAST_STEPS = 100

# share of the series that both channels must cover
_COVERED_SHARE = 0.4

# share of the spread of the speed that the error at equal rates must exceed. Chosen.
_WRONG_SHARE = 0.2

# share. Rates are known to this.
_RATE_ERROR = 0.002


def corrected(run: Run) -> tuple[Run, list[Finding]]:
    """Return a run with the stamps of its reference at the rate of the wheels, and the finding."""
    references = run.of("reference")
    if not references:
        return run, []
    reference = references[0]
    errors = errors_by_rate(run)
    if errors is None:
        return run, []

    at_equal_rates, spread, by_rate = errors
    rate = min(by_rate, key=lambda candidate: by_rate[candidate])
    is_wrong = at_equal_rates > max(_WRONG_SHARE * spread, limit.SLIDE_M_S)
    if not is_wrong or by_rate[rate] > limit.RATE_SHARE * at_equal_rates:
        return run, []

    finding = Finding(
        name="clock_rate",
        channels=(reference.name,),
        run=run.name,
        start_s=0.0,
        end_s=float(reference.time_s[-1]),
        size=rate,
        low=rate * (1.0 - _RATE_ERROR),
        high=rate * (1.0 + _RATE_ERROR),
        unit="times",
        details=ClockRate(reference.name),
    )
    right = reference._replace(time_s=reference.time_s / rate)
    return run._replace(channels={**run.channels, reference.name: right}), [finding]


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
    recorded = faults.at(reference, time_s)

    def error(rate: float) -> float | None:
        speed = faults.median(np.array([faults.at(wheel, time_s / rate) for wheel in wheels]))
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
