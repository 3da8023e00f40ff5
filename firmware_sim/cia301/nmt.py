"""The states of network management, the services in each state, and the commands between them.

Source: CiA 301, NMT state machine and its table of states and communication objects.
"""

from enum import IntEnum


class State(IntEnum):
    """NMT states, with the number that a heartbeat carries (0: the boot-up message)."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127

    @property
    def has_services(self) -> bool:
        """Whether the services SDO, SYNC, TIME and EMCY are active."""
        return self in (State.OPERATIONAL, State.PRE_OPERATIONAL)

    @property
    def title(self) -> str:
        """The name of the state as it is spelled in the standard, for example PRE-OPERATIONAL."""
        return self.name.replace("_", "-")


class Command(IntEnum):
    """NMT commands, as byte 0 of message 000h."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


# The state that a node enters on a command. The two reset commands are not here: they restart the
# node, which then enters PRE-OPERATIONAL.
STATE_AFTER = {
    Command.START: State.OPERATIONAL,
    Command.STOP: State.STOPPED,
    Command.ENTER_PRE_OPERATIONAL: State.PRE_OPERATIONAL,
}
