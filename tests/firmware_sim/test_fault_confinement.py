"""Fault confinement: what error frames add to the counters of senders, receivers and finders."""

import pytest

from rollerrig.firmware_sim.faults.confinement import Confinement, Controllers
from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

FRAME = Frame(0x181, bytes(8))
MS = 1_000_000


class Member:
    """What fault confinement needs of a node, noting what it is told."""

    def __init__(self):
        self.emergency, self.events, self.codes = self, [], []

    def event(self, code, **fields):
        events.check(code, {"node": 1} | fields)
        self.events.append(code)

    def report(self, code):
        self.codes.append(code)

    def clear(self, code):
        if code in self.codes and self.codes[-1] != 0:
            self.codes.append(0)


class Site:
    """Three nodes of which one is disturbed, and the error frames that were told."""

    def __init__(self):
        self.told, self.muted, self.deaf = [], set(), set()
        self.members = {1: Member(), 2: Member(), 3: Member()}
        self.controllers = Controllers(lambda frame, *what: self.told.append(what))
        self.confinement = Confinement(
            self.controllers, self.members, self.keep(self.muted), self.keep(self.deaf), 500_000
        )

    @staticmethod
    def keep(where):
        return lambda node, on: (where.add if on else where.discard)(node)

    def counters(self, node):
        one = self.controllers.nodes[node]
        return one.transmit, one.receive

    def send(self, node, count=1):
        return [self.controllers.passes(FRAME, node) for _ in range(count)]


@pytest.fixture
def site():
    return Site()


@pytest.mark.conformance("CAN", "transmit error counter: 8 for an error, 1 back for a frame")
def test_a_destroyed_frame_costs_its_sender_8_and_each_receiver_1_and_a_good_one_gives_1_back(site):
    site.confinement.disturb(1, attempts=3)
    assert site.send(1) == [True]
    assert site.counters(1) == (3 * 8 - 1, 0)
    assert site.counters(2) == site.counters(3) == (0, 3 - 1)
    assert site.told == [(8, 0, True), (16, 0, True), (24, 0, True)]
    site.confinement.disturb(1, attempts=0)
    site.send(1, 10)
    assert site.counters(1) == (13, 0)
    assert site.counters(2) == (0, 0)


@pytest.mark.conformance(
    "CAN", "receive error counter: 9 for who finds an error, 1 for other receivers"
)
def test_the_receiver_that_finds_an_error_counts_9_the_others_1_and_the_sender_8(site):
    site.confinement.disturb(3, finds=1)
    assert site.send(1) == [True]
    assert site.counters(3) == (0, 9 - 1)
    assert site.counters(2) == (0, 0)
    assert site.counters(1) == (8 - 1, 0)
    assert site.told == [(0, 9, False)]


@pytest.mark.conformance("CAN", "error passive receiver: destroys nothing and is deaf, EMCY 8120h")
def test_a_receiver_that_is_error_passive_destroys_nothing_and_hears_nothing(site):
    site.confinement.disturb(3, finds=1)
    site.send(0, 15)
    site.confinement.poll(0)
    assert site.counters(3) == (0, 120)
    assert site.deaf == set()
    site.send(0)
    site.confinement.poll(0)
    assert site.counters(3)[1] > 127
    assert site.deaf == {3}
    assert site.members[3].codes == [0x8120]
    site.told.clear()
    assert site.send(0, 300) == [True] * 300
    assert site.told == []
    # a receive error counter takes nobody off the bus
    assert site.muted == set()
    assert site.counters(3)[1] == 255


@pytest.mark.conformance("CAN", "error active again at the first frame received well")
def test_a_receiver_that_is_sound_again_is_error_active_with_the_first_good_frame(site):
    site.confinement.disturb(3, finds=1)
    site.send(0, 20)
    site.confinement.poll(0)
    site.confinement.disturb(3, finds=0)
    site.confinement.poll(0)
    assert site.deaf == set()
    site.send(0)
    site.confinement.poll(0)
    assert site.counters(3) == (0, 127)
    assert site.members[3].codes == [0x8120, 0]
    assert site.members[3].events[-1] == Code.CAN_ERROR_ACTIVE
    site.send(0, 127)
    assert site.confinement.busy
    site.confinement.poll(0)
    assert not site.confinement.busy


@pytest.mark.conformance("CAN", "bus-off and recovery after 128 times 11 bits, EMCY 8140h")
def test_a_sender_whose_counter_passes_255_is_off_until_1408_bits_have_passed(site):
    site.confinement.disturb(1, attempts=31)
    assert site.send(1, 2) == [True, False]
    site.confinement.poll(10 * MS)
    assert site.muted == {1}
    assert site.send(1) == [False]
    site.confinement.poll(10 * MS + 1408 * 2000 - 1)
    assert site.muted == {1}
    site.confinement.disturb(1, attempts=0)
    site.confinement.poll(10 * MS + 1408 * 2000)
    assert site.muted == set()
    assert site.counters(1) == (0, 0)
    assert site.members[1].codes[-2:] == [0x8140, 0]
    assert site.send(1) == [True]
