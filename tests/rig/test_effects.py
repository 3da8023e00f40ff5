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
