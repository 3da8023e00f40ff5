"""The states of network management, the services in each state, and the commands between them.

Source: CiA 301, NMT state machine and its table of states and communication objects.
"""

from enum import IntEnum


class State(IntEnum):
    """NMT states, with the number that a heartbeat carries."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127

    @property
    def has_emergencies(self) -> bool:
        """Whether the services SDO, SYNC, TIME and EMCY are active."""
        return self in (State.OPERATIONAL, State.PRE_OPERATIONAL)

    @property
    def title(self) -> str:
        """The state as the standard writes it."""
        return self.name.replace("_", "-")


class Command(IntEnum):
    """NMT commands, as byte 0 of message 000h."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


# the state that a command leads to
COMMANDED = {
    Command.START: State.OPERATIONAL,
    Command.STOP: State.STOPPED,
    Command.ENTER_PRE_OPERATIONAL: State.PRE_OPERATIONAL,
}
