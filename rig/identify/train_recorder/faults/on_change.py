"""Recognises which samples are news: logging on change, and sensors that are slower than the file.

A recorder that logs a row only when a value changes leaves long intervals in which nothing changes
by more than its deadband. They are filled. A gap of a recorder that logs every sample has no such
bound: after it the speed has moved on.

A sensor that is slower than the file, such as a receiver at 1 Hz in a file at 100 Hz, repeats each
value. Its repeated values are no measurements, and only its updates are kept.
"""

import itertools

import numpy as np

from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.recording import Channel, Run

_SPEEDS = ("speed", "reference")

# times the median interval. A longer interval is a long one.
_LONG = 2.5

# quantile of the changes across long intervals, and how many usual changes it may reach. Chosen.
_LONG_QUANTILE = 0.9
_LONG_CHANGES = 1.5

# share of a usual change that half of the long intervals stay below, although a few have more: a
# sensor that reads zero up to a speed jumps when the vehicle starts. Chosen.
_IDLE_SHARE = 0.5

# quantile of the changes of the other rows, and the share of a usual change that it must reach:
# rows without a change are rare. White noise of one channel reaches 0.47. Chosen.
_ROW_QUANTILE = 0.25
_ROW_SHARE = 0.35

# long intervals of a recorder that has a single row for each stop. Chosen.
_STOPS = 2

# samples. A sensor whose values are held for fewer is not called slow.
_SLOW_SAMPLES = 3

# changes of the value, of how many rounding steps, that show how long a sensor holds its values
_LEAST_UPDATES = 10
_FAST_STEPS = 2.0

# share of these intervals that must agree, and the share by which they may differ. Chosen.
_REGULAR = 0.7
_REGULAR_SHARE = 0.25


def resampled(run: Run) -> Run | None:
    """Return a run with all samples if it logs on change; None if it logs every sample.

    Values between two rows are interpolated, or held where they jump. They are known to the
    deadband.
    """
    groups: dict[bytes, list[Channel]] = {}
    for channel in run.channels.values():
        # cells without a value belong to the rows of other channels
        known = channel._replace(
            time_s=channel.time_s[np.isfinite(channel.values)],
            values=channel.values[np.isfinite(channel.values)],
        )
        groups.setdefault(known.time_s.tobytes(), []).append(known)

    channels = {}
    any_on_change = False
    for group in groups.values():
        deadband_m_s = deadband(group)
        if deadband_m_s is None:
            for channel in group:
                channels[channel.name] = run.channels[channel.name]
            continue
        any_on_change = True
        for channel in group:
            channels[channel.name] = _filled(channel, deadband_m_s)
    if not any_on_change:
        return None
    # in the order of the recording
    ordered = {name: channels[name] for name in run.channels}
    return run._replace(channels=ordered, logs_on_change=True)


def updates(run: Run) -> tuple[Run, dict[str, float]]:
    """Return a run with the updates of its slow sensors, and the usual interval of each of them, s.

    Samples between two updates are NaN.
    """
    channels = dict(run.channels)
    intervals_s = {}
    for channel in run.of(*_SPEEDS):
        samples = update_samples(channel)
        if samples < _SLOW_SAMPLES:
            continue
        intervals_s[channel.name] = samples * channel.step_s
        channels[channel.name] = _updates_of(channel, samples)
    return run._replace(channels=channels), intervals_s


def update_samples(channel: Channel) -> int:
    """Return every how many samples a channel has a new value; 1 if any sample may be new.

    Values that change by one rounding step only do not count, because a rounded value is held, too.
    """
    values = channel.values
    if not np.isfinite(values).all():
        return 1
    changes = np.abs(np.diff(values))
    changed = np.flatnonzero(changes > 0.0)
    if changed.size < _LEAST_UPDATES:
        return 1
    held = np.diff(changed)
    # the value moved on by several rounding steps while it was held
    is_fast = changes[changed[1:]] > _FAST_STEPS * channel.quantum
    if np.count_nonzero(is_fast) < _LEAST_UPDATES:
        return 1
    usual = int(np.median(held[is_fast]))
    near = np.abs(held[is_fast] - usual) <= max(1.0, _REGULAR_SHARE * usual)
    early = held < (1.0 - 2.0 * _REGULAR_SHARE) * usual - 1.0
    is_regular = np.mean(near) > _REGULAR and np.mean(early) < 1.0 - _REGULAR
    return usual if is_regular else 1


