"""Contact points against a published table of rigid contact, and against their equations."""

import math
from pathlib import Path

import conicity
import numpy as np
import pytest

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import geometry, profiles
from rollerrig.rig.contact.geometry import (
    COLUMNS,
    GAP,
    MOST,
    NX,
    NY,
    NZ,
    RADIUS,
    RAIL_Y,
    S,
    X,
    Y,
    Z,
)

DATA = Path(__file__).parents[2] / "data"
WHEEL = profiles.s1002()
RAIL = profiles.uic60()
# columns y_ws, roll, s_R, s_L, Y_R, Y_L, r_R, r_L, z in mm and rad; there the right side is +y,
# here the left one
RIGID = np.genfromtxt(DATA / "rigid_contact_s1002_uic60_1in20.csv", delimiter=",", skip_header=1)


def _deepest(y_m, z_m, roll, side, roller_m=math.inf, yaw=0.0, x_m=0.0):
    """Return the deepest contact of one wheel; side -1 is the mirror image."""
    pose = (x_m, side * y_m, z_m, side * roll, 0.0, side * yaw)
    return geometry.contacts(pose, WHEEL, RAIL, roller_m)[0]


@pytest.mark.parametrize("side", [1, -1])
def test_contact_points_are_those_of_the_rigid_contact_table(side):
    assert len(RIGID) > 12
    for row in RIGID:
        found = _deepest(row[0] * 1e-3, row[8] * 1e-3, row[1], side)
        k = 0 if side == 1 else 1
        assert found[S] * 1e3 == pytest.approx(row[2 + k], abs=0.05)
        assert found[RAIL_Y] * 1e3 == pytest.approx(row[4 + k], abs=0.05)
        assert found[RADIUS] * 1e3 == pytest.approx(row[6 + k], abs=0.05)
        assert abs(found[GAP]) < 2e-6


@pytest.mark.parametrize("shift_mm", [0.0, 2.0, 4.5, 5.5])
def test_a_wheelset_laid_down_has_the_height_and_roll_of_the_table(shift_mm):
    row = RIGID[np.argmin(np.abs(RIGID[:, 0] - shift_mm))]
    z, roll, _, _ = conicity.settle(shift_mm * 1e-3, WHEEL, RAIL)
    assert z * 1e3 == pytest.approx(row[8], abs=0.002)
    assert roll == pytest.approx(row[1], abs=3e-6)


# where the flange touches, 0.1 um across is 1 um up: at 6.5 mm the table is 2.45 um too high
@pytest.mark.parametrize("shift_mm", [0.0, 2.0, 4.5, 5.5, 6.5])
def test_a_wheelset_laid_down_has_the_height_that_follows_from_the_profiles_formulas(shift_mm):
    # the inclined rail head, laid with its gauge face
    tilt = math.atan(1.0 / 20.0)
    y = np.linspace(-0.0365, 0.0365, 1_500_001)
    height = -profiles.uic60_depth(y)
    across = y * math.cos(tilt) - height * math.sin(tilt)
    up = y * math.sin(tilt) + height * math.cos(tilt)
    up -= up.max()
    gauge_side = slice(None, up.argmax())
    across += 0.7175 - np.interp(-0.014, up[gauge_side], across[gauge_side])
    from_above = slice(across[gauge_side].argmin(), None)
    s = np.concatenate((np.linspace(-0.045, -0.03, 600_001), np.linspace(-0.0299, 0.04, 600_001)))
    radius = 0.445 + profiles.s1002_height(s)
    z, roll, _, _ = conicity.settle(shift_mm * 1e-3, WHEEL, RAIL)
    for side in (1, -1):
        below = -side * (0.75 + s) * math.sin(roll) - radius * math.cos(roll)
        there = -shift_mm * 1e-3 + side * (0.75 + s) * math.cos(roll) - radius * math.sin(roll)
        rail_z = np.interp(side * there, across[from_above], up[from_above], -1.0)
        assert z == pytest.approx(np.max(rail_z - below), abs=1e-7)


