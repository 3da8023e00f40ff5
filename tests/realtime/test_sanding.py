"""The sand's law: the two fitted stops are met, the others predicted, and [sanders] has the fitted numbers."""

import pytest
from paper import sanding

from rollerrig.rig import params


def test_the_law_meets_what_it_was_fitted_to_and_predicts_the_other_stops():
    result = sanding.study()
    rows = {row.name: row.default for row in params.ROWS["sanders"]}
    assert rows["gain"] == pytest.approx(result["gain"], rel=0.01)
    assert rows["dose_scale_kg_m"] == pytest.approx(result["dose_scale_kg_m"], rel=0.01)
    for one in result["stops"]:
        if one["stop"] == "no sand":
            assert one["by_the_law_m"] > one["measured_m"]
        else:
            assert one["by_the_law_m"] == pytest.approx(
                one["measured_m"], rel=0.01 if one["fitted"] else 0.15
            )
    assert sum(one["fitted"] for one in result["stops"]) == 2


def test_more_sand_in_more_places_never_lengthens_the_stop():
    distances = [sanding.distance_m(stop, 3.0, 0.008) for stop in sanding.STOPS]
    assert distances[0] > distances[1] > max(distances[2], distances[3])
    assert distances[4] == min(distances)
