"""Finds what a recorder or a sensor did wrong, and takes it out before all other steps.

The checks run in this order: units, logging on change, clock steps and gaps of the stamps, missing
values, old messages at the start, straight lines, zeros, held values; then copies between runs.
Each check returns the run without what it found, and its findings. Values that are no data become
NaN. Wrong stamps are corrected.
"""

import numpy as np

from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.faults import (
    copies,
    held,
    missing,
    old_messages,
    on_change,
    stamps,
    units,
)
from rollerrig.rig.identify.train_recorder.findings import DropOut, Finding
from rollerrig.rig.identify.train_recorder.recording import Run

# s. Change of speed is measured over these windows, and this percentile of it counts.
_HARDEST_WINDOW_S = 1.0
_HARDEST_PERCENTILE = 99.8


def without_faults(run: Run) -> tuple[Run, list[Finding]]:
    """Return a run without its faults, and the faults. `copies` finds those between runs."""
    run, found = copies.without_equal_channels(run)
    run, more = units.find(run)
    found += more

    logged = on_change.resampled(run)
    if logged is not None:
        # samples between changes are missing by design: no gap and no line is a fault
        logged = logged._replace(hardest_m_s2=hardest_m_s2(logged))
        logged, more = held.find(logged)
        return logged, found + more

    run, more = stamps.find(run)
    found += more
    run, _ = on_change.updates(run)
    run = run._replace(hardest_m_s2=hardest_m_s2(run))
    for check in (missing.empty_cells, old_messages.find, missing.lines, missing.zeros, held.find):
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
    speeds = run.of(*sampling.SPEEDS)
    if len(speeds) < 2:
        return limit.HARDEST_M_S2

    window_s = _HARDEST_WINDOW_S
    time_s = speeds[0].time_s
    half_steps = max(round(0.5 * window_s / speeds[0].step_s), 1)
    if time_s.size <= 2 * half_steps:
        return limit.HARDEST_M_S2
    passed_s = time_s[2 * half_steps :] - time_s[: -2 * half_steps]
    values = np.array([sampling.at(channel, time_s) for channel in speeds])
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
