"""The adhesion of a line by place, from a CSV file of a user."""

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import scenario
from rollerrig.rig import adhesion_profile
from rollerrig.rig.contact import adhesion

LINE = "position_m,adhesion\n0,0.15\n150,0.05\n350,0.15\n"
STOP = 'adhesion = "low"\n[[friction]]\nprofile = "line.csv"\n'


@pytest.fixture
def line(tmp_path):
    """Return a function that loads a stop on a line with this content."""

    def load(content, more=""):
        (tmp_path / "line.csv").write_text(content)
        (tmp_path / "stop.toml").write_text(STOP + more)
        return scenario.load(str(tmp_path / "stop.toml"))

    return load


def initial(plan, mu_cd):
    """Return the adhesion that a wheel gets where tests state it."""
    section = plan["adhesion"]
    load_N = 0.5 * plan.params.vehicle.static_load_N
    law = plan.params.law._replace(mu_cd=mu_cd)
    at = (section["initial_at_sliding_m_s"], section["initial_at_speed_m_s"])
    rail = scenario.load("velim_a1", settings=("rig=plain_track",)).params.patch
    return adhesion.wheel_adhesion(*at, load_N, rail, law)[0]


def test_a_wheel_gets_the_adhesion_of_the_profile_at_its_places(line):
    plan = line(LINE)
    friction = plan.params.friction
    np.testing.assert_array_equal(friction.start, [0.0, 150.0, 350.0])
    assert friction.by_place.all()
    got = [initial(plan, mu_cd) for mu_cd in friction.mu_cd]
    assert got == pytest.approx([0.15, 0.05, 0.15], rel=1e-6)
    assert (friction.axles == 0b1111).all()


def test_a_profile_can_begin_elsewhere_and_act_on_some_axles(line):
    friction = line(LINE, "from_m = 100.0\naxles = [1, 2]\n").params.friction
    np.testing.assert_array_equal(friction.start, [100.0, 250.0, 450.0])
    assert (friction.axles == 0b0011).all()


def test_the_resolved_scenario_needs_the_file_no_more(line, tmp_path):
    plan = line(LINE)
    resolved = tmp_path / "elsewhere" / "scenario.toml"
    resolved.parent.mkdir()
    resolved.write_text(scenario.dump(plan))
    again = scenario.load(str(resolved)).params.friction
    for ours, theirs in zip(plan.params.friction, again, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_equal_rows_are_one_change_and_comments_are_skipped(line):
    rows = "# measured\n0,0.1\n1,0.1\n2;0.1\n\n3,0.2\n"
    np.testing.assert_array_equal(line(rows).params.friction.start, [0.0, 3.0])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0,15\n", r"line 1: adhesion = 15; allowed is 0.005 to 0.6 \(a share, not %\)"),
        ("5,0.1\n3,0.1\n", "line 2: position 3 m after 5 m; positions must rise"),
        ("a,b\n", "line 1: 'a, b'; allowed are two columns position_m,adhesion"),
        ("0,0.1,3\n", "line 1: .*allowed are two columns"),
        ("0,nan\n", "line 1: .*finite numbers"),
        ("# empty\n", "no rows; allowed are two columns"),
        ("0,0.59\n", r"position 0 m: initial_adhesion = 0.59: no mu_cd gives it"),
        (
            "".join(f"{i},{0.1 + 0.01 * (i % 2)}\n" for i in range(1200)),
            f"changes 1200 times; allowed are {adhesion_profile.MOST_CHANGES} changes",
        ),
    ],
)
def test_a_wrong_file_is_refused_with_its_line_and_what_is_allowed(line, content, message):
    with pytest.raises(ConfigError, match=message):
        line(content)


@pytest.mark.parametrize("more", ["mu_cd = 0.1\n", "from_s = 1.0\n", "axles = [9]\n"])
def test_other_keys_beside_a_profile_are_checked(line, more):
    with pytest.raises(ConfigError, match="friction"):
        line(LINE, more)


def test_a_profile_that_is_missing_or_no_path_is_refused(tmp_path):
    for value, message in (('"no.csv"', "no.csv"), ("3", "allowed is the path of a CSV file")):
        (tmp_path / "stop.toml").write_text(f"[[friction]]\nprofile = {value}\n")
        with pytest.raises(ConfigError, match=message):
            scenario.load(str(tmp_path / "stop.toml"))
