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
