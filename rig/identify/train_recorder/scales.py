"""Compares speeds while wheels roll: wheel radii, scales and offsets, in one fit.

    [R2] v_i = (1 + rho_i) V + c_i + b_i w, V the reference, else the median of all speeds,
         w the yaw rate of the vehicle (0 where it is not recorded)

rho_i of a wheel is the radius that the recorder assumes over the radius of the wheel, less one. It
is the median over blocks in which nobody brakes hard, for each date. c_i and b_i hold for all
dates. The standard error of rho_i is that of the median of blocks or of the medians of stretches of
the recording, whichever is larger, with SYSTEMATIC_RADIUS, which no amount of data removes. The
interval also holds half the difference to the ratio over all motion: a ratio that depends on the
choice of blocks is no better known.

A ratio that scatters between blocks is no property of a wheel: it slips, or the vehicle turns. If
all wheels differ from the reference by the same scale, the reference is doubted.
"""

import itertools
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.statistics import resampling, robust_line
from rollerrig.rig.identify.statistics.interval import Estimate, freedom_of_sum
from rollerrig.rig.identify.train_recorder import four_wheels, sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.alignment import (
    AS_RECORDED,
    Aligned,
    Scale,
    align,
    base_speed,
    quiet,
    slope,
)
from rollerrig.rig.identify.train_recorder.findings import (
    Finding,
    OffsetOrDelay,
    RivalOffset,
    ScaleOrOffset,
    SpeedLine,
    WheelRadius,
)
from rollerrig.rig.identify.train_recorder.recording import Run

# share of the common difference by which a wheel may be away from it if the reference is wrong.
# Chosen.
_COMMON_SPREAD = 0.25

# the mean of all wheels as a channel
_ALL_WHEELS = "all wheels"


class Wheel(NamedTuple):
    """rho of a speed [R2] with its standard error, from so many blocks.

    `choice_error` is that of the choice of blocks. It is the same for all dates, and cancels in
    their differences.
    """

    radius: float
    error: float
    blocks: int
    choice_error: float = 0.0

    @property
    def estimate(self) -> Estimate:
        """rho with its whole error. SYSTEMATIC_RADIUS is known; the other errors are not."""
        known = min(limit.SYSTEMATIC_RADIUS, self.error)
        estimated = float(np.sqrt(self.error**2 - known**2 + self.choice_error**2))
        parts = [(estimated, self.freedom), (known, np.inf)]
        error = float(np.hypot(self.error, self.choice_error))
        return Estimate(self.radius, error, freedom_of_sum(parts))

    @property
    def freedom(self) -> int:
        """Degrees of freedom of an error that is estimated from stretches."""
        return max(min(self.blocks, resampling.STRETCHES) - 1, 2)

    @property
    def half_width(self) -> float:
        """Half the width of the 95 % interval."""
        return self.estimate.half_width()


class _Block(NamedTuple):
    """Means over one block of one channel."""

    run: str
    date: str
    speed: float  # of the vehicle, m/s
    change_m_s2: float  # of the vehicle's speed
    share: float  # of the channel beyond the vehicle
    yaw_rad_s: float
    error: float  # standard error of `share` by noise


class _Visits(NamedTuple):
    """Blocks at low and at high speed, and how many times the vehicle visits the rarer ones."""

    slow_blocks: int
    fast_blocks: int
    visits: int


