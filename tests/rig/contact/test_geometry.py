"""Contact points against a published table of rigid contact, and against their equations."""

import math
from pathlib import Path
from typing import NamedTuple

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


class RigidContact(NamedTuple):
    """A row of the published table; there the right side is +y, here the left one."""

    shift_mm: float
    roll_rad: float
    s_right_mm: float  # place on the wheel's profile
    s_left_mm: float
    rail_y_right_mm: float  # place on the rail
    rail_y_left_mm: float
    radius_right_mm: float  # rolling radius
    radius_left_mm: float
    z_mm: float  # height of the axle


RIGID_CONTACTS = [
    RigidContact(*row[: len(RigidContact._fields)])
    for row in np.genfromtxt(
        DATA / "rigid_contact_s1002_uic60_1in20.csv", delimiter=",", skip_header=1
    )
]


def _deepest(y_m, z_m, roll, side=1, roller_m=math.inf, yaw=0.0, x_m=0.0):
    """Return the deepest contact of one wheel; side -1 is the mirror image."""
    pose = (x_m, side * y_m, z_m, side * roll, 0.0, side * yaw)
    return geometry.contacts(pose, WHEEL, RAIL, roller_m)[0]


def _deepest_of(row, side):
    """Return the deepest contact of a wheelset that is placed as in the table."""
    return _deepest(row.shift_mm * 1e-3, row.z_mm * 1e-3, row.roll_rad, side)


@pytest.mark.parametrize("row", RIGID_CONTACTS, ids=lambda row: f"{row.shift_mm:g} mm")
def test_contact_points_are_those_of_the_rigid_contact_table(row):
    right = _deepest_of(row, side=1)
    assert right[S] * 1e3 == pytest.approx(row.s_right_mm, abs=0.05)
    assert right[RAIL_Y] * 1e3 == pytest.approx(row.rail_y_right_mm, abs=0.05)
    assert right[RADIUS] * 1e3 == pytest.approx(row.radius_right_mm, abs=0.05)
    assert abs(right[GAP]) < 2e-6

    left = _deepest_of(row, side=-1)
    assert left[S] * 1e3 == pytest.approx(row.s_left_mm, abs=0.05)
    assert left[RAIL_Y] * 1e3 == pytest.approx(row.rail_y_left_mm, abs=0.05)
    assert left[RADIUS] * 1e3 == pytest.approx(row.radius_left_mm, abs=0.05)
    assert abs(left[GAP]) < 2e-6


def test_the_table_of_rigid_contact_is_complete():
    assert len(RIGID_CONTACTS) > 12


@pytest.mark.parametrize("shift_mm", [0.0, 2.0, 4.5, 5.5])
def test_a_wheelset_laid_down_has_the_height_and_roll_of_the_table(shift_mm):
    row = min(RIGID_CONTACTS, key=lambda row: abs(row.shift_mm - shift_mm))
    z_m, roll_rad, _, _ = conicity.settle(shift_mm * 1e-3, WHEEL, RAIL)
    assert z_m * 1e3 == pytest.approx(row.z_mm, abs=0.002)
    assert roll_rad == pytest.approx(row.roll_rad, abs=3e-6)


