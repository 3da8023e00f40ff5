"""Translates between the rig and a unit with its own CAN messages, while a bench runs.

After each SYNC the gateway waits for the axle speeds of node 16 and sends the unit its messages,
encoded as in the DBC. A value that does not fit its signal becomes the nearest one that does. The
gateway turns the unit's answer into the magnets of node 17, the unit's reference speed and the
heartbeat of node 32. So such a unit runs the same sequences. In lockstep it must answer the last
message of each cycle; a unit that keeps its own time is for real time only. If the unit is silent,
its heartbeat stops and the brakes apply. If a signal of the unit is no finite number, the unit has
failed: the gateway sends its EMCY FF02h, its heartbeat stops for the rest of the run, and no magnet
is energised. Before the first SYNC the gateway sends the speed at the start of the run until the
unit answers.

With `bus` in the mapping the unit has a bus of its own, so its messages may have identifiers of the
rig. The gateway is then on both buses, and writes the frames of the unit's to a log.

If the gateway itself fails, the run ends with that reason, and the unit is not blamed.
"""

import contextlib
import math
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import can
import cantools

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface import magnets, signals
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import SYNC
from rollerrig.wsp_interface.bus.sdo_client import SdoClient
from rollerrig.wsp_interface.rig_objects import (
    FAILURE,
    GENERIC_ERROR,
    MAGNETS_ID,
    UNIT_EMERGENCY_ID,
    UNIT_HAS_FAILED,
    UNIT_HEARTBEAT_ID,
    unit_frames,
)
from rollerrig.wsp_interface.signals import BENCH_NODE, Table
from rollerrig.wsp_interface.unit_map import fields, own_bus
from rollerrig.wsp_interface.unit_map.mapping import (
    MEASURED_SPEED,
    Outgoing,
    UnitMap,
    load,
    source_of_column,
)

OPERATIONAL = 5  # NMT state in a heartbeat
HEARTBEAT_SYNCS = 5  # SYNCs between two heartbeats
QUIET_S = 0.1

# data of frames for a unit that has failed: magnets that are all off, and the EMCY
_NO_MAGNETS = bytes([magnets.ALL_OFF])
_FAILED = struct.pack("<HB5x", UNIT_HAS_FAILED, GENERIC_ERROR)


