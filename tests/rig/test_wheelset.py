"""Wheelset and roller: the force's sign, its slope, the damped stage, locking."""

from typing import NamedTuple

import numpy as np
import pytest
from rolling import FULL_BRAKE_PA, LEAVES, SOAP, TRACK, Rig

from rollerrig.configs.vehicle import ALLOWED_AXLES
from rollerrig.rig import wheelset
from rollerrig.rig.compiled import record_type
from rollerrig.rig.contact import adhesion

RIG = Rig(30.0, adhesion=SOAP).params
MU_CD = 0.06
MU_CR = 0.28
RADIUS_M = 0.445
INERTIA_KGM2 = 160.0
LOAD_N = 105e3
SLIDINGS_M_S = (1e-9, 1e-4, 0.01, 0.3, 3.0, 30.0)
near = pytest.approx


def force(sliding_m_s, surface_m_s=30.0, load_N=LOAD_N):
    """Return (contact force, secant slope, lambda_0) of a wheelset without adhesion memory."""
    return wheelset.contact_force(
        sliding_m_s,
        surface_m_s,
        load_N,
        MU_CD,
        MU_CR,
        RIG.patch,
        RIG.law,
        adhesion.NO_MEMORY,
        0.0,
    )


@pytest.mark.parametrize("sliding_m_s", SLIDINGS_M_S)
def test_the_force_opposes_sliding_equally_in_both_directions(sliding_m_s):
    braking_N, braking_slope, _ = force(sliding_m_s)
    driving_N, driving_slope, _ = force(-sliding_m_s)
    assert braking_N > 0.0
    assert driving_N == near(-braking_N, rel=1e-12)
    assert driving_slope == near(braking_slope, rel=1e-12)


@pytest.mark.parametrize("sliding_m_s", SLIDINGS_M_S)
def test_the_secant_slope_times_sliding_is_the_force(sliding_m_s):
    force_N, slope, _ = force(sliding_m_s)
    assert slope * sliding_m_s == near(force_N, rel=1e-12)


def test_without_sliding_or_load_there_is_no_force():
    force_N, _, _ = force(0.0)
    assert force_N == 0.0
    assert force(1.0, load_N=0.0) == (0.0, 0.0, 0.0)
    assert np.isfinite(force(0.0, surface_m_s=0.0)).all()
    assert np.isfinite(force(1e-300, surface_m_s=0.0)).all()


def test_both_wheels_of_a_wheelset_carry_half_its_load():
    f, *_ = adhesion.wheel_adhesion(0.3, 30.0, 0.5 * LOAD_N, RIG.patch, RIG.law)
    force_N, _, _ = force(0.3)
    assert force_N == near(f * LOAD_N, rel=1e-12)


class Adhesion(NamedTuple):
    """What `wheelset.wheelset_adhesion` returns."""

    f: float
    degraded: float
    recovered: float
    lambda_: float
    work_J_m: float
    slope: float


def adhesion_of(sliding_m_s, bound, surface_m_s=30.0, mu_cd=MU_CD, sliding_bound_m_s=np.inf):
    """Return the adhesion of a wheelset; `bound` is the creepage up to which sliding cleans."""
    law = RIG.law._replace(cleaning_creepage=bound, cleaning_sliding_m_s=sliding_bound_m_s)
    return Adhesion(
        *wheelset.wheelset_adhesion(sliding_m_s, surface_m_s, LOAD_N, mu_cd, MU_CR, RIG.patch, law)
    )


@pytest.mark.parametrize("sliding_m_s", [0.0, 1e-6, 0.3, 5.9, 14.9, -14.9])
def test_cleaning_follows_the_paper_to_the_bit_up_to_its_creepage(sliding_m_s):
    assert adhesion_of(sliding_m_s, bound=0.5) == adhesion_of(sliding_m_s, bound=np.inf)


@pytest.mark.parametrize("surface_m_s", [2.0, 10.0, 20.0, 40.0])
def test_both_limits_together_are_their_harmonic_mean(surface_m_s):
    limits = {"surface_m_s": surface_m_s, "bound": 0.55, "sliding_bound_m_s": 8.0}
    begin_m_s = 1.0 / (1.0 / (0.55 * surface_m_s) + 1.0 / 8.0)
    paper = {"surface_m_s": surface_m_s, "bound": np.inf}
    before = 0.999 * begin_m_s
    beyond = begin_m_s + 0.05 * surface_m_s
    assert adhesion_of(before, **limits) == adhesion_of(before, **paper)
    assert adhesion_of(beyond, **limits).f < adhesion_of(beyond, **paper).f


