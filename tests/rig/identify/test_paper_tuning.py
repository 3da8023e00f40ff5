"""tune and validate backwards: stops with a known recovery from a generator that shares no code."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[3]))

from generator import braking_stops

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.reports import tuning as report
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.patch import patch_for
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.preparation import prepare
from rollerrig.rig.identify.decide import fitting
from rollerrig.rig.identify.paper import tuning, validation

TRUE_TAU_M_J = 1.9e-4


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return dataset.load(braking_stops.make(tmp_path_factory.mktemp("stops"), {}, 104))


@pytest.fixture(scope="module")
def tuned(data):
    return tuning.tune(data)


@pytest.fixture(scope="module")
def verdicts(data, tuned):
    return validation.validate(data, tuned.tau_m_J.value)


def test_the_interval_of_tau_holds_the_true_value_and_is_narrow(tuned):
    tau = tuned.tau_m_J
    assert tau.low < TRUE_TAU_M_J < tau.high
    assert 0.0 < tau.low < tau.value < tau.high
    assert (tau.high - tau.low) / tau.value < 0.12


def test_each_run_has_its_own_contaminant(data, tuned):
    assert list(tuned.mu_cd) == [run.name for run in data.group("tune")]
    for mu in tuned.mu_cd.values():
        assert 0.02 < mu.low < mu.value < mu.high < 0.08


def test_recovery_explains_most_of_what_the_classic_model_leaves(tuned):
    assert tuned.rmse < 0.5 * tuned.rmse_classic
    assert tuned.tau_paper_m_J == pytest.approx(TRUE_TAU_M_J, rel=0.08)


def test_measured_transitions_follow_the_exponential(tuned):
    W = tuned.samples.energy_J_m
    middle = np.median(W)
    for part in (middle > W, middle <= W):
        expected = -np.expm1(-tuned.tau_m_J.value * W[part])
        assert np.median(tuned.transition[part] - expected) == pytest.approx(0.0, abs=0.02)


def test_the_same_seed_gives_the_same_interval(data, tuned):
    assert tuning.tune(data, 0).tau_m_J == tuned.tau_m_J


def test_on_runs_never_fitted_the_new_model_beats_the_classic(verdicts):
    new, classic = (report.mean_errors(verdicts, name) for name in ("new", "classic"))
    for key in ("mean_m_s", "std_m_s", "E1_m_s", "adhesion_rmse"):
        assert new[key] < 0.6 * classic[key], key
    assert new["mean_1_m_s"] < 0.1


def test_table_6_has_the_papers_rows_for_each_run(verdicts):
    head, rows = report.table6(verdicts)
    assert head == ["", "b1", "b2", "b3"]
    assert [row[0] for row in rows][3:6] == [
        "mean sliding of wheelset 1, measured",
        "mean sliding of wheelset 1, with recovery",
        "mean sliding of wheelset 1, classic, no recovery",
    ]
    measured = verdicts[0].sliding_m_s["measured"][:, 0]
    assert float(rows[3][1]) == pytest.approx(measured.mean(), abs=0.006)
    assert float(rows[6][1]) == pytest.approx(measured.std(), abs=0.006)


def test_reports_hold_what_was_found_without_outside_parts(data, tuned, verdicts):
    tau = tuned.tau_m_J
    for page in (report.tune_page(data, tuned), report.validate_page(data, tau, verdicts)):
        assert f"{tau.value * 1e4:.4g}" in page
        assert "<svg" in page
        assert "<script" not in page
        assert 'src="http' not in page
    told = report.tune_json(data, tuned)
    assert told["tau_m_J"]["ci95"] == [tau.low, tau.high]


def test_a_wheel_that_is_not_braked_rolls_on_at_the_speed_of_the_vehicle():
    n = 200
    patch = patch_for(0.445, np.inf, 0.3, 2.1e11, 8e10, 0.3)
    law = adhesion.Law(0.06, 0.28, 0.4, 0.4, 0.2, 0.6, 0.3, 0.1, 1.0, 0.4, 1.9e-4)
    speed = 30.0 - 0.005 * np.arange(n)
    sliding, force = np.empty(n), np.empty(n)
    validation.free_run(
        speed / 0.445,
        speed,
        np.full(n, 1.05e5),
        np.zeros(n),
        0.06,
        0.01,
        100,
        0.445,
        160.0,
        patch,
        law,
        sliding,
        force,
    )
    assert np.max(np.abs(sliding)) < 0.02
    # the wheelset's inertia is slowed down by the contact: J a / r^2
    assert np.mean(force[50:]) == pytest.approx(-160.0 * 0.5 / 0.445**2, rel=0.02)


def test_runs_without_enough_sliding_are_refused(data):
    calm = data._replace(
        runs=[
            run._replace(wheel_speed_rad_s=np.repeat(run.speed_m_s[:, None] / 0.445, 4, axis=1))
            for run in data.runs
        ]
    )
    with pytest.raises(ConfigError, match="wheels slide by more than"):
        tuning.tune(calm)


def test_a_fit_that_cannot_be_solved_says_what_to_do():
    with pytest.raises(ConfigError, match="end at a higher speed"):
        fitting.solve(np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros(2))


def test_a_dataset_without_runs_to_judge_is_refused(data):
    with pytest.raises(ConfigError, match="validate"):
        validation.validate(data._replace(runs=data.group("tune")), TRUE_TAU_M_J)


def test_samples_are_those_in_which_wheels_slide(data):
    paper, s = (tuning.collect(prepare(data, data.group("tune")), bound) for bound in (np.inf, 0.1))
    assert s.sliding_m_s.min() > tuning.LEAST_SLIDING_M_S
    assert s.speed_m_s.min() > tuning.LEAST_SPEED_M_S
    np.testing.assert_array_equal(paper.creepage, s.sliding_m_s / s.speed_m_s)
    beyond = paper.creepage > 0.1
    np.testing.assert_array_equal(s.creepage[~beyond], paper.creepage[~beyond])
    assert beyond.any()
    assert (s.creepage[beyond] < paper.creepage[beyond]).all()
