"""The connections of the desk: silent ones are closed, and give way to its owner (see `places`).

A connection of HTTP is silent until the guard has allowed a request on it. So programs of other
users, which have no token, cannot hold the places, however many connections they open. A connection
that becomes a WebSocket leaves its place: the guard has allowed it, or closes it.
"""

import asyncio
import time
from typing import Any

from uvicorn.protocols.http.auto import AutoHTTPProtocol

from rollerrig.wsp_interface.events import OnEvent
from rollerrig.wsp_interface.places import Places

# a browser sends its request within milliseconds; some open connections before they need them
FIRST_REQUEST_S = 10.0
# connections that wait for the desk to accept them: few, so that all of them find a descriptor
BACKLOG = 64
_STATE = "connection"  # key in the state of a request


def protocol(on_event: OnEvent) -> type[asyncio.Protocol]:
    """Return the class of the connections of one server, for uvicorn.

    `on_event` is called as on_event(code, **fields) when connections are closed.
    """
    places = Places("THE DESK", FIRST_REQUEST_S, idle_gives_way=True, on_event=on_event)

    class Connection(AutoHTTPProtocol):  # type: ignore[valid-type]
        """A connection with a place."""

        def __init__(self, *arguments: Any, app_state: dict[str, Any], **options: Any) -> None:
            # each request of this connection finds it in its state
            state = {**app_state, _STATE: self}
            super().__init__(*arguments, app_state=state, **options)
            self.address = ""
            self.silent = True
            self.last_used_s = time.monotonic()

        def connection_made(self, transport: Any) -> None:
            """The connection begins."""
            super().connection_made(transport)
            self.address = (transport.get_extra_info("peername") or ("",))[0]
            if not places.admit(self):
                self.abort()

        def data_received(self, data: bytes) -> None:
            """Bytes have arrived. They keep the place only of a connection that is not silent."""
            if not self.silent:
                self.last_used_s = time.monotonic()
            super().data_received(data)

        def connection_lost(self, exc: Exception | None) -> None:
            """The connection has ended."""
            places.leave(self)
            super().connection_lost(exc)

        def handle_websocket_upgrade(self) -> None:
            """The connection becomes a WebSocket."""
            places.leave(self)
            super().handle_websocket_upgrade()

        def abort(self) -> None:
            """Close the connection immediately."""
            self.transport.abort()

    return Connection


def note_allowed(scope: Any) -> None:
    """Note that a request was allowed: its connection is not silent any more."""
    connection = scope.get("state", {}).get(_STATE)
    if connection is not None:
        connection.silent = False
        connection.last_used_s = time.monotonic()
