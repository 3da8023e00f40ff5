"""Finds what a recorder or a sensor did wrong, and takes it out before all other steps.

The checks run in this order: units, logging on change, clock steps and gaps of the stamps, missing
values, old messages at the start, straight lines, zeros, held values; then copies between runs.
Each check returns the run without what it found, and its findings. Values that are no data become
NaN. Wrong stamps are corrected.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import findings, on_change
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.findings import (
    ClockStep,
    CopyOfChannel,
    CopySource,
    Details,
    DropOut,
    Finding,
    StuckValue,
    WrongUnit,
)
from rollerrig.rig.identify.train_recorder.recording import Channel, Run


class UnitRatio(NamedTuple):
    """Numbers in `true_unit` that are read as `declared_unit` are too large by `ratio`."""

    ratio: float
    true_unit: str
    declared_unit: str


_RATIOS = (
    UnitRatio(3.6, "km/h", "m/s"),
    UnitRatio(1 / 3.6, "m/s", "km/h"),
    UnitRatio(2.23694, "mph", "m/s"),
    UnitRatio(0.44704, "m/s", "mph"),
    UnitRatio(1.609344, "km/h", "mph"),
    UnitRatio(1 / 1.609344, "mph", "km/h"),
)
_SPEEDS = ("speed", "reference")

# s. Change of speed is measured over these windows, and this percentile of it counts.
_HARDEST_WINDOW_S = 1.0
_HARDEST_PERCENTILE = 99.8

# m/s. A channel whose upper quartile is below it shows no unit.
MOVING_M_S = 0.5

# samples in motion with a position. Fewer do not show a unit.
_POSITION_SAMPLES = 20

# ratio of speeds that no wheel reaches for long by slip: of m/s and km/h or mph. Chosen.
_NO_SLIP_RATIO = 2.0

# share by which speeds of one unit may differ
_SAME_UNIT_SHARE = 0.1

# share of the samples. A channel with more on straight lines was resampled along them.
_MOSTLY_STRAIGHT = 0.3

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

# m/s. A value closer to zero is a zero.
_ZERO_M_S = 1e-9


# s. A vehicle may keep its slope through a gap of this length.
_SHORT_GAP_S = 3.0

# samples on each side of a jump of the stamps: at most and at least
_SIDE_SAMPLES = 15
_LEAST_SIDE_SAMPLES = 8

# s. After a gap of this length no vehicle has the same speed and slope as before.
LONG_JUMP_S = 60.0

# s. Longest interval of the samples with which a shorter step of the clock shows.
SLOWEST_CLOCK_S = limit.CLOCK_SIDE_S / _LEAST_SIDE_SAMPLES

# samples and percentile of their changes that show how much a speed usually changes in a sample
_USUAL_SAMPLES = 50
_USUAL_PERCENTILE = 99.0


class Stretch(NamedTuple):
    """Samples first to last of a channel, both included."""

    first: int
    last: int


class Hit(NamedTuple):
    """What a check of one channel finds: name, first and last sample, details."""

    name: str
    first: int
    last: int
    details: Details | None


def find(run: Run) -> tuple[Run, list[Finding]]:
    """Return a run without its faults, and the faults. `copies` finds copies between runs."""
    run, found = equal_channels(run)
    run, more = _units(run)
    found += more

    logged = on_change.resampled(run)
    if logged is not None:
        # samples between changes are missing by design: no gap and no line is a fault
        logged = logged._replace(hardest_m_s2=hardest_m_s2(logged))
        logged, more = _held(logged)
        return logged, found + more

    run, more = _stamps(run)
    found += more
    run, _ = on_change.updates(run)
    run = run._replace(hardest_m_s2=hardest_m_s2(run))
    for check in (_missing, _old_messages, _lines, _zeros, _held):
        run, more = check(run)
        found += more
    return run, _join_drop_outs(found)


def hardest_m_s2(run: Run) -> float:
    """Return the hardest braking of the vehicle, m/s^2: that of dataset.toml, else from the data.

    It is at least HARDEST_M_S2. From the data it is the change on which all speeds agree from a
    moment in which all wheels roll to the next one, so that the lock of wheels does not count.
    """
    if run.hardest_is_given:
        return run.hardest_m_s2
    speeds = run.of(*_SPEEDS)
    if len(speeds) < 2:
        return limit.HARDEST_M_S2

    window_s = _HARDEST_WINDOW_S
    time_s = speeds[0].time_s
    half_steps = max(round(0.5 * window_s / speeds[0].step_s), 1)
    if time_s.size <= 2 * half_steps:
        return limit.HARDEST_M_S2
    passed_s = time_s[2 * half_steps :] - time_s[: -2 * half_steps]
    values = np.array([at(channel, time_s) for channel in speeds])
    changes = np.abs(values[:, 2 * half_steps :] - values[:, : -2 * half_steps])
    agreed = np.min(np.nan_to_num(changes), axis=0)
    # at both ends of the window all wheels roll: their speeds are together
    differ = np.ptp(values, axis=0) > np.maximum(
        limit.TOGETHER_M_S, limit.SLIDE_SHARE * np.abs(values).max(axis=0)
    )
    agreed[differ[2 * half_steps :] | differ[: -2 * half_steps]] = 0.0
    good = (passed_s > 0.5 * window_s) & (passed_s < 3.0 * max(window_s, speeds[0].step_s))
    if not good.any():
        return limit.HARDEST_M_S2
    seen_m_s2 = float(np.percentile(agreed[good] / passed_s[good], _HARDEST_PERCENTILE))
    return max(limit.HARDEST_M_S2, limit.HARDEST_FACTOR * seen_m_s2)


def _join_drop_outs(found: list[Finding]) -> list[Finding]:
    """Make one finding of drop-outs of a channel that follow each other, as zeros before a gap."""
    joined: list[Finding] = []
    for finding in sorted(found, key=lambda f: (f.name, f.channels, f.start_s)):
        if joined and _follows(finding, joined[-1]):
            joined[-1] = _extended(joined[-1], finding)
        else:
            joined.append(finding)
    return joined


def _follows(finding: Finding, before: Finding) -> bool:
    """Whether a drop-out continues another one of the same channels."""
    return (
        finding.name == "sensor_dropout"
        and before.name == "sensor_dropout"
        and before.channels == finding.channels
        and finding.start_s - before.end_s < 0.5
    )


def _extended(before: Finding, after: Finding) -> Finding:
    """Return a drop-out from the start of one to the end of the next, with the reasons of both."""
    assert isinstance(before.details, DropOut)
    assert isinstance(after.details, DropOut)
    reasons = before.details.reasons
    for reason in after.details.reasons:
        if reason not in reasons:
            reasons = (*reasons, reason)

    size_s = after.end_s - before.start_s
    half_s = max(after.high - after.size, before.high - before.size)
    return before._replace(
        end_s=after.end_s,
        size=size_s,
        low=size_s - half_s,
        high=size_s + half_s,
        details=DropOut(reasons),
    )


def stretches(flag: np.ndarray) -> list[Stretch]:
    """Return the stretches in which a flag (n,) is set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flag, [False]]).astype(np.int8)))
    return [
        Stretch(int(start), int(end) - 1)
        for start, end in zip(edges[::2], edges[1::2], strict=True)
    ]


