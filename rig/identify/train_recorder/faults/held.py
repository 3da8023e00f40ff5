"""Finds a sensor that holds its value while the vehicle's speed changes."""

from collections.abc import Iterator

import numpy as np

from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.faults import each_speed
from rollerrig.rig.identify.train_recorder.findings import StuckValue
from rollerrig.rig.identify.train_recorder.recording import Channel, Run
from rollerrig.rig.identify.train_recorder.sampling import Stretch

# A value that is held for more than this many times the usual time is stuck. The usual time is
# known from so many stretches, which are a share of all samples. Chosen.
_HELD_FACTOR = 3.0
_HELD_STRETCHES = 10
_HELD_SAMPLES_SHARE = 0.2

# share of the motion of the other channels in a hold. If they end further away from their first
# value, a stuck sensor jumps by at least this share of what it missed. Chosen.
_MISSED_SHARE = 0.5

# samples that such a jump may take, if they are no further apart than this, s. At longer intervals
# the vehicle's motion in several samples is as large as the jump. Chosen.
_JUMP_SAMPLES = 3
_FAST_STEP_S = 0.25


@each_speed.each_speed
def find(run: Run, channel: Channel) -> Iterator[each_speed.Hit]:
    """Find a value that stays while the other channels move, or ends in an impossible jump.

    Of a slow sensor only the updates count. A value is not held across a gap.
    """
    good = np.flatnonzero(np.isfinite(channel.values))
    if good.size < 2:
        return
    known = channel._replace(time_s=channel.time_s[good], values=channel.values[good])
    v = known.values
    t = known.time_s
    others = each_speed.others(run, known)
    without_gap = np.diff(t) <= limit.gap_s(float(np.median(np.diff(t))))
    is_same = np.concatenate([(np.diff(v) == 0.0) & without_gap, [False]]) & (
        np.abs(v) > sampling.ZERO_M_S
    )
    held = sampling.stretches(is_same)
    shortest_s = limit.stuck_s(float(np.median(np.diff(t))), run.logs_on_change)
    shortest_s = max(shortest_s, _HELD_FACTOR * _usually_held_s(known, others, held))
    # both the held value and the others are rounded
    other_quanta_m_s = [c.quantum for c in run.of(*sampling.SPEEDS) if c.name != channel.name]
    step_m_s = max(channel.quantum, _step_after_hold(v, held)) + max(other_quanta_m_s, default=0.0)
    least_move_m_s = least_move_of_others(run, channel)
    for stretch in held:
        first = stretch.first
        last = stretch.last + 1  # equal to the sample before it
        if t[last] - t[first] < shortest_s:
            continue

        held_others = others[first : last + 1]
        known_others = held_others[np.isfinite(held_others)]
        others_move_m_s = float(np.ptp(known_others)) if known_others.size > 1 else 0.0
        jump_m_s = abs(v[last + 1] - v[last]) if last + 1 < v.size else 0.0
        possible_m_s = limit.jump_m_s(run.hardest_m_s2, t[min(last + 1, t.size - 1)] - t[last])
        # one more pulse or rounding step is no jump
        possible_m_s += channel.quantum

        all_freeze = others_move_m_s == 0.0 and jump_m_s > possible_m_s
        moved_m_s = max(least_move_m_s, _HELD_FACTOR * step_m_s)
        is_passed = others_move_m_s > moved_m_s and not _moves_on(known, last, known_others)
        if all_freeze or is_passed:
            yield each_speed.Hit(
                "sensor_stuck", int(good[first]), int(good[last]), StuckValue(float(v[first]))
            )


def _moves_on(channel: Channel, last: int, others: np.ndarray) -> bool:
    """Whether a channel leaves its hold, which ends at sample `last`, without a jump.

    A stuck sensor misses what the others moved in the hold, and jumps by it at the end. A sensor
    that is right, and is compared with others at the wrong time, moves on as it does later. The
    result is False where the others returned to their first value, or where the channel ends.
    """
    v = channel.values
    missed_m_s = float(others[-1] - others[0])
    if abs(missed_m_s) < _MISSED_SHARE * np.ptp(others):
        return False
    # resampled values may take some samples for a jump
    most_samples = _JUMP_SAMPLES if channel.step_s <= _FAST_STEP_S else 1
    if last + 2 * most_samples >= v.size:
        return False
    for samples in range(1, most_samples + 1):
        jump_m_s = float(v[last + samples] - v[last])
        later_m_s = float(v[last + 2 * samples] - v[last + samples])
        beyond_motion_m_s = abs(jump_m_s - later_m_s)
        is_along = jump_m_s * missed_m_s > 0.0
        if is_along and beyond_motion_m_s > _MISSED_SHARE * abs(missed_m_s):
            return False
    return True


def least_move_of_others(run: Run, channel: Channel) -> float:
    """Return by how much other speeds must move while a channel holds a value, m/s."""
    errors_m_s = [other.error for other in run.of(*sampling.SPEEDS) if other.name != channel.name]
    return limit.moved_m_s(max(errors_m_s, default=0.0), run.fastest_m_s)


def _step_after_hold(values: np.ndarray, held: list[Stretch]) -> float:
    """Return by how much a channel usually changes after it held a value, m/s.

    It is the resolution of a sensor whose values were interpolated or have several steps. The
    result is 0 where few values are held.
    """
    changes = []
    for stretch in held:
        after = stretch.last + 2
        if after < values.size and np.isfinite(values[after]):
            changes.append(abs(float(values[after] - values[after - 1])))
    return float(np.median(changes)) if len(changes) >= _HELD_STRETCHES else 0.0


def _usually_held_s(channel: Channel, others: np.ndarray, held: list[Stretch]) -> float:
    """Return how long a channel usually holds a value while the others move, s.

    A slow sensor in a fast file repeats each value. The result is 0 where few values are held.
    """
    t = channel.time_s
    held_s = []
    samples = 0
    for stretch in held:
        part = others[stretch.first : stretch.last + 2]
        known = part[np.isfinite(part)]
        if known.size > 1 and np.ptp(known) > channel.quantum:
            held_s.append(float(t[min(stretch.last + 1, t.size - 1)] - t[stretch.first]))
            samples += stretch.last - stretch.first + 1
    if len(held_s) < _HELD_STRETCHES or samples < _HELD_SAMPLES_SHARE * t.size:
        return 0.0
    # a single long one counts as one
    return float(np.median(held_s))