class ChannelFit(NamedTuple):
    """The line of one speed [R2], over all dates of a vehicle."""

    name: str
    dates: dict[str, Wheel]  # without the effect of the offset if it is significant
    line: Wheel  # rho of a fit of scale and offset
    offset_m_s: float  # of the same fit
    offset_error_m_s: float
    offset_is_significant: bool
    has_offset: bool  # significant, shown by several visits, and no delay explains it
    scatter: float  # of the ratio between blocks, beyond noise
    scatter_in_motion: float  # the same, also while the vehicle is driven or braked
    typical: float  # median of the ratio less one
    speeds_m_s: tuple[float, float]  # lowest and highest
    visits: _Visits
    # delay of the vehicle's speed, s, that explains a significant offset as well; None if none does
    late_s: float | None = None
    normal_late_s: float = 0.0  # largest delay of the vehicle's speed that is normal

    @property
    def offset(self) -> Estimate:
        """The offset with its error, m/s."""
        return Estimate(self.offset_m_s, self.offset_error_m_s, self.line.freedom)

    @property
    def is_steady(self) -> bool:
        """Whether the ratio is a property of the wheel.

        A ratio that is too large for worn wheels must also hold while the vehicle is driven or
        braked: else the wheel slips.
        """
        return self.worst_scatter < limit.STEADY_SHARE

    @property
    def worst_scatter(self) -> float:
        """Scatter that `is_steady` judges."""
        if abs(self.typical) > limit.COMMON_SHARE:
            return max(self.scatter, 0.5 * self.scatter_in_motion)
        return self.scatter

    @property
    def has_range(self) -> bool:
        """Whether the speeds differ enough, and often enough, to distinguish scale and offset."""
        return _has_range(self.speeds_m_s, self.visits)

    @property
    def is_ambiguous(self) -> bool:
        """Whether a delay beyond the normal one explains an offset as well."""
        return self.late_s is not None and not 0.0 <= self.late_s <= self.normal_late_s


class _Level(NamedTuple):
    """Dates in a row whose radii agree, and their mean."""

    dates: list[str]
    mean: Wheel


class Scales(NamedTuple):
    """Scales of each channel in each run, the findings, and the fits by vehicle.

    `unknown` are differences that several causes explain.
    """

    of_runs: list[dict[str, Scale]]
    found: list[Finding]
    unknown: list[Finding]
    fits: dict[str, list[ChannelFit]]
    tests: int


def fit(runs: list[Run], delay_s: dict[str, float], block_s: float) -> Scales:
    """Return the scales of all channels, and the statistically significant findings."""
    aligned = [align(run, delay_s, {}, block_s) for run in runs]
    by_vehicle: dict[str, list[Aligned]] = {}
    unknown: list[Finding] = []
    for a in aligned:
        by_vehicle.setdefault(a.run.vehicle_id, []).append(a)

    found: list[Finding] = []
    fits: dict[str, list[ChannelFit]] = {}
    scale_of: dict[tuple[str, str, str], Scale] = {}
    tests = 1
    for vehicle_id, group in sorted(by_vehicle.items()):
        fits[vehicle_id] = fit_channels(group)
        reference = _reference_finding(group, fits[vehicle_id])
        if reference is not None:
            finding, scale = reference
            found.append(finding)
            name = finding.channels[0]
            for a in group:
                scale_of[vehicle_id, name, a.run.date] = scale
            if finding.name == "unknown":
                unknown.append(found.pop())
            group = [align(a.run, delay_s, {name: scale}, block_s) for a in group]
            fits[vehicle_id] = fit_channels(group)
        unknown += _offsets_or_delays(group, fits[vehicle_id])
        of_one = four_wheels.offset(group)
        if of_one is not None and not any(c.has_offset for c in fits[vehicle_id]):
            known = {**group[0].scale, of_one.name: Scale(0.0, of_one.offset_m_s)}
            group = [align(a.run, delay_s, known, block_s) for a in group]
            fits[vehicle_id] = [_with_offset(channel, of_one) for channel in fit_channels(group)]
        tests = max(sum(len(channel.dates) for channel in fits[vehicle_id]), tests)

        is_pair = not any(a.has_reference for a in group) and len(fits[vehicle_id]) == 1
        for channel in fits[vehicle_id]:
            names = group[0].names if is_pair else (channel.name,)
            more, scales = _judge(channel, names, vehicle_id, tests)
            found += more
            for date, scale in scales.items():
                scale_of[vehicle_id, channel.name, date] = scale

    of_runs = []
    for run in runs:
        scales = {}
        for name in run.channels:
            scales[name] = scale_of.get((run.vehicle_id, name, run.date), AS_RECORDED)
        of_runs.append(scales)
    return Scales(of_runs, found, unknown, fits, tests)


def _with_offset(channel: ChannelFit, offset: four_wheels.WheelOffset) -> ChannelFit:
    """Return the fit of a speed that was corrected by an offset of one of four speeds."""
    if channel.name != offset.name:
        return channel
    return channel._replace(
        offset_m_s=offset.offset_m_s,
        offset_error_m_s=offset.error_m_s,
        offset_is_significant=True,
        has_offset=True,
        late_s=None,
    )


# --- blocks ---


