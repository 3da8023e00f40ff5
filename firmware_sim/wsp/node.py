"""A WSP as a unit on the bus, the reference or an FMU: node 32, which answers every SYNC with the magnets.

After a SYNC it waits for what its WSP hears (axle speeds: TPDO1 of node 16), runs one cycle of it, tells its reference
speed (TPDO1 of node 32) and then the magnets (RPDO1 of node 17). It heartbeats before every fifth answer, and before
that when 0.1 s have passed without. A SYNC without speeds is answered when the next one comes, or when none comes. In
lockstep it has no clock: all that it sends there follows from what it hears and ends with an answer, so the bus log
repeats, and 0.1 s are counted in SYNCs. Source: CiA 301 (NMT, heartbeat, PDO).

Missing speeds: the last magnets are repeated for `MISSED_MAX` SYNCs, then all magnets fall (the brakes apply) until
speeds are back. A speed sensor that is found stuck is told by an EMCY (code FF01h, axles as bits in its first
manufacturer byte). It starts itself after boot-up, as CiA 302-2 allows (1F80h).
"""

import logging
import os
import signal
import struct
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import can
import numpy as np

from rollerrig.firmware_sim.cia301.nmt import COMMANDED, Command, State
from rollerrig.firmware_sim.wsp import logic
from rollerrig.wsp_interface import rig_objects as rig
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import NMT, SYNC
from rollerrig.wsp_interface.magnets import ALL_OFF
from rollerrig.wsp_interface.signals import AXLES, DEFAULT_ADDRESS, WSP_NODE

log = logging.getLogger(__name__)

# CiA 301 Table 26: device specific; error register bit 0
SENSOR_STUCK, GENERIC_ERROR = 0xFF01, 0x01

HEARTBEAT_SYNCS = 5
# shorter than the rig's patience
HEARTBEAT_S = 0.1
MISSED_MAX = 5


class Wsp(Protocol):
    """What a unit runs. `hears`: frames whose counts it gets, one behind the other; the last sets off its cycle."""

    hears: tuple[rig.Layout, ...]

    def begin(self) -> None:
        """Forget everything: the unit has been switched on."""

    def cycle(self, counts: np.ndarray) -> tuple[int, int | None]:
        """The byte of magnets, and the reference speed in counts of 0.01 m/s; None: it tells none."""

    def idle(self) -> None:
        """A cycle without speeds has passed."""

    def stuck(self) -> int:
        """The axles whose speed sensors are taken for stuck, bit 0 the leading one."""

    def sand(self) -> bool:
        """Whether sanders shall strew."""


class Serving(Protocol):
    """A unit on an open bus."""

    def run(self) -> None:
        """Serve until the bus ends or `stop` is called."""

    def stop(self) -> None:
        """Ask `run` to end, from a signal handler or another thread; it does within 0.1 s."""


class Reference:
    """The reference WSP of `logic`."""

    hears: tuple[rig.Layout, ...] = (rig.SPEEDS,)

    def __init__(self, params: logic.Params) -> None:
        """Compile the cycle."""
        self._params: Any = params  # its fields are made from a table
        warm(params)

    def begin(self) -> None:
        self._wsp = logic.new_unit(self._params)

    def cycle(self, counts: np.ndarray) -> tuple[int, int | None]:
        magnets, reference = logic.cycle(self._wsp, counts)
        return int(magnets), int(reference)

    def idle(self) -> None:
        pass

    def stuck(self) -> int:
        return int(logic.stuck(self._wsp))

    def sand(self) -> bool:
        """Where it shall: from the first sliding until `calm_s` after the last."""
        cycles, calm = (int(slot[0]) for slot in (self._wsp.state.cycles, self._wsp.state.calm))
        # calm since it was switched on: no wheel has slid yet
        return (
            bool(self._params.sand)
            and calm < cycles
            and calm * self._params.cycle_s < self._params.calm_s
        )


