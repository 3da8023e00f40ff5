"""Finds clock steps and gaps of the stamps, and corrects the steps."""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import findings, sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.findings import ClockStep, DropOut, Finding
from rollerrig.rig.identify.train_recorder.recording import Channel, Run

# s. A vehicle may keep its slope through a gap of this length.
_SHORT_GAP_S = 3.0

# samples on each side of a jump of the stamps: at most and at least
_SIDE_SAMPLES = 15
_LEAST_SIDE_SAMPLES = 8

# multiples of the error of a sample that a curve through both sides of a longer jump may leave.
# Beyond, the vehicle changes its motion too often to show that it goes on. Chosen.
_SMOOTH = 3.0

# s. After a gap of this length no vehicle has the same speed and slope as before.
LONG_JUMP_S = 60.0

# s. Longest interval of the samples with which a shorter step of the clock shows.
SLOWEST_CLOCK_S = limit.CLOCK_SIDE_S / _LEAST_SIDE_SAMPLES


def find(run: Run) -> tuple[Run, list[Finding]]:
    """Find clock steps and gaps of the stamps, and corrects the steps."""
    found: list[Finding] = []
    for group in sampling.of_clocks(run):
        corrected_s, more = _check_clock(run, group)
        found += more

        # where corrected stamps overlap, the first samples stay
        latest_before = np.concatenate([[-np.inf], np.maximum.accumulate(corrected_s)[:-1]])
        rises = corrected_s > latest_before
        corrected_channels = [
            channel._replace(time_s=corrected_s[rises], values=channel.values[rises])
            for channel in group
        ]
        run = sampling.replaced(run, corrected_channels)
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
    least must contradict a gap, and all channels a longer one: a small robot repeats its motion.
    """
    step_s = group[0].step_s
    samples = _SIDE_SAMPLES
    if size_s < LONG_JUMP_S:
        samples = min(samples, int(limit.CLOCK_SIDE_S / step_s))
    is_long = size_s > _SHORT_GAP_S
    if is_long:
        # what a vehicle does for a part of a second does not show where it is seconds later
        samples = max(samples, round(min(size_s, limit.CLOCK_SIDE_S) / step_s))
    before = slice(max(k - samples + 1, 0), k + 1)
    after = slice(k + 1, k + 1 + samples)
    seen = []
    for channel in group:
        if channel.quantity not in (*sampling.SPEEDS, "position"):
            continue
        sides = [_side(channel, part, shift) for part, shift in ((before, 0.0), (after, size_s))]
        if min(time_s.size for time_s, _ in sides) >= _LEAST_SIDE_SAMPLES:
            seen.append(_continuity(sides, channel, size_s))
    if not seen or not all(continuity.value_goes_on for continuity in seen):
        return False
    slopes_go_on = np.mean([continuity.slope_goes_on for continuity in seen]) > 0.5
    contradict = [continuity.contradicts_gap for continuity in seen]
    if is_long:
        smooth = all(continuity.is_smooth for continuity in seen)
        return bool(slopes_go_on and smooth and all(contradict))
    return bool(slopes_go_on and any(contradict))


class _Continuity(NamedTuple):
    """Whether a channel continues across a jump of the stamps, and whether a gap would show."""

    value_goes_on: bool
    slope_goes_on: bool
    contradicts_gap: bool
    is_smooth: bool  # one curve describes both sides


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
        is_smooth=bool(spread < _SMOOTH * channel.error + channel.quantum / 3.0),
    )
