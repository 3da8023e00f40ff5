"""A roller drive, nodes 1 to 4: the CiA 402 state machine around the motor of one roller.

Either the bench's own rig control moves the motor: then the drive is walked to OPERATION ENABLED
from inside, tells so with bit 9 (remote) cleared, and does not obey controlwords. Or a master on
the bus does: then states, option codes, ramps and modes are the standard's, and the demands stand
in the array of commands for the control loops of the tick. Whoever has it, an emergency stop makes a
quick stop of it, and bars it from being enabled until it is taken back. Source: CiA 402-2 / IEC 61800-7-201.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301 import nmt
from rollerrig.firmware_sim.cia301.communication import Profile
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError, key
from rollerrig.firmware_sim.drive402 import objects as table
from rollerrig.firmware_sim.drive402 import states
from rollerrig.firmware_sim.drive402.axis import COMMANDS, Axis, integer
from rollerrig.firmware_sim.drive402.demand import CYCLIC_TORQUE, MODES, Heat
from rollerrig.firmware_sim.drive402.states import Command, State, Transition
from rollerrig.wsp_interface.bus.frames import S_NS
from rollerrig.wsp_interface.events import Code

HEARTBEAT_FAULT, OVER_TEMPERATURE, UNDER_VOLTAGE = 0x8130, 0x4310, 0x3220
_QUICK_STOP, _REACTION, _ABORT = 0x605A, 0x605E, 0x6007
# option codes of the transitions that may brake first
_RAMPS = {5: 0x605C, 8: 0x605B}
# option codes above this leave the drive in QUICK STOP ACTIVE
_LAST_LEAVING_OPTION = 4
# the way to OPERATION ENABLED, which an emergency stop bars
_ENABLING = (Command.SHUTDOWN, Command.SWITCH_ON, Command.ENABLE_OPERATION)


def build(
    node_id: int,
    axle: int,
    row: np.ndarray,
    parameters: Mapping[str, float] | None = None,
    commands: np.ndarray | None = None,
    on_command: Callable[[], None] = lambda: None,
    control: str = "rig",
    storage: Path | None = None,
) -> Node:
    """The node of the drive under `axle` (from 1).

    `row`: live float64 array of all signals; `parameters` as in `objects.DEFAULTS`; `commands`: float64 array of
    shape (COMMANDS,) written before `on_command()` is called; `control`: "rig" or "bus".
    """
    parameters = table.DEFAULTS | dict(parameters or {})
    profile = Profile(table.DEVICE_TYPE, f"roller drive {axle}", table.RPDOS, table.TPDOS)
    node = process_image.build(
        node_id,
        profile,
        ("roller drive", table.PRODUCT_CODE),
        table.rows(axle, parameters),
        row,
        parameters,
        axle,
        storage,
    )
    commands = np.zeros(COMMANDS) if commands is None else commands
    node.commands = table.COMMANDS
    axis = Axis(node.objects, axle, row, parameters, commands, on_command)
    node.device = Drive(node, axis, control == "rig")
    return node


class Drive:
    """State machine and demands of one drive.

    `local`: the rig control has it; `stopped`: an emergency stop holds it; `_then`: the state to enter
    when a ramp has come to rest, and the number of the transition.
    """

    def __init__(self, node: Node, axis: Axis, local: bool) -> None:
        self.node, self.axis, self.demand, self.local = node, axis, axis.demand, local
        self.state, self.stopped = State.NOT_READY_TO_SWITCH_ON, False
        self.word = self.before = self.mode = self.error = self._last_ns = 0
        self._then: tuple[State, int] | None = None
        own = node.objects.own
        own(0x6041, read=lambda: self.word)
        own(0x6061, read=lambda: self.mode)
        own(0x603F, read=lambda: self.error)
        own(0x2000, read=lambda: int(not self.local), effect=self._take_source)
        own(0x6040, effect=self.on_controlword)
        own(0x6060, check=_check_mode, effect=lambda _: self._take_mode())
        node.on_reset.append(self._on_reset)
        node.on_power_off += [self._on_reset, self._publish]
        node.on_poll.append(self.step)
        node.on_state.append(self._on_nmt)
        node.on_partner.append(self._on_partner)

    def control_from_rig(self) -> None:
        """The rig control moves the motor from now on; a fault has to be reset first."""
        self.local, self._then, self.demand.stopping = True, None, None
        self._take_mode()
        if self.state is State.QUICK_STOP_ACTIVE:
            self._obey(Command.DISABLE_VOLTAGE)
        for command in _ENABLING:
            self._obey(command)
        self._publish()

    def control_from_bus(self) -> None:
        """A master on the bus moves the motor from now on, beginning at the torque of now."""
        values = self.node.objects.values
        self.local = False
        self.axis.take_over()
        values[key(0x6071, 0)] = integer(self.demand.torque, "I16")
        values[key(0x60FF, 0)] = integer(self.demand.velocity, "I32")
        self.before = values[key(0x6040, 0)]
        self._take_mode()
        self._publish()

    def emergency_stop(self, on: bool) -> None:
        """Begin an emergency stop (the motor brakes as 605Ah says, and is off when it stands), or take it back."""
        if on == self.stopped:
            return
        self.stopped = on
        if on:
            self._obey(Command.QUICK_STOP)
        elif self.local:
            self.control_from_rig()
        self._publish()

    def _take_source(self, bus: int) -> None:
        if bool(bus) == self.local:
            (self.control_from_bus if bus else self.control_from_rig)()

    @property
    def enabled(self) -> bool:
        """Whether the motor is powered."""
        stops = self.state in (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
        return self.state is State.OPERATION_ENABLED or (stops and self.demand.stopping is not None)

    def on_controlword(self, word: int) -> None:
        """A controlword has been written."""
        command, self.before = states.command_of(word, self.before), word
        if not self.local and command is not None:
            self._obey(command)
        self._publish()

    def trip(self, code: int, text: str) -> None:
        """A fault: transition 13, the reaction that 605Eh asks for, then FAULT."""
        if self.state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            return
        was_enabled, self.error = self.enabled, code
        self._enter(State.FAULT_REACTION_ACTIVE, states.FAULT_DETECTED)
        self.node.event(Code.DRIVE_FAULT, error_code=code, reason=text)
        self.node.emergency.report(code)
        option = self._option(_REACTION)
        if was_enabled and option != 0 and not self.local:
            self._brake(self.axis.deceleration(option), (State.FAULT, states.REACTION_COMPLETED))
        else:
            self._enter(State.FAULT, states.REACTION_COMPLETED)
        self._publish()

    def recover(self) -> None:
        """Reset a fault (transition 15) and enable the drive again, if the rig control has it."""
        if self.local:
            self._obey(Command.FAULT_RESET)
            self.control_from_rig()

    def _obey(self, command: Command) -> None:
        if self.stopped and command in _ENABLING:
            return
        # enabling from ready takes two transitions, every other command at most one
        for _ in range(2):
            row = states.FROM_COMMAND.get((self.state, command))
            if row is not None:
                self._perform(row)
            elif (
                command is Command.ENABLE_OPERATION
                and self.state is State.OPERATION_ENABLED
                and self.demand.stopping is not None
            ):
                # a stop that is under way is cancelled
                self.axis.take_over()
                self._then = None

    def _perform(self, row: Transition) -> None:
        if row.number == 16 and self._option(_QUICK_STOP) <= _LAST_LEAVING_OPTION:
            return
        if row.number == 15:
            self.node.emergency.clear(self.error)
            self.error = 0
        if row.number in _RAMPS and self._option(_RAMPS[row.number]) and not self.local:
            self._brake(self.axis.deceleration(1), (row.target, row.number))
            return
        self._enter(row.target, row.number)
        if row.number == 11:
            self._quick_stop()

    def _enter(self, state: State, number: int) -> None:
        self.state, self._then = state, None
        if state is State.OPERATION_ENABLED:
            self.axis.take_over()
        elif state not in (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE):
            self.demand.take_over(0.0, 0.0)
        if not self.local:
            self.node.event(Code.DRIVE_STATE, state=state.title, transition=number)

    def _quick_stop(self) -> None:
        option = self._option(_QUICK_STOP)
        if option == 0:
            self._enter(State.SWITCH_ON_DISABLED, 12)
            return
        stays = option > _LAST_LEAVING_OPTION
        self._brake(
            self.axis.deceleration(option - _LAST_LEAVING_OPTION if stays else option),
            None if stays else (State.SWITCH_ON_DISABLED, 12),
        )

    def _brake(self, deceleration: float, then: tuple[State, int] | None) -> None:
        """Take the motor to rest along a ramp, and then enter a state by the transition of a number."""
        if self.demand.stopping is None:
            self.demand.velocity = self.axis.actual()[0]
        self.demand.torque = 0.0
        self.demand.stopping, self._then = deceleration, then

    def step(self, now_ns: int) -> None:
        """What the drive does by itself; called with every poll."""
        dt_s, self._last_ns = max(now_ns - self._last_ns, 0) / S_NS, now_ns
        self._supervise(dt_s)
        if self.local and not self.stopped:
            return
        if self.enabled:
            self.demand.step(self.axis.set_points(self.mode, self._halt), self._halt, dt_s)
            if (
                self.demand.stopping is not None
                and self.demand.velocity == 0.0
                and (not self.stopped or self.axis.rests())
                and self._then is not None
            ):
                self._enter(*self._then)
        self._publish()

    def _supervise(self, dt_s: float) -> None:
        axis = self.axis
        if axis.voltage_is_low:
            self.trip(UNDER_VOLTAGE, f"DC link {axis.dc_link_V:g} V is below {axis.lowest_V:g} V")
        axis.warm(dt_s)
        if axis.heat.load > Heat.TRIP:
            self.trip(OVER_TEMPERATURE, f"thermal load {axis.heat.load:.0%} of the motor")

    def _publish(self) -> None:
        """Statusword and commands follow the state."""
        self.word = self._statusword()
        self.axis.publish(self.enabled, self.local, self.mode, self.stopped)

    def _statusword(self) -> int:
        hot = self.axis.heat.load > Heat.WARNING
        word = (
            self.state
            | (not self.axis.voltage_is_low) * states.VOLTAGE_ENABLED
            | hot * states.WARNING
        )
        if self.local:
            return word
        word |= states.REMOTE | self.demand.limited * states.INTERNAL_LIMIT
        if self.state is State.OPERATION_ENABLED:
            word |= self.axis.mode_bits(self.mode, self._halt, self._last_ns)
        return word

    @property
    def _halt(self) -> bool:
        return bool(self.before & states.HALT_BIT)

    def _option(self, index: int) -> int:
        return self.node.objects.values[key(index, 0)]

    def _take_mode(self) -> None:
        before = self.mode
        self.mode = CYCLIC_TORQUE if self.local else self.node.objects.values[key(0x6060, 0)]
        # a PDO writes the same mode again and again
        if self.mode != before and self.enabled and self.demand.stopping is None:
            self.axis.take_over()

    def _on_nmt(self, old: nmt.State, new: nmt.State) -> None:
        if new is nmt.State.STOPPED:
            self._abort_connection("NMT stopped")
        elif new is nmt.State.INITIALISING and old is not new:
            self._abort_connection("reset")
        elif new is nmt.State.PRE_OPERATIONAL and old is nmt.State.INITIALISING:
            self._power_on()

    def _power_on(self) -> None:
        """Transitions 0 and 1; a drive of the rig control goes on to be enabled."""
        if self.state is State.NOT_READY_TO_SWITCH_ON:
            self._enter(State.SWITCH_ON_DISABLED, states.SELF_TEST_PASSED)
        self.before = self.node.objects.values[key(0x6040, 0)]
        self._take_mode()
        if self.local:
            self.control_from_rig()
        self._publish()

    def _on_reset(self) -> None:
        """The application starts anew, without the fault it had."""
        self.state, self.error, self._then = State.NOT_READY_TO_SWITCH_ON, 0, None
        self.demand.take_over(0.0, 0.0)

    def _on_partner(self, partner: int, alive: bool) -> None:
        if not alive:
            self._abort_connection(f"node {partner} is lost")

    def _abort_connection(self, why: str) -> None:
        if self.local or not self.enabled:
            return
        option = self._option(_ABORT)
        if option == 1:
            self.trip(HEARTBEAT_FAULT, f"connection aborted: {why}")
        elif option:
            self._obey(Command.DISABLE_VOLTAGE if option == 2 else Command.QUICK_STOP)
        self._publish()


def _check_mode(mode: int) -> None:
    if mode not in (0, *MODES):
        raise AbortError(Abort.INVALID_VALUE)
