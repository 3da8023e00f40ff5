"""Braking stops of a coach in MuJoCo, with a known hidden effect: a third generator to judge
`explain`.

It has another physics engine (`mujoco_coach`), solves the paper's adhesion by iteration
(`mujoco_contact`), and has its own brake, slide protection, sensors and noise. Each effect has its
own form here, and no code comes from the rig or from the other generators. Effects that act while a
stop runs are in `mujoco_coach`. In this file are those that are fixed in place, that change a
constant, or that change what a sensor shows.

A set is six stops from 22 to 44 m/s, sampled at 100 Hz. Runs differ in speed, in demand, in the
sliding at which the protection vents, and in the contaminant's friction (5 %). Friction varies by 2
% along the rail and for each wheelset, in every run anew. Torque, load and mass are off by 0.3 % in
the whole set.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.optimize import brentq
from scipy.signal import lfilter

from . import mujoco_coach as coach
from . import mujoco_contact as contact
from .conditions import (
    Conditions,
    pad_variation,
    pole_wheels,
    rail_deviations,
    wheel_speeds,
)

# smallest size of each cause; fractions, or the unit of its formula
SMALLEST = {
    "rail_cleaning": 0.05,
    "adhesion_memory": 2.0,
    "speed_dependent_friction": 0.05,
    "negative_conditioning": 0.10,
    "contaminated_patch": 0.05,
    "friction_trend": 0.12,
    "brake_gain": 0.04,
    "pad_fade": 0.015,
    "torque_offset": 0.015,
    "running_resistance": 150.0,
    "track_gradient": 0.0006,
    "wheel_radius": 0.0005,
    "wheel_inertia": 0.05,
    "speed_sensor_delay": 0.005,
    "torque_sensor_delay": 0.010,
    "wheel_out_of_round": 0.02,
    "load_transfer": 0.012,
    "sanding": 0.05,
    "roller_curvature": 0.40,
    "interfacial_layer": 0.50,
    "falling_friction": 0.15,
}
# sizes beyond which an effect has no physical meaning
LARGEST = {"roller_curvature": 0.70, "interfacial_layer": 0.75}
# size of each effect that is not in the rig's table of causes
UNKNOWN = {
    "tone_wheel_eccentric": 0.004,  # share of the speed, once per turn, in one sensor
    "wheel_clock_drift": 0.0012,  # the wheel speeds' clock runs behind
    "torque_hysteresis": 0.10,  # of the demand, between a rising and a falling brake
    "axle_generator": 15e3,  # W, taken from one wheelset
    "one_glazed_tread": 0.15,  # friction of one wheelset
    "jointed_rail": 0.35,  # friction lost on 1.5 m of every 25 m
    "leaf_edges": 0.25,  # more friction from some place on, which differs between runs
    "coupler_surge": 5000.0,  # N, from the next vehicle
    "sloshing_tank": 0.12,  # of the mass, which is a liquid
    "track_waves": 0.0025,  # m, up and down in 9 m; load sensors are too slow to show it
}
NAMES = (*SMALLEST, *UNKNOWN)
# pairs of causes that are hidden together, at twice their smallest sizes
PAIRS = tuple(
    {cause: 2.0 * SMALLEST[cause] for cause in pair}
    for pair in (
        ("rail_cleaning", "brake_gain"),
        ("adhesion_memory", "running_resistance"),
        ("contaminated_patch", "wheel_inertia"),
        ("friction_trend", "speed_sensor_delay"),
        ("negative_conditioning", "track_gradient"),
        ("sanding", "pad_fade"),
        ("speed_dependent_friction", "load_transfer"),
        ("falling_friction", "torque_sensor_delay"),
    )
)
# causes whose size has the meaning of a parameter in the rig's table: (parameter, sign)
SAME_MEANING = {
    "brake_gain": ("gain", 1),
    "wheel_radius": ("fraction", 1),
    "wheel_inertia": ("fraction", 1),
    "speed_sensor_delay": ("delay_s", 1),
    "torque_sensor_delay": ("delay_s", 1),
    "wheel_out_of_round": ("amplitude", 1),
}

RUNS = ("long_1", "long_2", "short_1", "short_2", "check_1", "check_2")
_SPEEDS_M_S = dict(zip(RUNS, (43.0, 35.5, 29.0, 23.0, 39.0, 26.0), strict=True))
IDEAL = Conditions()
SAMPLE_S = 0.01
# standard deviations of the sensors; of the torque relative to its largest value, of the load
# relative to the static one
SPEED_NOISE_M_S = 0.03
SPIN_NOISE_RAD_S = 0.07
TORQUE_NOISE = 0.015
LOAD_NOISE = 0.01
# standard deviations of calibration and mass in a set, and of the contaminant's friction in a run
CALIBRATION = 0.003
SCATTER = 0.05
# friction along the rail: its deviation, and its correlation length
FIELD = 0.02
FIELD_M = 8.0
# cells of the rail, from behind the start of the first wheelset
_PLACES = np.arange(-40.0, 1600.0, coach.CELL_M)
_ARMS = np.array([10.78, 8.22, -8.22, -10.78]) / 9.5  # of the wheelsets about the body, mean 1


def make(
    folder: Path,
    effects: dict[str, float],
    seed: int,
    runs: tuple[str, ...] = RUNS,
    conditions: Conditions = IDEAL,
) -> Path:
    """Write a dataset of stops with hidden effects; return its folder.

    `effects` has the size of each effect by its name. The same seed writes the same bytes. Raises
    ValueError for an unknown effect.
    """
    unknown = set(effects) - set(NAMES)
    if unknown:
        raise ValueError(f"no effect {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    tables = []
    for run in runs:
        stop = nature(effects, seed, run, conditions)
        header, rows = records(coach.run(stop), stop, effects, seed, run, conditions)
        np.savetxt(
            folder / "runs" / f"{run}.csv",
            rows,
            delimiter=",",
            header=header,
            comments="",
            fmt=["%.2f", "%.5f"] + ["%.5f"] * 4 + ["%.2f"] * 8,
        )
        group = "validate" if run.startswith("check") else "tune"
        tables.append(
            f'\n[[run]]\nfile = "runs/{run}.csv"\ngroup = "{group}"\n'
            f"initial_speed_m_s = {stop.speed_m_s:.2f}\n"
        )
    head = _HEAD
    if conditions.sensor:
        # nobody declares the noise of such a sensor: it depends on the speed
        head = head.replace(_SPIN_NOISE, "")
    head += f"positions_m = {list(coach.POSITIONS_M)}\n"
    (folder / "dataset.toml").write_text(head + "".join(tables), encoding="utf-8")
    return folder


_SPIN_NOISE = f"wheel_speed_rad_s = {SPIN_NOISE_RAD_S}\n"
_HEAD = f"""kind = "braking_runs"
title = "braking stops of a coach on a contaminated rail"
vehicle = "uic_z1"
sample_time_s = {SAMPLE_S}

