"""Finds slides, a lower bound of the adhesion used in them, and places where several runs slide.

    [S1] sliding = V - v_i / (1 + rho_i), V by the reference; without one, the least speed of the
         vehicle that the fastest wheel allows: V(t) >= max over t' of v_max(t') - a |t - t'|,
         after t' with a the hardest braking, and before t' with a nearly zero, because nobody
         drives while wheels slide in braking
    [S2] mu >= (d - 2 s_d - R / M) / g, d the deceleration of the vehicle while wheels slide,
         s_d its standard error

[S2] is the mean over all wheels of the adhesion that the contact used; the best wheel used at least
that. It assumes level track (10 per mille uphill add 0.010), no other brake that acts on the rail,
and a running resistance R of at most RESISTANCE_M_S2.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d

from rollerrig.configs.vehicle import GRAVITY_M_S2
from rollerrig.rig.identify.statistics import robust_line
from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.alignment import Aligned, quiet, slope
from rollerrig.rig.identify.train_recorder.findings import Cycle, Finding, SharedPlace, Sliding
from rollerrig.rig.identify.train_recorder.sampling import stretches
from rollerrig.rig.identify.train_recorder.sliding import drops

# m/s. Scatter of a speed: the least one, and the one that is assumed where few samples show it.
_LEAST_SCATTER_M_S = 0.02
_ASSUMED_SCATTER_M_S = 0.1
_SCATTER_SAMPLES = 20

# s. Slides with less between them are one episode.
_SAME_EPISODE_S = 2.0

# s. Wheels roll when their speeds have been close together for this time.
_ROLLING_S = 2.0

# s. A wheel that is faster than the vehicle was in this time spins. Slides of all wheels last less.
_BEFORE_S = 30.0

# m/s^2. A vehicle that loses less speed is not braked, and its wheels do not slide.
_BRAKED_M_S2 = -0.1

# m. Positions of slides are counted in these steps.
_PLACE_STEP_M = 10.0

# random arrangements of the slides, and the least change of speed of a braked track
_ARRANGEMENTS = 500
_BRAKED_TRACK_M_S2 = -0.2


class AdhesionUsed(NamedTuple):
    """Mean adhesion used with its lower and upper bound; NaN if unknown."""

    mean: float
    low: float
    high: float


class Slide(NamedTuple):
    """One episode: its run, first and last sample of the aligned run, and the adhesion used."""

    run: int
    first: int
    last: int
    finding: Finding
    adhesion: AdhesionUsed


class Noise(NamedTuple):
    """What hides slides in a run, for each speed (m,), m/s."""

    scatter_m_s: np.ndarray  # about the vehicle's speed, without hard braking
    smallest_m_s: np.ndarray  # smallest slide by noise and rounding
    least_drop_m_s: np.ndarray  # smallest short drop that counts


class Seen(NamedTuple):
    """Where each speed slides, flags (n, m), and by how much, m/s, (n, m).

    The size of a long slide is against the vehicle, that of a short drop against what the wheel did
    before and after it.
    """

    slides_at: np.ndarray
    size_m_s: np.ndarray


class ShortDrop(NamedTuple):
    """A visible drop of one speed that is too short for a slide: first and last sample, depth."""

    name: str
    first: int
    last: int
    depth_m_s: float


class _Deceleration(NamedTuple):
    """Deceleration of the vehicle with its standard error, m/s^2."""

    value_m_s2: float
    error_m_s2: float


def vehicle(a: Aligned) -> np.ndarray:
    """Return the speed of the vehicle also while wheels slide, m/s [S1]."""
    known = np.isfinite(a.speed) & ~_spins(a)
    some = known.any(axis=1)
    fastest = np.max(np.where(known, a.speed, -np.inf), axis=1)
    fastest = np.where(some, fastest, -np.inf)

    since_start_s = a.time_s - a.time_s[0]
    brakes = a.run.hardest_m_s2 * since_start_s
    drives = limit.DRIVES_M_S2 * since_start_s
    from_before = np.maximum.accumulate(fastest + brakes) - brakes
    from_behind = np.maximum.accumulate((fastest - drives)[::-1])[::-1] + drives
    least = np.where(some, np.maximum(from_before, from_behind), np.nan)
    return np.where(np.isfinite(a.reference), a.reference, least)


def _spins(a: Aligned) -> np.ndarray:
    """Return where a wheel is much faster than the others, which are not braked, flags (n, m).

    Three speeds at least are needed to see it.
    """
    if len(a.names) < 3:
        return np.zeros(a.speed.shape, bool)
    middle = sampling.median(a.speed.T)
    is_braked = np.nan_to_num(slope(a.time_s, middle)) < _BRAKED_M_S2
    least = np.maximum(limit.SLIDE_M_S, limit.SLIP_SHARE * np.nan_to_num(middle))
    excess = np.nan_to_num(a.speed - middle[:, None])
    # a braked vehicle does not become faster than it was
    was_m_s = _fastest_before(a, middle)
    is_too_fast = a.speed > (was_m_s + least)[:, None]
    spins = (excess > least[:, None]) & (~is_braked[:, None] | is_too_fast)
    # an episode begins and ends where the wheel leaves the others and returns to them
    begun = excess > np.maximum(limit.SLIDE_LEAST_M_S, 0.5 * limit.SLIDE_SHARE * middle)[:, None]
    for j in range(spins.shape[1]):
        for stretch in stretches(begun[:, j]):
            part = slice(stretch.first, stretch.last + 1)
            spins[part, j] = spins[part, j].any()
    return spins


def _fastest_before(a: Aligned, middle: np.ndarray) -> np.ndarray:
    """Return the largest median of the speeds in the 30 s before each sample, m/s, (n,)."""
    count = max(round(_BEFORE_S / a.step_s), 1)
    plain = np.where(np.isfinite(middle), middle, -np.inf)
    # the window of odd length ends at the sample
    filtered = maximum_filter1d(
        plain, 2 * (count // 2) + 1, origin=count // 2, mode="constant", cval=-np.inf
    )
    return np.asarray(filtered)


def can_be_seen(a: Aligned) -> bool:
    """Whether slides show: against a reference, other speeds, or the hardest braking.

    A single speed that falls faster than HARDEST_M_S2 may slide, or the vehicle brakes hard: only
    the hardest braking in dataset.toml decides it. Speeds of a vehicle that turns sharply do not
    show slides.
    """
    if turns(a):
        return False
    if a.has_reference or len(a.names) > 1 or a.run.hardest_is_given:
        return True
    v = vehicle(a)
    return not flags(a, v, noise_of(a, v)).slides_at.any()


def scatter(a: Aligned) -> np.ndarray:
    """Return how each speed scatters about the vehicle's without hard braking, m/s, (m,)."""
    is_quiet = quiet(a)
    v = a.vehicle
    deviations = []
    for speed in a.speed.T:
        offset = (speed - v)[is_quiet & np.isfinite(speed) & np.isfinite(v)]
        if offset.size > _SCATTER_SAMPLES:
            deviations.append(robust_line.deviation(offset))
        else:
            deviations.append(_ASSUMED_SCATTER_M_S)
    return np.maximum(deviations, _LEAST_SCATTER_M_S)


