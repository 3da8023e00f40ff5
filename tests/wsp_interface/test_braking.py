"""A braking begins with the last sample before the demand and ends with the first at standstill."""

import numpy as np
import pytest

from rollerrig.wsp_interface import braking

NAN = float("nan")


@pytest.mark.parametrize(
    ("demand_Pa", "begin"),
    [
        ([0.0, 0.0, 3e5, 3e5], 1),  # a sample shows the demand of the tick before it
        ([3e5, 3e5], 0),
        ([NAN, NAN, 3e5, 0.0], 1),
        ([0.0, NAN], None),
    ],
)
def test_a_demand_was_given_at_the_last_sample_that_does_not_show_it(demand_Pa, begin):
    assert braking.begin(np.array(demand_Pa)) == begin


@pytest.mark.parametrize(("since", "standstill"), [(0, 1), (2, 3)])
def test_standstill_is_the_first_sample_at_rest_since_another_one(since, standstill):
    speed_m_s = np.array([5.0, braking.STANDS_M_S, 1.0, 0.0, 0.0])
    assert braking.standstill(speed_m_s, since) == standstill
    assert braking.standstill(speed_m_s[:1]) is None