def at(channel: Channel, time_s: np.ndarray) -> np.ndarray:
    """Return a channel at other stamps of any shape, by linear interpolation; NaN across gaps."""
    good = np.isfinite(channel.values)
    known_s = channel.time_s[good]
    known = channel.values[good]
    if known_s.size < 2:
        return np.full(time_s.shape, np.nan)

    after = np.clip(np.searchsorted(known_s, time_s), 1, known_s.size - 1)
    without_gap = known_s[after] - known_s[after - 1] <= 2.5 * channel.step_s
    within = (time_s >= known_s[0]) & (time_s <= known_s[-1])
    return np.where(without_gap & within, np.interp(time_s, known_s, known), np.nan)


def median(values: np.ndarray) -> np.ndarray:
    """Return the median over the first axis without NaN; NaN where there is no value."""
    middle = np.full(values.shape[1], np.nan)
    known = np.isfinite(values).any(axis=0)
    middle[known] = np.nanmedian(values[:, known], axis=0)
    return middle


def _replaced(run: Run, channels: list[Channel]) -> Run:
    """Return a run with these channels in place of those of the same names."""
    return run._replace(
        channels={**run.channels, **{channel.name: channel for channel in channels}}
    )


def _without(channel: Channel, parts: list[Stretch]) -> Channel:
    """Return a channel with NaN in these stretches."""
    values = channel.values.copy()
    for part in parts:
        values[part.first : part.last + 1] = np.nan
    return channel._replace(values=values)