def noise_of(a: Aligned, v: np.ndarray) -> Noise:
    """Return what hides slides in a run whose vehicle has the speed v (n,)."""
    scatter_m_s = scatter(a)
    smallest_m_s = by_noise(a, scatter_m_s)
    if not drops.can_be_seen(a):
        return Noise(scatter_m_s, smallest_m_s, np.full(len(a.names), np.inf))
    of_samples_m_s = _least_m_s(a, np.array(a.noise_m_s))
    return Noise(scatter_m_s, smallest_m_s, drops.least(a, v, of_samples_m_s))


def find(aligned: list[Aligned]) -> tuple[list[Slide], list[np.ndarray]]:
    """Return the slides of all runs, and for each run where each speed slides, flags (n, m)."""
    found: list[Slide] = []
    flags_of_runs = []
    for number_of_run, a in enumerate(aligned):
        v = vehicle(a)
        noise = noise_of(a, v)
        seen = Seen(np.zeros(a.speed.shape, bool), np.zeros(a.speed.shape))
        if can_be_seen(a):
            seen = flags(a, v, noise)
        flags_of_runs.append(seen.slides_at)
        for first, last in episodes(a, np.any(seen.slides_at, axis=1)):
            found.append(_slide(number_of_run, a, v, seen, noise.scatter_m_s, first, last))
    return found, flags_of_runs


