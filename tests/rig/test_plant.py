"""The plant as a whole: energy, momentum, limits, convergence, repeatability."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rolling import DRY, FULL_BRAKE_PA, HOLD, LEAVES, NO_RESISTANCE, SOAP, TRACK, VENT, Rig

from rollerrig.rig.contact.patch import Patch, patch_for

LONGEST_S = 40.0
MU_SOAP = 0.06
MU_CLEAN = 0.28


def random_magnets(seconds, seed=3):
    """Return magnets (ticks, 4): random patterns of 50 to 400 ms for 20 s, then none."""
    random = np.random.default_rng(seed)
    rows = np.empty((20_000, 4))
    for axle in range(4):
        lengths = random.integers(50, 400, len(rows) // 50)
        states = random.choice([0, HOLD, VENT], len(lengths))
        rows[:, axle] = np.repeat(states, lengths)[: len(rows)]
    rest = np.zeros((max(0, round(seconds * 1000) - len(rows)), 4))
    return np.vstack([rows, rest])[: round(seconds * 1000)]


def stop(mode, law, magnets=0):
    """Return a rig and its history of a stop from 30 m/s."""
    rig = Rig(30.0, adhesion=law, rig=mode)
    return rig, rig.roll(LONGEST_S, magnets)


@pytest.fixture(scope="module")
def stops():
    """Return rig and history of six stops by place and law."""
    pulses = random_magnets(LONGEST_S)
    runs = {}
    for where, mode in (("track", TRACK), ("rollers", {})):
        runs[where, "dry"] = stop(mode, DRY)
        runs[where, "soap"] = stop(mode, SOAP)
        runs[where, "soap with pulses"] = stop(mode, SOAP, pulses)
    return runs


def kinetic_J(inertia, speed):
    """Return the kinetic energy that is lost from the first to the last sample."""
    return 0.5 * inertia * (speed[0] ** 2 - speed[-1] ** 2)


LAWS = ("dry", "soap", "soap with pulses")


@pytest.mark.parametrize("law", LAWS)
def test_on_the_track_the_energy_of_a_stop_is_sliding_brake_and_resistance_work(stops, law):
    rig, run = stops["track", law]
    vehicle = rig.params.vehicle
    lost = (
        kinetic_J(vehicle.mass_kg, run.vehicle_speed)
        + kinetic_J(vehicle.wheelset_inertia_kgm2, run.wheel_speed).sum()
    )
    counted = (
        run.change("sliding_work").sum()
        + run.change("brake_work").sum()
        + run.change("resistance_work")
    )
    assert counted == pytest.approx(lost, rel=1e-6)
    # the same from the quantities observed once a tick, without the plant's counters
    v = run.vehicle_speed
    resistance_N = vehicle.resistance_A_N + vehicle.resistance_C_N_s2_m2 * v**2
    observed = (
        run.integral(run.contact_force_N * run.sliding).sum()
        + run.integral(run.brake_torque * run.wheel_speed).sum()
        + run.integral(resistance_N * v)
    )
    assert observed == pytest.approx(lost, rel=1e-3)


@pytest.mark.parametrize("law", LAWS)
def test_on_rollers_the_energy_of_every_axle_and_of_the_vehicle_balances(stops, law):
    rig, run = stops["rollers", law]
    vehicle = rig.params.vehicle
    drive = rig.params.drive
    lost = kinetic_J(vehicle.wheelset_inertia_kgm2, run.wheel_speed) + kinetic_J(
        drive.roller_inertia_kgm2, run.roller_speed
    )
    supplied = run.change("motor_work")
    taken = run.change("sliding_work") + run.change("brake_work")
    np.testing.assert_allclose(taken, lost + supplied, rtol=1e-6)
    observed = (
        run.integral(run.contact_force_N * run.sliding)
        + run.integral(run.brake_torque * run.wheel_speed)
        - run.integral(run.motor_torque * run.roller_speed)
    )
    np.testing.assert_allclose(observed, lost, atol=1e-3 * taken.max())
    # the vehicle
    force_N = run.contact_force_N.sum(axis=1)
    taken_J = run.integral(force_N * run.vehicle_speed) + run.change("resistance_work")
    assert taken_J == pytest.approx(kinetic_J(vehicle.mass_kg, run.vehicle_speed), rel=1e-3)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("where", ["track", "rollers"])
def test_brake_and_sliding_only_take_energy(stops, where, law):
    _, run = stops[where, law]
    assert np.diff(run.brake_work, axis=0).min() >= 0.0
    assert np.diff(run.resistance_work).min() >= 0.0
    # where the contact hardly slides, rounding may give back a negligible energy
    assert np.diff(run.sliding_work, axis=0).min() > -1e-3
    assert run.brake_torque.min() >= 0.0


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("where", ["track", "rollers"])
def test_a_stop_ends_at_a_clean_standstill(stops, where, law):
    rig, run = stops[where, law]
    assert np.isfinite(run.log).all()
    still = np.flatnonzero(run.standing)
    assert still.size > 1000, "the vehicle has not stopped"
    rest = slice(still[0], None)
    for name in ("position", "wheel_angle", "roller_angle", "sliding_work", "brake_work"):
        assert np.ptp(getattr(run, name)[rest], axis=0).max() == 0.0, name
    for name in (
        "vehicle_speed",
        "vehicle_acceleration",
        "wheel_speed",
        "roller_speed",
        "sliding",
        "creepage",
        "adhesion",
        "motor_torque",
        "motor_torque_demand",
        "brake_torque",
    ):
        assert np.abs(getattr(run, name)[still[0] + 1 :]).max() == 0.0, name
    # it stopped without bouncing, and the bogies pitched back
    assert np.diff(run.vehicle_speed).max() < 1e-6
    np.testing.assert_allclose(run.wheel_load[-1], rig.params.vehicle.static_load_N, rtol=1e-6)


def test_friction_limits_the_adhesion_of_the_contact(stops):
    for (_, law), (_, run) in stops.items():
        most = 0.7 if law == "dry" else MU_CLEAN / 0.4
        assert 0.0 < np.abs(run.adhesion).max() <= most
        assert (run.adhesion_degraded <= run.adhesion_recovered + 1e-12).all()


def test_without_wsp_wheels_lock_on_leaves_and_some_on_soap_but_none_on_the_dry_rig(stops):
    assert Rig(42.3, adhesion=LEAVES).roll(40.0).longest_lock[-1].min() > 10.0
    # soap: sliding cleans until the contact holds the brake of the wheels that braking loads, the
    # first ones of the bogies; the others lock
    soap = stops["rollers", "soap"][1]
    loaded = soap.creepage[soap.vehicle_speed > 20.0][:, [0, 2]]
    assert 0.05 < loaded.max() < 0.15
    np.testing.assert_array_equal(soap.longest_lock[-1] > 10.0, [False, True, False, True])
    assert stops["rollers", "dry"][1].longest_lock[-1].max() == 0.0


def test_a_locked_wheel_recovers_when_the_valve_vents():
    rig = Rig(42.3, adhesion=LEAVES)
    locked = rig.roll(15.0)
    assert (locked.wheel_speed[-1] == 0.0).all()
    freed = rig.roll(20.0, VENT)
    np.testing.assert_allclose(
        freed.wheel_circumferential_speed[-1], freed.vehicle_speed[-1], rtol=1e-3
    )
    assert (freed.locked_since[-1] == 0.0).all()
    braked_again = rig.roll(12.0)
    assert braked_again.vehicle_speed[-1] > 3.0
    assert (braked_again.wheel_speed[-1] == 0.0).any()


@pytest.mark.parametrize("law", [DRY, SOAP])
def test_a_roller_of_infinite_radius_is_a_rail(law):
    def patch_on(roller_m):
        return patch_for(
            wheel_radius_m=0.445,
            roller_radius_m=roller_m,
            lateral_radius_m=0.3,
            young_Pa=2.1e11,
            shear_Pa=8e10,
            poisson=0.3,
        )

    rail = patch_on(np.inf)
    numbers = [field for field in Patch._fields if field != "model"]
    for name in numbers:
        assert getattr(patch_on(1e9), name) == pytest.approx(getattr(rail, name), rel=1e-8)
    track = Rig(42.3, adhesion=law, rig=TRACK)
    endless = Rig(42.3, adhesion=law, contact={"roller_radius_m": np.inf})
    assert endless.params.patch == track.params.patch == rail
    # motors hold the surface at the vehicle's speed, within the accuracy of rig control
    pulses = random_magnets(20.0)
    on_track = track.roll(20.0, pulses)
    on_rollers = endless.roll(20.0, pulses)
    assert on_rollers.position[-1] == pytest.approx(on_track.position[-1], rel=2e-4)
    assert np.abs(on_rollers.vehicle_speed - on_track.vehicle_speed).max() < 0.05


@pytest.mark.parametrize("mode", [TRACK, {}], ids=["track", "rollers"])
@pytest.mark.parametrize(
    ("law", "demand_Pa", "seconds"),
    [(DRY, FULL_BRAKE_PA, 2.0), (SOAP, 1.5e5, 2.0), (SOAP, FULL_BRAKE_PA, 1.6)],
)
def test_halving_the_step_quarters_the_error(mode, law, demand_Pa, seconds):
    # smooth: no lock, no spring kink; motors idle, their control samples by the tick
    def end(step_s):
        rig = Rig(30.0, step_s, 2e-3, adhesion=law, rig=mode, brake={"spring_pressure_Pa": 0.0})
        run = rig.roll(seconds, demand_Pa=demand_Pa, controlled=False)
        return np.hstack([run.vehicle_speed[-1], run.wheel_speed[-1], run.roller_speed[-1]])

    exact = end(2e-5)
    errors = [np.abs(end(step_s) - exact).max() for step_s in (2e-3, 1e-3, 5e-4)]
    orders = np.log2(errors[:-1]) - np.log2(errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.25)


@pytest.mark.parametrize("step_s", [1e-3, 1e-2])
@pytest.mark.parametrize("law", [DRY, SOAP])
def test_a_coarse_step_stays_stable_and_close(stops, law, step_s):
    _, fine = stops["rollers", "dry" if law is DRY else "soap"]
    coarse = Rig(30.0, step_s, step_s, adhesion=law).roll(LONGEST_S)
    assert np.isfinite(coarse.log).all()
    assert coarse.position[-1] == pytest.approx(fine.position[-1], rel=2e-3)


def test_momentum_is_constant_without_external_forces():
    # on the track: vehicle and wheelsets together
    track = Rig(20.0, vehicle=NO_RESISTANCE, rig=TRACK)
    track.state.wheel_speed[:] *= (0.0, 0.5, 0.9, 1.2)
    vehicle = track.params.vehicle
    run = track.roll(2.0, demand_Pa=0.0)
    wheelset_kg_m = vehicle.wheelset_inertia_kgm2 / vehicle.wheel_radius_m
    momentum = vehicle.mass_kg * run.vehicle_speed + wheelset_kg_m * run.wheel_speed.sum(axis=1)
    assert np.ptp(momentum) < 1e-9 * momentum[0]
    assert np.abs(run.sliding[1]).min() > 1.0
    assert np.abs(run.sliding[-1]).max() < 1e-3

    # on the rig: wheelset and roller of each axle
    rollers = Rig(20.0, vehicle=NO_RESISTANCE)
    rollers.state.wheel_speed[:] *= (0.0, 0.5, 0.9, 1.2)
    drive = rollers.params.drive
    run = rollers.roll(2.0, demand_Pa=0.0, controlled=False)
    roller_kg_m = drive.roller_inertia_kgm2 / drive.roller_radius_m
    momentum = wheelset_kg_m * run.wheel_speed + roller_kg_m * run.roller_speed
    assert np.ptp(momentum, axis=0).max() < 1e-9 * momentum.max()


def test_friction_that_changes_at_a_place_reaches_every_axle_at_that_place():
    run = Rig(20.0, friction=[(True, 5.0, 0.10, MU_CLEAN, 0b1111)]).roll(2.5, demand_Pa=0.0)
    behind_m = np.array([0.0, 2.56, 19.0, 21.56])
    arrived = np.argmax(run.friction_degraded == 0.10, axis=0)
    # a tick uses the places of the axles at its beginning
    late_m = run.position[arrived - 1] - (5.0 + behind_m)
    assert late_m.min() >= 0.0
    assert late_m.max() < 0.02
    assert (run.friction_degraded[0] == MU_SOAP).all()
    assert (run.friction_degraded[-1] == 0.10).all()


def test_friction_that_changes_in_time_reaches_the_given_axles_simultaneously():
    rows = [(False, 0.5, 0.03, 0.2, 0b0100), (False, 0.8, 0.05, 0.25, 0b0110)]
    run = Rig(20.0, friction=rows).roll(1.0)
    expected = [{MU_SOAP}, {MU_SOAP, 0.05}, {MU_SOAP, 0.03, 0.05}, {MU_SOAP}]
    for axle in range(4):
        assert set(run.friction_degraded[:, axle]) == expected[axle]
    first = np.argmax(run.friction_degraded[:, 2] == 0.03)
    assert run.time[first] == pytest.approx(0.501)  # the tick that begins at 0.5 s
    assert set(run.friction_recovered[:, 2]) == {MU_CLEAN, 0.2, 0.25}


def test_a_repeated_run_is_equal_to_the_last_bit():
    pulses = random_magnets(3.0)
    first = Rig(42.3, adhesion=SOAP).roll(3.0, pulses)
    second = Rig(42.3, adhesion=SOAP).roll(3.0, pulses)
    assert first.log.tobytes() == second.log.tobytes()


def test_settings_without_an_effect_change_no_bit():
    plain = Rig(42.3).roll(2.0)
    same = Rig(
        42.3,
        friction=[(False, 0.0, MU_SOAP, MU_CLEAN, 0b1111), (True, 900.0, 0.3, 0.3, 15)],
        adhesion={"cleaning_creepage": np.inf},
    ).roll(2.0)
    assert plain.log.tobytes() == same.log.tobytes()


PLAIN = """
import numpy as np
from rolling import Rig, SOAP
rig = Rig(42.3, adhesion=SOAP)
rig.state.wheel_speed[1] = 0.0
rig.state.cylinder_pressure[:] = 3e5
print(rig.roll(0.03, (0, 1, 3, 0)).log[-1].tolist())
"""


def test_the_kernels_are_ordinary_python_and_agree_with_it():
    states = {}
    for without_jit in ("0", "1"):
        process = subprocess.run(
            [sys.executable, "-c", PLAIN],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            env=os.environ | {"NUMBA_DISABLE_JIT": without_jit},
            check=True,
        )
        states[without_jit] = np.array(eval(process.stdout, {"nan": np.nan, "inf": np.inf}))
    np.testing.assert_allclose(states["1"], states["0"], rtol=1e-11, atol=1e-12)