def _lasting(
    name: str,
    channel: Channel,
    names: tuple[str, ...],
    run: Run,
    part: Stretch,
    details: Details | None,
) -> Finding:
    """Return a finding whose size is its duration, which is known to one sample."""
    start_s = float(channel.time_s[part.first])
    end_s = float(channel.time_s[part.last])
    step_s = channel.step_s
    size_s = end_s - start_s + step_s
    return Finding(
        name=name,
        channels=names,
        run=run.name,
        start_s=start_s,
        end_s=end_s,
        size=size_s,
        low=max(size_s - step_s, 0.0),
        high=size_s + step_s,
        unit="s",
        details=details,
    )


def _clocks(run: Run) -> list[list[Channel]]:
    """Return the channels in groups that share their stamps."""
    groups: dict[bytes, list[Channel]] = {}
    for channel in run.channels.values():
        groups.setdefault(channel.time_s.tobytes(), []).append(channel)
    return list(groups.values())


# --- units ---


def _units(run: Run) -> tuple[Run, list[Finding]]:
    """Check declared units by the position, else by the majority of the channels.

    Without a position, channels that agree with one another have no wrong unit. One speed alone
    shows nothing about its unit. The ratio must hold for nearly all samples: that of a wheel that
    slips varies.
    """
    speeds = run.of(*_SPEEDS)
    moving = {}
    for channel in speeds:
        upper_quartile = usual_speed_m_s(channel)
        if upper_quartile > MOVING_M_S:
            moving[channel.name] = upper_quartile
    if not moving:
        return run, []

    scale = _scale_by_position(run, speeds)
    evidence = findings.POSITION
    if scale is None:
        scale = _scale_by_majority(run, moving)
        evidence = findings.OTHER_CHANNELS

    found = []
    for channel in speeds:
        measured_ratio = scale.get(channel.name, 1.0)
        match = _matching_ratio(measured_ratio)
        if match is None:
            continue
        found.append(
            Finding(
                name="wrong_unit",
                channels=(channel.name,),
                run=run.name,
                start_s=0.0,
                end_s=float(channel.time_s[-1]),
                size=measured_ratio,
                low=measured_ratio * (1 - limit.UNIT_SHARE),
                high=measured_ratio * (1 + limit.UNIT_SHARE),
                unit="times",
                details=WrongUnit(
                    true_unit=match.true_unit,
                    declared_unit=match.declared_unit,
                    evidence=evidence,
                ),
            )
        )
        corrected = channel._replace(
            values=channel.values / match.ratio, quantum=channel.quantum / match.ratio
        )
        run = _replaced(run, [corrected])
    return run, found


def usual_speed_m_s(channel: Channel) -> float:
    """Return the upper quartile of a speed, which shows its unit."""
    return float(np.nanpercentile(channel.values, 75))


def _matching_ratio(measured_ratio: float) -> UnitRatio | None:
    """Return the two units whose ratio is the measured one; None if there are none."""
    for candidate in _RATIOS:
        if abs(measured_ratio / candidate.ratio - 1.0) < limit.UNIT_SHARE:
            return candidate
    return None


def _scale_by_majority(run: Run, moving: dict[str, float]) -> dict[str, float]:
    """Return each speed over the speed that most channels agree with.

    Channels whose ratio varies from sample to sample are left out.
    """

    def agreeing(speed: float) -> int:
        return sum(abs(other / speed - 1.0) < _SAME_UNIT_SHARE for other in moving.values())

    base_speed = max(sorted(moving.values()), key=agreeing)
    base_name = next(name for name, speed in moving.items() if speed == base_speed)
    base = run.channels[base_name]
    scale = {}
    for name in moving:
        channel = run.channels[name]
        base_values = at(base, channel.time_s)
        is_moving = (base_values > MOVING_M_S) & np.isfinite(channel.values)
        if not is_moving.any():
            continue
        ratios = channel.values[is_moving] / base_values[is_moving]
        ratio = float(np.median(ratios))
        near = np.abs(ratios / ratio - 1.0) < limit.UNIT_SHARE
        if max(ratio, 1.0 / max(ratio, 1e-9)) > _NO_SLIP_RATIO:
            near = np.abs(ratios / ratio - 1.0) < limit.UNIT_WIDE_SHARE
        if ratio > 0.0 and np.mean(near) > limit.UNIT_STEADY:
            scale[name] = ratio
    return scale