def at_least(found: list[Slide], smallest_m_s: float) -> list[Slide]:
    """Return the slides whose interval reaches the smallest size that the recording shows.

    Slides whose interval holds 0 are left out, too.
    """
    return [
        slide for slide in found if slide.finding.high >= smallest_m_s and slide.finding.low > 0.0
    ]


def half_interval_m_s(size_m_s: float, scatter_m_s: float) -> float:
    """Return half the width of the interval of a size, by the scatter of the wheel's speed."""
    return 2.0 * scatter_m_s + 0.02 * size_m_s


def _sliding(a: Aligned, v: np.ndarray) -> np.ndarray:
    """Return by how much each speed is below the vehicle's at least, m/s, (n, m).

    A sensor may read 0 below its lowest speed. So a wheel that reads 0 turns at up to that speed.
    """
    columns = []
    for name, speed in zip(a.names, a.speed.T, strict=True):
        recorded = a.run.channels[name].values
        turns = recorded[recorded > 0.0]
        lowest_m_s = float(turns.min()) if turns.size else 0.0
        columns.append(v - np.where(speed == 0.0, np.minimum(lowest_m_s, v), speed))
    return np.column_stack(columns)


def by_noise(a: Aligned, deviation_m_s: np.ndarray) -> np.ndarray:
    """Return the smallest slide of each speed by its noise, of this deviation (m,), m/s."""
    return np.maximum(_least_m_s(a, deviation_m_s), limit.SLIDE_DEVIATIONS * deviation_m_s)


def _least_m_s(a: Aligned, noise_m_s: np.ndarray) -> np.ndarray:
    """Return the smallest slide at low speed by noise and rounding, m/s, (m,)."""
    quantum = max(
        max(channel.quantum, channel.deadband_m_s) for channel in a.run.of("speed", "reference")
    )
    fastest_m_s = a.run.fastest_m_s
    return np.array([limit.slide_m_s(float(noise), quantum, fastest_m_s) for noise in noise_m_s])


def smallest(a: Aligned, v: np.ndarray, by_noise_m_s: np.ndarray) -> np.ndarray:
    """Return the smallest sliding that counts at each sample, m/s, (n, m).

    It grows with the speed and the deceleration, because a tyre creeps at its peak of adhesion, and
    with what the stamps of wheel and vehicle may differ. `by_noise_m_s` (m,) is that of `by_noise`.
    """
    half_s = max(0.5, 2.5 * a.step_s)
    change_m_s2 = np.abs(np.nan_to_num(slope(a.time_s, v, half_s)))
    share = np.maximum(limit.SLIDE_SHARE, limit.SLIDE_SHARE_M_S2 * change_m_s2)
    is_road_vehicle = a.run.hardest_m_s2 > limit.HARDEST_M_S2
    if is_road_vehicle:
        # without a value of the reference the vehicle's speed is that of the fastest wheel, which
        # is on the outer side of a curve
        in_curves = np.maximum(2.0 * limit.curve_share(v), limit.SLIDE_SHARE_CURVE)
        share = np.where(np.isfinite(a.reference), share, np.maximum(share, in_curves))
    by_speed = share * v
    by_timing = change_m_s2 * a.timing_s
    return np.maximum(by_noise_m_s[None, :], by_speed[:, None]) + by_timing[:, None]


def turns(a: Aligned) -> bool:
    """Whether the speeds differ mostly because the vehicle turns sharply, as a small robot does.

    Then they show slides only against a reference, or with a yaw rate. Half of the samples without
    braking decide: faults and slip are briefer.
    """
    if a.has_reference or len(a.names) < 2:
        return False
    known = np.isfinite(a.speed)
    fastest = np.max(np.where(known, a.speed, 0.0), axis=1)
    slowest = np.min(np.where(known, a.speed, np.inf), axis=1)
    is_braked = np.nan_to_num(slope(a.time_s, sampling.median(a.speed.T))) < _BRAKED_M_S2
    rolls = ~is_braked & (fastest > limit.SLIDE_M_S)
    if np.count_nonzero(rolls) < _SCATTER_SAMPLES:
        return False
    share = 1.0 - slowest[rolls] / fastest[rolls]
    return bool(np.median(share) > limit.SLIDE_SHARE_CURVE)