def _has_range(speeds_m_s: tuple[float, float], visits: _Visits) -> bool:
    """Whether blocks at low and at high speed distinguish scale and offset."""
    is_wide = speeds_m_s[1] > limit.OFFSET_RANGE * speeds_m_s[0]
    return is_wide and min(visits.slow_blocks, visits.fast_blocks) >= limit.OFFSET_BLOCKS


def _visits(rows: list[_Block], speeds_m_s: tuple[float, float]) -> _Visits:
    """Return the blocks below and above the middle of the speeds, and the visits of the vehicle.

    Blocks in a row on one side of the middle are one visit. They share one curve or one slope.
    """
    middle_m_s = float(np.sqrt(speeds_m_s[0] * speeds_m_s[1]))
    slow_visits = 0
    fast_visits = 0
    before: tuple[str, bool] | None = None
    slow_blocks = 0
    for row in rows:
        is_slow = row.speed < middle_m_s
        slow_blocks += int(is_slow)
        if (row.run, is_slow) != before:
            slow_visits += int(is_slow)
            fast_visits += int(not is_slow)
        before = (row.run, is_slow)
    return _Visits(slow_blocks, len(rows) - slow_blocks, min(slow_visits, fast_visits))


def fit_channels(group: list[Aligned]) -> list[ChannelFit]:
    """Return the fit of each speed over the runs of one vehicle; none if it has few blocks."""
    blocks: dict[str, list[_Block]] = {}
    in_motion: dict[str, list[_Block]] = {}
    rounding: dict[str, float] = {}
    normal_late_s = _normal_late_s(group)
    for a in group:
        base = base_speed(a)
        if base is None:
            continue
        names = a.names
        if not a.has_reference and len(names) == 2:
            # the second speed of a pair is the base of the comparison
            names = names[:1]
        is_quiet = quiet(a)
        moves = np.nan_to_num(base) > a.slowest_m_s
        for name in names:
            blocks.setdefault(name, []).extend(_blocks(a, name, base, is_quiet))
            in_motion.setdefault(name, []).extend(_blocks(a, name, base, moves))
            error = _rounding_error(a, name, base, is_quiet)
            rounding[name] = max(rounding.get(name, 0.0), error)

    return [
        _fit_channel(name, rows, in_motion[name], rounding[name], normal_late_s, len(blocks))
        for name, rows in blocks.items()
        if len(rows) >= limit.LEAST_BLOCKS
    ]


def _normal_late_s(group: list[Aligned]) -> float:
    """Return the largest delay of the reference that is normal, s; 0 without a reference."""
    normal_s = 0.0
    for a in group:
        for reference in a.run.of("reference"):
            normal_s = max(normal_s, reference.delay_s + limit.late_s(a.step_s))
    return normal_s


def _blocks(a: Aligned, name: str, base: np.ndarray, is_quiet: np.ndarray) -> list[_Block]:
    """Return the blocks of one speed of a run."""
    speed = a.speed[:, a.names.index(name)]
    good = is_quiet & np.isfinite(speed) & np.isfinite(base)
    noise = np.hypot(a.noise_m_s[a.names.index(name)], _base_error(a))
    number_of_block = a.blocks()
    change_m_s2 = np.nan_to_num(slope(a.time_s, base, max(1.0, 2.5 * a.step_s)))
    rows = []
    for k in np.unique(number_of_block[good]):
        part = good & (number_of_block == k)
        if not a.is_filled(part):
            continue
        mean = float(base[part].mean())
        yaw = a.yaw_rad_s[part]
        rows.append(
            _Block(
                run=a.run.name,
                date=a.run.date,
                speed=mean,
                change_m_s2=float(change_m_s2[part].mean()),
                share=float(speed[part].sum() / base[part].sum()) - 1.0,
                yaw_rad_s=float(np.nanmean(yaw)) if np.isfinite(yaw).any() else 0.0,
                # the noise of a receiver is not white: a quarter of the samples is independent
                error=float(noise / mean / np.sqrt(max(part.sum() / 4.0, 1.0))),
            )
        )
    return rows


def _base_error(a: Aligned) -> float:
    """Return the standard error of a sample of the speed to compare with, m/s."""
    return a.reference_noise_m_s if a.has_reference else max(a.noise_m_s)


