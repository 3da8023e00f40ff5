"""`compare` shows what rollers add to a track: the adhesion of each third of a stop."""

from pathlib import Path

import pyarrow as pa
import pytest

from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.record import compare, records


def drifts(*settings):
    """Return the drifts of a short stop at mu_cd = 0.04."""
    all_settings = ("initial_speed_m_s=15.0", "adhesion.mu_cd=0.04", *settings)
    plan = scenario.load("velim_a1", settings=all_settings)
    channels = pa.table(free.channels(free.simulate(plan), plan.table))
    return compare.drifts(records.Run(Path("run"), channels, plan.resolved, [], {}))


def test_a_film_that_thins_raises_friction_from_third_to_third_and_a_track_keeps_it():
    rollers = drifts("roller_film.thinning=0.02")
    track = drifts("roller_film.thinning=0.02", "rig=plain_track")
    first, second, last = rollers["friction mu_cd"]
    assert 0.04 < first < second < last
    assert track["friction mu_cd"] == pytest.approx((0.04, 0.04, 0.04), rel=1e-12)
    last_third = 2
    on_rollers = rollers["adhesion while sliding"][last_third]
    assert on_rollers > track["adhesion while sliding"][last_third]
