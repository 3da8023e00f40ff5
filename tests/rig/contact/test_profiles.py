"""Wheel and rail profiles against published samples, and against frequent mistakes in files."""

from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.contact import profile_csv, profiles

DATA = Path(__file__).parents[2] / "data"
S1002 = np.genfromtxt(DATA / "s1002.csv", delimiter=",", skip_header=1)
UIC60 = np.genfromtxt(DATA / "uic60.csv", delimiter=",", skip_header=1)


def test_s1002_equals_its_published_samples_except_at_its_jumps():
    off = np.abs(profiles.s1002_height(S1002[:, 0] * 1e-3) * 1e3 - S1002[:, 1])
    assert np.sort(off)[-2] < 1e-6
    # one sample is on the jump at -26 mm
    assert off.max() < 4e-5


def test_uic60_equals_the_sampled_head():
    depth = profiles.uic60_depth(UIC60[:, 0] * 1e-3) * 1e3
    np.testing.assert_allclose(depth, UIC60[:, 1], atol=1e-6)


def test_the_table_of_a_wheel_is_its_profile_and_its_slope():
    wheel = profiles.s1002()
    s = wheel.start_m + wheel.spacing_m * np.arange(len(wheel.fine))
    here = (S1002[:, 0] > -50.0) & (S1002[:, 0] < 59.0)
    table = np.interp(S1002[here, 0] * 1e-3, s, wheel.fine[:, 0]) - 0.445
    off = np.abs(table - S1002[here, 1] * 1e-3)
    assert off[S1002[here, 0] > -25.0].max() < 1e-7
    assert off.max() < 5e-6  # the flange, from slopes 0.1 mm apart
    slope = np.interp(S1002[here, 0] * 1e-3, s, wheel.fine[:, 1])
    # the steps of the profile at -35 and -26 mm spoil a difference quotient
    calm = (
        np.min(np.abs(S1002[here, 0][:, None] - np.array([-35.0, -26.0, -39.76, -38.43])), 1) > 0.5
    )
    np.testing.assert_allclose(slope[calm], S1002[here, 2][calm], atol=2e-3)


def test_a_laid_rail_has_its_gauge_face_at_half_the_gauge_14_mm_down():
    for laying in (1 / 20, 1 / 40, 0.0):
        rail = profiles.uic60(laying)
        gauge_side = rail.nodes[:, 1].argmax()
        y = rail.nodes[gauge_side:, profiles.Y_M]
        z = rail.nodes[gauge_side:, profiles.Z_M]
        assert np.interp(0.014, -z, y) == pytest.approx(0.7175, abs=2e-5)
        assert rail.nodes[:, 1].max() == pytest.approx(0.0, abs=1e-7)


def test_curvatures_of_the_arcs_are_those_of_the_drawing():
    rail = profiles.uic60(0.0)
    middle = (profiles.SINES - 1) // 2
    assert 1.0 / rail.nodes[middle, 3] == pytest.approx(0.300, rel=1e-3)
    assert 1.0 / rail.nodes[middle + profiles.SINES // 14, 3] == pytest.approx(0.080, rel=1e-2)


def test_a_convex_profile_is_not_moved_and_the_shift_of_a_hollow_one_is_reported():
    y = np.linspace(-0.0365, 0.0365, 4001)
    _, changes = profiles.rail(y, -profiles.uic60_depth(y))
    assert changes.moved_by_convexity_m < 1e-6
    hollow = -profiles.uic60_depth(y) - 2e-4 * np.exp(-((y / 0.004) ** 2))
    _, changes = profiles.rail(y, hollow)
    assert 2e-5 < changes.moved_by_convexity_m < 1e-3


def test_smoothing_removes_noise_from_the_slopes_and_reports_the_shift_of_the_points():
    rng = np.random.default_rng(1)
    s = np.linspace(-0.056, 0.060, 1161)
    noisy = profiles.s1002_height(s) + rng.normal(0.0, 2e-6, s.size)
    rough, _ = profiles.wheel(s, noisy)
    smooth, changes = profiles.wheel(s, noisy, smoothing_m=0.002)
    exact = profiles.s1002()
    tread = slice(600, 1100)
    exact_slope = exact.fine[tread, profiles.SLOPE]
    smooth_error = np.std(smooth.fine[tread, profiles.SLOPE] - exact_slope)
    rough_error = np.std(rough.fine[tread, profiles.SLOPE] - exact_slope)
    assert smooth_error < 0.1 * rough_error
    assert changes.smoothing_m == 0.002
    assert 0.0 < changes.moved_by_smoothing_m < 1e-3


def _write(path: Path, rows) -> Path:
    path.write_text("s_mm,z_mm\n" + "".join(f"{a:.6f},{b:.6f}\n" for a, b in rows))
    return path


WHEEL = S1002[150:, :2]


def test_a_wheel_from_a_file_is_the_wheel_it_describes(tmp_path):
    s, z = profile_csv.read(_write(tmp_path / "w.csv", WHEEL[::-1]), profile_csv.WHEEL)
    np.testing.assert_allclose(z * 1e3, WHEEL[:, 1], atol=1e-6)
    named = profiles.wheel_named(str(tmp_path / "w.csv"), 0.445, 0.75, 0.0)
    exact = profiles.s1002()
    s = named.start_m + named.spacing_m * np.arange(len(named.fine))
    whole = exact.start_m + exact.spacing_m * np.arange(len(exact.fine))
    tread = (s > -0.03) & (s < 0.05)
    np.testing.assert_allclose(
        named.fine[tread, 0], np.interp(s[tread], whole, exact.fine[:, 0]), atol=2e-7
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda w: np.delete(w, slice(400, 460), 0), "gap of"),
        (lambda w: np.vstack((w[:300], w[290:])), "folds back"),
        (lambda w: w * 1e-3, "looks like m"),
        (lambda w: w / 25.4, "looks like inches"),
        (lambda w: w[:5], "at least 10"),
        (lambda w: w[300:900], "wide"),
        (lambda w: w + np.array([40.0, 0.0]), "must reach"),
        (lambda w: np.vstack((w, [[61.0, np.nan]])), "finite"),
    ],
)
def test_a_bad_profile_is_refused_with_file_reason_and_remedy(tmp_path, spoil, message):
    path = _write(tmp_path / "bad.csv", spoil(WHEEL))
    with pytest.raises(ConfigError, match=message) as raised:
        profile_csv.read(path, profile_csv.WHEEL)
    assert "bad.csv" in str(raised.value)


def test_the_message_names_a_line_that_is_no_number(tmp_path):
    path = _write(tmp_path / "bad.csv", WHEEL)
    lines = path.read_text().splitlines()
    lines[37] = "1.5,abc"
    path.write_text("\n".join(lines))
    with pytest.raises(ConfigError, match="line 38"):
        profile_csv.read(path, profile_csv.WHEEL)


def test_a_missing_file_is_refused_with_what_is_allowed():
    with pytest.raises(ConfigError, match="s1002"):
        profiles.wheel_named("no/such.csv", 0.445, 0.75, 0.0)
