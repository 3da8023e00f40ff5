"""Plans with combinations of brakes, a brake model for each, and the time of the build-up."""

import csv
import json

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.campaign import campaign, combined, speed_steps

SCENARIO = """
title = "A short stop of a tram on dry rails"
vehicle = "tram_3_bogies"
adhesion = "dry"
wsp_config = "tram_3_bogies"
initial_speed_m_s = 7.0
[[demand]]
pressure_Pa = 4.5e5
"""
PLAN = """
title = "combinations"
scenario = "tram.toml"
design = "random"
runs = 8
seed = 3

[combinations.all_brakes]
isolates = []

[combinations.friction_only]
isolates = ["dynamic_brake", "magnetic_track_brake"]

[inputs."vehicle.mass_kg"]
distribution = "norm"
loc = 50000.0
scale = 1000.0
source = "a test"

[etcs]
speeds_km_h = [0, 20]
build_up_s = 0.8
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "tram.toml").write_text(SCENARIO)
    (tmp_path / "plan.toml").write_text(PLAN)
    return tmp_path


def test_each_combination_is_a_campaign_and_a_brake_model(folder, capsys):
    out = folder / "out"
    command = ["campaign", str(folder / "plan.toml"), "--out", str(out), "--workers", "1", "--json"]
    assert cli.main(command) == 0
    done = json.loads(capsys.readouterr().out)["combinations"]
    assert list(done) == ["all_brakes", "friction_only"]
    assert combined.names_in(out) == ("all_brakes", "friction_only")
    isolating = "--set 'dynamic_brake.axles=[]' --set 'magnetic_track_brake.bogies=[]'"
    for name, found in done.items():
        for case in found["worst"]:
            assert (isolating in case["replay"]) == (name == "friction_only")
    # the same draws in both
    masses = [
        campaign.result(out / name)["vehicle.mass_kg"].to_pylist()
        for name in ("all_brakes", "friction_only")
    ]
    assert masses[0] == masses[1]

    command = ["etcs", str(out), "--format", "brake-models", "--out", str(folder / "e"), "--json"]
    assert cli.main(command) == 0
    tables = json.loads(capsys.readouterr().out)["combinations"]
    with_all, friction_only = (tables[name]["steps"][0]["nominal_m_s2"] for name in tables)
    # magnets add to it
    assert with_all > 1.3 * friction_only
    lines = (folder / "e" / "brake_models.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [row["combination"] for row in rows] == list(tables)
    for row, table in zip(rows, tables.values(), strict=True):
        assert float(row["ad_m_s2"]) == pytest.approx(table["steps"][0]["nominal_m_s2"], abs=1e-4)
        assert float(row["kdry_rst_ebcl_0"]) == 1.0
        assert float(row["tbu_s"]) == pytest.approx(table["build_up"]["nominal_s"], abs=1e-3)
        # a mass of 2 % more or less
        assert table["steps"][0]["kdry_rst"][0]["estimate"] == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('["dynamic_brake", "magnetic_track_brake"]', '["eddy_current_brake"]', "Allowed: dynamic"),
        ('["dynamic_brake", "magnetic_track_brake"]', '"dynamic_brake"', "give a list"),
        ("combinations.all_brakes", 'combinations."../all"', "name is that of a folder"),
        ('scenario = "tram.toml"', 'scenario = "dry_stop"', "has no dynamic_brake that acts"),
        ("build_up_s = 0.8", "build_up_s = 0.8\nnominal_m_s2 = [2.0]", "its own nominal"),
    ],
)
def test_a_wrong_combination_is_refused_with_a_remedy(folder, before, after, message):
    path = folder / "plan.toml"
    path.write_text(PLAN.replace(before, after))

    def load_all():
        return [campaign.load(str(path), combination=name) for name in combined.read(str(path))]

    with pytest.raises(ConfigError, match=message):
        load_all()


def test_a_folder_keeps_its_combinations(folder):
    combined.claim(folder / "out", ("one", "two"))
    combined.claim(folder / "out", ("one", "two"))
    with pytest.raises(ConfigError, match="has the combinations one, two"):
        combined.claim(folder / "out", ("one",))
    (folder / "out" / combined.FILE).write_text('{"combinations": ["../elsewhere"]}')
    with pytest.raises(ConfigError, match="no list of combinations"):
        combined.names_in(folder / "out")


@pytest.mark.parametrize(("delay_s", "rise_s"), [(0.7, 0.0), (0.5, 2.0)])
def test_the_build_up_time_is_the_delay_and_half_of_an_even_rise(delay_s, rise_s):
    time_s = np.arange(0.0, 60.0, 0.001)
    share = np.clip((time_s - 1.0 - delay_s) / max(rise_s, 1e-9), 0.0, 1.0)
    speed_m_s = np.maximum(35.0 - np.cumsum(share) * 0.001, 0.0)
    channels = {
        "time_s": time_s,
        "brake_demand_Pa": np.where(time_s >= 1.0, 3e5, 0.0),
        "vehicle_speed_m_s": speed_m_s,
        "position_m": np.cumsum(speed_m_s) * 0.001,
    }
    steps = speed_steps.Steps((0.0, 60.0, 120.0), 4.0)
    found = speed_steps.figures(channels, steps)
    assert found["deceleration_060_120_m_s2"] == pytest.approx(1.0, rel=1e-3)
    assert found[speed_steps.BUILD_UP] == pytest.approx(delay_s + 0.5 * rise_s, abs=5e-3)
