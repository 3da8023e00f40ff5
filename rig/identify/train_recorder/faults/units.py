"""Finds declared units that are wrong, and converts the values."""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import findings, sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.findings import Finding, WrongUnit
from rollerrig.rig.identify.train_recorder.recording import Channel, Run

# m/s. A channel whose upper quartile is below it shows no unit.
MOVING_M_S = 0.5

# samples in motion with a position. Fewer do not show a unit.
_POSITION_SAMPLES = 20

# ratio of speeds that no wheel reaches for long by slip: of m/s and km/h or mph. Chosen.
_NO_SLIP_RATIO = 2.0

# share by which speeds of one unit may differ
_SAME_UNIT_SHARE = 0.1


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


def find(run: Run) -> tuple[Run, list[Finding]]:
    """Check declared units by the position, else by the majority of the channels.

    Without a position, channels that agree with one another have no wrong unit. One speed alone
    shows nothing about its unit. The ratio must hold for nearly all samples: that of a wheel that
    slips varies.
    """
    speeds = run.of(*sampling.SPEEDS)
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
        run = sampling.replaced(run, [corrected])
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
        base_values = sampling.at(base, channel.time_s)
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
        position = sampling.at(positions[0], channel.time_s)
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
