"""A hub in a separate thread, as in the bench, for tests with blocking clients."""

import asyncio
import contextlib
import socket
import threading
import time

import pytest

from rollerrig.wsp_interface.bus.hub import Hub


class HubThread:
    """A hub on a free loopback port.

    log: the frames that a tap has received.
    problems: exceptions that reached the event loop.
    """

    def __init__(self, **hub_options) -> None:
        self.loop = asyncio.new_event_loop()
        self.problems: list[dict] = []
        self.loop.set_exception_handler(lambda loop, context: self.problems.append(context))
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.log = []
        self.hub = self.do(lambda: Hub(time.monotonic_ns, **hub_options))
        self.do(lambda: self.hub.tap(self.log.append))
        self.port = self.listen("socketcand")

    def do(self, function):
        """Run a plain function, or a coroutine function, in the hub's thread; return its result."""

        async def run():
            result = function()
            return await result if asyncio.iscoroutine(result) else result

        return asyncio.run_coroutine_threadsafe(run(), self.loop).result(60)

    def node(self, receive=lambda frame: None):
        """Attach a node in the process to the hub; return its port."""
        return self.do(lambda: self.hub.attach(receive))

    def send(self, port, *sent) -> None:
        """Send frames from a port, all in one callback of the hub's thread."""

        def send_all():
            for frame in sent:
                port.send(frame)

        self.do(send_all)

    def listen(self, codec: str) -> int:
        """Open a port for a protocol; return its number."""
        return self.do(lambda: self.hub.listen(codec, port=0))

    def address(self) -> str:
        return f"127.0.0.1:{self.port}/rig0"

    def connect(self, port: int | None = None, source: str = "127.0.0.1") -> socket.socket:
        """Return a client's socket before the handshake; `source` is the client's address."""
        connection = socket.create_connection(
            ("127.0.0.1", port or self.port), 60, source_address=(source, 0)
        )
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def raw_mode(self, source: str = "127.0.0.1") -> socket.socket:
        """Return a client's socket that has completed the handshake."""
        client = self.connect(source=source)
        for command, answer in (
            (b"", b"< hi >"),
            (b"< open rig0 >", b"< ok >"),
            (b"< rawmode >", b"< ok >"),
        ):
            client.sendall(command)
            assert client.recv(256) == answer
        return client

    def until(self, condition) -> bool:
        """Return whether the condition comes true within a minute."""
        end_s = time.monotonic() + 60.0
        while time.monotonic() < end_s:
            if condition():
                return True
            time.sleep(0.002)
        return False

    def close(self) -> None:
        if self.loop.is_running():
            self.do(self.hub.close)
            self.loop.call_soon_threadsafe(self.loop.stop)
            self.thread.join(60)
            self.loop.close()


@pytest.fixture
def start_hub():
    """Return a function that starts hubs; they are closed after the test."""
    with contextlib.ExitStack() as stack:

        def start(**hub_options) -> HubThread:
            hub_thread = HubThread(**hub_options)
            stack.callback(hub_thread.close)
            return hub_thread

        yield start


@pytest.fixture
def bench(start_hub):
    return start_hub()