def flags(a: Aligned, v: np.ndarray, noise: Noise) -> Seen:
    """Return where each speed slides for long enough in braking, and by how much.

    With a reference a wheel that is nearly locked slides also if the vehicle is not braked. A wheel
    that another one mirrors runs in a curve. Whether slides can be seen at all is not asked.
    """
    sliding = _sliding(a, v)
    threshold = smallest(a, v, noise.smallest_m_s)
    flag = np.where(np.isfinite(sliding), sliding > threshold, False)
    all_agree = agreeing(a, v, sliding, threshold)
    flag &= ~all_agree[:, None]

    shortest = max(round(limit.slide_s(a.step_s) / a.step_s), 2)
    change_m_s2 = slope(a.time_s, v, max(1.5, 2.5 * a.step_s))
    for j in range(flag.shape[1]):
        for stretch in stretches(flag[:, j]):
            part = slice(stretch.first, stretch.last + 1)
            has_change = np.isfinite(change_m_s2[part]).any()
            mean_change = np.nanmean(change_m_s2[part]) if has_change else 0.0
            is_short = stretch.last - stretch.first + 1 < shortest
            # a reference may have no values for a while
            is_referenced = bool(np.isfinite(a.reference[part]).mean() > 0.5)
            is_locked = is_referenced and bool(
                np.mean(sliding[part, j]) > limit.LOCKED_SHARE * np.nanmean(v[part])
            )
            is_braked = mean_change <= _BRAKED_M_S2 or is_locked
            # wheels that fall together are those of a vehicle that brakes harder than assumed
            is_together = not is_referenced and _are_together(
                a.speed[part], threshold[part], shortest
            )
            # one speed alone falls because the vehicle brakes, or because the wheel slides
            is_alone = not (
                is_referenced
                or a.run.hardest_is_given
                or bool(np.any(np.isfinite(a.speed[part]).sum(axis=1) > 1))
            )
            is_none = is_short or is_together or is_alone or not is_braked
            if is_none or is_mirrored(sliding[part], j):
                flag[part, j] = False
    of_drops = _drops(a, v, noise)
    size_m_s = np.where(flag, sliding, of_drops.size_m_s)
    return Seen(flag | of_drops.slides_at, size_m_s)


def _drops(a: Aligned, v: np.ndarray, noise: Noise) -> Seen:
    """Return where each speed drops and recovers while the vehicle is braked, and by how much."""
    if not drops.can_be_seen(a):
        return Seen(np.zeros(a.speed.shape, bool), np.zeros(a.speed.shape))
    of = drops.excess(a, v, noise.least_drop_m_s)
    # without a reference v is a bound, which may rise before the vehicle drives again
    speed = a.reference if a.has_reference else sampling.median(a.speed.T)
    is_braked = np.nan_to_num(slope(a.time_s, speed, limit.DROP_WINDOW_S)) < _BRAKED_M_S2
    flag = drops.flags(of, is_braked, limit.drop_samples(a.step_s))
    for j in range(flag.shape[1]):
        for stretch in stretches(flag[:, j]):
            part = slice(stretch.first, stretch.last + 1)
            # without a reference a drop of one wheel is a rise of the others
            if a.has_reference and is_mirrored(of.excess_m_s[part], j):
                flag[part, j] = False
    return Seen(flag, of.excess_m_s)


def short_drops(a: Aligned, slides_at: np.ndarray) -> list[ShortDrop]:
    """Return drops that are visible in braking, and are no slide because they are too short.

    They are twice as large as the least drop that counts. `slides_at` (n, m) are the slides.
    """
    if not drops.can_be_seen(a) or not can_be_seen(a):
        return []
    v = vehicle(a)
    of = drops.excess(a, v, noise_of(a, v).least_drop_m_s)
    large = of._replace(smallest_m_s=2.0 * of.smallest_m_s)
    speed = a.reference if a.has_reference else sampling.median(a.speed.T)
    is_braked = np.nan_to_num(slope(a.time_s, speed, limit.DROP_WINDOW_S)) < _BRAKED_M_S2
    visible = drops.flags(large, is_braked, limit.DROP_VISIBLE_SAMPLES)
    found = []
    for j, name in enumerate(a.names):
        for stretch in stretches(visible[:, j]):
            part = slice(stretch.first, stretch.last + 1)
            is_mirror = a.has_reference and is_mirrored(of.excess_m_s[part], j)
            if not slides_at[part].any() and not is_mirror:
                depth_m_s = float(of.excess_m_s[part, j].max())
                found.append(ShortDrop(name, stretch.first, stretch.last, depth_m_s))
    return found


