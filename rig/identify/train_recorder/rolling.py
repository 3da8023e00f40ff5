"""Compares the channels of one vehicle while its wheels roll: delays and scales.

Delays and scales are estimated alternately, because each needs the other.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.statistics import robust_line
from rollerrig.rig.identify.train_recorder import delays, scales
from rollerrig.rig.identify.train_recorder.alignment import Aligned, align, block_length_s
from rollerrig.rig.identify.train_recorder.delays import Delays
from rollerrig.rig.identify.train_recorder.findings import Finding
from rollerrig.rig.identify.train_recorder.recording import Run
from rollerrig.rig.identify.train_recorder.scales import Scales

# samples. Fewer do not show how far a wheel is from the middle of the vehicle.
_TURNING_SAMPLES = 100

# m. No wheel is further from the middle of a road vehicle or a robot.
_MOST_BESIDE_M = 2.0


class Rolling(NamedTuple):
    """All runs with delays and scales corrected, the findings, and both fits for `judged`."""

    aligned: list[Aligned]
    found: list[Finding]
    delays: Delays
    scales: Scales


def fit(runs: list[Run]) -> Rolling:
    """Return all runs with delays and scales corrected, and the findings about both."""
    block_s = block_length_s(runs) if runs else 0.0
    late = Delays({}, [], {}, [])
    for _ in range(2):
        scale = scales.fit(runs, late.delay_s, block_s)
        if runs:
            late = delays.fit(runs, scale.of_runs, block_s)
    scale = scales.fit(runs, late.delay_s, block_s)

    aligned = []
    for run, scale_of_run in zip(runs, scale.of_runs, strict=True):
        a = _without_turning(align(run, late.delay_s, scale_of_run, block_s))
        aligned.append(a._replace(timing_s=_timing_s(a, late)))
    return Rolling(aligned, late.found + scale.found, late, scale)


def _without_turning(a: Aligned) -> Aligned:
    """Return a run with the speeds of the middle of the vehicle, if the yaw rate is recorded.

    [R3] v_i = V + b_i w, w the yaw rate. b_i, by which the wheel is beside the middle, minimises
         the absolute errors over all samples; samples in which a wheel slides count little.
    """
    turns = np.isfinite(a.yaw_rad_s) & np.isfinite(a.vehicle)
    if np.count_nonzero(turns) < _TURNING_SAMPLES:
        return a
    columns = []
    for speed in a.speed.T:
        known = turns & np.isfinite(speed)
        beside_m = 0.0
        if np.count_nonzero(known) >= _TURNING_SAMPLES and np.std(a.yaw_rad_s[known]) > 0.0:
            (beside_m,) = robust_line.fit(
                a.yaw_rad_s[known, None], (speed - a.vehicle)[known], np.ones(known.sum())
            )
        if abs(beside_m) > _MOST_BESIDE_M:
            beside_m = 0.0
        columns.append(speed - beside_m * np.nan_to_num(a.yaw_rad_s))
    return a._replace(speed=np.column_stack(columns))


def _timing_s(a: Aligned, late: Delays) -> float:
    """Return by how much the stamps of wheels and vehicle may differ after correction, s."""
    references = a.run.of("reference")
    if not references:
        return 0.5 * a.step_s
    # between two values of the reference its speed is not known
    half_step_s = 0.5 * max(a.step_s, references[0].step_s)
    lag = late.lags.get(references[0].name)
    if lag is None:
        return max(references[0].delay_s, half_step_s)
    return max(0.5 * (lag.high_s - lag.low_s), half_step_s)
