"""The motor as its drive sees it: present speed and torque, set-points, demands, heat.

Speeds and torques are in counts of the bus (0.0001 rad/s, thousandths of the rated torque). They go
to the control loops of the tick in SI units, through the array of commands.
Source: CiA 402-2 / IEC 61800-7-201, bits 10 to 13 of the statusword by mode of operation.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from rollerrig.firmware_sim.cia301.objects import Objects, key
from rollerrig.firmware_sim.drive402 import demand, states
from rollerrig.firmware_sim.drive402 import objects as table
from rollerrig.wsp_interface import signals

# the array of commands of one drive
ENABLED = 0
LOOP = 1  # which control loop is active, one of those below
TORQUE_Nm = 2
VELOCITY_rad_s = 3
TORQUE_LIMIT_Nm = 4
COMMANDS = 5  # length of the array

LOOP_RIG = 0
LOOP_TORQUE = 1
LOOP_VELOCITY = 2
LOOP_STOP = 3  # a velocity loop; the simulated vehicle stops with its rollers


class Axis:
    """One motor.

    `commands`: float64 array of shape (COMMANDS,), which the axis writes before `on_command()`.
    """

    def __init__(
        self,
        objects: Objects,
        axle: int,
        row: np.ndarray,
        parameters: Mapping[str, float],
        commands: np.ndarray,
        on_command: Callable[[], None],
    ) -> None:
        self.objects = objects
        self.row = row
        self.commands = commands
        self.on_command = on_command
        self.demand = demand.Demand()
        self.heat = demand.Heat(parameters.get("thermal_time_constant_s", 0.0))
        self.dc_link_V = parameters["dc_link_V"]
        self.lowest_V = parameters["dc_link_min_V"]
        self._rated_Nm = parameters["rated_torque_Nm"]
        self._torque_column = signals.column("motor_torque", axle)
        self._speed_column = signals.column("roller_speed", axle)
        self._target_reached = demand.ConditionTimer()
        self._at_rest = demand.ConditionTimer()
        objects.attach(0x606B, read=lambda: integer(self.demand.velocity, "I32"))
        objects.attach(0x6074, read=lambda: integer(self.demand.torque, "I16"))
        # a motor with a constant torque per ampere: current in per mille of the rated one
        objects.attach(0x6078, read=objects.readers[key(0x6077, 0)])
        objects.attach(0x6079, read=lambda: integer(1000.0 * self.dc_link_V, "U32"))

    @property
    def voltage_is_low(self) -> bool:
        """Whether the DC link is below its lowest voltage."""
        return self.dc_link_V < self.lowest_V

    def actual(self) -> tuple[float, float]:
        """Return speed and torque of the motor, in counts of the bus (not rounded)."""
        speed = self.row.item(self._speed_column) / table.SPEED.scale
        torque = self.row.item(self._torque_column) / (table.TORQUE.scale * self._rated_Nm)
        if not math.isfinite(speed + torque):
            return 0.0, 0.0
        return speed, torque

    def is_at_rest(self) -> bool:
        """Return whether the speed of the motor is within the threshold 606Fh."""
        speed, _ = self.actual()
        return bool(abs(speed) <= self.objects.values[key(0x606F, 0)])

    def take_over(self) -> None:
        """Let the demands begin at the present speed and torque of the motor."""
        self.demand.take_over(*self.actual())

    def deceleration(self, option: int) -> float:
        """Return the deceleration for an option code: 1 is the slow-down ramp, else quick stop."""
        index = 0x6084 if option == 1 else 0x6085
        return float(self.objects.values[key(index, 0)])

    def warm(self, dt_s: float) -> None:
        """Advance the thermal load by `dt_s`."""
        self.heat.step(self.row.item(self._torque_column) / self._rated_Nm, dt_s)

    def set_points(self, mode: int, halt: bool) -> demand.SetPoints:
        """Return the present set-points and limits of the objects."""
        values = self.objects.values
        fastest = values[key(0x6080, 0)] / table.RPM_PER_RAD_S / table.SPEED.scale
        if mode == demand.PROFILE_VELOCITY:
            fastest = min(fastest, values[key(0x6081, 0)])
        return demand.SetPoints(
            mode=mode,
            target_velocity=values[key(0x60FF, 0)] + values[key(0x60B1, 0)],
            target_torque=values[key(0x6071, 0)] + values[key(0x60B2, 0)],
            acceleration=values[key(0x6083, 0)],
            deceleration=self.deceleration(values[key(0x605D, 0)] if halt else 1),
            torque_slope=values[key(0x6087, 0)],
            highest_velocity=fastest,
            highest_torque=values[key(0x6072, 0)],
        )

    def mode_bits(self, mode: int, halt: bool, now_ns: int) -> int:
        """Return bits 10, 12 and 13 of the statusword of an enabled drive."""
        speed, _ = self.actual()
        set_points = self.set_points(mode, halt)
        # evaluated in every mode, because it measures a time
        at_rest = self._within(self._at_rest, abs(speed), 0x606F, 0x6070, now_ns)
        bits = 0
        if mode == demand.PROFILE_VELOCITY:
            target = 0.0 if halt else set_points.target_velocity
            deviation = abs(speed - target)
            if self._within(self._target_reached, deviation, 0x606D, 0x606E, now_ns):
                bits |= states.TARGET_REACHED
            if at_rest:
                bits |= states.SPEED_ZERO
            max_slippage = self.objects.values[key(0x60F8, 0)]  # 0: not supervised
            if 0 < max_slippage < abs(self.demand.velocity - speed):
                bits |= states.SLIPPAGE
        elif mode == demand.PROFILE_TORQUE:
            target = 0.0 if halt else set_points.target_torque
            if self.demand.torque == target:
                bits |= states.TARGET_REACHED
        else:
            if not halt and self.demand.stopping is None:
                bits |= states.FOLLOWS
            if halt and at_rest:
                bits |= states.TARGET_REACHED
        return bits

    def _within(
        self,
        timer: demand.ConditionTimer,
        size: float,
        bound_index: int,
        time_index: int,
        now_ns: int,
    ) -> bool:
        """Return whether a size has been within a bound for a time; two objects hold these."""
        values = self.objects.values
        within_bound = size <= values[key(bound_index, 0)]
        return timer.holds(within_bound, values[key(time_index, 0)], now_ns)

    def publish(self, enabled: bool, local: bool, mode: int, stopped: bool = False) -> None:
        """Write the commands for the control loops, and call `on_command` if they have changed."""
        values = self.objects.values
        per_mille_Nm = table.TORQUE.scale * self._rated_Nm
        velocity = mode in demand.VELOCITY_MODES or self.demand.stopping is not None
        if stopped:
            loop = LOOP_STOP
        elif local:
            loop = LOOP_RIG
        elif velocity:
            loop = LOOP_VELOCITY
        else:
            loop = LOOP_TORQUE
        # in a velocity loop the torque is fed forward
        torque = values[key(0x60B2, 0)] if velocity else self.demand.torque
        commands = (
            float(enabled),
            float(loop),
            torque * per_mille_Nm,
            self.demand.velocity * table.SPEED.scale,
            values[key(0x6072, 0)] * per_mille_Nm,
        )
        if tuple(self.commands) != commands:
            self.commands[:] = commands
            self.on_command()


def integer(value: float, kind: str) -> int:
    """Return a number rounded, within the bounds of a type of the bus."""
    low, high = signals.KINDS[kind]
    return min(max(round(value), low), high)
