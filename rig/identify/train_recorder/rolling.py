"""Compares channels of one vehicle while its wheels roll: which is late, which goes by another wheel radius.

    [R1] v_i(t + d_i) = (1 + rho_i) V(t), V by the reference, else by the median of all speeds

rho_i is the recorder's radius over the wheel's own, less one, told as the error of the wheel speed. It is the median
over blocks in which nobody brakes hard; d_i makes the capped absolute error least, its interval comes from a bootstrap
over the same blocks. Channels of fewer than three cannot say which of two is wrong: both are named.
"""

from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from rollerrig.rig.identify.train_recorder import faults
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.recording import Channel, Finding, Run

_GRID_S = np.arange(-limit.LATEST_S, limit.LATEST_S + 0.01, 0.05)
_MOST = 20_000  # samples that decide a delay


class Aligned(NamedTuple):
    """A run on the stamps of one of its speeds: arrays (n,), `speed` (n, m) put right by delay and radius."""

    run: Run
    names: tuple[str, ...]
    time_s: np.ndarray
    speed: np.ndarray
    reference: np.ndarray
    position: np.ndarray
    demand: np.ndarray
    radius: dict[str, float]

    def as_recorded(self) -> "Aligned":
        """The same with the radius that the recorder takes."""
        scale = [1.0 + self.radius.get(name, 0.0) for name in self.names]
        return self._replace(speed=self.speed * scale, radius={})

    @property
    def vehicle(self) -> np.ndarray:
        """The vehicle's speed while wheels roll, m/s."""
        middle = faults.median(self.speed.T)
        return np.where(np.isfinite(self.reference), self.reference, middle)

    @property
    def step_s(self) -> float:
        return float(np.median(np.diff(self.time_s)))


def align(run: Run, delay_s: dict[str, float], radius: dict[str, float]) -> Aligned:
    """Channels with what is known of delay and radius taken off [R1]."""
    speeds = run.of("speed")
    base = max(
        speeds, key=lambda c: np.isfinite(c.values).sum() - 1e9 * (np.isfinite(c.values).sum() < 2)
    )
    time_s = base.time_s - delay_s.get(base.name, 0.0)

    def of(channel: Channel) -> np.ndarray:
        return faults.at(channel, time_s + delay_s.get(channel.name, 0.0)) / (
            1.0 + radius.get(channel.name, 0.0)
        )

    nothing = np.full(time_s.size, np.nan)
    one = {c.quantity: of(c) for c in run.of("reference", "position", "demand")}
    return Aligned(
        run,
        tuple(c.name for c in speeds),
        time_s,
        np.column_stack([of(c) for c in speeds]),
        one.get("reference", nothing),
        one.get("position", nothing),
        one.get("demand", nothing),
        radius,
    )


