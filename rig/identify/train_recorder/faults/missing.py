"""Finds values that are no data: empty cells, straight lines that fill a gap, and zeros."""

from collections.abc import Iterator

import numpy as np

from rollerrig.rig.identify.train_recorder import findings, sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.faults import each_speed
from rollerrig.rig.identify.train_recorder.findings import DropOut
from rollerrig.rig.identify.train_recorder.recording import Channel, Run
from rollerrig.rig.identify.train_recorder.sampling import Stretch

# share of the samples. A channel with more on straight lines was resampled along them.
_MOSTLY_STRAIGHT = 0.3


# changes that show how much a speed usually changes in a sample
_USUAL_SAMPLES = 50


@each_speed.each_speed
def empty_cells(_: Run, channel: Channel) -> Iterator[each_speed.Hit]:
    """Find cells without a value, of one channel while the others go on."""
    good = np.flatnonzero(np.isfinite(channel.values))
    longest_s = limit.gap_s(channel.step_s)
    row_s = float(np.median(np.diff(channel.time_s)))
    for k in np.flatnonzero(np.diff(channel.time_s[good]) > longest_s):
        first = int(good[k]) + 1
        last = int(good[k + 1]) - 1
        intervals_s = np.diff(channel.time_s[first - 1 : last + 2])
        # a gap of all rows is a matter of the stamps
        is_long = intervals_s[intervals_s < 2.5 * row_s].sum() > longest_s
        if is_long and last - first >= 1 and first > 0:
            yield each_speed.Hit("sensor_dropout", first, last, DropOut((findings.NO_VALUES,)))


@each_speed.each_speed
def lines(_: Run, channel: Channel) -> Iterator[each_speed.Hit]:
    """Find straight lines over seconds, which fill a gap and are no data."""
    good = np.flatnonzero(np.isfinite(channel.values))
    v = channel.values[good]
    t = channel.time_s[good]
    slope = np.diff(v) / np.maximum(np.diff(t), 1e-6)

    # a line is straight over the stamps, or over the count of samples
    bend = np.minimum(np.abs(np.diff(slope)) * channel.step_s, np.abs(np.diff(v, 2)))
    bends = bend > 0.0
    usual_bend = float(np.median(bend[bends])) if bends.any() else 0.0
    roughness = max(usual_bend, 0.5 * channel.quantum)
    is_straight = (bend < limit.LINE_SHARE * roughness) & (np.abs(slope[1:]) > 1e-3)

    if np.mean(is_straight) > _MOSTLY_STRAIGHT:
        # the whole channel was resampled along straight lines
        return
    for stretch in sampling.stretches(np.concatenate([[False], is_straight, [False]])):
        # the neighbours on both sides are on the line, too
        first = stretch.first - 1
        last = stretch.last + 1
        long_enough = t[last] - t[first] >= limit.LINE_S and last - first >= 8
        if long_enough and _is_off_rounding(v[first : last + 1], channel.quantum):
            yield each_speed.Hit("interpolated", int(good[first]), int(good[last]), None)


def _is_off_rounding(values: np.ndarray, quantum: float) -> bool:
    """Whether most values are between the rounding steps of the channel, or it has none."""
    if not quantum:
        return True
    steps = values / quantum
    return bool(np.mean(np.abs(steps - np.rint(steps)) > 1e-3) > 0.7)


@each_speed.each_speed
def zeros(run: Run, channel: Channel) -> Iterator[each_speed.Hit]:
    """Find zeros that come and go faster than a wheel can lock or take up speed.

    A speed from few pulses in each interval is zero where no pulse falls into one.
    """
    changes = np.abs(np.diff(channel.values))
    moves = changes[np.isfinite(changes) & (changes > 0.0)]
    usual_m_s = float(np.median(moves)) if moves.size > _USUAL_SAMPLES else 0.0
    others = each_speed.others(run, channel)
    for stretch in sampling.stretches(np.abs(channel.values) < sampling.ZERO_M_S):
        edges_m_s = []
        for outside, inside in (
            (stretch.first - 1, stretch.first),
            (stretch.last + 1, stretch.last),
        ):
            speed_m_s = _speed_next_to(channel, outside, inside)
            if speed_m_s is not None:
                edges_m_s.append(speed_m_s)
        fastest_m_s = limit.zero_jump_m_s(run.hardest_m_s2, channel.step_s)
        if len(edges_m_s) == 2 and _is_not_braked(channel.time_s, others, stretch):
            # nothing locks a wheel, however slowly its speed is sampled
            fastest_m_s = limit.ZERO_JUMP_M_S
        fastest_m_s = max(fastest_m_s, limit.JUMP_FACTOR * usual_m_s)
        if edges_m_s and min(edges_m_s) > fastest_m_s:
            yield each_speed.Hit(
                "sensor_dropout", stretch.first, stretch.last, DropOut((findings.ZEROS,))
            )


def _is_not_braked(time_s: np.ndarray, others: np.ndarray, stretch: Stretch) -> bool:
    """Whether the median of the other speeds loses no speed from before a stretch to after it."""
    before = others[stretch.first - 1]
    after = others[stretch.last + 1]
    passed_s = time_s[stretch.last + 1] - time_s[stretch.first - 1]
    return bool(after - before > -limit.QUIET_M_S2 * passed_s)


def _speed_next_to(channel: Channel, outside: int, inside: int) -> float | None:
    """Return the speed outside an edge, m/s; None at a gap or an end of the recording."""
    if not 0 <= outside < channel.values.size:
        return None
    is_gap = abs(channel.time_s[outside] - channel.time_s[inside]) >= 2.5 * channel.step_s
    if is_gap or not np.isfinite(channel.values[outside]):
        return None
    return abs(float(channel.values[outside]))
