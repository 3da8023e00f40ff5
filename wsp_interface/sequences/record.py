"""The data of a sequence that was played, and the part of the braking that counts for a measure.

The braking lasts from the first brake demand to standstill, or to the end. A limit may judge only
the part of it at some speeds: its bounds are `above_m_s` and `below_m_s`. A row counts if the
vehicle is faster than the first and not faster than the second. A step, from a row to the next one,
counts if its first row does. So the distance above a speed and the distance below it are together
the stopping distance.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from rollerrig.configs.vehicle import Kind, kind_of
from rollerrig.wsp_interface import braking, events
from rollerrig.wsp_interface.diagnosis import VENTS, Diagnosis, Sample

LOCKED_M_S = 0.1  # a wheelset with a slower rim is locked
# near standstill a rolling wheel is slower than that, too: then the rim of a locked wheelset is
# slower than this share of the vehicle's speed
LOCKED_SHARE = 0.1
NAN = float("nan")


@dataclass(frozen=True)
class Record:
    """The data of a sequence that was played.

    columns: values by name, shape (n,), one for each bus cycle.
    demands: the commanded brake demands, as (time in s, pressure in Pa).
    finals: signals that were read at the end.
    scenario: the resolved scenario.
    dry_m: distance of the dry stop; NaN if there is none.
    fault_s: time of the first fault; NaN if there is none.
    above_m_s, below_m_s: the speeds of the vehicle that count; infinite where there is no bound.
    train: the summary of a train; empty for one vehicle. The axles of a train count through.
    """

    columns: Mapping[str, np.ndarray]
    demands: tuple[tuple[float, float], ...]
    finals: Mapping[str, tuple[float, ...]]
    scenario: Mapping[str, Any]
    dry_m: float = NAN
    fault_s: float = NAN
    above_m_s: float = -math.inf
    below_m_s: float = math.inf
    train: Mapping[str, Any] = field(default_factory=dict)

    def between(self, above_m_s: float, below_m_s: float) -> "Record":
        """Return the record, of which only these speeds of the vehicle count."""
        return replace(self, above_m_s=above_m_s, below_m_s=below_m_s)

    @cached_property
    def kind(self) -> Kind:
        """The kind of the vehicle."""
        return kind_of(self.scenario, "the scenario")

    @property
    def axles(self) -> range:
        """The axles of the vehicle or train, counted from 1."""
        return range(1, (len(self.train["axles"]) if self.train else self.kind.axles) + 1)

    @property
    def bounded(self) -> bool:
        """Whether only some speeds of the vehicle count."""
        return math.isfinite(self.above_m_s) or math.isfinite(self.below_m_s)

    @cached_property
    def braking(self) -> slice:
        """The rows from the first brake demand to standstill, or to the end."""
        begin = braking.begin(self.columns["brake_demand_Pa"]) or 0
        standstill = braking.standstill(self.columns["vehicle_speed_m_s"], begin)
        end = len(self.columns["time_s"]) if standstill is None else standstill + 1
        return slice(begin, end)

    @cached_property
    def counts(self) -> np.ndarray:
        """Which rows of the braking count, shape (n,)."""
        speed_m_s = self.columns["vehicle_speed_m_s"][self.braking]
        return (speed_m_s > self.above_m_s) & (speed_m_s <= self.below_m_s)

    @property
    def stands(self) -> bool:
        """Whether the braking ends with standstill."""
        return float(self.whole("vehicle_speed_m_s")[-1]) <= braking.STANDS_M_S

    @property
    def slow_enough(self) -> bool:
        """Whether the vehicle has become as slow as the lower bound of speed, or stands."""
        last_m_s = float(self.whole("vehicle_speed_m_s")[-1])
        return last_m_s <= max(self.above_m_s, braking.STANDS_M_S)

    def whole(self, name: str) -> np.ndarray:
        """Return a column over the whole braking, shape (n,)."""
        return self.columns[name][self.braking]

    def braked(self, name: str) -> np.ndarray:
        """Return a column over the rows of the braking that count, shape (m,)."""
        return self.whole(name)[self.counts]

    def steps(self, name: str) -> np.ndarray:
        """Return the change of a column in each step of the braking, shape (n - 1,).

        It is 0 in steps that do not count.
        """
        return np.where(self.counts[:-1], np.diff(self.whole(name)), 0.0)

    def wheelsets(self, name: str, unit: str = "") -> np.ndarray:
        """Return a signal of every wheelset over the rows that count, shape (axles, m)."""
        return self.wheelsets_whole(name, unit)[:, self.counts]

    def wheelsets_whole(self, name: str, unit: str = "") -> np.ndarray:
        """Return a signal of every wheelset over the whole braking, shape (axles, n)."""
        return np.array([self.whole(f"{name}_{axle}{unit}") for axle in self.axles])

    @cached_property
    def locked(self) -> np.ndarray:
        """Where each wheelset is locked at a speed that counts, shape (axles, n).

        The rows are those of the whole braking. Without bounds of speed, locks count above
        `rig.lock_above_m_s`, as in the rig; with bounds, at every speed between them.
        """
        speed_m_s = self.whole("vehicle_speed_m_s")
        rim_m_s = self.wheelsets_whole("wheel_circumferential_speed", "_m_s")
        return self.fast & (rim_m_s < np.minimum(LOCKED_M_S, LOCKED_SHARE * speed_m_s))

    @cached_property
    def fast(self) -> np.ndarray:
        """Where a lock or a deep slide counts over the whole braking, shape (n,)."""
        if self.bounded:
            return self.counts
        return self.whole("vehicle_speed_m_s") > self.scenario["rig"]["lock_above_m_s"]

    @cached_property
    def begun_vents(self) -> np.ndarray:
        """How often the dump valve of each axle began to vent at a speed that counts, (axles,)."""
        vents = self.wheelsets_whole("valve") > VENTS
        begins = vents[:, 1:] & ~vents[:, :-1] & self.counts[1:]
        return begins.sum(axis=1)

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """What the rows that count show of the unit's wiring and reference speed."""
        found = Diagnosis(self.kind, events.ignore)
        samples = zip(
            self.whole("time_s").tolist(),
            self.whole("vehicle_speed_m_s").tolist(),
            self.wheelsets_whole("sliding", "_m_s").T.tolist(),
            self.wheelsets_whole("valve").T.tolist(),
            self.whole("wsp_reference_speed_m_s").tolist(),
            self.whole("brake_demand_Pa").tolist(),
            strict=True,
        )
        for values, counts in zip(samples, self.counts.tolist(), strict=True):
            look = found.look if counts else found.skip
            look(Sample(*values))
        return found
