"""Compares the channels of one vehicle while its wheels roll: delays and wheel radii.

    [R1] v_i(t + d_i) = (1 + rho_i) V(t), V by the reference, else by the median of all speeds

rho_i is the radius that the recorder assumes over the radius of the wheel, less one. It is the
error of the wheel speed. Its value is the median over blocks in which nobody brakes hard. The delay
d_i minimises the capped absolute error; its interval comes from a bootstrap over the same blocks.
With two channels only it cannot be decided which of them is wrong: the finding has both.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from rollerrig.rig.identify.train_recorder import faults
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.findings import Delay, Finding, WheelRadius
from rollerrig.rig.identify.train_recorder.recording import Channel, Run

# s. Delays are tried in these steps.
_DELAY_STEP_S = 0.05
_GRID_S = np.arange(-limit.LATEST_S, limit.LATEST_S + 0.01, _DELAY_STEP_S)

# samples. More do not improve a delay, they only cost time.
_MOST_SAMPLES = 20_000

# samples in motion. With fewer a run shows nothing about a delay.
_LEAST_SAMPLES = 50

# m/s^2. Below this change of speed a delay does not show.
_CHANGING_M_S2 = 0.15

# samples of the bootstrap of a delay
_REPLICATES = 300

# share of BLOCK_S that must have values
_FILLED_SHARE = 0.4

# share of the greatest brake demand. Above it the vehicle brakes hard.
_HARD_DEMAND_SHARE = 0.4

# standard deviation of a normal distribution over its median absolute deviation
_DEVIATION_OF_MEDIAN = 1.4826

# standard error of a median over that of a mean
_ERROR_OF_MEDIAN = 1.2533

# share. No radius is known better.
_LEAST_ERROR = 1e-4


class Aligned(NamedTuple):
    """A run on the stamps of one of its speeds: arrays (n,), `speed` (n, m), SI units.

    Delays and radii are corrected. Missing channels are NaN.
    """

    run: Run
    names: tuple[str, ...]  # of the columns of `speed`
    time_s: np.ndarray
    speed: np.ndarray
    reference: np.ndarray
    position: np.ndarray
    demand: np.ndarray
    radius: dict[str, float]  # rho that is corrected, by channel

    def as_recorded(self) -> "Aligned":
        """The same run with the radius that the recorder assumes."""
        scale = [1.0 + self.radius.get(name, 0.0) for name in self.names]
        return self._replace(speed=self.speed * scale, radius={})

    @property
    def vehicle(self) -> np.ndarray:
        """Speed of the vehicle while wheels roll, m/s."""
        middle = faults.median(self.speed.T)
        return np.where(np.isfinite(self.reference), self.reference, middle)

    @property
    def has_reference(self) -> bool:
        """Whether the reference has any value."""
        return bool(np.isfinite(self.reference).any())

    @property
    def step_s(self) -> float:
        """Median interval of the stamps."""
        return float(np.median(np.diff(self.time_s)))

    def blocks(self) -> np.ndarray:
        """Number of the block of BLOCK_S of each sample."""
        return ((self.time_s - self.time_s[0]) // limit.BLOCK_S).astype(int)

    def is_filled(self, samples: np.ndarray) -> bool:
        """Whether enough samples of a block are flagged."""
        return bool(samples.sum() * self.step_s > _FILLED_SHARE * limit.BLOCK_S)


def align(run: Run, delay_s: dict[str, float], radius: dict[str, float]) -> Aligned:
    """Return a run with the known delays and radii of its channels corrected [R1]."""
    speeds = run.of("speed")
    base = max(speeds, key=lambda channel: np.isfinite(channel.values).sum())
    time_s = base.time_s - delay_s.get(base.name, 0.0)

    def corrected(channel: Channel) -> np.ndarray:
        values = faults.at(channel, time_s + delay_s.get(channel.name, 0.0))
        return values / (1.0 + radius.get(channel.name, 0.0))

    nothing = np.full(time_s.size, np.nan)
    others = {
        channel.quantity: corrected(channel)
        for channel in run.of("reference", "position", "demand")
    }
    return Aligned(
        run=run,
        names=tuple(channel.name for channel in speeds),
        time_s=time_s,
        speed=np.column_stack([corrected(channel) for channel in speeds]),
        reference=others.get("reference", nothing),
        position=others.get("position", nothing),
        demand=others.get("demand", nothing),
        radius=radius,
    )


def slope(time_s: np.ndarray, values: np.ndarray, half_s: float = 1.0) -> np.ndarray:
    """Return the least-squares slope in a window around each sample; NaN where a third is missing.

    The window reaches `half_s` to both sides. Its sums are differences of running sums.
    """
    good = np.isfinite(values)
    t = time_s - time_s[0]
    plain = np.nan_to_num(values)
    start = np.searchsorted(t, t - half_s)
    end = np.searchsorted(t, t + half_s, "right")

    def window_sum(terms: np.ndarray) -> np.ndarray:
        running = np.concatenate([[0.0], np.cumsum(np.where(good, terms, 0.0))])
        return running[end] - running[start]

    n = window_sum(np.ones(t.size))
    x = window_sum(t)
    y = window_sum(plain)
    xy = window_sum(t * plain)
    xx = window_sum(t * t)

    spread = n * xx - x * x
    step_s = max(float(np.median(np.diff(t))), 1e-3)
    usual_samples = max(2.0 * half_s / step_s, 1.0)
    is_known = (n > 0.67 * usual_samples) & (spread > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(is_known, (n * xy - x * y) / spread, np.nan)


def quiet(a: Aligned) -> np.ndarray:
    """Return where nobody brakes hard and the wheels turn, flags (n,)."""
    v = a.vehicle
    is_steady = np.abs(slope(a.time_s, v)) < limit.QUIET_M_S2
    turns = v > limit.SLOWEST_M_S
    return is_steady & turns & ~_brakes_hard(a)


def _brakes_hard(a: Aligned) -> np.ndarray:
    """Return where the brake demand is high, flags (n,); nowhere if no demand is recorded."""
    known = np.isfinite(a.demand)
    most = np.nanmax(a.demand) if known.any() else 0.0
    if most <= 0.0:
        return np.zeros(a.time_s.size, bool)
    return np.nan_to_num(a.demand) > _HARD_DEMAND_SHARE * most


def fit(runs: list[Run]) -> tuple[list[Aligned], list[Finding]]:
    """Return all runs with delays and radii corrected, and the findings about both.

    Delays and radii are estimated alternately, because each needs the other.
    """
    delays: dict[str, float] = {}
    for _ in range(2):
        radii, _ = _radii(runs, delays)
        delays, delay_findings = _delays(runs, radii)
    radii, radius_findings = _radii(runs, delays)

    aligned = [align(run, delays, radius) for run, radius in zip(runs, radii, strict=True)]
    return aligned, delay_findings + radius_findings


# --- delays ---


class Lag(NamedTuple):
    """How late a channel is, with its 95 % interval, s; negative: early."""

    delay_s: float
    low_s: float
    high_s: float

    def reversed(self) -> "Lag":
        """The lag of the other side of the comparison."""
        return Lag(-self.delay_s, -self.high_s, -self.low_s)


class _DelaySearch:
    """Decides which channels are late; `delays` are to be corrected, `found` are reported."""

    def __init__(self, runs: list[Run], radii: list[dict[str, float]]) -> None:
        self.radii = radii
        self.aligned = [align(run, {}, radius) for run, radius in zip(runs, radii, strict=True)]
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
        late, other = first, second
        if lag.delay_s <= 0.0:
            late, other = second, first
            lag = lag.reversed()
        if lag.low_s > limit.LATE_S:
            self._decide(late, lag, other)

    def _compare_with_median(self) -> None:
        """Compare each speed with the median of all speeds."""
        for name in self.names:
            lag = self._estimate(name, self.names)
            if lag is None:
                continue
            if lag.low_s > limit.LATE_S or lag.high_s < -limit.LATE_S:
                self._decide(name, lag, "")

    def _compare_reference(self, reference: str) -> None:
        """Compare the reference with the median of the speeds that are not late."""
        right = [name for name in self.names if name not in self.delays]
        lag = self._estimate(reference, right) if right else None
        if lag is None:
            return
        if lag.high_s < -limit.LATE_S and len(right) == 1:
            # an early reference means that the only wheel is late
            self._decide(right[0], lag.reversed(), reference)
        else:
            self._decide(reference, lag, "")

    def _estimate(self, name: str, against: list[str]) -> Lag | None:
        return _lag(self.aligned, self.radii, name, against, self._rng)

    def _decide(self, name: str, lag: Lag, against: str) -> None:
        """Report a lag beyond the delay that is normal for the channel; else only corrects it."""
        normal_s = max(self.channels[name].delay_s, 0.0)
        is_late = lag.low_s > normal_s + limit.LATE_S
        is_early = lag.high_s < -limit.LATE_S and len(self.names) > 2 and name != self.reference
        if is_late or is_early:
            self.delays[name] = lag.delay_s
            self.found.append(
                Finding(
                    name="speed_sensor_delay",
                    channels=(name,),
                    run="",
                    start_s=0.0,
                    end_s=0.0,
                    size=lag.delay_s,
                    low=lag.low_s,
                    high=lag.high_s,
                    unit="s",
                    details=Delay(of_reference=name == self.reference, against=against),
                )
            )
        elif name == self.reference or abs(lag.delay_s) > limit.LATE_S:
            # normal for this channel: corrected, not reported
            self.delays[name] = lag.delay_s


def _delays(
    runs: list[Run], radii: list[dict[str, float]]
) -> tuple[dict[str, float], list[Finding]]:
    """Return the delay of each late channel, s, and the findings."""
    search = _DelaySearch(runs, radii)
    search.search()
    return search.delays, search.found


def _lag(
    aligned: list[Aligned],
    radii: list[dict[str, float]],
    name: str,
    against: list[str],
    rng: np.random.Generator,
) -> Lag | None:
    """Return how late a channel is against the median of others; None where nothing changes."""
    block_costs: list[np.ndarray] = []
    total = sum(a.time_s.size for a in aligned)
    every = max(total // _MOST_SAMPLES, 1)
    for a, radius in zip(aligned, radii, strict=True):
        if name not in a.run.channels:
            continue
        present = [other for other in against if other in a.names]
        base = faults.median(np.array([a.speed[:, a.names.index(other)] for other in present]))
        changes = np.abs(slope(a.time_s, base)) > _CHANGING_M_S2
        picked = np.flatnonzero(changes & (base > limit.SLOWEST_M_S))[::every]
        if picked.size < _LEAST_SAMPLES:
            continue

        # capped error (delays, samples) of the channel for each delay of the grid
        t = a.time_s[picked]
        scale = 1.0 + radius.get(name, 0.0)
        shifted = faults.at(a.run.channels[name], t + _GRID_S[:, None])
        error = np.abs(shifted / scale - base[picked])
        error = np.where(np.isfinite(error), np.minimum(error, limit.CAP_M_S), np.nan)

        # only samples that have a value for every delay compare the delays fairly
        complete = np.isfinite(error).all(axis=0)
        block = ((t - a.time_s[0]) // limit.BLOCK_S).astype(int)[complete]
        if block.size < _LEAST_SAMPLES:
            continue
        _, block_number = np.unique(block, return_inverse=True)
        cost = np.array([np.bincount(block_number, row[complete]) for row in error])
        block_costs += list(cost.T)

    if len(block_costs) < limit.LEAST_BLOCKS:
        return None
    costs = np.array(block_costs)
    drawn = rng.integers(0, len(costs), (_REPLICATES, len(costs)))
    best_s = _least_cost(costs.sum(axis=0)[None])[0]
    low_s, high_s = np.quantile(_least_cost(costs[drawn].sum(axis=1)), (0.025, 0.975))
    return Lag(
        delay_s=float(best_s),
        low_s=float(min(low_s, best_s) - _DELAY_STEP_S),
        high_s=float(max(high_s, best_s) + _DELAY_STEP_S),
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


# --- radii ---


class Wheel(NamedTuple):
    """rho of a speed [R1] with its standard error, from so many blocks."""

    radius: float
    error: float
    blocks: int


class _Level(NamedTuple):
    """Dates in a row whose radii agree, and their mean."""

    dates: list[str]
    mean: Wheel


def _radii(
    runs: list[Run], delays: dict[str, float]
) -> tuple[list[dict[str, float]], list[Finding]]:
    """Return rho of each channel in each run, and the statistically significant findings."""
    aligned = [align(run, delays, {}) for run in runs]
    groups: dict[tuple[str, str], list[Aligned]] = {}
    for a in aligned:
        groups.setdefault((a.run.vehicle_id, a.run.date), []).append(a)

    # vehicle -> channel -> date -> wheel
    known: dict[str, dict[str, dict[str, Wheel]]] = {}
    for (vehicle_id, date), group in sorted(groups.items()):
        for name, wheel in wheels(group).items():
            known.setdefault(vehicle_id, {}).setdefault(name, {})[date] = wheel
    tests = sum(len(dates) for names in known.values() for dates in names.values())
    tests = max(tests, 1)

    found: list[Finding] = []
    radius_of: dict[tuple[str, str, str], float] = {}
    for vehicle_id, names in known.items():
        has_reference = any(a.has_reference for a in aligned if a.run.vehicle_id == vehicle_id)
        is_pair = len(names) == 2 and not has_reference
        for name, dates in names.items():
            channels = tuple(names) if is_pair else (name,)
            more, radius_by_date = _judge_radius(channels, vehicle_id, dates, tests)
            found += more
            for date, radius in radius_by_date.items():
                radius_of[vehicle_id, name, date] = radius
            if is_pair:
                # the second speed of a pair is the base of the comparison
                break

    radii = []
    for run in runs:
        radii.append(
            {name: radius_of.get((run.vehicle_id, name, run.date), 0.0) for name in run.channels}
        )
    return radii, found


def wheels(group: list[Aligned]) -> dict[str, Wheel]:
    """Return rho of each speed over the runs of one vehicle and date [R1]."""
    shares_of_blocks: dict[str, list[float]] = {}
    rounding_error: dict[str, float] = {}
    for a in group:
        base = _base_speed(a)
        if base is None:
            continue
        is_quiet = quiet(a)
        block = a.blocks()
        for j, name in enumerate(a.names):
            speed = a.speed[:, j]
            good = is_quiet & np.isfinite(speed) & np.isfinite(base)
            if not good.any():
                continue
            for k in np.unique(block[good]):
                in_block = good & (block == k)
                if a.is_filled(in_block):
                    share = float(speed[in_block].sum() / base[in_block].sum()) - 1.0
                    shares_of_blocks.setdefault(name, []).append(share)

            # rounding of equal values does not average out
            rounding = a.run.channels[name].quantum / np.sqrt(12.0)
            distinct = max(np.unique(speed[good]).size, 1)
            error = rounding / float(np.mean(base[good])) / np.sqrt(distinct)
            rounding_error[name] = max(rounding_error.get(name, 0.0), error)

    found = {}
    for name, shares in shares_of_blocks.items():
        if len(shares) < limit.LEAST_BLOCKS:
            continue
        middle = float(np.median(shares))
        deviation = float(np.median(np.abs(np.array(shares) - middle)))
        spread = _DEVIATION_OF_MEDIAN * deviation
        error_of_median = _ERROR_OF_MEDIAN * spread / np.sqrt(len(shares))
        error = float(np.hypot(error_of_median, rounding_error[name])) + _LEAST_ERROR
        found[name] = Wheel(middle, error, len(shares))
    return found


def _base_speed(a: Aligned) -> np.ndarray | None:
    """Return the speed to compare with: the vehicle's or the second of two; None for one speed."""
    if not a.has_reference:
        if len(a.names) == 1:
            return None
        if len(a.names) == 2:
            return a.speed[:, 1]
    return a.vehicle


