"""Stops of vehicles with other numbers of axles, in vector lanes, against the same stops alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from program import LONGEST_S

# the packaged scenarios that fit into lanes, by the number of axles
FITTING = {2: {"bogie_low"}, 6: {"tram_low"}, 8: {"multiple_unit_low"}}


@pytest.mark.parametrize("axles", FITTING)
def test_stops_of_a_vehicle_in_lanes_are_the_stops_alone(axles):
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("lanes_of_vehicle.py")],
        env=os.environ | {"ROLLERRIG_AXLES": str(axles)},
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert set(found) == FITTING[axles]
    for figures in found.values():
        assert figures["same_samples"]
        assert figures["distance"] < 1e-7
        assert figures["channel"] < 1e-6
        assert not figures["depends_on_others"]


def test_a_campaign_of_another_vehicle_may_draw_its_values_and_starts_by_itself(tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text(
        'title = "two axles"\nscenario = "bogie_low"\ndesign = "random"\nruns = 2\n'
        '[vary."adhesion.mu_cd"]\nlow = 0.02\nhigh = 0.05\n'
        "[vary.initial_speed_m_s]\nlow = 2.0\nhigh = 4.0\n"
    )
    command = [sys.executable, "-m", "rollerrig.realtime.cli", "campaign", str(plan)]
    names = {"ROLLERRIG_AXLES", "ROLLERRIG_EQUIPMENT"}
    done = subprocess.run(
        [*command, "--workers", "1", "--out", str(tmp_path / "campaign"), "--json"],
        env={name: value for name, value in os.environ.items() if name not in names},
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["runs"] == 2
