"""The coach in 3D: statics, energy, modes against independent matrices, symmetry, stability."""

import coach_energy
import numpy as np
import pytest
import scipy.linalg

from rollerrig.configs.table import read
from rollerrig.rig import params
from rollerrig.rig.contact import geometry
from rollerrig.rig.multibody import (
    coach,
    coordinates,
    links,
    motion,
    stability,
    stop,
    wheel_rail_forces,
)
from rollerrig.rig.multibody.coordinates import (
    BEFORE_WHEELSETS,
    COORDINATES,
    PER_BODY,
    PITCH,
    ROLL,
    YAW,
    Y,
    Z,
)

GRAVITY_M_S2 = 9.80665
MASS_KG = 43000.0
WEIGHT_N = MASS_KG * GRAVITY_M_S2
WHEELS = 8
WHEELSETS = 4

# places of one coordinate of all bodies, and of the rotation of all wheelsets
LATERAL = slice(Y, None, PER_BODY)
VERTICAL = slice(Z, None, PER_BODY)
ROTATION = slice(BEFORE_WHEELSETS + PITCH, None, PER_BODY)


def _sections(vehicle=None, **multibody):
    """Return the parameter sections of a coach with these changes."""
    return {
        "contact": read(params.ROWS["contact"], {}, "contact"),
        "adhesion": read(params.ROWS["adhesion"], {}, "adhesion"),
        "vehicle": read(params.ROWS["vehicle"], vehicle or {}, "vehicle"),
        "multibody": read(params.ROWS["multibody"], multibody, "multibody"),
    }


def _law(**changes):
    return params.law_of({**_sections()["adhesion"], **changes})


COACH = coach.build(_sections())
SOAP = _law()
DRY = _law(mu_cd=0.28, k_ad=1.0, k_sd=0.4, gamma_d_s_m=0.6, tau_m_J=0.0)


def wheel_loads_N(state):
    """Return the vertical load of each wheel, shape (8,)."""
    return state.wheel_forces[:, wheel_rail_forces.LOAD]


def braking_N(state):
    """Return the braking force of all wheelsets."""
    return state.wheelset_forces[:, wheel_rail_forces.BRAKING_N].sum()


def mean_speed_m_s(state):
    return motion.mean_speed(state.v, COACH)


# --- the modes of car and bogies ---


def stiffness(of: coach.Coach, move: float = 1e-6) -> np.ndarray:
    """Return the stiffness matrix (42, 42) of the suspension at rest, from its forces."""
    matrix = np.zeros((COORDINATES, COORDINATES))
    at_rest = np.zeros(COORDINATES)
    for column in range(COORDINATES):
        for sign in (1.0, -1.0):
            q = np.zeros(COORDINATES)
            q[column] = sign * move
            force = np.zeros(COORDINATES)
            links.springs(q, force, of.springs)
            links.curves(q, at_rest, force, of.curves)
            matrix[:, column] -= sign * force / (2.0 * move)
    return matrix


def modes(of: coach.Coach) -> tuple[np.ndarray, np.ndarray]:
    """Return the modes of car and bogies with fixed wheelsets.

    They are the frequencies in Hz (18,), rising, and the shapes (18, 18).
    """
    root = np.sqrt(of.inertia[:BEFORE_WHEELSETS])
    K = stiffness(of)[:BEFORE_WHEELSETS, :BEFORE_WHEELSETS] / np.outer(root, root)
    squares, shapes = np.linalg.eigh(0.5 * (K + K.T))
    frequencies_Hz = np.sqrt(np.maximum(squares, 0.0)) / (2.0 * np.pi)
    return frequencies_Hz, shapes / root[:, None]


# values of the paper's Tables 1 to 3
_CAR = 0
_BOGIES = ((1, 9.5), (2, -9.5))  # body, and the x of its middle
_CAR_HEIGHT_M = 1.8
_BOGIE_HEIGHT_M = 0.6
_AXLE_HEIGHT_M = 0.445
_SECONDARY_HEIGHT_M = 0.9


