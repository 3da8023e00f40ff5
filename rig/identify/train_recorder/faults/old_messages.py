"""Finds values at the start that do not continue into the following samples."""

import numpy as np

from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.findings import Finding
from rollerrig.rig.identify.train_recorder.recording import Channel, Run
from rollerrig.rig.identify.train_recorder.sampling import Stretch

# samples and percentile of their changes that show how much a speed usually changes in a sample
_USUAL_SAMPLES = 50
_USUAL_PERCENTILE = 99.0


def find(run: Run) -> tuple[Run, list[Finding]]:
    """Find samples at the start before a jump that no vehicle makes."""
    found = []
    for group in sampling.of_clocks(run):
        speeds = [channel for channel in group if channel.quantity in sampling.SPEEDS]
        if not speeds:
            continue
        first = speeds[0]
        step_s = float(np.median(np.diff(first.time_s)))
        last_jump = _last_jump_at_start(speeds, run.hardest_m_s2)
        if last_jump is None or last_jump * step_s <= 0.5:
            continue

        part = Stretch(0, last_jump)
        names = tuple(channel.name for channel in speeds)
        found.append(sampling.lasting("old_messages", first, names, run, part, None))
        run = sampling.replaced(run, [sampling.without(channel, [part]) for channel in group])
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
