"""Kdry_rst and Kwet_rst: their intervals, the decelerations behind them, and their files."""

import csv
import json
import math

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.campaign import campaign, etcs, speed_steps
from rollerrig.realtime.campaign.statistics import corrections, draws

RUNS = 3000
# weakness: a generalised Pareto law with this shape above its median, so that its tail is known
SHAPE = -0.2
SCALE = 0.05


def weak_ratio(uniform):
    """Return the ratio that a share of the stops falls below."""
    return 1.0 - SCALE * (uniform**-SHAPE - 1.0) / SHAPE


@pytest.mark.parametrize(
    ("campaigns", "share", "share_at_a_level"),
    [(12, 0.10, 0.25), pytest.param(200, 0.02, 0.04, marks=pytest.mark.nightly)],
)
def test_intervals_of_kdry_rst_hold_the_true_factor_in_95_of_100_at_every_level(
    campaigns, share, share_at_a_level
):
    """The shares may differ from 95 % by `share`, and be lower at a level by `share_at_a_level`."""
    rng = np.random.default_rng(17)
    levels = (0, 1, 2, 4, 6)
    in_interval = dict.fromkeys(levels, 0)
    above_bound = dict.fromkeys(levels, 0)
    methods = {}
    for _ in range(campaigns):
        found = corrections.corrections(weak_ratio(rng.random(RUNS)), levels=levels)
        for level, factor in zip(levels, found, strict=True):
            true_factor = weak_ratio(corrections.failing_share(level))
            in_interval[level] += factor.low <= true_factor <= factor.high
            above_bound[level] += factor.bound <= true_factor
            methods[level] = factor.method
    assert methods == {
        0: "rank",
        1: "rank",
        2: "rank",
        **dict.fromkeys((4, 6), corrections.BY_TAIL),
    }
    # of all levels: at each level alone, 200 campaigns cannot distinguish 95 from 92 %
    for held in (in_interval, above_bound):
        of_all = sum(held.values()) / (campaigns * len(levels))
        assert of_all == pytest.approx(0.95, abs=share)
        assert min(held.values()) >= (0.95 - share_at_a_level) * campaigns


def test_intervals_of_kwet_rst_hold_the_true_ratio_in_93_to_97_of_100():
    rng = np.random.default_rng(2)
    covered = 0
    tries = 2000
    for _ in range(tries):
        dry = rng.normal(1.1, 0.06, 200)
        wet = rng.gamma(20.0, 0.7 / 20.0, 150)
        found = corrections.wet_ratio(draws.moments(wet), draws.moments(dry))
        covered += found.low <= 0.7 / 1.1 <= found.high
    assert 0.93 <= covered / tries <= 0.97


def test_a_safe_deceleration_is_the_product_that_etcs_states():
    # 3.13 of SUBSET-026, from memory: no weight of adhesion, half of it, all of it
    assert corrections.safe_deceleration(1.0, 0.8, 0.5, 0.0) == pytest.approx(0.4)
    assert corrections.safe_deceleration(1.0, 0.8, 0.5, 0.5) == pytest.approx(0.6)
    assert corrections.safe_deceleration(1.0, 0.8, 0.5, 1.0) == pytest.approx(0.8)


def test_levels_that_few_runs_do_not_reach_have_no_number_but_a_reason():
    found = corrections.corrections(np.linspace(0.9, 1.1, 100))
    assert [factor.method for factor in found[:3]] == ["rank", "rank", "none"]
    assert "500 runs" in found[2].reason
    assert math.isnan(found[9].bound)


# --- decelerations ---


def stop(initial_m_s, build_up_s, deceleration_m_s2, lasts_s=200.0):
    """Return the channels of a stop whose deceleration rises linearly and then stays."""
    time_s = np.arange(0.0, lasts_s, 0.001)
    share = np.clip(time_s / build_up_s, 0.0, 1.0)
    speed_m_s = initial_m_s - np.cumsum(deceleration_m_s2 * share) * 0.001
    speed_m_s = np.maximum(speed_m_s, 0.0)
    return {
        "time_s": time_s,
        "vehicle_speed_m_s": speed_m_s,
        "position_m": np.cumsum(speed_m_s) * 0.001,
        "brake_demand_Pa": np.full(time_s.size, 3.8e5),
    }


STEPS = speed_steps.Steps((0.0, 40.0, 80.0, 120.0), 4.0)


