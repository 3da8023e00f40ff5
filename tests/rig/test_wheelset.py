"""Wheelset and roller: the force's sign, its slope, the damped stage, locking."""

import numpy as np
import pytest
from rolling import FULL_BRAKE_PA, SOAP, TRACK, Rig

from rollerrig.rig import wheelset
from rollerrig.rig.contact import adhesion

RIG = Rig(30.0, adhesion=SOAP).params
LOAD_N = 105e3
SLIDINGS_M_S = (1e-9, 1e-4, 0.01, 0.3, 3.0, 30.0)
near = pytest.approx


def force(sliding_m_s, surface_m_s=30.0, load_N=LOAD_N):
    return wheelset.contact_force(
        sliding_m_s, surface_m_s, load_N, 0.06, 0.28, RIG.patch, RIG.law, adhesion.NO_MEMORY, 0.0
    )


@pytest.mark.parametrize("sliding_m_s", SLIDINGS_M_S)
def test_the_force_opposes_sliding_equally_in_both_directions(sliding_m_s):
    braking = force(sliding_m_s)
    driving = force(-sliding_m_s)
    assert braking[0] > 0.0
    assert driving[0] == near(-braking[0], rel=1e-12)
    assert driving[1] == near(braking[1], rel=1e-12)


@pytest.mark.parametrize("sliding_m_s", SLIDINGS_M_S)
def test_the_secant_slope_times_sliding_is_the_force(sliding_m_s):
    T, slope, _ = force(sliding_m_s)
    assert slope * sliding_m_s == near(T, rel=1e-12)


def test_without_sliding_or_load_there_is_no_force():
    assert force(0.0)[0] == 0.0
    assert force(1.0, load_N=0.0) == (0.0, 0.0, 0.0)
    assert np.isfinite(force(0.0, surface_m_s=0.0)).all()
    assert np.isfinite(force(1e-300, surface_m_s=0.0)).all()


def test_both_wheels_of_a_wheelset_carry_half_its_load():
    f = adhesion.wheel_adhesion(0.3, 30.0, 0.5 * LOAD_N, RIG.patch, RIG.law)[0]
    assert force(0.3)[0] == near(f * LOAD_N, rel=1e-12)


def test_cleaning_follows_the_paper_to_the_bit_up_to_its_creepage_and_is_none_at_a_locked_wheel():
    def creep(sliding_m_s, bound, surface_m_s=30.0):
        law = RIG.law._replace(cleaning_creepage=bound)
        return wheelset.wheelset_adhesion(
            sliding_m_s, surface_m_s, LOAD_N, 0.06, 0.28, RIG.patch, law
        )

    for sliding_m_s in (0.0, 1e-6, 0.3, 5.9, 14.9, -14.9):
        assert creep(sliding_m_s, 0.5) == creep(sliding_m_s, np.inf)
    # down to standstill, where creepage has a floor
    for surface_m_s in (30.0, 3.0, 0.05, 1e-3, 0.0):
        paper = creep(surface_m_s, np.inf, surface_m_s)
        locked = creep(surface_m_s, 0.5, surface_m_s)
        assert locked[1:3] == paper[1:3]
        assert locked[0] == near(paper[1], rel=1e-12)
        assert locked[3] == 0.0
    assert creep(30.0, np.inf)[0] > 0.25
    assert creep(30.0, 1.0) == creep(30.0, np.inf)


def test_cleaning_fades_without_a_step_and_its_slope_is_the_derivative():
    law = RIG.law._replace(cleaning_creepage=0.5)
    at = np.linspace(12.0, 31.0, 400)
    f = np.empty_like(at)
    slope = np.empty_like(at)
    for i, sliding_m_s in enumerate(at):
        f[i], _, _, _, _, slope[i] = wheelset.wheelset_adhesion(
            sliding_m_s, 30.0, LOAD_N, 0.03, 0.28, RIG.patch, law
        )
    assert np.all(np.diff(f[at > 21.0]) <= 0.0)
    # away from the kinks of the slope, where the fading begins and ends
    inside = np.abs(at[1:-1] - 15.0) > 0.1
    inside &= np.abs(at[1:-1] - 30.0) > 0.1
    np.testing.assert_allclose(slope[1:-1][inside], np.gradient(f, at)[1:-1][inside], atol=2e-4)
    assert np.abs(np.diff(slope)).max() < 2e-3


