"""One CAN bus carried inside the bench process, which programs outside join over TCP.

Every frame gets one time stamp and one place in one order, then goes to the taps, to the nodes in
the process (a plain call) and, encoded once for each protocol, to the clients. What is sent within
one callback of the event loop leaves in one write for each client, and a client that reads too
slowly loses frames, counted, instead of holding up the rig. Nobody gets their own frames back.

By default the bus is ideal: a frame is delivered at once, and the bit rate is only accounted for
(`load`). After `arbitrate` frames wait for the wire as on a real bus, lowest identifier first, each
for its bits' time; time is that of the hub's clock, simulated or real.

Threads: a hub lives in the thread of its event loop; call it from nowhere else. Limits: no acknowledge; error frames
only where a fault asks for them (`destroy`), and for clients that ask for them, with the identifier of what was
destroyed behind their content. The protocols have no authentication: loopback only, unless another host is asked for.
"""

import asyncio
import errno
import ipaddress
import logging
from collections import deque
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.bus.client import Client
from rollerrig.wsp_interface.bus.codecs import CODECS
from rollerrig.wsp_interface.bus.connection_set import SDO_REPLY, SYNC
from rollerrig.wsp_interface.bus.frames import OVERLOAD_BACKLOG_NS, BusLoad, Frame, check
from rollerrig.wsp_interface.bus.wire import Alarm, Wire
from rollerrig.wsp_interface.events import Code, OnEvent

log = logging.getLogger(__name__)

CLIENTS_MAX = 32  # of each protocol, so that descriptors never run out
BUFFER_BYTES = 1 << 20  # for each client; about 25 000 frames, or five seconds of a full bus
CLOSE_TIMEOUT_S = 0.5
# CAN_ERR_PROT and CAN_ERR_BUSERROR; CAN_ERR_PROT_TX
_BUS_ERROR, _ON_TRANSMISSION = 0x088, 0x80

Callback = Callable[[Frame], None]
Then = Callable[[], None] | None
Gate = Callable[["Port | Client", Frame, Callable[[], None]], bool]


class Port:
    """A place on the bus for a node of this process."""

    def __init__(
        self, hub: "Hub", callback: Callback, name: str, on_close: Callable[[], None] | None
    ) -> None:
        self.name, self.dropped = name, 0
        self._hub: Hub | None = hub
        self._callback, self._on_close = callback, on_close

    def send(self, frame: Frame, then: Then = None, origin: Hashable = None) -> None:
        """Put a frame on the bus; ValueError when it is no CAN frame, counted when closed.

        `then()` is called when the bus has carried it; `origin` is whose transmit queue it waits in,
        where several nodes share a port.
        """
        if self._hub is None:
            self.dropped += 1
            return
        self._hub.submit(check(frame), self, then, origin)

    def deliver(self, frame: Frame) -> None:
        """Hand the node a frame of somebody else; its exceptions harm nobody else."""
        if self._hub is not None:
            self._hub.call(self._callback, frame)

    def close(self) -> None:
        """Leave the bus; no more calls come."""
        if self._hub is not None:
            hub, self._hub = self._hub, None
            hub.leave(self)
            if self._on_close:
                self._on_close()