class _TableMatrices:
    """Mass and stiffness of car and bogies on fixed wheelsets, from the printed tables alone.

    Coordinates x, y, z, roll, pitch, yaw of car, front bogie, rear bogie.
    """

    def __init__(self):
        car = [29720.0] * 3 + [76400.0, 1494400.0, 1467160.0]
        # four axleboxes and four links pitch with a bogie frame
        pitch_kgm2 = 1900.0 + 4 * (12.0 + 4.0)
        bogie = [3000.0] * 3 + [2400.0, pitch_kgm2, 4000.0]
        self.mass = np.diag(car + bogie + bogie)
        self.stiffness = np.zeros((18, 18))
        for body, middle_m in _BOGIES:
            self._add_primary(body)
            self._add_secondary(body, middle_m)

    def _add_primary(self, bogie):
        up_m = _AXLE_HEIGHT_M - _BOGIE_HEIGHT_M
        for x_m in (1.28, -1.28):
            for y_m in (1.0, -1.0):
                at_bogie = self._displacement(bogie, (x_m, y_m, up_m))
                self._add_spring((844e3, 844e3, 790e3), at_bogie)
                self._add_torsion(10700.0, self._roll(bogie))

    def _add_secondary(self, bogie, middle_m):
        on_car_m = _SECONDARY_HEIGHT_M - _CAR_HEIGHT_M
        on_bogie_m = _SECONDARY_HEIGHT_M - _BOGIE_HEIGHT_M
        for y_m in (1.0, -1.0):
            at_car = self._displacement(_CAR, (middle_m, y_m, on_car_m))
            at_bogie = self._displacement(bogie, (0.0, y_m, on_bogie_m))
            self._add_spring((124e3, 124e3, 340e3), at_car - at_bogie)
        self._add_torsion(2.5e6, self._roll(_CAR) - self._roll(bogie))
        # the traction rod
        at_car = self._displacement(_CAR, (middle_m, 0.0, on_car_m))
        at_bogie = self._displacement(bogie, (0.0, 0.0, on_bogie_m))
        self._add_spring((5e6, 0.0, 0.0), at_car - at_bogie)

    def _displacement(self, body, place_m):
        """Return u + theta x r of a point of a body over the 18 coordinates, shape (3, 18)."""
        x, y, z = place_m
        first = PER_BODY * body
        matrix = np.zeros((3, 18))
        matrix[:, first : first + 3] = np.eye(3)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        matrix[:, first + 3 : first + 6] = -cross
        return matrix

    def _roll(self, body):
        row = np.zeros(18)
        row[PER_BODY * body + ROLL] = 1.0
        return row

    def _add_spring(self, stiffness_N_m, elongation):
        self.stiffness += elongation.T @ np.diag(stiffness_N_m) @ elongation

    def _add_torsion(self, stiffness_Nm_rad, twist):
        self.stiffness += stiffness_Nm_rad * np.outer(twist, twist)


def test_natural_modes_equal_those_of_matrices_built_from_the_tables():
    matrices = _TableMatrices()
    squares = scipy.linalg.eigh(matrices.stiffness, matrices.mass, eigvals_only=True)
    expected_Hz = np.sqrt(squares) / (2.0 * np.pi)
    frequencies_Hz, _ = modes(COACH)
    np.testing.assert_allclose(frequencies_Hz, expected_Hz, rtol=0.01)


def test_bounce_and_pitch_of_car_and_bogies_have_the_known_frequencies():
    # the car of Table 2 weighs 29 t where the coach weighs 42.28 t
    frequencies_Hz, _ = modes(coach.build(_sections({"mass_kg": 42280.0})))
    assert np.abs(frequencies_Hz - 0.985).min() < 0.01
    assert np.abs(frequencies_Hz - 5.6).min() < 0.15


def _undamped():
    return coach.build(
        _sections(
            primary_damper_N_s_m=0.0,
            secondary_damper_N_s_m=0.0,
            lateral_damper_N_s_m=0.0,
            yaw_damper_N_s_m=0.0,
            traction_rod_damping_N_s_m=0.0,
        )
    )