def test_a_locked_wheelset_stays_locked_on_soap_and_has_only_the_degraded_adhesion():
    rig = Rig(40.0, adhesion=SOAP, rig=TRACK)
    rig.state.wheel_speed[:] = 0.0
    rig.state.cylinder_pressure[:] = rig.state.brake_demand[:] = FULL_BRAKE_PA
    run = rig.roll(40.0)
    fast = run.vehicle_speed > 5.0
    assert (run.wheel_speed[fast] == 0.0).all()
    np.testing.assert_allclose(
        run.adhesion[1:][fast[1:]], run.adhesion_degraded[1:][fast[1:]], rtol=1e-9
    )
    assert run.adhesion[fast].max() < 0.11


def test_the_wheelset_accelerates_by_contact_less_brake():
    wheels = RIG.wheels
    rate, brake_Nm, locked = wheelset.wheel_acceleration(60.0, 10e3, 2000.0, 0, wheels)
    assert not locked
    assert brake_Nm == 2000.0
    assert rate == near((0.445 * 10e3 - 2000.0) / 160.0)


def test_a_wheel_at_rest_stays_locked_until_the_contact_overcomes_the_brake():
    wheels = RIG.wheels
    assert wheelset.wheel_acceleration(0.0, 4000.0, 2000.0, 0, wheels) == (
        0.0,
        0.445 * 4000.0,
        True,
    )
    rate, brake_Nm, locked = wheelset.wheel_acceleration(0.0, 5000.0, 2000.0, 0, wheels)
    assert not locked
    assert brake_Nm == 2000.0
    assert rate == near((0.445 * 5000.0 - 2000.0) / 160.0)
    # nothing pulls it backwards
    assert wheelset.wheel_acceleration(0.0, -500.0, 2000.0, 0, wheels) == (0.0, 0.0, True)


@pytest.mark.parametrize(("locked", "on_track"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_stage_solves_its_linear_system(locked, on_track):
    vehicle = RIG.vehicle
    drive = RIG.drive
    h = 1e-4
    g = 5e6
    r = vehicle.wheel_radius_m
    R = drive.roller_radius_m
    p = np.array(
        [
            0.0 if locked else r / vehicle.wheelset_inertia_kgm2,
            0.0 if on_track else -R / drive.roller_inertia_kgm2,
        ]
    )
    q = g * np.array([-r, R])
    gamma = 1.0 - 1.0 / np.sqrt(2.0)
    k = np.array([-3.0, 2.0])
    wheel_k, roller_k, added_N = wheelset.implicit_slopes(
        *k, g, bool(locked), bool(on_track), h, 0, RIG.wheels, drive
    )
    slopes = np.array([wheel_k, roller_k])
    expected = np.linalg.solve(np.eye(2) - gamma * h * np.outer(p, q), k)
    np.testing.assert_allclose(slopes, expected, rtol=1e-12)
    np.testing.assert_allclose(k + p * added_N, slopes, rtol=1e-12)


def test_a_braked_wheel_without_adhesion_stops_when_the_brake_has_taken_its_momentum():
    rig = Rig(30.0, adhesion={"mu_cd": 1e-4, "mu_cr": 1e-4, "A_d": 1.0, "A_r": 1.0})
    rig.state.cylinder_pressure[:] = rig.state.brake_demand[:] = 2e5
    run = rig.roll(3.5, demand_Pa=2e5)
    torque_Nm = run.brake_torque[1, 0]
    expected_s = 160.0 * (30.0 / 0.445) / torque_Nm
    stopped_s = run.time[np.argmax(run.wheel_speed == 0.0, axis=0)]
    np.testing.assert_allclose(stopped_s, expected_s, rtol=5e-3)


def test_a_lock_is_counted_only_while_the_vehicle_runs_above_the_limit():
    rig = Rig(10.0, adhesion={"mu_cd": 0.01, "tau_m_J": 0.0}, rig={"lock_above_m_s": 5.0})
    run = rig.roll(60.0)
    locked = (run.wheel_circumferential_speed < 0.1) & (run.vehicle_speed > 5.0)[:, None]
    assert locked.any(axis=0).all()
    np.testing.assert_allclose(run.longest_lock[-1], locked.sum(axis=0) * 1e-3, atol=2e-3)
    assert (run.locked_since[-1] == 0.0).all()
