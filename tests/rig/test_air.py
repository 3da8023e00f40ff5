"""The coach's air: closed balance, choked flow as in ISO 6358, weak brakes without air."""

import math

import numpy as np
import pytest
from rolling import FILL, FULL_BRAKE_PA, HOLD, VENT, Rig

from rollerrig.rig import brake

NORMAL_PA = 101325.0
RESERVOIR_L = 125.0
CYLINDER_L = 4.0
# magnets of half a second: 250 ms of filling, then 250 ms of venting, holding and filling
PULSE = np.repeat(
    [
        [FILL, FILL, FILL, FILL],
        [VENT, VENT, HOLD, FILL],
    ],
    250,
    axis=0,
)


def pulses(seconds):
    """Return magnets (ticks, 4) of repeated pulses."""
    return np.tile(PULSE, (round(2 * seconds), 1))


def coach(reservoir_volume_L=RESERVOIR_L, **air):
    return Rig(30.0, air={"reservoir_volume_L": reservoir_volume_L, **air})


@pytest.mark.parametrize("supply", [{}, {"supply_pressure_Pa": 5.0e5, "supply_NL_s_bar": 2.0}])
def test_the_cylinders_use_the_air_that_the_reservoir_lost_and_the_supply_gave(supply):
    rig = coach(**supply)
    run = rig.roll(15.0, pulses(15.0))
    used_NL = run.change("air_consumption")
    supplied_NL = run.change("air_supplied")
    lost_NL = -RESERVOIR_L * run.change("reservoir_pressure") / NORMAL_PA
    assert used_NL > 100.0
    assert (supplied_NL > 1.0) == bool(supply)
    assert lost_NL + supplied_NL == pytest.approx(used_NL, rel=1e-9)
    # the consumption is the air that flowed into the cylinders, so it follows from the rises of
    # pressure
    rises_Pa = np.maximum(np.diff(run.cylinder_pressure, axis=0), 0.0).sum()
    assert used_NL == pytest.approx(CYLINDER_L * rises_Pa / NORMAL_PA, rel=1e-3)


def test_flow_is_choked_below_the_critical_ratio_and_ends_at_equal_pressure():
    conductance = 1.6e-4
    critical_ratio = 0.5
    from_Pa = 4e5
    from_absolute_Pa = from_Pa + NORMAL_PA
    critical_Pa = critical_ratio * from_absolute_Pa - NORMAL_PA

    def flow(to_Pa):
        return brake.flow(from_Pa, to_Pa, conductance, critical_ratio)

    for to_Pa in (0.0, 5e4, critical_Pa):
        assert flow(to_Pa) == pytest.approx(conductance * from_absolute_Pa, rel=1e-12)
    falling = [flow(to_Pa) for to_Pa in np.linspace(2e5, from_Pa, 50)]
    assert (np.diff(falling) < 0.0).all()
    assert flow(from_Pa) == 0.0
    # nothing flows back
    assert brake.flow(3e5, from_Pa, conductance, critical_ratio) == 0.0


def test_venting_a_full_cylinder_takes_longer_than_an_emptier_one_and_follows_choked_flow():
    times_s = []
    for pressure_Pa in (3.8e5, 2.0e5):
        rig = coach()
        rig.charge(pressure_Pa)
        rig.roll(0.05, VENT)
        run = rig.roll(1.5, VENT)
        time_s = run.time - run.time[0]
        cylinder_Pa = run.cylinder_pressure[:, 0]

        # a volume that empties through a choke falls exponentially, in absolute pressure
        absolute_Pa = cylinder_Pa + NORMAL_PA
        rate_1_s = rig.params.brake.air.vent * NORMAL_PA / CYLINDER_L
        expected_Pa = absolute_Pa[0] * np.exp(-rate_1_s * time_s)
        choked = absolute_Pa > NORMAL_PA / 0.5
        np.testing.assert_allclose(absolute_Pa[choked], expected_Pa[choked], rtol=2e-4)

        assert run.cylinder_pressure[-1].max() < 1.0
        times_s.append(time_s[np.argmax(cylinder_Pa < 0.4e5)])
    full_s, emptier_s = times_s
    assert full_s > emptier_s + 0.03


def test_a_small_reservoir_and_the_cylinders_end_at_one_pressure_below_the_demand():
    rig = coach(reservoir_volume_L=20.0)
    run = rig.roll(15.0)
    # 20 L at 5 bar into four cylinders, at one temperature
    common_Pa = 5.0e5 * 20.0 / (20.0 + 4 * CYLINDER_L)
    assert common_Pa < FULL_BRAKE_PA
    assert run.reservoir_pressure[-1] == pytest.approx(common_Pa, rel=1e-3)
    np.testing.assert_allclose(run.cylinder_pressure[-1], common_Pa, rtol=1e-3)
    assert run.reservoir_least[-1] == run.reservoir_pressure.min()


def test_pulses_of_a_protection_empty_the_reservoir_and_weaken_the_brake():
    rig = coach(reservoir_volume_L=60.0)
    run = rig.roll(15.0, pulses(15.0))
    early = slice(None, 4000)
    late = slice(-2500, None)
    pressure_Pa = run.cylinder_pressure[:, 0]
    torque_Nm = run.brake_torque[:, 0]
    assert pressure_Pa[late].max() < 0.6 * pressure_Pa[early].max()
    assert torque_Nm[late].max() < 0.6 * torque_Nm[early].max()


def test_without_a_reservoir_its_pressure_and_supply_stay_0():
    run = Rig(30.0).roll(2.0)
    assert (run.reservoir_pressure == 0.0).all()
    assert run.change("air_supplied") == 0.0


def test_a_huge_reservoir_gives_the_same_demand():
    rig = coach(reservoir_volume_L=1e5)
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
    end_Pa = run.cylinder_pressure[-1, 0]
    assert math.isclose(end_Pa, share * plain.cylinder_pressure[-1, 0], rel_tol=1e-9)