def test_the_time_step_swings_with_the_frequency_of_the_mode():
    free = _undamped()
    frequencies_Hz, shapes = modes(free)
    bounce = np.abs(shapes[Z]).argmax()
    state = stop.rolling(free, 20.0)
    state.q[:BEFORE_WHEELSETS] += 1e-3 * shapes[:, bounce] / np.abs(shapes[Z, bounce])

    sample_s = 0.005
    heights = []
    for _ in range(800):
        stop.advance(state, free, SOAP, sample_s)
        heights.append(state.q[Z])

    # the period from the upward crossings of the mean, interpolated between samples
    swing = np.array(heights) - np.mean(heights)
    before = np.flatnonzero(np.diff(np.sign(swing)) > 0)
    crossings = before - swing[before] / (swing[before + 1] - swing[before])
    period_s = (crossings[-1] - crossings[0]) / (len(crossings) - 1) * sample_s
    # the contacts are springs too, 0.3 % softer in series
    assert 1.0 / period_s == pytest.approx(frequencies_Hz[bounce], rel=0.01)


# --- statics ---


def test_there_are_42_degrees_of_freedom_seven_bodies_of_six():
    assert coordinates.BODIES * coordinates.PER_BODY == 42
    assert coordinates.COORDINATES == 42
    assert COACH.inertia.size == 42
    assert "138 - 40 - 48 - 8 = 42" in coach.__doc__


def test_the_masses_sum_to_the_vehicles():
    assert COACH.mass_kg == pytest.approx(MASS_KG)
    assert COACH.weight_N.sum() == pytest.approx(WEIGHT_N)


def test_static_wheel_loads_sum_to_the_weight():
    state = stop.rolling(COACH, 20.0)
    stop.advance(state, COACH, SOAP, 3.0)
    assert wheel_loads_N(state).sum() == pytest.approx(WEIGHT_N, rel=1e-6)
    # and each wheel carries its eighth
    np.testing.assert_allclose(wheel_loads_N(state), WEIGHT_N / WHEELS, rtol=1e-4)


def test_a_coach_set_down_too_high_settles_to_its_weight():
    state = stop.rolling(COACH, 20.0)
    state.q[VERTICAL] += 2e-5
    stop.advance(state, COACH, SOAP, 20.0)
    assert wheel_loads_N(state).sum() == pytest.approx(WEIGHT_N, rel=1e-6)


# --- energy and momentum ---


def test_energy_is_balanced_in_a_stop():
    speed_m_s = 42.3
    state = stop.rolling(COACH, speed_m_s)
    stop.advance(state, COACH, SOAP, 0.01)
    begin_J = coach_energy.total_J(state, COACH)
    duration_s = stop.advance(
        state,
        COACH,
        SOAP,
        90.0,
        brake_Nm=6000.0,
        resistance=(600.0, 0.94),
        end_m_s=0.02,
    )
    assert 20.0 < duration_s < 60.0
    kinetic_J = 0.5 * MASS_KG * speed_m_s**2
    assert abs(coach_energy.total_J(state, COACH) - begin_J) < 1e-3 * kinetic_J
    # every way by which energy leaves is in use
    assert state.sliding_work.min() > 0.0
    assert state.brake_work.min() > 0.0
    assert state.damper_work[0] > 0.0


def test_energy_is_balanced_while_it_sways_and_hits_its_flanges():
    lateral_m_s = 0.2
    state = stop.rolling(COACH, 30.0)
    state.v[LATERAL] = lateral_m_s
    stop.advance(state, COACH, DRY, 0.002)
    begin_J = coach_energy.total_J(state, COACH)
    stop.advance(state, COACH, DRY, 2.0)
    lateral_J = 0.5 * MASS_KG * lateral_m_s**2
    assert abs(coach_energy.total_J(state, COACH) - begin_J) < 0.05 * lateral_J


