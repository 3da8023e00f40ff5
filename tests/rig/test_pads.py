"""Brake pads: no change while nothing varies, the energy balance, and fading by heat."""

import numpy as np
import pytest
from rolling import DRY, LOGGED, TRACK, Rig

from rollerrig.configs import store
from rollerrig.realtime.bench import scenario
from rollerrig.rig.mechanisms import pads

VARYING = {
    "speed_loss": 0.2,
    "pressure_loss": 0.1,
    "fade_loss": 0.6,
    "fade_from_K": 300.0,
    "fade_scale_K": 40.0,
    "clamp_hysteresis": 0.05,
}


MASS_KG = 43000.0
WHEELSET_KGM2 = 160.0
RADIUS_M = 0.445
DISC_J_K = 1.15e5  # heat capacity of the discs of a wheelset


def braked(**varying):
    """Return a dry rig on the track with these losses of its pads."""
    return Rig(30.0, adhesion=DRY, rig=TRACK, pads=varying)


def test_pads_that_do_not_vary_change_no_bit_even_when_they_are_computed():
    rig = braked()
    forced = braked()
    forced.params = forced.params._replace(pads=forced.params.pads._replace(vary=True))
    plain = rig.roll(8.0)
    computed = forced.roll(8.0)
    for name in LOGGED:
        if name != "clamp_pressure":
            equal = np.array_equal(getattr(plain, name), getattr(computed, name), equal_nan=True)
            assert equal, name


def test_all_the_work_of_varying_pads_becomes_heat_and_the_energy_of_the_stop_balances():
    rig = Rig(30.0, adhesion=DRY, rig=TRACK, pads=VARYING, brake={"disc_cooling_time_s": 1e5})
    run = rig.roll(45.0)
    assert run.vehicle_speed[-1] == 0.0
    heat_J = DISC_J_K * run.change("disc_temperature")
    np.testing.assert_allclose(heat_J, run.change("brake_work"), rtol=1e-3)

    vehicle_J = 0.5 * MASS_KG * 30.0**2
    wheelset_J = 0.5 * WHEELSET_KGM2 * (30.0 / RADIUS_M) ** 2
    lost_J = vehicle_J + 4 * wheelset_J
    counted_J = (
        run.change("brake_work").sum()
        + run.change("sliding_work").sum()
        + run.change("resistance_work")
    )
    assert counted_J == pytest.approx(lost_J, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "rim_m_s", "pressure_Pa", "disc_K"),
    [
        ("speed_loss", 40.0, 0.0, 300.0),
        ("pressure_loss", 0.0, 4e5, 300.0),
        ("fade_loss", 0.0, 0.0, 900.0),
    ],
)
def test_each_loss_lowers_friction_where_it_acts_and_nowhere_else(
    name, rim_m_s, pressure_Pa, disc_K
):
    constants = Rig(30.0, pads={name: 0.5}).params.pads
    assert 0.5 < pads.friction_share(rim_m_s, pressure_Pa, disc_K, constants) < 0.8
    assert pads.friction_share(0.0, 0.0, 300.0, constants) == 1.0


def test_hot_discs_brake_less_and_stay_cooler_than_without_fading():
    fade = {key: value for key, value in VARYING.items() if "fade" in key}
    plain = braked().roll(12.0)
    fading = braked(**fade).roll(12.0)
    cold = slice(None, 500)
    hot = slice(4000, 9000)
    assert fading.disc_temperature[-1].max() < plain.disc_temperature[-1].max()
    assert fading.brake_torque[hot].mean() < 0.9 * plain.brake_torque[hot].mean()
    assert np.array_equal(plain.brake_torque[cold], fading.brake_torque[cold])


def test_the_clamp_lags_behind_rising_and_falling_pressure_and_turns_without_a_jump():
    rising_Pa = np.linspace(0.0, 4e5, 400)
    pressure_Pa = np.concatenate([rising_Pa, rising_Pa[::-1]])
    clamp_Pa = np.empty_like(pressure_Pa)
    last_Pa = 0.0
    for i, pressure in enumerate(pressure_Pa):
        last_Pa = pads.clamped(last_Pa, pressure, 0.05)
        clamp_Pa[i] = last_Pa

    rises = slice(None, 400)
    falls = slice(450, None)  # after the clamp has turned
    np.testing.assert_allclose(clamp_Pa[rises], 0.95 * pressure_Pa[rises], rtol=1e-12)
    np.testing.assert_allclose(clamp_Pa[falls], 1.05 * pressure_Pa[falls], rtol=1e-12, atol=1e-6)
    assert np.abs(np.diff(clamp_Pa)).max() <= 1.06e3
    # the loop takes work from the movement of the clamp, and gives none
    mean_Pa = 0.5 * (clamp_Pa[1:] + clamp_Pa[:-1])
    assert np.sum(np.diff(pressure_Pa) * mean_Pa) < 0.0


def karwatzki(speed_km_h, force_kN):
    """The friction of a cast-iron block P10, from memory."""
    of_force = (1.6 * force_kN + 100.0) / (8.0 * force_kN + 100.0)
    return 0.6 * of_force * (speed_km_h + 100.0) / (5.0 * speed_km_h + 100.0)


# the class of disc pads, and a block with 20 kN at 3.8 bar, at 20 m/s and 2 bar
@pytest.mark.parametrize(
    ("name", "friction", "within"),
    [
        ("organic", 0.35, 0.01),
        ("sinter", 0.35, 0.01),
        ("cast_iron", karwatzki(72.0, 20.0 * 2.0 / 3.8), 0.02),
    ],
)
def test_a_set_of_pads_has_the_friction_of_its_class_in_the_middle_of_a_stop(
    name, friction, within
):
    plan = scenario.load("dry_stop", settings=(f"pads={name}",))
    share = pads.friction_share(20.0, 2.0e5, 320.0, plan.params.pads)
    assert plan["brake"]["pad_friction"] * share == pytest.approx(friction, abs=within)
    assert scenario.load("dry_stop")["pads_set"] == "constant"


def test_each_packaged_set_of_pads_has_such_a_class():
    assert store.names("pads") == ["cast_iron", "constant", "organic", "sinter"]
