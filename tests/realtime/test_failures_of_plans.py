"""Plans with failures and with inputs of single brake units: what each run has, and its factors."""

import json
import shlex
from collections import Counter

import numpy as np
import pytest
from short_campaign import run_here

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.campaign import campaign, comparison, etcs, outcome
from rollerrig.realtime.campaign.components import train

SCENARIO = """
title = "A short stop on dry rails"
adhesion = "dry"
initial_speed_m_s = 20.0
[[demand]]
pressure_Pa = 3.8e5
"""
HEAD = """
title = "failures"
scenario = "short.toml"
unit = "none"
design = "{design}"
runs = {runs}
seed = 3
"""
DEAD_DISC = """
[failures.dead_disc]
on = "disc"
probability = {probability}
loses = 1.0
source = "a test"
"""
PADS = """
[inputs."brake.pad_friction"]
per = "disc"
distribution = "norm"
loc = 0.35
scale = 0.02
correlation_in_car = 0.5
source = "a test"
"""
STEPS = """
[etcs]
speeds_km_h = [0, 30]
build_up_s = 6.0
"""


@pytest.fixture
def plan_of(tmp_path):
    (tmp_path / "short.toml").write_text(SCENARIO)

    def write(text, design="stratified", runs=120, name="plan"):
        path = tmp_path / f"{name}.toml"
        path.write_text(HEAD.format(design=design, runs=runs) + text)
        return path

    return write


def load(path):
    return campaign.load(str(path))


def test_the_factors_of_dead_brake_units_are_those_by_hand(plan_of, tmp_path):
    """1, 2 or 3 of 8 discs are dead with 1e-3 each; a level has the number that it must expect."""
    few = DEAD_DISC.format(probability=1e-3) + "most = 2\n" + STEPS
    path = plan_of(few, runs=40)
    run_here(path, tmp_path / "out")
    table = etcs.table(etcs.sample(tmp_path / "out"), None, 0.0)
    (step,) = table["steps"]
    # P(2) = 28 * 1e-6, P(1) = 8e-3 by hand; more than two are out of service
    failed = {0: 0, 1: 0, 2: 0, 3: 1, 4: 1, 5: 2, 6: 2, 9: 2}
    for level, number in failed.items():
        factor = step["kdry_rst"][level]
        assert factor["method"] == "strata"
        # the running resistance brakes as well, so the rest is a little stronger
        assert factor["estimate"] == pytest.approx(1.0 - number / 8.0, abs=0.004)
        # all sets of places were computed: the bound is the estimate
        assert factor["bound"] == factor["estimate"]


def test_a_run_has_its_failures_as_faults_and_lost_torque_and_its_command_repeats_it(plan_of):
    text = PADS + DEAD_DISC.format(probability=0.2)
    text += """
[failures.valve]
on = "bogie"
fault = "cylinder_leak"
time_constant_s = 1.5
probability = 0.3
source = "a test"

[failures.filling]
on = "train"
probability = 0.5
set = { "brake.fill_time_constant_s" = 4.0 }
source = "a test"
"""
    plan = load(plan_of(text, design="random", runs=40))
    columns = {name: place for place, name in enumerate(plan.axes)}
    seen = Counter()
    for number, point in enumerate(plan.points):
        resolved = campaign.resolve(plan, number)
        dead = [int(word) for word in point[columns["failures.dead_disc"]].split(",") if word]
        pads = [point[columns[f"brake.pad_friction[{disc}]"]] for disc in range(1, 9)]
        by_disc = [0.0 if disc in dead else pads[disc - 1] / 0.35 for disc in range(1, 9)]
        of_axles = [(by_disc[place] + by_disc[place + 1]) / 2.0 for place in range(0, 8, 2)]
        assert resolved["brake"]["axle_factors"] == pytest.approx(of_axles, rel=1e-12)
        bogies = [int(word) for word in point[columns["failures.valve"]].split(",") if word]
        axles = [axle for bogie in bogies for axle in (2 * bogie - 1, 2 * bogie)]
        assert [fault.values for fault in resolved.faults] == [
            {"axle": axle, "time_constant_s": 1.5} for axle in axles
        ]
        is_slow = point[columns["failures.filling"]] == "1"
        assert resolved["brake"]["fill_time_constant_s"] == (4.0 if is_slow else 1.3)
        seen.update(dead=len(dead), bogies=len(bogies), slow=is_slow)

        words = shlex.split(campaign.command(plan, number))
        assert words.count("--fault") == len(axles)
    # 320 discs with 0.2, 80 bogies with 0.3, 40 trains with 0.5: five standard deviations
    assert abs(seen["dead"] - 64) < 36
    assert abs(seen["bogies"] - 24) < 21
    assert abs(seen["slow"] - 20) < 16


def test_a_large_random_plan_draws_the_same_failures_as_a_small_one(plan_of):
    text = PADS + DEAD_DISC.format(probability=0.1) + "most = 2\n"
    small = load(plan_of(text, design="random", runs=30))
    path = plan_of(text, design="random", runs=30)
    large = campaign.load(str(path), rows_up_to=10)
    assert large.is_large
    assert large.axes == small.axes
    assert [large.points[number] for number in range(30)] == list(small.points)


def test_pads_of_a_coach_vary_less_together_than_each(plan_of):
    plan = load(plan_of(PADS.replace("0.5", "0.0"), design="random", runs=2000))
    pads = np.array(plan.points)
    assert pads.std(axis=0) == pytest.approx([0.02] * 8, rel=0.1)
    # eight independent discs: the mean scatters by 1 / sqrt(8)
    assert pads.mean(axis=1).std() == pytest.approx(0.02 / 8**0.5, rel=0.1)
    together = np.array(load(plan_of(PADS, design="random", runs=2000)).points)
    # rank 0.5 is 0.518 between normal numbers
    expected = 0.02 * ((1.0 + 7.0 * 0.518) / 8.0) ** 0.5
    assert together.mean(axis=1).std() == pytest.approx(expected, rel=0.1)