class Unit:
    """One WSP unit on an open bus. `run` returns when the bus ends or after `stop`.

    `lockstep_s` above 0: nothing goes by the wall clock; a SYNC comes every so many seconds of the run.
    """

    def __init__(self, bus: can.BusABC, wsp: Wsp, lockstep_s: float = 0.0) -> None:
        """Switch on; the bus is not touched before `run`."""
        self.state = State.INITIALISING
        self.answers = 0
        self._bus, self._wsp, self._lockstep = bus, wsp, lockstep_s > 0.0
        most = int(HEARTBEAT_S / lockstep_s + 1e-9) if lockstep_s else HEARTBEAT_SYNCS
        self._beat_syncs = min(max(most, 1), HEARTBEAT_SYNCS)
        self._inputs = np.zeros(AXLES * len(wsp.hears), dtype=np.int64)
        # frames heard since the last SYNC
        self._heard: set[int] = set()
        self._awaiting = self._stopping = False
        self._beat_s = self._synced_s = 0.0
        self._take: dict[int, Callable[[can.Message], None]] = {
            NMT: self._command,
            SYNC: self._sync,
            **{
                one.can_id: partial(self._hear, one, slice(AXLES * at, AXLES * (at + 1)))
                for at, one in enumerate(wsp.hears)
            },
        }
        bus.set_filters(
            [{"can_id": one, "can_mask": 0x7FF, "extended": False} for one in self._take]
        )

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
        rest_s = self._beat_s - time.monotonic()
        message = self._bus.recv(rest_s) if rest_s > 0.0 else None
        if message is not None:
            take = self._take.get(message.arbitration_id)
            if take and not (
                message.is_extended_id or message.is_remote_frame or message.is_error_frame
            ):
                take(message)
        elif self._lockstep:
            self._beat_s = time.monotonic() + HEARTBEAT_S
        elif (now_s := time.monotonic()) >= self._beat_s:
            if self._awaiting and now_s >= self._synced_s + HEARTBEAT_S:
                self._answer_without_speeds()
            self._heartbeat()

    def _boot(self) -> None:
        """Reset, boot-up message, then OPERATIONAL without waiting for a master."""
        self._wsp.begin()
        self._stuck = 0
        self._magnets, self._missed, self._syncs = ALL_OFF, 0, 0
        self._awaiting = self._sand = False
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
        elif command in COMMANDED:
            wanted = COMMANDED[Command(command)]
            if wanted is not State.OPERATIONAL:
                self._leave_operational()
            self.state = wanted

    def _leave_operational(self) -> None:
        """Drop the magnets while PDOs are still allowed."""
        if self.state is State.OPERATIONAL:
            self._send(rig.MAGNETS_ID, bytes((ALL_OFF,)))
        self._awaiting = False

    def _sync(self, message: can.Message) -> None:
        if len(message.data) > 1:
            return
        self._synced_s = time.monotonic()
        if self._awaiting:
            self._answer_without_speeds()
        self._heard.clear()
        self._syncs += 1
        self._awaiting = self.state is State.OPERATIONAL
        if not self._awaiting:
            self._heartbeat_if_due()

    def _hear(self, layout: rig.Layout, place: slice, message: can.Message) -> None:
        if len(message.data) != layout.struct.size:
            return
        self._inputs[place] = layout.struct.unpack(message.data)
        self._heard.add(layout.can_id)
        if layout is not self._wsp.hears[-1]:
            return
        if len(self._heard) < len(self._wsp.hears):
            if self._awaiting:
                self._answer_without_speeds()
            return
        self._missed = 0
        if not self._awaiting:
            return
        self._heartbeat_if_due()
        self._magnets, reference = self._wsp.cycle(self._inputs)
        if reference is not None:
            self._send(rig.REFERENCE_SPEED.can_id, rig.REFERENCE_SPEED.struct.pack(reference))
        self._tell_stuck(self._wsp.stuck())
        self._ask_for_sand()
        self._answer()

    def _tell_stuck(self, axles: int) -> None:
        """An EMCY when a speed sensor is found stuck, one without error when none is any more."""
        if axles != self._stuck:
            self._stuck = axles
            log.info("WSP unit: stuck speed sensors, by axle: %s", f"{axles:04b}"[::-1])
            code = SENSOR_STUCK if axles else 0
            self._send(
                rig.UNIT_EMERGENCY_ID,
                struct.pack("<HBB4x", code, GENERIC_ERROR if axles else 0, axles),
            )

    def _ask_for_sand(self) -> None:
        """Tell the sanders when what the unit wants of them changes."""
        wanted = self._wsp.sand()
        if wanted != self._sand:
            self._sand = wanted
            self._send(rig.SAND_ID, bytes((rig.ALL_SANDERS * wanted,)))

    def _answer_without_speeds(self) -> None:
        self._heartbeat_if_due()
        self._wsp.idle()
        self._missed += 1
        if self._missed > MISSED_MAX:
            self._magnets = ALL_OFF
        self._answer()

    def _answer(self) -> None:
        self._awaiting = False
        self._send(rig.MAGNETS_ID, bytes((self._magnets,)))
        self.answers += 1

    def _heartbeat_if_due(self) -> None:
        if self._syncs % self._beat_syncs == 0:
            self._heartbeat()

    def _heartbeat(self) -> None:
        self._beat_s = time.monotonic() + HEARTBEAT_S
        self._send(rig.UNIT_HEARTBEAT_ID, bytes((self.state,)))

    def _send(self, can_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def warm(params: logic.Params) -> None:
    """Compile the cycle, or load it from numba's cache, before anybody waits for an answer."""
    unit = logic.new_unit(params)
    logic.cycle(unit, np.zeros(AXLES, dtype=np.int64))
    logic.stuck(unit)


def main(
    bus_address: str = DEFAULT_ADDRESS,
    config: str = "reference",
    priority: int = 0,
    lockstep_s: float = 0.0,
) -> int:
    """Run the reference WSP on a bus until it ends or SIGINT or SIGTERM comes; exit status 0.

    It asks for SCHED_FIFO with a `priority` above 0 and goes on where that is refused. Raises ConfigError
    for a wrong `config` (name or TOML path), BusError for a bus that cannot be opened.
    """
    wsp = Reference(logic.load(config))
    return serve(lambda bus: Unit(bus, wsp, lockstep_s), bus_address, priority, lockstep_s)


def serve(
    built: Callable[[can.BusABC], Serving],
    bus_address: str,
    priority: int,
    lockstep_s: float,
    errors: bool = False,
) -> int:
    """Run a unit on a bus, as `main` does the reference; `errors` as `open_client` has it. Raises BusError."""
    with buses.open_client(bus_address, 60.0 if lockstep_s else 3.0, errors, ahead=True) as bus:
        unit = built(bus)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: unit.stop())
        if priority:
            try:
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
                for thread in {*threading.enumerate()} - {
                    threading.current_thread()
                }:  # what watches the unit
                    os.sched_setscheduler(
                        thread.native_id or 0, os.SCHED_FIFO, os.sched_param(min(priority + 1, 99))
                    )
            except OSError as error:
                print(
                    f"info: SCHED_FIFO priority {priority} was refused: {error.strerror}",
                    flush=True,
                )
        unit.run()
    return 0
