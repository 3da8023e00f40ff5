"""The demands of a drive that a master on the bus controls: ramps, limits, times and thermal load.

In profile modes the demand follows the target along a ramp. In cyclic modes the demand is the
target. A stop brings the demand to rest with a deceleration. The demand begins at the present speed
and torque of the motor, so that neither enabling nor a change of mode or master causes a jump.
Source: CiA 402-2, modes profile velocity (3), profile torque (4), cyclic synchronous velocity (9)
and torque (10).
"""

from typing import NamedTuple

# modes of operation, 6060h
PROFILE_VELOCITY = 3
PROFILE_TORQUE = 4
CYCLIC_VELOCITY = 9
CYCLIC_TORQUE = 10
MODES = (PROFILE_VELOCITY, PROFILE_TORQUE, CYCLIC_VELOCITY, CYCLIC_TORQUE)
VELOCITY_MODES = (PROFILE_VELOCITY, CYCLIC_VELOCITY)


class SetPoints(NamedTuple):
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
    if target >= value:
        return min(value + step, target)
    return max(value - step, target)


class Demand:
    """Velocity and torque demand, in counts of the bus.

    `stopping`: the deceleration of a stop in progress, else None. `limited`: a limit cuts the
    target.
    """

    def __init__(self) -> None:
        self.velocity = 0.0
        self.torque = 0.0
        self.limited = False
        self.stopping: float | None = None

    def take_over(self, velocity: float, torque: float) -> None:
        """Begin at the present velocity and torque of the motor."""
        self.velocity = velocity
        self.torque = torque
        self.stopping = None

    def step(self, set_points: SetPoints, halt: bool, dt_s: float) -> None:
        """Advance the demands by `dt_s`."""
        if self.stopping is not None:
            self.velocity = approach(self.velocity, 0.0, self.stopping * dt_s)
            self.limited = False
        elif set_points.mode in VELOCITY_MODES:
            self._velocity(set_points, halt, dt_s)
        else:
            self._torque(set_points, halt, dt_s)

    def _velocity(self, set_points: SetPoints, halt: bool, dt_s: float) -> None:
        target = self._limit(set_points.target_velocity, set_points.highest_velocity)
        if halt:
            self.velocity = approach(self.velocity, 0.0, set_points.deceleration * dt_s)
        elif set_points.mode == CYCLIC_VELOCITY:
            self.velocity = target
        else:
            same_direction = target * self.velocity >= 0
            faster = same_direction and abs(target) > abs(self.velocity)
            ramp = set_points.acceleration if faster else set_points.deceleration
            self.velocity = approach(self.velocity, target, ramp * dt_s)

    def _torque(self, set_points: SetPoints, halt: bool, dt_s: float) -> None:
        target = self._limit(set_points.target_torque, set_points.highest_torque)
        if set_points.mode == CYCLIC_TORQUE and not halt:
            self.torque = target
            return
        if halt:
            target = 0.0
        self.torque = approach(self.torque, target, set_points.torque_slope * dt_s)

    def _limit(self, target: float, bound: float) -> float:
        """Return the target within plus and minus `bound`; set `limited`."""
        cut = min(max(target, -bound), bound)
        self.limited = cut != target
        return cut


class ConditionTimer:
    """Measures how long a condition has been true, for windows and thresholds with a time."""

    def __init__(self) -> None:
        self.since_ns: int | None = None

    def holds(self, condition: bool, time_ms: int, now_ns: int) -> bool:
        """Return whether the condition has been true for at least `time_ms`."""
        if not condition:
            self.since_ns = None
            return False
        if self.since_ns is None:
            self.since_ns = now_ns
        return now_ns - self.since_ns >= time_ms * 1_000_000


class Heat:
    """Thermal load of the motor: first order in torque squared.

    The motor can bear a load of 1 for any time.
    """

    WARNING = 1.0
    TRIP = 1.2

    def __init__(self, time_constant_s: float) -> None:
        self.time_constant_s = time_constant_s
        self.load = 0.0

    def step(self, torque_fraction: float, dt_s: float) -> None:
        """Advance the load by `dt_s`; the torque is a fraction of the rated torque."""
        if self.time_constant_s > 0:
            self.load += (torque_fraction**2 - self.load) * min(dt_s / self.time_constant_s, 1.0)
