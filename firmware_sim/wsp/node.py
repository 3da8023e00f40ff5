"""The reference WSP as a unit on the bus: node 32, which answers every SYNC with the magnets.

After a SYNC it waits for the axle speeds (TPDO1 of node 16), runs one cycle of `wsp`, tells its
reference speed (TPDO1 of node 32) and then the magnets (RPDO1 of node 17). It heartbeats with
every fifth SYNC, before the answer, and by wall clock only while no SYNC comes: so in lockstep,
where time-outs count simulated time, the bus log repeats. Source: CiA 301 (NMT, heartbeat, PDO).

Missing speeds: the last magnets are repeated for `MISSED_MAX` SYNCs, then all magnets fall (the
brakes apply) until speeds are back. A speed sensor that is found stuck is told by an EMCY (code
FF01h, axles as bits in its first manufacturer byte). It starts itself after boot-up, as CiA 302-2 allows (1F80h).
"""

import logging
import signal
import struct
import time
from collections.abc import Callable
from types import FrameType

import can
import numpy as np

from rollerrig.firmware_sim.cia301.nmt import COMMANDED, Command, State
from rollerrig.firmware_sim.wsp import logic
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import NMT, SYNC
from rollerrig.wsp_interface.rig_objects import (
    MAGNETS_ID,
    REFERENCE_SPEED,
    SPEEDS,
    UNIT_EMERGENCY_ID,
    UNIT_HEARTBEAT_ID,
)
from rollerrig.wsp_interface.signals import AXLES, DEFAULT_ADDRESS, WSP_NODE

log = logging.getLogger(__name__)

# CiA 301 Table 26: device specific; error register bit 0
SENSOR_STUCK, GENERIC_ERROR = 0xFF01, 0x01

HEARTBEAT_SYNCS = 5
# longer than any pause between two SYNCs of a bench that runs, shorter than node 17's patience
QUIET_S = 0.1
MISSED_MAX = 5
ALL_OFF = 0


class Unit:
    """One WSP unit on an open bus. `run` returns when the bus ends or after `stop`."""

    def __init__(self, bus: can.BusABC, params: logic.Params) -> None:
        """Compile the cycle and switch on; the bus is not touched before `run`."""
        self.state = State.INITIALISING
        self.answers = 0
        self._bus = bus
        self._params = params
        self._wsp = logic.new_unit(params)
        self._inputs = np.zeros(AXLES, dtype=np.int64)
        self._magnets = ALL_OFF
        self._stuck = 0
        self._syncs = 0
        self._missed = 0
        self._awaiting = False
        self._stopping = False
        self._quiet_until_s = 0.0
        self._take: dict[int, Callable[[can.Message], None]] = {
            NMT: self._command, SYNC: self._sync, SPEEDS.can_id: self._speeds,
        }
        warm(params)

    def run(self) -> None:
        """Serve until the bus ends or `stop` is called; then the magnets are off."""
        try:
            self._boot()
            while not self._stopping:
                self._wait()
            self._leave_operational()
        except can.CanError as error:
            log.info("WSP unit: the bus has ended: %s", error)

    def stop(self) -> None:
        """Ask `run` to end, from a signal handler or another thread; it does within 0.1 s."""
        self._stopping = True

    def _wait(self) -> None:
        rest_s = self._quiet_until_s - time.monotonic()
        message = self._bus.recv(rest_s) if rest_s > 0.0 else None
        if message is not None:
            if not (message.is_extended_id or message.is_remote_frame or message.is_error_frame):
                take = self._take.get(message.arbitration_id)
                if take is not None:
                    take(message)
        elif time.monotonic() >= self._quiet_until_s:
            if self._awaiting:
                self._answer_without_speeds()
            self._heartbeat()

    def _boot(self) -> None:
        """Reset, boot-up message, then OPERATIONAL without waiting for a master."""
        self._wsp, self._stuck = logic.new_unit(self._params), 0
        self._magnets, self._missed, self._syncs = ALL_OFF, 0, 0
        self._awaiting = False
        self.state = State.INITIALISING
        self._heartbeat()
        self.state = State.OPERATIONAL
        self._heartbeat()

    def _command(self, message: can.Message) -> None:
        if len(message.data) != 2 or message.data[1] not in (0, WSP_NODE):
            return
        command = message.data[0]
        if command in (Command.RESET_NODE, Command.RESET_COMMUNICATION):
            self._leave_operational()
            self._boot()
        elif command in tuple(COMMANDED):
            wanted = COMMANDED[Command(command)]
            if wanted is not State.OPERATIONAL:
                self._leave_operational()
            self.state = wanted

    def _leave_operational(self) -> None:
        """Drop the magnets while PDOs are still allowed."""
        if self.state is State.OPERATIONAL:
            self._send(MAGNETS_ID, bytes((ALL_OFF,)))
        self._awaiting = False

    def _sync(self, message: can.Message) -> None:
        self._quiet_until_s = time.monotonic() + QUIET_S
        if self._awaiting:
            self._answer_without_speeds()
        self._syncs += 1
        if self._syncs % HEARTBEAT_SYNCS == 0:
            self._heartbeat()
        self._awaiting = self.state is State.OPERATIONAL
        if self._awaiting and self._missed > MISSED_MAX:
            self._answer_without_speeds()

    def _speeds(self, message: can.Message) -> None:
        if len(message.data) != SPEEDS.struct.size:
            return
        self._missed = 0
        if not self._awaiting:
            return
        self._inputs[:] = SPEEDS.struct.unpack(message.data)
        magnets, reference = logic.cycle(self._wsp, self._inputs)
        self._magnets = int(magnets)
        self._send(REFERENCE_SPEED.can_id, REFERENCE_SPEED.struct.pack(int(reference)))
        self._tell_stuck(int(logic.stuck(self._wsp)))
        self._answer()

    def _tell_stuck(self, axles: int) -> None:
        """An EMCY when a speed sensor is found stuck, one without error when none is any more."""
        if axles != self._stuck:
            self._stuck = axles
            log.info("WSP unit: stuck speed sensors, by axle: %s", f"{axles:04b}"[::-1])
            code = SENSOR_STUCK if axles else 0
            self._send(UNIT_EMERGENCY_ID, struct.pack("<HBB4x", code, GENERIC_ERROR if axles else 0, axles))

    def _answer_without_speeds(self) -> None:
        self._missed += 1
        if self._missed > MISSED_MAX:
            self._magnets = ALL_OFF
        self._answer()

    def _answer(self) -> None:
        self._awaiting = False
        self._send(MAGNETS_ID, bytes((self._magnets,)))
        self.answers += 1

    def _heartbeat(self) -> None:
        self._quiet_until_s = time.monotonic() + QUIET_S
        self._send(UNIT_HEARTBEAT_ID, bytes((self.state,)))

    def _send(self, can_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def warm(params: logic.Params) -> None:
    """Compile the cycle, or load it from numba's cache, before anybody waits for an answer."""
    unit = logic.new_unit(params)
    logic.cycle(unit, np.zeros(AXLES, dtype=np.int64))
    logic.stuck(unit)


def main(bus_address: str = DEFAULT_ADDRESS, config: str = "reference") -> int:
    """Run the reference WSP on a bus until it ends or SIGINT or SIGTERM comes; exit status 0.

    Raises ConfigError for a wrong `config` (name or TOML path), BusError for a bus that cannot be
    opened.
    """
    params = logic.load(config)
    warm(params)
    with buses.open_client(bus_address) as bus:
        unit = Unit(bus, params)

        def on_signal(number: int, frame: FrameType | None) -> None:
            unit.stop()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, on_signal)
        unit.run()
    return 0
