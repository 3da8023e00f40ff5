"""Couplers and the brake pipe of a train: the laws of their forms, and messages for bad curves."""

import numpy as np
import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.train import coupler, motion, pipe

DRAW = {"draw_displacement_m": [0.02, 0.06], "draw_force_N": [20e3, 300e3]}
BUFF = {"buff_displacement_m": [0.05, 0.1], "buff_force_N": [200e3, 1e6]}
FORM = pipe.Form(
    speed_m_s=250.0,
    time_constant_s=0.5,
    time_constant_s_m=0.005,
    release_factor=3.0,
    pressure_Pa=5e5,
    full_reduction_Pa=1.5e5,
    full_demand_Pa=3.8e5,
)
TICK_S = 1e-3


def built(**more):
    return coupler.build([coupler.check({**DRAW, **BUFF, **more}, "test")])


def force_N(displacement_m, rate_m_s, couplers):
    return coupler.force(displacement_m, rate_m_s, couplers, 0)[0]


def test_a_coupler_has_the_force_of_its_curves_and_none_within_its_slack():
    couplers = built(draw_slack_m=0.01, buff_slack_m=0.02)
    assert force_N(0.01, 0.0, couplers) == 0.0
    assert force_N(-0.02, 0.0, couplers) == 0.0
    assert force_N(0.01 + 0.02, 0.0, couplers) == pytest.approx(20e3)
    assert force_N(0.01 + 0.04, 0.0, couplers) == pytest.approx(160e3)
    assert force_N(-0.02 - 0.1, 0.0, couplers) == pytest.approx(-1e6)
    # behind the last point the last slope goes on
    assert force_N(0.01 + 0.10, 0.0, couplers) == pytest.approx(300e3 + 0.04 * 7e6)


def test_a_gear_gives_back_its_share_of_the_force_and_takes_in_work_in_each_cycle():
    couplers = built(draw_return=0.4, buff_return=0.4, damping_N_s_m=1000.0)
    loading = force_N(0.05, 0.1, couplers) - 100.0
    unloading = force_N(0.05, -0.1, couplers) + 100.0
    assert unloading == pytest.approx(0.4 * loading)

    time_s = np.linspace(0.0, 2.0, 20001)
    x = 0.08 * np.sin(2.0 * np.pi * time_s)
    rate = np.gradient(x, time_s)
    F = np.array([force_N(*at, couplers) for at in zip(x, rate, strict=True)])
    work_J = np.cumsum(F * rate) * (time_s[1] - time_s[0])
    assert work_J[-1] > 0.0
    assert np.all(F * x >= 0.0)  # a draw gear only pulls, buffers only push


def test_the_stored_energy_is_the_work_of_an_elastic_coupler():
    couplers = built()
    x = np.linspace(0.0, 0.09, 9001)
    for sign in (1.0, -1.0):
        F = np.array([force_N(sign * one, 0.0, couplers) for one in x])
        work_J = np.trapezoid(F, sign * x)
        assert coupler.stored(sign * 0.09, couplers, 0) == pytest.approx(work_J, rel=1e-6)


def test_the_slopes_of_a_coupler_are_those_of_its_force():
    couplers = built(draw_return=0.5, buff_return=0.5, damping_N_s_m=2000.0)
    for x, w in ((0.03, 0.005), (0.03, 0.1), (-0.07, -0.004), (-0.07, 0.2)):
        _, stiffness, damping = coupler.force(x, w, couplers, 0)
        by_x = (force_N(x + 1e-7, w, couplers) - force_N(x - 1e-7, w, couplers)) / 2e-7
        by_w = (force_N(x, w + 1e-7, couplers) - force_N(x, w - 1e-7, couplers)) / 2e-7
        assert stiffness == pytest.approx(by_x, rel=1e-6)
        assert damping == pytest.approx(by_w, rel=1e-6)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({**DRAW}, "buff_displacement_m has 0 numbers"),
        ({**DRAW, **BUFF, "draw_force_N": [1.0]}, "the same number in both"),
        ({**DRAW, **BUFF, "buff_displacement_m": [0.1, 0.05]}, "must rise from point to point"),
        ({**DRAW, "kind": "rigid"}, "remove the curve"),
        ({"kind": "soft"}, "Allowed: gear, rigid"),
        ({**DRAW, **BUFF, "slack": 1.0}, "unknown key 'slack'"),
    ],
)
def test_a_bad_coupler_is_refused_with_place_and_remedy(given, message):
    with pytest.raises(ConfigError, match=message) as caught:
        coupler.check(given, "my.toml [coupler]")
    assert "my.toml [coupler]" in str(caught.value)


def test_every_packaged_coupler_loads_and_never_gives_more_than_it_took():
    names = store.names("couplers")
    assert {"screw", "screw_freight", "automatic", "rigid"} <= set(names)
    for name in names:
        checked = coupler.check(store.load("couplers", name)[0]["coupler"], name)
        assert checked["draw_return"] <= 1.0
        assert checked["buff_return"] <= 1.0


def test_cars_with_the_same_number_of_axles_share_a_buffer_as_far_as_it_has_room():
    assert motion.groups([4] * 10).tolist() == [[0, 6], [6, 4]]
    assert motion.groups([4, 8, 8, 4]).tolist() == [[0, 1], [1, 2], [3, 1]]


def demands_Pa(train_pipe, car, until_s):
    steps = np.arange(round(until_s / TICK_S)) * TICK_S
    return np.array([pipe.advance(train_pipe, car, time_s) for time_s in steps])


def test_the_pipe_brakes_the_rear_later_and_more_slowly():
    full = pipe.Valve(1.0, 0.0, 3.5e5, False)
    places_m = [5.0, 250.0]
    made = pipe.build(FORM, places_m, [full], [False, False], TICK_S)
    front, rear = (demands_Pa(made, car, 12.0) for car in (0, 1))
    begins_s = [np.flatnonzero(one)[0] * TICK_S for one in (front, rear)]
    assert begins_s == pytest.approx([1.02, 2.0], abs=1.5 * TICK_S)
    # 63 % of the demand after the lag
    lags_s = [np.argmax(one > 0.632 * 3.8e5) * TICK_S for one in (front, rear)]
    assert lags_s[0] - begins_s[0] == pytest.approx(0.5 + 0.005 * 5.0, rel=0.01)
    assert lags_s[1] - begins_s[1] == pytest.approx(0.5 + 0.005 * 250.0, rel=0.01)
    assert rear[-1] == pytest.approx(3.8e5, rel=1e-2)


def test_an_emergency_valve_in_the_middle_brakes_both_ends_and_is_not_released():
    valves = [pipe.Valve(0.0, 100.0, 0.0, True), pipe.Valve(1.0, 0.0, 5e5, False)]
    made = pipe.build(FORM, [0.0, 100.0, 200.0], valves, [False, False, True], TICK_S)
    front, middle, isolated = (demands_Pa(made, car, 12.0) for car in range(3))
    assert np.flatnonzero(front)[0] * TICK_S == pytest.approx(0.4, abs=1.5 * TICK_S)
    assert np.flatnonzero(middle)[0] == 0
    assert front[-1] == middle[-1] == 3.8e5
    assert np.all(isolated == 0.0)
