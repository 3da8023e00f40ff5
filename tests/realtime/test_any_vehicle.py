"""One process simulates any vehicles, one after another, with the same compiled kernels."""

import json
import subprocess
import sys

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.realtime.bench import free, scenario

# a stop of each kind of vehicle, and what the vehicle is
VEHICLES = {
    "velim_a1": COACH,
    "tram_low_dynamic": Kind(6, dynamic_brake=True),
    "bogie_low": Kind(2),
    "tram_emergency_magnetic": Kind(6, magnetic_track_brake=True),
    "multiple_unit_low": Kind(8),
}
SHORT = ("initial_speed_m_s=3",)
# prints the number of kernels that each stop has compiled; the first argument is the pacing
COUNT = """
import contextlib, json, sys, tempfile
from rollerrig.realtime import cli
from rollerrig.rig.compiled import compile_progress
pacing, *names = sys.argv[1:]
# the same adhesion for all: only some sets state an initial adhesion, for which a kernel is called
given = ("adhesion=low", "duration_max_s=0.2", "bus.interface=hub", "bus.socketcand_port=0")
settings = [word for setting in given for word in ("--set", setting)]
counts = []
for name in names:
    before = compile_progress._listener.compiled
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
        cli.main(["run", name, "--pacing", pacing, *settings, "--out", folder + "/run"])
    counts.append(compile_progress._listener.compiled - before)
print(json.dumps(counts))
"""


@pytest.fixture(scope="module")
def plans():
    return {name: scenario.load(name, settings=SHORT) for name in VEHICLES}


def test_scenarios_of_all_vehicles_load_in_one_process(plans):
    for name, kind in VEHICLES.items():
        plan = plans[name]
        assert plan.kind == kind
        assert plan.params.axles == kind.axles
        assert len(plan.params.axle_position_m) == kind.axles
        assert len(plan.table.span("wheel_speed").indices(10_000)) == 3
        assert f"wheel_speed_{kind.axles}_rad_s" in plan.table.columns
        assert f"wheel_speed_{kind.axles + 1}_rad_s" not in plan.table.columns
        assert ("dynamic_torque_1_Nm" in plan.table.columns) == kind.dynamic_brake
        assert ("track_brake_force_1_N" in plan.table.columns) == kind.magnetic_track_brake


@pytest.mark.xdist_group("vehicles")
def test_a_stop_does_not_depend_on_the_vehicles_before_it(plans):
    first = {name: free.simulate(plan) for name, plan in plans.items()}
    for name in reversed(VEHICLES):
        np.testing.assert_array_equal(free.simulate(plans[name]), first[name], err_msg=name)


@pytest.mark.nightly
@pytest.mark.parametrize("pacing", ["free", "lockstep"])
def test_after_a_coach_other_vehicles_compile_nothing(pacing, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", COUNT, pacing, *VEHICLES], capture_output=True, text=True, check=True
    )
    of_coach, *of_others = json.loads(done.stdout)
    assert of_coach > 100
    assert of_others == [0] * len(of_others)


@pytest.mark.parametrize("axles", [0, 3, 5, 14, 4.0, True, "4"])
def test_a_number_of_axles_that_no_vehicle_has_is_refused_with_the_allowed_ones(axles):
    with pytest.raises(ConfigError, match=r"axles = .*; it must be one of 2, 4, 6, 8, 10, 12"):
        scenario.load("velim_a1", tables={"vehicle": {"axles": axles}})


def test_the_place_of_a_mechanism_must_be_on_the_vehicle():
    settings = ("mechanisms.brake_gain_gain=0.1", "mechanisms.brake_gain_axle=5")
    with pytest.raises(ConfigError, match=r"brake_gain_axle = 5.*-2 to 4"):
        scenario.load("velim_a1", settings=settings)
    assert scenario.load("tram_low", settings=settings).kind.axles == 6
