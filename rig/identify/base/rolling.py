"""Compares each wheelset with the vehicle's speed while it rolls.

    [B1] ratio = r omega / v, 1 of a rolling wheel, below 1 of a braked one

A brake that is released leaves a wheel rolling. Where a recording never shows a released brake, the
largest ratio of half a second comes next to it: a braked wheel is slower, never faster.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from rollerrig.rig.identify.base.findings import Code, Finding
from rollerrig.rig.identify.data.preparation import samples_before_braking
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.statistics import groups

# Largest deviation of the ratio that all wheelsets share. It is below 0.0002 on 105 sets of three
# generators. Chosen between this and the 0.015 that made every score overflow.
LARGEST_COMMON = 0.002
# the same without a released brake, where low creepage lowers the ratio
LARGEST_COMMON_BRAKED = 0.02
# Largest deviation of one wheelset from the others: beyond the wear between a new and a worn wheel.
LARGEST_OF_ONE = 0.05
# Largest lead of a braked wheel over the vehicle, less its lead while it rolls. Chosen: it is below
# 0.0006 on the same sets.
LARGEST_LEAD = 0.015

# Least deviation of the radius of one wheelset that is a start for its fit. Chosen: smaller ones
# are found from the linearised replay; the sets of three generators hide at most 0.16 %.
LEAST_ODD_RADIUS = 0.005

# Standard error of the ratio of one run: below 0.0002 on 105 sets of three generators.
BY_RUN_ERROR = 0.0003
# probability that fault-free runs are parted by chance
_ALPHA = 0.001

LEAST_ROLLING_S = 0.3
LEAST_SPEED_M_S = 5.0
WINDOW_S = 0.5


class Rolling(NamedTuple):
    """How fast the wheelsets of a dataset roll, as ratios [B1], shape (axles,) each."""

    is_released: bool  # whether the brake is released somewhere
    ratio: np.ndarray  # while the brake is released; else the largest of any half second
    largest: np.ndarray  # of any half second, the median of the runs


def measure(data: Dataset) -> Rolling | None:
    """Return the rolling ratios of a dataset; None if no run is fast and long enough."""
    radius_m = data.sections["vehicle"]["wheel_radius_m"]
    # distances of the rims and of the surface with a released brake
    rims_m = np.zeros(data.axles)
    surface_m = np.zeros(data.axles)
    released_s = 0.0
    largest = []
    for run in data.runs:
        step_s = float(np.mean(np.diff(run.time_s)))
        surface_m_s = surface_speed(run)
        rim_m_s = radius_m * run.wheel_speed_rad_s

        fast = run.speed_m_s > LEAST_SPEED_M_S
        window = max(int(WINDOW_S / step_s), 1)
        if np.count_nonzero(fast) > 2 * window:
            means = uniform_filter1d(rim_m_s, window, axis=0)
            of_surface = np.maximum(uniform_filter1d(surface_m_s, window, axis=0), 1e-9)
            largest.append((means / of_surface)[fast].max(axis=0))

        released = min(
            samples_before_braking(run.torque_Nm[:, j], step_s) for j in range(run.axles)
        )
        is_rolling = fast[:released]
        rims_m += rim_m_s[:released][is_rolling].sum(axis=0) * step_s
        surface_m += surface_m_s[:released][is_rolling].sum(axis=0) * step_s
        released_s += np.count_nonzero(is_rolling) * step_s

    if not largest:
        return None
    most = np.median(largest, axis=0)
    if released_s < LEAST_ROLLING_S:
        return Rolling(False, most, most)
    return Rolling(True, rims_m / surface_m, most)


class OddRadius(NamedTuple):
    """A wheelset whose wheels roll as if they had another radius than the other ones."""

    axle: int  # from 1
    fraction: float  # its radius over the stated one, less 1


def odd_radius(data: Dataset) -> OddRadius | None:
    """Return the wheelset whose radius differs most while it rolls; None if all are nearly alike.

    None as well if the brake is never released.
    """
    found = measure(data)
    if found is None or not found.is_released:
        return None
    fractions = np.median(found.ratio) / found.ratio - 1.0
    odd = int(np.argmax(np.abs(fractions)))
    if abs(fractions[odd]) < LEAST_ODD_RADIUS:
        return None
    return OddRadius(odd + 1, float(fractions[odd]))


def surface_speed(run: Run) -> np.ndarray:
    """Return the speed of the surface under each wheelset, shape (n, axles)."""
    if run.surface_m_s is not None:
        return run.surface_m_s
    return np.repeat(run.speed_m_s[:, None], run.axles, axis=1)


def by_run(data: Dataset) -> np.ndarray:
    """Return the rolling ratios of each run (runs, axles); NaN if its brake is never released."""
    ratios = []
    for run in data.runs:
        found = measure(data._replace(runs=[run]))
        if found is None or not found.is_released:
            ratios.append(np.full(data.axles, np.nan))
        else:
            ratios.append(found.ratio)
    return np.array(ratios)


def _of_runs(data: Dataset, finding: Finding) -> Finding:
    """Return a finding on all wheelsets, with the runs that show it if the other runs do not."""
    ratios = np.median(by_run(data), axis=1)
    found = groups.find(ratios, np.full(ratios.size, BY_RUN_ERROR), _ALPHA, tests=1)
    if found is None:
        return finding
    parts = (found.apart, found.others)
    wrong = max(parts, key=lambda places: abs(np.mean(ratios[list(places)]) - 1.0))
    names = tuple(data.runs[k].name for k in wrong)
    return finding._replace(measured=float(np.mean(ratios[list(wrong)])), runs=names)


def check(data: Dataset) -> list[Finding]:
    """Return findings on the radius, the scale of one wheelset, and a slow reference."""
    rolling = measure(data)
    if rolling is None:
        return []
    deviation = rolling.ratio - 1.0
    common = LARGEST_COMMON if rolling.is_released else LARGEST_COMMON_BRAKED

    findings = []
    odd = np.flatnonzero(np.abs(rolling.ratio / np.median(rolling.ratio) - 1.0) > LARGEST_OF_ONE)
    for axle in odd:
        findings.append(
            Finding(
                Code.WHEEL_SPEED_SCALE,
                measured=float(rolling.ratio[axle]),
                allowed=LARGEST_OF_ONE,
                channels=(f"wheel_speed_{axle + 1}_rad_s",),
                axles=(int(axle) + 1,),
            )
        )
    have_one_sign = np.all(deviation > 0.0) or np.all(deviation < 0.0)
    if not odd.size and have_one_sign and np.abs(deviation).min() > common:
        measured = float(np.median(rolling.ratio))
        findings.append(_of_runs(data, Finding(Code.RADIUS, measured, allowed=common)))

    lead = rolling.largest - np.maximum(rolling.ratio, 1.0)
    ahead = np.flatnonzero(lead > LARGEST_LEAD)
    if ahead.size and not odd.size:
        findings.append(
            Finding(
                Code.REFERENCE_SLOW,
                measured=float(lead.max()),
                allowed=LARGEST_LEAD,
                axles=tuple(int(axle) + 1 for axle in ahead),
            )
        )
    return findings
