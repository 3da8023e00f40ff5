"""Wheel and rail profiles against published samples, and against frequent mistakes in files."""

from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.contact import profile_csv, profiles

DATA = Path(__file__).parents[2] / "data"
S1002 = np.genfromtxt(DATA / "s1002.csv", delimiter=",", skip_header=1)
UIC60 = np.genfromtxt(DATA / "uic60.csv", delimiter=",", skip_header=1)
# columns of the published samples: place across, height, slope
S_MM, Z_MM, SLOPE = S1002.T
RAIL_Y_MM, RAIL_DEPTH_MM, *_ = UIC60.T
# the steps of the wheel's profile
STEPS_MM = np.array([-39.76, -38.43, -35.0, -26.0])


def places_m(wheel):
    """Return the places across of the fine nodes of a wheel."""
    return wheel.start_m + wheel.spacing_m * np.arange(len(wheel.fine))


def test_s1002_equals_its_published_samples_except_at_its_jumps():
    height_mm = profiles.s1002_height(S_MM * 1e-3) * 1e3
    off_mm = np.abs(height_mm - Z_MM)
    # one sample is on the jump at -26 mm
    *_, second_largest, largest = np.sort(off_mm)
    assert second_largest < 1e-6
    assert largest < 4e-5


def test_uic60_equals_the_sampled_head():
    depth_mm = profiles.uic60_depth(RAIL_Y_MM * 1e-3) * 1e3
    np.testing.assert_allclose(depth_mm, RAIL_DEPTH_MM, atol=1e-6)


def test_the_table_of_a_wheel_is_its_profile_and_its_slope():
    wheel = profiles.s1002()
    s_m = places_m(wheel)
    covered = (S_MM > -50.0) & (S_MM < 59.0)
    s_mm = S_MM[covered]

    height_m = np.interp(s_mm * 1e-3, s_m, wheel.fine[:, profiles.RADIUS_M]) - 0.445
    off_m = np.abs(height_m - Z_MM[covered] * 1e-3)
    assert off_m[s_mm > -25.0].max() < 1e-7
    assert off_m.max() < 5e-6  # the flange, from slopes 0.1 mm apart

    # the steps of the profile spoil a difference quotient
    slope = np.interp(s_mm * 1e-3, s_m, wheel.fine[:, profiles.SLOPE])
    to_nearest_step_mm = np.abs(s_mm[:, None] - STEPS_MM).min(axis=1)
    smooth = to_nearest_step_mm > 0.5
    np.testing.assert_allclose(slope[smooth], SLOPE[covered][smooth], atol=2e-3)


@pytest.mark.parametrize("laying", [1 / 20, 1 / 40, 0.0])
def test_a_laid_rail_has_its_gauge_face_at_half_the_gauge_14_mm_down(laying):
    rail = profiles.uic60(laying)
    y_m = rail.nodes[:, profiles.Y_M]
    z_m = rail.nodes[:, profiles.Z_M]
    assert z_m.max() == pytest.approx(0.0, abs=1e-7)
    gauge_side = slice(z_m.argmax(), None)
    gauge_face_m = np.interp(0.014, -z_m[gauge_side], y_m[gauge_side])
    assert gauge_face_m == pytest.approx(0.5 * 1.435, abs=2e-5)


def test_curvatures_of_the_arcs_are_those_of_the_drawing():
    rail = profiles.uic60(0.0)
    radius_m = 1.0 / rail.nodes[:, profiles.RAIL_CURVATURE_1_M]
    middle = (profiles.SINES - 1) // 2
    on_second_arc = middle + profiles.SINES // 14
    assert radius_m[middle] == pytest.approx(0.300, rel=1e-3)
    assert radius_m[on_second_arc] == pytest.approx(0.080, rel=1e-2)


def test_a_convex_profile_is_not_moved_and_the_shift_of_a_hollow_one_is_reported():
    y_m = np.linspace(-0.0365, 0.0365, 4001)
    height_m = -profiles.uic60_depth(y_m)
    _, changes = profiles.rail(y_m, height_m)
    assert changes.moved_by_convexity_m < 1e-6

    hollow_m = 2e-4 * np.exp(-((y_m / 0.004) ** 2))
    _, changes = profiles.rail(y_m, height_m - hollow_m)
    assert 2e-5 < changes.moved_by_convexity_m < 1e-3


def test_smoothing_removes_noise_from_the_slopes_and_reports_the_shift_of_the_points():
    rng = np.random.default_rng(1)
    s_m = np.linspace(-0.056, 0.060, 1161)
    noisy_m = profiles.s1002_height(s_m) + rng.normal(0.0, 2e-6, s_m.size)
    rough, _ = profiles.wheel(s_m, noisy_m)
    smooth, changes = profiles.wheel(s_m, noisy_m, smoothing_m=0.002)

    tread = slice(600, 1100)
    exact_slope = profiles.s1002().fine[tread, profiles.SLOPE]
    smooth_error = np.std(smooth.fine[tread, profiles.SLOPE] - exact_slope)
    rough_error = np.std(rough.fine[tread, profiles.SLOPE] - exact_slope)
    assert smooth_error < 0.1 * rough_error
    assert changes.smoothing_m == 0.002
    assert 0.0 < changes.moved_by_smoothing_m < 1e-3