class Gateway:
    """Translates between the rig and a unit. `run` returns when the bus of the rig ends.

    bus: that of the rig.
    unit_bus: that of the unit; None: the same.
    start_rad_s: how fast the wheels turn when the run begins.
    log: takes each frame on the bus of the unit, with the time of the last frame of the rig in s.

    `address` is that of the unit's bus. `values` holds the quantities of the rig by source,
    `answers` counts the unit's answers.
    `failure` is the reason why the unit has failed; it is empty as long as it has not.
    `breakdown` is the reason why the gateway itself has failed; empty as long as it has not.
    """

    def __init__(
        self,
        bus: can.BusABC,
        mapping: UnitMap,
        unit_bus: can.BusABC | None = None,
        start_rad_s: float = 0.0,
        log: Callable[[can.Message, float], None] | None = None,
    ) -> None:
        self.bus = bus
        self.address = ""
        self.mapping = mapping
        self._unit_bus = unit_bus or bus
        self._log = log
        self._time_s = 0.0  # of the last frame of the rig
        self._frames = unit_frames(mapping.vehicle, 0)
        self._sources = source_of_column(mapping.vehicle)
        self.values = {
            source: start_rad_s if source.startswith(MEASURED_SPEED) else 0.0
            for source in self._sources.values()
        }
        self.answers = 0
        self.failure = ""
        self.breakdown = ""
        self._names = {*mapping.hold, *mapping.vent, *filter(None, (mapping.reference,))}
        self._limited: dict[str, int] = {}  # messages with a limited value, by signal
        self._wrong_checksums = 0
        self._counts = [0] * len(mapping.outgoing)  # messages sent, one for each of them
        self._syncs = 0
        self._stopping = False
        self._alive = False  # the unit has answered since the last heartbeat

    def stop(self) -> None:
        """Make `run` return within 0.1 s."""
        self._stopping = True

    def run(self) -> None:
        """Serve until the bus ends or `stop` is called."""
        try:
            next_poll_s = 0.0
            while not self._stopping:
                if self._syncs == 0 and time.monotonic() >= next_poll_s:
                    # before the first SYNC the bench waits for a heartbeat of the unit
                    next_poll_s = time.monotonic() + QUIET_S
                    self._send_to_unit()
                    if self._alive:
                        self._send_heartbeat()
                self._receive()
        except can.CanError:
            return
        except Exception as error:
            # whatever it is, the run must end with it instead of waiting for the unit
            self.breakdown = (
                f"the gateway between rig and unit has failed ({type(error).__name__}: {error}); "
                "this is a fault of rollerrig and not of the unit: please report it with the "
                "mapping and the DBC"
            )
            self._end_run()

    def _end_run(self) -> None:
        """End the run with the reason, so that the bench does not wait for the unit."""
        client = SdoClient(self.bus.send, self.bus.recv, lambda message: None)
        with contextlib.suppress(can.CanError, BusError):  # the bench may have exited
            client.write(BENCH_NODE, FAILURE, 0, self.breakdown.encode("ascii", "replace"))

    def notes(self) -> Iterator[str]:
        """Yield what is remarkable about the messages so far, a sentence each."""
        for name, messages in self._limited.items():
            yield f"{name}: the value was limited to the range of the signal in {messages} messages"
        if self._wrong_checksums:
            yield (
                f"{self.mapping.incoming.name}: {self._wrong_checksums} messages of the unit had a "
                "wrong checksum and were ignored"
            )

    def _receive(self) -> None:
        """Take what comes within 0.1 s, from the rig and from the unit."""
        if self._unit_bus is self.bus:
            message = self.bus.recv(QUIET_S)
            if message is not None and not self._take_of_unit(message):
                self._take_of_rig(message)
            return
        own_bus.wait(self.bus, self._unit_bus, QUIET_S)
        while (message := self.bus.recv(0.0)) is not None:
            self._time_s = message.timestamp
            self._take_of_rig(message)
        while (message := self._unit_bus.recv(0.0)) is not None:
            if self._log:
                self._log(message, self._time_s)
            self._take_of_unit(message)

    def _take_of_unit(self, message: can.Message) -> bool:
        """Translate a message if it is the unit's answer; return whether it is."""
        incoming = self.mapping.incoming
        if (message.arbitration_id, message.is_extended_id) != (
            incoming.frame_id,
            incoming.is_extended_frame,
        ):
            return False
        self._translate_answer(bytes(message.data))
        return True

    def _take_of_rig(self, message: can.Message) -> None:
        can_id = message.arbitration_id
        if can_id == SYNC:
            self._syncs += 1
            if self._syncs % HEARTBEAT_SYNCS == 0 and self._alive:
                self._send_heartbeat()
                self._alive = False
        elif can_id == self._frames.speeds.can_id:
            self._store(self._frames.speeds.read(message.data))
        elif can_id == self._frames.pressures.can_id:
            values = self._frames.pressures.read(message.data)
            self._store(values)
            if values:
                # pressures come last in a cycle, so all values are now of the same SYNC
                self._send_to_unit()

    def _store(self, values: Mapping[str, float]) -> None:
        for column, value in values.items():
            self.values[self._sources[column]] = value

    def _send_to_unit(self) -> None:
        for number, outgoing in enumerate(self.mapping.outgoing):
            message = outgoing.message
            sent = can.Message(
                arbitration_id=message.frame_id,
                data=self._data(outgoing, self._counts[number]),
                is_extended_id=message.is_extended_frame,
            )
            self._unit_bus.send(sent)
            if self._log:
                self._log(sent, self._time_s)
            self._counts[number] += 1

    def _data(self, outgoing: Outgoing, count: int) -> bytes:
        """Return the bytes of a message to the unit, the `count`-th of its kind from 0 on."""
        message = outgoing.message
        filled = outgoing.filled
        raw_values: dict[str, float] = {}
        for name, source in outgoing.sources.items():
            signal = fields.signal_of(message, name)
            raw, was_limited = fields.limited(signal, outgoing.factor * self.values[source])
            raw_values[name] = raw
            if was_limited:
                full_name = f"{message.name}.{name}"
                self._limited[full_name] = self._limited.get(full_name, 0) + 1
        for name, value in filled.constants.items():
            raw_values[name], _ = fields.limited(fields.signal_of(message, name), value)
        if filled.counter:
            low, high = fields.raw_range(fields.signal_of(message, filled.counter))
            raw_values[filled.counter] = low + count % (high - low + 1)
        if not filled.checksum:
            return fields.encode(message, raw_values)

        name = filled.checksum.signal
        data = fields.encode(message, raw_values | {name: 0})
        return fields.encode(message, raw_values | {name: filled.checksum.raw(message, data)})

    def _translate_answer(self, data: bytes) -> None:
        """Send the rig the unit's reference speed and magnets."""
        mapping = self.mapping
        try:
            content: Any = mapping.incoming.decode(data, decode_choices=False)
        except (cantools.Error, ValueError):
            return  # too short: the rig treats it as no answer
        if not self._names.issubset(content):
            return  # a multiplexed group without the magnets
        if not self._has_right_checksum(data):
            self._wrong_checksums += 1
            return
        if not self.failure:
            self._check(content)
        if self.failure:
            self._send(MAGNETS_ID, _NO_MAGNETS)
            return
        self._alive = True

        if mapping.reference:
            raw = signals.count(
                float(content[mapping.reference]) * mapping.reference_factor,
                signals.first_place("wsp_reference_speed"),
            )
            frame = self._frames.reference_speed
            self._send(frame.can_id, frame.struct.pack(raw))

        pairs = []
        for hold, vent in zip(mapping.hold, mapping.vent, strict=True):
            pairs.append(magnets.pair(bool(content[hold]), bool(content[vent])))
        self._send(MAGNETS_ID, bytes([magnets.pack(pairs)]))
        self.answers += 1

    def _has_right_checksum(self, data: bytes) -> bool:
        """Return whether a message of the unit has its checksum, or needs none."""
        checksum = self.mapping.checksum
        if not checksum:
            return True
        raw: Any = self.mapping.incoming.decode(data, decode_choices=False, scaling=False)
        return int(raw[checksum.signal]) == checksum.raw(self.mapping.incoming, data)

    def _check(self, content: Mapping[str, Any]) -> None:
        """Notice, and report by an EMCY, a signal of the unit that is no finite number."""
        for name in sorted(self._names):
            if not math.isfinite(content[name]):
                self.failure = (
                    f"the unit has failed: its signal {name} in {self.mapping.incoming.name} is "
                    f"{content[name]}; allowed are finite numbers"
                )
                self._send(UNIT_EMERGENCY_ID, _FAILED)
                return

    def _send_heartbeat(self) -> None:
        self._send(UNIT_HEARTBEAT_ID, bytes([OPERATIONAL]))

    def _send(self, can_id: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def companion(
    path: Path, vehicle: Table, start_rad_s: float = 0.0, log: Path | None = None
) -> Callable[[str], AbstractContextManager[Gateway]]:
    """Return a context manager that runs a gateway during a bench, given the address of its bus.

    `vehicle`: the signals of the vehicle of the bench. `start_rad_s`: how fast its wheels turn when
    the run begins. `log`: the file for the frames on a bus of the unit's own. Where the unit has
    such a bus, the gateway's `address` is that bus. Raises ConfigError, and on entry BusError.
    """
    mapping = load(path, vehicle)

    @contextlib.contextmanager
    def run_gateway(address: str) -> Iterator[Gateway]:
        with contextlib.ExitStack() as stack:
            bus = stack.enter_context(buses.open_client(address))
            unit_bus: can.BusABC | None = None
            write: Callable[[can.Message, float], None] | None = None
            if mapping.bus:
                address = stack.enter_context(own_bus.served(mapping.bus))
                unit_bus = stack.enter_context(buses.open_client(address))
                if log:
                    write = stack.enter_context(own_bus.logged(log))
            gateway = Gateway(bus, mapping, unit_bus, start_rad_s, write)
            gateway.address = address
            thread = threading.Thread(target=gateway.run, name="unit gateway", daemon=True)
            thread.start()
            try:
                yield gateway
            finally:
                gateway.stop()
                thread.join(2.0)

    return run_gateway