@pytest.mark.parametrize(("laying", "expected"), [(1 / 20, 0.0094), (1 / 40, 0.183)])
def test_equivalent_conicity_at_3_mm_is_the_reference(laying, expected):
    rail = profiles.uic60(laying)
    assert conicity.equivalent(0.003, WHEEL, rail) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("roller_m", [math.inf, 1.0, 0.5])
@pytest.mark.parametrize(
    "pose",
    [
        (0.0, 0.001, 0.4447, 0.0, 0.0, 0.0),
        (0.0, -0.003, 0.4447, 0.002, 0.3, 0.01),
        (0.002, 0.004, 0.4446, -0.001, 0.0, -0.015),
        (0.0, 0.0065, 0.4460, 0.001, 0.0, 0.005),
    ],
)
def test_every_contact_satisfies_the_six_equations(pose, roller_m):
    x, y, z, roll, _, yaw = pose
    e = np.array(geometry.axis(roll, yaw))
    for found in geometry.contacts(pose, WHEEL, RAIL, roller_m):
        n = found[[NX, NY, NZ]]
        on_wheel = found[[X, Y, Z]]  # from the wheelset's centre
        # the point lies on the wheel: its distance from the axis is the rolling radius there
        along = on_wheel @ e
        rho = on_wheel - along * e
        assert np.linalg.norm(rho) == pytest.approx(found[RADIUS], abs=1e-8)
        assert along - WHEEL.centre_m == pytest.approx(found[S], abs=2e-5)
        # the wheel's normal is the rail's: it meets the wheel's axis
        assert abs(np.cross(on_wheel, n) @ e) < 1e-8
        # the rail point lies along the normal, a gap away, on the rail or roller
        at = np.array([x, y, z]) + on_wheel - found[GAP] * n
        if math.isinf(roller_m):
            assert at[1] == pytest.approx(found[RAIL_Y], abs=1e-5)
            assert n[0] == 0.0
        else:
            axis_to_point = np.array([at[0], at[2] + roller_m])
            height = np.interp(
                -n[1],
                np.linspace(-profiles.STEEPEST, profiles.STEEPEST, profiles.SINES),
                RAIL.nodes[:, 1],
            )
            assert np.linalg.norm(axis_to_point) == pytest.approx(roller_m + height, abs=2e-6)


def test_no_point_of_the_wheel_is_closer_than_the_contacts():
    # by brute force in the plane: the vertical gap over the whole tread
    y = 0.002
    z = 0.4449
    found = _deepest(y, z, 0.0, 1)
    s = np.linspace(-0.03, 0.05, 16001)
    nodes = RAIL.nodes[::-1]
    wheel_z = z - np.interp(
        s, WHEEL.start_m + WHEEL.spacing_m * np.arange(len(WHEEL.fine)), WHEEL.fine[:, 0]
    )
    gap = wheel_z - np.interp(WHEEL.centre_m + s + y, nodes[:, 0], nodes[:, 1])
    assert s[gap.argmin()] == pytest.approx(found[S], abs=1e-4)
    assert gap.min() * found[NZ] == pytest.approx(found[GAP], abs=2e-7)


def test_tread_and_flange_are_both_found_where_both_are_close():
    found = geometry.contacts((0.0, 0.006, 0.44475, 0.0, 0.0, 0.0), WHEEL, RAIL)
    assert len(found) >= 2
    assert found[:, S].min() < -0.028
    assert found[:, S].max() > 0.005
    assert np.all(np.diff(found[:, GAP]) >= 0.0)


def test_a_roller_of_infinite_radius_is_a_rail():
    for y, yaw in ((0.0, 0.0), (0.003, 0.01), (0.0062, -0.004)):
        on_rail = _deepest(y, 0.4448, 0.0, 1, yaw=yaw)
        on_roller = _deepest(y, 0.4448, 0.0, 1, roller_m=1e5, yaw=yaw)
        np.testing.assert_allclose(on_roller[:9], on_rail[:9], atol=3e-7)