# where the flange touches, 0.1 um across is 1 um up: at 6.5 mm the table is 2.45 um too high
@pytest.mark.parametrize("shift_mm", [0.0, 2.0, 4.5, 5.5, 6.5])
def test_a_wheelset_laid_down_has_the_height_that_follows_from_the_profiles_formulas(shift_mm):
    # the inclined rail head
    tilt = math.atan(1.0 / 20.0)
    y = np.linspace(-0.0365, 0.0365, 1_500_001)
    height = -profiles.uic60_depth(y)
    across = y * math.cos(tilt) - height * math.sin(tilt)
    up = y * math.sin(tilt) + height * math.cos(tilt)
    up -= up.max()

    # laid with its gauge face 14 mm below the top at half the gauge
    gauge_side = slice(None, up.argmax())
    across += 0.7175 - np.interp(-0.014, up[gauge_side], across[gauge_side])
    visible_from_above = slice(across[gauge_side].argmin(), None)
    rail_across = across[visible_from_above]
    rail_up = up[visible_from_above]

    # the wheel, without its step at -30 mm
    flange_side = np.linspace(-0.045, -0.03, 600_001)
    tread = np.linspace(-0.0299, 0.04, 600_001)
    s = np.concatenate((flange_side, tread))
    radius = 0.445 + profiles.s1002_height(s)

    # both wheels of the settled wheelset just touch their rails
    z_m, roll, _, _ = conicity.settle(shift_mm * 1e-3, WHEEL, RAIL)
    for side in (1, -1):
        along_axis = side * (0.75 + s)
        wheel_z = -along_axis * math.sin(roll) - radius * math.cos(roll)
        wheel_y = -shift_mm * 1e-3 + along_axis * math.cos(roll) - radius * math.sin(roll)
        rail_z = np.interp(side * wheel_y, rail_across, rail_up, -1.0)
        assert z_m == pytest.approx(np.max(rail_z - wheel_z), abs=1e-7)


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
            sines = np.linspace(-profiles.STEEPEST, profiles.STEEPEST, profiles.SINES)
            height = np.interp(-n[1], sines, RAIL.nodes[:, profiles.Z_M])
            from_axis = np.hypot(at[0], at[2] + roller_m)
            assert from_axis == pytest.approx(roller_m + height, abs=2e-6)


def test_no_point_of_the_wheel_is_closer_than_the_contacts():
    # by brute force in the plane: the vertical gap over the whole tread
    y = 0.002
    z = 0.4449
    found = _deepest(y, z, 0.0)
    s = np.linspace(-0.03, 0.05, 16001)
    fine_s = WHEEL.start_m + WHEEL.spacing_m * np.arange(len(WHEEL.fine))
    wheel_z = z - np.interp(s, fine_s, WHEEL.fine[:, profiles.RADIUS_M])
    nodes = RAIL.nodes[::-1]  # rising across
    rail_z = np.interp(WHEEL.centre_m + s + y, nodes[:, profiles.Y_M], nodes[:, profiles.Z_M])
    gap = wheel_z - rail_z
    assert s[gap.argmin()] == pytest.approx(found[S], abs=1e-4)
    assert gap.min() * found[NZ] == pytest.approx(found[GAP], abs=2e-7)


def test_tread_and_flange_are_both_found_where_both_are_close():
    found = geometry.contacts((0.0, 0.006, 0.44475, 0.0, 0.0, 0.0), WHEEL, RAIL)
    assert len(found) >= 2
    assert found[:, S].min() < -0.028
    assert found[:, S].max() > 0.005
    assert np.all(np.diff(found[:, GAP]) >= 0.0)


def test_a_roller_of_infinite_radius_is_a_rail():
    # all columns up to the rolling radius; the later ones depend on the roller
    geometric = slice(None, RADIUS + 1)
    for y, yaw in ((0.0, 0.0), (0.003, 0.01), (0.0062, -0.004)):
        on_rail = _deepest(y, 0.4448, 0.0, yaw=yaw)
        on_roller = _deepest(y, 0.4448, 0.0, roller_m=1e5, yaw=yaw)
        np.testing.assert_allclose(on_roller[geometric], on_rail[geometric], atol=3e-7)


def test_off_the_crown_the_normal_tilts_by_the_offset_over_both_radii():
    found = _deepest(0.0, 0.4447, 0.0, roller_m=1.0, x_m=0.005)
    assert found[NX] == pytest.approx(0.005 / 1.445, rel=2e-3)


