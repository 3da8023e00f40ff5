"""Decides which channels are late. The delay minimises the capped absolute error.

Its interval comes from a bootstrap over blocks. With two channels only it cannot be decided which
of them is wrong: the later one is reported, with the other. A wheel that slips has no delay, and
neither has a channel whose speed differs by a factor: a delay adds the same speed at all speeds
while the vehicle brakes steadily, a wrong radius adds a share of the speed. An offset adds the same
speed, too. Only steady driving, or another rate of braking, distinguishes it from a delay.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.statistics import interval, resampling
from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.alignment import (
    AS_RECORDED,
    Aligned,
    Scale,
    align,
    slope,
)
from rollerrig.rig.identify.train_recorder.findings import (
    Delay,
    Finding,
    OffsetOrDelay,
    SpeedFactor,
)
from rollerrig.rig.identify.train_recorder.recording import Run

# s. Delays are tried in these steps.
_DELAY_STEP_S = 0.05
_GRID_S = np.arange(-limit.LATEST_S, limit.LATEST_S + 0.01, _DELAY_STEP_S)

# samples. More do not improve a delay, they only cost time.
_MOST_SAMPLES = 20_000

# samples in motion. With fewer a run shows nothing about a delay.
_LEAST_SAMPLES = 50

# m/s^2. Below this change of speed a delay does not show.
_CHANGING_M_S2 = 0.15

# Factors that are the rivals of a delay: as far as wheel radii and speedometers deviate.
_FACTORS = np.linspace(0.9, 1.1, 81)

# samples of the bootstrap of a delay, which shows the quantiles of the family-wise level too
_REPLICATES = 2000


class Lag(NamedTuple):
    """How late a channel is, with its 95 % interval, s; negative: early.

    `sure_s` is the interval at the family-wise level, which decides whether a channel is late.
    """

    delay_s: float
    low_s: float
    high_s: float
    sure_s: tuple[float, float] = (0.0, 0.0)
    share_left: float = 0.0  # error that is left, over the error without a delay
    # factor of the speed that fits better than any delay, and the error that it leaves
    factor: float | None = None
    # offset of the speed that fits as well as the delay, m/s
    offset_m_s: float | None = None

    def reversed(self) -> "Lag":
        """The lag of the other side of the comparison."""
        low_s, high_s = self.sure_s
        return Lag(-self.delay_s, -self.high_s, -self.low_s, (-high_s, -low_s), self.share_left)


class _DelaySearch:
    """Decides which channels are late; `delays` are to be corrected, `found` are reported."""

    def __init__(self, runs: list[Run], scales: list[dict[str, Scale]], block_s: float) -> None:
        self.scales = scales
        self.aligned = [
            align(run, {}, scale, block_s) for run, scale in zip(runs, scales, strict=True)
        ]
        self.late_s = limit.late_s(max(a.step_s for a in self.aligned))
        self.names = list(dict.fromkeys(name for a in self.aligned for name in a.names))
        self.channels = {
            channel.name: channel for run in runs for channel in run.of("speed", "reference")
        }
        self.reference: str | None = None
        for channel in self.channels.values():
            if channel.quantity == "reference":
                self.reference = channel.name
                break
        self.delays: dict[str, float] = {}
        self.found: list[Finding] = []
        self.lags: dict[str, Lag] = {}
        self.unknown: list[Finding] = []
        self._rng = np.random.default_rng(1)

    def search(self) -> None:
        if len(self.names) == 2:
            self._compare_pair()
        elif len(self.names) > 2:
            self._compare_with_median()
        if self.reference is not None:
            self._compare_reference(self.reference)

    def _compare_pair(self) -> None:
        """Compare two speeds: the later one is taken as wrong."""
        first, second = self.names
        lag = self._estimate(first, [second])
        if lag is None:
            return
        self.lags[first] = lag
        self.lags[second] = lag.reversed()
        late, other = first, second
        if lag.delay_s <= 0.0:
            late, other = second, first
            lag = lag.reversed()
        if lag.sure_s[0] > self.late_s:
            self._decide(late, lag, other)

    def _compare_with_median(self) -> None:
        """Compare each speed with the median of all speeds."""
        for name in self.names:
            lag = self._estimate(name, self.names)
            if lag is None:
                continue
            self.lags[name] = lag
            if lag.sure_s[0] > self.late_s or lag.sure_s[1] < -self.late_s:
                self._decide(name, lag, "")

    def _compare_reference(self, reference: str) -> None:
        """Compare the reference with the median of the speeds that are not late."""
        right = [name for name in self.names if name not in self.delays]
        lag = self._estimate(reference, right) if right else None
        if lag is None:
            return
        self.lags[reference] = lag
        if lag.sure_s[1] < -self.late_s and len(right) == 1:
            # an early reference means that the only wheel is late
            self._decide(right[0], lag.reversed(), reference)
        else:
            self._decide(reference, lag, "")

    def _estimate(self, name: str, against: list[str]) -> Lag | None:
        """Return the lag of a channel; None, and a finding, if it may be a factor or an offset."""
        lag = _lag(self.aligned, self.scales, name, against, self._rng)
        if lag is None:
            return None
        if lag.offset_m_s is not None:
            if self._is_beyond_normal(name, lag) and lag.share_left < limit.LATE_SHARE:
                rival = self._rival(name, against)
                self.unknown.append(_offset_or_delay(name, rival, lag.offset_m_s, lag))
                # one of both has to be corrected for the next steps
                self.delays[name] = lag.delay_s
            return None
        if lag.factor is None:
            return lag
        is_large = abs(lag.factor - 1.0) > limit.LATE_FACTOR
        if is_large and lag.share_left < limit.LATE_SHARE and name != self.reference:
            rival = self._rival(name, against)
            self.unknown.append(self._factor_finding(name, rival, lag.factor))
        return None

    def _rival(self, name: str, against: list[str]) -> str:
        """Return the other one of two speeds, which may as well be wrong; "" for several speeds."""
        is_pair = len(against) == 1 and name != self.reference
        return against[0] if is_pair else ""

    def _factor_finding(self, name: str, rival: str, factor: float) -> Finding:
        percent = 100.0 * (factor - 1.0)
        step = 100.0 * float(_FACTORS[1] - _FACTORS[0])
        return Finding(
            name="unknown",
            channels=(name, rival) if rival else (name,),
            size=percent,
            low=percent - step,
            high=percent + step,
            unit="%",
            details=SpeedFactor(factor, rival),
        )

    def _decide(self, name: str, lag: Lag, against: str) -> None:
        """Report a lag beyond the delay that is normal for the channel; else only corrects it."""
        is_late = self._is_beyond_normal(name, lag, against)
        is_early = lag.sure_s[1] < -self.late_s and len(self.names) > 2 and name != self.reference
        if (is_late or is_early) and lag.share_left < limit.LATE_SHARE:
            self.delays[name] = lag.delay_s
            self.found.append(
                Finding(
                    name="speed_sensor_delay",
                    channels=(name,),
                    size=lag.delay_s,
                    low=lag.low_s,
                    high=lag.high_s,
                    unit="s",
                    details=Delay(of_reference=name == self.reference, against=against),
                )
            )
        elif name == self.reference or abs(lag.delay_s) > self.late_s:
            # normal for this channel: corrected, not reported
            self.delays[name] = lag.delay_s

    def _is_beyond_normal(self, name: str, lag: Lag, against: str = "") -> bool:
        """Return whether a channel is later than its normal delay."""
        normal_s = max(self.channels[name].delay_s, 0.0)
        if name == self.reference or against == self.reference:
            normal_s += self._creepage_s()
        return lag.sure_s[0] > normal_s + self.late_s

    def _creepage_s(self) -> float:
        """Return the delay of a reference that creepage in driving and braking looks like, s."""
        speeds = np.concatenate([a.vehicle for a in self.aligned])
        return limit.CREEPAGE_S2_M * float(np.nanmedian(speeds))


def _offset_or_delay(name: str, rival: str, offset_m_s: float, lag: Lag) -> Finding:
    """Return the finding that a channel has an offset or a delay, or else its `rival` has it."""
    return Finding(
        name="unknown",
        channels=(name, rival) if rival else (name,),
        size=lag.delay_s,
        low=lag.low_s,
        high=lag.high_s,
        unit="s",
        details=OffsetOrDelay(offset_m_s, lag.delay_s, rival),
    )


class Delays(NamedTuple):
    """Delays to correct, s, by channel; the findings; and the estimates by channel.

    `unknown` are channels whose speed differs by a factor that may have several causes.
    """

    delay_s: dict[str, float]
    found: list[Finding]
    lags: dict[str, Lag]
    unknown: list[Finding]


def fit(runs: list[Run], scales: list[dict[str, Scale]], block_s: float) -> Delays:
    """Return the delay of each late channel and the findings."""
    search = _DelaySearch(runs, scales, block_s)
    search.search()
    return Delays(search.delays, search.found, search.lags, search.unknown)


def _lag(
    aligned: list[Aligned],
    scales: list[dict[str, Scale]],
    name: str,
    against: list[str],
    rng: np.random.Generator,
    offset_m_s: float = 0.0,
) -> Lag | None:
    """Return how late a channel is against the median of others, without an offset that it has.

    The result is None where nothing changes, where the wheel slips, and where the best delay is at
    the edge of the search. It has a factor and no delay where a factor fits better than any delay.
    """
    block_costs: list[np.ndarray] = []
    factor_cost = np.zeros(_FACTORS.size)
    no_delay = int(np.argmin(np.abs(_GRID_S)))
    capped = np.zeros(_GRID_S.size, int)
    samples = 0
    total = sum(a.time_s.size for a in aligned)
    every = max(total // _MOST_SAMPLES, 1)
    for a, scale in zip(aligned, scales, strict=True):
        if name not in a.run.channels:
            continue
        present = [other for other in against if other in a.names]
        base = sampling.median(np.array([a.speed[:, a.names.index(other)] for other in present]))
        half_s = max(1.0, 2.5 * a.step_s)
        changes = np.abs(slope(a.time_s, base, half_s)) > _CHANGING_M_S2
        picked = np.flatnonzero(changes & (base > a.slowest_m_s))[::every]
        if picked.size < _LEAST_SAMPLES:
            continue

        # capped error (delays, samples) of the channel for each delay of the grid
        t = a.time_s[picked]
        shifted = sampling.at(a.run.channels[name], t + _GRID_S[:, None])
        corrected = scale.get(name, AS_RECORDED).corrected(shifted) - offset_m_s
        error = np.abs(corrected - base[picked])
        error = np.where(np.isfinite(error), np.minimum(error, limit.CAP_M_S), np.nan)

        # only samples that have a value for every delay compare the delays fairly
        complete = np.isfinite(error).all(axis=0)
        block = ((t - a.time_s[0]) // a.block_s).astype(int)[complete]
        if block.size < _LEAST_SAMPLES:
            continue
        _, block_number = np.unique(block, return_inverse=True)
        cost = np.array([np.bincount(block_number, row[complete]) for row in error])
        undelayed = corrected[no_delay, complete]
        for k, factor in enumerate(_FACTORS):
            by_factor = np.abs(factor * undelayed - base[picked][complete])
            factor_cost[k] += np.minimum(by_factor, limit.CAP_M_S).sum()
        block_costs += list(cost.T)
        capped += np.count_nonzero(error[:, complete] >= limit.CAP_M_S, axis=1)
        samples += block.size

    if len(block_costs) < limit.LEAST_BLOCKS:
        return None
    costs = np.array(block_costs)
    total_cost = costs.sum(axis=0)
    best = int(np.argmin(total_cost))
    slips = capped[best] > limit.LATE_CAPPED * samples
    at_edge = not 2 <= best < _GRID_S.size - 2
    if slips or at_edge:
        return None
    without_delay = float(total_cost[no_delay])
    if factor_cost.min() < total_cost[best]:
        # the recorded speed times this factor fits, so the channel shows 1 / factor of the speed
        factor = 1.0 / float(_FACTORS[int(np.argmin(factor_cost))])
        left = float(factor_cost.min()) / max(without_delay, 1e-9)
        return Lag(0.0, 0.0, 0.0, share_left=left, factor=factor)
    counts = resampling.drawn(len(costs), rng, _REPLICATES)
    best_s = float(_least_cost(costs.sum(axis=0)[None])[0])
    varied_s = _least_cost(counts @ costs)
    low_s, high_s = _interval(varied_s, best_s, 1.0 - interval.REPORTED)
    tests = sum(len(a.run.of("speed", "reference")) for a in aligned[:1])
    lag = Lag(
        delay_s=best_s,
        low_s=low_s,
        high_s=high_s,
        sure_s=_interval(varied_s, best_s, limit.ALPHA / max(tests, 1)),
        share_left=float(total_cost[best]) / max(without_delay, 1e-9),
    )
    widest_s = max(lag.high_s, -lag.low_s)
    if widest_s > limit.LATEST_S - 2 * _DELAY_STEP_S:
        # the data do not bound the delay inside of the search
        return None
    if offset_m_s:
        return lag
    rival = _offset_rival(aligned, scales, name, against, lag.delay_s)
    if max(rival.error, limit.RIVAL_M_S) < limit.OFFSET_SCATTER * rival.error_of_delay:
        # the channel has an offset: a delay shows beside it only
        return _lag(aligned, scales, name, against, rng, rival.offset_m_s)
    is_visible = rival.error_of_neither > max(rival.error / limit.OFFSET_SCATTER, limit.RIVAL_M_S)
    if is_visible and rival.error < max(
        rival.error_of_delay / limit.OFFSET_SCATTER, limit.RIVAL_M_S
    ):
        return lag._replace(offset_m_s=rival.offset_m_s)
    return lag


def _interval(varied_s: np.ndarray, best_s: float, alpha: float) -> tuple[float, float]:
    """Return the interval of a delay from a bootstrap, at the level 1 - alpha.

    It is a step of the search wider on both sides.
    """
    low_s, high_s = np.quantile(varied_s, (0.5 * alpha, 1.0 - 0.5 * alpha))
    return float(min(low_s, best_s) - _DELAY_STEP_S), float(max(high_s, best_s) + _DELAY_STEP_S)


class _OffsetRival(NamedTuple):
    """The offset of a channel that fits best, and what it, a delay, and neither leave, m/s."""

    offset_m_s: float
    error: float
    error_of_delay: float
    error_of_neither: float


def _offset_rival(
    aligned: list[Aligned],
    scales: list[dict[str, Scale]],
    name: str,
    against: list[str],
    delay_s: float,
) -> _OffsetRival:
    """Return the offset of a channel that is the rival of a delay.

    All blocks in motion count: in steady driving an offset shows, and a delay does not. Means over
    blocks are compared, because the noise of single samples hides the difference.
    """
    undelayed: list[np.ndarray] = []
    delayed: list[np.ndarray] = []
    for a, scale in zip(aligned, scales, strict=True):
        if name not in a.run.channels:
            continue
        present = [other for other in against if other in a.names]
        base = sampling.median(np.array([a.speed[:, a.names.index(other)] for other in present]))
        moves = base > a.slowest_m_s
        channel = a.run.channels[name]
        scale_of_channel = scale.get(name, AS_RECORDED)
        differences = []
        for shift_s in (0.0, delay_s):
            values = sampling.at(channel, a.time_s + shift_s)
            differences.append(scale_of_channel.corrected(values) - base)
        known = moves & np.isfinite(differences[0]) & np.isfinite(differences[1])
        if not known.any():
            continue
        _, block = np.unique(a.blocks()[known], return_inverse=True)
        count = np.bincount(block)
        for means, difference in zip((undelayed, delayed), differences, strict=True):
            means.append(np.bincount(block, difference[known]) / count)
    without_delay = np.concatenate(undelayed)
    offset_m_s = float(np.median(without_delay))
    by_offset = np.minimum(np.abs(without_delay - offset_m_s), limit.CAP_M_S)
    by_delay = np.minimum(np.abs(np.concatenate(delayed)), limit.CAP_M_S)
    by_neither = np.minimum(np.abs(without_delay), limit.CAP_M_S)
    return _OffsetRival(
        offset_m_s=offset_m_s,
        error=float(by_offset.mean()),
        error_of_delay=float(by_delay.mean()),
        error_of_neither=float(by_neither.mean()),
    )


def _least_cost(cost: np.ndarray) -> np.ndarray:
    """Return the delay of the least cost of each row, by a parabola through three points."""
    k = np.clip(np.argmin(cost, axis=1), 1, cost.shape[1] - 2)
    row = np.arange(len(cost))
    before = cost[row, k - 1]
    here = cost[row, k]
    after = cost[row, k + 1]
    bend = before - 2.0 * here + after
    is_valley = bend > 0.0
    vertex = 0.5 * (before - after) / np.where(is_valley, bend, 1.0)
    return _GRID_S[k] + _DELAY_STEP_S * np.where(is_valley, vertex, 0.0)
