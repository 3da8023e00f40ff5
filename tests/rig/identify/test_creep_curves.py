"""Measured creep curves, and curves with known truth, get the right answer and no false report."""

import functools
import json
from pathlib import Path

import creep_generators as generators
import creep_rates
import numpy as np
import pytest
from tiers import first_of

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.reports.creep_curve import explained
from rollerrig.rig.contact.patch import patch_for
from rollerrig.rig.identify.creep_curves import conditions, judgement, shape
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.runs import LARGEST_ADHESION, Curve
from rollerrig.rig.identify.paper import polach_fit

MEASURED = Path(__file__).parents[2] / "data" / "measured"
SEED = 5


@functools.cache
def judged(name):
    """Return the dataset of a measured case, and its judgement."""
    data = dataset.load(MEASURED / name)
    return data, judgement.judge(data)


def effect(answer, name):
    """Return the effect of a condition."""
    return next(e for e in answer.shown.factors.effects if e.name == name)


def text(data, answer):
    """Return the sentences of the report."""
    return " ".join(explained.story(data, answer))


def with_points(points):
    """Return a dataset of a locomotive with these points as its curve."""
    return dataset.load("eurosprinter_127001")._replace(curve=Curve(*points))


def write(folder, **columns):
    """Write a creep-curve dataset with these columns; return its folder."""
    np.savetxt(
        folder / "curve.csv",
        np.column_stack(list(columns.values())),
        delimiter=",",
        header=",".join(columns),
        comments="",
    )
    (folder / "dataset.toml").write_text('kind = "creep_curve"\nfile = "curve.csv"\n')
    return folder


# --- the measured cases ---


def test_friction_that_falls_with_load_is_not_reported_to_fall_with_creepage():
    data, answer = judged("creep_load")
    assert not answer.shown.falls
    load = effect(answer, conditions.LOAD)
    assert load.is_reported
    # 0.872 at 400 N and 0.582 at 2700 N, at a creepage of 14 %
    assert load.size == pytest.approx(0.582 / 0.872 - 1.0, abs=0.01)
    assert [found.name for found in answer.shown.reported] == [conditions.LOAD]
    assert "Friction falls with load: by 32.9 %" in text(data, answer)


def test_adhesion_that_rises_to_a_limit_does_not_fall():
    data, answer = judged("creep_saturates")
    assert answer.verdict == "consistent"
    assert not answer.shown.falls
    assert "it rises to a limit" in text(data, answer)
    assert "would have been shown" in text(data, answer)


def test_rounded_creepages_with_many_points_each_get_a_result(tmp_path, capsys, monkeypatch):
    # the fit is what matters here, not its intervals
    monkeypatch.setattr(polach_fit, "REPLICATES", 10)
    folder = str(MEASURED / "creep_rounded_crash")
    assert cli.main(["explain", folder, "--out", str(tmp_path / "explain")]) == 0
    assert cli.main(["tune", folder, "--out", str(tmp_path / "tune")]) == 0
    assert "does not fall" in " ".join(capsys.readouterr().out.split())
    result = json.loads((tmp_path / "explain" / "report.json").read_text())
    assert result["verdict"] == "consistent"
    assert result["law"]["parameters"]["k_s"]["bound"] == "high"
    assert result["law"]["parameters"]["k_s"]["ci95"] is None


@pytest.mark.parametrize(
    "name", first_of(["creep_sand", "terramech_grouser_mit", "terramech_smooth_mit"])
)
def test_on_sand_adhesion_rises_throughout_and_the_law_does_not_fit(name):
    data, answer = judged(name)
    assert not answer.shown.falls
    assert answer.shown.reported == []
    assert answer.law_fails
    assert answer.verdict == "unexplained"
    assert answer.law.rms > 3.0 * answer.shown.smooth.scatter
    words = text(data, answer)
    assert "does not fit" in words
    assert "still rises there" in words
    assert "scatter by" in words


def test_two_series_that_differ_by_a_quarter_are_reported_with_their_difference():
    data, answer = judged("creep_series")
    assert not answer.shown.falls
    series = effect(answer, conditions.SERIES)
    assert series.is_reported
    assert series.low <= -0.25 <= series.high
    assert "series 2 has 25" in text(data, answer)


