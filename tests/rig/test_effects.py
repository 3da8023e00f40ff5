"""The extended model in the plant: invisible at zero, felt otherwise, by the same kernel."""

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import scenario
from rollerrig.rig import effects, plant
from rollerrig.rig.plant import Plant

TICKS = 3000


def course(params) -> np.ndarray:
    run = Plant(params, 30.0)
    for tick in range(TICKS):
        plant.advance(run.state, run.delay, np.zeros(4), np.nan, tick, params)
        plant.observe(run.state, params)
    return run.buffer.copy()


def extended(**coefficients: float):
    told = tuple(f"mechanisms.{name}={value}" for name, value in coefficients.items())
    return scenario.load("velim_a1", "", told).params


@pytest.fixture(scope="module")
def base():
    return extended()


def test_mechanisms_at_zero_change_no_bit_even_when_they_are_computed(base) -> None:
    forced = base._replace(effects=base.effects._replace(on_friction=True, on_torque=True))
    with_them, without = course(forced), course(base)
    from rollerrig.rig.state import SLOTS

    for name, at in SLOTS.items():
        if name not in ("slid", "rail_work"):
            assert np.array_equal(with_them[at], without[at], equal_nan=True), name


def test_cleaning_by_leading_wheels_raises_friction_only_behind_them() -> None:
    params = extended(rail_cleaning_gain=0.2, rail_cleaning_energy_J_m=100.0)
    run = Plant(params, 30.0)
    for tick in range(TICKS):
        plant.advance(run.state, run.delay, np.zeros(4), np.nan, tick, params)
        plant.observe(run.state, params)
    degraded = run.state.friction_degraded
    assert degraded[0] == pytest.approx(params.law.mu_cd)
    assert degraded[1] > degraded[0]
    assert degraded[3] >= degraded[2]


def test_resistance_gradient_radius_and_layer_are_built_in(base) -> None:
    params = extended(running_resistance_force_N=500.0, track_gradient_gradient=0.001,
                      wheel_radius_fraction=0.01, roller_curvature_stiffness_fraction=0.5)
    assert params.vehicle.resistance_A_N == pytest.approx(
        base.vehicle.resistance_A_N + 500.0 + 9.80665 * 43.0)
    assert params.vehicle.wheel_radius_m == pytest.approx(1.01 * base.vehicle.wheel_radius_m)
    assert params.patch.eps1 > 1.4 * base.patch.eps1


def test_torque_changes_at_one_axle_only() -> None:
    built = extended(brake_gain_gain=0.1, brake_gain_axle=2.0).effects
    assert effects.torque(1000.0, 1, 0.0, built) == pytest.approx(1100.0)
    assert effects.torque(1000.0, 0, 0.0, built) == 1000.0


def test_a_coefficient_out_of_bounds_is_refused() -> None:
    with pytest.raises(ConfigError, match="rail_cleaning_gain"):
        extended(rail_cleaning_gain=7.0)


def test_resistance_grows_with_the_speed_to_the_power_that_is_told(base) -> None:
    linear = extended(running_resistance_force_N=400.0, running_resistance_speed_power=1.0)
    square = extended(running_resistance_force_N=400.0, running_resistance_speed_power=2.0)
    assert linear.vehicle.resistance_B_N_s_m - base.vehicle.resistance_B_N_s_m == pytest.approx(20.0)
    assert square.vehicle.resistance_C_N_s2_m2 - base.vehicle.resistance_C_N_s2_m2 == pytest.approx(
        1.0)
    with pytest.raises(ConfigError, match="speed_power"):
        extended(running_resistance_speed_power=0.5)


def test_fade_of_a_pad_saturates_with_its_heat() -> None:
    straight = extended(pad_fade_fade_1_MJ=0.01).effects
    bent = extended(pad_fade_fade_1_MJ=0.01, pad_fade_heat_MJ=3.0).effects
    assert effects.torque(1000.0, 0, 5e6, straight) == pytest.approx(950.0, rel=1e-4)
    assert effects.torque(1000.0, 0, 5e6, bent) == pytest.approx(
        1000.0 * (1.0 - 0.03 * (1.0 - np.exp(-5.0 / 3.0))))


def test_a_torque_offset_may_begin_at_a_torque() -> None:
    built = extended(torque_offset_offset_Nm=50.0, torque_offset_from_Nm=300.0).effects
    assert effects.torque(200.0, 0, 0.0, built) == 200.0
    assert effects.torque(400.0, 0, 0.0, built) == 450.0


def friction_after(seconds: float, **coefficients: float) -> tuple[np.ndarray, float]:
    params = extended(**coefficients)
    run = Plant(params, 30.0)
    for tick in range(round(seconds * 1000)):
        plant.advance(run.state, run.delay, np.zeros(4), np.nan, tick, params)
        plant.observe(run.state, params)
    return run.state.friction_degraded / params.law.mu_cd, run.state.time[0]


def test_sand_behind_the_first_wheelset_leaves_that_one_as_it_is() -> None:
    found, _ = friction_after(0.5, sanding_gain=0.2, sanding_start_s=0.1, sanding_duration_s=5.0,
                              sanding_behind=1.0)
    assert found == pytest.approx([1.0, *[np.exp(0.2)] * 3])


def test_an_empirical_term_is_felt_as_its_formula_says() -> None:
    found, time_s = friction_after(0.5, empirical_covariate=2.0, empirical_linear=0.1,
                                   empirical_quadratic=-0.05, empirical_centre=1.0,
                                   empirical_scale=2.0)
    z = (time_s - 1.0) / 2.0
    assert np.log(found) == pytest.approx(np.full(4, 0.1 * z - 0.05 * z * z), abs=2e-4)
    wave, time_s = friction_after(0.5, empirical_covariate=2.0, empirical_linear=0.1,
                                  empirical_period=4.0)
    assert np.log(wave) == pytest.approx(np.full(4, 0.1 * np.cos(np.pi * time_s / 2.0)), abs=2e-4)


def test_friction_follows_the_speed_on_a_bent_line_as_the_table_writes() -> None:
    found, _ = friction_after(0.2, speed_dependent_friction_slope_per_m_s=0.01,
                              speed_dependent_friction_knee_m_s=12.0)
    assert np.log(found[0]) == pytest.approx(0.12 * (1.0 - np.exp(-10.0 / 12.0)), rel=2e-3)
