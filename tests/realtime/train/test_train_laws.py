"""A train obeys the laws of mechanics: momentum, energy, and a chain of masses with its modes."""

from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.train import plan, stop
from rollerrig.rig.train import coupler

COACH = {
    "vehicle": "uic_z1",
    "adhesion": "low",
    "rig": "plain_track",
    "initial_speed_m_s": 30.0,
    "demand": [{"pressure_Pa": 3.8e5}],
    # a rail that nothing cleans: one vehicle knows it by a lag, a train by its places
    "mechanisms": {"rail_cleaning_gain": 0.0},
}
# a step is a tick, so that each step can be observed
FINE = {"tick_hz": 10000, "step_s": 1e-4}
# linear and elastic
SPRING_N_M = 8e6
ELASTIC = f"""
[coupler]
draw_displacement_m = [0.01]
draw_force_N = [{0.01 * SPRING_N_M}]
buff_displacement_m = [0.01]
buff_force_N = [{0.01 * SPRING_N_M}]
"""


def read(content, folder=Path()):
    return plan.read(content, folder / "train.toml")


@pytest.fixture
def elastic(tmp_path):
    path = tmp_path / "elastic.toml"
    path.write_text(ELASTIC)
    return str(path)


def test_two_cars_with_a_rigid_coupler_are_one_vehicle_of_twice_the_size():
    changes = {"friction": [{"from_m": 80.0, "mu_cd": 0.06}]}
    length_m = 26.4
    train = read(
        {
            **COACH,
            **changes,
            "train": {"coupler": "rigid", "car": [{"count": 2, "length_m": length_m}]},
        }
    )
    twice = {
        "axles": 8,
        "mass_kg": 86000.0,
        "resistance_A_N": 1200.0,
        "resistance_C_N_s2_m2": 2 * 0.9375,
        "body_distance_m": length_m,
    }
    given = {**COACH, **changes, "vehicle_set": "uic_z1", "vehicle": twice}
    vehicle = scenario.read(given, Path("vehicle.toml"))

    cars = stop.simulate(train).samples().cars
    whole = free.channels(free.simulate(vehicle), vehicle.table)
    assert np.abs(whole["vehicle_speed_m_s"] - cars[0]["vehicle_speed_m_s"]).max() < 1e-9
    for axle in range(1, 5):
        for car, first in ((0, 0), (1, 4)):
            of_vehicle = whole[f"sliding_{first + axle}_m_s"]
            assert np.abs(of_vehicle - cars[car][f"sliding_{axle}_m_s"]).max() < 1e-6
    assert max(whole["vents_8"]) >= 3  # its unit acts


def test_a_train_of_one_car_is_the_car():
    train = read({**COACH, "train": {"car": [{}]}})
    car = stop.simulate(train).samples().cars[0]
    alone = scenario.read({**COACH, "vehicle_set": "uic_z1"} | {"vehicle": {}}, Path("car.toml"))
    whole = free.channels(free.simulate(alone), alone.table)
    assert np.abs(whole["vehicle_speed_m_s"] - car["vehicle_speed_m_s"]).max() < 1e-9


def test_couplers_change_no_momentum_and_brakes_change_as_much_as_their_forces():
    content = {
        **COACH,
        "loop": FINE,
        "train": {"delay_of_car_s": 0.2, "car": [{"count": 2}, {"load_kg": 10000.0, "count": 2}]},
    }
    train = read(content)
    run = stop.Stop(train)
    states = [body.state for body in run.bodies]
    masses = train.mass_kg
    begin = [state.vehicle_speed[0] for state in states]
    impulse = 0.0
    resistance_before = np.zeros(len(states))
    largest_N = 0.0
    for _ in range(8000):
        before = [state.vehicle_speed[0] for state in states]
        run.run(1)
        for number, state in enumerate(states):
            way_m = 0.5e-4 * (before[number] + state.vehicle_speed[0])
            resistance_N = (state.resistance_work[0] - resistance_before[number]) / way_m
            resistance_before[number] = state.resistance_work[0]
            impulse += 1e-4 * (np.sum(state.contact_force) + resistance_N)
        largest_N = max(largest_N, np.abs(run.link.motion.force_N).max())
    lost = masses @ (begin - np.array([state.vehicle_speed[0] for state in states]))
    assert largest_N > 5e3
    assert lost == pytest.approx(impulse, rel=1e-6)


def test_the_energy_of_a_train_goes_to_contacts_brakes_resistance_and_couplers():
    train = read({**COACH, "train": {"delay_of_car_s": 0.2, "car": [{"count": 4}]}})
    run = stop.Stop(train)
    states = [body.state for body in run.bodies]

    def kinetic_J():
        wheels = sum(np.sum(0.5 * state.wheel_speed**2 / state.per_inertia) for state in states)
        bodies = 0.5 * train.mass_kg @ np.array([state.vehicle_speed[0] ** 2 for state in states])
        return bodies + wheels

    before_J = kinetic_J()
    run.run(15000)
    taken_J = np.sum(run.link.motion.work_J)
    for state in states:
        taken_J += np.sum(state.sliding_work + state.brake_work) + state.resistance_work[0]
    assert before_J - kinetic_J() == pytest.approx(taken_J, rel=1e-3)
    # a gear that returns a share of its force keeps the rest
    assert np.all(run.link.motion.work_J > 0.0)