[accuracy]
speed_m_s = {SPEED_NOISE_M_S}
wheel_speed_rad_s = {SPIN_NOISE_RAD_S}
torque_fraction = {TORQUE_NOISE}
load_fraction = {LOAD_NOISE}
calibration_fraction = {CALIBRATION}

[axles]
"""


def nature(
    effects: dict[str, float], seed: int, run: str, conditions: Conditions = IDEAL
) -> coach.Stop:
    """Return a stop as it happens. The effects do not change what the random draws decide."""
    of_set = np.random.default_rng((seed, 71))
    rng = np.random.default_rng((seed, 72, RUNS.index(run)))
    axle = int(of_set.integers(4))
    mass_error = of_set.normal(0.0, CALIBRATION)
    patch_m = of_set.uniform(50.0, 90.0)
    patch_length_m = of_set.uniform(40.0, 65.0)
    size = dict.fromkeys(NAMES, 0.0) | effects

    # friction at each place, for each wheelset
    radii = np.full(4, coach.RADIUS_M)
    radii[axle] *= 1.0 + size["wheel_radius"]
    leaf_m = rng.uniform(40.0, 120.0)
    rail = _field(rng)
    treads = np.stack([_field(rng) for _ in range(4)])
    factors = 1.0 + FIELD / np.sqrt(2.0) * (rail + treads)
    if conditions.rail_deviation:
        of_rail, of_tread = rail_deviations(conditions, FIELD)
        if conditions.rail_is_shared:
            rail = _field(np.random.default_rng((seed, 75)))
        factors = 1.0 + of_rail * rail + of_tread * treads
    factors[axle] *= 1.0 - size["one_glazed_tread"]
    begin = _smooth((_PLACES - patch_m) / 8.0)
    end = _smooth((patch_m + patch_length_m - _PLACES) / 8.0)
    factors *= 1.0 - size["contaminated_patch"] * begin * end
    factors *= 1.0 - size["jointed_rail"] * (_PLACES % 25.0 < 1.5)
    factors *= 1.0 + size["leaf_edges"] * _smooth((_PLACES - leaf_m) / 4.0)

    # the order of the draws decides the stop
    speed_m_s = _SPEEDS_M_S[run] + rng.uniform(-0.9, 0.9)
    mu_cd = contact.MU_CD * (1.0 + rng.normal(0.0, SCATTER))
    demand_Nm = rng.uniform(9500.0, 11500.0)
    begin_s = rng.uniform(0.3, 0.9)
    relief_from_s = rng.uniform(6.0, 11.0)
    relief_for_s = rng.uniform(1.0, 2.0)
    sand_from_s = rng.uniform(3.5, 5.5)
    sand_to_s = sand_from_s + rng.uniform(5.0, 8.0)
    high = rng.uniform(0.15, 0.40, 4)
    return coach.Stop(
        speed_m_s=speed_m_s,
        mu_cd=mu_cd,
        demand_Nm=demand_Nm,
        begin_s=begin_s,
        relief_s=(relief_from_s, relief_for_s),
        sand_s=(sand_from_s, sand_to_s),
        high=high,
        factors=factors,
        sizes=np.array([size.get(name, 0.0) for name in coach.ACTING]),
        axle=axle,
        radii_m=radii,
        inertia_kgm2=coach.AXLE_KGM2 * (1.0 + size["wheel_inertia"]),
        mass_kg=coach.MASS_KG * (1.0 + mass_error),
        roller_1_m=_roller(size["roller_curvature"]),
        gradient=size["track_gradient"],
        sloshing=size["sloshing_tank"],
        pads=pad_variation(conditions, seed, RUNS.index(run)),
    )


def records(
    trace: np.ndarray,
    stop: coach.Stop,
    effects: dict[str, float],
    seed: int,
    run: str,
    conditions: Conditions = IDEAL,
) -> tuple[str, np.ndarray]:
    """Return the head and the rows of a CSV file: what sensors show of a trace."""
    of_set = np.random.default_rng((seed, 73))
    rng = np.random.default_rng((seed, 74, RUNS.index(run)))
    torque_gain, load_gain = 1.0 + of_set.normal(0.0, CALIBRATION, 2)
    size = dict.fromkeys(NAMES, 0.0) | effects
    clock = trace[:, coach.TIME]
    at = np.arange(0.0, clock[-1] + 1e-9, SAMPLE_S)

    def sampled(columns: Any, late_s: Any = 0.0) -> np.ndarray:
        """Return columns of the trace at the times of samples, shape (samples, columns)."""
        rows = np.atleast_2d(np.transpose(columns))
        return np.stack([np.interp(at - late_s, clock, row) for row in rows], axis=1)

    spins = coach.four(trace, coach.SPINS).copy()
    loads = coach.four(trace, coach.LOADS) - coach.four(trace, coach.SWINGS)
    spins[:, stop.axle] *= 1.0 + size["tone_wheel_eccentric"] * np.sin(
        trace[:, coach.ANGLES + stop.axle]
    )
    if size["load_transfer"]:
        # the sensors are where a part of the shift does not pass
        braking = -np.gradient(
            uniform_filter1d(trace[:, coach.SPEED_M_S], 601, mode="nearest"), clock
        )
        loads = loads - size["load_transfer"] * loads.mean() * braking[:, None] * _ARMS
    if size["track_waves"]:
        keep = np.exp(-coach.STEP_S / 0.4)
        loads = loads[0] + lfilter([1.0 - keep], [1.0, -keep], loads - loads[0], axis=0)
    torques = sampled(coach.four(trace, coach.TORQUES), size["torque_sensor_delay"])
    speeds = sampled(trace[:, coach.SPEED_M_S])
    spins_late_s = size["speed_sensor_delay"] + size["wheel_clock_drift"] * at

    # the order of the draws decides the noise
    speed_noise = rng.normal(0.0, SPEED_NOISE_M_S, speeds.shape)
    spin_noise = rng.normal(0.0, SPIN_NOISE_RAD_S, torques.shape)
    load_noise = rng.normal(size=torques.shape)
    torque_noise = rng.normal(size=torques.shape)
    shown_spins = sampled(spins, spins_late_s) + spin_noise
    if conditions.sensor:
        wheels = pole_wheels(seed, RUNS.index(run))
        shown_spins = wheel_speeds(conditions, clock, spins, at - spins_late_s, wheels)
    rows = np.hstack(
        [
            at[:, None],
            speeds + speed_noise,
            shown_spins,
            load_gain * sampled(loads)
            + LOAD_NOISE * coach.MASS_KG * coach.G_M_S2 / 4.0 * load_noise,
            torque_gain * torques + TORQUE_NOISE * torques.max() * torque_noise,
        ]
    )

    names = ["time_s", "vehicle_speed_m_s"]
    for name, unit in (("wheel_speed", "rad_s"), ("wheel_load", "N"), ("brake_torque", "Nm")):
        names += [f"{name}_{i}_{unit}" for i in (1, 2, 3, 4)]
    return ",".join(names), rows


def _field(rng: np.random.Generator) -> np.ndarray:
    """Return a Gaussian field over _PLACES: variance 1, correlation exp(-(d / FIELD_M)^2)."""
    width = FIELD_M / 2.0 / coach.CELL_M
    smooth = gaussian_filter1d(rng.normal(size=_PLACES.size), width, mode="wrap")
    return smooth * np.sqrt(2.0 * np.sqrt(np.pi) * width)


def _smooth(x: np.ndarray) -> np.ndarray:
    """Return 0 below -0.5, 1 above 0.5, and half a cosine between them."""
    return 0.5 + 0.5 * np.sin(np.pi * np.clip(x, -0.5, 0.5))


def _roller(lost: float) -> float:
    """Return the curvature (1/m) of the roller that reduces the creep stiffness by this share."""
    if not lost:
        return 0.0

    def too_stiff(curvature_1_m: float) -> float:
        on_rail = contact.stiffness(coach.RADIUS_M)
        return contact.stiffness(coach.RADIUS_M, curvature_1_m) / on_rail - 1.0 + lost

    return brentq(too_stiff, 0.0, 60.0)
