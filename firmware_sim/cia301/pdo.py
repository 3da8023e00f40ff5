"""Process data objects: values of several objects in one message, packed without gaps.

A transmit PDO is sent with every n-th SYNC, after a change, by a timer, or on a remote request. A
receive PDO takes effect immediately or with the next SYNC. When a PDO is configured, its mapping is
compiled to one struct and one list of functions. Source: CiA 301, PDO protocols and transmission
types.
"""

from collections.abc import Callable

from rollerrig.firmware_sim.cia301.communication import ACYCLIC, split, valid
from rollerrig.firmware_sim.cia301.emergency import PDO_LENGTH, RPDO_LATE
from rollerrig.firmware_sim.cia301.host import MS, Host
from rollerrig.firmware_sim.cia301.objects import AbortError, key, packer
from rollerrig.firmware_sim.cia301.pdo_mapping import (
    COB_ID,
    DUMMIES,
    EVENT_TIMER,
    INHIBIT_TIME,
    SYNC_START_VALUE,
    TO_MAPPING,
    TRANSMISSION_TYPE,
    attach_rules,
    mapped_keys,
)
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

# Transmission types beside ACYCLIC. The types 1 to 240 (LAST_SYNCHRONOUS) mean: with every n-th
# SYNC, n being the type.
LAST_SYNCHRONOUS = 240
RTR_SYNCHRONOUS = 252  # sampled with SYNC, sent on a remote request
RTR = 253  # sampled and sent on a remote request
EVENT = 254  # and 255: after a change, or by the event timer

_INHIBIT_UNIT_NS = 100_000  # the inhibit time is a number of 100 us


class Channel:
    """The common part of both directions.

    `first_index` is the index of the communication parameters of the first PDO of this direction,
    `place` the place of this PDO among them, from 0. `number` counts from 1, as the standard does.

    `live`: the PDO exists, carries an object, and the node is OPERATIONAL.
    """

    transmits: bool

    def __init__(self, node: Host, first_index: int, place: int) -> None:
        self.node = node
        self.index = first_index + place
        self.number = place + 1
        self.live = False
        # names of the alarms of the event timer and of the inhibit time
        self.event_alarm = f"{type(self).__name__.lower()} {self.number}"
        self.inhibit_alarm = f"{self.event_alarm} inhibited"
        attach_rules(node, self.index, self.configure, self.transmits)

    def configure(self, operational: bool) -> None:
        """Compile communication and mapping parameters."""
        cob_id = self._parameter(COB_ID)
        self.can_id, self.extended = split(cob_id)
        self.keys = mapped_keys(self.node.objects, self.index + TO_MAPPING)
        self.live = operational and valid(cob_id) and bool(self.keys)
        self.node.timers.cancel(self.event_alarm)
        self.node.timers.cancel(self.inhibit_alarm)

    def _parameter(self, sub: int) -> int:
        """Return a communication parameter."""
        value: int = self.node.objects.values[key(self.index, sub)]
        return value


class Tpdo(Channel):
    """One transmit PDO.

    `on_sync(counter)` is called at a SYNC, with None if the SYNC has no counter. The attribute
    `on_sync` is None if a SYNC has no effect on this PDO.
    """

    transmits = True

    def configure(self, operational: bool) -> None:
        super().configure(operational)
        self.kind = self._parameter(TRANSMISSION_TYPE)
        if not self.live:
            return

        objects = self.node.objects
        self.getters = [objects.getter(at) for at in self.keys]
        self.pack = packer([objects.variables[at] for at in self.keys]).pack

        # keys of the objects that enable the sending of changes; empty: changes are always sent
        self.enablers: set[int] = set()
        for at in self.keys:
            index = at >> 8
            if index in self.node.event_enablers:
                self.enablers.add(self.node.event_enablers[index])

        self.inhibit_ns = self._parameter(INHIBIT_TIME) * _INHIBIT_UNIT_NS
        self.event_ns = self._parameter(EVENT_TIMER) * MS
        self.free_ns = 0  # time at which the inhibit time is over

        # the PDO is sent with every n-th SYNC
        self.every = 1
        if 1 <= self.kind <= LAST_SYNCHRONOUS:
            self.every = self.kind
        self.syncs_passed = 0  # since the last message
        # counter of the SYNC from which the PDO is sent; 0: there is none to wait for (any more)
        self.awaited_counter = self._parameter(SYNC_START_VALUE)

        # content of the last message that was sent by `_send`, and of the last sample at a SYNC
        self.last: bytes | None = None
        self.sampled: bytes | None = None

        self.on_sync = self._action_at_sync()
        self._await_event()

    def _action_at_sync(self) -> Callable[[int | None], None] | None:
        """Return the call at a SYNC for the transmission type, None if a SYNC has no effect."""
        if self.kind == ACYCLIC:
            return self._send_if_changed
        if self.kind == RTR_SYNCHRONOUS:
            return self._sample_only
        if self.kind == 1 and not self.awaited_counter:
            return self._send_sample
        if self.kind <= LAST_SYNCHRONOUS:
            return self._send_every_nth
        return None

    def sample(self) -> bytes:
        """Return the present content of the message."""
        return self.pack(*[get() for get in self.getters])

    def on_remote(self, _: Frame) -> None:
        """Answer a remote request for this PDO.

        The answer of a synchronous PDO is its sample of the last SYNC, once there is one.
        """
        if self.kind >= RTR or self.sampled is None:
            self._send(self.sample())
        else:
            self._send(self.sampled)

    def watch(self, now_ns: int) -> None:
        """Send changed content, as soon as the inhibit time allows (event-driven transmission).

        The first message needs no change and no enabling object.
        """
        if now_ns < self.free_ns:
            return
        data = self.sample()
        values = self.node.objects.values
        enabled = not self.enablers or any(values[at] for at in self.enablers)
        if self.last is None or (data != self.last and enabled):
            self._send(data)

    def _await_event(self) -> None:
        """Start the event timer again."""
        if self.kind >= EVENT and self.event_ns:
            due_ns = self.node.now_ns + self.event_ns
            self.node.timers.set(self.event_alarm, due_ns, self._on_event_timer)

    def _on_event_timer(self) -> None:
        """Send the content, if necessary after the inhibit time."""
        if self.node.now_ns < self.free_ns:
            self.node.timers.set(self.event_alarm, self.free_ns, self._on_event_timer)
        else:
            self._send(self.sample())

    def _send_sample(self, _: int | None) -> None:
        # the usual case (type 1), short because it is the inner loop of the bus thread
        data = self.pack(*[get() for get in self.getters])
        self.sampled = data
        self.node.send(Frame(self.can_id, data, self.extended))

    def _send_every_nth(self, counter: int | None) -> None:
        # a SYNC without a counter cannot be the awaited one, so the PDO does not wait for it
        if self.awaited_counter and counter is not None:
            if counter != self.awaited_counter:
                return
            # the PDO is sent with this SYNC, and from now on with every n-th one
            self.awaited_counter = 0
            self.syncs_passed = self.every - 1
        self.syncs_passed += 1
        if self.syncs_passed >= self.every:
            self.syncs_passed = 0
            self._send_sample(counter)

    def _send_if_changed(self, _: int | None) -> None:
        self.sampled = self.sample()
        if self.sampled != self.last:
            self._send(self.sampled)

    def _sample_only(self, _: int | None) -> None:
        self.sampled = self.sample()

    def _send(self, data: bytes) -> None:
        """Send content, and start the inhibit time and the event timer."""
        self.last = data
        self.node.send(Frame(self.can_id, data, self.extended))
        if self.kind >= EVENT and self.inhibit_ns:
            self.free_ns = self.node.clock_ns() + self.inhibit_ns
            # a change during the inhibit time is sent when this time is over
            self.node.timers.set(self.inhibit_alarm, self.free_ns, lambda: self.watch(self.free_ns))
        self._await_event()


