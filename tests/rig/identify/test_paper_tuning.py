"""`tune` and `validate` recover the known recovery of generated stops.

The generator shares no code with them.
"""

import numpy as np
import pytest
from generator import braking_stops

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.reports import tuning as report
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.patch import patch_for
from rollerrig.rig.identify.data import dataset, parameters
from rollerrig.rig.identify.data.preparation import prepare
from rollerrig.rig.identify.decide import fitting
from rollerrig.rig.identify.paper import tuning, validation
from rollerrig.rig.identify.replay import free_run

TRUE_TAU_M_J = 1.9e-4
RADIUS_M = 0.445
INERTIA_KGM2 = 160.0  # of a wheelset
STEP_S = 0.01


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


def test_the_level_of_the_contaminant_is_fitted_for_each_run(data, tuned):
    assert list(tuned.mu_cd) == [run.name for run in data.group("tune")]
    for mu_cd in tuned.mu_cd.values():
        assert 0.02 < mu_cd.low < mu_cd.value < mu_cd.high < 0.08


def test_recovery_explains_most_of_what_the_classic_model_leaves(tuned):
    assert tuned.rmse < 0.5 * tuned.rmse_classic
    assert tuned.tau_paper_m_J == pytest.approx(TRUE_TAU_M_J, rel=0.08)


def test_measured_transitions_follow_the_exponential(tuned):
    energy_J_m = tuned.samples.energy_J_m
    is_low = energy_J_m < np.median(energy_J_m)
    for half in (is_low, ~is_low):
        expected = -np.expm1(-tuned.tau_m_J.value * energy_J_m[half])
        assert np.median(tuned.transition[half] - expected) == pytest.approx(0.0, abs=0.02)


def test_the_same_seed_gives_the_same_interval(data, tuned):
    assert tuning.tune(data, 0).tau_m_J == tuned.tau_m_J


def test_on_runs_never_fitted_the_new_model_beats_the_classic(verdicts):
    new = report.mean_errors(verdicts, "new")
    classic = report.mean_errors(verdicts, "classic")
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

    # the first run: mean and standard deviation of the measured sliding
    measured_m_s = verdicts[0].sliding_m_s["measured"][:, 0]
    mean_of_b1 = float(rows[3][1])
    deviation_of_b1 = float(rows[6][1])
    assert mean_of_b1 == pytest.approx(measured_m_s.mean(), abs=0.006)
    assert deviation_of_b1 == pytest.approx(measured_m_s.std(), abs=0.006)


def test_reports_hold_the_results_without_files_from_outside(data, tuned, verdicts):
    tau = tuned.tau_m_J
    pages = [report.tune_page(data, tuned), report.validate_page(data, tau, verdicts)]
    for page in pages:
        assert f"{tau.value * 1e4:.4g}" in page
        assert "<svg" in page
        assert "<script" not in page
        assert 'src="http' not in page
    written = report.tune_json(data, tuned)
    assert written["tau_m_J"]["ci95"] == [tau.low, tau.high]


def test_a_wheel_that_is_not_braked_rolls_on_at_the_speed_of_the_vehicle():
    n = 200
    window = 100  # samples
    mass_kg = 1000.0
    deceleration_m_s2 = 0.5
    mu_cd = 0.06
    patch = patch_for(
        wheel_radius_m=RADIUS_M,
        roller_radius_m=np.inf,
        lateral_radius_m=0.3,
        young_Pa=2.1e11,
        shear_Pa=8e10,
        poisson=0.3,
    )
    law = adhesion.Law(
        mu_cd=mu_cd,
        mu_cr=0.28,
        A_d=0.4,
        A_r=0.4,
        gamma_d_s_m=0.2,
        gamma_r_s_m=0.6,
        k_ad=0.3,
        k_sd=0.1,
        k_ar=1.0,
        k_sr=0.4,
        tau_m_J=TRUE_TAU_M_J,
    )
    row = np.zeros(parameters.PARAMETERS)
    row[parameters.RADIUS] = RADIUS_M
    row[parameters.INERTIA] = INERTIA_KGM2
    row[parameters.EPS1] = patch.eps1
    row[parameters.LAW] = law

    speed_m_s = 30.0 - deceleration_m_s2 * STEP_S * np.arange(n)
    unchanged = np.ones((n, 1))
    motion = free_run.run(
        free_run.Stop(
            surface_m_s=speed_m_s[:, np.newaxis],
            load_N=1.05e5 * unchanged,
            torque_Nm=np.zeros((n, 1)),
            degraded=unchanged,
            recovered=unchanged,
            sliding_m_s=np.zeros((n, 1)),
            parameters=row[np.newaxis],
            mass_kg=mass_kg,
            extra_N=np.zeros(n),
            resistance=(0.0, 0.0, 0.0),
            field=np.zeros((2, 1)),
            axle_position_m=np.zeros(1),
            step_s=STEP_S,
            on_rollers=True,
            feedback_Ns=0.0,
            window=window,
        )
    )
    assert np.max(np.abs(speed_m_s - RADIUS_M * motion.wheel_rad_s[:, 0])) < 0.02
    # the contact slows down the inertia of the wheelset: J a / r^2; the vehicle feels it
    expected_N = -INERTIA_KGM2 * deceleration_m_s2 / RADIUS_M**2
    rate_m_s2 = np.gradient(motion.speed_m_s, STEP_S)
    assert np.mean(-mass_kg * rate_m_s2[50:]) == pytest.approx(expected_N, rel=0.02)


def test_runs_without_enough_sliding_are_refused(data):
    rolling = []
    for run in data.runs:
        wheel_rad_s = np.repeat(run.speed_m_s[:, None] / RADIUS_M, 4, axis=1)
        rolling.append(run._replace(wheel_speed_rad_s=wheel_rad_s))
    with pytest.raises(ConfigError, match="wheels slide by more than"):
        tuning.tune(data._replace(runs=rolling))


def test_a_fit_that_cannot_be_solved_names_the_remedy():
    with pytest.raises(ConfigError, match="end at a higher speed"):
        fitting.solve(np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros(2))


def test_a_dataset_without_runs_to_judge_is_refused(data):
    with pytest.raises(ConfigError, match="validate"):
        validation.validate(data._replace(runs=data.group("tune")), TRUE_TAU_M_J)


def test_samples_are_those_in_which_wheels_slide(data):
    design = prepare(data, data.group("tune"))
    law = adhesion.Law(*design.base[parameters.LAW])
    paper = law._replace(cleaning_creepage=np.inf)
    unbounded = tuning.collect(design, paper)
    bounded = tuning.collect(design, paper._replace(cleaning_creepage=0.1))
    assert bounded.sliding_m_s.min() > tuning.LEAST_SLIDING_M_S
    assert bounded.speed_m_s.min() > tuning.LEAST_SPEED_M_S

    # the paper's creepage is sliding over speed; with a bound it is smaller beyond the bound
    np.testing.assert_array_equal(unbounded.creepage, bounded.sliding_m_s / bounded.speed_m_s)
    is_beyond = unbounded.creepage > 0.1
    assert is_beyond.any()
    np.testing.assert_array_equal(bounded.creepage[~is_beyond], unbounded.creepage[~is_beyond])
    assert (bounded.creepage[is_beyond] < unbounded.creepage[is_beyond]).all()