def _rounding_error(a: Aligned, name: str, base: np.ndarray, is_quiet: np.ndarray) -> float:
    """Return the error of a ratio by rounding: that of equal values does not average out."""
    speed = a.speed[:, a.names.index(name)]
    good = is_quiet & np.isfinite(speed) & np.isfinite(base)
    if not good.any():
        return 0.0
    distinct = max(np.unique(speed[good]).size, 1)
    rounding = a.run.channels[name].quantum / np.sqrt(12.0)
    return float(rounding / np.mean(base[good]) / np.sqrt(distinct))


def _fit_channel(
    name: str,
    rows: list[_Block],
    in_motion: list[_Block],
    rounding: float,
    normal_late_s: float,
    tests: int,
) -> ChannelFit:
    """Return the fit of one speed to its blocks [R2], which are part of those in motion.

    A reference that is late by d makes an offset of d times the change of the speed. If such a
    delay explains a significant offset as well, the two cannot be distinguished. A delay that is
    normal is subtracted.
    """
    speed = np.array([row.speed for row in rows])
    share = np.array([row.share for row in rows])
    noise = float(np.median([row.error for row in rows]))
    dates = sorted({row.date for row in rows})
    is_date = np.array([[row.date == date for date in dates] for row in rows], float)
    weight = np.sqrt(speed)

    # turning is taken out first: one side runs faster, the other slower
    yaw = np.array([row.yaw_rad_s for row in rows])
    if np.std(yaw) > 0.0:
        turning = np.column_stack([is_date, yaw / speed])
        coefficients = robust_line.fit(turning, share, weight)
        share = share - coefficients[-1] * yaw / speed

    speeds = (float(np.quantile(speed, 0.05)), float(np.quantile(speed, 0.95)))
    visits = _visits(rows, speeds)
    by_late = np.array([row.change_m_s2 for row in rows]) / speed
    fit = _fit_offset(is_date, share, speed, tests)
    late_s = None
    subtracted_late_s = 0.0
    offset_is_significant = _has_range(speeds, visits) and fit.is_significant
    if offset_is_significant:
        late_s = _late_s(is_date, by_late, share, speed, fit.scatter)
        if late_s is not None and 0.0 <= late_s <= normal_late_s:
            subtracted_late_s = late_s
    elif _has_range(speeds, visits):
        # a delay beside an offset scatters the ratio where the vehicle brakes and drives
        beside_late = _fit_offset(is_date, share, speed, tests, by_late)
        if beside_late.is_significant and abs(beside_late.late_s) <= limit.LATEST_S:
            offset_is_significant = True
            fit = beside_late
            subtracted_late_s = fit.late_s
    has_offset = offset_is_significant and late_s is None and visits.visits >= limit.OFFSET_VISITS
    offset = fit.offset_m_s if has_offset else 0.0
    if not has_offset and late_s is None:
        subtracted_late_s = 0.0
    level = share - offset / speed - subtracted_late_s * by_late
    share_in_motion = np.array(
        [
            row.share - (offset + subtracted_late_s * row.change_m_s2) / row.speed
            for row in in_motion
        ]
    )
    by_choice = _error_of_choice(level, share_in_motion, np.array([row.speed for row in in_motion]))
    wheels = {}
    for k, date in enumerate(dates):
        of_date = level[is_date[:, k] > 0.0]
        if of_date.size < limit.LEAST_BLOCKS:
            continue
        error = float(
            np.hypot(
                np.hypot(resampling.error_of_level(of_date), limit.SYSTEMATIC_RADIUS), rounding
            )
        )
        if has_offset:
            error = float(np.hypot(error, fit.offset_error_m_s * np.median(1.0 / speed)))
        wheels[date] = Wheel(float(np.median(of_date)), error, of_date.size, by_choice)

    middle = level - is_date @ robust_line.fit(is_date, level, weight)
    scatter = np.sqrt(max(robust_line.spread(middle) ** 2 - noise**2, 0.0))
    if name == _ALL_WHEELS:
        # a single wheel that slips in braking would look like a late reference
        share_in_motion = _without_normal_delay(share_in_motion, in_motion, normal_late_s)
    noise_in_motion = float(np.median([row.error for row in in_motion]))
    scatter_in_motion = np.sqrt(
        max(robust_line.spread(share_in_motion) ** 2 - noise_in_motion**2, 0.0)
    )
    return ChannelFit(
        name=name,
        dates=wheels,
        line=Wheel(radius=fit.ratio, error=fit.ratio_error, blocks=len(rows)),
        offset_m_s=fit.offset_m_s,
        offset_error_m_s=fit.offset_error_m_s,
        offset_is_significant=offset_is_significant,
        has_offset=has_offset,
        scatter=float(scatter),
        scatter_in_motion=float(scatter_in_motion),
        typical=float(np.median(share)),
        speeds_m_s=speeds,
        visits=visits,
        late_s=late_s,
        normal_late_s=normal_late_s,
    )


