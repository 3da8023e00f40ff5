"""The drive state machine of CiA 402: states, commands of the controlword, numbered transitions.

Everything here is a table. The statusword's lower bits tell the state; a command is a pattern in
the controlword's lower bits; a transition has the number that the standard gives it. Source: CiA
402-2 / IEC 61800-7-201, power drive state machine.
"""

from enum import IntEnum
from typing import NamedTuple


class State(IntEnum):
    """States of the power drive; the value is the statusword's pattern for it."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08

    @property
    def title(self) -> str:
        """The state as the standard writes it."""
        return self.name.replace("_", " ")


class Command(IntEnum):
    """What a controlword asks for."""

    DISABLE_VOLTAGE = 1
    QUICK_STOP = 2
    SHUTDOWN = 3
    SWITCH_ON = 4
    ENABLE_OPERATION = 5
    FAULT_RESET = 6


# (mask, pattern, command); bit 7 is told apart by its edge
PATTERNS = (
    (0x82, 0x00, Command.DISABLE_VOLTAGE),
    (0x86, 0x02, Command.QUICK_STOP),
    (0x87, 0x06, Command.SHUTDOWN),
    (0x8F, 0x07, Command.SWITCH_ON),
    (0x8F, 0x0F, Command.ENABLE_OPERATION),
)
FAULT_RESET_BIT, HALT_BIT = 0x80, 0x100

VOLTAGE_ENABLED, WARNING, REMOTE = 0x10, 0x80, 0x200
TARGET_REACHED, INTERNAL_LIMIT, SPEED_ZERO, SLIPPAGE = 0x400, 0x800, 0x1000, 0x2000
FOLLOWS = SPEED_ZERO


class Transition(NamedTuple):
    """One row of the standard's table."""

    number: int
    state: State
    commands: tuple[Command, ...]
    target: State


_NOT_READY, _DISABLED, _READY, _ON, _ENABLED, _QUICK_STOP, _REACTION, _FAULT = State
TRANSITIONS = (
    Transition(2, _DISABLED, (Command.SHUTDOWN,), _READY),
    # enabling at once passes through switched on
    Transition(3, _READY, (Command.SWITCH_ON, Command.ENABLE_OPERATION), _ON),
    Transition(4, _ON, (Command.ENABLE_OPERATION,), _ENABLED),
    Transition(5, _ENABLED, (Command.SWITCH_ON,), _ON),
    Transition(6, _ON, (Command.SHUTDOWN,), _READY),
    Transition(7, _READY, (Command.DISABLE_VOLTAGE, Command.QUICK_STOP), _DISABLED),
    Transition(8, _ENABLED, (Command.SHUTDOWN,), _READY),
    Transition(9, _ENABLED, (Command.DISABLE_VOLTAGE,), _DISABLED),
    Transition(10, _ON, (Command.DISABLE_VOLTAGE, Command.QUICK_STOP), _DISABLED),
    Transition(11, _ENABLED, (Command.QUICK_STOP,), _QUICK_STOP),
    Transition(12, _QUICK_STOP, (Command.DISABLE_VOLTAGE,), _DISABLED),
    Transition(15, _FAULT, (Command.FAULT_RESET,), _DISABLED),
    Transition(16, _QUICK_STOP, (Command.ENABLE_OPERATION,), _ENABLED),
)
FROM_COMMAND = {(row.state, command): row for row in TRANSITIONS for command in row.commands}
# transitions that the drive makes by itself: 0 and 1 at power-on, 13 into a fault, 14 when the
# reaction to it is over
SELF_TEST_PASSED, FAULT_DETECTED, REACTION_COMPLETED = 1, 13, 14


def command_of(controlword: int, before: int) -> Command | None:
    """What a controlword asks for; a fault reset is the rising edge of bit 7."""
    if controlword & ~before & FAULT_RESET_BIT:
        return Command.FAULT_RESET
    for mask, pattern, command in PATTERNS:
        if controlword & mask == pattern:
            return command
    return None
