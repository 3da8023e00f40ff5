"""A WSP (the reference, or an FMU) as a unit on the bus: node 32, which answers each SYNC with the
magnets.

After a SYNC the unit waits for the input frames of its WSP (axle speeds: TPDO1 of node 16) and runs
one cycle. It sends its reference speed (TPDO1 of node 32) and then the magnets (RPDO1 of node 17).
It sends a heartbeat before every fifth answer, or earlier if 0.1 s have passed without one. If the
speeds after a SYNC are missing, the unit answers when the next SYNC comes, or after 0.1 s without
one.

In lockstep the unit has no clock. It sends only in reaction to frames, and an answer is always the
last frame, so that the bus log repeats. 0.1 s are counted in SYNCs there.

Missing speeds: the unit repeats the last magnets for `MISSED_MAX` SYNCs. Then all magnets are off
(the brakes apply) until speeds are back. An EMCY reports rejected speed sensors (code FF01h, axles
as bits in the first manufacturer byte). The unit starts itself after boot-up, as CiA 302-2 allows
(1F80h). Source: CiA 301 (NMT, heartbeat, PDO).
"""

import gc
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

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import memory
from rollerrig.configs.vehicle import AXLES_OF_GROUP, COACH, MOST_AXLES, Kind
from rollerrig.firmware_sim.cia301.nmt import STATE_AFTER, Command, State
from rollerrig.firmware_sim.wsp import logic
from rollerrig.wsp_interface import rig_objects as rig
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import NMT, SYNC
from rollerrig.wsp_interface.magnets import ALL_OFF
from rollerrig.wsp_interface.signals import DEFAULT_ADDRESS

log = logging.getLogger(__name__)

SENSOR_STUCK = 0xFF01  # error code, CiA 301 Table 26: device specific

HEARTBEAT_SYNCS = 5  # SYNCs between heartbeats
HEARTBEAT_S = 0.1  # at most; shorter than the time after which the rig counts the unit as lost
MISSED_MAX = 5  # SYNCs without speeds for which the magnets are repeated


_HIGHEST_PRIORITY = 99  # of SCHED_FIFO


class Wsp(Protocol):
    """The WSP that a unit runs.

    `hears`: its input frames, whose counts it gets in this order; the last one triggers its cycle.
    """

    hears: tuple[rig.Layout, ...]

    def begin(self) -> None:
        """Begin again: the unit has been switched on."""

    def cycle(self, counts: np.ndarray) -> tuple[int, int | None]:
        """The byte of the magnets, and the reference speed in counts of 0.01 m/s (None: none)."""

    def idle(self) -> None:
        """Take note that a cycle without speeds has passed."""

    def stuck(self) -> int:
        """The axles whose speed sensors the unit rejects; bit 0 is the leading axle."""

    def sand(self) -> bool:
        """Whether the sanders should be on."""

    def permitted_shares(self) -> tuple[float, ...] | None:
        """The share of its force that each motor may give; None for a unit that commands none."""


class Serving(Protocol):
    """A unit on an open bus."""

    def run(self) -> None:
        """Serve until the bus ends or `stop` is called."""

    def stop(self) -> None:
        """Ask `run` to end, from a signal handler or another thread; it does within 0.1 s."""


class Reference:
    """The reference WSP of `logic`.

    `frames` are those of the group of axles that it protects. `dynamic_brake`: whether the vehicle
    has one, whose motors the unit releases.
    """

    def __init__(self, params: logic.Params, frames: rig.UnitFrames, dynamic_brake: bool) -> None:
        """Compile the cycle."""
        self._params: Any = params  # its fields are made from a table
        self._axles = len(frames.speeds.names)
        self._dynamic_brake = dynamic_brake
        self.hears: tuple[rig.Layout, ...] = (frames.speeds,)
        warm(params)

    def begin(self) -> None:
        self._wsp = logic.new_unit(self._params, self._axles)

    def cycle(self, counts: np.ndarray) -> tuple[int, int | None]:
        magnets, reference = logic.cycle(self._wsp, counts)
        return int(magnets), int(reference)

    def idle(self) -> None:
        pass

    def stuck(self) -> int:
        return int(logic.stuck(self._wsp))

    def permitted_shares(self) -> tuple[float, ...] | None:
        if not self._dynamic_brake:
            return None
        return tuple(logic.permitted_share(self._wsp, axle) for axle in range(self._axles))

    def sand(self) -> bool:
        """True, if configured, from the first sliding until `calm_s` after the last."""
        if not self._params.sand:
            return False
        cycles = int(self._wsp.state.cycles[0])
        calm_cycles = int(self._wsp.state.calm[0])
        has_slid = calm_cycles < cycles
        return has_slid and bool(calm_cycles * self._params.cycle_s < self._params.calm_s)