def _judge_radius(
    channels: tuple[str, ...], vehicle_id: str, dates: dict[str, Wheel], tests: int
) -> tuple[list[Finding], dict[str, float]]:
    """Return the findings about the radius of one speed and its steps, and rho by date."""
    levels = _levels(dates, tests)
    found = []
    first = levels[0]
    if _is_significant(first.mean, tests):
        until = first.dates[-1] if len(levels) > 1 else None
        found.append(
            _radius_finding("wheel_radius", channels, first.mean, first.dates[0], vehicle_id, until)
        )
    for before, level in itertools.pairwise(levels):
        step = _difference(level.mean, before.mean)
        found.append(
            _radius_finding("wheel_radius_step", channels, step, level.dates[0], vehicle_id, None)
        )

    radius_by_date = {}
    for level in levels:
        for date in level.dates:
            radius_by_date[date] = level.mean.radius if found else 0.0
    return found, radius_by_date


def _levels(dates: dict[str, Wheel], tests: int) -> list[_Level]:
    """Return the levels of a radius: a date that differs significantly begins a new one."""
    levels: list[list[tuple[str, Wheel]]] = []
    for date, wheel in dates.items():
        if levels:
            before = _mean([earlier for _, earlier in levels[-1]])
            if not _is_significant(_difference(wheel, before), tests):
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
) -> Finding:
    """Return a finding with its size in % of the radius."""
    quantile = float(student.ppf(0.975, max(wheel.blocks - 1, 2)))
    half = wheel.error * quantile
    # a wheel that is smaller than assumed turns faster: the signs differ
    return Finding(
        name=name,
        channels=channels,
        run="",
        start_s=0.0,
        end_s=0.0,
        size=-100 * wheel.radius,
        low=-100 * (wheel.radius + half),
        high=-100 * (wheel.radius - half),
        unit="%",
        details=WheelRadius(vehicle_id=vehicle_id, until=until, ambiguous=len(channels) > 1),
        date=date,
    )


def _difference(wheel: Wheel, other: Wheel) -> Wheel:
    return Wheel(
        radius=wheel.radius - other.radius,
        error=float(np.hypot(wheel.error, other.error)),
        blocks=min(wheel.blocks, other.blocks),
    )


def _mean(level: list[Wheel]) -> Wheel:
    """Return the mean, weighted by the inverse variances."""
    weight = np.array([1.0 / wheel.error**2 for wheel in level])
    return Wheel(
        radius=float(np.sum(weight * [wheel.radius for wheel in level]) / weight.sum()),
        error=float(max(weight.sum() ** -0.5, _LEAST_ERROR)),
        blocks=sum(wheel.blocks for wheel in level),
    )


def _is_significant(wheel: Wheel, tests: int) -> bool:
    """Whether a radius differs from 0 by more than LEAST_RADIUS and chance.

    The probability ALPHA of a false alarm is shared among the tests.
    """
    quantile = float(student.ppf(1.0 - limit.ALPHA / tests / 2.0, max(wheel.blocks - 1, 2)))
    return abs(wheel.radius) - limit.LEAST_RADIUS > wheel.error * quantile
