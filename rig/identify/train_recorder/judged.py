"""Says for each kind of finding whether this recording could show it, and from which size on.

A finding that is absent means something only with the smallest size that would have been seen. The
sizes come from the same limits that decide about findings: sample rate, rounding, noise, and the
errors of the fits.
"""

import itertools
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import clock_rate, scales
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.alignment import Aligned, quiet, slope
from rollerrig.rig.identify.train_recorder.faults import held, stamps, units
from rollerrig.rig.identify.train_recorder.findings import Finding, OffsetOrDelay
from rollerrig.rig.identify.train_recorder.recording import Run
from rollerrig.rig.identify.train_recorder.rolling import Rolling
from rollerrig.rig.identify.train_recorder.scales import ChannelFit
from rollerrig.rig.identify.train_recorder.sliding import driving, planted, slides

# checks of the motion. The others are checks of the file.
OF_MOTION = (
    "speed_sensor_delay",
    "wheel_radius",
    "speed_scale",
    "speed_offset",
    "slide",
    "driving_slip",
)

# m/s^2. A vehicle that loses more speed is braked.
_BRAKED_M_S2 = -0.1

# s. Braking or driving for less is not judged.
_LEAST_S = 2.0

# the two nearest units of speed, mph and km/h
_NEAREST_UNITS = 1.609344

# the smallest rate of a clock that is tried
_NEAREST_RATE = min(rate for rate in clock_rate.RATES if rate > 1.0)

# reasons why a kind of finding is not judged
ONE_SPEED = "one_speed"
ONE_SPEED_NO_POSITION = "one_speed_no_position"
NO_REFERENCE = "no_reference"
FEW_SPEEDS = "few_speeds"
SHORT = "short"
ON_CHANGE = "on_change"
FEW_CHANGES = "few_changes"
FEW_BLOCKS = "few_blocks"
UNSTEADY = "unsteady"
NO_RANGE = "no_range"
FEW_VISITS = "few_visits"
OFFSET_OR_DELAY = "offset_or_delay"
ONE_DATE = "one_date"
NOT_BRAKED = "not_braked"
NO_HARDEST = "no_hardest"
TURNS = "turns"
NOT_DRIVEN = "not_driven"
NO_POSITION = "no_position"
FEW_RUNS = "few_runs"
NO_SPEED = "no_speed"
SLOW = "slow"
NO_PLANTED = "no_planted"
SLOW_FOR_UNIT = "slow_for_unit"


class Check(NamedTuple):
    """Whether one kind of finding was judged, and the smallest size that would have been seen.

    `values` are the numbers and names of the reason. `channels` could not be judged although others
    were.
    """

    name: str
    judged: bool
    smallest: float  # NaN if it was not judged
    unit: str
    reason: str = ""  # one of the reasons above, if it or some channels were not judged
    values: tuple[float, ...] = ()
    channels: tuple[str, ...] = ()


def _not_judged(
    name: str, reason: str, values: tuple[float, ...] = (), channels: tuple[str, ...] = ()
) -> Check:
    return Check(name, False, np.nan, "", reason, values, channels)


def checks(runs: list[Run], fit: Rolling, sliding: list[np.ndarray]) -> list[Check]:
    """Return the checks of a recording: runs without faults, and the fit of their channels.

    `sliding` are the flags (n, m) of wheels that slide, by run.
    """
    fastest_m_s = max(run.fastest_m_s for run in runs)
    found = [
        *_file_checks(runs),
        _delay_check(fit),
        *_scale_checks(fit),
        _slide_check(fit.aligned, sliding),
        _driving_check(fit.aligned),
        _place_check(runs),
    ]
    return [_unless_too_slow(check, fastest_m_s) for check in found]


def _unless_too_slow(check: Check, fastest_m_s: float) -> Check:
    """Return a check, as not judged if its smallest size is above all speeds of the recording."""
    if check.unit == "m/s" and check.smallest > fastest_m_s:
        return _not_judged(check.name, SLOW, (check.smallest, fastest_m_s))
    return check


# --- the file ---