def test_off_the_crown_the_normal_tilts_by_the_offset_over_both_radii():
    found = _deepest(0.0, 0.4447, 0.0, 1, roller_m=1.0, x_m=0.005)
    assert found[NX] == pytest.approx(0.005 / 1.445, rel=2e-3)


def test_pitch_turns_the_wheel_into_itself():
    still = geometry.contacts((0.0, 0.001, 0.4447, 1e-3, 0.0, 5e-3), WHEEL, RAIL)
    turned = geometry.contacts((0.0, 0.001, 0.4447, 1e-3, 2.0, 5e-3), WHEEL, RAIL)
    np.testing.assert_array_equal(still, turned)


def test_a_wheel_off_the_rail_is_refused():
    with pytest.raises(ValueError, match="off the rail"):
        geometry.contacts((0.0, 0.0, 0.52, 0.0, 0.0, 0.0), WHEEL, RAIL)


@kernel
def _sway(found, F, steps, roller_m, wheel, rail, log):
    count = geometry.detect(
        found, 0, 0, F, 0, (0.0, 0.0, 0.4447), geometry.axis(0.0, 0.0), roller_m, wheel, rail
    )
    for i in range(steps):
        y = 0.004 * math.sin(i * 1e-3)
        pose = (0.0, y, 0.4447)
        axle = geometry.axis(0.0, 0.005 * math.cos(i * 1e-3))
        count = geometry.track(found, 0, count, pose, axle, roller_m, wheel, rail)
        if i % 16 == 0:
            count = geometry.detect(found, 0, count, F, 0, pose, axle, roller_m, wheel, rail)
        if i < log.shape[0]:
            log[i, 0] = y
            log[i, 1] = count
            log[i, 2] = found[0, geometry.S]


def _scratch():
    return np.zeros((MOST, COLUMNS)), np.zeros((1, len(WHEEL.coarse)))


def test_tracking_step_by_step_finds_the_contacts_of_a_new_search():
    found, F = _scratch()
    log = np.zeros((6000, 3))
    _sway(found, F, 6000, math.inf, WHEEL, RAIL, log)
    for i in range(0, 6000, 250):
        y, count, s = log[i]
        fresh = geometry.contacts(
            (0.0, y, 0.4447, 0.0, 0.0, 0.005 * math.cos(i * 1e-3)), WHEEL, RAIL
        )
        assert count >= 1
        assert np.abs(fresh[:, S] - s).min() < 5e-5


@kernel
def _quick(F, pose, axle, roller_m, wheel, rail):
    geometry.misfits(F, 0, pose, axle, roller_m, wheel, rail)


@kernel
def _exact(F, pose, axle, roller_m, wheel, rail):
    for i in range(wheel.coarse.shape[0]):
        F[0, i] = geometry.matched(
            wheel.coarse[i, 0], wheel.coarse[i, 1], wheel.coarse[i, 2], pose, axle, roller_m, rail
        )[0]


@pytest.mark.parametrize("roller_m", [math.inf, 0.5, 1.0])
def test_the_misfits_of_the_search_are_within_ten_micrometres(roller_m):
    rng = np.random.default_rng(5)
    for _ in range(200):
        x = 0.0 if math.isinf(roller_m) else rng.normal(0.0, 5e-3)
        pose = (x, rng.normal(0.0, 5e-3), 0.4447)
        axle = geometry.axis(rng.normal(0.0, 5e-3), rng.normal(0.0, 1e-2))
        _, F = _scratch()
        _, exact = _scratch()
        _quick(F, pose, axle, roller_m, WHEEL, RAIL)
        _exact(exact, pose, axle, roller_m, WHEEL, RAIL)
        assert np.abs(F - exact).max() < 1e-5
