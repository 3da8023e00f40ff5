"""Campaigns with a train: rows equal runs, failures act in the cars, the rest is refused."""

import json
import math

import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.campaign import campaign
from rollerrig.realtime.commands import output

PLAN = """
title = "a short stop of a train"
scenario = "two_car_unit"
design = "random"
runs = 4
seed = 3

[vary]
initial_speed_m_s = { low = 6.0, high = 9.0 }

[inputs."car_2.load_kg"]
distribution = "uniform"
loc = 1000.0
scale = 9000.0
source = "assumption"

[inputs."brake.pad_friction"]
per = "car"
distribution = "norm"
loc = 0.35
scale = 0.01
source = "assumption"

[failures.brake_of_car_isolated]
on = "car"
places = [1]
probability = 1.0
loses = 1.0
source = "assumption"

[failures.sensor]
on = "axle"
places = [6]
probability = 1.0
fault = "speed_sensor_dropout"
source = "assumption"
"""


def write(folder, *replaced):
    text = PLAN
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    path = folder / "plan.toml"
    path.write_text(text)
    return str(path)


def test_a_row_of_a_campaign_is_a_run_of_the_train(tmp_path, capsys):
    plan = campaign.load(write(tmp_path))
    settings, faults = campaign.changes(plan, 1)
    values = dict(one.split("=", 1) for one in settings)
    assert json.loads(values["car_1.brake.axle_factors"]) == [0.0] * 4
    assert all(json.loads(values["car_2.brake.axle_factors"]))
    # axle 6 of the train is axle 2 of the second car
    assert faults == ("speed_sensor_dropout car=2 axle=2",)
    row = campaign.once(campaign.piece(plan, 0))[1]
    assert row["error"] is None
    assert row["valid"]
    words = ["run", "two_car_unit", "--pacing", "free", "--json", "--out", str(tmp_path / "run")]
    for one in settings:
        words += ["--set", one]
    for one in faults:
        words += ["--fault", one]
    assert cli.main(words) == output.PASS
    result = json.loads(capsys.readouterr().out)
    assert result["braking_distance_m"] == row["braking_distance_m"]
    assert result["cars"][1]["load_kg"] == json.loads(values["car_2.load_kg"])
    assert result["config_hash"] == row["config_hash"]


def test_an_isolated_brake_makes_the_stop_longer(tmp_path):
    distances_m = []
    for probability in ("1.0", "0.0"):
        replaced = ("probability = 1.0\nloses", f"probability = {probability}\nloses")
        plan = campaign.load(write(tmp_path, replaced))
        distances_m.append(campaign.once(campaign.piece(plan, 0))[0]["braking_distance_m"])
    assert math.isfinite(distances_m[0])
    assert distances_m[0] > 1.5 * distances_m[1]


@pytest.mark.parametrize(
    ("old", "new", "options", "message"),
    [
        ("runs = 4", "runs = 4\nstep_s = 2e-4", {}, "step_s = 0.0002: two_car_unit is a train"),
        ("[vary]", "[vary]", {"device": "cuda"}, "a train runs on cores"),
        ('"two_car_unit"', '"no_train"', {}, "no_train"),
        ("car_2.load_kg", "car_3.load_kg", {}, "it has the cars 1 to 2"),
    ],
)
def test_what_a_campaign_with_a_train_does_not_have_is_refused(
    old, new, options, message, tmp_path
):
    with pytest.raises(ConfigError, match=message):
        campaign.load(write(tmp_path, (old, new)), **options)


def test_explain_refuses_a_train_and_its_cars(tmp_path, capsys):
    run = tmp_path / "run"
    words = ("two_car_unit", "--pacing", "free", "--set", "initial_speed_m_s=3", "--out", str(run))
    assert cli.main(["run", *words]) == output.PASS
    capsys.readouterr()
    for folder, message in ((run, "is the run of a train"), (run / "car_2", "is a car of a train")):
        assert cli.main(["explain", str(folder), "--out", str(tmp_path / "x")]) == output.USAGE
        assert message in " ".join(capsys.readouterr().err.split())