class _OffsetFit(NamedTuple):
    """Scale and offset of one fit [R2], with standard errors, and the scatter that is left, m/s."""

    ratio: float
    ratio_error: float
    offset_m_s: float
    offset_error_m_s: float
    is_significant: bool  # of the offset
    scatter: float
    late_s: float = 0.0  # delay of the vehicle's speed, if it is part of the fit


def _fit_offset(
    is_date: np.ndarray,
    share: np.ndarray,
    speed: np.ndarray,
    tests: int,
    by_late: np.ndarray | None = None,
) -> _OffsetFit:
    """Return the fit of scales by date and one offset to the shares of blocks.

    `tests` is the number of speeds whose offsets are tested.
    `by_late` is the change of the speed over the speed. With it a delay of the vehicle's speed is
    part of the fit.
    """
    weight = np.sqrt(speed)
    without = is_date
    if by_late is not None:
        without = np.column_stack([is_date, by_late])
    line = np.column_stack([without, 1.0 / speed])
    coefficients = robust_line.fit(line, share, weight)
    offset = float(coefficients[-1])
    errors = np.maximum(
        resampling.bootstrap_errors(line, share, weight),
        resampling.jackknife_errors(line, share, weight),
    )
    offset_error = float(errors[-1])

    scatter_without = robust_line.spread(
        (share - without @ robust_line.fit(without, share, weight)) * speed
    )
    scatter = robust_line.spread((share - line @ coefficients) * speed)
    freedom = max(min(share.size, resampling.STRETCHES) - 1, 2)
    estimate = Estimate(offset, offset_error, freedom)
    is_significant = bool(
        estimate.is_finding(limit.ALPHA, tests, limit.LEAST_OFFSET_M_S)
        and scatter < limit.OFFSET_SCATTER * scatter_without
    )
    dates = is_date.shape[1]
    return _OffsetFit(
        ratio=float(np.median(coefficients[:dates])),
        ratio_error=float(np.hypot(np.median(errors[:dates]), limit.SYSTEMATIC_RADIUS)),
        offset_m_s=offset,
        offset_error_m_s=offset_error,
        is_significant=is_significant,
        scatter=scatter,
        late_s=0.0 if by_late is None else float(coefficients[-2]),
    )


def _late_s(
    is_date: np.ndarray,
    by_late: np.ndarray,
    share: np.ndarray,
    speed: np.ndarray,
    scatter_of_line: float,
) -> float | None:
    """Return the delay of the vehicle's speed that explains the shares as well as an offset, s.

    `by_late` is the change of the speed over the speed, and `scatter_of_line`, m/s, what scale and
    offset leave. The result is None if every delay up to LATEST_S leaves more than that, and more
    than RIVAL_M_S.
    """
    columns = np.column_stack([is_date, by_late])
    robust_late = robust_line.fit(columns, share, np.sqrt(speed))
    late_s = float(robust_late[-1])
    scatter = robust_line.spread((share - columns @ robust_late) * speed)
    explains = scatter < max(scatter_of_line / limit.OFFSET_SCATTER, limit.RIVAL_M_S)
    return late_s if explains and abs(late_s) <= limit.LATEST_S else None


def _without_normal_delay(
    share_in_motion: np.ndarray, in_motion: list[_Block], normal_late_s: float
) -> np.ndarray:
    """Return shares (n,) less what a delay of the vehicle's speed explains, if it is normal.

    In hard braking a receiver that is 0.2 s late differs from the wheels by a few percent.
    """
    by_late = np.array([row.change_m_s2 / row.speed for row in in_motion])
    columns = np.column_stack([np.ones(by_late.size), by_late])
    weight = np.sqrt([row.speed for row in in_motion])
    late_s = float(robust_line.fit(columns, share_in_motion, weight)[-1])
    if not 0.0 <= late_s <= normal_late_s:
        return share_in_motion
    return share_in_motion - late_s * by_late


