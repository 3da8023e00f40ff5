"""The drive state machine of CiA 402: states, commands of the controlword, numbered transitions.

Everything here is a table. The lower bits of the statusword show the state. A command is a pattern
in the lower bits of the controlword. Each transition has its number from the standard.
Source: CiA 402-2 / IEC 61800-7-201, power drive state machine.
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
    """Commands of the controlword."""

    DISABLE_VOLTAGE = 1
    QUICK_STOP = 2
    SHUTDOWN = 3
    SWITCH_ON = 4
    ENABLE_OPERATION = 5
    FAULT_RESET = 6


# (mask, pattern, command); a fault reset is not a pattern, but a rising edge of bit 7
PATTERNS = (
    (0x82, 0x00, Command.DISABLE_VOLTAGE),
    (0x86, 0x02, Command.QUICK_STOP),
    (0x87, 0x06, Command.SHUTDOWN),
    (0x8F, 0x07, Command.SWITCH_ON),
    (0x8F, 0x0F, Command.ENABLE_OPERATION),
)
# bits of the controlword
FAULT_RESET_BIT = 0x80
HALT_BIT = 0x100

# bits of the statusword
VOLTAGE_ENABLED = 0x10
WARNING = 0x80
REMOTE = 0x200
TARGET_REACHED = 0x400
INTERNAL_LIMIT = 0x800
SPEED_ZERO = 0x1000  # profile velocity
FOLLOWS = 0x1000  # cyclic synchronous modes: the drive follows the command value
SLIPPAGE = 0x2000


class Transition(NamedTuple):
    """One row of the standard's table."""

    number: int
    state: State
    commands: tuple[Command, ...]
    target: State


_NOT_READY, _DISABLED, _READY, _ON, _ENABLED, _QUICK_STOP, _REACTION, _FAULT = State
TRANSITIONS = (
    Transition(2, _DISABLED, (Command.SHUTDOWN,), _READY),
    # ENABLE OPERATION in READY TO SWITCH ON passes through SWITCHED ON
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
# transitions that the drive makes by itself
SELF_TEST_PASSED = 1  # at power-on, after 0
FAULT_DETECTED = 13
REACTION_COMPLETED = 14


def command_of(controlword: int, before: int) -> Command | None:
    """Return the command of a controlword, or None; `before` is the last controlword."""
    if controlword & ~before & FAULT_RESET_BIT:
        return Command.FAULT_RESET
    for mask, pattern, command in PATTERNS:
        if controlword & mask == pattern:
            return command
    return None