def test_a_stop_with_a_constant_deceleration_has_it_in_every_step():
    found = speed_steps.decelerations(stop(40.0, 4.0, 1.2), STEPS)
    assert list(found) == list(STEPS.columns)
    assert STEPS.columns[0] == "deceleration_000_040_m_s2"
    assert list(found.values()) == pytest.approx([1.2, 1.2, 1.2], rel=1e-3)


def test_a_step_above_the_start_has_no_deceleration_and_a_train_that_rolls_on_has_zero():
    found = speed_steps.decelerations(stop(15.0, 4.0, 1.2), STEPS)
    assert list(found.values()) == [pytest.approx(1.2, rel=1e-3), None, None]
    found = speed_steps.decelerations(stop(40.0, 4.0, 1.2, lasts_s=20.0), STEPS)
    assert list(found.values()) == [0.0, 0.0, pytest.approx(1.2, rel=1e-3)]
    released = stop(40.0, 4.0, 1.2) | {"brake_demand_Pa": np.zeros(200_000)}
    assert list(speed_steps.decelerations(released, STEPS).values()) == [None] * 3


# --- from campaigns to files ---

SCENARIO = """
initial_speed_m_s = 4.0
adhesion = "{adhesion}"
[[demand]]
pressure_Pa = 3.8e5
"""
PLAN = """
scenario = "{scenario}"
design = "{design}"
runs = {runs}
chunk = 8
[inputs."brake.pad_friction"]
distribution = "norm"
loc = 0.35
scale = 0.01
source = "test"
[etcs]
speeds_km_h = {speeds}
build_up_s = 0.5
"""


@pytest.fixture
def plan(tmp_path):
    def plan(name="dry", design="random", speeds="[0, 5, 10]", runs=24):
        scenario = tmp_path / f"{name}_stop.toml"
        scenario.write_text(SCENARIO.format(adhesion="very_low" if name == "wet" else "dry"))
        path = tmp_path / f"{name}.toml"
        path.write_text(PLAN.format(scenario=scenario, design=design, speeds=speeds, runs=runs))
        return str(path)

    return plan


def folder(plan, tmp_path, name="dry", **changed):
    """Run a campaign in this process, and return the folder of its results."""
    loaded = campaign.load(plan(name, **changed))
    out = tmp_path / f"{name}_results"
    for chunk in campaign.open_result(loaded, out):
        campaign.write_chunk(out, chunk, campaign.run_chunk(loaded, chunk))
    return out


def test_two_campaigns_give_the_factors_as_json_csv_and_page_each_with_the_notice(
    plan, tmp_path, capsys
):
    dry = folder(plan, tmp_path)
    wet = folder(plan, tmp_path, "wet")
    out = tmp_path / "etcs"
    assert cli.main(["etcs", str(dry), str(wet), "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    table = json.loads((out / "etcs.json").read_text())
    assert printed["steps"] == table["steps"]

    # half of the stops are weaker than the nominal one, which has the mean friction
    for step in table["steps"]:
        median = step["kdry_rst"][0]
        assert median["estimate"] == pytest.approx(1.0, abs=0.02)
        assert median["low"] <= median["estimate"] <= median["high"]
        assert 0.0 < step["kwet_rst"]["estimate"] < 1.0
        assert step["kdry_rst"][5]["bound"] is None
    assert len(table["dry"]["sha256_of_results"]) == 64

    text = (out / "etcs.csv").read_text()
    rows = list(csv.reader(line for line in text.splitlines() if not line.startswith("#")))
    assert len(rows) == 1 + 2 * 10
    page = (out / "etcs.html").read_text()
    for written in (text, page, json.dumps(table)):
        assert "Not a certificate" in written
        assert "SUBSET-026" in written


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"speeds": "[0]"}, "at least two rising"),
        ({"speeds": "[0, 40, 30]"}, "at least two rising"),
        ({"speeds": "[0, 10]\nnominal_m_s2 = [1.0, 2.0]"}, "one for each of the 1 steps"),
    ],
)
def test_wrong_steps_are_refused_before_the_first_run(plan, changed, message):
    with pytest.raises(ConfigError, match=message):
        campaign.load(plan(**changed))