def log_event(code: Code, /, **fields: Any) -> None:
    """Log an event: the callback of a hub that nobody gives another one."""
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

    `clock_ns` gives the time that every frame is stamped with. The hub calls `on_event(code, **fields)`
    for clients that it refuses and for addresses that other machines reach.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        bitrate: int = 500_000,
        name: str = "rig0",
        buffer_bytes: int = BUFFER_BYTES,
        on_event: OnEvent = log_event,
    ) -> None:
        self.name, self.buffer_bytes, self._on_event = name, buffer_bytes, on_event
        self._warned: set[tuple[Code, str]] = set()
        self.load = BusLoad(bitrate, clock_ns())
        self._clock_ns = clock_ns
        self._waiting: deque[tuple[Frame, Port | Client, Then]] = deque()
        self._carrying = False
        self.wire: Wire | None = None
        # simulated time waits for somebody: services, which nobody may have to wait for, then pass
        # beside the wire, or a client that asks before it answers would wait for ever
        self.still = False
        # told what is sent and by whom, whether or not the bus will carry it
        self.arrived: Callable[[Frame, Port | Client], None] | None = None
        self._alarm: Alarm | None = None
        self._at_ns: int | None = None  # the end of the frame that the wire carries
        self._flush_due = False
        # whose frames bring the time at which they came; no frame is stamped before an earlier one
        self.stamped_by: Port | None = None
        self._latest_ns = 0
        # tuples are replaced, not changed: a callback may attach or close while frames go out
        self._taps: tuple[Callback, ...] = ()
        self._ports: tuple[Port, ...] = ()
        self._clients: tuple[Client, ...] = ()
        self._servers: list[asyncio.Server] = []
        # decides whether a frame goes on now, and may call what carries it later
        self.gate: Gate | None = None
        self._gone_dropped = 0  # drops of those that have left

    def attach(
        self, callback: Callback, name: str = "node", on_close: Callable[[], None] | None = None
    ) -> Port:
        """Join as a node: callback(frame) for frames of others, on_close() when the port closes."""
        port = Port(self, callback, name, on_close)
        self._ports = (*self._ports, port)
        return port

    def tap(self, callback: Callback) -> None:
        """Call callback(frame) for every frame, before the nodes see it."""
        self._taps = (*self._taps, callback)

    async def listen(
        self, codec: str = "socketcand", host: str = "127.0.0.1", port: int | None = None
    ) -> int:
        """Accept TCP clients of a protocol of `codecs.CODECS`; return the port number.

        Port 0 takes a free one, None the protocol's usual one. Raises BusError when the protocol
        is unknown or the address cannot be used.
        """
        if codec not in CODECS:
            raise BusError(
                f"CAN hub {self.name}: unknown protocol {codec!r}; allowed: {', '.join(CODECS)}"
            )
        row = CODECS[codec]
        port = row.port if port is None else port
        try:
            # "localhost" may be two addresses, and a free port would then be two ports
            server = await asyncio.get_running_loop().create_server(
                lambda: Client(self, codec, row), "127.0.0.1" if host == "localhost" else host, port
            )
        except (OSError, OverflowError) as error:
            raise BusError(_why_not(self.name, codec, host, port, error)) from error
        self._servers.append(server)
        address = server.sockets[0].getsockname()
        if beyond_loopback(address[0]):
            self._on_event(
                Code.SERVER_EXPOSED,
                server=f"CAN HUB {self.name} ({codec})",
                host=address[0],
                port=address[1],
                who="WITHOUT ANY AUTHENTICATION",
            )
        return int(address[1])

    def join(self, client: Client) -> bool:
        """Take in a TCP client that has connected; False where there is no room for it."""
        if sum(one.codec == client.codec for one in self._clients) >= CLIENTS_MAX:
            self.warn(Code.HUB_FULL, client.codec, clients_max=CLIENTS_MAX)
            return False
        self._clients = (*self._clients, client)
        return True

    def warn(self, code: Code, protocol: str, **fields: Any) -> None:
        """Report an event of a protocol, the same only once: many clients may have the same trouble."""
        if (code, protocol) not in self._warned:
            self._warned.add((code, protocol))
            self._on_event(code, bus=self.name, protocol=protocol, **fields)

    def leave(self, member: Port | Client) -> None:
        """Let a node or client go; its drops stay counted."""
        self._gone_dropped += member.dropped
        member.dropped = 0
        self._ports = tuple(port for port in self._ports if port is not member)
        self._clients = tuple(client for client in self._clients if client is not member)

    def submit(
        self, frame: Frame, sender: Port | Client, then: Then = None, origin: Hashable = None
    ) -> None:
        """Queue a frame, as an answer would else overtake its question to the nodes behind; carry what waits."""
        if self.arrived is not None:
            self.arrived(frame, sender)
        if self.gate is None or self.gate(
            sender, frame, partial(self._queue, frame, sender, then, origin)
        ):
            self._queue(frame, sender, then, origin)

    def destroy(
        self, frame: Frame, transmit_errors: int, receive_errors: int = 0, by_sender: bool = True
    ) -> None:
        """An error frame ends a frame, with the counters of who found the error. Source: Linux can/error.h"""
        now_ns = self._now_ns()
        state = bytes(
            (0, 0, _ON_TRANSMISSION if by_sender else 0, 0, 0, 0, transmit_errors, receive_errors)
        )
        self.load.carry(frame, now_ns)
        if self.wire is not None:
            self.wire.occupy(frame, now_ns)
        self.tell_error(_BUS_ERROR, state, now_ns)
        error = Frame(
            _BUS_ERROR, state + frame.can_id.to_bytes(4, "little"), time_ns=now_ns, error=True
        )
        for client in self._clients:
            if client.listening and client.errors:
                client.put(client.encode(error))
                self._flush_soon()

    def tell_error(self, kind: int, state: bytes, at_ns: int | None = None) -> None:
        """Let the taps see an error frame of a class and content of Linux can/error.h, now."""
        now_ns = self._now_ns() if at_ns is None else at_ns
        for tap in self._taps:
            self.call(tap, Frame(kind, state, time_ns=now_ns, error=True))

    def _now_ns(self) -> int:
        return self._clock_ns() if self._at_ns is None else self._at_ns

    def _queue(self, frame: Frame, sender: Port | Client, then: Then, origin: Hashable) -> None:
        # services: NMT below SYNC; SDO, heartbeats and LSS from the SDO replies on
        if self.wire is not None and not (
            self.still and (frame.extended or not SYNC <= frame.can_id < SDO_REPLY)
        ):
            self._offer(self.wire, frame, sender, then, origin)
            return
        self._waiting.append((frame, sender, then))
        if self._carrying:
            return
        self._carrying = True
        try:
            while self._waiting:
                self._carry(*self._waiting.popleft(), self._now_ns())
        finally:
            self._carrying = False

    def _carry(self, frame: Frame, sender: Port | Client, then: Then, now_ns: int) -> None:
        """Stamp one frame and give it to everybody but its sender."""
        if self.stamped_by is not None:
            now_ns = max(frame.time_ns, self._latest_ns) if sender is self.stamped_by else now_ns
            self._latest_ns = now_ns
        stamped = Frame(frame.can_id, frame.data, frame.extended, frame.remote, frame.dlc, now_ns)
        self.load.carry(stamped, now_ns)
        for tap in self._taps:
            self.call(tap, stamped)
        for port in self._ports:
            if port is not sender:
                port.deliver(stamped)
        wires: dict[str, bytes] = {}
        for client in self._clients:
            if client is not sender and client.listening:
                if client.codec not in wires:
                    wires[client.codec] = client.encode(stamped)
                client.put(wires[client.codec])
        if then is not None:
            then()
        if wires:
            self._flush_soon()

    def arbitrate(self, timed: bool) -> None:
        """From now on frames wait for the wire; once done it stays so.

        `timed`: they are carried by the event loop as the clock goes; else by `advance`, which
        whoever moves simulated time has to call. To be called in the event loop.
        """
        if self.wire is not None:
            return
        self.wire = Wire(self.load.bitrate, self._clock_ns())
        if timed:
            self._alarm = Alarm()
            asyncio.get_running_loop().add_reader(self._alarm.fileno, self._ring)

    def advance(self, now_ns: int) -> None:
        """Carry every frame whose last bit has left the wire by now, each at its own time."""
        if self.wire is None or self._at_ns is not None:
            return
        try:
            while (found := self.wire.take(now_ns)) is not None:
                one, self._at_ns = found
                one.carry(self._at_ns)
                if self._at_ns - one.ready_ns > OVERLOAD_BACKLOG_NS:
                    self.load.overloaded = True
        finally:
            self._at_ns = None
        self._set_alarm()

    def _offer(
        self, wire: Wire, frame: Frame, sender: Port | Client, then: Then, origin: Hashable
    ) -> None:
        idle = not wire
        if not wire.offer(
            frame,
            self._now_ns(),
            sender if origin is None else origin,
            partial(self._carry, frame, sender, then),
        ):
            sender.dropped += 1
        elif idle and self._at_ns is None:
            self._set_alarm()

    def _ring(self) -> None:
        if self._alarm is not None:
            self._alarm.acknowledge()
            self.advance(self._clock_ns())

    def _set_alarm(self) -> None:
        if (
            self._alarm is not None
            and self.wire is not None
            and (end_ns := self.wire.end_ns()) is not None
        ):
            self._alarm.set(end_ns - self._clock_ns())

    def _flush_soon(self) -> None:
        if not self._flush_due:
            self._flush_due = True
            asyncio.get_running_loop().call_soon(self.flush)

    def flush(self) -> None:
        """Write now what waits for the clients; happens by itself after the current callback."""
        self._flush_due = False
        for client in self._clients:
            client.flush()

    def call(self, callback: Callback, frame: Frame) -> None:
        """Call a node or tap; an exception is reported to the event loop, not to the sender."""
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
        """Frames that somebody did not get because they read too slowly or had left."""
        return (
            self._gone_dropped
            + sum(one.dropped for one in self._ports)
            + sum(one.dropped for one in self._clients)
        )

    def stats(self) -> dict[str, Any]:
        """Return the counters: frames, dropped, bits, load [percent], overloaded, longest wait, clients."""
        now_ns = self._clock_ns()
        return {
            "frames": self.load.frames,
            "dropped": self.dropped,
            "bits": self.load.bits,
            "load_percent": round(self.load.run_percent(now_ns), 3),
            "overloaded": self.load.overloaded,
            "longest_wait_us": self.wire.longest_wait_ns / 1000.0 if self.wire is not None else 0.0,
            "clients": [
                {"name": client.name, "dropped": client.dropped} for client in self._clients
            ],
        }

    async def close(self) -> None:
        """Close ports, servers and clients; what clients have still to get is sent for 0.5 s."""
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


def _why_not(name: str, codec: str, host: str, port: int, error: OSError | OverflowError) -> str:
    code = error.errno if isinstance(error, OSError) else None
    why = f"{error}; allowed is an address of this machine, 127.0.0.1 for local programs"
    if isinstance(error, OverflowError):
        why = "allowed ports are 0 (any free one) to 65535"
    elif code == errno.EADDRINUSE:
        why = (
            f"the port is already in use, perhaps by another bench; stop its holder (ss -ltnp 'sport = :{port}' "
            "shows who it is) or choose another port in the bus address (0 takes any free one)"
        )
    elif code == errno.EACCES:
        why = "ports below 1024 need rights; choose one from 1024 to 65535"
    return f"CAN hub {name}: cannot listen for {codec} on {host}:{port}: {why}"