def _file_checks(runs: list[Run]) -> list[Check]:
    """Return the checks of units, stamps and sensors; the run that shows least counts."""
    speeds = [channel for run in runs for channel in run.of("speed", "reference")]
    step_s = max(channel.step_s for channel in speeds)
    # a slow sensor has the stamps of the others
    stamps_s = min(channel.step_s for channel in speeds)
    hardest_m_s2 = max(run.hardest_m_s2 for run in runs)
    on_change = any(run.logs_on_change for run in runs)
    several = all(len(run.of("speed", "reference")) > 1 for run in runs)
    has_position = all(run.of("position") for run in runs)

    unit = _not_judged("wrong_unit", ONE_SPEED_NO_POSITION)
    fastest_m_s = max(run.fastest_m_s for run in runs)
    if several or has_position:
        unit = Check("wrong_unit", True, _NEAREST_UNITS, "times")
        usual_m_s = max(units.usual_speed_m_s(channel) for channel in speeds)
        if usual_m_s <= units.MOVING_M_S:
            unit = _not_judged("wrong_unit", SLOW_FOR_UNIT, (units.MOVING_M_S, usual_m_s))

    bits = [sum(c.bits for c in run.of("speed", "reference")) for run in runs]
    copied_samples = max(limit.COPY_SAMPLES, limit.COPY_BITS / max(min(bits), 1e-3))
    found = [
        unit,
        Check(
            "clock_step",
            True,
            stamps_s + max(limit.LEAST_STEP_S, 2.0 * stamps_s),
            "s",
        ),
        _rate_check(runs),
        Check("old_messages", True, limit.jump_m_s(hardest_m_s2, step_s), "m/s"),
        Check("copy", True, copied_samples * step_s, "s"),
    ]
    by_name = {
        "interpolated": max(limit.LINE_S, 8.0 * step_s),
        "sensor_dropout": limit.gap_s(step_s),
    }
    for name, smallest_s in by_name.items():
        if on_change:
            found.append(_not_judged(name, ON_CHANGE))
        else:
            found.append(Check(name, True, smallest_s, "s"))
    found.append(_stuck_check(runs, several, fastest_m_s, step_s))
    if on_change:
        found[1] = _not_judged("clock_step", ON_CHANGE)
    elif stamps_s > stamps.SLOWEST_CLOCK_S:
        # a shorter jump of the stamps looks like a gap
        found[1] = Check("clock_step", True, stamps.LONG_JUMP_S, "s")
    return found


def _stuck_check(runs: list[Run], several: bool, fastest_m_s: float, step_s: float) -> Check:
    """Return the check of held values; `several`: each run has several speeds."""
    if not several:
        return _not_judged("sensor_stuck", ONE_SPEED)
    moves_m_s = [
        held.least_move_of_others(run, channel)
        for run in runs
        for channel in run.of("speed", "reference")
    ]
    if max(moves_m_s) > fastest_m_s:
        return _not_judged("sensor_stuck", SLOW, (max(moves_m_s), fastest_m_s))
    on_change = any(run.logs_on_change for run in runs)
    shortest_s = limit.stuck_s(step_s, on_change)
    return Check("sensor_stuck", True, shortest_s, "s", "", (max(moves_m_s),))


def _rate_check(runs: list[Run]) -> Check:
    with_reference = [run for run in runs if run.of("reference") and run.of("speed")]
    if not with_reference:
        return _not_judged("clock_rate", NO_REFERENCE)
    drifts = [clock_rate.smallest_drift(run) for run in with_reference]
    known = [drift for drift in drifts if drift is not None]
    if len(known) == len(drifts):
        return Check("clock_rate", True, 1.0 + max(known), "times")
    if all(clock_rate.errors_by_rate(run) is None for run in with_reference):
        return _not_judged("clock_rate", FEW_CHANGES)
    return Check("clock_rate", True, _NEAREST_RATE, "times")


# --- rolling wheels ---


def _delay_check(fit: Rolling) -> Check:
    name = "speed_sensor_delay"
    if not fit.aligned:
        return _not_judged(name, NO_SPEED)
    a = fit.aligned[0]
    if len(a.names) == 1 and not a.has_reference:
        return _not_judged(name, ONE_SPEED)
    channels = {channel.name: channel for channel in a.run.of("speed", "reference")}
    wanted = list(channels) if len(a.names) > 1 else [c.name for c in a.run.of("reference")]
    missing = tuple(channel for channel in wanted if channel not in fit.delays.lags)
    if not fit.delays.lags:
        return _not_judged(name, FEW_CHANGES)
    smallest_s = 0.0
    for channel_name, lag in fit.delays.lags.items():
        normal_s = max(channels[channel_name].delay_s, 0.0) if channel_name in channels else 0.0
        half_s = 0.5 * (lag.sure_s[1] - lag.sure_s[0])
        smallest_s = max(smallest_s, normal_s + limit.late_s(a.step_s) + half_s)
    reason = FEW_CHANGES if missing else ""
    return Check(name, True, smallest_s, "s", reason, (), missing)


