"""A unit that sends again what a unit has sent in a recorded log of the bus.

The log is cut at its SYNCs. After the n-th SYNC of the bench, when the speeds have come, the frames
follow that the unit had sent after the n-th SYNC of the log: in lockstep at once, in real time with
the delays of the log. After the end of the log the magnets are off, and the heartbeat goes on.

Formats are those of python-can with these suffixes: candump (.log), Vector (.blf, .asc) and PEAK
(.trc).
"""

import logging
import time
from pathlib import Path
from typing import NamedTuple

import can

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.cia301.nmt import State
from rollerrig.firmware_sim.wsp import node
from rollerrig.wsp_interface import rig_objects as rig
from rollerrig.wsp_interface.bus.connection_set import SYNC
from rollerrig.wsp_interface.magnets import ALL_OFF

log = logging.getLogger(__name__)

SUFFIXES = (".log", ".blf", ".asc", ".trc")
# how long `run` waits for a frame before it looks whether it shall stop
_LOOK_S = 0.1


class Frame(NamedTuple):
    """A frame of the unit, and its time in s after the SYNC before it."""

    can_id: int
    data: bytes
    delay_s: float


class Log(NamedTuple):
    """What a unit has sent: before the first SYNC, and after each SYNC."""

    boot: tuple[Frame, ...]
    cycles: tuple[tuple[Frame, ...], ...]


def read(path: Path, frames: rig.UnitFrames) -> Log:
    """Return what the unit of a group has sent in a log. Raises ConfigError."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(
            f"{path}: no log of the bus that can be replayed; allowed are {', '.join(SUFFIXES)}: "
            "candump, BLF, ASC and TRC"
        )
    user_files.check(path, user_files.CAN_LOG)
    sent = {
        frames.magnets_id,
        frames.heartbeat_id,
        frames.reference_speed.can_id,
        frames.emergency_id,
        frames.sand_id,
        frames.shares_id,
    }
    boot: list[Frame] = []
    cycles: list[list[Frame]] = []
    synced_s = 0.0
    try:
        with can.LogReader(path) as messages:
            for message in messages:
                if message.is_extended_id or message.is_remote_frame or message.is_error_frame:
                    continue
                if message.arbitration_id == SYNC:
                    cycles.append([])
                    synced_s = message.timestamp
                elif message.arbitration_id in sent:
                    delay_s = max(message.timestamp - synced_s, 0.0) if cycles else 0.0
                    found = Frame(message.arbitration_id, bytes(message.data), delay_s)
                    (cycles[-1] if cycles else boot).append(found)
    # the readers raise errors of many kinds for files that are none
    except Exception as error:
        raise ConfigError(
            f"{path}: cannot be read as a log of the bus: {type(error).__name__}: {error}; the "
            "suffix says the format"
        ) from None
    if not cycles:
        raise ConfigError(
            f"{path}: has no SYNC (080h), which tells when a unit has to answer; record all frames of "
            "the bus"
        )
    if not any(frame.can_id == frames.magnets_id for cycle in cycles for frame in cycle):
        raise ConfigError(
            f"{path}: has no command of a unit ({frames.magnets_id:03X}h) after a SYNC; record the "
            "bus of a unit, or choose its group with --group"
        )
    return Log(tuple(boot), tuple(tuple(cycle) for cycle in cycles))


class Replay:
    """The unit of a log on an open bus. `run` returns when the bus ends or after `stop`.

    lockstep_s: period of SYNC in lockstep, in simulated s; 0 in real time.
    """

    def __init__(
        self, bus: can.BusABC, found: Log, frames: rig.UnitFrames, lockstep_s: float = 0.0
    ) -> None:
        """Switch on; the bus is not touched before `run`."""
        self._bus = bus
        self._log = found
        self._frames = frames
        self._lockstep = lockstep_s > 0.0
        self._syncs = 0
        self._synced_s = 0.0
        self._awaiting = False
        self._stopping = False
        bus.set_filters(
            [
                {"can_id": can_id, "can_mask": 0x7FF, "extended": False}
                for can_id in (SYNC, frames.speeds.can_id)
            ]
        )

    def run(self) -> None:
        """Serve until the bus ends or `stop` is called; then the magnets are off."""
        try:
            for frame in self._log.boot:
                self._send(frame.can_id, frame.data)
            if not any(frame.can_id == self._frames.heartbeat_id for frame in self._log.boot):
                self._send(self._frames.heartbeat_id, bytes((State.OPERATIONAL,)))
            while not self._stopping:
                self._take(self._bus.recv(_LOOK_S))
            self._send(self._frames.magnets_id, bytes((ALL_OFF,)))
        except can.CanError as error:
            log.info("replay: the bus has ended: %s", error)

    def stop(self) -> None:
        """Ask `run` to end, from a signal handler or another thread; it does within 0.1 s."""
        self._stopping = True

    def _take(self, message: can.Message | None) -> None:
        """Answer a SYNC when its speeds come, or the next SYNC if they do not."""
        if message is None:
            return
        if message.arbitration_id == SYNC:
            if self._awaiting:
                self._answer()
            self._syncs += 1
            self._synced_s = time.monotonic()
            self._awaiting = True
        elif self._awaiting:
            self._answer()

    def _answer(self) -> None:
        """Send the frames of this cycle of the log."""
        self._awaiting = False
        if self._syncs > len(self._log.cycles):
            self._answer_after_the_end()
            return
        for frame in self._log.cycles[self._syncs - 1]:
            rest_s = self._synced_s + frame.delay_s - time.monotonic()
            if not self._lockstep and rest_s > 0.0:
                time.sleep(min(rest_s, _LOOK_S))
            self._send(frame.can_id, frame.data)

    def _answer_after_the_end(self) -> None:
        if self._syncs == len(self._log.cycles) + 1:
            print(f"replay: the log has ended after {len(self._log.cycles)} SYNCs", flush=True)
        if self._syncs % node.HEARTBEAT_SYNCS == 0:
            self._send(self._frames.heartbeat_id, bytes((State.OPERATIONAL,)))
        self._send(self._frames.magnets_id, bytes((ALL_OFF,)))

    def _send(self, can_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
