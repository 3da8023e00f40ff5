"""The law of sand meets the fitted stops and predicts the others; [sanders] has the fitted
numbers.
"""

import pytest
from paper import sanding

from rollerrig.rig import params


def test_the_law_meets_what_it_was_fitted_to_and_predicts_the_other_stops():
    result = sanding.study()
    defaults = {row.name: row.default for row in params.ROWS["sanders"]}
    assert defaults["gain"] == pytest.approx(result["gain"], rel=0.01)
    assert defaults["dose_scale_kg_m"] == pytest.approx(result["dose_scale_kg_m"], rel=0.01)

    for stop in result["stops"]:
        if stop["stop"] == "no sand":
            assert stop["by_the_law_m"] > stop["measured_m"]
        else:
            tolerance = 0.01 if stop["fitted"] else 0.15
            assert stop["by_the_law_m"] == pytest.approx(stop["measured_m"], rel=tolerance)
    assert sum(stop["fitted"] for stop in result["stops"]) == 2


def test_more_sand_in_more_places_never_lengthens_the_stop():
    none, one_fixed, two_fixed, one_by_speed, two_by_speed = (
        sanding.distance_m(stop, 3.0, 0.008) for stop in sanding.STOPS
    )
    assert none > one_fixed > max(two_fixed, one_by_speed)
    assert two_by_speed == min(none, one_fixed, two_fixed, one_by_speed, two_by_speed)