def _scale_checks(fit: Rolling) -> list[Check]:
    """Return the checks of radii, steps of radii, scales and offsets."""
    names = ("wheel_radius", "wheel_radius_step", "speed_scale", "speed_offset")
    if not fit.aligned:
        return [_not_judged(name, NO_SPEED) for name in names]
    if all(len(a.names) == 1 and not a.has_reference for a in fit.aligned):
        return [_not_judged(name, ONE_SPEED) for name in names]

    fits = [channel for channels in fit.scales.fits.values() for channel in channels]
    with_dates = [channel for channel in fits if channel.dates]
    steady = [c for c in with_dates if c.is_steady and not c.is_ambiguous]
    if not with_dates:
        lowest_m_s = max(a.slowest_m_s for a in fit.aligned)
        needed_s = limit.LEAST_BLOCKS * fit.aligned[0].block_s
        reason = (needed_s, lowest_m_s, _quiet_s(fit))
        return [_not_judged(name, FEW_BLOCKS, reason) for name in names]
    if not steady and any(channel.is_ambiguous for channel in with_dates):
        rivals = _offset_or_delay([c for c in with_dates if c.is_ambiguous])
        return [_not_judged(name, OFFSET_OR_DELAY, rivals) for name in names]
    varying = tuple(c.name for c in with_dates if not c.is_steady or c.is_ambiguous)
    scatter = max((100.0 * channel.worst_scatter for channel in with_dates), default=0.0)
    if not steady:
        return [_not_judged(name, UNSTEADY, (scatter,), varying) for name in names]
    return [
        _radius_check(steady, fit.scales.tests, varying, scatter),
        _step_check(steady, fit.scales.tests),
        _scale_check(fit.aligned, steady, varying, scatter),
        _offset_check(steady, fit.delays.unknown),
    ]


def _quiet_s(fit: Rolling) -> float:
    """Return for how long wheels roll without hard braking, s."""
    return float(sum(np.count_nonzero(quiet(a)) * a.step_s for a in fit.aligned))


def _radius_check(
    steady: list[ChannelFit], tests: int, varying: tuple[str, ...], scatter: float
) -> Check:
    smallest = max(
        scales.smallest_radius(wheel, tests)
        for channel in steady
        for wheel in channel.dates.values()
    )
    reason = UNSTEADY if varying else ""
    values = (scatter,) if varying else ()
    if smallest >= limit.MOST_RADIUS:
        return _not_judged("wheel_radius", UNSTEADY, (100.0 * smallest,))
    return Check("wheel_radius", True, 100.0 * smallest, "%", reason, values, varying)


def _step_check(steady: list[ChannelFit], tests: int) -> Check:
    errors = []
    for channel in steady:
        wheels = list(channel.dates.values())
        for before, after in itertools.pairwise(wheels):
            step = scales.Wheel(
                radius=0.0,
                error=float(np.hypot(before.error, after.error)),
                blocks=min(before.blocks, after.blocks),
            )
            errors.append(scales.smallest_radius(step, tests))
    if not errors:
        return _not_judged("wheel_radius_step", ONE_DATE)
    return Check("wheel_radius_step", True, 100.0 * max(errors), "%")


def _scale_check(
    aligned: list[Aligned], steady: list[ChannelFit], varying: tuple[str, ...], scatter: float
) -> Check:
    # against all wheels, or of one wheel beyond what is a radius
    smallest = limit.MOST_RADIUS
    if aligned[0].has_reference and len(steady) > 1:
        smallest = limit.COMMON_SHARE
    reason = UNSTEADY if varying else ""
    values = (scatter,) if varying else ()
    return Check("speed_scale", True, 100.0 * smallest, "%", reason, values, varying)


def _offset_or_delay(rivals: list[ChannelFit]) -> tuple[float, ...]:
    """Return the delay, s, and the offset, m/s, that cannot be distinguished."""
    late_s = float(np.median([abs(channel.late_s or 0.0) for channel in rivals]))
    offset_m_s = float(np.median([abs(channel.offset_m_s) for channel in rivals]))
    return late_s, offset_m_s


