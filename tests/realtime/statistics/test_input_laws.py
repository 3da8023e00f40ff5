"""Inputs of a plan have laws with sources; correlations keep each law as it is."""

import numpy as np
import pytest
from scipy import stats

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign import campaign

SCENARIO = """
title = "A short stop"
initial_speed_m_s = 3.0
[[demand]]
pressure_Pa = 3.8e5
"""
HEAD = """
scenario = "{scenario}"
design = "{design}"
runs = {runs}
seed = 3
"""
TWO = """
[inputs."adhesion.mu_cd"]
distribution = "lognorm"
s = 0.3
scale = 0.06
low = 0.01
high = 0.3
source = "assumption"
[inputs.initial_speed_m_s]
distribution = "norm"
loc = 4.0
scale = 0.2
source = "assumption"
"""
CORRELATED = """
[[correlation]]
inputs = ["adhesion.mu_cd", "initial_speed_m_s"]
rank_correlation = {value}
source = "assumption"
"""


@pytest.fixture
def load(tmp_path):
    (tmp_path / "short.toml").write_text(SCENARIO)

    def load(text, design="random", runs=2000):
        head = HEAD.format(scenario=tmp_path / "short.toml", design=design, runs=runs)
        (tmp_path / "plan.toml").write_text(head + text)
        return campaign.load(str(tmp_path / "plan.toml"))

    return load


def test_drawn_values_follow_the_laws_of_the_plan_and_its_limits(load):
    plan = load(TWO)
    mu_cd, speed_m_s = np.array(plan.points).T
    assert plan.axes == ("adhesion.mu_cd", "initial_speed_m_s")
    assert stats.kstest(speed_m_s, "norm", args=(4.0, 0.2)).pvalue > 0.01
    assert stats.kstest(np.log(mu_cd / 0.06), "norm", args=(0.0, 0.3)).pvalue > 0.01
    assert mu_cd.min() >= 0.01
    assert mu_cd.max() <= 0.3
    assert plan.sources[0] == (
        "adhesion.mu_cd",
        "lognorm, s = 0.3, scale = 0.06, low = 0.01, high = 0.3",
        "assumption",
    )


@pytest.mark.parametrize("value", [-0.8, 0.5])
def test_a_correlation_is_reached_and_the_laws_stay_as_they_are(load, value):
    plan = load(TWO + CORRELATED.format(value=value), runs=4000)
    mu_cd, speed_m_s = np.array(plan.points).T
    assert stats.spearmanr(mu_cd, speed_m_s).statistic == pytest.approx(value, abs=0.04)
    assert stats.kstest(speed_m_s, "norm", args=(4.0, 0.2)).pvalue > 0.01
    assert stats.kstest(np.log(mu_cd / 0.06), "norm", args=(0.0, 0.3)).pvalue > 0.01


def test_ranges_and_laws_go_together_in_one_plan(load):
    plan = load(
        '[vary]\n"adhesion.mu_cd" = { low = 0.03, high = 0.1 }\n'
        + TWO.split("\n\n")[0][TWO.index("[inputs.initial") :]
    )
    assert plan.axes == ("adhesion.mu_cd", "initial_speed_m_s")
    assert "no source" in plan.sources[0][2]


def one(**changed):
    """Return the text of a plan with one input, some of whose keys are changed or left out."""
    keys = {"distribution": '"norm"', "loc": 4.0, "scale": 0.2, "source": '"test"'} | changed
    lines = [f"{key} = {value}" for key, value in keys.items() if value is not None]
    return "\n".join(["[inputs.initial_speed_m_s]", *lines]) + "\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (one(source=None), "source is missing"),
        (one(source='" "'), "source is missing"),
        (one(distribution=None), "distribution is missing"),
        (one(distribution='"normal"'), "did you mean"),
        (one(distribution='"poisson"'), "no continuous distribution"),
        (one(distribution='"gamma"'), "a is missing"),
        (one(sigma=1.0), "unknown key 'sigma'"),
        (one(scale=-1.0), "must be above 0"),
        (one(loc='"4"'), "must be a number"),
        (one(low=5.0, high=4.5), "low must be less than high"),
        (one(low=900.0), "must have values between"),
        (one(distribution='"beta"', a=-1.0, b=2.0), "not allowed for the distribution beta"),
        # the scenario allows no negative speed
        (one(scale=80.0), "limit it with low and high"),
        (one() + CORRELATED.format(value=0.5), "no input with a distribution"),
        (TWO + CORRELATED.format(value=1.5), "out of range"),
        (TWO + CORRELATED.format(value=0.5).replace('source = "assumption"', ""), "source is"),
        (TWO + 2 * CORRELATED.format(value=0.5), "occurs twice"),
        (TWO + CORRELATED.format(value=0.5).replace("adhesion.mu_cd", "initial_speed_m_s"), "two"),
        ("[vary]\ninitial_speed_m_s = { low = 1.0, high = 2.0 }\n" + one(), "keep one"),
        ("[inputs]\n", "are empty"),
    ],
)
def test_a_wrong_input_is_refused_with_its_place_and_the_remedy(load, text, message):
    with pytest.raises(ConfigError, match=message) as raised:
        load(text)
    assert "plan.toml" in str(raised.value)


def test_correlations_that_exclude_one_another_are_refused(load):
    third = '[inputs.mass_kg]\ndistribution = "norm"\nloc = 4.8e4\nscale = 100.0\nsource = "x"\n'
    pairs = ""
    names = ["adhesion.mu_cd", "initial_speed_m_s", "mass_kg"]
    for first, second, value in ((0, 1, 0.9), (1, 2, 0.9), (0, 2, -0.9)):
        pairs += (
            f'[[correlation]]\ninputs = ["{names[first]}", "{names[second]}"]\n'
            f'rank_correlation = {value}\nsource = "x"\n'
        )
    with pytest.raises(ConfigError, match="no law has all these correlations"):
        load(TWO + third + pairs)


@pytest.mark.parametrize(
    ("design", "runs", "message"),
    [
        ("matrix", 2000, "draw from laws"),
        ("saltelli", 1000, "set runs = 1024"),
        ("saltelli", 2000, "no \\[\\[correlation\\]\\]"),
    ],
)
def test_a_design_that_does_not_fit_the_inputs_is_refused(load, design, runs, message):
    text = TWO + CORRELATED.format(value=0.5) if "correlation" in message else TWO
    with pytest.raises(ConfigError, match=message):
        load(text, design, runs)


def test_a_saltelli_design_has_whole_blocks(load):
    plan = load(TWO, "saltelli", 1027)
    assert len(plan.points) == 1024
