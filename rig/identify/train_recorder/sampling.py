"""Samples of channels: stretches, values at other stamps, changed runs."""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder.findings import Details, Finding
from rollerrig.rig.identify.train_recorder.recording import Channel, Run

SPEEDS = ("speed", "reference")

# m/s. A value closer to zero is a zero.
ZERO_M_S = 1e-9


class Stretch(NamedTuple):
    """Samples first to last of a channel, both included."""

    first: int
    last: int


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
    if np.isfinite(values).all():
        return np.asarray(np.median(values, axis=0))
    middle = np.full(values.shape[1], np.nan)
    known = np.isfinite(values).any(axis=0)
    middle[known] = np.nanmedian(values[:, known], axis=0)
    return middle


def replaced(run: Run, channels: list[Channel]) -> Run:
    """Return a run with these channels in place of those of the same names."""
    return run._replace(
        channels={**run.channels, **{channel.name: channel for channel in channels}}
    )


def without(channel: Channel, parts: list[Stretch]) -> Channel:
    """Return a channel with NaN in these stretches."""
    values = channel.values.copy()
    for part in parts:
        values[part.first : part.last + 1] = np.nan
    return channel._replace(values=values)


def lasting(
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


def of_clocks(run: Run) -> list[list[Channel]]:
    """Return the channels in groups that share their stamps."""
    groups: dict[bytes, list[Channel]] = {}
    for channel in run.channels.values():
        groups.setdefault(channel.time_s.tobytes(), []).append(channel)
    return list(groups.values())