def _error_of_choice(
    level: np.ndarray, share_in_motion: np.ndarray, speed_in_motion: np.ndarray
) -> float:
    """Return the error of a ratio by the choice of blocks: quiet ones, or all in motion.

    The ratio over all motion is that of the distances, without blocks in which the wheel slides.
    """
    middle = float(np.median(level))
    rolls = np.abs(share_in_motion - middle) < limit.SLIDE_SHARE
    if not rolls.any():
        return 0.0
    of_motion = float(np.average(share_in_motion[rolls], weights=speed_in_motion[rolls]))
    return 0.5 * abs(of_motion - middle)


# --- the reference ---


def _together(group: list[Aligned]) -> ChannelFit | None:
    """Return the fit of the mean of all wheels to the reference; None if it has few blocks.

    In a curve the wheels of one side run faster and those of the other side slower, so their mean
    is steady where the ratio of a single wheel is not.
    """
    means = []
    for a in group:
        if not a.has_reference or len(a.names) < 2:
            continue
        mean = a.speed.mean(axis=1)
        error = float(np.sqrt(np.sum(np.square(a.noise_m_s)))) / len(a.names)
        coarsest = max(a.run.of("speed"), key=lambda channel: channel.quantum)
        channel = coarsest._replace(name=_ALL_WHEELS)
        means.append(
            a._replace(
                run=sampling.replaced(a.run, [channel]),
                names=(_ALL_WHEELS,),
                speed=mean[:, None],
                noise_m_s=(error,),
            )
        )
    fits = fit_channels(means) if means else []
    return fits[0] if fits else None


def _reference_finding(
    group: list[Aligned], fits: list[ChannelFit]
) -> tuple[Finding, Scale] | None:
    """Return the finding that the reference differs from all wheels, and the scale to correct."""
    references = [channel for a in group for channel in a.run.of("reference")]
    together = _together(group)
    if not references or together is None or len(fits) < 2 or not together.is_steady:
        return None

    typical = np.array([channel.typical for channel in fits])
    middle = together.typical
    is_common = bool(np.max(np.abs(typical - middle)) < _COMMON_SPREAD * abs(middle))
    has_offset = together.offset_is_significant and together.late_s is None
    offsets = np.array([channel.offset_m_s for channel in fits])
    offset = together.offset_m_s
    offset_is_common = has_offset and bool(
        np.max(np.abs(offsets - offset)) < _COMMON_SPREAD * abs(offset)
    )
    is_common |= offset_is_common
    if not is_common or not (abs(middle) > limit.COMMON_SHARE or offset_is_common):
        return None

    name = references[0].name
    if not together.has_range:
        error = float(max(np.ptp(typical), limit.SYSTEMATIC_RADIUS))
        half = Wheel(middle, error, together.line.blocks).half_width
        return _scale_or_offset(name, middle, half, together.speeds_m_s)

    # wheels read (1 + ratio) V + offset of the reference: the inverse line is that of the reference
    ratio = together.line.radius
    scale = Scale(1.0 / (1.0 + ratio) - 1.0, -offset / (1.0 + ratio))
    of_ratio = together.line
    of_offset = together.offset._replace(value=scale.offset_m_s)
    # a small ratio is one of the radii of the wheels
    has_small_ratio = abs(ratio) < limit.COMMON_SHARE and offset_is_common
    if has_small_ratio:
        is_finding = of_offset.is_finding(limit.ALPHA, len(fits), limit.LEAST_OFFSET_M_S)
    else:
        is_finding = of_ratio.estimate.is_finding(limit.ALPHA, len(fits))
    if not is_finding:
        # together they differ from nothing, and either of them alone may be nothing
        return _scale_or_offset(name, middle, of_ratio.half_width, together.speeds_m_s)
    finding = _line_finding(
        "speed_offset" if has_small_ratio else "speed_scale",
        name,
        scale,
        of_ratio.half_width,
        of_offset.half_width(),
        of_reference=True,
    )
    return finding, scale