def slope(time_s: np.ndarray, values: np.ndarray, half_s: float = 1.0) -> np.ndarray:
    """Least-squares slope over two half windows; NaN where a third of it is missing."""
    good = np.isfinite(values)
    t = time_s - time_s[0]
    sums = [
        np.concatenate([[0.0], np.cumsum(np.where(good, one, 0.0))])
        for one in (np.ones(t.size), t, np.nan_to_num(values), t * np.nan_to_num(values), t * t)
    ]
    a, b = np.searchsorted(t, t - half_s), np.searchsorted(t, t + half_s, "right")
    n, x, y, xy, xx = (one[b] - one[a] for one in sums)
    spread = n * xx - x * x
    usual = max(2.0 * half_s / max(float(np.median(np.diff(t))), 1e-3), 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((n > 0.67 * usual) & (spread > 0.0), (n * xy - x * y) / spread, np.nan)


def quiet(a: Aligned) -> np.ndarray:
    """Where nobody brakes hard and wheels turn."""
    v = a.vehicle
    rests = np.abs(slope(a.time_s, v)) < limit.QUIET_M_S2
    most = np.nanmax(a.demand) if np.isfinite(a.demand).any() else 0.0
    return (
        rests
        & (v > limit.SLOWEST_M_S)
        & ~(np.nan_to_num(a.demand) > 0.4 * most if most > 0.0 else False)
    )


def fit(runs: list[Run]) -> tuple[list[Aligned], list[Finding]]:
    """Delays, then radii of each car and date, then all runs with both taken off."""
    delays: dict[str, float] = {}
    for _ in range(2):
        radii, told = _radii(runs, delays)
        delays, late = _delays(runs, radii)
    radii, told = _radii(runs, delays)
    return [
        align(run, delays, radius) for run, radius in zip(runs, radii, strict=True)
    ], late + told


# --- delays ---


def _delays(
    runs: list[Run], radii: list[dict[str, float]]
) -> tuple[dict[str, float], list[Finding]]:
    aligned = [align(run, {}, radius) for run, radius in zip(runs, radii, strict=True)]
    names = list(dict.fromkeys(name for a in aligned for name in a.names))
    given = {c.name: c for run in runs for c in run.of("speed", "reference")}
    reference = next((c.name for c in given.values() if c.quantity == "reference"), None)
    delays, found = {}, []
    rng = np.random.default_rng(1)

    def estimate(name: str, against: list[str]) -> tuple[float, float, float] | None:
        return _delay(aligned, radii, name, against, rng)

    def tell(name: str, got: tuple[float, float, float], than: str) -> None:
        allowed = max(given[name].delay_s, 0.0)
        if got[1] > allowed + limit.LATE_S or (
            got[2] < -limit.LATE_S and len(names) > 2 and name != reference
        ):
            delays[name] = got[0]
            word = "late" if got[0] > 0 else "early"
            found.append(
                Finding(
                    "speed_sensor_delay", (name,), "", 0.0, 0.0, *got, "s", f"{word} against {than}"
                )
            )
        elif name == reference or abs(got[0]) > limit.LATE_S:
            delays[name] = got[0]  # as expected of it: taken off, not named

    if len(names) == 2:
        if (got := estimate(names[0], names[1:])) is not None:
            name = names[0] if got[0] > 0 else names[1]
            got = got if got[0] > 0 else (-got[0], -got[2], -got[1])
            if got[1] > limit.LATE_S:
                tell(name, got, (set(names) - {name}).pop())
    elif len(names) > 2:
        for name in names:
            if (got := estimate(name, names)) is not None and (
                got[1] > limit.LATE_S or got[2] < -limit.LATE_S
            ):
                tell(name, got, "the other speeds")
    if reference:
        right = [name for name in names if name not in delays]
        if right and (got := estimate(reference, right)) is not None:
            if got[2] < -limit.LATE_S and len(right) == 1:
                tell(right[0], (-got[0], -got[2], -got[1]), reference)
            else:
                tell(reference, got, "the wheels")
    return delays, found


def _delay(
    aligned: list[Aligned],
    radii: list[dict[str, float]],
    name: str,
    against: list[str],
    rng: np.random.Generator,
) -> tuple[float, float, float] | None:
    """How late a channel is against the median of some, with its 95 % interval; None where nothing changes."""
    costs, weight = [], []
    total = sum(a.time_s.size for a in aligned)
    for a, radius in zip(aligned, radii, strict=True):
        if name not in a.run.channels:
            continue
        base = faults.median(
            np.array([a.speed[:, a.names.index(one)] for one in against if one in a.names])
        )
        moving = np.abs(slope(a.time_s, base)) > 0.15
        pick = np.flatnonzero(moving & (base > limit.SLOWEST_M_S))[:: max(total // _MOST, 1)]
        if pick.size < 50:
            continue
        channel, t = a.run.channels[name], a.time_s[pick]
        scale = 1.0 + radius.get(name, 0.0)
        off = np.abs(faults.at(channel, t + _GRID_S[:, None]) / scale - base[pick])
        off = np.where(np.isfinite(off), np.minimum(off, limit.CAP_M_S), np.nan)
        whole = np.isfinite(off).all(axis=0)
        block = ((t - a.time_s[0]) // limit.BLOCK_S).astype(int)[whole]
        if block.size < 50:
            continue
        _, own = np.unique(block, return_inverse=True)
        costs += list(np.array([np.bincount(own, row[whole]) for row in off]).T)
        weight.append(block.size)
    if len(costs) < limit.LEAST_BLOCKS:
        return None
    blocks = np.array(costs)
    picked = blocks[rng.integers(0, len(blocks), (300, len(blocks)))].sum(axis=1)
    best = _least(blocks.sum(axis=0)[None])[0]
    low, high = np.quantile(_least(picked), (0.025, 0.975))
    return float(best), float(min(low, best) - 0.05), float(max(high, best) + 0.05)


def _least(cost: np.ndarray) -> np.ndarray:
    """Delay of the least cost of each row, a parabola through its three lowest points."""
    k = np.clip(np.argmin(cost, axis=1), 1, cost.shape[1] - 2)
    row = np.arange(len(cost))
    before, here, after = cost[row, k - 1], cost[row, k], cost[row, k + 1]
    bend = before - 2.0 * here + after
    return _GRID_S[k] + 0.05 * np.where(
        bend > 0.0, 0.5 * (before - after) / np.where(bend > 0.0, bend, 1.0), 0.0
    )


# --- radii ---


class Wheel(NamedTuple):
    radius: float
    error: float
    blocks: int


def _radii(
    runs: list[Run], delays: dict[str, float]
) -> tuple[list[dict[str, float]], list[Finding]]:
    """rho of each speed in each run, and what of it is beyond chance."""
    aligned = [align(run, delays, {}) for run in runs]
    groups: dict[tuple[str, str], list[Aligned]] = {}
    for a in aligned:
        groups.setdefault((a.run.vehicle_id, a.run.date), []).append(a)
    known: dict[str, dict[str, dict[str, Wheel]]] = {}
    for (car, date), mine in sorted(groups.items()):
        for name, wheel in wheels(mine).items():
            known.setdefault(car, {}).setdefault(name, {})[date] = wheel
    tried = max(sum(len(dates) for names in known.values() for dates in names.values()), 1)
    found, taken = [], {}
    for car, names in known.items():
        pair = len(names) == 2 and not any(
            np.isfinite(a.reference).any() for a in aligned if a.run.vehicle_id == car
        )
        for name, dates in list(names.items())[: 1 if pair else None]:
            channels = tuple(names) if pair else (name,)
            more, levels = _told(channels, car, dates, tried)
            found += more
            taken.update({(car, name, date): level for date, level in levels.items()})
    return [
        {name: taken.get((run.vehicle_id, name, run.date), 0.0) for name in run.channels}
        for run in runs
    ], found


def wheels(group: list[Aligned]) -> dict[str, Wheel]:
    """rho of each speed over the runs of one car and date [R1]."""
    blocks: dict[str, list[float]] = {}
    least: dict[str, float] = {}
    for a in group:
        v, still = a.vehicle, quiet(a)
        if len(a.names) == 2 and not np.isfinite(a.reference).any():
            v = a.speed[:, 1]
        elif len(a.names) == 1 and not np.isfinite(a.reference).any():
            continue
        block = ((a.time_s - a.time_s[0]) // limit.BLOCK_S).astype(int)
        for j, name in enumerate(a.names):
            good = still & np.isfinite(a.speed[:, j]) & np.isfinite(v)
            for k in np.unique(block[good]):
                own = good & (block == k)
                if own.sum() * a.step_s > 0.4 * limit.BLOCK_S:
                    blocks.setdefault(name, []).append(
                        float(a.speed[own, j].sum() / v[own].sum()) - 1.0
                    )
            rounding = a.run.channels[name].quantum / np.sqrt(12.0)
            distinct = max(np.unique(a.speed[good, j]).size, 1)
            if good.any():
                least[name] = max(
                    least.get(name, 0.0), rounding / float(np.mean(v[good])) / np.sqrt(distinct)
                )
    found = {}
    for name, shares in blocks.items():
        if len(shares) >= limit.LEAST_BLOCKS:
            middle = float(np.median(shares))
            spread = 1.4826 * float(np.median(np.abs(np.array(shares) - middle)))
            error = float(np.hypot(1.2533 * spread / np.sqrt(len(shares)), least[name])) + 1e-4
            found[name] = Wheel(middle, error, len(shares))
    return found


def _told(
    channels: tuple[str, ...], car: str, dates: dict[str, Wheel], tried: int
) -> tuple[list[Finding], dict[str, float]]:
    """Radius of one speed and its steps; dates that agree make one level."""
    levels: list[list[tuple[str, Wheel]]] = []
    for date, wheel in dates.items():
        before = _mean([one for _, one in levels[-1]]) if levels else wheel
        if levels and not _beyond(_less(wheel, before), tried):
            levels[-1].append((date, wheel))
        else:
            levels.append([(date, wheel)])
    means = [_mean([one for _, one in level]) for level in levels]
    of_car, found = f" of {car}" if car else "", []
    if _beyond(means[0], tried):
        until = f" until {levels[0][-1][0]}" if len(levels) > 1 else ""
        found.append(
            _finding(
                "wheel_radius",
                channels,
                means[0],
                levels[0][0][0],
                f"the wheels{of_car} have another radius than the recorder takes{until}",
            )
        )
    for level, before, mean in zip(levels[1:], means, means[1:], strict=False):
        found.append(
            _finding(
                "wheel_radius_step",
                channels,
                _less(mean, before),
                level[0][0],
                f"the radius of the wheels{of_car} steps on {level[0][0] or 'a date that is not given'}: "
                "turned wheels or a changed setting",
            )
        )
    return found, {
        date: mean.radius if found else 0.0
        for level, mean in zip(levels, means, strict=True)
        for date, _ in level
    }


def _finding(name: str, channels: tuple[str, ...], wheel: Wheel, date: str, text: str) -> Finding:
    # a wheel that is smaller than told turns faster
    half = wheel.error * float(student.ppf(0.975, max(wheel.blocks - 1, 2)))
    text += "; which of the two it is cannot be told" if len(channels) > 1 else ""
    return Finding(
        name,
        channels,
        "",
        0.0,
        0.0,
        -100 * wheel.radius,
        -100 * (wheel.radius + half),
        -100 * (wheel.radius - half),
        "%",
        text,
        date,
    )


def _less(one: Wheel, other: Wheel) -> Wheel:
    return Wheel(
        one.radius - other.radius,
        float(np.hypot(one.error, other.error)),
        min(one.blocks, other.blocks),
    )


def _mean(level: list[Wheel]) -> Wheel:
    weight = np.array([1.0 / wheel.error**2 for wheel in level])
    return Wheel(
        float(np.sum(weight * [wheel.radius for wheel in level]) / weight.sum()),
        float(max(weight.sum() ** -0.5, 1e-4)),
        sum(wheel.blocks for wheel in level),
    )


def _beyond(wheel: Wheel, tried: int) -> bool:
    reach = float(student.ppf(1.0 - limit.ALPHA / tried / 2.0, max(wheel.blocks - 1, 2)))
    return abs(wheel.radius) - limit.LEAST_RADIUS > wheel.error * reach
