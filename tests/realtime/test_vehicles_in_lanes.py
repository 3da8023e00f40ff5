"""Stops of vehicles with other numbers of axles, in vector lanes, against the same stops alone."""

import json
from pathlib import Path

import program
import pytest

# they share the servers of programs of these vehicles, and runs
pytestmark = pytest.mark.xdist_group("vehicles")

# the packaged scenarios that fit into lanes, by the number of axles
FITTING = {2: {"bogie_low"}, 6: {"tram_low"}, 8: {"multiple_unit_low"}}


@pytest.mark.nightly
@pytest.mark.parametrize("axles", FITTING)
def test_stops_of_a_vehicle_in_lanes_are_the_stops_alone(axles):
    text = Path(__file__).with_name("lanes_of_vehicle.py").read_text()
    done = program.python("-c", text, ROLLERRIG_AXLES=str(axles))
    assert done.status == 0, done.messages
    found = json.loads(done.printed)
    assert set(found) == FITTING[axles]
    for figures in found.values():
        assert figures["same_samples"]
        assert figures["distance"] < 1e-7
        assert figures["channel"] < 1e-6
        assert not figures["depends_on_others"]


@pytest.mark.nightly
def test_a_campaign_of_another_vehicle_may_draw_its_values_and_starts_by_itself(tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text(
        'title = "two axles"\nscenario = "bogie_low"\ndesign = "random"\nruns = 2\n'
        '[vary."adhesion.mu_cd"]\nlow = 0.02\nhigh = 0.05\n'
        "[vary.initial_speed_m_s]\nlow = 2.0\nhigh = 4.0\n"
    )
    done = program.rollerrig(
        *("campaign", plan, "--workers", "1", "--out", tmp_path / "campaign", "--json")
    )
    assert done.status == 0, done.messages
    assert json.loads(done.printed)["runs"] == 2