def test_pitch_turns_the_wheel_into_itself():
    still = geometry.contacts((0.0, 0.001, 0.4447, 1e-3, 0.0, 5e-3), WHEEL, RAIL)
    turned = geometry.contacts((0.0, 0.001, 0.4447, 1e-3, 2.0, 5e-3), WHEEL, RAIL)
    np.testing.assert_array_equal(still, turned)


def test_a_wheel_off_the_rail_is_refused():
    with pytest.raises(ValueError, match="off the rail"):
        geometry.contacts((0.0, 0.0, 0.52, 0.0, 0.0, 0.0), WHEEL, RAIL)


# columns of the log of `_sway`
LOGGED_Y, LOGGED_COUNT, LOGGED_S = range(3)
STEPS = 6000
STEPS_PER_SEARCH = 16


@kernel
def _sway(found, F, roller_m, wheel, rail, log):
    """Follow the contacts of a wheel that sways by 4 mm and yaws, and log them in each step."""
    pose = (0.0, 0.0, 0.4447)
    axle = geometry.axis(0.0, 0.0)
    count = geometry.detect(found, 0, 0, F, 0, pose, axle, roller_m, wheel, rail)
    for i in range(log.shape[0]):
        y = 0.004 * math.sin(i * 1e-3)
        pose = (0.0, y, 0.4447)
        axle = geometry.axis(0.0, 0.005 * math.cos(i * 1e-3))
        count = geometry.track(found, 0, count, pose, axle, roller_m, wheel, rail)
        if i % STEPS_PER_SEARCH == 0:
            count = geometry.detect(found, 0, count, F, 0, pose, axle, roller_m, wheel, rail)
        log[i, LOGGED_Y] = y
        log[i, LOGGED_COUNT] = count
        log[i, LOGGED_S] = found[0, geometry.S]


def _scratch():
    """Return empty arrays of contacts and misfits of one wheel."""
    return np.zeros((MOST, COLUMNS)), np.zeros((1, len(WHEEL.coarse)))


def test_tracking_step_by_step_finds_the_contacts_of_a_new_search():
    found, F = _scratch()
    log = np.zeros((STEPS, 3))
    _sway(found, F, math.inf, WHEEL, RAIL, log)
    for i in range(0, STEPS, 250):
        y, count, s = log[i]
        yaw = 0.005 * math.cos(i * 1e-3)
        fresh = geometry.contacts((0.0, y, 0.4447, 0.0, 0.0, yaw), WHEEL, RAIL)
        assert count >= 1
        assert np.abs(fresh[:, S] - s).min() < 5e-5


@kernel
def _misfits_of_the_search(F, pose, axle, roller_m, wheel, rail):
    geometry.misfits(F, 0, pose, axle, roller_m, wheel, rail)


@kernel
def _exact_misfits(F, pose, axle, roller_m, wheel, rail):
    for i in range(wheel.coarse.shape[0]):
        at = wheel.coarse[i, profiles.AT_M]
        radius = wheel.coarse[i, profiles.AT_RADIUS_M]
        slope = wheel.coarse[i, profiles.AT_SLOPE]
        F[0, i] = geometry.matched(at, radius, slope, pose, axle, roller_m, rail)[0]


@pytest.mark.parametrize("roller_m", [math.inf, 0.5, 1.0])
def test_the_misfits_of_the_search_are_within_ten_micrometres(roller_m):
    rng = np.random.default_rng(5)
    for _ in range(200):
        x = 0.0 if math.isinf(roller_m) else rng.normal(0.0, 5e-3)
        pose = (x, rng.normal(0.0, 5e-3), 0.4447)
        axle = geometry.axis(rng.normal(0.0, 5e-3), rng.normal(0.0, 1e-2))
        _, F = _scratch()
        _, exact = _scratch()
        _misfits_of_the_search(F, pose, axle, roller_m, WHEEL, RAIL)
        _exact_misfits(exact, pose, axle, roller_m, WHEEL, RAIL)
        assert np.abs(F - exact).max() < 1e-5
