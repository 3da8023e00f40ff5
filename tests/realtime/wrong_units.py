"""WSP units that do one thing wrong, as programs on the bus of a bench."""

import contextlib
import threading

import can
from bench_process import HEARTBEAT, MAGNETS, SYNC

from rollerrig.wsp_interface.bus import buses

BOOTS = b"\x00"
OPERATES = b"\x05"
FILLS = b"\x00"
VENTS = b"\xff"


def data_frame(can_id, data, extended=False):
    """A data frame of 11 or 29 bits."""
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=extended)


def remote_frame(can_id):
    """A remote frame that requests one byte."""
    return can.Message(arbitration_id=can_id, is_remote_frame=True, dlc=1, is_extended_id=False)


COMMAND = data_frame(MAGNETS, FILLS)
BEAT = data_frame(HEARTBEAT, OPERATES)
START = (data_frame(HEARTBEAT, BOOTS), BEAT)


class Unit:
    """A unit that sends `answer(n)` after SYNC number n, from 1, and its beats with every fifth.

    `answer` returns frames, or None: then the unit does nothing more, but stays connected. `first`
    are the frames that it sends before all others. Without SYNCs it sends its beats every 0.1 s.
    """

    def __init__(self, address, answer, first=START, beats=(BEAT,)):
        self.bus = buses.open_client(address)
        self.answer = answer
        self.first = first
        self.beats = beats
        self.syncs = 0
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _serve(self):
        with contextlib.suppress(can.CanError):
            self._send(self.first)
            while True:
                message = self.bus.recv(0.1)
                if message is None:
                    self._send(self.beats)
                elif message.arbitration_id == SYNC and not message.is_extended_id:
                    self.syncs += 1
                    if self.syncs % 5 == 0:
                        self._send(self.beats)
                    frames = self.answer(self.syncs)
                    if frames is None:
                        return
                    self._send(frames)
                else:
                    self.take(message)

    def take(self, message):
        """Take a message that is no SYNC."""

    def _send(self, frames):
        for frame in frames:
            self.bus.send(frame)

    def close(self):
        self.bus.shutdown()
        self.thread.join(5.0)