def test_momentum_lost_is_what_contacts_took():
    state = stop.rolling(COACH, 30.0)
    before_m_s = mean_speed_m_s(state)
    step_s = 1e-4
    pulled_Ns = 0.0
    for _ in range(1000):
        stop.advance(state, COACH, SOAP, step_s, brake_Nm=5000.0)
        pulled_Ns += step_s * braking_N(state)
    lost_Ns = MASS_KG * (before_m_s - mean_speed_m_s(state))
    assert lost_Ns == pytest.approx(pulled_Ns, rel=1e-6)


# --- symmetry ---


def test_a_mirrored_coach_makes_the_mirrored_motion():
    mirror = np.tile([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], coordinates.BODIES)
    kick = np.zeros(COORDINATES)
    kick[LATERAL] = np.linspace(0.1, 0.3, coordinates.BODIES)
    states = []
    for sign in (1.0, -1.0):
        state = stop.rolling(COACH, 25.0)
        state.v[:] += sign * kick
        stop.advance(state, COACH, DRY, 0.5, brake_Nm=2000.0)
        states.append(state)
    plain, mirrored = states
    np.testing.assert_allclose(plain.q, mirror * mirrored.q, atol=1e-9)
    assert np.abs(plain.q[LATERAL]).max() > 1e-3


def test_on_a_straight_track_nothing_goes_sideways_by_itself():
    state = stop.rolling(COACH, 42.0)
    stop.advance(state, COACH, SOAP, 2.0, brake_Nm=4000.0)
    for sideways in (Y, ROLL, YAW):
        assert np.abs(state.q[sideways::PER_BODY]).max() < 1e-12


# --- braking ---


def test_braking_loads_the_leading_wheelsets_of_coach_and_bogies():
    state = stop.rolling(COACH, 30.0)
    stop.advance(state, COACH, DRY, 4.0, brake_Nm=4000.0)
    loads_N = wheel_loads_N(state).reshape(WHEELSETS, 2).sum(axis=1)
    deceleration_m_s2 = braking_N(state) / MASS_KG

    # planar transfer [V2, V3 of vehicle.py] with the masses and heights of the coach
    car_kg, bogie_kg, wheelset_kg = 29720.0, 3000.0, 1820.0
    body_N = car_kg * (1.8 - 0.9) / 19.0 * deceleration_m_s2
    moment_kg_m = 0.5 * car_kg * 0.9 + bogie_kg * 0.6 + 2.0 * wheelset_kg * 0.445
    bogie_N = moment_kg_m / 2.56 * deceleration_m_s2
    transfer_N = np.array(
        [
            0.5 * body_N + bogie_N,
            0.5 * body_N - bogie_N,
            -0.5 * body_N + bogie_N,
            -0.5 * body_N - bogie_N,
        ]
    )
    np.testing.assert_allclose(loads_N, WEIGHT_N / WHEELSETS + transfer_N, rtol=0.01)


def test_halving_the_step_changes_the_stop_little():
    speeds_m_s = []
    for step_s in (2e-4, 1e-4, 5e-5):
        state = stop.rolling(COACH, 30.0)
        stop.advance(state, COACH, SOAP, 3.0, brake_Nm=6000.0, step_s=step_s)
        speeds_m_s.append(mean_speed_m_s(state))
    coarse, usual, fine = speeds_m_s
    assert abs(usual - fine) < 2e-4
    assert abs(usual - fine) < abs(coarse - fine)


def test_it_brakes_to_a_walk_and_stands_without_trembling():
    state = stop.rolling(COACH, 2.0)
    stop.advance(state, COACH, DRY, 10.0, brake_Nm=3000.0)
    assert np.abs(state.v).max() < 2e-3
    assert (np.abs(state.v[ROTATION]) < 1e-6).all()


@pytest.mark.parametrize(("bound", "low", "high"), [(0.5, 0.055, 0.065), (np.inf, 0.2, 0.28)])
def test_a_locked_wheel_of_the_coach_is_on_the_degraded_curve_or_by_the_papers_law_recovered(
    bound, low, high
):
    state = stop.rolling(COACH, 40.0)
    state.v[ROTATION] = 0.0
    stop.advance(state, COACH, _law(cleaning_creepage=bound), 2e-4, brake_Nm=1e6)
    assert (state.v[ROTATION] == 0.0).all()
    adhesion = np.abs(state.wheel_forces[:, wheel_rail_forces.PULL]) / wheel_loads_N(state)
    assert low < adhesion.min()
    assert adhesion.max() < high


