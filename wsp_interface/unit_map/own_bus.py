"""A bus of the unit's own, so that its messages may have identifiers that the rig uses.

The bus is a hub in a thread of this process, or an interface of python-can such as a CAN card.
"""

import asyncio
import contextlib
import select
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can

from rollerrig.configs import output_files
from rollerrig.configs.errors import BusError, ConfigError
from rollerrig.wsp_interface.bus import plugin
from rollerrig.wsp_interface.bus.frames import S_NS, candump_line
from rollerrig.wsp_interface.bus.hub import Hub

OWN = "own"
NAME = "unit0"
_FREE = f"socketcand://127.0.0.1:0/{NAME}"
_HUB = "socketcand:"


def check(given: Any, where: str) -> str:
    """Return the address of the unit's bus; "" for the bus of the rig. Raises ConfigError."""
    if given == OWN:
        return _FREE
    if isinstance(given, str) and (not given or given.partition(":")[2]):
        return given
    raise ConfigError(
        f'{where}: bus = {given!r}: write "{OWN}" for a bus on a free port, an address such as '
        f'"socketcand://127.0.0.1:29540/{NAME}" for a unit that you start, or "socketcan:can1" for an '
        "interface; without this key the unit is on the bus of the rig"
    )


@contextlib.contextmanager
def served(address: str) -> Iterator[str]:
    """Serve the bus at an address while the block runs; yield the address for programs.

    An interface of python-can is there already, and is yielded as it is. Raises BusError.
    """
    if not address.startswith(_HUB):
        yield address
        return
    try:
        host, port, name = plugin.parse_address(address)
    except ValueError as error:
        raise BusError(str(error)) from error
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="bus of the unit", daemon=True)
    thread.start()

    async def open_hub() -> tuple[Hub, int]:
        hub = Hub(time.monotonic_ns, name=name)
        return hub, await hub.listen("socketcand", host, port)

    try:
        hub, bound = asyncio.run_coroutine_threadsafe(open_hub(), loop).result()
        try:
            yield f"{_HUB}//{host}:{bound}/{name}"
        finally:
            asyncio.run_coroutine_threadsafe(hub.close(), loop).result()
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@contextlib.contextmanager
def logged(path: Path) -> Iterator[Callable[[can.Message, float], None]]:
    """Yield a function that writes a message, with its time in s, as `candump -l` does."""
    with output_files.create(path) as file:

        def write(message: can.Message, time_s: float) -> None:
            frame = plugin.frame_of(message)
            if frame is not None:
                line = candump_line(frame._replace(time_ns=round(time_s * S_NS)), NAME)
                file.write(f"{line}\n".encode())

        yield write


def wait(one: can.BusABC, other: can.BusABC, timeout_s: float) -> None:
    """Wait until a frame of one of two buses can be received, or until the time is up."""
    descriptors = [one.fileno(), other.fileno()]
    if min(descriptors) < 0:
        # an interface without a descriptor is asked again and again
        time.sleep(min(timeout_s, 1e-3))
        return
    select.select(descriptors, [], [], timeout_s)
