"""The places of a TCP server: how long a silent client keeps one, and who gives way to new ones.

A client is silent until it has sent its first valid message. Silent connections cost nothing to
make: the `preconnect` links of a web page open dozens of them, from this very machine. So they must
not keep a unit or a PLC out.

- A silent client is closed after a time, if the protocol expects its clients to speak first.
- When all places are taken, or all those of one address, a silent client gives way to a new one.
  The one that has been silent longest gives way: a client that has something to say says it soon.
  A protocol without a handshake has clients that only listen; there the newest silent one gives
  way, so that nobody pushes out a program that has listened for long.
- A client that has spoken keeps its place, unless the protocol lets the one give way that has been
  idle longest. Without anybody to give way, the new client is refused.

All programs of this machine have the same address. Other machines can take the places of one
address each, and leave the others.

A process that is out of descriptors cannot accept clients at all. `is_out_of_descriptors`
recognises this, and `close_silent` gives descriptors back.
"""

import asyncio
import errno
import time
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

from rollerrig.wsp_interface.events import Code, OnEvent

# Places of one protocol. Those of all servers of a bench together take less than a third of the
# 1024 descriptors that a process usually has.
PLACES = 64
PLACES_OF_ADDRESS = 32
# Out of descriptors, a client that has connected so recently may still be about to speak.
_JUST_CONNECTED_S = 1.0
_OUT_OF_DESCRIPTORS = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class Client(Protocol):
    """What a client shows to the places of its server."""

    @property
    def address(self) -> str:
        """The address of its machine."""

    @property
    def silent(self) -> bool:
        """Whether it has not sent a valid message yet."""

    @property
    def last_used_s(self) -> float:
        """When it connected or last sent something, by time.monotonic()."""

    def abort(self) -> None:
        """Close the connection immediately."""


class Places:
    """The places of one server.

    server: the server's name in events.
    first_message_s: how long a client may be silent; None where the protocol has no handshake.
    idle_gives_way: whether a client that has spoken gives way when it has been idle longest.
    on_event: called as on_event(code, **fields), once for each code.
    """

    def __init__(
        self,
        server: str,
        first_message_s: float | None,
        idle_gives_way: bool,
        on_event: OnEvent,
    ) -> None:
        self._server = server
        self._first_message_s = first_message_s
        self._idle_gives_way = idle_gives_way
        self._on_event = on_event
        self._reported: set[Code] = set()
        self._clients: dict[Client, asyncio.TimerHandle | None] = {}  # with the end of its time

    def __len__(self) -> int:
        """Return the number of taken places."""
        return len(self._clients)

    def admit(self, client: Client) -> bool:
        """Give a place to a new client, whose place may be that of another; False: it gets none."""
        rivals = [other for other in self._clients if other.address == client.address]
        places = PLACES_OF_ADDRESS
        if len(rivals) < PLACES_OF_ADDRESS:
            rivals = list(self._clients)
            places = PLACES

        if len(rivals) >= places:
            loser = self._who_gives_way(rivals)
            if loser is None:
                return False
            if loser.silent:
                self._report(Code.SERVER_SILENT_GAVE_WAY, places=places)
            self.leave(loser)
            loser.abort()

        timer = None
        if self._first_message_s is not None:
            running = asyncio.get_running_loop()
            timer = running.call_later(self._first_message_s, self._end_silence, client)
        self._clients[client] = timer
        return True

    def leave(self, client: Client) -> None:
        """Free the place of a client, if it has one."""
        timer = self._clients.pop(client, None)
        if timer is not None:
            timer.cancel()

    def close_silent(self) -> None:
        """Close all silent clients, except those that have just connected."""
        before_s = time.monotonic() - _JUST_CONNECTED_S
        for client in list(self._clients):
            if client.silent and client.last_used_s < before_s:
                self.leave(client)
                client.abort()

    def _who_gives_way(self, rivals: Iterable[Client]) -> Client | None:
        silent = [client for client in rivals if client.silent]
        if silent and self._first_message_s is None:
            return max(silent, key=_last_used_s)
        if silent:
            return min(silent, key=_last_used_s)
        if self._idle_gives_way:
            return min(rivals, key=_last_used_s)
        return None

    def _end_silence(self, client: Client) -> None:
        """Close a client whose time has come, if it is still silent."""
        if not client.silent:
            return
        self._report(Code.SERVER_SILENT_CLOSED, after_s=self._first_message_s)
        self.leave(client)
        client.abort()

    def _report(self, code: Code, **fields: Any) -> None:
        """Report an event once only: a page that opens connections opens many."""
        if code not in self._reported:
            self._reported.add(code)
            self._on_event(code, server=self._server, **fields)


def _last_used_s(client: Client) -> float:
    return client.last_used_s


def is_out_of_descriptors(context: Mapping[str, Any]) -> bool:
    """Return whether an event loop could not accept a client for want of descriptors or memory.

    context: what an event loop gives to its exception handler.
    """
    error = context.get("exception")
    is_about_a_socket = "socket" in context
    return is_about_a_socket and isinstance(error, OSError) and error.errno in _OUT_OF_DESCRIPTORS