def _updates_of(channel: Channel, samples: int) -> Channel:
    """Return a channel without the repeated values between updates `samples` apart."""
    values = channel.values
    is_update = np.concatenate([[True], np.diff(values) != 0.0])
    update = np.append(np.flatnonzero(is_update), values.size)
    for first, after in itertools.pairwise(update):
        # updates in between had the same value
        equal = round((after - first) / samples) - 1
        is_update[first + samples * np.arange(1, equal + 1)] = True
    return channel._replace(values=np.where(is_update, values, np.nan))


def deadband(group: list[Channel]) -> float | None:
    """Return the change that makes a recorder log a row, m/s; None if it logs every sample."""
    speeds = [channel for channel in group if channel.quantity in _SPEEDS]
    if not speeds or speeds[0].time_s.size < 2 * limit.CHANGE_INTERVALS:
        return None
    intervals_s = np.diff(speeds[0].time_s)
    if np.any(intervals_s < 0.0):
        return None
    is_long = intervals_s > _LONG * float(np.median(intervals_s))
    change = np.max([np.abs(np.diff(channel.values)) for channel in group], axis=0)
    no_idle_rows = not np.any(change == 0.0)
    # a recorder that logs every sample repeats the zeros of a standing vehicle
    stands = np.all([channel.values == 0.0 for channel in speeds], axis=0)
    one_row_per_stop = no_idle_rows and bool(stands.any())
    least = _STOPS if one_row_per_stop else limit.CHANGE_INTERVALS
    if is_long.sum() < least:
        return None

    change = np.max([np.abs(np.diff(channel.values)) for channel in speeds], axis=0)
    usual = float(np.median(change[~is_long]))
    rare = np.quantile(change[~is_long], _ROW_QUANTILE) >= _ROW_SHARE * usual > 0.0
    few_idle_rows = one_row_per_stop or bool(rare)
    long_change = float(np.quantile(change[is_long], _LONG_QUANTILE))
    is_bounded = long_change <= _LONG_CHANGES * usual
    is_mostly_idle = float(np.median(change[is_long])) <= _IDLE_SHARE * usual
    if few_idle_rows and (is_bounded or is_mostly_idle):
        return usual
    return None


def _filled(channel: Channel, deadband_m_s: float) -> Channel:
    """Return a channel with samples at even intervals, by linear interpolation.

    A speed that changes by more than the deadband across a long interval stayed until the next row,
    and so does one that begins or ends at zero: a sensor may read zero up to some speed. Across
    very long intervals such a speed is unknown: rows are missing.
    """
    intervals_s = np.diff(channel.time_s)
    step_s = float(np.median(intervals_s))
    count = int((channel.time_s[-1] - channel.time_s[0]) / step_s) + 1
    time_s = channel.time_s[0] + step_s * np.arange(count)
    values = np.interp(time_s, channel.time_s, channel.values)
    if channel.quantity in _SPEEDS:
        before = channel.values[:-1]
        jumps = np.abs(np.diff(channel.values)) > _LONG_CHANGES * deadband_m_s
        at_zero = (before == 0.0) | (channel.values[1:] == 0.0)
        stays = jumps & (at_zero | (intervals_s > _LONG * step_s))
        is_unknown = jumps & (before != 0.0) & (intervals_s > limit.BLOCK_S)
        row = np.clip(np.searchsorted(channel.time_s, time_s, "right") - 1, 0, before.size - 1)
        is_between = (time_s > channel.time_s[row]) & (time_s < channel.time_s[row + 1])
        values = np.where(is_between & stays[row], before[row], values)
        values[is_between & is_unknown[row]] = np.nan
    return channel._replace(time_s=time_s, values=values, deadband_m_s=deadband_m_s)
