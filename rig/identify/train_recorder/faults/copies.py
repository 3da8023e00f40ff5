"""Finds copies: equal stretches within and between runs, and channels that repeat another one."""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.findings import CopyOfChannel, CopySource, Finding
from rollerrig.rig.identify.train_recorder.recording import Channel, Run
from rollerrig.rig.identify.train_recorder.sampling import Stretch


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


def between_runs(runs: list[Run]) -> tuple[list[Run], list[Finding]]:
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
            found.append(sampling.lasting("copy", group.first, group.names, run, part, details))
            runs[group.run] = sampling.replaced(
                run, [sampling.without(run.channels[name], [part]) for name in group.names]
            )
    return runs, found


def without_equal_channels(run: Run) -> tuple[Run, list[Finding]]:
    """Return a run without speeds that repeat another speed in every sample, and the findings.

    Two sensors do not agree in all of so many different values, even if these are rounded. The
    later channel is left out.
    """
    found = []
    kept: list[Channel] = []
    channels = dict(run.channels)
    for channel in run.of(*sampling.SPEEDS):
        original = next((other for other in kept if _repeats(channel, other)), None)
        if original is None:
            kept.append(channel)
            continue
        part = Stretch(0, channel.time_s.size - 1)
        details = CopyOfChannel(original.name)
        found.append(sampling.lasting("copy", channel, (channel.name,), run, part, details))
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
        for clock in sampling.of_clocks(run):
            speeds = [channel for channel in clock if channel.quantity in sampling.SPEEDS]
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
