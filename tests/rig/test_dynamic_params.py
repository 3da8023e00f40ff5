"""The constants of a dynamic brake: the curve of a motor, and input that cannot work."""

import copy

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.rig import dynamic_brake, dynamic_params
from rollerrig.rig import params as physics

STEP_S = 1e-4
MOTORS = {"axles": [1, 2], "force_N": 12000.0, "corner_speed_m_s": 10.0, "fade_from_m_s": 3.0}


def sections(**values):
    """Return all checked sections of the coach with these values of the dynamic brake."""
    return physics.check({"dynamic_brake": MOTORS | values}, "my.toml")


def build(traction=(), **values):
    return dynamic_params.build(sections(**values), STEP_S, traction)


def braking_N(speed_m_s, brake):
    return dynamic_brake.curve_N(speed_m_s, brake.force_N, brake.brake_corner_speed_m_s)


def test_a_vehicle_without_driven_axles_has_no_dynamic_brake():
    assert not dynamic_params.build(physics.check({}, "my.toml"), STEP_S).acts


def test_a_motor_has_constant_force_up_to_the_corner_speed_and_constant_power_above():
    brake = build()
    for speed_m_s in (0.0, 5.0, 10.0):
        assert braking_N(speed_m_s, brake) == 12000.0
    for speed_m_s in (12.0, 30.0, 60.0):
        assert braking_N(speed_m_s, brake) * speed_m_s == pytest.approx(120e3)


@pytest.mark.parametrize("given", [{"brake_corner_speed_m_s": 20.0}, {"brake_power_W": 240e3}])
def test_the_brake_may_have_more_power_than_traction(given):
    brake = build(traction_force_N=9000.0, **given)
    assert braking_N(20.0, brake) == 12000.0
    assert braking_N(40.0, brake) * 40.0 == pytest.approx(240e3)
    # traction keeps its corner speed
    driving_N = dynamic_brake.curve_N(20.0, brake.traction_force_N, brake.corner_speed_m_s)
    assert driving_N * 20.0 == pytest.approx(90e3)


def test_the_brake_fades_out_between_two_speeds():
    brake = build(fade_to_m_s=1.0)
    shares = [dynamic_brake.fade_share(speed_m_s, brake) for speed_m_s in (0.5, 1.0, 2.0, 3.0, 9.0)]
    np.testing.assert_allclose(shares, [0.0, 0.0, 0.5, 1.0, 1.0])


def test_the_rate_of_the_force_is_limited():
    brake = build(force_rate_N_s=5000.0, time_constant_s=0.01)
    assert dynamic_brake.followed(0.0, 12000.0, brake) == pytest.approx(5000.0 * STEP_S)
    assert dynamic_brake.followed(0.0, -12000.0, brake) == pytest.approx(-5000.0 * STEP_S)


def test_the_axles_of_a_bogie_or_of_a_car_blend_together():
    np.testing.assert_array_equal(build(blending="bogie").blends_with, [0, 0, 1, 1])
    np.testing.assert_array_equal(build(blending="car").blends_with, [0, 0, 0, 0])
    two_cars = {"dynamic_brake": MOTORS | {"blending": "car"}, "vehicle": {"bogies_per_body": 1}}
    brake = dynamic_params.build(physics.check(two_cars, "my.toml"), STEP_S)
    np.testing.assert_array_equal(brake.blends_with, [0, 0, 1, 1])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"brake_corner_speed_m_s": 20.0, "brake_power_W": 240e3}, "keep one of them"),
        ({"force_N": 0.0}, "without a curve; give force_N and corner_speed_m_s"),
        ({"corner_speed_m_s": 0.0}, "without a curve; give force_N and corner_speed_m_s"),
        ({"axles": [1, 5]}, "the vehicle has 4 axles"),
        ({"axles": [2, 2]}, "list each driven axle once"),
        ({"axles": [1.5]}, "by its number from 1 to 4"),
        ({"fade_to_m_s": 3.0}, "is not below fade_from_m_s"),
    ],
)
def test_a_dynamic_brake_that_cannot_work_is_refused_with_the_remedy(values, message):
    with pytest.raises(ConfigError, match=message):
        build(**values)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [("vehicle", "model", "multibody"), ("rig", "mode", "virtual_track")],
)
def test_motors_are_refused_where_no_model_has_them(section, key, value):
    changed = copy.deepcopy(sections())
    changed[section][key] = value
    with pytest.raises(ConfigError, match=r"allowed is (vehicle.model|rig.mode)"):
        dynamic_params.build(changed, STEP_S)


def test_traction_needs_driven_axles_and_a_force():
    starts = [{"from_s": 0.0, "share": 1.0}]
    with pytest.raises(ConfigError, match="without driven axles"):
        build(starts, axles=[])
    with pytest.raises(ConfigError, match=r"give .* traction_force_N"):
        build(starts)
    assert build(starts, traction_force_N=9000.0).traction_share == [1.0]


def test_blending_is_refused_that_requests_more_than_both_brakes_have():
    # twice the force of the friction brake, whose pressure is limited
    friction_N_Pa = build().friction_N_Pa
    brake = build(demand_N_Pa=2.0 * friction_N_Pa)
    with pytest.raises(ConfigError, match=r"requests .* kN of axles 1 to 2, which have"):
        dynamic_params.check_blending(brake, largest_Pa=3.8e5, limit_Pa=3.8e5)
    # the motors of an axle give as much again
    strong = build(demand_N_Pa=2.0 * friction_N_Pa, blending="car", force_N=99e3)
    dynamic_params.check_blending(strong, largest_Pa=3.8e5, limit_Pa=3.8e5)
    dynamic_params.check_blending(build(), largest_Pa=3.8e5, limit_Pa=3.8e5)
