"""Formulas that all parts of the product share, by numbers that are easy to check."""

import pytest

from rollerrig.configs import vehicle

BRAKE = {
    "cylinder_area_m2": 0.05,
    "lever_ratio": 4.0,
    "efficiency": 0.9,
    "pad_friction": 0.35,
    "disc_radius_m": 0.25,
    "discs": 2.0,
}


def test_two_pads_press_on_each_disc():
    # 0.18 N of clamping force for each Pa, on both sides of two discs
    assert vehicle.brake_torque_Nm_Pa(BRAKE) == pytest.approx(0.18 * 4 * 0.35 * 0.25)


@pytest.mark.parametrize(
    ("place", "axles", "wheelsets"),
    [
        (0, 4, [1, 2, 3, 4]),
        (0, 2, [1, 2]),
        (3, 4, [3]),
        (-1, 4, [1, 2]),
        (-2, 4, [3, 4]),
        (-4, 8, [7, 8]),
    ],
)
def test_a_place_is_a_wheelset_a_bogie_or_all(place, axles, wheelsets):
    assert list(vehicle.wheelsets_of(place, axles)) == wheelsets


@pytest.mark.parametrize(
    ("power", "changed"),
    [
        (0.0, {"resistance_A_N": 1100.0}),
        (1.0, {"resistance_B_N_s_m": 15.0}),
        (2.0, {"resistance_C_N_s2_m2": 2.25}),
    ],
)
def test_a_further_resistance_has_its_force_at_20_m_s(power, changed):
    base = {"resistance_A_N": 1000.0, "resistance_B_N_s_m": 10.0, "resistance_C_N_s2_m2": 2.0}
    assert vehicle.running_resistance(base, 100.0, power) == pytest.approx(changed)


def test_a_gradient_is_a_share_of_the_weight():
    base = {"resistance_A_N": 1000.0, "mass_kg": 40000.0}
    uphill_N = vehicle.track_gradient(base, 0.01)["resistance_A_N"] - 1000.0
    assert uphill_N == pytest.approx(3922.66)
