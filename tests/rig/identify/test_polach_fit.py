"""Polach's parameters are found from creep curves.

The curves are those of a measured locomotive, and curves with known parameters.
"""

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.reports.creep_curve import tuned
from rollerrig.rig.contact import polach
from rollerrig.rig.identify.creep_curves import judgement
from rollerrig.rig.identify.data import dataset, parameters
from rollerrig.rig.identify.data.runs import Curve, Dataset
from rollerrig.rig.identify.paper import polach_fit
from rollerrig.rig.identify.paper.polach_fit import Parameters

SPEED_M_S = 10.0
LOAD_N = 1.0e5
SEED = 3


@pytest.fixture(scope="module")
def locomotive():
    return dataset.load("eurosprinter_127001")


@pytest.fixture(scope="module")
def fitted(locomotive):
    return polach_fit.fit(locomotive)


@pytest.fixture
def few_replicates(monkeypatch):
    """Fits are fast where their intervals do not matter."""
    monkeypatch.setattr(polach_fit, "REPLICATES", 10)


def empty_curve(points: int = 150) -> Curve:
    """Return a curve at one speed and load, without adhesion."""
    return Curve(
        creepage=np.geomspace(1e-3, 0.25, points),
        adhesion=np.zeros(points),
        speed_m_s=np.full(points, SPEED_M_S),
        load_N=np.full(points, LOAD_N),
        series=np.zeros(points),
    )


def with_curve(data: Dataset, true: Parameters, noise: float) -> Dataset:
    """Return a dataset whose curve has known parameters, and noise of this standard deviation."""
    curve = empty_curve()
    errors = noise * np.random.default_rng(SEED).standard_normal(curve.creepage.size)
    adhesion = polach_fit.model(np.array(true), curve, parameters.patch_of(data))
    return data._replace(curve=curve._replace(adhesion=adhesion + errors))


def test_the_patch_is_that_of_the_guides_example(locomotive):
    patch = parameters.patch_of(locomotive)
    cube_root = 106_700.0 ** (1.0 / 3.0)
    assert patch.a1 * cube_root == pytest.approx(6.304e-3, rel=2e-3)
    assert patch.b1 * cube_root == pytest.approx(12.61e-3, rel=2e-3)
    assert patch.c11 == pytest.approx(3.79, rel=0.02)


def test_five_parameters_and_four_reach_the_published_errors(fitted):
    # independent fits of this project's reference material: 0.0250 and 0.0281
    assert fitted.rms == pytest.approx(0.0250, abs=1e-4)
    assert fitted.rms_without_fall == pytest.approx(0.0281, abs=2e-4)
    assert fitted.scatter_floor == pytest.approx(0.025, abs=0.002)
    assert fitted.mean_error_of_recommended["dry"] == pytest.approx(0.134, abs=0.003)
    assert fitted.mean_error_of_recommended["wet"] == pytest.approx(-0.063, abs=0.003)


@pytest.mark.usefixtures("few_replicates")
@pytest.mark.parametrize(("left_out", "assumed"), [("speed_m_s", "10"), ("wheel_load_N", "52700")])
def test_a_curve_without_speed_or_load_warns_which_value_is_assumed(
    left_out, assumed, locomotive, tmp_path, capsys
):
    columns = {
        "creepage": locomotive.curve.creepage,
        "adhesion": locomotive.curve.adhesion,
        "speed_m_s": locomotive.curve.speed_m_s,
        "wheel_load_N": locomotive.curve.load_N,
    }
    del columns[left_out]
    np.savetxt(
        tmp_path / "curve.csv",
        np.column_stack(list(columns.values())),
        delimiter=",",
        header=",".join(columns),
        comments="",
    )
    (tmp_path / "dataset.toml").write_text('kind = "creep_curve"\nfile = "curve.csv"\n')
    assert cli.main(["tune", str(tmp_path), "--out", str(tmp_path / "out")]) == 0

    lines = capsys.readouterr().out.splitlines()
    warning = next(line for line in lines if line.startswith("warning: "))
    assert f"'{left_out}'" in warning
    assert assumed in warning
    page = (tmp_path / "out" / "tune.html").read_text()
    assert f"&#x27;{left_out}&#x27;" in page
    # the whole curve needs no warning
    assert locomotive.warnings == []


def test_intervals_hold_their_values(locomotive, fitted, monkeypatch):
    for interval in fitted.values.values():
        assert interval.low <= interval.value <= interval.high
        assert interval.low < interval.high

    # 95 % of other replicates are within the intervals
    monkeypatch.setattr(polach_fit, "REPLICATES", 30)
    values, low, high = np.transpose(list(fitted.values.values()))
    patch = parameters.patch_of(locomotive)
    replicates = polach_fit._bootstrap(locomotive.curve, patch, values, seed=1)
    is_within = (replicates >= low) & (replicates <= high)
    assert is_within.mean() > 0.85


@pytest.mark.usefixtures("few_replicates")
def test_known_parameters_are_found(locomotive):
    true = Parameters(mu_0=0.4, A=0.45, gamma_s_m=0.5, k_a=0.7, k_s=0.3)
    fit = polach_fit.fit(with_curve(locomotive, true, noise=0.002))
    for interval, value in zip(fit.values.values(), true, strict=True):
        assert interval.value == pytest.approx(value, rel=0.15)
    assert fit.rms == pytest.approx(0.002, rel=0.25)


def test_friction_that_does_not_fall_is_not_reported_to_fall(locomotive):
    true = Parameters(mu_0=0.3, A=1.0, gamma_s_m=0.0, k_a=0.6, k_s=0.3)
    data = with_curve(locomotive, true, noise=0.01)
    assert not judgement.without_law(data).falls


def test_the_model_is_the_kernels(locomotive):
    true = Parameters(mu_0=0.4, A=0.45, gamma_s_m=0.5, k_a=0.7, k_s=0.3)
    curve = empty_curve(points=20)
    patch = parameters.patch_of(locomotive)
    eps_of_creepage = patch.eps1 * LOAD_N ** (-1.0 / 3.0)
    modelled = polach_fit.model(np.array(true), curve, patch)
    for creepage, adhesion in zip(curve.creepage, modelled, strict=True):
        expected, *_ = polach.curve(
            SPEED_M_S * creepage,
            creepage,
            eps_of_creepage,
            true.mu_0 * true.A,
            true.A,
            true.gamma_s_m,
            true.k_a,
            true.k_s,
        )
        assert adhesion == pytest.approx(expected, rel=1e-12)


def test_the_report_shows_points_and_parameters(locomotive, fitted):
    page = tuned.tune_page(locomotive, fitted, judgement.without_law(locomotive))
    assert "<svg" in page
    assert "0.0250" in page


def test_a_parameter_at_its_bound_is_reported_as_not_determined():
    at_bound = tuned.parameter_json(1.0, 1.0, 1.0, polach_fit.bound_of("k_a", 1.0))
    assert at_bound["ci95"] is None
    assert tuned.parameter_words(at_bound) == "at its bound 1, not determined"
    inside = tuned.parameter_json(0.5, 0.4, 0.6, polach_fit.bound_of("k_a", 0.5))
    assert tuned.parameter_words(inside) == "0.5 (0.4 to 0.6)"


def test_braking_runs_are_refused(locomotive):
    with pytest.raises(ConfigError, match="creep_curve"):
        polach_fit.fit(locomotive._replace(curve=None, kind="braking_runs"))
