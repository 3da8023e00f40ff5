"""Braking runs of a car with ABS on a wet road, with hidden effects: two axles, four wheels.

The car brakes straight ahead. Each wheel has its tyre, brake and pressure; braking moves load to the
front axle. Nothing is imported from the rig, and the tyre is a formula of tyres, not of rails:

    [R1] f = mu sin(C atan(B k)), k = |s| / v                          Pacejka, Tire and Vehicle Dynamics
    [R2] N_front = m (g b + h a / L), N_rear = m (g (1 - b) - h a / L)  for both wheels of an axle

f is adhesion, s sliding in m/s, v speed of the car, m its mass, a its deceleration, b the fraction
of the weight on the front axle, h the height of the centre of mass, L the wheelbase. The load
follows the deceleration with a lag. Wheels: front left, front right, rear left, rear right.
"""

from math import atan, sin
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter1d

G = 9.80665
WHEELS = 4
MASS_KG = 1500.0
RADIUS_M = 0.31
INERTIA_KGM2 = 1.3  # of a wheel, with its share of the shafts
WHEELBASE_M = 2.7
HEIGHT_M = 0.55
FRONT_LOAD = 0.6
FRONT_BRAKE = 0.7  # fraction of the brake torque of the front axle at one pressure
TORQUE_NM_BAR = 60.0  # of all four brakes together
DRAG_A_N = 150.0
DRAG_C_N_S2_M2 = 0.4
TYRE_B = 14.0
TYRE_C = 1.25
PITCH_S = 0.08
STEP_S = 1e-4
STEPS_IN_SAMPLE = 100
LONGEST_S = 25.0
END_M_S = 4.0
FIELD_M = 0.25
RUNS = ("a1", "a2", "a3", "b1", "b2", "b3")


class Hidden(NamedTuple):
    """What dataset.toml does not say; 0 is nothing."""

    front_brake: float = 0.0  # change of FRONT_BRAKE
    height_fraction: float = 0.0  # of HEIGHT_M
    wheel_delay_s: float = 0.0  # of all wheel speeds
    patch_fraction: float = 0.0  # of the friction that is missing on 40 m of the road
    worn_fraction: float = 0.0  # of the radius of wheel 3


def tyre(creepage: np.ndarray) -> np.ndarray:
    """Return the adhesion over its maximum at creepages of braking [R1]."""
    return np.sin(TYRE_C * np.arctan(TYRE_B * creepage))


