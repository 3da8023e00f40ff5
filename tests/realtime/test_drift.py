"""What rollers add to a track shows in `compare`: adhesion of each third of the stop."""

from pathlib import Path

import pyarrow as pa
import pytest

from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.record import compare, records


def braked(*settings):
    plan = scenario.load(
        "velim_a1", settings=("initial_speed_m_s=15.0", "adhesion.mu_cd=0.04", *settings)
    )
    return records.Run(
        Path("run"), pa.table(free.channels(free.simulate(plan))), plan.resolved, [], {}
    )


def test_a_film_that_thins_raises_friction_from_third_to_third_and_a_track_keeps_it():
    worn, kept = (
        compare.drifts(braked(*settings))
        for settings in (
            ("roller_film.thinning=0.02",),
            ("roller_film.thinning=0.02", "rig=plain_track"),
        )
    )
    first, second, last = worn["friction mu_cd"]
    assert 0.04 < first < second < last
    assert kept["friction mu_cd"] == pytest.approx((0.04, 0.04, 0.04), rel=1e-12)
    assert worn["adhesion while sliding"][2] > kept["adhesion while sliding"][2]
