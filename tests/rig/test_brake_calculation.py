"""The brake calculation by mean values, beside printed results of RailwayBrakeCalculation.

Its notebooks (commits c232ace and 9a780ab) were run cell by cell with changed values, so their
printed results belong to several states, which each test names.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.rig import brake_calculation

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples" / "brake_calculation"


def example(name, unit=None, **head):
    path = EXAMPLES / f"{name}.toml"
    content = store.parse(path) | head
    content["brake_unit"] = [entry | (unit or {}) for entry in content["brake_unit"]]
    return brake_calculation.read(content, path)


def test_the_multiple_unit_has_the_printed_results():
    """The notebook had a_e, t_e and F_Ra of 45 m/s, and the distance of 200 km/h with them."""
    vehicle = example("multiple_unit")
    assert vehicle.dynamic_mass_kg == pytest.approx(126800.0)
    at_45 = brake_calculation.stop(vehicle, 45.0)
    assert at_45.resistance_N == pytest.approx(13387.5)
    assert at_45.response_s == pytest.approx(1.598264, abs=5e-7)
    assert at_45.deceleration_m_s2 == pytest.approx(0.899829, abs=5e-7)
    assert at_45.adhesion == pytest.approx(0.100059, abs=5e-7)
    # the resistance of 45 m/s as a constant force gives the distance that was printed
    constant = vehicle._replace(resistance=(13387.5, 0.0, 0.0))
    at_200_km_h = brake_calculation.stop(constant, 200.0 / 3.6)
    assert at_200_km_h.distance_m == pytest.approx(1803.796711, abs=5e-7)


def test_the_wagon_has_the_printed_results():
    """Its forces were printed with a friction of 0.28, the stop from 80 km/h with 0.12.

    The notebook subtracts the running resistance; here a constant force of that size does. It has
    the response time of the units for the train.
    """
    (unit,) = example("wagon", {"friction": 0.28}).units
    assert round(unit.cylinder_N) == 46726
    assert round(unit.pads_N) == 478362
    assert round(unit.force_N) == 133941
    vehicle = example("wagon", external_force_N=-1412.6)
    found = brake_calculation.stop(vehicle, 80.0 / 3.6)
    assert round(vehicle.units[0].response_s, 2) == 2.2
    assert round(found.deceleration_m_s2, 2) == 0.6
    braking_m = found.distance_m - found.speed_m_s * found.response_s
    assert round(found.speed_m_s * vehicle.units[0].response_s + braking_m, 1) == 461.7
    assert round(found.adhesion, 2) == 0.06
    assert round(found.energy_J / 1e6, 2) == 23.69
    assert round(vehicle.units[0].force_N * 80.0 / 3.6 / 1e3, 2) == 1275.63


def test_the_braked_weight_is_the_curve_of_the_distance_turned_round():
    vehicle = example("multiple_unit")
    found = brake_calculation.braked_weight_percentages(vehicle, brake_calculation.SINGLE_VEHICLE)
    assert list(found) == [100, 120, 140, 160]
    distance_m = brake_calculation.stop(vehicle, 120.0 / 3.6).distance_m
    assert distance_m == pytest.approx(83634.0 / (found[120] + 19.0))
    slow = brake_calculation.braked_weight_percentages(
        vehicle, brake_calculation.TRAIN, most_km_h=120.0
    )
    assert list(slow) == [100, 120]


def test_a_force_that_rises_evenly_lacks_its_delay_and_half_of_its_rise():
    time_s = np.linspace(0.0, 10.0, 2001)
    shares = np.clip((time_s - 0.6) / 3.0, 0.0, 1.0)
    found = brake_calculation.response_s(time_s.tolist(), shares.tolist())
    assert found == pytest.approx(0.6 + 1.5, abs=1e-3)


@pytest.mark.parametrize("scenario", ["dry_stop", "tram_low", "multiple_unit_low"])
def test_mean_values_agree_with_the_simulated_dry_stop(scenario, capsys):
    """Mean values are a little too long: they let the full brake begin late instead of rise."""
    assert cli.main(["brake-calculation", scenario, "--json"]) == 0
    simulated = json.loads(capsys.readouterr().out)["simulated"]
    share = simulated["calculated_m"] / simulated["distance_m"] - 1.0
    assert 0.0 < share < 0.006


def test_a_file_of_brake_units_and_a_scenario_give_the_same_forces(tmp_path, capsys):
    """The coach of dry_stop, written by hand as brake units."""
    path = tmp_path / "coach.toml"
    path.write_text(
        """
[[brake_unit]]
number = 4
cylinder_pressure_Pa = 3.5e5      # 3.8 bar less the springs of 0.3 bar
cylinder_area_m2 = 0.0324
lever_ratio = 2.1
rigging_ratio = 4.0               # two faces of two discs
rigging_efficiency = 0.95
friction = 0.35
friction_radius_m = 0.247
wheel_diameter_m = 0.89
build_up_s = 3.4
mass_kg = 10750.0
"""
    )
    assert cli.main(["brake-calculation", str(path), "--json"]) == 0
    by_hand = json.loads(capsys.readouterr().out)
    assert by_hand["simulated"] is None
    assert cli.main(["brake-calculation", "dry_stop", "--json"]) == 0
    of_scenario = json.loads(capsys.readouterr().out)
    assert by_hand["units"][0]["force_N"] == pytest.approx(of_scenario["units"][0]["force_N"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tram_low_dynamic"], "isolate it with --set dynamic_brake.axles=[]"),
        (["dry_stop", "--speed", "900"], "allowed are 1 to 500 km/h"),
        (["dry_stop", "--set", "demand=[{pressure_Pa=1000.0}]"], "demand more"),
        ([str(EXAMPLES / "wagon.toml"), "--set", "vehicle.mass_kg=1"], "change the file"),
    ],
)
def test_what_cannot_be_calculated_is_refused_with_a_remedy(arguments, message, capsys):
    assert cli.main(["brake-calculation", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_a_vehicle_that_does_not_stop_is_refused():
    vehicle = example("wagon", {"friction": 0.001}, external_force_N=-1e5)
    with pytest.raises(ConfigError, match="does not stop"):
        brake_calculation.stop(vehicle, 20.0)