@njit(cache=True)
def drive(v, friction, hidden_patch, patch_m, front_brake, height_m, radius_m, pedal_bar, apply_s):
    """Return the samples of a stop: v, four omega, four pressures in bar, as (n, 9).

    `friction` (4, places) is that under each wheel, every FIELD_M.
    """
    steps = int(LONGEST_S / STEP_S)
    out = np.empty((steps // STEPS_IN_SAMPLE, 9))
    omega = v / radius_m
    pressure_bar = np.zeros(WHEELS)
    was_rad_s = omega.copy()
    mode = np.zeros(WHEELS)
    torque_Nm_bar = np.empty(WHEELS)
    torque_Nm_bar[:2] = 0.5 * front_brake * TORQUE_NM_BAR
    torque_Nm_bar[2:] = 0.5 * (1.0 - front_brake) * TORQUE_NM_BAR
    place_m = 0.0
    felt_m_s2 = 0.0
    rows = 0
    for n in range(steps):
        if n % STEPS_IN_SAMPLE == 0:
            if v < END_M_S:
                break
            out[rows, 0] = v
            out[rows, 1:5] = omega
            out[rows, 5:9] = pressure_bar
            rows += 1
            # the control of each wheel, every 10 ms
            for j in range(WHEELS):
                slip = 1.0 - radius_m[j] * omega[j] / v
                rim_m_s2 = radius_m[j] * (omega[j] - was_rad_s[j]) / (STEP_S * STEPS_IN_SAMPLE)
                was_rad_s[j] = omega[j]
                if slip > 0.22 or (slip > 0.12 and rim_m_s2 < -12.0):
                    mode[j] = -1.0
                elif slip > 0.10:
                    mode[j] = 0.0
                else:
                    mode[j] = 1.0
        total_N = DRAG_A_N + DRAG_C_N_S2_M2 * v * v
        transfer_N = MASS_KG * height_m * felt_m_s2 / WHEELBASE_M
        field = int(place_m / FIELD_M)
        for j in range(WHEELS):
            share = FRONT_LOAD if j < 2 else 1.0 - FRONT_LOAD
            load_N = 0.5 * (MASS_KG * G * share + (transfer_N if j < 2 else -transfer_N))
            s = v - radius_m[j] * omega[j]
            mu = friction[j, field]
            if patch_m < place_m < patch_m + 40.0:
                mu *= 1.0 - hidden_patch
            f = mu * sin(TYRE_C * atan(TYRE_B * abs(s) / v))  # [R1]
            force_N = load_N * f if s > 0.0 else -load_N * f
            total_N += force_N
            torque_Nm = torque_Nm_bar[j] * pressure_bar[j]
            change = (radius_m[j] * force_N - torque_Nm) / INERTIA_KGM2
            omega[j] = max(omega[j] + STEP_S * change, 0.0)
            if n * STEP_S > apply_s and mode[j] > 0.0:
                pressure_bar[j] += STEP_S * (pedal_bar - pressure_bar[j]) / 0.25
            elif mode[j] < 0.0:
                pressure_bar[j] -= STEP_S * pressure_bar[j] / 0.08
        deceleration = total_N / MASS_KG
        felt_m_s2 += STEP_S * (deceleration - felt_m_s2) / PITCH_S
        place_m += STEP_S * v
        v -= STEP_S * deceleration
    return out[:rows]


def make(folder: Path, hidden: Hidden, seed: int, tyre_keys: str) -> Path:
    """Write a dataset of six stops; return its folder.

    `tyre_keys` are the lines of [adhesion] and [contact] that describe the tyre.
    """
    rng = np.random.default_rng((49, seed))
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    gain = 1.0 + rng.normal(0.0, 0.003)
    road = _field(rng, 0.015, 1)
    patch_m = rng.uniform(40.0, 60.0)
    level = rng.uniform(0.34, 0.42)
    text = _HEAD + tyre_keys
    for name in RUNS:
        v0 = round(rng.uniform(22.0, 34.0), 1)
        radius_m = np.full(WHEELS, RADIUS_M)
        radius_m[2] *= 1.0 + hidden.worn_fraction
        friction = level * (1.0 + rng.normal(0.0, 0.03))
        field = friction * (1.0 + road) * (1.0 + _field(rng, 0.015, WHEELS))
        samples = drive(
            v0,
            field,
            hidden.patch_fraction,
            patch_m,
            FRONT_BRAKE + hidden.front_brake,
            HEIGHT_M * (1.0 + hidden.height_fraction),
            radius_m,
            rng.uniform(90.0, 110.0),
            rng.uniform(0.6, 1.2),
        )
        _write(folder / "runs" / f"{name}.csv", samples, hidden.wheel_delay_s, gain, rng)
        group = "tune" if name[0] == "a" else "validate"
        text += f'\n[[run]]\nfile = "runs/{name}.csv"\ngroup = "{group}"\n'
    (folder / "dataset.toml").write_text(text, encoding="utf-8")
    return folder


def _field(rng: np.random.Generator, deviation: float, rows: int) -> np.ndarray:
    """Return random fields along the road, every FIELD_M, (rows, places)."""
    places = int(LONGEST_S * 40.0 / FIELD_M)
    smooth = gaussian_filter1d(rng.standard_normal((rows, places)), 5.0 / FIELD_M, axis=1)
    return deviation * smooth / smooth.std()


def _write(
    path: Path, samples: np.ndarray, delay_s: float, gain: float, rng: np.random.Generator
) -> None:
    """Write a stop as its sensors see it; the pressures have a gain."""
    time_s = STEP_S * STEPS_IN_SAMPLE * np.arange(len(samples))
    speed = samples[:, 0] + rng.normal(0.0, 0.03, len(samples))
    wheels = np.column_stack([np.interp(time_s - delay_s, time_s, w) for w in samples[:, 1:5].T])
    wheels += rng.normal(0.0, 0.1, wheels.shape)
    pressures = gain * samples[:, 5:9] + rng.normal(0.0, 0.2, wheels.shape)
    names = [
        "time_s",
        "vehicle_speed_m_s",
        *(f"wheel_speed_{j}_rad_s" for j in range(1, 5)),
        *(f"p{j} [bar]" for j in range(1, 5)),
    ]
    table = np.column_stack([time_s, speed, wheels, pressures])
    np.savetxt(path, table, delimiter=",", fmt="%.6g", header=",".join(names), comments="")


_HEAD = f"""title = "Six stops of a car with ABS on a wet road"
kind = "braking_runs"
sample_time_s = 0.01

[vehicle]
mass_kg = {MASS_KG}
wheel_radius_m = {RADIUS_M}
wheelset_inertia_kgm2 = {INERTIA_KGM2}
resistance_A_N = {DRAG_A_N}
resistance_C_N_s2_m2 = {DRAG_C_N_S2_M2}

[axles]
wheels = 2
positions_m = [0.0, {WHEELBASE_M}]
height_m = {HEIGHT_M}
front_load_fraction = {FRONT_LOAD}
front_brake_fraction = {FRONT_BRAKE}

[brake]
spring_pressure_Pa = 0.0
cylinder_area_m2 = 0.0025
lever_ratio = 0.5
disc_radius_m = 0.13

[accuracy]
speed_m_s = 0.03
wheel_speed_rad_s = 0.1
torque_fraction = 0.006
calibration_fraction = 0.003

[channels]
brake_pressure_1_Pa = "p1 [bar]"
brake_pressure_2_Pa = "p2 [bar]"
brake_pressure_3_Pa = "p3 [bar]"
brake_pressure_4_Pa = "p4 [bar]"
"""