def _offset_check(steady: list[ChannelFit], unknown: list[Finding]) -> Check:
    rivals = [finding.details for finding in unknown]
    offset_or_delay = [rival for rival in rivals if isinstance(rival, OffsetOrDelay)]
    if offset_or_delay:
        values = (abs(offset_or_delay[0].delay_s), abs(offset_or_delay[0].offset_m_s))
        return _not_judged("speed_offset", OFFSET_OR_DELAY, values)
    late = [channel for channel in steady if channel.late_s is not None]
    if len(late) == len(steady):
        return _not_judged("speed_offset", OFFSET_OR_DELAY, _offset_or_delay(late))
    with_range = [channel for channel in steady if channel.has_range]
    with_offset = [channel for channel in steady if channel.has_offset]
    if with_offset and not with_range:
        # one of four speeds, which the other three show
        error_m_s = max(c.offset.half_width() for c in with_offset)
        return Check("speed_offset", True, limit.LEAST_OFFSET_M_S + error_m_s, "m/s")
    if not with_range:
        lowest = min(channel.speeds_m_s[0] for channel in steady)
        highest = max(channel.speeds_m_s[1] for channel in steady)
        return _not_judged("speed_offset", NO_RANGE, (lowest, highest))
    with_visits = [c for c in with_range if c.visits.visits >= limit.OFFSET_VISITS]
    if not with_visits:
        return _not_judged("speed_offset", FEW_VISITS)
    smallest = max(
        channel.offset.smallest(limit.ALPHA, len(steady), limit.LEAST_OFFSET_M_S)
        for channel in with_visits
    )
    return Check("speed_offset", True, smallest, "m/s")


# --- sliding wheels ---


def _slide_check(aligned: list[Aligned], sliding: list[np.ndarray]) -> Check:
    """Return the check of slides; the smallest size is measured by planted slides."""
    visible = [k for k, a in enumerate(aligned) if slides.can_be_seen(a)]
    if not visible:
        reason = TURNS if any(slides.turns(a) for a in aligned) else NO_HARDEST
        return _not_judged("slide", reason)
    braked = []
    near = []
    braked_s = 0.0
    shortest_s = 0.0
    runs = [aligned[k] for k in visible]
    for k, a in zip(visible, runs, strict=True):
        v = slides.vehicle(a)
        change_m_s2 = np.nan_to_num(slope(a.time_s, v, max(1.5, 2.5 * a.step_s)))
        is_braked = (change_m_s2 < _BRAKED_M_S2) & np.isfinite(v)
        braked_s += np.count_nonzero(is_braked) * a.step_s
        braked.append(is_braked)
        near.append(driving.near(a, np.any(sliding[k], axis=1)))
        shortest_s = max(shortest_s, limit.slide_s(a.step_s))
    if braked_s < _LEAST_S:
        return _not_judged("slide", NOT_BRAKED, (braked_s,))
    places = planted.places(runs, braked, near)
    if not places:
        # all braking is near slides
        inside = [np.any(sliding[k], axis=1) for k in visible]
        places = planted.places(runs, braked, inside)
    smallest = planted.smallest_m_s(places)
    if not np.isfinite(smallest):
        is_one = all(len(a.names) == 1 and not a.has_reference for a in runs)
        return _not_judged("slide", ONE_SPEED if is_one else NO_PLANTED)
    return Check("slide", True, smallest, "m/s", "", (shortest_s, braked_s))


def _driving_check(aligned: list[Aligned]) -> Check:
    visible = [a for a in aligned if driving.can_be_seen(a)]
    if not visible:
        return _not_judged("driving_slip", FEW_SPEEDS)
    sizes = []
    driven_s = 0.0
    shortest_s = 0.0
    for a in visible:
        v = a.vehicle
        change_m_s2 = np.nan_to_num(slope(a.time_s, v, max(1.5, 2.5 * a.step_s)))
        is_driven = (change_m_s2 > -1.0) & (np.nan_to_num(v) > a.slowest_m_s)
        driven_s += np.count_nonzero(is_driven) * a.step_s
        if is_driven.any():
            sizes.append(np.max(driving.smallest(a, v)[is_driven], axis=1))
        shortest_s = max(shortest_s, limit.slide_s(a.step_s))
    if driven_s < _LEAST_S:
        lowest_m_s = max(a.slowest_m_s for a in visible)
        return _not_judged("driving_slip", NOT_DRIVEN, (driven_s, lowest_m_s))
    smallest = float(np.nanmedian(np.concatenate(sizes)))
    return Check("driving_slip", True, smallest, "m/s", "", (shortest_s, driven_s))


def _place_check(runs: list[Run]) -> Check:
    with_position = [run for run in runs if run.of("position")]
    if not with_position:
        return _not_judged("slippery_place", NO_POSITION)
    if len(with_position) < limit.PLACE_RUNS:
        return _not_judged(
            "slippery_place", FEW_RUNS, (float(limit.PLACE_RUNS), float(len(with_position)))
        )
    return Check("slippery_place", True, float(limit.PLACE_RUNS), "runs")