# down to standstill, where creepage has a floor
@pytest.mark.parametrize("bound", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("sliding_bound_m_s", [8.0, np.inf])
@pytest.mark.parametrize("surface_m_s", [30.0, 3.0, 0.05, 1e-3, 0.0])
def test_a_locked_wheel_does_not_clean(surface_m_s, bound, sliding_bound_m_s):
    paper = adhesion_of(surface_m_s, np.inf, surface_m_s)
    locked = adhesion_of(surface_m_s, bound, surface_m_s, sliding_bound_m_s=sliding_bound_m_s)
    assert locked.degraded == paper.degraded
    assert locked.recovered == paper.recovered
    assert locked.f == near(paper.degraded, rel=1e-12)
    assert locked.lambda_ == 0.0


def test_by_the_papers_law_a_locked_wheel_recovers():
    assert adhesion_of(30.0, np.inf).f > 0.25
    assert adhesion_of(30.0, 1.0) == adhesion_of(30.0, np.inf)


def test_cleaning_fades_without_a_step_and_its_slope_is_the_derivative():
    sliding_m_s = np.linspace(12.0, 31.0, 400)
    points = [adhesion_of(sliding, 0.5, mu_cd=0.03) for sliding in sliding_m_s]
    f = np.array([point.f for point in points])
    slope = np.array([point.slope for point in points])
    assert np.all(np.diff(f[sliding_m_s > 21.0]) <= 0.0)
    assert np.abs(np.diff(slope)).max() < 2e-3

    # away from the ends, and from the kinks of the slope where the fading begins and ends
    smooth = (np.abs(sliding_m_s - 15.0) > 0.1) & (np.abs(sliding_m_s - 30.0) > 0.1)
    smooth[[0, -1]] = False
    expected = np.gradient(f, sliding_m_s)
    np.testing.assert_allclose(slope[smooth], expected[smooth], atol=2e-4)


def test_a_locked_wheelset_stays_locked_on_soap_and_has_only_the_degraded_adhesion():
    rig = Rig(40.0, adhesion=SOAP, rig=TRACK)
    rig.state.wheel_speed[:] = 0.0
    rig.charge(FULL_BRAKE_PA)
    run = rig.roll(40.0)
    fast = run.vehicle_speed > 5.0
    assert (run.wheel_speed[fast] == 0.0).all()
    assert run.adhesion[fast].max() < 0.11
    fast[0] = False  # nothing is observed before the first tick
    np.testing.assert_allclose(run.adhesion[fast], run.adhesion_degraded[fast], rtol=1e-9)


BRAKE_NM = 2000.0


def accelerated(wheel_rad_s, contact_N):
    """Return (acceleration, acting brake torque, locked) of the first wheelset."""
    per_inertia = 1.0 / INERTIA_KGM2
    return wheelset.wheel_acceleration(wheel_rad_s, contact_N, BRAKE_NM, 0.0, RADIUS_M, per_inertia)


def test_the_wheelset_accelerates_by_contact_less_brake():
    rate_rad_s2, brake_Nm, locked = accelerated(60.0, contact_N=10e3)
    assert not locked
    assert brake_Nm == BRAKE_NM
    assert rate_rad_s2 == near((RADIUS_M * 10e3 - BRAKE_NM) / INERTIA_KGM2)


def test_a_wheel_at_rest_stays_locked_until_the_contact_overcomes_the_brake():
    assert accelerated(0.0, contact_N=4000.0) == (0.0, RADIUS_M * 4000.0, True)

    rate_rad_s2, brake_Nm, locked = accelerated(0.0, contact_N=5000.0)
    assert not locked
    assert brake_Nm == BRAKE_NM
    assert rate_rad_s2 == near((RADIUS_M * 5000.0 - BRAKE_NM) / INERTIA_KGM2)

    # nothing pulls it backwards
    assert accelerated(0.0, contact_N=-500.0) == (0.0, 0.0, True)


@pytest.mark.parametrize("locked", [False, True])
@pytest.mark.parametrize("on_track", [False, True])
def test_a_stage_solves_its_linear_system(locked, on_track):
    step_s = 1e-4
    slope_N_s_m = 5e6
    roller_m = RIG.drive.roller_radius_m
    explicit = np.array([-3.0, 2.0])  # slopes of wheel and roller without the implicit part

    # effect of 1 N on wheel and roller, and the force by 1 rad/s of each
    per_N = np.array([RADIUS_M / INERTIA_KGM2, -roller_m / RIG.drive.roller_inertia_kgm2])
    if locked:
        per_N[0] = 0.0
    if on_track:
        per_N[1] = 0.0
    wheel_k, roller_k, added_N = wheelset.implicit_slopes(
        *explicit, slope_N_s_m, *per_N, RADIUS_M, roller_m, step_s
    )
    slopes = np.array([wheel_k, roller_k])
    per_rad_s = slope_N_s_m * np.array([-RADIUS_M, roller_m])
    gamma = 1.0 - 1.0 / np.sqrt(2.0)
    system = np.eye(2) - gamma * step_s * np.outer(per_N, per_rad_s)
    np.testing.assert_allclose(slopes, np.linalg.solve(system, explicit), rtol=1e-12)
    np.testing.assert_allclose(explicit + per_N * added_N, slopes, rtol=1e-12)


def test_a_braked_wheel_without_adhesion_stops_when_the_brake_has_taken_its_momentum():
    rig = Rig(30.0, adhesion={"mu_cd": 1e-4, "mu_cr": 1e-4, "A_d": 1.0, "A_r": 1.0})
    rig.charge(2e5)
    run = rig.roll(3.5, demand_Pa=2e5)
    torque_Nm = run.brake_torque[1, 0]
    momentum_Nms = INERTIA_KGM2 * 30.0 / RADIUS_M
    expected_s = momentum_Nms / torque_Nm
    stopped_s = run.time[np.argmax(run.wheel_speed == 0.0, axis=0)]
    np.testing.assert_allclose(stopped_s, expected_s, rtol=5e-3)


def test_a_lock_is_counted_only_while_the_vehicle_runs_above_the_limit():
    rig = Rig(10.0, adhesion={"mu_cd": 0.01, "tau_m_J": 0.0}, rig={"lock_above_m_s": 5.0})
    run = rig.roll(60.0)
    locked = (run.wheel_circumferential_speed < 0.1) & (run.vehicle_speed > 5.0)[:, None]
    assert locked.any(axis=0).all()
    np.testing.assert_allclose(run.longest_lock[-1], locked.sum(axis=0) * 1e-3, atol=2e-3)
    assert (run.locked_since[-1] == 0.0).all()


@pytest.mark.parametrize("axles", ALLOWED_AXLES)
@pytest.mark.parametrize("mode", ["track", "contaminated_rollers"])
def test_throughout_a_stop_the_contacts_have_the_force_of_the_exact_law(axles, mode):
    vehicle = {"axles": axles, "bogies_per_body": 1, "mass_kg": 10.8e3 * axles}
    rig = Rig(8.0, adhesion=LEAVES, rig={"mode": mode}, vehicle=vehicle)
    rig.charge(FULL_BRAKE_PA)
    state = rig.state
    plants = record_type.table([rig.params])
    followed = 0
    has_locked = False
    for _ in range(100):
        rig.roll(0.05)
        if state.standing[0]:
            break
        exact = [
            wheelset.exact_slope(state, j, adhesion.NO_MEMORY, rig.params)[0] for j in range(axles)
        ]
        np.testing.assert_allclose(state.stage_slope, exact, rtol=1e-9)
        followed += int(state.is_solved.sum())

        # the work that a campaign computes of all rigs together is the observed one
        observed_J_m = state.dissipated_energy.copy()
        wheelset.observe_work(state, plants)
        np.testing.assert_allclose(state.dissipated_energy, observed_J_m, rtol=1e-8, atol=1e-9)
        has_locked |= state.wheel_speed.min() == 0.0
    assert has_locked
    # nearly all contacts are in the domain of the fast form
    assert followed > 50 * axles