def _scale_or_offset(
    channel: str, ratio: float, half_ratio: float, speeds_m_s: tuple[float, float]
) -> tuple[Finding, Scale]:
    """Return the finding that the reference differs by a factor or by an offset, and its scale.

    The wheels read (1 + `ratio`) times the reference. All speeds lie between `speeds_m_s`.
    """
    scale = Scale(1.0 / (1.0 + ratio) - 1.0)
    percent = 100.0 * scale.ratio
    middle_m_s = float(np.mean(speeds_m_s))
    finding = Finding(
        name="unknown",
        channels=(channel,),
        size=percent,
        low=percent - 100.0 * half_ratio,
        high=percent + 100.0 * half_ratio,
        unit="%",
        details=ScaleOrOffset(percent, scale.ratio * middle_m_s, speeds_m_s),
    )
    return finding, scale


def _offsets_or_delays(group: list[Aligned], fits: list[ChannelFit]) -> list[Finding]:
    """Return the speeds whose offset may as well be a delay beyond the normal one.

    If most of the wheels have it, it is one of the reference.
    """
    ambiguous = [channel for channel in fits if channel.is_ambiguous]
    references = [channel.name for a in group for channel in a.run.of("reference")]
    found = []
    if references and 2 * len(ambiguous) > len(fits):
        offset_m_s = -float(np.median([channel.offset_m_s for channel in ambiguous]))
        late_s = float(np.median([channel.late_s or 0.0 for channel in ambiguous]))
        half_m_s = max(channel.offset.half_width() for channel in ambiguous)
        return [_offset_or_delay(references[0], offset_m_s, half_m_s, late_s)]
    for channel in ambiguous:
        half_m_s = channel.offset.half_width()
        late_s = -(channel.late_s or 0.0)
        found.append(_offset_or_delay(channel.name, channel.offset_m_s, half_m_s, late_s))
    return found


def _offset_or_delay(channel: str, offset_m_s: float, half_m_s: float, late_s: float) -> Finding:
    return Finding(
        name="unknown",
        channels=(channel,),
        size=offset_m_s,
        low=offset_m_s - half_m_s,
        high=offset_m_s + half_m_s,
        unit="m/s",
        details=OffsetOrDelay(offset_m_s, late_s),
    )


def _line_finding(
    name: str,
    channel: str,
    scale: Scale,
    half_ratio: float,
    half_offset_m_s: float,
    of_reference: bool,
) -> Finding:
    """Return a finding about scale and offset of a speed; its size is the one of its name."""
    percent = 100.0 * scale.ratio
    half_percent = 100.0 * half_ratio
    scale_percent = (percent, percent - half_percent, percent + half_percent)
    offset_m_s = (
        scale.offset_m_s,
        scale.offset_m_s - half_offset_m_s,
        scale.offset_m_s + half_offset_m_s,
    )
    size, low, high = scale_percent if name == "speed_scale" else offset_m_s
    return Finding(
        name=name,
        channels=(channel,),
        size=size,
        low=low,
        high=high,
        unit="%" if name == "speed_scale" else "m/s",
        details=SpeedLine(scale_percent, offset_m_s, of_reference),
    )


# --- wheels ---


def _judge(
    channel: ChannelFit, names: tuple[str, ...], vehicle_id: str, tests: int
) -> tuple[list[Finding], dict[str, Scale]]:
    """Return the findings about one speed, and its scale by date."""
    if not channel.is_steady or not channel.dates or channel.is_ambiguous:
        return [], {}
    found = []
    offset_m_s = 0.0
    if channel.has_offset:
        offset_m_s = channel.offset_m_s
        found.append(
            _line_finding(
                "speed_offset",
                channel.name,
                Scale(channel.line.radius, offset_m_s),
                channel.line.half_width,
                channel.offset.half_width(),
                of_reference=False,
            )
        )

    levels = _levels(channel.dates, tests)
    first = levels[0]
    if is_significant(first.mean, tests):
        until = first.dates[-1] if len(levels) > 1 else None
        rival = _rival_offset(channel, first.mean)
        found.append(_level_finding(names, first.mean, first.dates[0], vehicle_id, until, rival))
    for before, level in itertools.pairwise(levels):
        step = _difference(level.mean, before.mean)
        if abs(step.radius) < limit.MOST_RADIUS:
            found.append(
                _radius_finding("wheel_radius_step", names, step, level.dates[0], vehicle_id, None)
            )

    scales = {}
    for level in levels:
        for date in level.dates:
            scales[date] = Scale(level.mean.radius if found else 0.0, offset_m_s)
    return found, scales


