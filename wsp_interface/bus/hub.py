"""One CAN bus inside the bench process, which outside programs join over TCP.

Every frame gets one time stamp and one place in one order. Then it goes to the taps, to the nodes
in the process (a plain call) and to the clients, encoded once for each protocol. Frames that are
sent within one callback of the event loop leave in one write for each client. A client that reads
too slowly loses frames, which are counted, instead of delaying the rig. No sender receives its
frames back.

By default the bus is ideal: it delivers a frame immediately and only counts its bits (`load`).
After `arbitrate` frames wait for the wire as on a real bus: the lowest identifier first, each for
its bits' time, by the hub's clock, which is simulated or real.

Threads: a hub belongs to the thread of its event loop; do not call it from another thread.

Limits: no acknowledge bit. There are error frames only where a fault causes them (`destroy`), and
only for clients that request them; the identifier of the destroyed frame follows their content.
The protocols have no authentication: the hub listens on loopback only, unless another host is
requested. `rollerrig.wsp_interface.places` says which clients give way when there are too many.
"""

import asyncio
import errno
import ipaddress
import logging
from collections import deque
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

from rollerrig.configs.errors import BusError, PortInUseError
from rollerrig.wsp_interface import events, places
from rollerrig.wsp_interface.bus.client import Client
from rollerrig.wsp_interface.bus.codecs import CODECS
from rollerrig.wsp_interface.bus.connection_set import is_service
from rollerrig.wsp_interface.bus.frames import OVERLOAD_BACKLOG_NS, BusLoad, Frame, check
from rollerrig.wsp_interface.bus.wire import Alarm, Wire
from rollerrig.wsp_interface.events import Code, OnEvent
from rollerrig.wsp_interface.places import Places

log = logging.getLogger(__name__)

FIRST_MESSAGE_S = 30.0  # long enough for someone who types the handshake
BUFFER_BYTES = 1 << 20  # for each client; about 25 000 frames, or five seconds of a full bus
CLOSE_TIMEOUT_S = 0.5

# of linux/can/error.h
_BUS_ERROR = 0x088  # class of an error frame: CAN_ERR_PROT and CAN_ERR_BUSERROR
_ON_TRANSMISSION = 0x80  # CAN_ERR_PROT_TX

Callback = Callable[[Frame], None]
Then = Callable[[], None] | None
# gate(sender, frame, carry): return whether the frame goes on now; call carry() to let it go later
Gate = Callable[["Port | Client", Frame, Callable[[], None]], bool]


class Port:
    """The connection of a node of this process to the bus. `dropped` counts its lost frames."""

    def __init__(
        self, hub: "Hub", callback: Callback, name: str, on_close: Callable[[], None] | None
    ) -> None:
        self.name = name
        self.dropped = 0
        self._hub: Hub | None = hub  # None after `close`
        self._callback = callback
        self._on_close = on_close

    def send(self, frame: Frame, then: Then = None, origin: Hashable = None) -> None:
        """Put a frame on the bus. A closed port only counts it as dropped.

        then: called when the bus has carried the frame.
        origin: the owner of the transmit queue, where several nodes share a port.

        Raises ValueError for a frame that no CAN controller could send.
        """
        if self._hub is None:
            self.dropped += 1
            return
        self._hub.submit(check(frame), self, then, origin)

    def deliver(self, frame: Frame) -> None:
        """Give the node a frame of another sender. Its exceptions do not reach the sender."""
        if self._hub is not None:
            self._hub.call(self._callback, frame)

    def close(self) -> None:
        """Leave the bus. The node gets no more calls."""
        if self._hub is None:
            return
        hub = self._hub
        self._hub = None
        hub.leave(self)
        if self._on_close:
            self._on_close()


def log_event(code: Code, /, **fields: Any) -> None:
    """Log an event: the default callback of a hub."""
    event = events.make(0.0, code, **fields)
    log.log(logging.getLevelNamesMapping()[event.level.upper()], event.text)


def beyond_loopback(host: str) -> bool:
    """Return whether other machines can reach a server that listens on this address."""
    if host == "localhost":
        return False
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return True


