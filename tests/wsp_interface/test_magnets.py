"""The byte of the magnets: bit 2j is the hold magnet of axle j + 1, bit 2j + 1 its vent magnet."""

import pytest

from rollerrig.wsp_interface import magnets


def test_each_magnet_has_its_bit():
    pairs = [magnets.FILLING, magnets.VENTING, magnets.HOLDING, magnets.VENT_MAGNET]
    assert magnets.pack(pairs) == 0b10_01_11_00
    assert magnets.unpack(0b10_01_11_00) == pairs


def test_every_byte_is_packed_as_it_was_unpacked():
    for byte in range(256):
        assert magnets.pack(magnets.unpack(byte)) == byte


@pytest.mark.parametrize(
    ("hold", "vent", "pair"),
    [(False, False, 0b00), (True, False, 0b01), (False, True, 0b10), (True, True, 0b11)],
)
def test_a_pair_has_the_hold_magnet_first(hold, vent, pair):
    assert magnets.pair(hold, vent) == pair


def test_all_magnets_off_lets_every_valve_fill():
    assert magnets.unpack(magnets.ALL_OFF) == [magnets.FILLING] * 4
