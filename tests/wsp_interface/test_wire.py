"""The wire: the order of frames, their times, full queues; and the hub that lets frames wait."""

import asyncio
import random

import pytest

from rollerrig.wsp_interface.bus import frames
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub
from rollerrig.wsp_interface.bus.wire import QUEUE_FRAMES, Wire, arbitration_field

BITRATE = 500_000
BIT_NS = 2000
EIGHT = bytes(8)  # data of a long frame: 111 bits, 222 us


class Site:
    """A hub with a clock that the test sets.

    `carried` holds its frames: (end in us, identifier).
    """

    def __init__(self, bitrate=BITRATE):
        self.now_ns = 0
        self.carried = []
        self.hub = Hub(lambda: self.now_ns, bitrate)
        self.hub.tap(lambda frame: self.carried.append((frame.time_ns / 1000, frame.can_id)))
        self.a = self.hub.attach(lambda frame: None)
        self.b = self.hub.attach(lambda frame: None)

    def until(self, now_us):
        """Advance to a time; return the frames that the bus has carried since the last call."""
        self.now_ns = round(1000 * now_us)
        self.hub.advance(self.now_ns)
        carried = self.carried
        self.carried = []
        return carried


@pytest.fixture
def site():
    """A site whose frames take time and wait for one another."""
    new = Site()
    new.hub.arbitrate(timed=False)
    return new


@pytest.mark.conformance("CAN", "arbitration: the lowest identifier of several senders first")
def test_of_frames_that_are_ready_together_the_lowest_identifier_is_first_from_any_sender(site):
    for port, can_id in ((site.a, 0x300), (site.b, 0x081), (site.a, 0x181), (site.b, 0x7FF)):
        port.send(Frame(can_id, b""))
    assert [can_id for _, can_id in site.until(10_000)] == [0x081, 0x181, 0x300, 0x7FF]


@pytest.mark.conformance("CAN", "a frame that has begun is not interrupted")
def test_a_frame_that_has_begun_is_not_interrupted_by_a_more_important_one(site):
    site.a.send(Frame(0x700, EIGHT))
    assert site.until(100) == []
    site.b.send(Frame(0x001, EIGHT))
    site.b.send(Frame(0x000, EIGHT))
    assert site.until(1000) == [(222, 0x700), (444, 0x000), (666, 0x001)]


@pytest.mark.conformance("CAN", "each frame takes its bits' time, one at a time")
@pytest.mark.parametrize(
    ("size", "extended", "bits"),
    [(0, False, 47), (1, False, 55), (8, False, 111), (0, True, 67), (8, True, 131)],
)
def test_a_frame_arrives_after_the_time_of_its_bits(site, size, extended, bits):
    site.now_ns = 5_000_000
    site.a.send(Frame(0x100, bytes(size), extended))
    end_us = 5000 + bits * BIT_NS / 1000
    assert site.until(end_us - 0.001) == []
    assert site.until(end_us) == [(end_us, 0x100)]


def test_on_an_ideal_bus_nothing_waits():
    site = Site()
    site.a.send(Frame(0x700, EIGHT))
    site.b.send(Frame(0x001, EIGHT))
    assert [can_id for _, can_id in site.carried] == [0x700, 0x001]


def test_a_node_hears_a_frame_after_its_last_bit_and_its_answer_waits_from_then(site):
    heard = []
    site.hub.attach(lambda frame: heard.append((frame.can_id, frame.time_ns)))
    answering = site.hub.attach(
        lambda frame: answering.send(Frame(0x300, b"")) if frame.can_id == 0x80 else None
    )
    site.a.send(Frame(0x80, b""))
    site.b.send(Frame(0x400, EIGHT))
    site.until(1000)
    # SYNC ends at 94 us. Its answer begins there, before the frame that has waited longer.
    assert heard == [(0x80, 94_000), (0x300, 188_000), (0x400, 410_000)]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (Frame(0x100, b""), Frame(0x100, b"", remote=True)),
        (Frame(0x100, b"", remote=True), Frame(0x100 << 18, b"", extended=True)),
        (
            Frame(0x100 << 18, b"", extended=True),
            Frame(0x100 << 18, b"", extended=True, remote=True),
        ),
        (Frame(0x0FF << 18 | 0x3FFFF, b"", extended=True), Frame(0x100, b"")),
        (Frame(0x100 << 18 | 1, b"", extended=True), Frame(0x100 << 18 | 2, b"", extended=True)),
    ],
)
def test_base_beats_extended_and_data_beats_remote_on_the_same_identifier(first, second):
    assert arbitration_field(first) < arbitration_field(second)


@pytest.mark.conformance("CAN", "bus load from the bits that were carried")
def test_the_load_is_the_share_of_time_in_which_the_wire_is_taken(site):
    sent = 0
    for at_us in range(0, 1_000_000, 1000):
        site.until(at_us)
        for can_id in (0x181, 0x182):
            site.a.send(Frame(can_id, EIGHT))
            sent += 111
    site.until(1_000_000)
    stats = site.hub.stats()
    assert stats["bits"] == sent
    assert stats["load_percent"] == pytest.approx(44.4, abs=0.001)
    assert stats["longest_wait_us"] == 222.0
    assert not stats["overloaded"]