class Hub:
    """The bus.

    clock_ns: returns the time that every frame is stamped with.
    bitrate: in bit/s, for the load and for the wire.
    name: what clients call the bus.
    other_names: further names by which clients may open it.
    first_message_s: how long a client of a protocol with a handshake may be silent.
    buffer_bytes: how much may wait for one client.
    on_event: called as on_event(code, **fields) for clients that the hub refuses and for addresses
        that other machines can reach.

    Attributes that the bench sets:

    services_bypass_wire: NMT, SDO, heartbeats and LSS do not wait for the wire. The bench sets it
        while simulated time waits. Otherwise a client that uses a service before it answers would
        wait forever.
    order: called with every frame that a member sends, before the gate. It decides whether the
        frame goes on now, and may let it go on later.
    gate: decides whether a frame goes on now, and may let it go on later.
    timestamping_port: frames of this port already carry the time at which they arrived. No frame is
        stamped before an earlier one.

    carries_from: the sender of the frame that the bus carries now, or carried last.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        bitrate: int = 500_000,
        name: str = "rig0",
        buffer_bytes: int = BUFFER_BYTES,
        on_event: OnEvent = log_event,
        other_names: tuple[str, ...] = (),
        first_message_s: float = FIRST_MESSAGE_S,
    ) -> None:
        self.name = name
        self.names = (name, *other_names)
        self.buffer_bytes = buffer_bytes
        self.load = BusLoad(bitrate, clock_ns())
        self.wire: Wire | None = None
        self.services_bypass_wire = False
        self.order: Gate | None = None
        self.gate: Gate | None = None
        self.timestamping_port: Port | None = None
        self.carries_from: Port | Client | None = None
        self._clock_ns = clock_ns
        self._on_event = on_event
        self._warned: set[tuple[Code, str]] = set()
        # tuples are replaced, not changed: a callback may attach or close while frames go out
        self._taps: tuple[Callback, ...] = ()
        self._ports: tuple[Port, ...] = ()
        self._clients: tuple[Client, ...] = ()
        self._first_message_s = first_message_s
        self._places: dict[str, Places] = {}  # by protocol
        self._servers: list[asyncio.Server] = []
        self._waiting: deque[tuple[Frame, Port | Client, Then]] = deque()
        self._carrying = False
        self._alarm: Alarm | None = None
        self._at_ns: int | None = None  # the end of the frame that the wire carries
        self._latest_ns = 0
        self._flush_due = False
        self._departed_dropped = 0  # drops of ports and clients that have left

    def attach(
        self, callback: Callback, name: str = "node", on_close: Callable[[], None] | None = None
    ) -> Port:
        """Return a new port for a node.

        callback: called with every frame of another sender.
        on_close: called when the port closes.
        """
        port = Port(self, callback, name, on_close)
        self._ports = (*self._ports, port)
        return port

    def tap(self, callback: Callback) -> None:
        """Call callback(frame) for every frame, before the nodes see it."""
        self._taps = (*self._taps, callback)

    async def listen(
        self,
        codec: str = "socketcand",
        host: str = "127.0.0.1",
        port: int | None = None,
        port_key: str = "",
    ) -> int:
        """Accept TCP clients of a protocol of `codecs.CODECS`; return the port number.

        Port 0 takes a free port, None the usual one of the protocol. `port_key` is the key of the
        configuration that gives the port, for messages; without one it is part of an address.
        Raises PortInUseError when another program has the port, and BusError when the protocol is
        unknown or the address cannot be used otherwise.
        """
        if codec not in CODECS:
            raise BusError(
                f"CAN hub {self.name}: unknown protocol {codec!r}; allowed: {', '.join(CODECS)}"
            )
        row = CODECS[codec]
        if port is None:
            port = row.port
        if codec not in self._places:
            self._places[codec] = Places(
                f"CAN hub {self.name} ({codec})",
                self._first_message_s if row.handshake else None,
                idle_gives_way=False,
                on_event=self._on_event,
            )
        # "localhost" may be two addresses, and a free port would then be two ports
        address = "127.0.0.1" if host == "localhost" else host
        loop = asyncio.get_running_loop()
        try:
            server = await loop.create_server(lambda: Client(self, codec, row), address, port)
        except (OSError, OverflowError) as error:
            place = f"CAN hub {self.name}: cannot listen for {codec} on {host}:{port}"
            if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
                raise PortInUseError(f"{place}: {_port_in_use(port, port_key)}") from error
            raise BusError(f"{place}: {_no_address(error)}") from error
        self._servers.append(server)
        bound_host, bound_port = server.sockets[0].getsockname()[:2]
        if beyond_loopback(bound_host):
            self._on_event(
                Code.SERVER_EXPOSED,
                server=f"CAN HUB {self.name} ({codec})",
                host=bound_host,
                port=bound_port,
                who="WITHOUT ANY AUTHENTICATION",
            )
        return int(bound_port)

    def join(self, client: Client) -> bool:
        """Add a TCP client that has connected; return False when there are too many."""
        its_places = self._places[client.protocol]
        if its_places.admit(client):
            self._clients = (*self._clients, client)
            return True
        if len(its_places) == places.PLACES:
            limit: dict[str, Any] = {"clients_max": places.PLACES, "address": None}
        else:
            limit = {"clients_max": places.PLACES_OF_ADDRESS, "address": client.address}
        self.warn(Code.HUB_FULL, client.protocol, **limit)
        return False

    def close_silent(self) -> None:
        """Close the clients that have sent nothing valid: descriptors have run out."""
        for its_places in self._places.values():
            its_places.close_silent()

    def warn(self, code: Code, protocol: str, **fields: Any) -> None:
        """Report an event of a protocol, once only: many clients may have the same problem."""
        if (code, protocol) not in self._warned:
            self._warned.add((code, protocol))
            self._on_event(code, bus=self.name, protocol=protocol, **fields)

    def leave(self, member: Port | Client) -> None:
        """Remove a port or client. Its dropped frames stay counted."""
        if isinstance(member, Client):
            self._places[member.protocol].leave(member)
        self._departed_dropped += member.dropped
        member.dropped = 0
        self._ports = tuple(port for port in self._ports if port is not member)
        self._clients = tuple(client for client in self._clients if client is not member)

    def submit(
        self, frame: Frame, sender: Port | Client, then: Then = None, origin: Hashable = None
    ) -> None:
        """Put a frame of a member on the bus, when its turn has come and the gate lets it pass."""
        go_on = partial(self._pass_gate, frame, sender, then, origin)
        if self.order is None or self.order(sender, frame, go_on):
            go_on()

    def _pass_gate(self, frame: Frame, sender: Port | Client, then: Then, origin: Hashable) -> None:
        if self.gate is None:
            self._queue(frame, sender, then, origin)
            return
        carry = partial(self._queue, frame, sender, then, origin)
        if self.gate(sender, frame, carry):
            carry()

    def destroy(
        self, frame: Frame, transmit_errors: int, receive_errors: int = 0, by_sender: bool = True
    ) -> None:
        """Destroy a frame on the wire by an error frame, which taps and some clients receive.

        transmit_errors, receive_errors: the counters of the node that found the error.
        by_sender: whether the sender found it.

        Source: linux/can/error.h.
        """
        now_ns = self._now_ns()
        place = _ON_TRANSMISSION if by_sender else 0
        state = bytes((0, 0, place, 0, 0, 0, transmit_errors, receive_errors))
        self.load.carry(frame, now_ns)
        if self.wire is not None:
            self.wire.occupy(frame, now_ns)
        self.report_error(_BUS_ERROR, state, now_ns)
        destroyed_id = frame.can_id.to_bytes(4, "little")
        error = Frame(_BUS_ERROR, state + destroyed_id, time_ns=now_ns, error=True)
        for client in self._clients:
            if client.listening and client.errors:
                client.put(client.encode(error))
                self._flush_soon()

    def report_error(self, kind: int, state: bytes, at_ns: int | None = None) -> None:
        """Give the taps an error frame: its class and content as in linux/can/error.h."""
        now_ns = self._now_ns() if at_ns is None else at_ns
        for tap in self._taps:
            self.call(tap, Frame(kind, state, time_ns=now_ns, error=True))

    def _now_ns(self) -> int:
        return self._clock_ns() if self._at_ns is None else self._at_ns

    def _queue(self, frame: Frame, sender: Port | Client, then: Then, origin: Hashable) -> None:
        """Let a frame wait for the wire; without one, carry it and all that its receivers send.

        A receiver may answer within its call. Its answer waits here until all other receivers have
        the frame, so an answer never overtakes its question.
        """
        bypasses_wire = self.services_bypass_wire and is_service(frame)
        if self.wire is not None and not bypasses_wire:
            self._offer(self.wire, frame, sender, then, origin)
            return
        self._waiting.append((frame, sender, then))
        if self._carrying:
            return
        self._carrying = True
        try:
            while self._waiting:
                next_frame, its_sender, its_then = self._waiting.popleft()
                self._carry(next_frame, its_sender, its_then, self._now_ns())
        finally:
            self._carrying = False

    def _carry(self, frame: Frame, sender: Port | Client, then: Then, now_ns: int) -> None:
        """Stamp a frame and give it to all members except its sender."""
        if self.timestamping_port is not None:
            if sender is self.timestamping_port:
                now_ns = max(frame.time_ns, self._latest_ns)
            self._latest_ns = now_ns
        self.carries_from = sender
        stamped = Frame(frame.can_id, frame.data, frame.extended, frame.remote, frame.dlc, now_ns)
        self.load.carry(stamped, now_ns)
        for tap in self._taps:
            self.call(tap, stamped)
        for port in self._ports:
            if port is not sender:
                port.deliver(stamped)
        encoded: dict[str, bytes] = {}  # by protocol
        for client in self._clients:
            if client is not sender and client.listening:
                if client.protocol not in encoded:
                    encoded[client.protocol] = client.encode(stamped)
                client.put(encoded[client.protocol])
        if then is not None:
            then()
        if encoded:
            self._flush_soon()

    def arbitrate(self, timed: bool) -> None:
        """Make frames wait for the wire from now on. Call it in the event loop.

        timed: the event loop carries the frames in real time. Otherwise the owner of simulated time
            has to call `advance`.
        """
        if self.wire is not None:
            return
        self.wire = Wire(self.load.bitrate, self._clock_ns())
        if timed:
            self._alarm = Alarm()
            asyncio.get_running_loop().add_reader(self._alarm.fileno, self._on_alarm)

    def advance(self, now_ns: int) -> None:
        """Carry every frame whose last bit has left the wire by now, each with its end time."""
        if self.wire is None or self._at_ns is not None:
            return
        try:
            while (taken := self.wire.take(now_ns)) is not None:
                waiting, end_ns = taken
                self._at_ns = end_ns
                waiting.carry(end_ns)
                if end_ns - waiting.ready_ns > OVERLOAD_BACKLOG_NS:
                    self.load.overloaded = True
        finally:
            self._at_ns = None
        self._set_alarm()

    def _offer(
        self, wire: Wire, frame: Frame, sender: Port | Client, then: Then, origin: Hashable
    ) -> None:
        was_idle = not wire
        accepted = wire.offer(
            frame,
            self._now_ns(),
            sender if origin is None else origin,
            partial(self._carry, frame, sender, then),
        )
        if not accepted:
            sender.dropped += 1
        elif was_idle and self._at_ns is None:
            self._set_alarm()

    def _on_alarm(self) -> None:
        if self._alarm is not None:
            self._alarm.acknowledge()
            self.advance(self._clock_ns())

    def _set_alarm(self) -> None:
        if self._alarm is None or self.wire is None:
            return
        end_ns = self.wire.end_ns()
        if end_ns is not None:
            self._alarm.set(end_ns - self._clock_ns())

    def _flush_soon(self) -> None:
        if not self._flush_due:
            self._flush_due = True
            asyncio.get_running_loop().call_soon(self.flush)

    def flush(self) -> None:
        """Write what waits for the clients now, not after the current callback."""
        self._flush_due = False
        for client in self._clients:
            client.flush()

    def call(self, callback: Callback, frame: Frame) -> None:
        """Call a node or tap. An exception goes to the event loop's handler, not to the sender."""
        try:
            callback(frame)
        except Exception as error:
            message = f"CAN hub {self.name}: {callback!r} failed on frame {frame.can_id:X}h"
            try:
                asyncio.get_running_loop().call_exception_handler(
                    {"message": message, "exception": error}
                )
            except RuntimeError:
                log.exception(message)

    @property
    def dropped(self) -> int:
        """The number of frames that a member lost because it was too slow or had left."""
        of_ports = sum(port.dropped for port in self._ports)
        of_clients = sum(client.dropped for client in self._clients)
        return self._departed_dropped + of_ports + of_clients

    def stats(self) -> dict[str, Any]:
        """Return the counters of the bus by name, and those of its clients."""
        now_ns = self._clock_ns()
        longest_wait_ns = 0 if self.wire is None else self.wire.longest_wait_ns
        return {
            "frames": self.load.frames,
            "dropped": self.dropped,
            "bits": self.load.bits,
            "load_percent": round(self.load.run_percent(now_ns), 3),
            "overloaded": self.load.overloaded,
            "longest_wait_us": longest_wait_ns / 1000.0,
            "clients": [
                {"name": client.name, "dropped": client.dropped} for client in self._clients
            ],
        }

    async def close(self) -> None:
        """Close ports, servers and clients. Clients get what waits for them, for at most 0.5 s."""
        if self._alarm is not None:
            asyncio.get_running_loop().remove_reader(self._alarm.fileno)
            self._alarm.close()
            self._alarm = None
        for server in self._servers:
            server.close()
        for port in self._ports:
            port.close()
        for client in self._clients:
            client.finish()
        if self._clients:
            await asyncio.wait([client.lost for client in self._clients], timeout=CLOSE_TIMEOUT_S)
        for client in self._clients:
            client.abort()
        for server in self._servers:
            await server.wait_closed()
        self._servers.clear()


def _port_in_use(port: int, port_key: str) -> str:
    """Return what is wrong where another program has the port, and how to correct it."""
    another_port = "choose another port in the bus address (0 takes any free one)"
    if port_key:
        another_port = f"give this bench another one: --set {port_key}=N (0 takes any free one)"
    return (
        "the port is already in use, perhaps by another bench; stop its owner "
        f"(ss -ltnp 'sport = :{port}' shows the program) or {another_port}"
    )


def _no_address(error: OSError | OverflowError) -> str:
    """Return why a server cannot have an address, and how to correct it."""
    if isinstance(error, OverflowError):
        return "allowed ports are 0 (any free one) to 65535"
    if error.errno == errno.EACCES:
        return "ports below 1024 need special rights; choose one from 1024 to 65535"
    return f"{error}; allowed is an address of this machine, 127.0.0.1 for local programs"
