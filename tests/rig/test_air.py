"""The coach's air: closed balance, choked flow as in ISO 6358, weak brakes without air."""

import math

import numpy as np
import pytest
from rolling import FILL, FULL_BRAKE_PA, HOLD, VENT, Rig

from rollerrig.rig import brake
from rollerrig.rig.lanes import layout

NORMAL_PA = 101325.0
PULSES = np.repeat([[FILL] * 4, [VENT, VENT, HOLD, FILL]], 250, axis=0)


def coach(reservoir_volume_L=125.0, **air):
    return Rig(30.0, air={"reservoir_volume_L": reservoir_volume_L, **air})


@pytest.mark.parametrize("supply", [{}, {"supply_pressure_Pa": 5.0e5, "supply_NL_s_bar": 2.0}])
def test_the_cylinders_use_the_air_that_the_reservoir_lost_and_the_supply_gave(supply):
    rig = coach(**supply)
    run = rig.roll(15.0, np.tile(PULSES, (30, 1)))
    lost_NL = -125.0 * run.change("reservoir_pressure") / NORMAL_PA
    assert run.change("air_consumption") > 100.0
    assert (run.change("air_supplied") > 1.0) == bool(supply)
    assert lost_NL + run.change("air_supplied") == pytest.approx(
        run.change("air_consumption"), rel=1e-9
    )
    # the consumption is the air that flowed into the cylinders, so it follows from the rises of
    # pressure
    rises = np.maximum(np.diff(run.cylinder_pressure, axis=0), 0.0).sum()
    assert run.change("air_consumption") == pytest.approx(4.0 * rises / NORMAL_PA, rel=1e-3)


def test_flow_is_choked_below_the_critical_ratio_and_ends_at_equal_pressure():
    conductance = 1.6e-4
    b = 0.5
    choked = [
        brake.flow(4e5, to, conductance, b)
        for to in (0.0, 5e4, 0.5 * (4e5 + NORMAL_PA) - NORMAL_PA)
    ]
    assert choked == pytest.approx([conductance * (4e5 + NORMAL_PA)] * 3, rel=1e-12)
    falling = [brake.flow(4e5, to, conductance, b) for to in np.linspace(2e5, 4e5, 50)]
    assert (np.diff(falling) < 0.0).all()
    assert falling[-1] == brake.flow(3e5, 4e5, conductance, b) == 0.0


def test_venting_a_full_cylinder_takes_longer_than_an_emptier_one_and_follows_choked_flow():
    times_s = []
    for pressure_Pa in (3.8e5, 2.0e5):
        rig = coach()
        rig.state.cylinder_pressure[:] = rig.state.brake_demand[:] = pressure_Pa
        rig.roll(0.05, VENT)
        run = rig.roll(1.5, VENT)
        p = run.cylinder_pressure[:, 0] + NORMAL_PA
        choked = p > NORMAL_PA / 0.5
        rate_1_s = rig.params.brake.air.vent * NORMAL_PA / 4.0
        # a volume that empties through a choke falls exponentially, in absolute pressure
        expected = p[0] * np.exp(-rate_1_s * (run.time - run.time[0]))
        np.testing.assert_allclose(p[choked], expected[choked], rtol=2e-4)
        assert run.cylinder_pressure[-1].max() < 1.0
        times_s.append(run.time[np.argmax(run.cylinder_pressure[:, 0] < 0.4e5)] - run.time[0])
    assert times_s[0] > times_s[1] + 0.03


def test_a_small_reservoir_and_the_cylinders_end_at_one_pressure_below_the_demand():
    rig = coach(reservoir_volume_L=20.0)
    run = rig.roll(15.0)
    # 20 L at 5 bar into four times 4 L, one temperature
    common_Pa = 5.0e5 * 20.0 / 36.0
    assert common_Pa < FULL_BRAKE_PA
    assert run.reservoir_pressure[-1] == pytest.approx(common_Pa, rel=1e-3)
    np.testing.assert_allclose(run.cylinder_pressure[-1], common_Pa, rtol=1e-3)
    assert run.reservoir_least[-1] == run.reservoir_pressure.min()


def test_pulses_of_a_protection_empty_the_reservoir_and_weaken_the_brake():
    rig = coach(reservoir_volume_L=60.0)
    run = rig.roll(15.0, np.tile(PULSES, (30, 1)))
    full_Pa = run.cylinder_pressure[:4000, 0].max()
    late_Pa = run.cylinder_pressure[-2500:, 0].max()
    assert late_Pa < 0.6 * full_Pa
    assert run.brake_torque[-2500:, 0].max() < 0.6 * run.brake_torque[:4000, 0].max()


def test_without_a_reservoir_its_pressure_and_supply_stay_0():
    run = Rig(30.0).roll(2.0)
    assert (run.reservoir_pressure == 0.0).all()
    assert run.change("air_supplied") == 0.0


def test_a_huge_reservoir_gives_the_same_demand_and_the_lanes_do_not_accept_such_stops():
    rig = coach(reservoir_volume_L=1e5)
    assert not layout.fits(rig.params)
    assert layout.fits(Rig(30.0).params)
    run = rig.roll(10.0)
    assert run.cylinder_pressure[-1].min() > 0.99 * FULL_BRAKE_PA
    assert run.reservoir_pressure[-1] == pytest.approx(5.0e5, rel=1e-3)


@pytest.mark.parametrize(
    ("weighed_mass_kg", "share"), [(0.0, 1.0), (43000.0, 1.0), (5.0e4, 0.86), (2.0e5, 0.6)]
)
def test_a_weighing_valve_gives_light_vehicles_less_pressure_in_proportion_down_to_its_least(
    weighed_mass_kg, share
):
    run = Rig(30.0, air={"weighed_mass_kg": weighed_mass_kg}).roll(12.0)
    plain = Rig(30.0).roll(12.0)
    assert run.brake_demand[-1] == pytest.approx(share * plain.brake_demand[-1], rel=1e-12)
    if share == 1.0:
        assert np.array_equal(run.cylinder_pressure, plain.cylinder_pressure)
    assert math.isclose(
        run.cylinder_pressure[-1, 0], share * plain.cylinder_pressure[-1, 0], rel_tol=1e-9
    )