class Unit:
    """One WSP unit on an open bus. `run` returns when the bus ends or after `stop`.

    `frames`: those of the group of axles that it protects.
    `lockstep_s`: period of SYNC in lockstep, in simulated s; 0 in real time. In lockstep nothing
    depends on the wall clock.
    """

    def __init__(
        self,
        bus: can.BusABC,
        wsp: Wsp,
        frames: rig.UnitFrames,
        lockstep_s: float = 0.0,
    ) -> None:
        """Switch on; the bus is not touched before `run`."""
        self._frames = frames
        self.state = State.INITIALISING
        self.answers = 0
        self._bus = bus
        self._wsp = wsp
        self._lockstep = lockstep_s > 0.0
        most_syncs = HEARTBEAT_SYNCS
        if self._lockstep:
            most_syncs = int(HEARTBEAT_S / lockstep_s + 1e-9)
        self._beat_syncs = min(max(most_syncs, 1), HEARTBEAT_SYNCS)
        axles = len(frames.speeds.names)
        self._inputs = np.zeros(axles * len(wsp.hears), dtype=np.int64)
        self._received: set[int] = set()  # identifiers of input frames since the last SYNC
        self._awaiting = False  # the last SYNC has not been answered
        self._stopping = False
        self._beat_s = 0.0  # when the next heartbeat is due
        self._synced_s = 0.0  # when the last SYNC came
        self._handlers: dict[int, Callable[[can.Message], None]] = {
            NMT: self._on_nmt,
            SYNC: self._on_sync,
        }
        for at, layout in enumerate(wsp.hears):
            place = slice(axles * at, axles * (at + 1))
            self._handlers[layout.can_id] = partial(self._on_input, layout, place)
        bus.set_filters(
            [{"can_id": can_id, "can_mask": 0x7FF, "extended": False} for can_id in self._handlers]
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
        """Handle the next frame, or do what is due when none comes before the next heartbeat."""
        rest_s = self._beat_s - time.monotonic()
        message = self._bus.recv(rest_s) if rest_s > 0.0 else None
        if message is not None:
            handler = self._handlers.get(message.arbitration_id)
            if handler and not (
                message.is_extended_id or message.is_remote_frame or message.is_error_frame
            ):
                handler(message)
            return
        now_s = time.monotonic()
        if self._lockstep:
            # nothing is due by the wall clock
            self._beat_s = now_s + HEARTBEAT_S
        elif now_s >= self._beat_s:
            if self._awaiting and now_s >= self._synced_s + HEARTBEAT_S:
                self._answer_without_speeds()
            self._heartbeat()

    def _boot(self) -> None:
        """Reset, boot-up message, then OPERATIONAL without waiting for a master."""
        self._wsp.begin()
        self._stuck = 0  # axles with a rejected sensor, as bits
        self._magnets = ALL_OFF
        self._missed = 0  # SYNCs without speeds
        self._syncs = 0
        self._awaiting = False
        self._sand = False
        self._shares: tuple[float, ...] | None = None
        self.state = State.INITIALISING
        self._heartbeat()
        self.state = State.OPERATIONAL
        self._heartbeat()

    def _on_nmt(self, message: can.Message) -> None:
        if len(message.data) != 2 or message.data[1] not in (0, self._frames.node):
            return
        command = message.data[0]
        if command in (Command.RESET_NODE, Command.RESET_COMMUNICATION):
            self._leave_operational()
            self._boot()
        elif command in STATE_AFTER:
            state = STATE_AFTER[Command(command)]
            if state is not State.OPERATIONAL:
                self._leave_operational()
            self.state = state

    def _leave_operational(self) -> None:
        """Switch the magnets off while PDOs are still allowed."""
        if self.state is State.OPERATIONAL:
            self._send(self._frames.magnets_id, bytes((ALL_OFF,)))
        self._awaiting = False

    def _on_sync(self, message: can.Message) -> None:
        if len(message.data) > 1:
            return
        self._synced_s = time.monotonic()
        if self._awaiting:
            self._answer_without_speeds()
        self._received.clear()
        self._syncs += 1
        self._awaiting = self.state is State.OPERATIONAL
        if not self._awaiting:
            self._heartbeat_if_due()

    def _on_input(self, layout: rig.Layout, place: slice, message: can.Message) -> None:
        """Take an input frame; after the last one run a cycle and answer."""
        if len(message.data) != layout.struct.size:
            return
        self._inputs[place] = layout.struct.unpack(message.data)
        self._received.add(layout.can_id)
        if layout is not self._wsp.hears[-1]:
            return
        if len(self._received) < len(self._wsp.hears):
            if self._awaiting:
                self._answer_without_speeds()
            return
        self._missed = 0
        if not self._awaiting:
            return
        self._heartbeat_if_due()
        self._magnets, reference = self._wsp.cycle(self._inputs)
        if reference is not None:
            layout = self._frames.reference_speed
            self._send(layout.can_id, layout.struct.pack(reference))
        self._report_stuck(self._wsp.stuck())
        self._switch_sanders()
        self._permit_shares()
        self._answer()

    def _report_stuck(self, axles: int) -> None:
        """Send an EMCY when the rejected sensors change; one without error when none is any
        more.
        """
        if axles == self._stuck:
            return
        self._stuck = axles
        log.info("WSP unit: rejected speed sensors, by axle: %s", f"{axles:04b}"[::-1])
        error_code = SENSOR_STUCK if axles else 0
        error_register = rig.GENERIC_ERROR if axles else 0
        self._send(
            self._frames.emergency_id, struct.pack("<HBB4x", error_code, error_register, axles)
        )

    def _switch_sanders(self) -> None:
        """Command the sanders, if the request of the WSP has changed."""
        sand = self._wsp.sand()
        if sand != self._sand:
            self._sand = sand
            self._send(self._frames.sand_id, bytes((rig.ALL_SANDERS if sand else 0,)))

    def _permit_shares(self) -> None:
        """Permit the motors their shares of the dynamic brake, if they have changed."""
        shares = self._wsp.permitted_shares()
        if shares is not None and shares != self._shares:
            self._shares = shares
            counts = [round(share * rig.WHOLE_SHARE) for share in shares]
            self._send(self._frames.shares_id, struct.pack(f"<{len(counts)}h", *counts))

    def _answer_without_speeds(self) -> None:
        self._heartbeat_if_due()
        self._wsp.idle()
        self._missed += 1
        if self._missed > MISSED_MAX:
            self._magnets = ALL_OFF
        self._answer()

    def _answer(self) -> None:
        self._awaiting = False
        self._send(self._frames.magnets_id, bytes((self._magnets,)))
        self.answers += 1

    def _heartbeat_if_due(self) -> None:
        if self._syncs % self._beat_syncs == 0:
            self._heartbeat()

    def _heartbeat(self) -> None:
        self._beat_s = time.monotonic() + HEARTBEAT_S
        self._send(self._frames.heartbeat_id, bytes((self.state,)))

    def _send(self, can_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def warm(params: logic.Params) -> None:
    """Compile the cycle, or load it from the cache of numba, before the rig waits for an answer."""
    unit = logic.new_unit(params, AXLES_OF_GROUP)
    logic.cycle(unit, np.zeros(AXLES_OF_GROUP, dtype=np.int64))
    logic.stuck(unit)
    logic.permitted_share(unit, 0)


def main(
    bus_address: str = DEFAULT_ADDRESS,
    config: str = "reference",
    priority: int = 0,
    lockstep_s: float = 0.0,
    group: int = 1,
    kind: Kind = COACH,
) -> int:
    """Run the reference WSP on a bus until the bus ends, or SIGINT or SIGTERM comes. Returns 0.

    `group` is the group of axles that the unit protects, 1 the leading one, of a vehicle of this
    `kind`. With a `priority` above 0 it requests SCHED_FIFO and locked memory, and continues if
    they are refused. Raises ConfigError for a wrong `config` (name or TOML path) or group, BusError
    if the bus cannot be opened.
    """
    frames = frames_of_group(kind, group)
    wsp = Reference(logic.load(config), frames, kind.dynamic_brake)
    return serve(lambda bus: Unit(bus, wsp, frames, lockstep_s), bus_address, priority, lockstep_s)


def frames_of_group(kind: Kind, group: int) -> rig.UnitFrames:
    """Return the frames of the unit of a group of a vehicle, 1 the leading one.

    Raises ConfigError.
    """
    if not 1 <= group <= kind.groups:
        with_group = min(AXLES_OF_GROUP * max(group, 1), MOST_AXLES)
        raise ConfigError(
            f"--group {group}: a vehicle with {kind.axles} axles has {kind.groups} group(s) of up to "
            f"four axles; allowed is 1 to {kind.groups}, or give the number of axles of another "
            f"vehicle, for example --axles {with_group}"
        )
    return rig.unit_frames(signals.table(kind), group - 1)


def serve(
    built: Callable[[can.BusABC], Serving],
    bus_address: str,
    priority: int,
    lockstep_s: float,
    errors: bool = False,
) -> int:
    """Run the unit that `built` makes on a bus, as `main` runs the reference; `errors` as in
    `open_client`.

    Raises BusError.
    """
    with buses.open_client(bus_address, 60.0 if lockstep_s else 3.0, errors, ahead=True) as bus:
        unit = built(bus)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: unit.stop())
        if priority:
            _be_punctual(priority)
        unit.run()
    return 0


def _be_punctual(priority: int) -> None:
    """Request what keeps a unit in real time from being late, and continue if it is refused."""
    # what is loaded now stays: no collection looks at it again
    gc.collect()
    gc.freeze()
    reason = memory.lock()
    if reason:
        print(f"info: locked memory was refused: {reason}", flush=True)
    _request_priority(priority)


def _request_priority(priority: int) -> None:
    """Request SCHED_FIFO for this thread, and one step more for the threads that watch the unit."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        for thread in threading.enumerate():
            if thread is not threading.current_thread():
                higher = os.sched_param(min(priority + 1, _HIGHEST_PRIORITY))
                os.sched_setscheduler(thread.native_id or 0, os.SCHED_FIFO, higher)
    except OSError as error:
        print(f"info: SCHED_FIFO priority {priority} was refused: {error.strerror}", flush=True)