def _write(path: Path, rows) -> Path:
    """Write a profile in mm, and return its path."""
    lines = ["s_mm,z_mm", *(f"{s_mm:.6f},{z_mm:.6f}" for s_mm, z_mm in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


WHEEL = S1002[150:, :2]


def test_a_wheel_from_a_file_is_the_wheel_it_describes(tmp_path):
    path = _write(tmp_path / "w.csv", WHEEL[::-1])
    _, z_m = profile_csv.read(path, profile_csv.WHEEL)
    np.testing.assert_allclose(z_m * 1e3, WHEEL[:, 1], atol=1e-6)

    from_file = profiles.wheel_named(str(path), 0.445, 0.75, 0.0)
    exact = profiles.s1002()
    s_m = places_m(from_file)
    exact_height_m = np.interp(s_m, places_m(exact), exact.fine[:, profiles.RADIUS_M])
    tread = (s_m > -0.03) & (s_m < 0.05)
    np.testing.assert_allclose(
        from_file.fine[tread, profiles.RADIUS_M], exact_height_m[tread], atol=2e-7
    )


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (np.delete(WHEEL, slice(400, 460), axis=0), "gap of"),
        (np.vstack((WHEEL[:300], WHEEL[290:])), "folds back"),
        (WHEEL * 1e-3, "looks like m"),
        (WHEEL / 25.4, "looks like inches"),
        (WHEEL[:5], "at least 10"),
        (WHEEL[300:900], "wide"),
        (WHEEL + np.array([40.0, 0.0]), "must reach"),
        (np.vstack((WHEEL, [[61.0, np.nan]])), "finite"),
    ],
    ids=["gap", "fold", "metres", "inches", "few", "narrow", "shifted", "nan"],
)
def test_a_bad_profile_is_refused_with_file_reason_and_remedy(tmp_path, rows, message):
    path = _write(tmp_path / "bad.csv", rows)
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


RAIL = np.column_stack((RAIL_Y_MM, -RAIL_DEPTH_MM))


@pytest.mark.parametrize(
    ("kind", "rows", "axes"),
    [
        # CONTACT and Simpack write z downwards; some programs look at the other wheel
        (profile_csv.RAIL, RAIL * [1, -1], "flip the sign of z"),
        (profile_csv.RAIL, RAIL[::-1] * [-1, -1], "flip the sign of z"),
        (profile_csv.WHEEL, S1002[:, :2] * [1, -1], "flip the sign of z"),
        (profile_csv.WHEEL, S1002[:, :2] * [-1, 1], "flip the sign of s"),
        (profile_csv.WHEEL, S1002[:, :2] * [-1, -1], "flip the sign of s and z"),
        # the mirrored wheel does not reach far enough, because of its axis
        (profile_csv.WHEEL, S1002[(S_MM > -60.0) & (S_MM < 40.0), :2] * [-1, 1], "the sign of s"),
    ],
    ids=["rail_z", "rail_z_mirrored", "wheel_z", "wheel_s", "wheel_s_and_z", "wheel_s_short"],
)
def test_a_profile_with_another_direction_of_an_axis_is_refused_with_the_axis_to_flip(
    tmp_path, kind, rows, axes
):
    path = _write(tmp_path / "profile.csv", rows)
    with pytest.raises(ConfigError, match=f"{axes}$"):
        profile_csv.read(path, kind)


@pytest.mark.parametrize("noise_mm", [0.0, 0.05])
def test_worn_and_noisy_profiles_with_the_documented_axes_are_read(tmp_path, noise_mm):
    rng = np.random.default_rng(2)
    rail = RAIL.copy()
    # 9 mm of side wear on the gauge side, and a hollow top
    rail[:, 1] -= 0.4 * np.clip(-RAIL_Y_MM - 13.0, 0.0, None)
    rail[:, 1] -= 1.0 * np.exp(-((RAIL_Y_MM / 8.0) ** 2))
    wheel = S1002[:, :2].copy()
    wheel[:, 1] -= 4.0 * np.exp(-((S_MM / 15.0) ** 2))
    for kind, rows in ((profile_csv.RAIL, rail), (profile_csv.WHEEL, wheel)):
        rows[:, 1] += rng.normal(0.0, noise_mm, len(rows))
        path = _write(tmp_path / "worn.csv", rows)
        _, z_m = profile_csv.read(path, kind)
        np.testing.assert_allclose(z_m * 1e3, rows[:, 1], atol=1e-6)