def test_adhesion_above_one_is_read_and_the_message_names_the_limit_that_is_checked(tmp_path):
    data, answer = judged("creep_above_one")
    assert answer.verdict == "consistent"
    assert data.curve.adhesion.max() > 1.8

    creepage = np.linspace(0.01, 0.5, 20)
    folder = write(tmp_path, creepage=creepage, adhesion=100.0 * creepage)
    with pytest.raises(ConfigError, match=f"at most {LARGEST_ADHESION:g} is allowed"):
        dataset.load(folder)


def test_the_measured_fall_of_a_locomotive_is_reported_with_its_interval():
    data = dataset.load("eurosprinter_127001")
    answer = judgement.judge(data)
    assert answer.verdict == "explained"
    assert answer.shown.falls
    # means of the points: 0.304 at 2 to 4 % creepage, 0.220 at 15 to 21 %
    assert answer.shown.fall.low < 1.0 - 0.220 / 0.304 < answer.shown.fall.high
    assert answer.law.has_fall
    assert answer.law.fits


# --- what every answer holds ---


def test_every_check_reports_whether_it_could_judge_why_not_and_the_smallest_size():
    data, answer = judged("creep_sand")
    result = explained.explain_json(data, answer)
    names = [check["name"] for check in result["checks"]]
    assert names[0] == "falling_friction"
    assert names[-1] == "law"
    for check in result["checks"]:
        if check["judged"]:
            assert check["smallest"]["value"] > 0.0
            assert check["reason"] is None
        else:
            assert check["reason"]
            assert check["smallest"] is None
            assert check["reason"] in check["text"]


def test_the_drawn_law_is_the_one_that_was_judged():
    _, answer = judged("creep_load")
    prepared = answer.shown.prepared
    for number in np.unique(prepared.group):
        here = np.flatnonzero(prepared.group == number)
        assert np.ptp(answer.law_columns[here], axis=0).max() == 0.0
        points = prepared.curve.chosen(here)
        again = explained.laws.modelled(
            answer.law.x,
            answer.law.beta,
            answer.law_columns[here],
            points,
            explained.patch_of(dataset.load(MEASURED / "creep_load")),
        )
        np.testing.assert_allclose(again, answer.law.modelled[here])


