"""A finding is reported if and only if its interval excludes nothing at the family-wise level.

The first half of the rule is tested on every report: of all shipped sets, and of the answers that
are kept of three generators. The second half is tested on the one place that decides.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from rollerrig.realtime import cli
from rollerrig.rig.identify.statistics import interval, resampling, robust_line, simulated_test
from rollerrig.rig.identify.statistics.interval import Estimate

ROOT = Path(__file__).parents[3]
MEASURED = ROOT / "tests" / "data" / "measured"
KEPT = ROOT / "tests" / "generator" / "kept"

# sizes that are 1 where there is nothing: ratios of units and of clocks
NOTHING = {"wrong_unit": 1.0, "clock_rate": 1.0}

MEASURED_SETS = sorted(file.parent.name for file in MEASURED.glob("*/dataset.toml"))
PACKAGED_SETS = ["eurosprinter_127001", "recorder_twin"]
BRAKING_SETS = ["open_none", "open_rail_cleaning", "velim_synthetic"]


def with_nothing_inside(report):
    """Return the findings of a report whose interval holds nothing."""
    found = []
    for cause in [*report["causes"], *report.get("episodes", [])]:
        size = next(iter(cause["parameters"].values()))
        if not interval.excludes(*size["ci95"], NOTHING.get(cause["name"], 0.0)):
            found.append((cause["name"], size))
        # of braking runs: the interval at the level of the decision
        decided = cause.get("evidence", {}).get("decided")
        if decided is not None and not interval.excludes(*decided["interval"]):
            found.append((cause["name"], decided))
    return found


def report_of(folder, out):
    cli.main(["explain", str(folder), "--out", str(out)])
    return json.loads((out / "report.json").read_text())


@pytest.mark.parametrize("name", MEASURED_SETS)
def test_no_finding_of_a_measured_set_has_nothing_in_its_interval(name, tmp_path, capsys):
    try:
        report = report_of(MEASURED / name, tmp_path / "out")
    except SystemExit:
        return  # refused: there is no finding
    assert with_nothing_inside(report) == []


@pytest.mark.parametrize("name", PACKAGED_SETS)
def test_no_finding_of_a_packaged_set_has_nothing_in_its_interval(name, tmp_path, capsys):
    report = report_of(name, tmp_path / "out")
    assert report["causes"]
    assert with_nothing_inside(report) == []


@pytest.mark.nightly
@pytest.mark.parametrize("name", BRAKING_SETS)
def test_no_cause_of_braking_runs_has_nothing_in_its_interval(name, tmp_path, capsys):
    report = report_of(name, tmp_path / "out")
    assert with_nothing_inside(report) == []
    for cause in report["causes"]:
        low, high = cause["evidence"]["decided"]["interval"]
        reported_low, reported_high = next(iter(cause["parameters"].values()))["ci95"]
        assert low < reported_low < reported_high < high


@pytest.mark.parametrize("generator", ["first", "second", "third"])
def test_no_cause_of_a_generated_set_has_nothing_in_its_interval(generator):
    answers = json.loads((KEPT / generator / "explain.json").read_text())
    causes = [cause for answer in answers.values() for cause in answer["causes"]]
    assert len(causes) > 200
    for answer in answers.values():
        assert with_nothing_inside(answer) == []


# --- the place that decides ---


def estimates_of_a_mean(effect, count, values, seed):
    """Return estimates of the mean of normal values about an effect."""
    rng = np.random.default_rng(seed)
    drawn = effect + rng.standard_normal((count, values))
    errors = drawn.std(axis=1, ddof=1) / np.sqrt(values)
    return [
        Estimate(float(mean), float(error), values - 1)
        for mean, error in zip(drawn.mean(axis=1), errors, strict=True)
    ]


def test_a_finding_is_what_the_family_wise_interval_excludes():
    for estimate in estimates_of_a_mean(effect=0.8, count=500, values=8, seed=1):
        low, high = estimate.interval(1.0 - 0.02 / 5)
        assert estimate.is_finding(0.02, 5) == interval.excludes(low, high)


def test_a_finding_has_nothing_in_no_interval_of_a_report():
    found = [e for e in estimates_of_a_mean(0.8, 500, 8, 2) if e.is_finding(0.02, 5)]
    assert len(found) > 50
    assert all(interval.excludes(*estimate.interval()) for estimate in found)


def test_false_alarms_of_a_family_stay_below_alpha():
    families = 2000
    tests = 5
    estimates = estimates_of_a_mean(effect=0.0, count=families * tests, values=6, seed=3)
    alarms = np.reshape([e.is_finding(0.02, tests) for e in estimates], (families, tests))
    # 2 % of 2000 are 40, with a standard deviation of 6.3
    assert alarms.any(axis=1).sum() < 40 + 3 * 6.3


def test_half_of_the_estimates_at_the_smallest_size_are_findings():
    error = 0.3
    smallest = Estimate(0.0, error).smallest(0.02, 4, least=0.1)
    rng = np.random.default_rng(4)
    values = smallest + error * rng.standard_normal(2000)
    share = np.mean([Estimate(float(v), error).is_finding(0.02, 4, least=0.1) for v in values])
    assert 0.45 < share < 0.55


def test_a_known_error_adds_no_uncertainty_to_an_estimated_one():
    assert interval.freedom_of_sum([(1.0, 5.0), (0.0, np.inf)]) == pytest.approx(5.0)
    assert interval.freedom_of_sum([(1.0, 5.0), (1.0, np.inf)]) == pytest.approx(20.0)
    assert interval.freedom_of_sum([(0.0, 5.0), (1.0, np.inf)]) == np.inf


def test_errors_of_a_line_are_its_scatter_over_many_sets():
    slopes = []
    errors = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        x = rng.uniform(-1.0, 1.0, 60)
        columns = np.column_stack([np.ones(60), x])
        values = 2.0 + 3.0 * x + rng.standard_normal(60)
        weight = np.ones(60)
        slopes.append(robust_line.fit(columns, values, weight)[1])
        errors.append(resampling.bootstrap_errors(columns, values, weight)[1])
    assert 0.7 < np.median(errors) / np.std(slopes) < 1.4


def test_stretches_that_share_an_error_make_the_error_of_a_level_larger():
    rng = np.random.default_rng(5)
    independent = rng.standard_normal(60)
    shared = np.repeat(rng.standard_normal(6), 10) + 0.1 * rng.standard_normal(60)
    assert resampling.error_of_level(shared) > 2.0 * resampling.error_of_level(independent)


def test_the_p_value_of_simulations_is_uniform_where_nothing_is_there():
    rng = np.random.default_rng(6)
    p_values = [
        simulated_test.p_value(
            float(rng.standard_normal()), lambda: float(rng.standard_normal()), 199, 99, 10
        ).p_value
        for _ in range(400)
    ]
    for level in (0.1, 0.3, 0.6):
        assert np.mean(np.array(p_values) <= level) == pytest.approx(level, abs=0.08)
