"""What a recorder or a sensor did wrong, found in each channel and its stamps, and taken out before all else.

In this order: units, clock steps and gaps of the stamps, old messages at the start, copies, straight lines, zeros,
held values. Each check returns the run without what it found (NaN where values are no data, stamps put right) and
the findings.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.recording import Channel, Finding, Run

_RATIOS = (
    (3.6, "km/h given as m/s"),
    (1 / 3.6, "m/s given as km/h"),
    (2.23694, "mph given as m/s"),
    (0.44704, "m/s given as mph"),
    (1.609344, "km/h given as mph"),
    (1 / 1.609344, "mph given as km/h"),
)
_SPEEDS = ("speed", "reference")


class Stretch(NamedTuple):
    """Samples first to last of a channel, both within."""

    first: int
    last: int


def find(run: Run) -> tuple[Run, list[Finding]]:
    """All faults of one run by itself; copies are found between runs (`copies`)."""
    found: list[Finding] = []
    for check in (_units, _stamps, _missing, _old_messages, _lines, _zeros, _held):
        run, more = check(run)
        found += more
    return run, _joined(found)


def _joined(found: list[Finding]) -> list[Finding]:
    """Drop-outs of one channel that follow one another, as zeros before a gap, are one."""
    out: list[Finding] = []
    for f in sorted(found, key=lambda f: (f.name, f.channels, f.start_s)):
        last = out[-1] if out else None
        if (
            last
            and f.name == "sensor_dropout"
            and (last.name, last.channels) == (f.name, f.channels)
            and (f.start_s - last.end_s < 0.5)
        ):
            size, half = f.end_s - last.start_s, max(f.high - f.size, last.high - last.size)
            text = last.text if f.text in last.text else f"{last.text}, then {f.text}"
            out[-1] = last._replace(
                end_s=f.end_s, size=size, low=size - half, high=size + half, text=text
            )
        else:
            out.append(f)
    return out


def stretches(flag: np.ndarray) -> list[Stretch]:
    """Where a flag (n,) is set, stretch by stretch."""
    edge = np.flatnonzero(np.diff(np.concatenate([[False], flag, [False]]).astype(np.int8)))
    return [Stretch(int(a), int(b) - 1) for a, b in zip(edge[::2], edge[1::2], strict=True)]


def at(channel: Channel, time_s: np.ndarray) -> np.ndarray:
    """A channel at other stamps of any shape, to be compared with others; NaN across gaps."""
    good = np.isfinite(channel.values)
    t, v = channel.time_s[good], channel.values[good]
    if t.size < 2:
        return np.full(time_s.shape, np.nan)
    after = np.clip(np.searchsorted(t, time_s), 1, t.size - 1)
    near = (t[after] - t[after - 1] <= 2.5 * channel.step_s) & (time_s >= t[0]) & (time_s <= t[-1])
    return np.where(near, np.interp(time_s, t, v), np.nan)


def _with(run: Run, *channels: Channel) -> Run:
    return run._replace(
        channels={**run.channels, **{channel.name: channel for channel in channels}}
    )


def _without(channel: Channel, parts: list[Stretch]) -> Channel:
    values = channel.values.copy()
    for part in parts:
        values[part.first : part.last + 1] = np.nan
    return channel._replace(values=values)


def _duration(name: str, channel: Channel, run: Run, part: Stretch, text: str) -> Finding:
    """A finding that lasts; its end is known to a sample."""
    start, end, step = (
        float(channel.time_s[part.first]),
        float(channel.time_s[part.last]),
        channel.step_s,
    )
    size = end - start + step
    return Finding(
        name,
        (channel.name,),
        run.name,
        start,
        end,
        size,
        max(size - step, 0.0),
        size + step,
        "s",
        text,
    )


def _clocks(run: Run) -> list[list[Channel]]:
    """Channels that share their stamps."""
    groups: dict[bytes, list[Channel]] = {}
    for channel in run.channels.values():
        groups.setdefault(channel.time_s.tobytes(), []).append(channel)
    return list(groups.values())


# --- units ---


def _units(run: Run) -> tuple[Run, list[Finding]]:
    """Declared units against position, else against most channels, else against what a vehicle can do."""
    speeds = run.of(*_SPEEDS)
    fast = {c.name: speed for c in speeds if (speed := float(np.nanpercentile(c.values, 75))) > 0.5}
    if not fast:
        return run, []
    base = max(
        sorted(fast.values()),
        key=lambda one: sum(abs(other / one - 1.0) < 0.1 for other in fast.values()),
    )
    scale, why = _by_position(run, speeds), "from the position"
    if scale is None:
        scale, why = {name: speed / base for name, speed in fast.items()}, "from the other channels"
        hardest = min(
            _hardest(c) for c in speeds if c.name in fast and abs(scale[c.name] - 1.0) < 0.1
        )
        if hardest > limit.HARDEST_M_S2 + 0.3:
            scale = {name: 3.6 * one for name, one in scale.items()}
            why = f"from its changes of {hardest:.2g} m/s², more than a vehicle brakes"
    found = []
    for channel in speeds:
        for ratio, text in _RATIOS:
            if abs(scale.get(channel.name, 1.0) / ratio - 1.0) < limit.UNIT_SHARE:
                got = scale[channel.name]
                found.append(
                    Finding(
                        "wrong_unit",
                        (channel.name,),
                        run.name,
                        0.0,
                        float(channel.time_s[-1]),
                        got,
                        got * (1 - limit.UNIT_SHARE),
                        got * (1 + limit.UNIT_SHARE),
                        "times",
                        f"{channel.name} is {text}, {why}; taken as that below",
                    )
                )
                run = _with(
                    run,
                    channel._replace(
                        values=channel.values / ratio, quantum=channel.quantum / ratio
                    ),
                )
    return run, found


def _by_position(run: Run, speeds: list[Channel]) -> dict[str, float] | None:
    """Distance by each speed over that by position; the most usual of samples close together."""
    if not (place := run.of("position")):
        return None
    scale = {}
    for channel in speeds:
        way = at(place[0], channel.time_s)
        steps = max(round(2.0 / channel.step_s), 1)
        moved, time_s = way[steps:] - way[:-steps], channel.time_s[steps:] - channel.time_s[:-steps]
        mean = 0.5 * (channel.values[steps:] + channel.values[:-steps])
        good = (
            np.isfinite(moved) & np.isfinite(mean) & (mean > 0.5) & (time_s > 0.0) & (moved > 0.5)
        )
        if good.sum() < 20:
            return None
        scale[channel.name] = float(np.median(mean[good] * time_s[good] / moved[good]))
    return scale


def _hardest(channel: Channel) -> float:
    """Change of speed over 6 s, longer than most slides, that is exceeded in 2 % of the time, m/s²."""
    steps = max(round(6.0 / channel.step_s), 1)
    change = np.abs(channel.values[steps:] - channel.values[:-steps])
    time_s = channel.time_s[steps:] - channel.time_s[:-steps]
    good = np.isfinite(change) & (np.abs(time_s - 6.0) < 0.5)
    return float(np.percentile(change[good] / time_s[good], 98)) if good.any() else 0.0


# --- stamps ---


def _stamps(run: Run) -> tuple[Run, list[Finding]]:
    found = []
    for group in _clocks(run):
        time_s, step = group[0].time_s, float(np.median(np.diff(group[0].time_s)))
        steps = np.diff(time_s)
        usual = np.abs(steps[np.abs(steps - step) < limit.LEAST_STEP_S] - step)
        half = float(np.quantile(usual, 0.975)) + 1e-3 if usual.size else step
        names = tuple(channel.name for channel in group)
        moved, open_at = np.zeros(time_s.size), None
        for k in map(
            int,
            np.flatnonzero((steps < 0.0) | (steps > step + max(limit.LEAST_STEP_S, 2.0 * step))),
        ):
            size, back = float(steps[k] - step), bool(steps[k] < step)
            # a step there and back again is one finding
            if open_at is not None and back and abs(size + found[open_at].size) < 3.0 * half:
                one = found[open_at]
                moved[k + 1 :] -= size
                if one.unit == "gap":
                    moved[int(np.searchsorted(time_s, one.start_s, "right")) :] += size
                found[open_at] = one._replace(
                    end_s=float(time_s[k]),
                    name="clock_step",
                    unit="s",
                    text=_of_clock(one.size, half, True),
                )
                open_at = None
                continue
            if back or _runs_on(group, k, size, step):
                found.append(
                    Finding(
                        "clock_step",
                        names,
                        run.name,
                        float(time_s[k]),
                        float(time_s[-1]),
                        size,
                        size - half,
                        size + half,
                        "s",
                        _of_clock(size, half, False),
                    )
                )
                moved[k + 1 :] -= size
            elif size >= limit.LEAST_STEP_S:
                found.append(
                    Finding(
                        "sensor_dropout",
                        names,
                        run.name,
                        float(time_s[k]),
                        float(time_s[k + 1]),
                        size + step,
                        size,
                        size + 2.0 * step,
                        "gap",
                        "no samples",
                    )
                )
            open_at = None if back else len(found) - 1
        right = time_s + moved
        rises = right > np.concatenate([[-np.inf], np.maximum.accumulate(right)[:-1]])
        run = _with(
            run,
            *(
                channel._replace(time_s=right[rises], values=channel.values[rises])
                for channel in group
            ),
        )
    return run, [
        f._replace(unit="s") for f in found if f.name != "sensor_dropout" or f.size >= limit.GAP_S
    ]


def _of_clock(size: float, half: float, back: bool) -> str:
    whole = (
        f", {round(size):+d} s exactly" if abs(size - round(size)) < half and round(size) else ""
    )
    return f"the stamps jump by {size:+.3f} s while the motion runs on{whole}" + (
        "; they come back at the end" if back else ""
    )


def _runs_on(group: list[Channel], k: int, size: float, step: float) -> bool:
    """Whether speeds or position go on across a jump of the stamps as if no time had passed."""
    for channel in group:
        before, after = slice(max(k - 14, 0), k + 1), slice(k + 1, k + 16)
        if channel.quantity == "demand" or not (
            np.isfinite(channel.values[before]).sum() >= 8
            and np.isfinite(channel.values[after]).sum() >= 8
        ):
            continue
        # a line with the same slope on both sides and a jump between: what is the jump worth in seconds?
        t = np.concatenate([channel.time_s[before], channel.time_s[after] - size])
        v = np.concatenate([channel.values[before], channel.values[after]])
        late = np.arange(t.size) >= channel.time_s[before].size
        good = np.isfinite(v)
        base = np.column_stack([np.ones(t.size), t - t.mean(), late, (t - t.mean()) ** 2])[good]
        fit, *_ = np.linalg.lstsq(base, v[good], rcond=None)
        spread = (
            np.sqrt(np.sum((v[good] - base @ fit) ** 2) / max(good.sum() - 4, 1))
            + channel.quantum / 3.0
        )
        cov = np.linalg.pinv(base.T @ base)
        jump, error = fit[2], spread * np.sqrt(cov[2, 2]) + 1e-9
        expected = fit[1] * size
        if abs(expected) > limit.CLOCK_RATIO * error and abs(jump) < abs(jump - expected) / 2.0:
            return True
    return False


def _old_messages(run: Run) -> tuple[Run, list[Finding]]:
    """What stands before a jump at the start that no vehicle makes."""
    found = []
    for group in _clocks(run):
        speeds = [channel for channel in group if channel.quantity in _SPEEDS]
        if not speeds:
            continue
        time_s, step = speeds[0].time_s, float(np.median(np.diff(speeds[0].time_s)))
        n = int(np.searchsorted(time_s, time_s[0] + limit.START_S))
        v = np.array([channel.values[: n + 1] for channel in speeds])
        jump = np.abs(np.diff(v))
        jump[~(np.isfinite(jump) & (np.minimum(v[:, :-1], v[:, 1:]) > 0.0))] = 0.0
        beyond = jump.min(axis=0) - limit.HARDEST_M_S2 * np.diff(time_s[: n + 1]) - limit.JUMP_M_S
        if (jumps := np.flatnonzero(beyond > 0.0)).size and (k := int(jumps[-1])) * step > 0.5:
            part = Stretch(0, k)
            text = "what the channels tell there does not go over into what follows: old messages"
            found.append(
                _duration("old_messages", speeds[0], run, part, text)._replace(
                    channels=tuple(channel.name for channel in speeds)
                )
            )
            run = _with(run, *(_without(channel, [part]) for channel in group))
    return run, found


# --- sensors ---


def _others(run: Run, channel: Channel) -> np.ndarray:
    """Median of the other speeds at the stamps of one channel, NaN where there is none."""
    others = [at(other, channel.time_s) for other in run.of(*_SPEEDS) if other.name != channel.name]
    return median(np.array(others)) if others else np.full(channel.time_s.size, np.nan)


def median(values: np.ndarray) -> np.ndarray:
    """Median over the first axis without NaN; NaN where there is no value."""
    found = np.full(values.shape[1], np.nan)
    any_ = np.isfinite(values).any(axis=0)
    found[any_] = np.nanmedian(values[:, any_], axis=0)
    return found


Told = Iterator[tuple[str, int, int, str]]  # what it is called, its first and last sample, a text


def _each(check: Callable[[Run, Channel], Told]) -> Callable[[Run], tuple[Run, list[Finding]]]:
    """A check of one speed on each of them, one after another: the run without what it finds, and the findings."""

    def checked(run: Run) -> tuple[Run, list[Finding]]:
        found = []
        for channel in run.of(*_SPEEDS):
            told = [
                (name, Stretch(first, last), text)
                for name, first, last, text in check(run, channel)
            ]
            found += [_duration(name, channel, run, part, text) for name, part, text in told]
            run = _with(run, _without(channel, [part for _, part, _ in told]))
        return run, found

    return checked


@_each
def _lines(_: Run, channel: Channel) -> Told:
    """Straight lines over seconds, which stand where a gap was: no data."""
    good = np.flatnonzero(np.isfinite(channel.values))
    v, t = channel.values[good], channel.time_s[good]
    slope = np.diff(v) / np.maximum(np.diff(t), 1e-6)
    # drawn over the stamps, or over the count of samples
    bend = np.minimum(np.abs(np.diff(slope)) * channel.step_s, np.abs(np.diff(v, 2)))
    rough = max(
        float(np.median(bend[bend > 0.0])) if (bend > 0.0).any() else 0.0, 0.5 * channel.quantum
    )
    straight = np.concatenate(
        [[False], (bend < limit.LINE_SHARE * rough) & (np.abs(slope[1:]) > 1e-3), [False]]
    )
    for a, b in (
        (first - 1, last + 1) for first, last in stretches(straight)
    ):  # both ends are on the line
        steps = v[a : b + 1] / (channel.quantum or np.inf)
        off = not channel.quantum or np.mean(np.abs(steps - np.rint(steps)) > 1e-3) > 0.7
        if t[b] - t[a] >= limit.LINE_S and b - a >= 8 and off:
            yield (
                "interpolated",
                int(good[a]),
                int(good[b]),
                "a straight line drawn across a gap; refused as data",
            )


@_each
def _zeros(_: Run, channel: Channel) -> Told:
    """Zeros that come and go faster than a wheel can lock or take up speed."""
    v = channel.values
    for first, last in stretches(np.abs(v) < 1e-9):
        # an edge at a gap or at an end tells nothing
        edges = [
            abs(float(v[k]))
            for k, near in ((first - 1, first), (last + 1, last))
            if 0 <= k < v.size
            and abs(channel.time_s[k] - channel.time_s[near]) < 2.5 * channel.step_s
            and np.isfinite(v[k])
        ]
        if edges and min(edges) > limit.ZERO_JUMP_M_S:
            yield "sensor_dropout", first, last, "zeros"


@_each
def _missing(_: Run, channel: Channel) -> Told:
    """Cells without a value, of one channel while the others go on."""
    good = np.flatnonzero(np.isfinite(channel.values))
    for k in np.flatnonzero(np.diff(channel.time_s[good]) > max(limit.GAP_S, 3.0 * channel.step_s)):
        first, last = int(good[k]) + 1, int(good[k + 1]) - 1
        if last - first >= 1 and first > 0:
            yield "sensor_dropout", first, last, "no values"


@_each
def _held(run: Run, channel: Channel) -> Told:
    """A value that stays while the other channels move on, or from which it jumps as no vehicle does."""
    v, t, others = channel.values, channel.time_s, _others(run, channel)
    same = np.concatenate([np.diff(v) == 0.0, [False]]) & (np.abs(v) > 1e-9)
    for a, last in ((first, end + 1) for first, end in stretches(same)):
        if t[last] - t[a] < limit.STUCK_S:
            continue
        moves = others[a : last + 1][np.isfinite(others[a : last + 1])]
        jump = abs(v[last + 1] - v[last]) if last + 1 < v.size else 0.0
        frozen = (
            moves.size < 2 or not np.ptp(moves)
        ) and jump > limit.JUMP_M_S + limit.HARDEST_M_S2 * channel.step_s
        if frozen or (moves.size > 1 and np.ptp(moves) > limit.MOVED_M_S):
            yield "sensor_stuck", a, last, f"held at {v[a]:.2f} m/s"


# --- copies ---


def copies(runs: list[Run]) -> tuple[list[Run], list[Finding]]:
    """Byte-equal stretches of all speeds of a clock, within a run or between two; the later one is taken out."""
    found: list[Finding] = []
    groups = [
        (r, group)
        for r, run in enumerate(runs)
        for group in ([c for c in clock if c.quantity in _SPEEDS] for clock in _clocks(run))
        if group
    ]
    seen: dict[tuple[tuple[str, ...], int], tuple[int, int]] = {}
    for g, (r, group) in enumerate(groups):
        names = tuple(c.name for c in group)
        rows = np.column_stack([c.values for c in group])
        windows, changes = _windows(rows)
        pairs = [
            (k, seen.setdefault((names, int(windows[k])), (g, k)))
            for k in map(int, np.flatnonzero(changes >= limit.COPY_CHANGES))
        ]
        pairs = [
            (k, first) for k, first in pairs if first[0] != g or k - first[1] >= limit.COPY_SAMPLES
        ]
        while pairs:
            (k, (g0, k0)), n = pairs[0], 1
            while n < len(pairs) and pairs[n] == (k + n, (g0, k0 + n)):
                n += 1
            pairs = pairs[n:]
            part, other = Stretch(k, k + n + limit.COPY_SAMPLES - 2), groups[g0]
            if not np.array_equal(
                rows[k : part.last + 1],
                np.column_stack([c.values for c in other[1]])[k0 : k0 + n + limit.COPY_SAMPLES - 1],
                equal_nan=True,
            ):
                continue
            text = (
                f"the same samples as {runs[other[0]].name} from {other[1][0].time_s[k0]:.1f} s on: a copy tells "
                "nothing new"
            )
            found.append(_duration("copy", group[0], runs[r], part, text)._replace(channels=names))
            runs[r] = _with(runs[r], *(_without(runs[r].channels[name], [part]) for name in names))
    return runs, found


def _windows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of every window of samples: a number that equal windows share, and how often its rows change."""
    n = max(len(rows) - limit.COPY_SAMPLES + 1, 0)
    told = np.nan_to_num(rows, nan=-1.0)
    window = np.array([hash(told[k : k + limit.COPY_SAMPLES].tobytes()) for k in range(n)], int)
    # what was taken out does not change
    changed = np.concatenate(
        [[0], np.cumsum(np.any(np.nan_to_num(np.diff(rows, axis=0)) != 0.0, axis=1))]
    )
    return window, changed[limit.COPY_SAMPLES - 1 :] - changed[:n]