def _scale_by_position(run: Run, speeds: list[Channel]) -> dict[str, float] | None:
    """Return the distance by each speed over the distance by position; medians of windows of 2 s.

    The result is None without a position or with too few samples in motion.
    """
    positions = run.of("position")
    if not positions:
        return None
    scale = {}
    for channel in speeds:
        position = at(positions[0], channel.time_s)
        steps = max(round(2.0 / channel.step_s), 1)
        moved_m = position[steps:] - position[:-steps]
        passed_s = channel.time_s[steps:] - channel.time_s[:-steps]
        mean_speed = 0.5 * (channel.values[steps:] + channel.values[:-steps])
        good = (
            np.isfinite(moved_m)
            & np.isfinite(mean_speed)
            & (mean_speed > MOVING_M_S)
            & (passed_s > 0.0)
            & (moved_m > 0.5)
        )
        if good.sum() < _POSITION_SAMPLES:
            return None
        scale[channel.name] = float(np.median(mean_speed[good] * passed_s[good] / moved_m[good]))
    return scale


# --- stamps ---


def _stamps(run: Run) -> tuple[Run, list[Finding]]:
    """Find clock steps and gaps of the stamps, and corrects the steps."""
    found: list[Finding] = []
    for group in _clocks(run):
        corrected_s, more = _check_clock(run, group)
        found += more

        # where corrected stamps overlap, the first samples stay
        latest_before = np.concatenate([[-np.inf], np.maximum.accumulate(corrected_s)[:-1]])
        rises = corrected_s > latest_before
        corrected_channels = [
            channel._replace(time_s=corrected_s[rises], values=channel.values[rises])
            for channel in group
        ]
        run = _replaced(run, corrected_channels)
    return run, [f for f in found if f.name != "sensor_dropout" or f.size >= limit.GAP_S]


def _check_clock(run: Run, group: list[Channel]) -> tuple[np.ndarray, list[Finding]]:
    """Return the corrected stamps of a group of channels, and its clock steps and gaps.

    A step that is taken back later is one finding. A gap whose jump is taken back later was a step
    of the clock, too.
    """
    time_s = group[0].time_s
    names = tuple(channel.name for channel in group)
    steps_s = np.diff(time_s)
    step_s = float(np.median(steps_s))

    # half width of the interval of a jump: how irregular stamps usually are
    usual_s = np.abs(steps_s[np.abs(steps_s - step_s) < limit.LEAST_STEP_S] - step_s)
    half_s = float(np.quantile(usual_s, 0.975)) + 1e-3 if usual_s.size else step_s

    is_back = steps_s < 0.0
    is_jump = steps_s > step_s + max(limit.LEAST_STEP_S, 2.0 * step_s)
    found: list[Finding] = []
    shift_s = np.zeros(time_s.size)
    open_jump: int | None = None  # index in `found` of a forward jump that may be taken back
    for k in map(int, np.flatnonzero(is_back | is_jump)):
        size_s = float(steps_s[k] - step_s)
        backward = bool(steps_s[k] < step_s)

        if open_jump is not None and backward:
            before = found[open_jump]
            was_gap = before.name == "sensor_dropout"
            # without samples for one more step than the stamps jump
            jump_s = before.size - step_s if was_gap else before.size
            if abs(size_s + jump_s) < 3.0 * half_s:
                shift_s[k + 1 :] -= size_s
                if was_gap:
                    # it looked like a gap, and was not corrected
                    after_gap = int(np.searchsorted(time_s, before.start_s, "right"))
                    shift_s[after_gap:] += size_s
                found[open_jump] = before._replace(
                    name="clock_step",
                    end_s=float(time_s[k]),
                    size=jump_s,
                    low=jump_s - half_s,
                    high=jump_s + half_s,
                    details=_clock_details(jump_s, half_s, returns=True),
                )
                open_jump = None
                continue

        if backward or _motion_goes_on(group, k, size_s):
            found.append(
                Finding(
                    name="clock_step",
                    channels=names,
                    run=run.name,
                    start_s=float(time_s[k]),
                    end_s=float(time_s[-1]),
                    size=size_s,
                    low=size_s - half_s,
                    high=size_s + half_s,
                    unit="s",
                    details=_clock_details(size_s, half_s, returns=False),
                )
            )
            shift_s[k + 1 :] -= size_s
        else:
            found.append(
                Finding(
                    name="sensor_dropout",
                    channels=names,
                    run=run.name,
                    start_s=float(time_s[k]),
                    end_s=float(time_s[k + 1]),
                    size=size_s + step_s,
                    low=size_s,
                    high=size_s + 2.0 * step_s,
                    unit="s",
                    details=DropOut((findings.NO_SAMPLES,)),
                )
            )
        open_jump = None if backward else len(found) - 1
    return time_s + shift_s, found