def test_a_brake_stronger_than_the_adhesion_locks_the_wheel_and_releasing_it_frees_it():
    state = stop.rolling(COACH, 20.0)
    stop.advance(state, COACH, SOAP, 3.0, brake_Nm=30000.0)
    assert np.abs(state.v[ROTATION]).max() < 1e-12
    assert 5.0 < mean_speed_m_s(state) < 19.0
    stop.advance(state, COACH, SOAP, 3.0, brake_Nm=0.0)
    circumferential_m_s = 0.444 * state.v[ROTATION]
    assert (circumferential_m_s > 0.95 * mean_speed_m_s(state)).all()


# --- stability ---


@pytest.mark.parametrize("law", [SOAP, DRY], ids=["soap", "dry"])
def test_lateral_motion_dies_away_at_42_m_s_on_straight_track(law):
    assert stability.growth(COACH, law, 42.0) < -0.05


def test_a_speed_sweep_finds_where_hunting_begins():
    conical = coach.build(_sections(laying=1 / 40))
    speeds_m_s = np.array([30.0, 45.0, 60.0, 75.0])
    critical_m_s = stability.critical_speed(conical, SOAP, speeds_m_s, tolerance_m_s=5.0)
    assert 35.0 < critical_m_s < 75.0
    assert stability.growth(conical, SOAP, 0.7 * critical_m_s) < 0.0


def test_more_yaw_damping_raises_the_critical_speed():
    speeds_m_s = np.array([20.0, 40.0, 60.0, 80.0])
    critical_m_s = []
    for damping_N_s_m in (0.0, 500e3):
        damped = coach.build(
            _sections(laying=1 / 40, yaw_damper_N_s_m=damping_N_s_m, yaw_damper_max_N=2e4)
        )
        critical_m_s.append(stability.critical_speed(damped, SOAP, speeds_m_s, tolerance_m_s=8.0))
    without, with_damping = critical_m_s
    assert with_damping > without


# --- on rollers ---


def test_on_rollers_the_wheels_sink_deeper_and_the_contacts_are_more_curved():
    roller_m = 1.0
    on_rollers = coach.build(_sections(), roller_m=roller_m)
    assert on_rollers.axle_height_m < 0.445
    # the first contact of each wheel
    touching = stop.rolling(on_rollers, 20.0).contacts[:: geometry.MOST]
    on_rail = stop.rolling(COACH, 20.0).contacts[:: geometry.MOST]
    curvature_1_m = on_rail[:, geometry.ROLLING] + 1.0 / roller_m
    np.testing.assert_allclose(touching[:, geometry.ROLLING], curvature_1_m, rtol=1e-3)


# --- the wheelsets as gyroscopes ---


def test_a_turning_wheelset_that_rolls_to_the_side_begins_to_yaw():
    rolls = slice(BEFORE_WHEELSETS + ROLL, None, PER_BODY)
    yaws = slice(BEFORE_WHEELSETS + YAW, None, PER_BODY)
    roll_rad_s = 1e-3
    step_s = 1e-5
    yaw_rad_s = []
    for sign in (1.0, -1.0):
        state = stop.rolling(COACH, 30.0)
        turns_rad_s = state.v[ROTATION].copy()
        state.v[rolls] += sign * roll_rad_s
        stop.advance(state, COACH, DRY, step_s, step_s=step_s)
        yaw_rad_s.append(state.v[yaws].copy())
    inertia_kgm2 = COACH.inertia
    moment_Nm = -inertia_kgm2[ROTATION] * turns_rad_s * roll_rad_s
    expected_rad_s = moment_Nm / inertia_kgm2[yaws] * step_s
    found_rad_s = 0.5 * (yaw_rad_s[0] - yaw_rad_s[1])
    # the contacts resist a little
    np.testing.assert_allclose(found_rad_s, expected_rad_s, rtol=0.1)
