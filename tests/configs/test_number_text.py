"""Numbers in tables are rounded and have no exponent."""

import math

import pytest

from rollerrig.configs.number_text import rounded


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.067e5, "106700"),
        (999960.0, "1000000"),
        (-123456789.0, "-123500000"),
        (1.9e-5, "0.000019"),
        (12.5, "12.5"),
        (0.0, "0"),
        (3e-12, "3e-12"),
        (math.nan, "nan"),
        (math.inf, "inf"),
    ],
)
def test_a_number_has_an_exponent_only_if_its_zeros_could_not_be_counted(value, text):
    assert rounded(value) == text


@pytest.mark.parametrize("digits", [1, 3, 4, 6])
def test_a_number_keeps_its_significant_digits_at_each_magnitude(digits):
    for power in range(-7, 15):
        for mantissa in (1.0, -1.2345678, 9.876543):
            value = mantissa * 10.0**power
            assert float(rounded(value, digits)) == float(f"{value:.{digits}g}")
            assert "e" not in rounded(value, digits)
