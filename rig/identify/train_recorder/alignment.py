"""A run on the stamps of one of its speeds, with delays, scales and offsets corrected.

[R1] v_i(t + d_i) = (1 + rho_i) V(t) + c_i, V by the reference, else by the median of all speeds
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.recording import Channel, Run

# share of a block that must have values
_FILLED_SHARE = 0.4

# share of the greatest brake demand. Above it the vehicle brakes hard.
_HARD_DEMAND_SHARE = 0.4


class Scale(NamedTuple):
    """Ratio rho and offset of a channel [R1]."""

    ratio: float = 0.0
    offset_m_s: float = 0.0

    def corrected(self, values: np.ndarray) -> np.ndarray:
        """Return the true speed of recorded values.

        A sensor that stands, or that is below its lowest speed, reads 0: the true speed is not
        negative because of an offset.
        """
        speed = (values - self.offset_m_s) / (1.0 + self.ratio)
        return np.where((values >= 0.0) & (speed < 0.0), 0.0, speed)

    def recorded(self, speed: np.ndarray) -> np.ndarray:
        """Return the values that a recorder has for a true speed."""
        return (1.0 + self.ratio) * speed + self.offset_m_s


AS_RECORDED = Scale()


class Aligned(NamedTuple):
    """A run on the stamps of one of its speeds: arrays (n,), `speed` (n, m), SI units.

    Delays and scales are corrected. Missing channels are NaN.
    """

    run: Run
    names: tuple[str, ...]  # of the columns of `speed`
    time_s: np.ndarray
    speed: np.ndarray
    reference: np.ndarray
    position: np.ndarray
    demand: np.ndarray
    yaw_rad_s: np.ndarray
    scale: dict[str, Scale]  # that is corrected, by channel
    block_s: float  # blocks of this length count as independent
    slowest_m_s: float  # lowest speed at which the channels are compared, by the worst of them
    noise_m_s: tuple[float, ...]  # standard error of a sample of each speed
    reference_noise_m_s: float
    timing_s: float = 0.0  # by which the stamps of wheels and vehicle may differ after correction

    def as_recorded(self) -> "Aligned":
        """The same run with the scales that the recorder assumes."""
        columns = [
            self.scale.get(name, AS_RECORDED).recorded(values)
            for name, values in zip(self.names, self.speed.T, strict=True)
        ]
        return self._replace(speed=np.column_stack(columns), scale={})

    def part(self, start: int, end: int) -> "Aligned":
        """The samples from `start` to before `end`."""
        part = slice(start, end)
        return self._replace(
            time_s=self.time_s[part],
            speed=self.speed[part],
            reference=self.reference[part],
            position=self.position[part],
            demand=self.demand[part],
            yaw_rad_s=self.yaw_rad_s[part],
        )

    @property
    def vehicle(self) -> np.ndarray:
        """Speed of the vehicle while wheels roll, m/s."""
        middle = sampling.median(self.speed.T)
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
        """Number of the block of each sample."""
        return ((self.time_s - self.time_s[0]) // self.block_s).astype(int)

    def is_filled(self, samples: np.ndarray) -> bool:
        """Whether enough samples of a block are flagged."""
        return bool(samples.sum() * self.step_s > _FILLED_SHARE * self.block_s)


def align(run: Run, delay_s: dict[str, float], scale: dict[str, Scale], block_s: float) -> Aligned:
    """Return a run with the known delays and scales of its channels corrected [R1]."""
    speeds = run.of("speed")
    base = max(speeds, key=lambda channel: np.isfinite(channel.values).sum())
    time_s = base.time_s - delay_s.get(base.name, 0.0)

    def corrected(channel: Channel) -> np.ndarray:
        values = sampling.at(channel, time_s + delay_s.get(channel.name, 0.0))
        return scale.get(channel.name, AS_RECORDED).corrected(values)

    lowest_m_s = []
    for channel in run.of("speed", "reference"):
        resolution_m_s = max(channel.quantum, channel.deadband_m_s)
        lowest_m_s.append(limit.slowest_m_s(channel.noise, resolution_m_s, run.fastest_m_s))
    reference_noise_m_s = [channel.error for channel in run.of("reference")]
    nothing = np.full(time_s.size, np.nan)
    others = {
        channel.quantity: corrected(channel)
        for channel in run.of("reference", "position", "demand", "yaw")
    }
    return Aligned(
        run=run,
        names=tuple(channel.name for channel in speeds),
        time_s=time_s,
        speed=np.column_stack([corrected(channel) for channel in speeds]),
        reference=others.get("reference", nothing),
        position=others.get("position", nothing),
        demand=others.get("demand", nothing),
        yaw_rad_s=others.get("yaw", nothing),
        scale=scale,
        block_s=block_s,
        slowest_m_s=max(lowest_m_s),
        noise_m_s=tuple(channel.error for channel in speeds),
        reference_noise_m_s=max(reference_noise_m_s, default=0.0),
    )


def block_length_s(runs: list[Run]) -> float:
    """Return the length of independent blocks, from the length and the rate of all runs."""
    duration_s = 0.0
    step_s = 0.0
    for run in runs:
        speed = run.of("speed")[0]
        duration_s += speed.step_s * speed.values.size
        step_s = max(step_s, speed.step_s)
    return limit.block_s(duration_s, step_s)


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
    # at low rates a window has to hold several samples
    half_s = max(1.0, 2.5 * a.step_s)
    is_steady = np.abs(slope(a.time_s, v, half_s)) < limit.QUIET_M_S2
    turns = v > a.slowest_m_s
    return is_steady & turns & ~_brakes_hard(a)


def _brakes_hard(a: Aligned) -> np.ndarray:
    """Return where the brake demand is high, flags (n,); nowhere if no demand is recorded."""
    known = np.isfinite(a.demand)
    most = np.nanmax(a.demand) if known.any() else 0.0
    if most <= 0.0:
        return np.zeros(a.time_s.size, bool)
    return np.nan_to_num(a.demand) > _HARD_DEMAND_SHARE * most


def base_speed(a: Aligned) -> np.ndarray | None:
    """Return the speed to compare with: the vehicle's or the second of two; None for one speed."""
    if not a.has_reference:
        if len(a.names) == 1:
            return None
        if len(a.names) == 2:
            return a.speed[:, 1]
    return a.vehicle
