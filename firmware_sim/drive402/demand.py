"""What a drive under control of the bus asks of its motor: ramps, limits and the bits that tell.

In profile modes the demand follows the target along a ramp, in cyclic modes it is the target; a
stop takes the demand to rest along a deceleration. The demand begins at what the motor does now, so
that neither enabling nor a change of mode or of master makes a jump. Source: CiA 402-2, modes
profile velocity (3), profile torque (4), cyclic synchronous velocity (9) and torque (10).
"""

from typing import NamedTuple

PROFILE_VELOCITY, PROFILE_TORQUE, CYCLIC_VELOCITY, CYCLIC_TORQUE = 3, 4, 9, 10
MODES = (PROFILE_VELOCITY, PROFILE_TORQUE, CYCLIC_VELOCITY, CYCLIC_TORQUE)
VELOCITY_MODES = (PROFILE_VELOCITY, CYCLIC_VELOCITY)


class Set(NamedTuple):
    """Set-points and limits in counts of the bus: speeds 0.0001 rad/s, torques per mille."""

    mode: int
    target_velocity: float
    target_torque: float
    acceleration: float
    deceleration: float
    torque_slope: float
    highest_velocity: float
    highest_torque: float


def approach(value: float, target: float, step: float) -> float:
    """`value` moved towards `target` by at most `step`."""
    return min(value + step, target) if target >= value else max(value - step, target)


class Demand:
    """Velocity and torque demand. `stopping`: the deceleration of a stop under way, or None."""

    def __init__(self) -> None:
        self.velocity = self.torque = 0.0
        self.limited = False
        self.stopping: float | None = None

    def take_over(self, velocity: float, torque: float) -> None:
        """Begin at what the motor does now."""
        self.velocity, self.torque, self.stopping = velocity, torque, None

    def step(self, given: Set, halt: bool, dt_s: float) -> None:
        """Move the demands on by `dt_s`."""
        if self.stopping is not None:
            self.velocity = approach(self.velocity, 0.0, self.stopping * dt_s)
            self.limited = False
        elif given.mode in VELOCITY_MODES:
            self._velocity(given, halt, dt_s)
        else:
            self._torque(given, halt, dt_s)

    def _velocity(self, given: Set, halt: bool, dt_s: float) -> None:
        target = self._limit(given.target_velocity, given.highest_velocity)
        if halt:
            self.velocity = approach(self.velocity, 0.0, given.deceleration * dt_s)
        elif given.mode == CYCLIC_VELOCITY:
            self.velocity = target
        else:
            faster = abs(target) > abs(self.velocity) and target * self.velocity >= 0
            ramp = given.acceleration if faster else given.deceleration
            self.velocity = approach(self.velocity, target, ramp * dt_s)

    def _torque(self, given: Set, halt: bool, dt_s: float) -> None:
        target = self._limit(given.target_torque, given.highest_torque)
        if given.mode == CYCLIC_TORQUE and not halt:
            self.torque = target
        else:
            self.torque = approach(self.torque, 0.0 if halt else target, given.torque_slope * dt_s)

    def _limit(self, target: float, bound: float) -> float:
        """The target inside plus and minus `bound`; `limited` tells whether it had to be cut."""
        cut = min(max(target, -bound), bound)
        self.limited = cut != target
        return cut


class Since:
    """For how long something has been so: windows and thresholds with a time."""

    def __init__(self) -> None:
        self.since_ns: int | None = None

    def holds(self, so: bool, time_ms: int, now_ns: int) -> bool:
        """Whether `so` has been true for at least `time_ms`."""
        if not so:
            self.since_ns = None
        elif self.since_ns is None:
            self.since_ns = now_ns
        return self.since_ns is not None and now_ns - self.since_ns >= time_ms * 1_000_000


class Heat:
    """Thermal load of the motor, 1 is what it bears for ever: first order in torque squared."""

    WARNING, TRIP = 1.0, 1.2

    def __init__(self, time_constant_s: float) -> None:
        self.time_constant_s, self.load = time_constant_s, 0.0

    def step(self, torque_fraction: float, dt_s: float) -> None:
        """Move the load on by `dt_s` at a torque given as a fraction of the rated one."""
        if self.time_constant_s > 0:
            self.load += (torque_fraction**2 - self.load) * min(dt_s / self.time_constant_s, 1.0)
