"""Gives the parameters of an identified cause: coefficients and shape, with their intervals.

The size of a cause is its first parameter. Its error has three parts: the spread over the null
simulations, the numerical errors of the filter (`floor`), and the form of the law. A law that
differs from the truth by any share up to `form_fraction` makes an error of the size

    [V1] size form_fraction / sqrt(3)

A cause is reported if and only if its family-wise interval excludes 0: the interval at the level
1 - alpha of its score test, with the same degrees of freedom.
"""

import math
from typing import NamedTuple

from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.causes.columns import PLACE_BIN_M, TIME_BIN_S
from rollerrig.rig.identify.decide import evidence
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.statistics import interval
from rollerrig.rig.mechanisms.table import BY_NAME


class Estimate(NamedTuple):
    """The estimate of one parameter."""

    value: float
    low: float  # 95 % interval
    high: float
    unit: str  # "-" of a plain number


def parameters(identified: IdentifiedCause) -> dict[str, Estimate]:
    """Return the estimates of an identified cause by the names of its parameters."""
    cause = identified.cause
    if table.BY_NAME[cause.name].phase:
        return _amplitude_and_phase(identified)

    rows = {row.name: row for row in BY_NAME[cause.name].parameters}
    estimates = {}
    for k, (row, value) in enumerate(zip(rows.values(), identified.unbiased.values, strict=False)):
        low, high = _with_error(identified, value, k).interval()
        estimates[row.name] = Estimate(value, low, high, unit=row.source)
    for name, value in cause.shape.items():
        low, high = _interval_of_shape(cause.name, name, value)
        unit = rows[name].source if name in rows else "s"
        estimates[name] = Estimate(value, low, high, unit)
    return estimates


def family_wise(identified: IdentifiedCause) -> Estimate:
    """Return the size of a cause, its first parameter, with its family-wise interval."""
    size = next(iter(parameters(identified).values()))
    estimate = _with_error(identified, size.value, 0)
    if table.BY_NAME[identified.cause.name].phase:
        # the mean of all runs
        runs = max(len(identified.cause.values) // 2, 1)
        estimate = estimate._replace(error=_error_of_amplitude(identified, size.value, runs))
    low, high = estimate.interval(1.0 - evidence.alpha_of(identified.score_test))
    return size._replace(low=low, high=high)


def is_finding(identified: IdentifiedCause) -> bool:
    """Return whether the family-wise interval of the size of a cause excludes 0."""
    size = family_wise(identified)
    return interval.excludes(size.low, size.high)


def _with_error(identified: IdentifiedCause, value: float, k: int) -> interval.Estimate:
    """Return the value of coefficient number k with its standard error and degrees of freedom."""
    deviation = identified.deviation[min(k, len(identified.deviation) - 1)]
    floor = table.BY_NAME[identified.cause.name].floor
    of_form = _error_of_form(identified, value)
    known = math.hypot(floor, of_form)
    # `deviation` contains the floor
    of_chance = math.sqrt(max(deviation * deviation - floor * floor, 0.0))
    freedom = interval.freedom_of_sum(
        [(of_chance, identified.score_test.freedom), (known, math.inf)]
    )
    return interval.Estimate(value, math.hypot(deviation, of_form), freedom)


def _error_of_form(identified: IdentifiedCause, value: float) -> float:
    """Return the error that the form of the law makes [V1]."""
    return abs(value) * identified.form / math.sqrt(3.0)


def _error_of_amplitude(identified: IdentifiedCause, amplitude: float, runs: int) -> float:
    """Return the standard error of an amplitude that is the mean of some runs."""
    deviation = float(max(identified.deviation)) / math.sqrt(runs)
    return math.hypot(deviation, _error_of_form(identified, amplitude))


def _interval_of_shape(cause: str, name: str, value: float) -> tuple[float, float]:
    """Return the interval of a parameter of the shape: the grid on which it was searched."""
    if name in table.BY_NAME[cause].scales:
        return value / 2.0, value * 2.0
    if name in ("start_m", "length_m"):
        bin_width = PLACE_BIN_M
    elif name.startswith(("start_s", "duration_s")):
        bin_width = TIME_BIN_S
    else:
        bin_width = 0.0
    return value - bin_width, value + bin_width


def _amplitude_and_phase(identified: IdentifiedCause) -> dict[str, Estimate]:
    """Return amplitude and phase of a cause that is fitted as cosine and sine of each run.

    The amplitude is the mean of all runs. The phase is that of the first run, with any other
    possible.
    """
    values = identified.cause.values
    deviation = float(max(identified.deviation))
    runs = max(len(values) // 2, 1)
    # noise adds to the squares of both coefficients
    square = sum(v * v for v in values) / runs - 2.0 * deviation * deviation
    amplitude = math.sqrt(max(square, 0.0))
    error = _error_of_amplitude(identified, amplitude, runs)
    wide = interval.Estimate(amplitude, error).half_width()
    return {
        "amplitude": Estimate(amplitude, max(amplitude - wide, 0.0), amplitude + wide, "-"),
        "phase_rad": Estimate(math.atan2(-values[1], values[0]), -math.pi, math.pi, "rad"),
    }
