"""Finds driving slip: wheels that are faster than the vehicle for longer than noise lasts.

    [D1] slip = v_i / (1 + rho_i) - V, V by the reference, else by the median of at least three
         speeds

Two speeds without a reference show driving slip as little as one: the slower one may slide.
"""

import numpy as np

from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.alignment import Aligned, slope
from rollerrig.rig.identify.train_recorder.findings import Finding, Slipping
from rollerrig.rig.identify.train_recorder.sampling import stretches
from rollerrig.rig.identify.train_recorder.sliding import slides

# m/s^2. A vehicle that loses more speed is braked and not driven.
_BRAKED_M_S2 = -1.0

# s. What is so close to a slide is not judged.
NEAR_S = 2.0

# speeds. Without a reference their median is the vehicle's speed.
_LEAST_SPEEDS = 3


def can_be_seen(a: Aligned) -> bool:
    """Whether driving slip shows: against a reference or most of the speeds."""
    return a.has_reference or len(a.names) >= _LEAST_SPEEDS


def smallest(a: Aligned, v: np.ndarray) -> np.ndarray:
    """Return the smallest slip that counts at each sample, m/s, (n, m)."""
    by_speed = (limit.slip_share(v) * v)[:, None]
    return np.maximum(slides.smallest(a, v, slides.by_noise(a, _noise(a))), by_speed)


def _noise(a: Aligned) -> np.ndarray:
    """Return the noise of each speed against the vehicle, m/s, (m,).

    The scatter about the vehicle would hold the slip itself.
    """
    return np.hypot(a.noise_m_s, a.reference_noise_m_s)


def find(
    aligned: list[Aligned], sliding: list[np.ndarray]
) -> tuple[list[Finding], list[np.ndarray]]:
    """Return the episodes of all runs, and for each run where each speed slips, flags (n, m).

    `sliding` are the flags of wheels that slide in braking. Without a reference a wheel that rolls
    is faster than those, and does not slip.
    """
    found: list[Finding] = []
    flags = []
    for a, slides_at in zip(aligned, sliding, strict=True):
        v = _by_slowest(a, a.reference) if a.has_reference else sampling.median(a.speed.T)
        slip = a.speed - v[:, None]
        slips_at = _flags(a, v, slip)
        if not a.has_reference:
            slips_at &= ~near(a, np.any(slides_at, axis=1))[:, None]
        flags.append(slips_at)
        for first, last in slides.episodes(a, np.any(slips_at, axis=1)):
            found.append(_episode(a, v, slip, slips_at, first, last))
    return found, flags


def _by_slowest(a: Aligned, reference: np.ndarray) -> np.ndarray:
    """Return the speed of the vehicle (n,): at low speed at least that of two wheels that agree.

    A receiver shows little of the speed near 0. The wheels that are not driven are the slowest
    ones, and agree with each other.
    """
    if len(a.names) < _LEAST_SPEEDS:
        return reference
    ordered = np.sort(a.speed, axis=1)
    agree = ordered[:, 1] - ordered[:, 0] < limit.SLIDE_M_S
    is_slow = reference < min(limit.SLOWEST_M_S, limit.SLOW_SHARE * a.run.fastest_m_s)
    return np.where(agree & is_slow, np.fmax(reference, ordered[:, 1]), reference)


def near(a: Aligned, flag: np.ndarray) -> np.ndarray:
    """Return where a flag (n,) is set within NEAR_S, flags (n,)."""
    set_s = a.time_s[flag]
    if not set_s.size:
        return np.zeros(flag.size, bool)
    after = np.clip(np.searchsorted(set_s, a.time_s), 0, set_s.size - 1)
    before = np.maximum(after - 1, 0)
    distance_s = np.minimum(np.abs(set_s[after] - a.time_s), np.abs(set_s[before] - a.time_s))
    return distance_s <= NEAR_S


def _flags(a: Aligned, v: np.ndarray, slip: np.ndarray) -> np.ndarray:
    """Return where each speed slips for long enough, flags (n, m)."""
    if not can_be_seen(a):
        return np.zeros(a.speed.shape, bool)
    least_m_s = smallest(a, v)
    flag = np.where(np.isfinite(slip), slip > least_m_s, False)
    flag &= ~slides.agreeing(a, v, slip, least_m_s)[:, None]
    flag &= (v > a.slowest_m_s)[:, None]

    shortest = max(round(limit.slide_s(a.step_s) / a.step_s), 2)
    change_m_s2 = np.nan_to_num(slope(a.time_s, v, max(1.5, 2.5 * a.step_s)))
    # without a reference the wheels that are slower may slide
    braked_m_s2 = _BRAKED_M_S2 if a.has_reference else 0.0
    for j in range(flag.shape[1]):
        for stretch in stretches(flag[:, j]):
            part = slice(stretch.first, stretch.last + 1)
            is_short = stretch.last - stretch.first + 1 < shortest
            is_braked = float(np.mean(change_m_s2[part])) < braked_m_s2
            if is_short or is_braked or slides.is_mirrored(slip[part], j):
                flag[part, j] = False
    return flag


def _episode(
    a: Aligned, v: np.ndarray, slip: np.ndarray, flags: np.ndarray, first: int, last: int
) -> Finding:
    """Return one episode; its size is the largest slip."""
    part = slice(first, last + 1)
    within = np.where(flags[part], slip[part], 0.0)
    most = float(within.max())
    worst = int(np.argmax(within.max(axis=0)))
    noise = float(_noise(a)[worst])
    half = 2.0 * noise + 0.02 * most
    share = np.where(flags[part], slip[part] / v[part, None], 0.0)
    start_s = float(a.time_s[first])
    end_s = float(a.time_s[last])
    return Finding(
        name="driving_slip",
        channels=tuple(name for j, name in enumerate(a.names) if flags[part, j].any()),
        run=a.run.name,
        start_s=start_s,
        end_s=end_s,
        size=most,
        low=most - half,
        high=most + half,
        unit="m/s",
        details=Slipping(
            duration_s=end_s - start_s + a.step_s,
            most_share=float(np.nanmax(share)),
            cycles=slides.cycles(a, slip, flags, first, last),
        ),
        date=a.run.date,
    )