def test_campaigns_that_cannot_give_the_factors_are_refused_with_the_remedy(plan, tmp_path):
    sobol = folder(plan, tmp_path, "sobol", design="sobol", runs=8)
    with pytest.raises(ConfigError, match='set design = "random"'):
        etcs.sample(sobol)

    dry = folder(plan, tmp_path, speeds="[0, 10, 200]", runs=8)
    with pytest.raises(ConfigError, match="begin faster"):
        etcs.table(etcs.sample(dry), None, 0.0)
    other = folder(plan, tmp_path, "other", runs=8)
    with pytest.raises(ConfigError, match="the same speeds_km_h"):
        etcs.table(etcs.sample(dry), etcs.sample(other), 0.0)

    (other / "results" / "part-000000.parquet").unlink()
    with pytest.raises(ConfigError):
        etcs.sample(other)
    (other / "plan.json").write_text('{"fingerprint": "x"}')
    with pytest.raises(ConfigError, match=r"has no table \[etcs\]"):
        etcs.sample(other)


def test_a_folder_that_no_campaign_has_made_is_refused_with_the_command_that_makes_one(
    tmp_path, capsys
):
    assert cli.main(["etcs", str(tmp_path / "nothing")]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "no result folder of a campaign" in message
    assert "rollerrig campaign etcs_dry --out" in message


# --- for OSRD ---

TRAIN = """
gamma_service_m_s2 = 0.9
gamma_normal_service_m_s2 = 0.7
k_n_pos_m_s2 = 0.0
k_n_neg_m_s2 = 0.0
t_traction_cut_off_s = 1.0
t_bs1_s = 3.0
t_bs2_s = 3.0
t_be_s = 4.0
"""
# fields of EtcsBrakeParams in editoast/schemas/src/rolling_stock/etcs_brake_params.rs of OSRD,
# commit 67ad641e23cf: unknown and missing ones are refused there
CURVES = {
    *("gamma_emergency", "gamma_service", "gamma_normal_service"),
    *("k_dry", "k_wet", "k_n_pos", "k_n_neg"),
}
TIMES = {"t_traction_cut_off", "t_bs1", "t_bs2", "t_be"}


def test_osrd_json_keeps_the_rules_that_osrd_checks_and_has_the_bounds_of_the_level(
    plan, tmp_path, capsys
):
    dry = folder(plan, tmp_path)
    wet = folder(plan, tmp_path, "wet")
    train = tmp_path / "train.toml"
    train.write_text(TRAIN)
    words = ["etcs", str(dry), str(wet), "--out", str(tmp_path / "out"), "--format", "osrd"]
    assert cli.main([*words, "--train", str(train), "--ebcl", "0", "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    found = json.loads((tmp_path / "out" / "osrd.json").read_text())
    assert set(found) == CURVES | TIMES
    for name in CURVES:
        curve = found[name]
        assert set(curve) == {"boundaries", "values"}
        assert len(curve["values"]) == len(curve["boundaries"]) + 1
        assert curve["boundaries"] == sorted(set(curve["boundaries"]))
        assert min(curve["values"] + curve["boundaries"]) >= 0.0
    for name in ("k_dry", "k_wet"):
        assert found[name]["boundaries"] == found["gamma_emergency"]["boundaries"]
        assert max(found[name]["values"]) <= 1.0
    # steps of 0 to 5 and 5 to 10 km/h: the boundary between them, in m/s
    assert found["k_dry"]["boundaries"] == [pytest.approx(5 / 3.6)]
    steps = table["steps"]
    assert found["gamma_emergency"]["values"] == [step["nominal_m_s2"] for step in steps]
    assert found["k_dry"]["values"] == [min(step["kdry_rst"][0]["bound"], 1.0) for step in steps]
    assert found["t_be"] == 4.0

    for changed, message in (
        (["--train", str(train), "--ebcl", "9"], "no bound of Kdry_rst at this level"),
        (["--train", str(train), "--ebcl", "10"], "allowed are 0 to 9"),
        ([], "--format osrd needs --train FILE"),
    ):
        assert cli.main([*words, *changed]) == 2
        assert message in capsys.readouterr().err
    train.write_text(TRAIN.replace("t_be_s = 4.0", ""))
    assert cli.main([*words, "--train", str(train)]) == 2
    assert "t_be_s is missing; OSRD needs it" in capsys.readouterr().err
    assert cli.main(["etcs", str(dry), "--train", str(train)]) == 2
    assert "--train is for --format osrd" in capsys.readouterr().err