def where_reference_is_off(a: Aligned, faster: bool) -> np.ndarray:
    """Return where the reference is faster, or slower, than wheels that agree, flags (n,)."""
    if not a.has_reference:
        return np.zeros(a.time_s.size, bool)
    v = a.reference
    sliding = v[:, None] - a.speed
    threshold = smallest(a, v, by_noise(a, scatter(a)))
    if faster:
        return agreeing(a, v, sliding, threshold)
    by_speed = (limit.slip_share(v) * v)[:, None]
    return agreeing(a, v, -sliding, np.maximum(threshold, by_speed))


def agreeing(
    a: Aligned, v: np.ndarray, difference: np.ndarray, threshold: np.ndarray
) -> np.ndarray:
    """Return where all wheels differ from the reference by the same amount, flags (n,).

    `difference` and `threshold` (n, m) are those of sliding or slipping wheels. Wheels that slide
    differ from one another, so here the reference is off. Locked wheels agree as well, and slide.
    """
    if not a.has_reference or len(a.names) < 2:
        return np.zeros(v.size, bool)
    known = np.isfinite(difference)
    several = known.sum(axis=1) > 1
    most = np.max(np.where(known, difference, -np.inf), axis=1)
    fewest = np.min(np.where(known, difference, np.inf), axis=1)
    is_off = several & (most > np.min(threshold, axis=1))
    found = np.zeros(v.size, bool)
    for stretch in stretches(is_off & (fewest > 0.0)):
        part = slice(stretch.first, stretch.last + 1)
        middle = 0.5 * (most[part] + fewest[part])
        is_locked = float(np.median(middle)) > limit.LOCKED_SHARE * float(np.median(v[part]))
        spread = most[part] - fewest[part]
        if not is_locked and np.median(spread) < limit.AGREE_SHARE * np.median(middle):
            found[part] = True
    return found


def _are_together(speed: np.ndarray, threshold: np.ndarray, shortest: int) -> bool:
    """Whether several speeds (n, m) never differ by more than the smallest slide for long enough.

    `shortest` is the number of samples of the shortest slide.
    """
    if speed.shape[1] < 2:
        return False
    known = np.isfinite(speed)
    fastest = np.max(np.where(known, speed, -np.inf), axis=1)
    slowest = np.min(np.where(known, speed, np.inf), axis=1)
    several = known.sum(axis=1) > 1
    differ = several & (fastest - slowest > np.min(threshold, axis=1))
    return not any(part.last - part.first + 1 >= shortest for part in stretches(differ))


def is_mirrored(difference: np.ndarray, j: int) -> bool:
    """Whether another wheel differs from the vehicle as much with the opposite sign, as in a curve.

    `difference` (n, m) is that of all wheels.
    """
    means = [
        float(np.nanmean(column)) if np.isfinite(column).any() else 0.0 for column in difference.T
    ]
    of_wheel = means[j]
    return any(
        other * of_wheel < 0.0 and abs(other) > limit.MIRROR_SHARE * abs(of_wheel)
        for other in means
    )


def episodes(a: Aligned, any_slides: np.ndarray) -> list[tuple[int, int]]:
    """Return first and last sample of each episode; slides less than 2 s apart are one episode."""
    found: list[tuple[int, int]] = []
    for first, last in stretches(any_slides):
        if found:
            begin, end = found[-1]
            if a.time_s[first] - a.time_s[end] < _SAME_EPISODE_S:
                found[-1] = (begin, last)
                continue
        found.append((first, last))
    return found