def test_elastic_couplers_store_what_they_take_in(elastic):
    train = read(
        {**COACH, "train": {"coupler": elastic, "delay_of_car_s": 0.3, "car": [{"count": 4}]}}
    )
    run = stop.Stop(train)
    largest_J = 0.0
    for _ in range(60):
        run.run(50)
        motion = run.link.motion
        stored_J = sum(
            coupler.stored(x, run.couplers, i) for i, x in enumerate(motion.displacement_m)
        )
        largest_J = max(largest_J, stored_J)
        assert np.sum(motion.work_J) == pytest.approx(stored_J, abs=1e-3 * largest_J)
    assert largest_J > 20.0


def test_a_chain_of_masses_answers_a_late_brake_as_its_modes_do(elastic):
    # wheels without inertia on a dry rail: the cars are masses under the forces of their brakes
    content = {
        **COACH,
        "adhesion": "dry",
        "loop": {**FINE, "record_hz": 100},
        "vehicle": {
            "wheelset_inertia_kgm2": 1.0,
            "resistance_A_N": 0.0,
            "resistance_C_N_s2_m2": 0.0,
        },
        "vehicle_set": "uic_z1",
        "demand": [{"pressure_Pa": 1.5e5}],
        "brake": {"fill_time_constant_s": 0.1},
        "valve": {"fill_time_constant_s": 0.05},
        "train": {"coupler": elastic, "delay_of_car_s": 0.1, "car": [{"count": 5, "unit": "none"}]},
    }
    train = read(content)
    run = stop.Stop(train, unit="none")
    step_s = 1e-4
    brakes_N, tensions_N = [], []
    for _ in range(15000):
        run.run(1)
        brakes_N.append([np.sum(body.state.contact_force) for body in run.bodies])
        tensions_N.append(run.link.motion.force_N.copy())
    brakes_N, tensions_N = np.array(brakes_N), np.array(tensions_N)

    found_N = tensions_of_modes(train.mass_kg, brakes_N, step_s)
    largest_N = np.abs(found_N).max(axis=0)
    assert largest_N.max() > 20e3
    assert np.abs(tensions_N - found_N).max() < 0.005 * largest_N.max()
    assert np.abs(tensions_N).max(axis=0) == pytest.approx(largest_N, rel=0.005)


def tensions_of_modes(masses_kg, brakes_N, step_s):
    """Return the tension of each coupler (n, couplers) by the modes of the chain.

    Each mode is an oscillator, solved exactly under a force that is constant in each step.
    """
    count = len(masses_kg)
    difference = np.eye(count - 1, count) - np.eye(count - 1, count, k=1)
    stiffness = SPRING_N_M * difference.T @ difference
    squares, modes = linalg.eigh(stiffness, np.diag(masses_kg))
    forces = -brakes_N @ modes
    amplitudes = np.zeros((len(brakes_N), count))
    for mode, square in enumerate(squares):
        if mode == 0:
            continue  # the motion of the whole train stretches no coupler
        omega = np.sqrt(square)
        c, s = np.cos(omega * step_s), np.sin(omega * step_s)
        q = rate = 0.0
        for k, force in enumerate(forces[:, mode]):
            rest = force / square
            # the tension of a step is that of its middle
            half_c, half_s = np.cos(0.5 * omega * step_s), np.sin(0.5 * omega * step_s)
            amplitudes[k, mode] = rest + (q - rest) * half_c + rate / omega * half_s
            q, rate = (
                rest + (q - rest) * c + rate / omega * s,
                -omega * (q - rest) * s + rate * c,
            )
    return SPRING_N_M * (amplitudes @ modes.T) @ difference.T


def test_a_train_repeats_to_the_bit():
    train = read({**COACH, "initial_speed_m_s": 15.0, "train": {"car": [{"count": 3}]}})
    first, second = (stop.simulate(train).samples() for _ in range(2))
    assert np.array_equal(first.force_N, second.force_N)
    for a, b in zip(first.cars, second.cars, strict=True):
        assert all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)


def test_stiff_couplers_need_no_shorter_step(tmp_path):
    path = tmp_path / "stiff.toml"
    path.write_text(ELASTIC.replace(str(0.01 * SPRING_N_M), "1e8"))
    given = {**COACH, "initial_speed_m_s": 20.0, "loop": {"step_s": 1e-3}}
    rigid, stiff = (
        stop.simulate(
            read(
                {**given, "train": {"coupler": name, "delay_of_car_s": 0.1, "car": [{"count": 3}]}}
            )
        ).samples()
        for name in ("rigid", str(path))
    )
    count = min(len(rigid.cars[0]["time_s"]), len(stiff.cars[0]["time_s"]))
    difference = (
        rigid.cars[0]["vehicle_speed_m_s"][:count] - stiff.cars[0]["vehicle_speed_m_s"][:count]
    )
    assert np.abs(difference).max() < 0.1