def test_more_than_the_wire_can_carry_is_an_overload_and_its_load_is_100_percent():
    site = Site(bitrate=10_000)
    site.hub.arbitrate(timed=False)
    for at_us in range(0, 1_000_000, 5000):
        site.until(at_us)
        site.a.send(Frame(0x181, EIGHT))
    site.until(1_000_000)
    stats = site.hub.stats()
    assert stats["overloaded"]
    assert 98.0 < stats["load_percent"] <= 100.0


@pytest.mark.conformance("CAN", "bounded transmit queues with counted drops")
def test_a_sender_with_a_full_queue_loses_frames_which_are_counted_and_others_lose_none(site):
    for number in range(QUEUE_FRAMES + 50):
        site.a.send(Frame(0x001, number.to_bytes(8, "little")))
    site.b.send(Frame(0x7FF, b""))
    assert site.a.dropped == site.hub.dropped == 50
    carried = site.until(1e6)
    assert len(carried) == QUEUE_FRAMES + 1
    assert carried[-1][1] == 0x7FF
    # the queue has room again
    site.a.send(Frame(0x001, b""))
    assert len(site.until(2e6)) == 1


def test_nodes_that_share_a_port_have_separate_queues(site):
    for _ in range(QUEUE_FRAMES + 1):
        site.a.send(Frame(0x001, b""), origin="babbler")
    site.a.send(Frame(0x181, b""), origin="neighbour")
    assert site.a.dropped == 1
    assert site.until(1e6)[-1][1] == 0x181


@pytest.mark.parametrize("seed", range(5))
def test_any_traffic_keeps_the_laws_of_the_wire(seed):
    """One frame at a time, none before it is ready, no idle wire while one waits, all in order."""
    source = random.Random(seed)
    wire = Wire(BITRATE, 0)
    offered = {}  # number of a frame: (ready_ns, arbitration field, its time in ns)
    done = []  # (number, end_ns), in the order of the wire
    now_ns = 0
    for _ in range(2000):
        now_ns += source.choice((0, 0, source.randrange(400_000)))
        while (taken := wire.take(now_ns)) is not None:
            waiting, end_ns = taken
            done.append((waiting.number, end_ns))
        frame = Frame(source.randrange(0x800), bytes(source.randrange(9)))
        if wire.offer(frame, now_ns, source.randrange(3), lambda end_ns: None):
            takes_ns = frames.bits(frame) * BIT_NS
            offered[len(offered) + 1] = (now_ns, arbitration_field(frame), takes_ns)
    while (taken := wire.take(1 << 60)) is not None:
        waiting, end_ns = taken
        done.append((waiting.number, end_ns))
    assert sorted(number for number, _ in done) == list(offered)

    free_ns = 0
    left = dict(offered)
    for number, end_ns in done:
        ready_ns, field, takes_ns = left.pop(number)
        begin_ns = end_ns - takes_ns
        first_ready_ns = min([ready_ns, *(other_ready for other_ready, _, _ in left.values())])
        assert begin_ns == max(free_ns, first_ready_ns)
        assert ready_ns <= begin_ns
        for other_ready, other_field, _ in left.values():
            if other_ready <= begin_ns:
                assert other_field >= field
        free_ns = end_ns


def test_an_error_frame_takes_the_wires_time(site):
    site.hub.destroy(Frame(0x181, EIGHT), 8)
    site.a.send(Frame(0x181, EIGHT))
    assert site.until(443) == [(0, 0x088)]
    assert site.until(444) == [(444, 0x181)]


def test_services_bypass_the_wire_while_simulated_time_does_not_advance(site):
    site.hub.services_bypass_wire = True
    site.a.send(Frame(0x211, b"\0"))
    site.a.send(Frame(0x601, EIGHT))
    assert site.carried == [(0, 0x601)]
    site.hub.services_bypass_wire = False
    site.a.send(Frame(0x601, EIGHT))
    assert site.until(10_000) == [(0, 0x601), (110, 0x211), (332, 0x601)]


def test_in_real_time_no_frame_arrives_early_and_all_arrive():
    async def run():
        loop = asyncio.get_running_loop()

        def clock_ns():
            return round(1e9 * loop.time())

        hub = Hub(clock_ns, BITRATE)
        a = hub.attach(lambda frame: None)
        b = hub.attach(lambda frame: None)
        late_ns = []
        hub.tap(lambda frame: late_ns.append(clock_ns() - frame.time_ns))
        hub.arbitrate(timed=True)
        for _ in range(100):
            for port, can_id in ((a, 0x300), (b, 0x200), (a, 0x100)):
                port.send(Frame(can_id, EIGHT))
            await asyncio.sleep(0.003)
        await hub.close()
        return late_ns

    late_ns = asyncio.run(run())
    assert len(late_ns) == 300
    assert min(late_ns) >= 0
