"""The axle speed unit and the way from signals to objects. Real frames over the hub."""

import math

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import process_image
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import Place

TABLE = signals.table(COACH)
START = 1  # NMT command


@pytest.fixture
def unit(wire):
    """The axle speed unit, OPERATIONAL."""
    node = wire.encoder(parameters={"teeth": 100.0})
    wire.nmt(START)
    wire.take()
    return node


@pytest.mark.conformance("CiA 406", "default PDOs: speeds 6030h and tooth frequencies 2100h")
def test_default_pdos_carry_speeds_and_tooth_frequencies_of_four_axles(wire, unit):
    wire.row[TABLE.span("measured_speed")] = [90.0, 91.234, -1.0, 1000.0]
    wire.row[TABLE.span("tooth_frequency")] = [1432.5, 0.001, 5e6, 0.0]
    wire.sync()
    frames = {frame.can_id: frame.data for frame in wire.frames}
    assert np.frombuffer(frames[0x190], "<i2").tolist() == [9000, 9123, -100, 32767]
    assert np.frombuffer(frames[0x290], "<u4").tolist() == [1_432_500, 1]
    assert np.frombuffer(frames[0x390], "<u4").tolist() == [2**32 - 1, 0]


@pytest.mark.conformance("CiA 406", "6030h saturates, 2102h has 32 bits")
def test_a_speed_beyond_16_bits_saturates_in_6030h_and_is_right_in_2102h(wire, unit):
    wire.row[signals.column("measured_speed", 4)] = 1000.00005
    assert wire.read(16, 0x6030, 4) == (32767).to_bytes(2, "little")
    assert int.from_bytes(wire.read(16, 0x2102, 4), "little") == 10_000_000


@pytest.mark.conformance("CiA 406", "position 6020h, preset 6010h, counter wraps")
def test_pulse_counters_wrap_and_positions_follow_their_preset(wire, unit):
    counter = signals.column("pulse_count", 2)
    wire.row[counter] = 2.0**32 + 5
    assert wire.read(16, 0x2101, 2) == (5).to_bytes(4, "little")
    assert wire.write(16, 0x6010, 2, 1000, 4) == 0
    assert wire.read(16, 0x6020, 2) == (1000).to_bytes(4, "little")
    wire.row[counter] += 7
    assert wire.read(16, 0x6020, 2) == (1007).to_bytes(4, "little")


@pytest.mark.conformance("CiA 406", "acceleration 6040h")
def test_acceleration_is_the_change_of_speed_between_two_syncs(wire, unit):
    for time_s, speed in ((0.00, 90.0), (0.01, 89.9), (0.02, 89.7)):
        wire.row[signals.column("time")] = time_s
        wire.row[signals.column("measured_speed", 1)] = speed
        wire.sync()
    value = int.from_bytes(wire.read(16, 0x6040, 1), "little", signed=True)
    assert value == pytest.approx(-2000, abs=1)


@pytest.mark.conformance("CiA 406", "measuring units 6001h, 6002h, 6501h, 6502h")
def test_the_teeth_of_the_pole_wheel_are_the_measuring_units(wire, unit):
    assert wire.read(16, 0x6001) == wire.read(16, 0x6501) == (100).to_bytes(4, "little")


# special values of a signal: halves (rounding), more than any type holds, no numbers
VALUES = [
    0.0,
    1.0,
    -1.0,
    0.5,
    1.5,
    2.5,
    -0.5,
    123.456,
    1e5,
    -1e5,
    1e12,
    -1e12,
    math.nan,
    math.inf,
    -math.inf,
]
PLACES = [place for signal in TABLE.signals for place in signal.places]


@pytest.mark.parametrize("place", PLACES, ids=lambda place: f"{place.index:04X}h")
def test_the_fast_reader_of_a_signal_equals_the_table_of_signals(place):
    row = np.zeros(1)
    for parameter in (1.0, 4000.0):
        read = process_image.reader(row, 0, place, parameter)
        for value in VALUES:
            row[0] = value
            assert read() == signals.count(value, place, parameter)


def test_a_counter_wraps_in_both_directions():
    row = np.zeros(1)
    place = Place(1, 0x6064, 0, "I32", 1.0, wraps=True)
    read = process_image.reader(row, 0, place)
    for value in (2.0**31, -(2.0**31) - 1, 2.0**40 + 3):
        row[0] = value
        assert read() == signals.count(value, place)