def test_the_page_and_the_recording_are_written(tmp_path, capsys):
    folder = str(MEASURED / "creep_series")
    assert cli.main(["explain", folder, "--out", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text()
    assert "<svg" in page
    assert "series 2" in page
    assert (tmp_path / "report.rrd").stat().st_size > 0
    assert "The series differ" in capsys.readouterr().out


def test_conditions_that_change_together_are_reported_as_not_distinguished():
    points = generators.curve(generators.LOAD, SEED)
    loads = np.unique(points.wheel_load_N)
    together = points._replace(series=np.searchsorted(loads, points.wheel_load_N) + 1.0)
    answer = judgement.judge(with_points(together))
    series = effect(answer, conditions.SERIES)
    load = effect(answer, conditions.LOAD)
    assert series.is_reported
    assert series.together_with == [conditions.LOAD]
    assert not load.judged
    assert "together with series" in load.why_not


@pytest.mark.parametrize("points", first_of([30, 200]))
def test_a_load_that_grows_with_creepage_is_not_judged_and_makes_no_fall(points):
    rng = np.random.default_rng(SEED)
    creepage = rng.uniform(0.001, 0.4, points)
    adhesion = 0.3 * np.tanh(20.0 * creepage) + 0.01 * rng.standard_normal(points)
    load = 1e4 + 1e5 * creepage
    curve = generators.Points(creepage, adhesion, np.full(points, 10.0), load, np.zeros(points))
    answer = judgement.judge(with_points(curve))
    assert not answer.shown.falls
    assert answer.shown.reported == []
    assert "together with creepage" in effect(answer, conditions.LOAD).why_not


@pytest.mark.parametrize("seed", first_of(range(5)))
def test_a_speed_that_sliding_lowers_is_not_judged_as_a_dependence_of_friction(seed):
    """A robot turns its wheels at nearly one speed: the faster they slide, the slower it drives."""
    rng = np.random.default_rng(seed)
    surface = rng.integers(0, 4, 400)
    creepage = np.array((0.1, 0.2, 0.35, 0.6))[surface] * rng.uniform(0.7, 1.3, 400)
    friction = np.array((0.2, 0.4, 0.8, 0.7))[surface]
    adhesion = friction * np.tanh(10.0 * creepage) + 0.01 * rng.standard_normal(400)
    speed_m_s = 0.08 * rng.uniform(0.85, 1.15, 400) * (1.0 - creepage)
    curve = generators.Points(creepage, adhesion, speed_m_s, np.full(400, 30.0), surface + 1.0)
    answer = judgement.without_law(with_points(curve))
    speed = next(e for e in answer.factors.effects if e.name == conditions.SPEED)
    assert "together with creepage" in speed.why_not
    assert [e.name for e in answer.reported] == [conditions.SERIES]


@pytest.mark.parametrize("seed", first_of(range(5)))
def test_a_series_of_one_point_is_not_reported_to_differ(seed):
    rng = np.random.default_rng(seed)
    creepage = rng.uniform(0.001, 0.4, 200)
    adhesion = 0.3 * np.tanh(20.0 * creepage) + 0.01 * rng.standard_normal(200)
    series = np.zeros(200)
    series[-1] = 1.0
    curve = generators.Points(creepage, adhesion, np.full(200, 10.0), np.full(200, 5e4), series)
    assert judgement.without_law(with_points(curve)).reported == []


def test_three_creepages_are_too_few_to_judge_a_fall():
    rng = np.random.default_rng(SEED)
    creepage = np.repeat((0.01, 0.05, 0.2), 6)
    adhesion = np.repeat((0.1, 0.3, 0.2), 6) + 0.005 * rng.standard_normal(18)
    points = generators.Points(
        creepage, adhesion, np.full(18, 10.0), np.full(18, 50e3), np.zeros(18)
    )
    data = with_points(points)
    answer = judgement.judge(data)
    assert not answer.shown.falls
    assert "3 different creepages; at least 4" in answer.shown.fall_why_not
    assert "could not be judged: there are 3 different creepages" in text(data, answer)


def test_adhesion_that_falls_from_the_first_point_on_has_its_maximum_at_or_below_it():
    rng = np.random.default_rng(SEED)
    creepage = np.linspace(0.03, 0.4, 60)
    adhesion = 0.35 - 0.3 * creepage + 0.004 * rng.standard_normal(60)
    points = generators.Points(
        creepage, adhesion, np.full(60, 10.0), np.full(60, 50e3), np.zeros(60)
    )
    data = with_points(points)
    answer = judgement.judge(data)
    assert answer.shown.falls
    assert "at or below the smallest creepages" in text(data, answer)


@pytest.mark.parametrize("scatter", first_of([0.0, 1e-9]))
def test_computed_curves_without_scatter_get_a_result_and_no_false_report(scatter):
    creepage = np.geomspace(1e-3, 0.3, 80)
    adhesion = 0.4 * np.tanh(40.0 * creepage)
    adhesion = adhesion + scatter * np.random.default_rng(SEED).standard_normal(80)
    points = generators.Points(
        creepage, adhesion, np.full(80, 10.0), np.full(80, 50e3), np.zeros(80)
    )
    answer = judgement.judge(with_points(points))
    assert not answer.shown.falls
    assert answer.shown.reported == []


def test_equal_creepages_in_all_points_get_a_result():
    rng = np.random.default_rng(SEED)
    points = generators.Points(
        np.full(20, 0.1),
        0.3 + 0.01 * rng.standard_normal(20),
        np.full(20, 10.0),
        np.full(20, 50e3),
        np.zeros(20),
    )
    answer = judgement.judge(with_points(points))
    assert not answer.shown.falls
    assert answer.shown.fall_why_not


def test_measured_in_traction_the_curve_is_the_same():
    points = generators.curve(generators.FALLING, SEED)
    braking = judgement.without_law(with_points(points))
    mirrored = points._replace(creepage=-points.creepage, adhesion=-points.adhesion)
    traction = judgement.without_law(with_points(mirrored))
    assert traction.fall == braking.fall


# --- files ---


@pytest.mark.parametrize(
    ("column", "low", "high", "unit"),
    [
        ("temperature_degC", 10.0, 50.0, "K"),
        ("pressure_bar", 1.8, 3.2, "Pa"),
        pytest.param("temperature_K", 283.0, 323.0, "K", marks=pytest.mark.nightly),
        pytest.param("pressure_kPa", 180.0, 320.0, "Pa", marks=pytest.mark.nightly),
    ],
)
def test_temperature_and_pressure_are_judged_in_any_of_their_units(
    column, low, high, unit, tmp_path
):
    rng = np.random.default_rng(SEED)
    creepage = rng.uniform(0.005, 0.3, 120)
    value = rng.choice((low, high), 120)
    level = np.where(value == high, 0.8, 1.0)
    adhesion = 0.4 * level * np.tanh(25.0 * creepage) + 0.005 * rng.standard_normal(120)
    folder = write(tmp_path, creepage=creepage, adhesion=adhesion, **{column: value})
    data = dataset.load(folder)
    answer = judgement.judge(data)
    name = column.partition("_")[0]
    found = effect(answer, name)
    assert found.is_reported
    assert found.low <= -0.2 <= found.high
    assert f"Friction falls with {name}" in text(data, answer)
    assert f"{unit}" in text(data, answer)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("wheel_load_N", 0.0, "wheel_load_N.*above 0"),
        ("speed_m_s", -1.0, "speed_m_s.*at least 0"),
        ("temperature_K", -5.0, "temperature_degC"),
        ("adhesion", -0.3, "opposite signs"),
    ],
)
def test_impossible_values_are_refused_with_column_and_remedy(column, value, message, tmp_path):
    columns = {
        "creepage": np.linspace(0.01, 0.3, 20),
        "adhesion": np.full(20, 0.3),
        "speed_m_s": np.full(20, 10.0),
        "wheel_load_N": np.full(20, 5e4),
    }
    columns[column] = np.full(20, value)
    with pytest.raises(ConfigError, match=message):
        dataset.load(write(tmp_path, **columns))


