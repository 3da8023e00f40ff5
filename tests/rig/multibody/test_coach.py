"""The coach in 3D: statics, energy, modes against matrices of its own, symmetry, stability, speed."""

import coach_energy
import numpy as np
import pytest
import scipy.linalg

from rollerrig.configs.table import read
from rollerrig.rig import params
from rollerrig.rig.multibody import coach, coordinates, links, motion, stability, stop

G = 9.80665


def _sections(vehicle=None, **multibody):
    found = {name: read(params.ROWS[name], {}, name) for name in ("contact", "adhesion")}
    found["vehicle"] = read(params.ROWS["vehicle"], vehicle or {}, "vehicle")
    found["multibody"] = read(params.ROWS["multibody"], multibody, "multibody")
    return found


def _law(**changes):
    return params.law_of({**_sections()["adhesion"], **changes})


COACH = coach.build(_sections())
SOAP = _law()
DRY = _law(mu_cd=0.28, k_ad=1.0, k_sd=0.4, gamma_d_s_m=0.6, tau_m_J=0.0)


HELD = 18  # coordinates of car and bogies


def stiffness(of: coach.Coach, move: float = 1e-6) -> np.ndarray:
    """Stiffness matrix (42, 42) of the suspension at rest, from its own forces."""
    matrix = np.zeros((42, 42))
    for column in range(42):
        for sign in (1.0, -1.0):
            q, force = np.zeros(42), np.zeros(42)
            q[column] = sign * move
            links.springs(q, force, of.springs)
            links.curves(q, np.zeros(42), force, of.curves)
            matrix[:, column] -= sign * force / (2.0 * move)
    return matrix


