"""Polach's parameters from creep curves: the measured locomotive, and curves of known parameters."""

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.reports import creep_curve
from rollerrig.rig.contact import polach
from rollerrig.rig.identify.data import dataset, parameters
from rollerrig.rig.identify.data.runs import Curve
from rollerrig.rig.identify.paper import polach_fit


@pytest.fixture(scope="module")
def locomotive():
    return dataset.load("eurosprinter_127001")


@pytest.fixture(scope="module")
def fitted(locomotive):
    return polach_fit.fit(locomotive)


def curve_of(x, noise=0.0, points=150, speed=10.0, seed=3):
    rng = np.random.default_rng(seed)
    e = np.geomspace(1e-3, 0.25, points)
    curve = Curve(
        e, np.zeros(points), np.full(points, speed), np.full(points, 1.0e5), np.zeros(points)
    )
    return curve, noise * rng.standard_normal(points)


def test_the_patch_is_that_of_the_guides_example(locomotive):
    patch = parameters.patch_of(locomotive)
    a, b = (side * 106_700.0 ** (1.0 / 3.0) for side in (patch.a1, patch.b1))
    assert a == pytest.approx(6.304e-3, rel=2e-3)
    assert b == pytest.approx(12.61e-3, rel=2e-3)
    assert patch.c11 == pytest.approx(3.79, rel=0.02)


def test_five_parameters_and_four_reach_the_published_errors(fitted):
    # independent fits of this project's reference material: 0.0250 and 0.0281
    assert fitted.rms == pytest.approx(0.0250, abs=1e-4)
    assert fitted.rms_without_fall == pytest.approx(0.0281, abs=2e-4)
    assert fitted.scatter_floor == pytest.approx(0.025, abs=0.002)
    assert fitted.mean_error_of_recommended["dry"] == pytest.approx(0.134, abs=0.003)
    assert fitted.mean_error_of_recommended["wet"] == pytest.approx(-0.063, abs=0.003)
    assert polach_fit.falls(fitted, 148)


@pytest.mark.parametrize(("left_out", "taken"), [("speed_m_s", "10"), ("wheel_load_N", "52700")])
def test_a_curve_without_speed_or_load_says_what_is_taken_for_it(
    left_out, taken, locomotive, tmp_path, capsys
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
    said = next(
        line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")
    )
    assert f"'{left_out}'" in said
    assert taken in said
    assert f"&#x27;{left_out}&#x27;" in (tmp_path / "out" / "tune.html").read_text()
    assert locomotive.warnings == []


def test_intervals_hold_their_values(fitted):
    for value in fitted.values.values():
        assert value.low <= value.value <= value.high
        assert value.low < value.high


def test_known_parameters_are_found(locomotive):
    true = np.array([0.4, 0.45, 0.5, 0.7, 0.3])
    curve, noise = curve_of(true, 0.002)
    curve = curve._replace(
        adhesion=polach_fit.model(true, curve, parameters.patch_of(locomotive)) + noise
    )
    found = polach_fit.fit(locomotive._replace(curve=curve))
    for value, at in zip(found.values.values(), true, strict=True):
        assert value.value == pytest.approx(at, rel=0.15)
    assert found.rms == pytest.approx(0.002, rel=0.25)


def test_friction_that_does_not_fall_is_not_told_to(locomotive):
    true = np.array([0.3, 1.0, 0.0, 0.6, 0.3])
    curve, noise = curve_of(true, 0.01)
    curve = curve._replace(
        adhesion=polach_fit.model(true, curve, parameters.patch_of(locomotive)) + noise
    )
    found = polach_fit.fit(locomotive._replace(curve=curve))
    assert not polach_fit.falls(found, curve.creepage.size)


def test_the_model_is_the_kernels(locomotive):
    x = np.array([0.4, 0.45, 0.5, 0.7, 0.3])
    curve, _ = curve_of(x, points=20)
    patch = parameters.patch_of(locomotive)
    for e, f in zip(curve.creepage, polach_fit.model(x, curve, patch), strict=True):
        unit = patch.eps1 * 1.0e5 ** (-1.0 / 3.0)
        assert f == pytest.approx(
            polach.curve(10.0 * e, e, unit, 0.4 * 0.45, 0.45, 0.5, 0.7, 0.3)[0], rel=1e-12
        )


def test_the_report_shows_points_and_parameters(locomotive, fitted):
    page = creep_curve.tune_page(locomotive, fitted)
    assert "<svg" in page
    assert "0.0250" in page


def test_braking_runs_are_refused(locomotive):
    with pytest.raises(ConfigError, match="creep_curve"):
        polach_fit.fit(locomotive._replace(curve=None, kind="braking_runs"))