def _rival_offset(channel: ChannelFit, wheel: Wheel) -> RivalOffset | None:
    """Return the offset of a speed that looks like a radius in these data; None if none does.

    At nearly one speed an offset alone explains a radius. If low speed occurs once, the fit of both
    is not trusted, and is the rival.
    """
    if channel.has_offset:
        return None
    if not channel.has_range:
        offset_m_s = wheel.radius * float(np.mean(channel.speeds_m_s))
        radius_percent = 0.0
    elif channel.visits.visits < limit.OFFSET_VISITS:
        offset_m_s = channel.offset_m_s
        radius_percent = -100.0 * channel.line.radius
    else:
        return None
    if abs(offset_m_s) < limit.LEAST_OFFSET_M_S:
        return None
    return RivalOffset(offset_m_s, radius_percent, channel.speeds_m_s)


def _level_finding(
    names: tuple[str, ...],
    wheel: Wheel,
    date: str,
    vehicle_id: str,
    until: str | None,
    rival: RivalOffset | None,
) -> Finding:
    """Return a wheel radius, or a scale of the speed where no wheel differs so much."""
    if abs(wheel.radius) <= limit.MOST_RADIUS:
        return _radius_finding("wheel_radius", names, wheel, date, vehicle_id, until, rival)
    return _line_finding(
        "speed_scale",
        names[0],
        Scale(wheel.radius),
        wheel.half_width,
        0.0,
        of_reference=False,
    )


def _levels(dates: dict[str, Wheel], tests: int) -> list[_Level]:
    """Return the levels of a radius: a date that differs significantly begins a new one."""
    levels: list[list[tuple[str, Wheel]]] = []
    for date, wheel in dates.items():
        if levels:
            before = _mean([earlier for _, earlier in levels[-1]])
            if not is_significant(_difference(wheel, before), tests):
                levels[-1].append((date, wheel))
                continue
        levels.append([(date, wheel)])
    return [
        _Level([date for date, _ in level], _mean([wheel for _, wheel in level]))
        for level in levels
    ]


def _radius_finding(
    name: str,
    channels: tuple[str, ...],
    wheel: Wheel,
    date: str,
    vehicle_id: str,
    until: str | None,
    rival: RivalOffset | None = None,
) -> Finding:
    """Return a finding with its size in % of the radius."""
    half = wheel.half_width
    # a wheel that is smaller than assumed turns faster: the signs differ
    return Finding(
        name=name,
        channels=channels,
        size=-100 * wheel.radius,
        low=-100 * (wheel.radius + half),
        high=-100 * (wheel.radius - half),
        unit="%",
        details=WheelRadius(
            vehicle_id=vehicle_id, until=until, ambiguous=len(channels) > 1, rival=rival
        ),
        date=date,
    )


def _difference(wheel: Wheel, other: Wheel) -> Wheel:
    return Wheel(
        radius=wheel.radius - other.radius,
        error=float(np.hypot(wheel.error, other.error)),
        blocks=min(wheel.blocks, other.blocks),
    )


def _mean(level: list[Wheel]) -> Wheel:
    """Return the mean, weighted by the inverse variances; the systematic error stays."""
    weight = np.array([1.0 / wheel.error**2 for wheel in level])
    return Wheel(
        radius=float(np.sum(weight * [wheel.radius for wheel in level]) / weight.sum()),
        error=float(max(weight.sum() ** -0.5, limit.SYSTEMATIC_RADIUS)),
        blocks=sum(wheel.blocks for wheel in level),
        choice_error=max(wheel.choice_error for wheel in level),
    )


def is_significant(wheel: Wheel, tests: int) -> bool:
    """Whether a radius differs from 0 by more than LEAST_RADIUS and chance.

    The probability ALPHA of a false alarm is shared among the tests.
    """
    return wheel.estimate.is_finding(limit.ALPHA, tests, limit.LEAST_RADIUS)


def smallest_radius(wheel: Wheel, tests: int) -> float:
    """Return the smallest share of the radius that these blocks would have shown."""
    return wheel.estimate.smallest(limit.ALPHA, tests, limit.LEAST_RADIUS)