# --- how often it is right ---


# the command `creep_rates.py` measures the rates on more curves
@pytest.mark.parametrize("curves", [1, pytest.param(5, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("truth", creep_rates.ALL, ids=lambda truth: truth.name)
def test_curves_with_known_truth_are_answered_without_a_false_report(truth, curves):
    found = creep_rates.answers(truth, range(1000, 1000 + curves))
    assert found.false_reports == []
    assert found.missed == []


@pytest.mark.parametrize("curves", [1, pytest.param(4, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("truth", creep_rates.FORMS, ids=lambda truth: truth.name)
def test_curves_in_any_measured_form_are_answered_without_a_false_report(truth, curves):
    found = creep_rates.answers_on_forms(truth, range(1000, 1000 + curves))
    assert found.false_reports == []


def test_braking_and_traction_with_other_ranges_make_no_fall_and_their_difference_is_reported():
    rng = np.random.default_rng(SEED)
    creepage = np.concatenate([rng.uniform(0.005, 0.3, 100), -rng.uniform(0.005, 0.15, 100)])
    level = np.where(creepage < 0.0, 1.0, 0.8)
    adhesion = np.sign(creepage) * 0.5 * level * np.tanh(30.0 * np.abs(creepage))
    adhesion += 0.01 * rng.standard_normal(200)
    curve = generators.Points(
        creepage, adhesion, np.full(200, 10.0), np.full(200, 5e4), np.zeros(200)
    )
    data = with_points(curve)
    answer = judgement.judge(data)
    assert not answer.shown.falls
    direction = effect(answer, conditions.DIRECTION)
    assert direction.is_reported
    assert direction.low <= 0.25 <= direction.high
    assert "Braking and traction differ: traction has 2" in text(data, answer)


@pytest.mark.parametrize("seed", [3, 22])
def test_few_creepages_that_each_have_one_direction_are_not_judged_for_a_fall(seed):
    truth = next(t for t in creep_rates.FORMS if t.form == "few creepages, two directions")
    points, _ = generators.tyre_curve(truth, seed)
    answer = judgement.without_law(with_points(points))
    assert not answer.falls
    assert "measured at other creepages" in answer.fall_why_not


def polach_points(points, k_a, seed):
    """Return Polach's law on a contact of 6 mm by 6 mm, with friction that does not fall."""
    rng = np.random.default_rng(seed)
    patch = patch_for(0.63, np.inf, 0.63, 2.1e11, 8.0e10, 0.3)
    creepage = np.geomspace(5e-4, 0.2, points)
    curve = Curve(
        creepage, creepage, np.full(points, 10.0), np.full(points, 52.7e3), np.zeros(points)
    )
    adhesion = polach_fit.model(np.array([0.4, 1.0, 0.0, k_a, 0.4 * k_a]), curve, patch)
    return curve._replace(adhesion=adhesion + 0.006 * rng.standard_normal(points))


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_polachs_law_fits_its_points_on_a_stiffer_contact_and_the_first_screen_shows_the_patch(
    seed, tmp_path
):
    points = polach_points(30, 1.0, seed)
    folder = write(
        tmp_path,
        creepage=points.creepage,
        adhesion=points.adhesion,
        speed_m_s=points.speed_m_s,
        wheel_load_N=points.load_N,
    )
    data = dataset.load(folder)
    answer = judgement.judge(data)
    assert answer.verdict == "consistent"
    assert not answer.law_fails
    k_a = answer.law.parameters["k_a"]
    # the contact is 1.36 times as stiff as that of the dataset
    assert k_a.low < 1.36 < k_a.high
    words = text(data, answer)
    assert "times as stiff as the computed one fits" in words
    assert "half axes of 5.7 mm along and 4.4 mm across at 52.7 kN" in words


def test_points_whose_neighbours_share_large_errors_are_not_said_to_fit_or_not_to_fall():
    rng = np.random.default_rng(SEED)
    error = np.zeros(60)
    for i in range(1, 60):
        error[i] = 0.97 * error[i - 1] + 0.05 * rng.standard_normal()
    creepage = np.linspace(0.01, 0.3, 60)
    curve = generators.Points(
        creepage,
        0.5 * np.tanh(15.0 * creepage) + error,
        np.full(60, 10.0),
        np.full(60, 5e4),
        np.zeros(60),
    )
    answer = judgement.judge(with_points(curve))
    assert not answer.shown.falls
    assert "would not have shown a fall" in answer.shown.fall_why_not
    assert answer.law_fails or "would not have shown a misfit" in answer.law_why_not


@pytest.mark.parametrize("seed", first_of(range(5)))
def test_a_fall_by_a_third_in_fifteen_points_is_shown(seed):
    rng = np.random.default_rng(seed)
    creepage = np.linspace(0.005, 0.3, 15)
    adhesion = 0.4 * np.minimum(creepage / 0.06, 1.0) * (1.0 - np.clip(creepage - 0.06, 0.0, 1.0))
    adhesion = adhesion * (1.0 - 0.5 * np.clip(creepage - 0.06, 0.0, 1.0))
    curve = generators.Points(
        creepage,
        adhesion + 0.004 * rng.standard_normal(15),
        np.full(15, 10.0),
        np.full(15, 5e4),
        np.zeros(15),
    )
    answer = judgement.without_law(with_points(curve))
    assert answer.falls
    true_fall = 1.0 - adhesion[-1] / adhesion.max()
    assert answer.fall.low < true_fall < answer.fall.high


@pytest.mark.parametrize("seed", first_of(range(5)))
def test_a_sharp_bend_that_a_smooth_curve_overshoots_is_no_fall(seed):
    rng = np.random.default_rng(seed)
    creepage = np.sort(rng.uniform(0.001, 0.3, 200))
    adhesion = np.minimum(creepage / 0.02, 1.0) * 0.3 + 0.001 * rng.standard_normal(200)
    smooth = shape.fit(
        creepage, adhesion, np.zeros(200, dtype=int), np.empty((200, 0)), np.arange(200)
    )
    assert shape.fall(smooth, adhesion, seed=0).p_value > shape.FALL_ALPHA