def _slide(
    number_of_run: int,
    a: Aligned,
    v: np.ndarray,
    seen: Seen,
    scatter_m_s: np.ndarray,
    first: int,
    last: int,
) -> Slide:
    """Return one episode; its size is the largest sliding."""
    part = slice(first, last + 1)
    slides_at = seen.slides_at
    within = np.where(slides_at[part], seen.size_m_s[part], 0.0)
    worst = int(np.argmax(within.max(axis=0)))
    most = float(within.max())
    half = half_interval_m_s(most, float(scatter_m_s[worst]))

    names = [name for j, name in enumerate(a.names) if slides_at[part, j].any()]
    start_s = float(a.time_s[first])
    end_s = float(a.time_s[last])
    adhesion = _adhesion(a, v, first, last)
    finding = Finding(
        name="slide",
        channels=tuple(names),
        run=a.run.name,
        start_s=start_s,
        end_s=end_s,
        size=most,
        low=most - half,
        high=most + half,
        unit="m/s",
        details=Sliding(
            duration_s=end_s - start_s + a.step_s,
            initial_speed_m_s=float(v[first]),
            adhesion_at_least=float(adhesion.low),
            cycles=cycles(a, seen.size_m_s, slides_at, first, last),
        ),
        date=a.run.date,
    )
    return Slide(number_of_run, first, last, finding, adhesion)


def cycles(
    a: Aligned, difference: np.ndarray, flags: np.ndarray, first: int, last: int
) -> tuple[Cycle, ...]:
    """Return each time that a wheel leaves the vehicle's speed and recovers in one episode."""
    found = []
    for j, name in enumerate(a.names):
        for stretch in stretches(flags[first : last + 1, j]):
            part = slice(first + stretch.first, first + stretch.last + 1)
            found.append(
                Cycle(
                    channel=name,
                    start_s=float(a.time_s[part][0]),
                    end_s=float(a.time_s[part][-1]),
                    depth_m_s=float(np.nanmax(difference[part, j])),
                )
            )
    return tuple(sorted(found, key=lambda cycle: cycle.start_s))


def _adhesion(a: Aligned, v: np.ndarray, first: int, last: int) -> AdhesionUsed:
    """Return the mean adhesion used and its bounds, by the deceleration over the episode [S2]."""
    middle_s = 0.5 * (a.time_s[first] + a.time_s[last])
    half_s = max(1.0, 0.5 * (a.time_s[last] - a.time_s[first]))
    near = np.abs(a.time_s - middle_s) <= half_s + 0.5 * a.step_s
    samples = np.flatnonzero(near & np.isfinite(v))
    deceleration: _Deceleration | None
    if np.isfinite(a.reference[samples]).mean() > 0.67:
        deceleration = _deceleration_by_reference(a, v, samples)
    else:
        deceleration = _deceleration_by_wheels(a, v, first, last)
    if deceleration is None:
        return AdhesionUsed(np.nan, np.nan, np.nan)

    value, error = deceleration
    return AdhesionUsed(
        mean=value / GRAVITY_M_S2,
        low=(value - 2.0 * error - limit.RESISTANCE_M_S2) / GRAVITY_M_S2,
        high=(value + 2.0 * error) / GRAVITY_M_S2,
    )


def _deceleration_by_reference(a: Aligned, v: np.ndarray, samples: np.ndarray) -> _Deceleration:
    """Return the slope of a straight line through the speed of the vehicle."""
    t = a.time_s[samples] - a.time_s[samples].mean()
    deceleration = -float(t @ v[samples] / (t @ t))
    rest = v[samples] - v[samples].mean() + deceleration * t
    variance = rest @ rest / max(samples.size - 2, 1)
    # the noise of a receiver is not white: as if only a quarter of the samples were independent
    error = 2.0 * float(np.sqrt(variance / (t @ t)))
    return _Deceleration(deceleration, error)


def _deceleration_by_wheels(
    a: Aligned, v: np.ndarray, first: int, last: int
) -> _Deceleration | None:
    """Return the deceleration between two moments before and after the slide when all wheels roll.

    The result is None where there is no such moment, or only a single speed.
    """
    count = max(round(_ROLLING_S / a.step_s), 2)
    if len(a.names) > 1:
        spread = np.ptp(np.where(np.isfinite(a.speed), a.speed, np.nan), axis=1)
    else:
        spread = np.full(v.size, np.nan)
    is_together = np.nan_to_num(spread, nan=np.inf) < limit.TOGETHER_M_S
    # samples in a row that are close together, up to each sample
    together = np.convolve(is_together, np.ones(count), "full")
    all_roll = together > count - 0.5
    before = np.flatnonzero(all_roll[:first])
    after = last + 1 + np.flatnonzero(all_roll[last + count : v.size])
    if not (before.size and after.size):
        return None

    seconds = float(a.time_s[after[0]] - a.time_s[before[-1]])
    deceleration = -float(v[after[0]] - v[before[-1]]) / seconds
    return _Deceleration(deceleration, 0.5 * limit.TOGETHER_M_S / seconds)