def test_the_page_has_failures_their_combinations_and_quantiles_with_weights(
    plan_of, tmp_path, capsys
):
    text = PADS + DEAD_DISC.format(probability=1e-4) + "[failures]\nrarest = 1e-6\n"
    path = plan_of(text, runs=150)
    run_here(path, tmp_path / "out")
    assert cli.main(["campaign", str(path), "--out", str(tmp_path / "out"), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    found = {one["quantile"]: one for one in printed["stopping_distance"]}
    plan = load(path)
    rows = campaign.result(tmp_path / "out")
    weights = rows[campaign.WEIGHT].to_numpy()
    assert weights.sum() == pytest.approx(1.0, abs=1e-12)
    distance_m = rows["braking_distance_m"].to_numpy()
    # a stop is as rare as the page says: counted with weights
    for quantile in (0.5, 0.95):
        estimate_m = found[quantile]["estimate_m"]
        assert weights[distance_m > estimate_m].sum() <= 1.0 - quantile + 1e-12
        assert weights[distance_m >= estimate_m].sum() >= 1.0 - quantile - 1e-12
        assert found[quantile]["probability_error"] > 0.0
    # the longest stops of the rows are those with failures, and weigh little
    assert found[0.5]["estimate_m"] < np.median(distance_m)
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    for text in ("Combinations of failures", "1 x dead_disc", "1 in 10,000", "no failure"):
        assert text in page
    outcome_of_plan = outcome.read(plan, tmp_path / "out")
    assert outcome_of_plan.distance_m.missing == 0.0
    with pytest.raises(ConfigError, match="different weights"):
        comparison.read(tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("probability = 0.1\nloses = 1.0", "source is missing"),
        ('source = "a"\nloses = 1.0', "give probability, or rate_1_h and inspection_interval_h"),
        (
            'source = "a"\nloses = 1.0\nprobability = 0.1\nrate_1_h = 1e-6',
            "give probability, or rate_1_h and inspection_interval_h, and not both",
        ),
        ('source = "a"\nprobability = 0.1', "states no effect; give loses"),
        (
            'source = "a"\nprobability = 0.1\nfault = "vent_magnet_ded"',
            "did you mean 'vent_magnet_dead'",
        ),
        (
            'source = "a"\nprobability = 0.1\nfault = "vent_magnet_dead"\non = "disc"',
            'acts on an axle; set on = "axle"',
        ),
        ('source = "a"\nprobability = 0.1\nfault = "power_dip"', 'set on = "train"'),
        (
            'source = "a"\nprobability = 0.1\nfault = "power_dip"\non = "train"',
            "acts on the bus",
        ),
        (
            'source = "a"\nprobability = 0.1\nfault = "dynamic_brake_lost"',
            "dynamic_brake_lost",
        ),
        ('source = "a"\nprobability = 0.1\nloses = 1.0\nplaces = [5]', "numbers from 1 to 4"),
        ('source = "a"\nprobability = 1.0\nloses = 1.0\nmost = 1', "no train runs"),
        ('source = "a"\nprobability = 0.1\nset = { "brake.pads" = 1.0 }', "pads"),
        ('source = "a"\nprobability = 0.1\nloss = 1.0', "unknown key 'loss'"),
    ],
)
def test_a_component_that_cannot_fail_so_is_refused_with_the_remedy(plan_of, text, message):
    with pytest.raises(ConfigError, match=r"\[failures\] x: ") as error:
        load(plan_of(f"[failures.x]\n{text}\n"))
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("text", "design", "message"),
    [
        (DEAD_DISC.format(probability=0.1), "sobol", 'set design = "stratified"'),
        ("[failures]\nx = 1\n", "stratified", "must be a table, such as"),
        (PADS.replace("pad_friction", "spring_pressure_Pa"), "random", "allowed for the factors"),
        (PADS.replace('per = "disc"\n', ""), "random", "is for inputs of single units"),
        (PADS + "correlation_between_cars = 0.8\n", "random", "is above correlation_in_car"),
        (PADS + '[vary]\n"vehicle.axles" = { low = 2, high = 4 }\n', "random", "one vehicle"),
        (PADS, "saltelli", "independent inputs"),
    ],
)
def test_a_plan_with_wrong_components_is_refused_with_the_remedy(plan_of, text, design, message):
    with pytest.raises(ConfigError) as error:
        load(plan_of(text, design=design, runs=3000))
    assert message in str(error.value)


def test_the_units_of_a_train_are_counted_from_its_leading_end():
    tram = train.Train(axles=6, discs=2, cars=3)
    assert tram.units("disc")[11] == (11,)
    assert tram.units("axle")[1] == (2, 3)
    assert tram.units("bogie")[2] == (8, 9, 10, 11)
    assert tram.units("car") == tram.units("bogie")
    assert tram.units("train") == (tuple(range(12)),)
    assert tram.axles_of((8, 9, 10, 11)) == [5, 6]


def test_a_folder_continues_only_with_the_same_failures(plan_of, tmp_path):
    campaign.claim(load(plan_of(DEAD_DISC.format(probability=1e-3))), tmp_path / "out")
    campaign.claim(load(plan_of(DEAD_DISC.format(probability=1e-3))), tmp_path / "out")
    with pytest.raises(ConfigError, match="another plan"):
        campaign.claim(load(plan_of(DEAD_DISC.format(probability=2e-3))), tmp_path / "out")
