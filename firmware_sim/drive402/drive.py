"""A roller drive, nodes 1 to 4: the CiA 402 state machine around the motor of one roller.

The motor has one of two sources of control:
- The rig control of the bench. The drive then enters OPERATION ENABLED from inside, clears bit 9
  (remote) of the statusword, and does not obey controlwords.
- A master on the bus. States, option codes, ramps and modes then follow the standard, and the
  demands go through the array of commands to the control loops of the tick.

With both sources an emergency stop causes a quick stop. The drive cannot be enabled until the
emergency stop is reset. Source: CiA 402-2 / IEC 61800-7-201.
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

# error codes of EMCY and 603Fh
HEARTBEAT_FAULT = 0x8130
OVER_TEMPERATURE = 0x4310
UNDER_VOLTAGE = 0x3220

# objects with option codes
_QUICK_STOP = 0x605A
_FAULT_REACTION = 0x605E
_ABORT_CONNECTION = 0x6007
# by the number of a transition: the object that decides whether the drive brakes first
_RAMPS = {5: 0x605C, 8: 0x605B}

# quick stop options above this keep the drive in QUICK STOP ACTIVE
_LAST_LEAVING_OPTION = 4
# the commands on the way to OPERATION ENABLED, which an emergency stop blocks
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
    """Build the node of the drive under `axle` (from 1).

    `row`: live float64 array of all signals. `parameters`: as in `objects.DEFAULTS`. `commands`:
    float64 array of shape (COMMANDS,), which the node writes before it calls `on_command()`.
    `control`: "rig" or "bus". `storage`: the file of 1010h.
    """
    parameters = table.DEFAULTS | dict(parameters or {})
    profile = Profile(table.DEVICE_TYPE, f"roller drive {axle}", table.RPDOS, table.TPDOS)
    node = process_image.build(
        node_id,
        profile,
        table.PRODUCT,
        table.rows(axle, parameters),
        row,
        process_image.carried_by_drive(axle, parameters),
        storage,
    )
    if commands is None:
        commands = np.zeros(COMMANDS)
    node.commands = table.COMMANDS
    axis = Axis(node.objects, axle, row, parameters, commands, on_command)
    node.device = Drive(node, axis, control == "rig")
    return node


class Drive:
    """State machine and demands of one drive.

    `local`: the rig control moves the motor. `stopped`: an emergency stop is set. `at_rest`: the
    state that the drive enters when its demand has reached zero, and the number of that transition.
    """

    def __init__(self, node: Node, axis: Axis, local: bool) -> None:
        self.node = node
        self.axis = axis
        self.demand = axis.demand
        self.local = local
        self.stopped = False
        self.state = State.NOT_READY_TO_SWITCH_ON
        self.statusword = 0
        self.controlword = 0  # the last one
        self.mode = 0
        self.error = 0
        self.at_rest: tuple[State, int] | None = None
        self._last_ns = 0
        attach = node.objects.attach
        attach(0x6041, read=lambda: self.statusword)
        attach(0x6061, read=lambda: self.mode)
        attach(0x603F, read=lambda: self.error)
        attach(0x2000, read=lambda: int(not self.local), effect=self._choose_source)
        attach(0x6040, effect=self.on_controlword)
        attach(0x6060, check=_check_mode, effect=lambda _: self._read_mode())
        node.on_reset.append(self._on_reset)
        node.on_power_off += [self._on_reset, self._publish]
        node.on_poll.append(self.step)
        node.on_state.append(self._on_nmt)
        node.on_partner.append(self._on_partner)

    def control_from_rig(self) -> None:
        """Let the rig control move the motor from now on. A fault must be reset first."""
        self.local = True
        self.at_rest = None
        self.demand.stopping = None
        self._read_mode()
        if self.state is State.QUICK_STOP_ACTIVE:
            self._obey(Command.DISABLE_VOLTAGE)
        for command in _ENABLING:
            self._obey(command)
        self._publish()

    def control_from_bus(self) -> None:
        """Let a master on the bus move the motor from now on, beginning at the present torque."""
        values = self.node.objects.values
        self.local = False
        self.axis.take_over()
        values[key(0x6071, 0)] = integer(self.demand.torque, "I16")
        values[key(0x60FF, 0)] = integer(self.demand.velocity, "I32")
        self.controlword = values[key(0x6040, 0)]
        self._read_mode()
        self._publish()

    def emergency_stop(self, on: bool) -> None:
        """Set or reset the emergency stop.

        The motor brakes as 605Ah defines, and is switched off when it is at rest.
        """
        if on == self.stopped:
            return
        self.stopped = on
        if on:
            self._obey(Command.QUICK_STOP)
        elif self.local:
            self.control_from_rig()
        self._publish()

    def _choose_source(self, bus: int) -> None:
        if bus and self.local:
            self.control_from_bus()
        elif not bus and not self.local:
            self.control_from_rig()

    @property
    def enabled(self) -> bool:
        """Whether the motor is powered."""
        if self.state is State.OPERATION_ENABLED:
            return True
        braking = self.state in (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
        return braking and self.demand.stopping is not None

    def on_controlword(self, word: int) -> None:
        """Take a controlword that has been written."""
        command = states.command_of(word, self.controlword)
        self.controlword = word
        if not self.local and command is not None:
            self._obey(command)
        self._publish()

    def trip(self, code: int, text: str) -> None:
        """Report a fault: transition 13, the reaction that 605Eh defines, then FAULT."""
        if self.state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            return
        was_enabled = self.enabled
        self.error = code
        self._enter(State.FAULT_REACTION_ACTIVE, states.FAULT_DETECTED)
        self.node.event(Code.DRIVE_FAULT, error_code=code, reason=text)
        self.node.emergency.report(code)
        option = self._option(_FAULT_REACTION)
        if was_enabled and option != 0 and not self.local:
            self._brake(self.axis.deceleration(option), (State.FAULT, states.REACTION_COMPLETED))
        else:
            self._enter(State.FAULT, states.REACTION_COMPLETED)
        self._publish()

    def recover(self) -> None:
        """Reset a fault (transition 15) and enable the drive again, if the rig control moves it."""
        if self.local:
            self._obey(Command.FAULT_RESET)
            self.control_from_rig()

    def _obey(self, command: Command) -> None:
        """Carry out a command of the controlword, if the state allows it."""
        if self.stopped and command in _ENABLING:
            return
        # enabling from ready takes two transitions, every other command at most one
        for _ in range(2):
            transition = states.FROM_COMMAND.get((self.state, command))
            if transition is not None:
                self._perform(transition)
                continue
            enabled = self.state is State.OPERATION_ENABLED
            stopping = self.demand.stopping is not None
            if command is Command.ENABLE_OPERATION and enabled and stopping:
                # the command cancels a stop that is in progress
                self.axis.take_over()
                self.at_rest = None

    def _perform(self, transition: Transition) -> None:
        number = transition.number
        if number == 16 and self._option(_QUICK_STOP) <= _LAST_LEAVING_OPTION:
            # these options leave QUICK STOP ACTIVE only towards SWITCH ON DISABLED
            return
        if number == 15:  # fault reset
            self.node.emergency.clear(self.error)
            self.error = 0
        if number in _RAMPS and self._option(_RAMPS[number]) and not self.local:
            self._brake(self.axis.deceleration(1), (transition.target, number))
            return
        self._enter(transition.target, number)
        if number == 11:  # quick stop
            self._quick_stop()

    def _enter(self, state: State, number: int) -> None:
        """Enter a state by the transition with this number."""
        self.state = state
        self.at_rest = None
        if state is State.OPERATION_ENABLED:
            self.axis.take_over()
        elif state not in (State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE):
            self.demand.take_over(0.0, 0.0)
        if not self.local:
            self.node.event(Code.DRIVE_STATE, state=state.title, transition=number)

    def _quick_stop(self) -> None:
        """Brake as the option code 605Ah defines."""
        option = self._option(_QUICK_STOP)
        if option == 0:
            self._enter(State.SWITCH_ON_DISABLED, 12)
        elif option <= _LAST_LEAVING_OPTION:
            self._brake(self.axis.deceleration(option), (State.SWITCH_ON_DISABLED, 12))
        else:
            # options 5 to 7 have the ramps of 1 to 3, but stay in QUICK STOP ACTIVE
            self._brake(self.axis.deceleration(option - _LAST_LEAVING_OPTION), None)

    def _brake(self, deceleration: float, at_rest: tuple[State, int] | None) -> None:
        """Bring the motor to rest along a ramp, and then enter a state by a transition."""
        if self.demand.stopping is None:
            self.demand.velocity = self.axis.actual()[0]
        self.demand.torque = 0.0
        self.demand.stopping = deceleration
        self.at_rest = at_rest

    def step(self, now_ns: int) -> None:
        """Advance ramps and supervision to `now_ns`; called with every poll."""
        dt_s = max(now_ns - self._last_ns, 0) / S_NS
        self._last_ns = now_ns
        self._supervise(dt_s)
        if self.local and not self.stopped:
            return
        if self.enabled:
            self.demand.step(self.axis.set_points(self.mode, self._halt), self._halt, dt_s)
            self._end_stop()
        self._publish()

    def _end_stop(self) -> None:
        """Enter the next state, if a stop has come to its end."""
        demand_at_rest = self.demand.stopping is not None and self.demand.velocity == 0.0
        # an emergency stop ends when the roller itself is at rest
        motor_at_rest = not self.stopped or self.axis.is_at_rest()
        if self.at_rest is not None and demand_at_rest and motor_at_rest:
            self._enter(*self.at_rest)

    def _supervise(self, dt_s: float) -> None:
        """Trip the drive if its voltage is too low or its motor too hot."""
        axis = self.axis
        if axis.voltage_is_low:
            self.trip(UNDER_VOLTAGE, f"DC link {axis.dc_link_V:g} V is below {axis.lowest_V:g} V")
        axis.warm(dt_s)
        if axis.heat.load > Heat.TRIP:
            self.trip(OVER_TEMPERATURE, f"thermal load {axis.heat.load:.0%} of the motor")

    def _publish(self) -> None:
        """Bring statusword and commands up to date."""
        self.statusword = self._new_statusword()
        self.axis.publish(self.enabled, self.local, self.mode, self.stopped)

    def _new_statusword(self) -> int:
        word = int(self.state)
        if not self.axis.voltage_is_low:
            word |= states.VOLTAGE_ENABLED
        if self.axis.heat.load > Heat.WARNING:
            word |= states.WARNING
        if self.local:
            return word
        word |= states.REMOTE
        if self.demand.limited:
            word |= states.INTERNAL_LIMIT
        if self.state is State.OPERATION_ENABLED:
            word |= self.axis.mode_bits(self.mode, self._halt, self._last_ns)
        return word

    @property
    def _halt(self) -> bool:
        return bool(self.controlword & states.HALT_BIT)

    def _option(self, index: int) -> int:
        """Return the option code in an object."""
        return self.node.objects.values[key(index, 0)]

    def _read_mode(self) -> None:
        """Take the mode of operation from 6060h; the rig control always has cyclic torque."""
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
        """Perform transitions 0 and 1; a drive of the rig control is then enabled."""
        if self.state is State.NOT_READY_TO_SWITCH_ON:
            self._enter(State.SWITCH_ON_DISABLED, states.SELF_TEST_PASSED)
        self.controlword = self.node.objects.values[key(0x6040, 0)]
        self._read_mode()
        if self.local:
            self.control_from_rig()
        self._publish()

    def _on_reset(self) -> None:
        """Begin again at power-on, without the former fault."""
        self.state = State.NOT_READY_TO_SWITCH_ON
        self.error = 0
        self.at_rest = None
        self.demand.take_over(0.0, 0.0)

    def _on_partner(self, partner: int, alive: bool) -> None:
        if not alive:
            self._abort_connection(f"node {partner} is lost")

    def _abort_connection(self, why: str) -> None:
        """React to a lost connection as the option code 6007h defines."""
        if self.local or not self.enabled:
            return
        option = self._option(_ABORT_CONNECTION)
        if option == 1:
            self.trip(HEARTBEAT_FAULT, f"connection aborted: {why}")
        elif option == 2:
            self._obey(Command.DISABLE_VOLTAGE)
        elif option == 3:
            self._obey(Command.QUICK_STOP)
        self._publish()


def _check_mode(mode: int) -> None:
    if mode not in (0, *MODES):
        raise AbortError(Abort.INVALID_VALUE)