def modes(of: coach.Coach) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in Hz (18,), rising, and shapes (18, 18) of car and bogies, wheelsets held."""
    root = np.sqrt(of.inertia[:HELD])
    K = stiffness(of)[:HELD, :HELD] / np.outer(root, root)
    squares, shapes = np.linalg.eigh(0.5 * (K + K.T))
    return np.sqrt(np.maximum(squares, 0.0)) / (2.0 * np.pi), shapes / root[:, None]


def test_there_are_42_degrees_of_freedom_seven_bodies_of_six():
    assert (
        coordinates.BODIES * coordinates.PER_BODY
        == coordinates.COORDINATES
        == COACH.inertia.size
        == 42
    )
    assert "138 - 40 - 48 - 8 = 42" in coach.__doc__


def test_the_masses_sum_to_the_vehicles():
    assert COACH.mass_kg == pytest.approx(43000.0)
    assert COACH.weight_N.sum() == pytest.approx(43000.0 * G)


def test_static_wheel_loads_sum_to_the_weight():
    state = stop.rolling(COACH, 20.0)
    stop.advance(state, COACH, SOAP, 3.0)
    assert state.wheel_forces[:, 0].sum() == pytest.approx(43000.0 * G, rel=1e-6)
    # and each wheel carries its eighth
    np.testing.assert_allclose(state.wheel_forces[:, 0], 43000.0 * G / 8.0, rtol=1e-4)


def test_a_coach_set_down_too_high_settles_to_its_weight():
    state = stop.rolling(COACH, 20.0)
    state.q[2::6] += 2e-5
    stop.advance(state, COACH, SOAP, 20.0)
    assert state.wheel_forces[:, 0].sum() == pytest.approx(43000.0 * G, rel=1e-6)


def test_energy_is_balanced_in_a_stop():
    state = stop.rolling(COACH, 42.3)
    stop.advance(state, COACH, SOAP, 0.01)
    begin = coach_energy.held(state, COACH) + coach_energy.taken(state)
    kinetic = 0.5 * 43000.0 * 42.3**2
    taken = stop.advance(state, COACH, SOAP, 90.0, 6000.0, resistance=(600.0, 0.94), end_m_s=0.02)
    assert 20.0 < taken < 60.0
    assert abs(coach_energy.held(state, COACH) + coach_energy.taken(state) - begin) < 1e-3 * kinetic
    # and none of the ways by which energy leaves is idle
    assert min(state.sliding_work.min(), state.brake_work.min(), state.damper_work[0]) > 0.0


def test_energy_is_balanced_while_it_sways_and_hits_its_flanges():
    state = stop.rolling(COACH, 30.0)
    state.v[1::6] = 0.2
    stop.advance(state, COACH, DRY, 0.002)
    begin = coach_energy.held(state, COACH) + coach_energy.taken(state)
    stop.advance(state, COACH, DRY, 2.0)
    lateral = 0.5 * 43000.0 * 0.2**2
    assert abs(coach_energy.held(state, COACH) + coach_energy.taken(state) - begin) < 0.05 * lateral


def test_momentum_lost_is_what_contacts_took():
    state = stop.rolling(COACH, 30.0)
    before = motion.mean_speed(state.v, COACH)
    pulled = 0.0
    for _ in range(1000):
        stop.advance(state, COACH, SOAP, 1e-4, 5000.0)
        pulled += 1e-4 * state.wheelset_forces[:, 22].sum()
    assert 43000.0 * (before - motion.mean_speed(state.v, COACH)) == pytest.approx(pulled, rel=1e-6)


def _matrices():
    """Mass and stiffness of car and bogies on fixed wheelsets, from the printed tables alone.

    Coordinates x, y, z, roll, pitch, yaw of car, front bogie, rear bogie.
    """
    mass = np.diag(
        [29720.0] * 3
        + [76400.0, 1494400.0, 1467160.0]
        + 2 * ([3000.0] * 3 + [2400.0, 1900.0 + 4 * (12.0 + 4.0), 4000.0])
    )
    K = np.zeros((18, 18))

    def at(body, r):
        """Displacement of a point of a body over the 18 coordinates: u + theta x r."""
        D = np.zeros((3, 18))
        if body is not None:
            D[:, 6 * body : 6 * body + 3] = np.eye(3)
            x, y, z = r
            D[:, 6 * body + 3 : 6 * body + 6] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return D

    def spring(k, a, ra, b, rb):
        nonlocal K
        D = at(a, ra) - at(b, rb)
        K = K + D.T @ np.diag(k) @ D

    def torsion(k, a, b):
        row = np.zeros(18)
        row[6 * a + 3] = 1.0
        if b is not None:
            row[6 * b + 3] = -1.0
        return k * np.outer(row, row)

    for bogie, middle in ((1, 9.5), (2, -9.5)):
        for x in (1.28, -1.28):
            for y in (1.0, -1.0):
                spring((844e3, 844e3, 790e3), bogie, (x, y, 0.445 - 0.6), None, None)
                K = K + torsion(10700.0, bogie, None)
        for y in (1.0, -1.0):
            spring((124e3, 124e3, 340e3), 0, (middle, y, 0.9 - 1.8), bogie, (0.0, y, 0.9 - 0.6))
        K = K + torsion(2.5e6, 0, bogie)
        spring((5e6, 0.0, 0.0), 0, (middle, 0.0, 0.9 - 1.8), bogie, (0.0, 0.0, 0.9 - 0.6))
    return mass, K


def test_natural_modes_equal_those_of_matrices_built_from_the_tables():
    mass, K = _matrices()
    expected = np.sqrt(scipy.linalg.eigh(K, mass, eigvals_only=True)) / (2.0 * np.pi)
    found, _ = modes(COACH)
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_bounce_and_pitch_of_car_and_bogies_have_the_known_frequencies():
    # the car of Table 2 weighs 29 t where the coach weighs 42.28 t
    found, _ = modes(coach.build(_sections({"mass_kg": 42280.0})))
    assert np.abs(found - 0.985).min() < 0.01
    assert np.abs(found - 5.6).min() < 0.15


def _undamped():
    return coach.build(
        _sections(
            **{
                name: 0.0
                for name in (
                    "primary_damper_N_s_m",
                    "secondary_damper_N_s_m",
                    "lateral_damper_N_s_m",
                    "yaw_damper_N_s_m",
                    "traction_rod_damping_N_s_m",
                )
            }
        )
    )


def test_the_time_step_swings_with_the_frequency_of_the_mode():
    free = _undamped()
    frequencies, shapes = modes(free)
    bounce = np.abs(shapes[2]).argmax()
    state = stop.rolling(free, 20.0)
    state.q[:18] += 1e-3 * shapes[:, bounce] / np.abs(shapes[2, bounce])
    log = []
    for _ in range(800):
        stop.advance(state, free, SOAP, 0.005)
        log.append(state.q[2])
    log = np.array(log) - np.mean(log)
    crossings = np.flatnonzero(np.diff(np.sign(log)) > 0)
    exact = crossings - log[crossings] / (log[crossings + 1] - log[crossings])
    period = (exact[-1] - exact[0]) / (len(exact) - 1) * 0.005
    # the contacts are springs too, 0.3 % softer in series
    assert 1.0 / period == pytest.approx(frequencies[bounce], rel=0.01)


def test_a_mirrored_coach_does_the_mirrored_thing():
    mirror = np.tile([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], 7)
    kick = np.zeros(42)
    kick[1::6] = np.linspace(0.1, 0.3, 7)
    states = []
    for sign in (1.0, -1.0):
        state = stop.rolling(COACH, 25.0)
        state.v[:] += sign * kick
        stop.advance(state, COACH, DRY, 0.5, 2000.0)
        states.append(state)
    np.testing.assert_allclose(states[0].q, mirror * states[1].q, atol=1e-9)
    assert np.abs(states[0].q[1::6]).max() > 1e-3


def test_on_a_straight_track_nothing_goes_sideways_by_itself():
    state = stop.rolling(COACH, 42.0)
    stop.advance(state, COACH, SOAP, 2.0, 4000.0)
    for sideways in (1, 3, 5):
        assert np.abs(state.q[sideways::6]).max() < 1e-12


def test_braking_loads_the_leading_wheelsets_of_coach_and_bogies():
    state = stop.rolling(COACH, 30.0)
    stop.advance(state, COACH, DRY, 4.0, 4000.0)
    loads = state.wheel_forces[:, 0].reshape(4, 2).sum(1)
    deceleration = state.wheelset_forces[:, 22].sum() / 43000.0
    # planar transfer [V2, V3 of vehicle.py] with the coach's own masses and heights
    body = 29720.0 * (1.8 - 0.9) / 19.0 * deceleration
    bogie = (0.5 * 29720.0 * 0.9 + 3000.0 * 0.6 + 2.0 * 1820.0 * 0.445) / 2.56 * deceleration
    static = 43000.0 * G / 4.0
    expected = static + np.array(
        [0.5 * body + bogie, 0.5 * body - bogie, -0.5 * body + bogie, -0.5 * body - bogie]
    )
    np.testing.assert_allclose(loads, expected, rtol=0.01)


def test_halving_the_step_changes_the_stop_little():
    speeds = []
    for step in (2e-4, 1e-4, 5e-5):
        state = stop.rolling(COACH, 30.0)
        stop.advance(state, COACH, SOAP, 3.0, 6000.0, step_s=step)
        speeds.append(motion.mean_speed(state.v, COACH))
    assert abs(speeds[1] - speeds[2]) < 2e-4
    assert abs(speeds[1] - speeds[2]) < abs(speeds[0] - speeds[2])


def test_it_brakes_to_a_walk_and_stands_without_trembling():
    state = stop.rolling(COACH, 2.0)
    stop.advance(state, COACH, DRY, 10.0, 3000.0)
    assert np.abs(state.v).max() < 2e-3
    np.testing.assert_array_equal(np.abs(state.v[22::6]) < 1e-6, True)


@pytest.mark.parametrize(("bound", "low", "high"), [(0.5, 0.055, 0.065), (np.inf, 0.2, 0.28)])
def test_a_locked_wheel_of_the_coach_is_on_the_degraded_curve_or_by_the_papers_law_recovered(
    bound, low, high
):
    state = stop.rolling(COACH, 40.0)
    state.v[22::6] = 0.0
    stop.advance(state, COACH, _law(cleaning_creepage=bound), 2e-4, 1e6)
    assert (state.v[22::6] == 0.0).all()
    pull = np.abs(state.wheel_forces[:, 1]) / state.wheel_forces[:, 0]
    assert low < pull.min() <= pull.max() < high


def test_a_brake_stronger_than_the_adhesion_locks_the_wheel_and_releasing_it_frees_it():
    state = stop.rolling(COACH, 20.0)
    stop.advance(state, COACH, SOAP, 3.0, 30000.0)
    assert np.abs(state.v[22::6]).max() < 1e-12
    speed = motion.mean_speed(state.v, COACH)
    assert 5.0 < speed < 19.0
    stop.advance(state, COACH, SOAP, 3.0, 0.0)
    assert np.all(0.444 * state.v[22::6] > 0.95 * motion.mean_speed(state.v, COACH))


def test_lateral_motion_dies_away_at_42_m_s_on_straight_track():
    for law in (SOAP, DRY):
        assert stability.growth(COACH, law, 42.0) < -0.05


def test_a_speed_sweep_finds_where_hunting_begins():
    conical = coach.build(_sections(laying=1 / 40))
    found = stability.critical_speed(
        conical, SOAP, np.array([30.0, 45.0, 60.0, 75.0]), tolerance_m_s=2.0
    )
    assert 35.0 < found < 75.0
    assert stability.growth(conical, SOAP, 0.7 * found) < 0.0


def test_more_yaw_damping_raises_the_critical_speed():
    found = [
        stability.critical_speed(
            coach.build(_sections(laying=1 / 40, yaw_damper_N_s_m=damping, yaw_damper_max_N=2e4)),
            SOAP,
            np.array([20.0, 40.0, 60.0, 80.0]),
            2.0,
        )
        for damping in (0.0, 500e3)
    ]
    assert found[1] > found[0]


def test_the_rollers_of_a_rig_press_harder_and_brake_the_coach_too():
    on_rollers = coach.build(_sections(), roller_m=1.0)
    assert on_rollers.axle_height_m < 0.445
    state = stop.rolling(on_rollers, 20.0)
    touching = state.contacts[::4]
    rail = stop.rolling(COACH, 20.0).contacts[::4]
    np.testing.assert_allclose(touching[:, 12], rail[:, 12] + 1.0, rtol=1e-3)