# --- places ---


class _Span(NamedTuple):
    """Positions from and to, m."""

    low_m: float
    high_m: float


def places(aligned: list[Aligned], slides: list[Slide]) -> list[Finding]:
    """Return the places where significantly many runs slide.

    By chance, each run would slide anywhere on the track on which it braked. This is simulated: the
    slides of a run are shifted together along its braked track, which is closed to a ring.
    """
    spans: dict[int, list[_Span]] = {}
    for slide in slides:
        position = aligned[slide.run].position[slide.first : slide.last + 1]
        if np.isfinite(position).any():
            span = _Span(float(np.nanmin(position)), float(np.nanmax(position)))
            spans.setdefault(slide.run, []).append(span)
    if len(spans) < limit.PLACE_RUNS:
        return []

    braked = {run: _braked_track(aligned[run], spans[run]) for run in spans}
    start_m = min(track.low_m for track in braked.values())
    end_m = max(track.high_m for track in braked.values())
    grid_m = np.arange(start_m, end_m + _PLACE_STEP_M, _PLACE_STEP_M)

    count = _runs_that_slide(grid_m, spans, braked, {})
    if count.max() < limit.PLACE_RUNS:
        return []
    rng = np.random.default_rng(1)
    as_many = 0
    for _ in range(_ARRANGEMENTS):
        shift_m = {run: rng.uniform(0.0, 1e6) for run in spans}
        simulated = _runs_that_slide(grid_m, spans, braked, shift_m)
        if simulated.max() >= count.max():
            as_many += 1
    chance = (1 + as_many) / (_ARRANGEMENTS + 1)
    if chance > limit.PLACE_P:
        return []

    found = []
    for first, last in stretches(count >= max(limit.PLACE_RUNS, 0.75 * count.max())):
        place = _Span(float(grid_m[first]), float(grid_m[last] + _PLACE_STEP_M))
        names = [
            aligned[run].run.name for run, run_spans in spans.items() if _meets(run_spans, place)
        ]
        length_m = place.high_m - place.low_m
        found.append(
            Finding(
                name="slippery_place",
                channels=("position",),
                size=length_m,
                low=max(length_m - 2 * _PLACE_STEP_M, 0.0),
                high=length_m + 2 * _PLACE_STEP_M,
                unit="m",
                details=SharedPlace(
                    runs=tuple(names),
                    most_runs=int(count[first : last + 1].max()),
                    chance=float(chance),
                ),
                place_m=(place.low_m, place.high_m),
            )
        )
    return found


def _braked_track(a: Aligned, spans: list[_Span]) -> _Span:
    """Return the positions between which a run brakes or slides."""
    change_m_s2 = np.nan_to_num(slope(a.time_s, a.vehicle))
    is_braked = np.isfinite(a.position) & (change_m_s2 < _BRAKED_TRACK_M_S2)
    positions = [*a.position[is_braked]]
    for span in spans:
        positions += [span.low_m, span.high_m]
    return _Span(min(positions), max(positions))


def _runs_that_slide(
    grid_m: np.ndarray,
    spans: dict[int, list[_Span]],
    braked: dict[int, _Span],
    shift_m: dict[int, float],
) -> np.ndarray:
    """Return how many runs slide in each step of the grid, with the slides of each run shifted."""
    count = np.zeros(grid_m.size)
    for run, run_spans in spans.items():
        track = braked[run]
        length_m = max(track.high_m - track.low_m, _PLACE_STEP_M)
        slides_at = np.zeros(grid_m.size, bool)
        for span in run_spans:
            from_track_m = span.low_m - track.low_m + shift_m.get(run, 0.0)
            start_m = track.low_m + from_track_m % length_m
            end_m = start_m + span.high_m - span.low_m
            slides_at |= (grid_m + _PLACE_STEP_M > start_m) & (grid_m < end_m)
        count += slides_at
    return count


def _meets(spans: list[_Span], place: _Span) -> bool:
    """Whether one of the slides of a run is in a place."""
    return any(span.high_m > place.low_m and span.low_m < place.high_m for span in spans)
