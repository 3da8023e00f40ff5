"""Gives the parameters of an identified cause: coefficients and shape, with 95 % intervals."""

import math
from typing import NamedTuple

from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.causes.columns import PLACE_BIN_M, TIME_BIN_S
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
        deviation = identified.deviation[min(k, len(identified.deviation) - 1)]
        low, high = interval.Estimate(value, deviation).interval()
        estimates[row.name] = Estimate(value, low, high, unit=row.source)
    for name, value in cause.shape.items():
        low, high = _interval_of_shape(cause.name, name, value)
        unit = rows[name].source if name in rows else "s"
        estimates[name] = Estimate(value, low, high, unit)
    return estimates


def excludes_nothing(identified: IdentifiedCause) -> bool:
    """Return whether the interval of the size of a cause, its first parameter, excludes 0."""
    size = next(iter(parameters(identified).values()))
    return interval.excludes(size.low, size.high)


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
    wide = interval.Estimate(amplitude, deviation / math.sqrt(runs)).half_width()
    return {
        "amplitude": Estimate(amplitude, max(amplitude - wide, 0.0), amplitude + wide, "-"),
        "phase_rad": Estimate(math.atan2(-values[1], values[0]), -math.pi, math.pi, "rad"),
    }