class Rpdo(Channel):
    """One receive PDO.

    `too_late(frame)` returns whether the window of synchronous messages (1007h) is over. `refused`:
    keys of the objects that refused their last value.
    """

    transmits = False

    def __init__(
        self, node: Host, first_index: int, place: int, too_late: Callable[[Frame], bool]
    ) -> None:
        super().__init__(node, first_index, place)
        self.too_late = too_late
        self.refused: set[int] = set()

    def configure(self, operational: bool) -> None:
        super().configure(operational)
        self.synchronous = self._parameter(TRANSMISSION_TYPE) <= LAST_SYNCHRONOUS
        # longest time between two messages; 0: not supervised
        self.deadline_ns = self._parameter(EVENT_TIMER) * MS
        # content that waits for the next SYNC
        self.waiting: bytes | None = None
        if self.live:
            variables = self.node.objects.variables
            layout = packer([DUMMIES.get(at) or variables[at] for at in self.keys])
            self.size = layout.size
            self.unpack = layout.unpack

    def on_frame(self, frame: Frame) -> None:
        """Take a message for this PDO. A message that is too short is reported and ignored.

        The report is made once, until a message is long enough again.
        """
        node = self.node
        data = frame.data
        emergency = node.emergency
        if len(data) < self.size:
            information = bytes([self.number, len(data), self.size])
            is_new = emergency.report(PDO_LENGTH, self.number, information)
            if is_new:
                node.event(
                    Code.PDO_TOO_SHORT, pdo=self.number, length=len(data), expected=self.size
                )
            return

        if emergency.active:
            emergency.clear(PDO_LENGTH, self.number)
            emergency.clear(RPDO_LATE, self.number)
        if self.deadline_ns:
            node.timers.set(self.event_alarm, node.now_ns + self.deadline_ns, self._on_deadline)

        if not self.synchronous:
            self.apply(data)
        elif not self.too_late(frame):
            self.waiting = data

    def on_sync(self) -> None:
        """Apply the data that have come since the last SYNC."""
        if self.waiting is not None:
            data = self.waiting
            self.waiting = None
            self.apply(data)

    def apply(self, data: bytes) -> None:
        """Write the content into the objects.

        A value that an object refuses is skipped and reported. The refusals of an object are
        reported once, until it accepts a value again.
        """
        objects = self.node.objects
        for at, value in zip(self.keys, self.unpack(data[: self.size]), strict=True):
            if at in DUMMIES:
                continue
            try:
                objects.assign(at, value)
                self.refused.discard(at)
            except AbortError as refusal:
                if at in self.refused:
                    continue  # reported already
                self.refused.add(at)
                self.node.event(
                    Code.PDO_REFUSED,
                    pdo=self.number,
                    index=at >> 8,
                    sub=at & 0xFF,
                    value=value,
                    abort=refusal.code.name,
                )

    def _on_deadline(self) -> None:
        """Report that no message has come for too long."""
        self.node.event(Code.PDO_LATE, pdo=self.number)
        self.node.emergency.report(RPDO_LATE, self.number, bytes([self.number]))
