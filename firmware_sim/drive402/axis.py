"""The motor of a drive as the drive sees it: speed and torque of now, set-points, demands, heat.

Speeds and torques stand in counts of the bus (0.0001 rad/s, per mille of the rated torque) until
they go to the control loops of the tick, in SI units, through the array of commands. Source: CiA
402-2 / IEC 61800-7-201, bits 10 to 13 of the statusword by mode of operation.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from rollerrig.firmware_sim.cia301.objects import Objects, key
from rollerrig.firmware_sim.drive402 import demand, states
from rollerrig.firmware_sim.drive402 import objects as table
from rollerrig.wsp_interface import signals

# the array of commands of one drive; LOOP: what of it the control loop should follow
ENABLED, LOOP, TORQUE_Nm, VELOCITY_rad_s, TORQUE_LIMIT_Nm, COMMANDS = range(6)
# LOOP_STOP: a velocity loop as well, and the simulated vehicle stops with its rollers
LOOP_RIG, LOOP_TORQUE, LOOP_VELOCITY, LOOP_STOP = 0, 1, 2, 3


class Axis:
    """One motor. `commands`: float64 array of shape (COMMANDS,), written before `on_command()`."""

    def __init__(
        self,
        objects: Objects,
        axle: int,
        row: np.ndarray,
        parameters: Mapping[str, float],
        commands: np.ndarray,
        on_command: Callable[[], None],
    ) -> None:
        self.objects, self.row, self.commands, self.on_command = objects, row, commands, on_command
        self.demand = demand.Demand()
        self.heat = demand.Heat(parameters.get("thermal_time_constant_s", 0.0))
        self.dc_link_V, self.lowest_V = parameters["dc_link_V"], parameters["dc_link_min_V"]
        self._rated_Nm = parameters["rated_torque_Nm"]
        self._torque, self._speed = (
            signals.column("motor_torque", axle),
            signals.column("roller_speed", axle),
        )
        self._reached, self._at_rest = demand.Since(), demand.Since()
        objects.own(0x606B, read=lambda: integer(self.demand.velocity, "I32"))
        objects.own(0x6074, read=lambda: integer(self.demand.torque, "I16"))
        # a motor with a constant torque per ampere: current in per mille of the rated one
        objects.own(0x6078, read=objects.readers[key(0x6077, 0)])
        objects.own(0x6079, read=lambda: integer(1000.0 * self.dc_link_V, "U32"))

    @property
    def voltage_is_low(self) -> bool:
        """Whether the DC link is below its lowest voltage."""
        return self.dc_link_V < self.lowest_V

    def actual(self) -> tuple[float, float]:
        """Speed and torque of the motor, in counts of the bus (not rounded)."""
        speed, torque = self.row.item(self._speed), self.row.item(self._torque)
        counts = speed / table.SPEED.scale, torque / (table.TORQUE.scale * self._rated_Nm)
        return counts if math.isfinite(sum(counts)) else (0.0, 0.0)

    def rests(self) -> bool:
        """Whether the motor is slower than the threshold 606Fh."""
        return bool(abs(self.actual()[0]) <= self.objects.values[key(0x606F, 0)])

    def take_over(self) -> None:
        """The demands begin at what the motor does now."""
        self.demand.take_over(*self.actual())

    def deceleration(self, option: int) -> float:
        """The deceleration that an option code means: 1 the slow-down ramp, else quick stop."""
        return float(self.objects.values[key(0x6084 if option == 1 else 0x6085, 0)])

    def warm(self, dt_s: float) -> None:
        """Move the thermal load on by `dt_s`."""
        self.heat.step(self.row.item(self._torque) / self._rated_Nm, dt_s)

    def set_points(self, mode: int, halt: bool) -> demand.Set:
        """Set-points and limits as the objects have them now."""
        values = self.objects.values
        fastest = values[key(0x6080, 0)] / table.RPM_PER_RAD_S / table.SPEED.scale
        if mode == demand.PROFILE_VELOCITY:
            fastest = min(fastest, values[key(0x6081, 0)])
        return demand.Set(
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
        """Bits 10, 12 and 13 of the statusword of an enabled drive."""
        speed, given = self.actual()[0], self.set_points(mode, halt)
        slow = self._holds(self._at_rest, abs(speed), 0x606F, 0x6070, now_ns)
        if mode == demand.PROFILE_VELOCITY:
            away = abs(speed - (0.0 if halt else given.target_velocity))
            there = self._holds(self._reached, away, 0x606D, 0x606E, now_ns)
            slips = 0 < self.objects.values[key(0x60F8, 0)] < abs(self.demand.velocity - speed)
            return (
                there * states.TARGET_REACHED | slow * states.SPEED_ZERO | slips * states.SLIPPAGE
            )
        if mode == demand.PROFILE_TORQUE:
            return (
                self.demand.torque == (0.0 if halt else given.target_torque)
            ) * states.TARGET_REACHED
        follows = not halt and self.demand.stopping is None
        return follows * states.FOLLOWS | (halt and slow) * states.TARGET_REACHED

    def _holds(self, since: demand.Since, size: float, bound: int, time: int, now_ns: int) -> bool:
        """Whether a size has kept within the bound of one object for the time of another."""
        values = self.objects.values
        return since.holds(size <= values[key(bound, 0)], values[key(time, 0)], now_ns)

    def publish(self, enabled: bool, local: bool, mode: int, stopped: bool = False) -> None:
        """The commands follow the state and the demands; told only when they change."""
        values, per_mille_Nm = self.objects.values, table.TORQUE.scale * self._rated_Nm
        velocity = mode in demand.VELOCITY_MODES or self.demand.stopping is not None
        loop = LOOP_RIG if local else LOOP_VELOCITY if velocity else LOOP_TORQUE
        if stopped:
            loop = LOOP_STOP
        # in a speed loop the torque is what is fed forward
        torque = values[key(0x60B2, 0)] if velocity else self.demand.torque
        wanted = (
            float(enabled),
            float(loop),
            torque * per_mille_Nm,
            self.demand.velocity * table.SPEED.scale,
            values[key(0x6072, 0)] * per_mille_Nm,
        )
        if tuple(self.commands) != wanted:
            self.commands[:] = wanted
            self.on_command()


def integer(value: float, kind: str) -> int:
    """A number as an integer within the bounds of a type of the bus."""
    low, high = signals.KINDS[kind]
    return min(max(round(value), low), high)
