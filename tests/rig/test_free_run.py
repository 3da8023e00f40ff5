"""Wheelsets that run freely under given torques move as in the plant that had these torques."""

import numpy as np
import pytest
from rolling import FILL, SOAP, TRACK, VENT, History, Rig

from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.replay import free_run, lanes
from rollerrig.rig.identify.replay.free_run import Stop

SPEED_M_S = 25.0
DURATION_S = 4.0
STEP_S = 0.005
AXLES = 4
each_memory = pytest.mark.parametrize(
    "memory",
    [{}, {"length_m": 3.0}, {"length_m": 3.0, "speed_power": 0.5, "of_work": 1.0}],
    ids=["without memory", "with memory", "of the work done"],
)


def braked(memory: dict[str, float]) -> tuple[Rig, History]:
    """Return a rig on soap, and its history under a brake that is vented twice."""
    mechanisms = {f"adhesion_memory_{key}": value for key, value in memory.items()}
    rig = Rig(SPEED_M_S, adhesion=SOAP, rig=TRACK, mechanisms=mechanisms)
    fills_and_vents = np.repeat([FILL, VENT], [1500, 700])
    magnets = np.resize(fills_and_vents, round(DURATION_S / rig.params.tick_s))[:, None]
    return rig, rig.roll(DURATION_S, magnets)


def sampled(rig: Rig, values: np.ndarray) -> np.ndarray:
    """Return the values of a history at the samples of a stop."""
    return values[:: round(STEP_S / rig.params.tick_s)]


def stop_of(rig: Rig, history: History, memory: dict[str, float]) -> Stop:
    """Return a stop with the torques and loads of the plant."""
    torque_Nm = sampled(rig, history.brake_torque).copy()
    speed_m_s = np.repeat(sampled(rig, history.vehicle_speed)[:, np.newaxis], AXLES, axis=1)
    unchanged = np.ones_like(torque_Nm)
    vehicle = rig.params.vehicle
    row = np.zeros(parameters.PARAMETERS)
    row[parameters.RADIUS] = vehicle.wheel_radius_m
    row[parameters.INERTIA] = vehicle.wheelset_inertia_kgm2
    row[parameters.LAW] = rig.params.law
    row[parameters.EPS1] = rig.params.patch.eps1
    row[parameters.MEMORY] = memory.get("length_m", 0.0)
    row[parameters.MEMORY_POWER] = memory.get("speed_power", 0.0)
    row[parameters.MEMORY_OF_WORK] = memory.get("of_work", 0.0)
    return Stop(
        surface_m_s=speed_m_s,
        load_N=sampled(rig, history.wheel_load).copy(),
        torque_Nm=torque_Nm,
        degraded=unchanged,
        recovered=unchanged,
        sliding_m_s=np.zeros_like(torque_Nm),
        parameters=np.tile(row, (AXLES, 1)),
        mass_kg=vehicle.mass_kg,
        extra_N=np.zeros(len(torque_Nm)),
        resistance=(
            vehicle.resistance_A_N,
            vehicle.resistance_B_N_s_m,
            vehicle.resistance_C_N_s2_m2,
        ),
        field=np.zeros((2, AXLES)),
        axle_position_m=np.zeros(AXLES),
        step_s=STEP_S,
        on_rollers=False,
        feedback_Ns=0.0,
    )


@each_memory
def test_a_free_run_under_the_torques_of_the_plant_moves_as_the_plant(
    memory: dict[str, float],
) -> None:
    rig, history = braked(memory)
    assert np.max(history.sliding) > 1.0
    motion = free_run.run(stop_of(rig, history, memory))
    radius_m = rig.params.vehicle.wheel_radius_m
    speed_m_s = sampled(rig, history.vehicle_speed)
    rim_m_s = radius_m * sampled(rig, history.wheel_speed)
    np.testing.assert_allclose(motion.speed_m_s, speed_m_s, atol=2e-4)
    np.testing.assert_allclose(radius_m * motion.wheel_rad_s, rim_m_s, atol=2e-3)


@each_memory
def test_a_free_run_with_vector_mathematics_is_that_with_exact_mathematics(
    memory: dict[str, float],
) -> None:
    stop = stop_of(*braked(memory), memory)
    motions = []
    for exact in (None, True):
        motion = free_run.Motion(*(np.full(shape, np.nan) for shape in shapes_of(stop)))
        assert free_run.drive(stop, bool(memory) or None, exact, np.empty(lanes.CELLS), motion)
        motions.append(motion)
    for fast, exactly in zip(*motions, strict=True):
        np.testing.assert_allclose(fast, exactly, rtol=1e-9)


def shapes_of(stop: Stop) -> list[tuple[int, ...]]:
    """Return the shapes of speed, wheel speeds and torques of a stop."""
    samples, axles = stop.torque_Nm.shape
    return [(samples,), (samples, axles), (samples, axles)]


def test_a_wheel_that_is_braked_too_much_locks_and_never_turns_backwards() -> None:
    stop = stop_of(*braked({}), {})
    stop.torque_Nm[:, 0] = 2.0e4
    motion = free_run.run(stop)
    locked = motion.wheel_rad_s[200:, 0]
    assert np.all(locked == 0.0)
    assert np.all(motion.wheel_rad_s[:, 1:] > 40.0)
    assert np.all(np.diff(motion.speed_m_s) < 0.0)
