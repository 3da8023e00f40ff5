"""Modbus RTU over a pseudo-terminal: real bytes on a real line, right and wrong ones."""

import os
import random
import select
import struct
import time
import tty

import pytest
from modbus_site import Site, until
from pymodbus.framer import FramerRTU

from rollerrig.configs.errors import BusError
from rollerrig.wsp_interface.events import Code

READ = struct.pack(">BHH", 3, 202, 1)
TOLD = bytes.fromhex("01030204d2")


@pytest.fixture
def site():
    place = Site()
    yield place
    place.close()


@pytest.fixture
def line(site):
    """The client's end of a serial line: a plain device, opened raw."""
    master = Line(os.open(site.serial(), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))
    yield master
    master.close()


class Line:
    def __init__(self, descriptor):
        self.descriptor = descriptor
        tty.setraw(descriptor)

    def close(self):
        os.close(self.descriptor)

    def send(self, data):
        assert os.write(self.descriptor, data) == len(data)

    def receive(self, size=0):
        """A frame, or so many bytes, and what else comes until 50 ms of silence."""
        data = b""
        while not (len(data) >= size > 0 or (not size and data and sealed(data[:-2]) == data)):
            assert select.select([self.descriptor], [], [], 60.0)[0], data.hex()
            data += os.read(self.descriptor, 4096)
        return data + self.rest(0.05)

    def rest(self, silence_s=0.2):
        """What comes until a silence; nothing, if nobody says anything."""
        data = b""
        while select.select([self.descriptor], [], [], silence_s)[0]:
            data += os.read(self.descriptor, 4096)
        return data

    def ask(self, request, unit=1):
        self.send(frame(request, unit))
        return self.receive()


def frame(request, unit=1):
    return sealed(bytes((unit,)) + request)


def sealed(data):
    return data + FramerRTU.compute_CRC(data).to_bytes(2, "big")


def test_the_checksum_is_that_of_the_standards_example():
    # MODBUS over Serial Line V1.02, appendix B: 02 07 has the checksum 41 12
    assert sealed(b"\x02\x07") == b"\x02\x07\x41\x12"


@pytest.mark.conformance("Modbus", "RTU: CRC")
def test_a_request_is_answered_with_its_checksum(line):
    assert line.ask(READ) == sealed(TOLD)


def test_a_drive_answers_on_its_own_unit(line):
    reply = line.ask(struct.pack(">BHH", 3, 100, 1), unit=13)
    assert reply[:3] == bytes((13, 3, 2))
    assert reply == sealed(reply[:-2])


@pytest.mark.parametrize(
    "request_", [struct.pack(">BHH", 3, 200, 0), struct.pack(">BHH", 5, 0, 0x1234)]
)
def test_a_wrong_request_gets_its_exception(request_, line):
    reply = line.ask(request_)
    assert reply == sealed(bytes((1, request_[0] | 0x80, 3)))


def test_an_unknown_function_is_answered_after_the_silence(line):
    assert line.ask(bytes((0x55, 1, 2))) == sealed(bytes((1, 0xD5, 1)))


@pytest.mark.conformance("Modbus", "RTU: a wrong checksum gets silence")
def test_a_frame_with_a_wrong_checksum_is_not_answered_and_the_next_one_is(line, site):
    broken = bytearray(frame(READ))
    broken[-1] ^= 1
    line.send(bytes(broken))
    until(lambda: site.server.counters.malformed == 1)
    assert line.rest() == b""
    assert line.ask(READ) == sealed(TOLD)


def test_another_unit_on_the_line_is_let_be(line):
    # over TCP unit 255 is the device itself; on a line it is reserved
    for unit in (5, 255):
        line.send(frame(READ, unit=unit))
        assert line.rest() == b""
    # what that unit answers looks like anything
    line.send(sealed(b"\x05\x03\x02\x12\x34"))
    assert line.rest() == b""
    assert line.ask(READ) == sealed(TOLD)


@pytest.mark.conformance("Modbus", "RTU: broadcast")
def test_everybody_obeys_unit_0_and_nobody_answers(line, site):
    line.send(frame(struct.pack(">BHH", 6, 1, 1234), unit=0))
    until(lambda: ("speed_set_point", 1234) in site.written)
    assert line.rest() == b""


def test_a_broadcast_stops_the_rig_and_resets_the_stop(line, site):
    for value, word in ((1, 0xFF00), (0, 0)):
        line.send(frame(struct.pack(">BHH", 5, 2, word), unit=0))
        until(lambda value=value: site.written[-1:] == [("emergency_stop", value)])
    assert line.rest() == b""


def test_a_frame_in_single_bytes_is_one_frame(line, site):
    site.lines[0].silence_s = 60.0  # however busy the machine is
    for byte in frame(READ):
        line.send(bytes((byte,)))
        time.sleep(0.002)
    assert line.receive() == sealed(TOLD)


def test_frames_without_a_pause_are_answered_in_order(line):
    line.send(frame(READ) + frame(struct.pack(">BHH", 3, 208, 1)) + frame(READ))
    told = sealed(TOLD) + sealed(b"\x01\x03\x02\x00\x64") + sealed(TOLD)
    assert line.receive(len(told)) == told


def test_a_frame_that_is_cut_is_forgotten_at_the_silence(line, site):
    line.send(frame(READ)[:5])
    until(lambda: site.server.counters.malformed == 1)
    assert line.ask(READ) == sealed(TOLD)


@pytest.mark.conformance("Modbus", "RTU: fuzz")
@pytest.mark.parametrize("seed", range(3))
def test_noise_harms_nobody(seed, line, site):
    rng = random.Random(seed)
    for _ in range(30):
        data = rng.randbytes(rng.randrange(1, 400))
        line.send(sealed(data) if rng.random() < 0.3 else data)
        if rng.random() < 0.3:
            time.sleep(0.03)
    line.rest(0.5)
    assert line.ask(READ) == sealed(TOLD)
    assert site.thread.is_alive()


def test_a_device_is_set_to_its_speed_and_parity_and_served(site):
    far, near = os.openpty()
    name = os.ttyname(near)
    assert site.serial(name, baud_rate=9600, parity="none") == name
    line = Line(far)
    assert line.ask(READ) == sealed(TOLD)
    line.close()
    os.close(near)


def test_a_line_that_is_lost_is_told_and_harms_nobody(site):
    events = []
    far, near = os.openpty()
    device = os.ttyname(near)
    site.serial(device, on_event=lambda code, **fields: events.append((code, fields)))
    os.close(near)
    os.close(far)
    until(lambda: events)
    assert events[0] == (Code.MODBUS_SERIAL_LOST, {"device": device})
    assert site.thread.is_alive()


@pytest.mark.parametrize("port", ["/dev/does_not_exist", "/dev/null"])
def test_what_is_no_serial_device_is_refused_with_its_name(port, site):
    with pytest.raises(BusError, match=port):
        site.serial(port)