def _clock_details(size_s: float, half_s: float, returns: bool) -> ClockStep:
    """Return the details of a step: its whole seconds where the size is whole within its error."""
    whole = round(size_s)
    is_whole = abs(size_s - whole) < half_s
    return ClockStep(whole_seconds=whole if is_whole else 0, returns=returns)


def _motion_goes_on(group: list[Channel], k: int, size_s: float) -> bool:
    """Whether speeds and position continue across a jump of the stamps as if no time had passed.

    The jump is between samples k and k + 1. The value of every channel must continue, and the slope
    of most: a vehicle that runs on through a gap returns to both by chance only. One channel at
    least must contradict a gap.
    """
    step_s = group[0].step_s
    samples = _SIDE_SAMPLES
    if size_s < LONG_JUMP_S:
        samples = min(samples, int(limit.CLOCK_SIDE_S / step_s))
    before = slice(max(k - samples + 1, 0), k + 1)
    after = slice(k + 1, k + 1 + samples)
    seen = []
    for channel in group:
        if channel.quantity not in (*_SPEEDS, "position"):
            continue
        sides = [_side(channel, part, shift) for part, shift in ((before, 0.0), (after, size_s))]
        if min(time_s.size for time_s, _ in sides) >= _LEAST_SIDE_SAMPLES:
            seen.append(_continuity(sides, channel, size_s))
    if not seen or not all(continuity.value_goes_on for continuity in seen):
        return False
    slopes_go_on = np.mean([continuity.slope_goes_on for continuity in seen]) > 0.5
    return bool(slopes_go_on and any(continuity.contradicts_gap for continuity in seen))


class _Continuity(NamedTuple):
    """Whether a channel continues across a jump of the stamps, and whether a gap would show."""

    value_goes_on: bool
    slope_goes_on: bool
    contradicts_gap: bool


