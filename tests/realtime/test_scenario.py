"""Scenarios: layers merge in order, and a resolved scenario is a scenario again."""

import tomllib

import numpy as np
import pytest

from rollerrig.configs import vehicle
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import scenario

OF_A_USER = """
title = "a scenario of a user"
vehicle = "uic_z1"
adhesion_set = "wet"
initial_speed_m_s = 20.0
[adhesion]
mu_cd = 0.09
[[demand]]
from_s = 1.0
pressure_Pa = 2.0e5
[[friction]]
from_m = 100.0
mu_cd = 0.05
axles = [1, 3]
[[friction]]
from_s = 7.0
mu_cr = 0.2
"""


@pytest.fixture
def user_scenario(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(OF_A_USER)
    return str(path)


def test_a_later_layer_overrides_an_earlier_one(user_scenario, tmp_path):
    model = tmp_path / "extended.toml"
    model.write_text("[adhesion]\ntau_m_J = 1e-4\nmu_cr = 0.25\n")
    plain = scenario.load(user_scenario)
    # the scenario overrides the set "wet", and the set overrides the default
    assert plain["adhesion"]["mu_cd"] == 0.09
    assert plain["adhesion"]["cleaning_creepage"] == 0.55
    assert plain["adhesion"]["mu_cr"] == 0.28
    extended = scenario.load(user_scenario, str(model))
    assert extended["adhesion"]["tau_m_J"] == 1e-4
    assert extended["adhesion"]["mu_cr"] == 0.25

    # settings of the command line override both
    settled = scenario.load(
        user_scenario, str(model), ("adhesion.mu_cr=0.22", "initial_speed_m_s=25")
    )
    assert settled["adhesion"]["mu_cr"] == 0.22
    assert settled["adhesion"]["tau_m_J"] == 1e-4
    assert settled["initial_speed_m_s"] == 25.0


def test_a_set_and_single_values_of_it_can_be_set_in_any_order(user_scenario):
    for settings in (
        ("adhesion=dry", "adhesion.mu_cr=0.3"),
        ("adhesion.mu_cr=0.3", "adhesion=dry"),
    ):
        plan = scenario.load(user_scenario, settings=settings)
        assert plan["adhesion_set"] == "dry"
        assert plan["adhesion"]["tau_m_J"] == 0.0
        assert plan["adhesion"]["mu_cr"] == 0.3
        assert plan["adhesion"]["mu_cd"] == 0.09


def test_a_set_is_found_in_the_folder_of_the_scenario_that_names_it(tmp_path):
    (tmp_path / "sand.toml").write_text("[adhesion]\nmu_cd = 0.2\n")
    (tmp_path / "own.toml").write_text(
        OF_A_USER.replace('"wet"', '"sand.toml"').replace("0.09", "0.2")
    )
    assert scenario.load(str(tmp_path / "own.toml"))["adhesion"]["mu_cd"] == 0.2


def test_the_resolved_scenario_is_complete_and_a_scenario_again(user_scenario, tmp_path):
    first = scenario.load(user_scenario, settings=("loop.tick_hz=2000", "loop.step_s=5e-5"))
    folder = tmp_path / "run7"
    folder.mkdir()
    (folder / "scenario.toml").write_text(scenario.dump(first))
    again = scenario.load(str(folder / "scenario.toml"))
    assert again.name == "run7"
    assert again.resolved == first.resolved
    assert scenario.digest(again) == scenario.digest(first)
    written = tomllib.loads(scenario.dump(first))
    for section, rows in scenario.SECTIONS.items():
        # a vehicle without such equipment has no table of it
        if section in vehicle.EQUIPMENT_KEYS:
            assert section not in written
            continue
        assert set(written[section]) == {row.name for row in rows}
    for row in scenario.HEAD:
        assert row.name in written


def test_the_hash_changes_with_every_value_that_changes_the_result(user_scenario):
    plain = scenario.digest(scenario.load(user_scenario))
    assert scenario.digest(scenario.load(user_scenario)) == plain
    for setting in (
        "adhesion.mu_cd=0.091",
        "loop.step_s=5e-5",
        "valve.dead_time_s=0.05",
        "initial_speed_m_s=20.1",
        "wsp_config=other",
    ):
        assert scenario.digest(scenario.load(user_scenario, settings=(setting,))) != plain


def test_friction_and_demand_become_arrays_in_their_order(user_scenario):
    plan = scenario.load(user_scenario)
    friction = plan.params.friction
    demand = plan.params.demand
    assert friction.by_place.tolist() == [True, False]
    assert friction.start.tolist() == [100.0, 7.0]
    # a step without a value has that of the adhesion law
    assert friction.mu_cd.tolist() == [0.05, 0.09]
    assert friction.mu_cr.tolist() == [0.28, 0.2]
    assert friction.axles.tolist() == [0b0101, 0b1111]

    assert demand.start_s.tolist() == [1.0]
    assert demand.pressure_Pa.tolist() == [2e5]


def test_without_demand_nothing_brakes(tmp_path):
    (tmp_path / "coast.toml").write_text('title = "it coasts"\n')
    plan = scenario.load(str(tmp_path / "coast.toml"))
    assert plan.params.demand.start_s.size == 0
    assert plan["demand"] == []


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ((), (10, 10, 10)),
        (("loop.tick_hz=2000",), (5, 20, 20)),
        (("loop.step_s=1e-3", "loop.record_hz=1000"), (1, 10, 1)),
        (("bus.sync_period_s=0.005",), (10, 5, 10)),
    ],
)
def test_rates_become_whole_ratios(settings, expected):
    plan = scenario.load("velim_a1", settings=settings)
    assert (plan.params.substeps, plan.sync_ticks, plan.record_ticks) == expected
    assert plan.params.step_s * plan.params.substeps == pytest.approx(plan.params.tick_s)


def test_ratios_that_are_no_whole_numbers_are_refused_with_both_numbers():
    with pytest.raises(ConfigError, match=r"tick of 0.001 s over step_s = 0.0004 s is 2.5"):
        scenario.load("velim_a1", settings=("loop.step_s=4e-4",))
    with pytest.raises(
        ConfigError, match=r"sync_period_s = 0.0005 s over a tick of 0.001 s is 0.5"
    ):
        scenario.load("velim_a1", settings=("bus.sync_period_s=5e-4",))


def test_a_mask_names_an_axle_once_however_often_it_is_listed(tmp_path):
    text = OF_A_USER.replace("axles = [1, 3]", "axles = [3, 1, 3]")
    (tmp_path / "own.toml").write_text(text)
    assert scenario.load(str(tmp_path / "own.toml")).params.friction.axles[0] == 0b0101


def test_numbers_reach_the_physics_as_floats():
    plan = scenario.load("velim_a1", settings=("vehicle.mass_kg=40000",))
    assert isinstance(plan.params.vehicle.mass_kg, float)
    assert all(np.asarray(column).dtype.kind in "fib" for column in plan.params.friction)


def test_the_comment_of_a_scenario_promises_to_repeat_only_what_it_contains():
    plan = scenario.load("velim_a1")
    assert "# Run it again to repeat the run, unless a PLC" in scenario.dump(plan)
    of_test = scenario.dump(plan, of_harness=True)
    assert "its brake, friction and faults are not in this file" in of_test
    assert "Run it again" not in of_test
    assert tomllib.loads(of_test) == tomllib.loads(scenario.dump(plan))