def _side(channel: Channel, part: slice, shift_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps, s, and values of the samples of one side of a jump that have a value."""
    values = channel.values[part]
    good = np.isfinite(values)
    return channel.time_s[part][good] - shift_s, values[good]


def _continuity(
    sides: list[tuple[np.ndarray, np.ndarray]], channel: Channel, size_s: float
) -> _Continuity:
    """Return how a channel continues across a jump that is taken out of the stamps.

    A curve with one slope and one curvature on both sides, and a jump between them, is fitted. In a
    gap the value would have moved on by slope x size, and the slopes of both sides would differ.
    """
    t = np.concatenate([time_s for time_s, _ in sides])
    v = np.concatenate([values for _, values in sides])
    is_after = np.arange(t.size) >= sides[0][0].size
    from_middle = t - t.mean()
    base = np.column_stack([np.ones(t.size), from_middle, is_after, from_middle**2])
    fit, *_ = np.linalg.lstsq(base, v, rcond=None)
    _, slope, jump, _ = fit

    residual = v - base @ fit
    spread = np.sqrt(np.sum(residual**2) / max(t.size - 4, 1)) + channel.quantum / 3.0
    covariance = np.linalg.pinv(base.T @ base)
    jump_error = spread * np.sqrt(covariance[2, 2]) + 1e-9

    slopes = [float(np.polyfit(time_s - time_s.mean(), values, 1)[0]) for time_s, values in sides]
    slope_errors = [
        float((spread + 1e-9) / np.sqrt(np.sum((time_s - time_s.mean()) ** 2)))
        for time_s, _ in sides
    ]
    allowed_slope = limit.CLOCK_SLOPE_SHARE * abs(slope) + limit.CLOCK_RATIO * max(slope_errors)
    expected_jump = slope * size_s
    # through a long gap a vehicle does not keep its slope
    jump_of_short_gap = abs(slope) * min(size_s, _SHORT_GAP_S)
    allowed_jump = max(limit.CLOCK_RATIO * jump_error, limit.CLOCK_JUMP_SHARE * jump_of_short_gap)
    return _Continuity(
        value_goes_on=bool(abs(jump) < allowed_jump),
        slope_goes_on=bool(abs(slopes[1] - slopes[0]) < allowed_slope),
        contradicts_gap=bool(
            abs(expected_jump) > limit.CLOCK_RATIO * jump_error
            and abs(jump) < abs(jump - expected_jump) / 2.0
        ),
    )


def _old_messages(run: Run) -> tuple[Run, list[Finding]]:
    """Find samples at the start before a jump that no vehicle makes."""
    found = []
    for group in _clocks(run):
        speeds = [channel for channel in group if channel.quantity in _SPEEDS]
        if not speeds:
            continue
        first = speeds[0]
        step_s = float(np.median(np.diff(first.time_s)))
        last_jump = _last_jump_at_start(speeds, run.hardest_m_s2)
        if last_jump is None or last_jump * step_s <= 0.5:
            continue

        part = Stretch(0, last_jump)
        names = tuple(channel.name for channel in speeds)
        found.append(_lasting("old_messages", first, names, run, part, None))
        run = _replaced(run, [_without(channel, [part]) for channel in group])
    return run, found


def _last_jump_at_start(speeds: list[Channel], hardest_vehicle_m_s2: float) -> int | None:
    """Return the sample before the last jump that all speeds make at the start; None without."""
    time_s = speeds[0].time_s
    count = int(np.searchsorted(time_s, time_s[0] + limit.START_S))
    v = np.array([channel.values[: count + 1] for channel in speeds])
    jump = np.abs(np.diff(v))
    # a change from or to zero, or to no value, is a matter of the other checks
    between_speeds = np.isfinite(jump) & (np.minimum(v[:, :-1], v[:, 1:]) > 0.0)
    jump[~between_speeds] = 0.0

    # what speeds often do is no sign of old messages: pulses that are counted in short intervals
    usual_m_s = limit.JUMP_FACTOR * _usual_jump_m_s(speeds)
    # a single wheel may lock or recover between two samples
    hardest_m_s2 = hardest_vehicle_m_s2 * (limit.WHEEL_FACTOR if len(speeds) == 1 else 1.0)
    possible = hardest_m_s2 * np.diff(time_s[: count + 1])
    excess = jump.min(axis=0) - np.maximum(possible + limit.JUMP_M_S, usual_m_s)
    jumps = np.flatnonzero(excess > 0.0)
    return int(jumps[-1]) if jumps.size else None


def _usual_jump_m_s(speeds: list[Channel]) -> float:
    """Return the change between two samples that all speeds rarely exceed together, m/s.

    The first seconds are left out, because old messages are searched for there. The result is 0
    if few samples are left.
    """
    time_s = speeds[0].time_s
    later = time_s > time_s[0] + limit.START_S
    if np.count_nonzero(later) < _USUAL_SAMPLES:
        return 0.0
    changes = np.abs(np.diff([channel.values[later] for channel in speeds])).min(axis=0)
    known = changes[np.isfinite(changes)]
    return float(np.percentile(known, _USUAL_PERCENTILE)) if known.size else 0.0


# --- sensors ---


def _others(run: Run, channel: Channel) -> np.ndarray:
    """Return the median of the other speeds at the stamps of one channel; NaN without any."""
    others = [at(other, channel.time_s) for other in run.of(*_SPEEDS) if other.name != channel.name]
    if not others:
        return np.full(channel.time_s.size, np.nan)
    return median(np.array(others))


def _each_speed(
    check: Callable[[Run, Channel], Iterator[Hit]],
) -> Callable[[Run], tuple[Run, list[Finding]]]:
    """Make a check of a run from a check of one channel; it runs on one speed after another."""

    def checked(run: Run) -> tuple[Run, list[Finding]]:
        found = []
        for channel in run.of(*_SPEEDS):
            parts = []
            for hit in check(run, channel):
                part = Stretch(hit.first, hit.last)
                parts.append(part)
                found.append(_lasting(hit.name, channel, (channel.name,), run, part, hit.details))
            run = _replaced(run, [_without(channel, parts)])
        return run, found

    return checked


@_each_speed
def _lines(_: Run, channel: Channel) -> Iterator[Hit]:
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
    for stretch in stretches(np.concatenate([[False], is_straight, [False]])):
        # the neighbours on both sides are on the line, too
        first = stretch.first - 1
        last = stretch.last + 1
        long_enough = t[last] - t[first] >= limit.LINE_S and last - first >= 8
        if long_enough and _is_off_rounding(v[first : last + 1], channel.quantum):
            yield Hit("interpolated", int(good[first]), int(good[last]), None)


def _is_off_rounding(values: np.ndarray, quantum: float) -> bool:
    """Whether most values are between the rounding steps of the channel, or it has none."""
    if not quantum:
        return True
    steps = values / quantum
    return bool(np.mean(np.abs(steps - np.rint(steps)) > 1e-3) > 0.7)


@_each_speed
def _zeros(run: Run, channel: Channel) -> Iterator[Hit]:
    """Find zeros that come and go faster than a wheel can lock or take up speed.

    A speed from few pulses in each interval is zero where no pulse falls into one.
    """
    changes = np.abs(np.diff(channel.values))
    moves = changes[np.isfinite(changes) & (changes > 0.0)]
    usual_m_s = float(np.median(moves)) if moves.size > _USUAL_SAMPLES else 0.0
    others = _others(run, channel)
    for stretch in stretches(np.abs(channel.values) < _ZERO_M_S):
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
            yield Hit("sensor_dropout", stretch.first, stretch.last, DropOut((findings.ZEROS,)))


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


@_each_speed
def _missing(_: Run, channel: Channel) -> Iterator[Hit]:
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
            yield Hit("sensor_dropout", first, last, DropOut((findings.NO_VALUES,)))


@_each_speed
def _held(run: Run, channel: Channel) -> Iterator[Hit]:
    """Find a value that stays while the other channels move, or ends in an impossible jump.

    Of a slow sensor only the updates count. A value is not held across a gap.
    """
    good = np.flatnonzero(np.isfinite(channel.values))
    if good.size < 2:
        return
    known = channel._replace(time_s=channel.time_s[good], values=channel.values[good])
    v = known.values
    t = known.time_s
    others = _others(run, known)
    without_gap = np.diff(t) <= limit.gap_s(float(np.median(np.diff(t))))
    is_same = np.concatenate([(np.diff(v) == 0.0) & without_gap, [False]]) & (np.abs(v) > _ZERO_M_S)
    held = stretches(is_same)
    shortest_s = limit.stuck_s(float(np.median(np.diff(t))), run.logs_on_change)
    shortest_s = max(shortest_s, _HELD_FACTOR * _usually_held_s(known, others, held))
    # both the held value and the others are rounded
    other_quanta_m_s = [c.quantum for c in run.of(*_SPEEDS) if c.name != channel.name]
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
            yield Hit(
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
    errors_m_s = [other.error for other in run.of(*_SPEEDS) if other.name != channel.name]
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


# --- copies ---


class _Group(NamedTuple):
    """Speeds of one run that share their stamps; `rows` (n, channels)."""

    run: int
    names: tuple[str, ...]
    first: Channel
    rows: np.ndarray
    bits: float  # of information in one row: noise over the rounding step


class _Place(NamedTuple):
    """A window: the number of its group, and its first sample."""

    group: int
    first: int


def copies(runs: list[Run]) -> tuple[list[Run], list[Finding]]:
    """Return runs without copies, and the copies: equal stretches of all speeds of a clock.

    Copies are found within a run and between runs. The later one is taken out.
    """
    runs = list(runs)
    groups = _speed_groups(runs)
    found: list[Finding] = []
    # windows that were seen before, by the names of the channels and a hash of the samples
    seen: dict[tuple[tuple[str, ...], int], _Place] = {}
    for g, group in enumerate(groups):
        window_hash, changes = _windows(group.rows)
        pairs: list[tuple[int, _Place]] = []
        for k in map(int, np.flatnonzero(changes >= limit.COPY_CHANGES)):
            original = seen.setdefault((group.names, int(window_hash[k])), _Place(g, k))
            if original.group != g or k - original.first >= limit.COPY_SAMPLES:
                pairs.append((k, original))

        while pairs:
            k, original = pairs[0]
            windows = _windows_in_a_row(pairs)
            pairs = pairs[windows:]
            samples = windows + limit.COPY_SAMPLES - 1
            source = groups[original.group]
            # a hash is no proof
            is_copy = np.array_equal(
                group.rows[k : k + samples],
                source.rows[original.first : original.first + samples],
                equal_nan=True,
            )
            if not is_copy or samples * group.bits < limit.COPY_BITS:
                continue

            part = Stretch(k, k + samples - 1)
            run = runs[group.run]
            details = CopySource(
                run=runs[source.run].name, start_s=float(source.first.time_s[original.first])
            )
            found.append(_lasting("copy", group.first, group.names, run, part, details))
            runs[group.run] = _replaced(
                run, [_without(run.channels[name], [part]) for name in group.names]
            )
    return runs, found


def equal_channels(run: Run) -> tuple[Run, list[Finding]]:
    """Return a run without speeds that repeat another speed in every sample, and the findings.

    Two sensors do not agree in all of so many different values, even if these are rounded. The
    later channel is left out.
    """
    found = []
    kept: list[Channel] = []
    channels = dict(run.channels)
    for channel in run.of(*_SPEEDS):
        original = next((other for other in kept if _repeats(channel, other)), None)
        if original is None:
            kept.append(channel)
            continue
        part = Stretch(0, channel.time_s.size - 1)
        details = CopyOfChannel(original.name)
        found.append(_lasting("copy", channel, (channel.name,), run, part, details))
        del channels[channel.name]
    return run._replace(channels=channels), found


def _repeats(channel: Channel, other: Channel) -> bool:
    """Whether a channel has the values of another one in every sample, and enough of them."""
    if not np.array_equal(channel.time_s, other.time_s):
        return False
    if not np.array_equal(channel.values, other.values, equal_nan=True):
        return False
    known = channel.values[np.isfinite(channel.values)]
    changes = np.count_nonzero(np.diff(known))
    has_content = known.size * channel.bits >= limit.COPY_BITS
    # two sensors with noise of more than a rounding step hardly agree in a single sample
    is_fine = channel.noise > channel.quantum
    least = limit.EQUAL_CHANGES_FINE if is_fine else limit.EQUAL_CHANGES
    return bool(changes >= least and has_content)


def _speed_groups(runs: list[Run]) -> list[_Group]:
    groups = []
    for number_of_run, run in enumerate(runs):
        for clock in _clocks(run):
            speeds = [channel for channel in clock if channel.quantity in _SPEEDS]
            if speeds:
                names = tuple(channel.name for channel in speeds)
                rows = np.column_stack([channel.values for channel in speeds])
                bits = sum(channel.bits for channel in speeds)
                groups.append(_Group(number_of_run, names, speeds[0], rows, bits))
    return groups


def _windows_in_a_row(pairs: list[tuple[int, _Place]]) -> int:
    """Return how many pairs from the first on continue the same copy."""
    k, original = pairs[0]
    count = 1
    while count < len(pairs) and pairs[count] == (
        k + count,
        _Place(original.group, original.first + count),
    ):
        count += 1
    return count


def _windows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a hash of every window of samples, and how often its rows change."""
    count = max(len(rows) - limit.COPY_SAMPLES + 1, 0)
    plain = np.nan_to_num(rows, nan=-1.0)
    window_hash = np.array(
        [hash(plain[k : k + limit.COPY_SAMPLES].tobytes()) for k in range(count)], int
    )
    # samples that were taken out (NaN) do not count as a change
    row_changes = np.any(np.nan_to_num(np.diff(rows, axis=0)) != 0.0, axis=1)
    changes_until = np.concatenate([[0], np.cumsum(row_changes)])
    return window_hash, changes_until[limit.COPY_SAMPLES - 1 :] - changes_until[:count]
