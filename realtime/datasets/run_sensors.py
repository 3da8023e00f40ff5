"""The channels that the sensors of a rig would have measured in a recorded run.

A recording holds what the physics computed. An explanation must not use more of it than the sensors
of a train would give. The wheel speed is that of the speed sensor. The torque is computed from the
cylinder pressure with the stated brake [G1], and the load from the deceleration and the static load
[G2]. A brake or a load transfer that differs from the stated one shows only in the motion.
Rollers give the speed of the surface under each wheelset.

    [G1] C = c (p - p_spring), not below 0; of a locked wheel what acts, as the load cell of the rig
         measures it
    [G2] N_j = N_static + d (+-body / 2 +- bogie), d the deceleration behind the lag of the pitch
    [G3] mean from t - d - T to t - d, T the window, d a tick and the time of half a tooth

A pole wheel gives the mean over a window that has passed, so all other channels are averaged over
this window as well. Samples closer than those of the dataset are filtered without phase and thinned
(scipy.signal.resample_poly).
"""

from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter, resample_poly

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record import records, run_folder
from rollerrig.rig import params
from rollerrig.rig.identify.data.runs import Run

SAMPLE_TIME_S = 0.01  # of a dataset
SLOWEST_SAMPLE_S = 0.05  # samples further apart cannot be explained
_LARGEST_DENOMINATOR = 50  # of the ratio of the sample times
# channels that a pole wheel does not average: time, and what it has averaged already
_NOT_AVERAGED = ("time_s", "wheel_speed_rad_s")
# Standard deviations of the noise that is added to a recording, which has no noise itself. The
# dataset declares them.
NOISE = {
    "speed_m_s": 0.01,
    "wheel_speed_rad_s": 0.02,
    "torque_fraction": 0.005,
    "load_fraction": 0.003,
    "calibration_fraction": 0.001,
}
PERFECT = dict.fromkeys(NOISE, 0.0)
# what sensors of a test train may reach (assumption)
TRAIN = {
    "speed_m_s": 0.03,
    "wheel_speed_rad_s": 0.067,
    "torque_fraction": 0.015,
    "load_fraction": 0.01,
    "calibration_fraction": 0.003,
}


def of_run(recorded: records.Run, slowest_m_s: float, longest_s: float = np.inf) -> Run:
    """Return the measured channels of a recorded run, without noise.

    The run ends at the first sample that is not faster than `slowest_m_s` or later than
    `longest_s`. Raises ConfigError for a recording that is too coarse or lacks a channel, and for a
    scenario without brake or vehicle.
    """
    plan = recorded.scenario
    end = _end(recorded, slowest_m_s, longest_s)

    def of_all_axles(name: str, unit: str) -> np.ndarray:
        columns = [f"{name}_{axle}_{unit}" for axle in recorded.signal_table.axles]
        return np.column_stack([recorded.column(column)[:end] for column in columns])

    surface_m_s = None
    if plan["rig"]["mode"] == "contaminated_rollers":
        roller_radius_m = plan["contact"]["roller_radius_m"]
        surface_m_s = roller_radius_m * of_all_axles("roller_speed", "rad_s")

    wheel_rad_s = of_all_axles("measured_speed", "rad_s")
    if plan["rig"]["mode"] == params.VIRTUAL_TRACK:
        # the wheels of the track are virtual; the recorded error of the motors leads to their speed
        error_m_s = of_all_axles("tracking_error", "m_s")
        wheel_rad_s = wheel_rad_s - error_m_s / plan["vehicle"]["wheel_radius_m"]

    model = _stated_model(recorded)
    # [G1]
    pressure_Pa = of_all_axles("cylinder_pressure", "Pa")
    braking_Pa = pressure_Pa - model.brake.spring_pressure_Pa
    pads_Nm = np.maximum(model.brake.torque_Nm_Pa * braking_Pa, 0.0)
    turns = of_all_axles("wheel_speed", "rad_s") > 0.0
    torque_Nm = np.where(turns, pads_Nm, of_all_axles("brake_torque", "Nm"))

    if plan["vehicle"]["model"] == "planar":
        load_N = _load(model.vehicle, recorded, end)
    else:
        # no such formula holds for the multibody coach
        load_N = of_all_axles("wheel_load", "N")

    is_held = plan["rig"].get("speed") == "held"
    run = Run(
        name=recorded.folder.resolve().name,
        group="tune",
        mu_cd=None,
        mass_kg=np.inf if is_held else plan["vehicle"]["mass_kg"],
        time_s=recorded.column("time_s")[:end],
        speed_m_s=recorded.column("vehicle_speed_m_s")[:end],
        wheel_speed_rad_s=wheel_rad_s,
        load_N=load_N,
        torque_Nm=torque_Nm,
        position_m=recorded.column("position_m")[:end],
        surface_m_s=surface_m_s,
    )
    if plan["sensor"]["model"] == "pole_wheel":
        run = _averaged(run, plan)
    return _thinned(run, recorded.folder)


def _end(recorded: records.Run, slowest_m_s: float, longest_s: float) -> int:
    """Return the number of samples before the first one that is too slow or too late."""
    is_slow = recorded.column("vehicle_speed_m_s") <= slowest_m_s
    is_late = recorded.column("time_s") > longest_s
    beyond = np.flatnonzero(is_slow | is_late)
    if beyond.size and beyond[0] > 0:
        return int(beyond[0])
    return len(recorded.table)


def _stated_model(recorded: records.Run) -> params.Params:
    """Return brake and vehicle as the scenario states them: planar, without mechanisms."""
    plan = recorded.scenario
    sections = {name: dict(plan[name]) for name in params.ROWS if name in plan}
    sections["mechanisms"] = {}
    sections["vehicle"] = {**sections.get("vehicle", {}), "model": "planar"}
    no_friction_changes = params.Friction(*[np.zeros(0) for _ in params.Friction._fields])
    no_demand = params.Demand(*np.zeros((2, 0)))
    # nothing is simulated with the model, so the length of a tick does not matter
    return params.build(
        params.check(sections, str(recorded.folder / run_folder.SCENARIO)),
        no_friction_changes,
        no_demand,
        tick_s=1e-3,
        substeps=10,
    )


def noisy(run: Run, noise: Mapping[str, float], rng: np.random.Generator) -> Run:
    """Return the run with added noise and scale errors; `noise` has the keys of `NOISE`."""
    shape = run.load_N.shape
    samples, axles = shape
    # the order of the draws decides the noise of a seed
    scale = 1.0 + noise["calibration_fraction"] * rng.standard_normal((2, axles))
    speed_m_s = run.speed_m_s + noise["speed_m_s"] * rng.standard_normal(samples)
    wheel_rad_s = run.wheel_speed_rad_s + noise["wheel_speed_rad_s"] * rng.standard_normal(shape)
    static_N = float(run.load_N.mean())
    load_N = run.load_N * scale[0] + noise["load_fraction"] * static_N * rng.standard_normal(shape)
    most_Nm = float(np.max(np.abs(run.torque_Nm)))
    torque_noise_Nm = noise["torque_fraction"] * most_Nm * rng.standard_normal(shape)
    return run._replace(
        speed_m_s=speed_m_s,
        wheel_speed_rad_s=wheel_rad_s,
        load_N=load_N,
        torque_Nm=run.torque_Nm * scale[1] + torque_noise_Nm,
    )


def _load(vehicle: params.Vehicle, run: records.Run, end: int) -> np.ndarray:
    """Return the loads in N, shape (end, axles) [G2]."""
    step_s = float(np.median(np.diff(run.column("time_s"))))
    keep = np.exp(-step_s / vehicle.pitch_time_constant_s)
    half_new = 0.5 * (1.0 - keep)
    # the acceleration behind the lag of the pitch; -d of [G2]
    lagged_m_s2 = lfilter(
        [half_new, half_new], [1.0, -keep], run.column("vehicle_acceleration_m_s2")[:end]
    )
    transfer_N = lagged_m_s2[:, None] * vehicle.transfer_kg
    return np.maximum(vehicle.static_load_N - transfer_N, 0.0)


def _averaged(run: Run, plan: Mapping[str, Any]) -> Run:
    """Return the run with all channels averaged over the window of the pole wheel [G3].

    The wheel speeds are such means already.
    """
    time_s = run.time_s
    window_s = plan["sensor"]["window_s"]
    pitch_rad = 2.0 * np.pi / plan["sensor"]["teeth"]
    half_tooth_s = 0.5 * pitch_rad / np.maximum(run.wheel_speed_rad_s, 1.0)
    late_s = 1.0 / plan["loop"]["tick_hz"] + half_tooth_s

    def mean(values: np.ndarray, late_s: np.ndarray) -> np.ndarray:
        integral = CubicSpline(time_s, values).antiderivative()
        means = (integral(time_s - late_s) - integral(time_s - late_s - window_s)) / window_s
        # the first windows begin before the run
        early = time_s - time_s[0] < window_s + late_s
        means[early] = values[early]
        return means

    def averaged(values: np.ndarray) -> np.ndarray:
        if values.ndim == 1:
            return mean(values, late_s.mean(axis=1))
        return np.column_stack([mean(values[:, j], late_s[:, j]) for j in range(run.axles)])

    # the sensor gives a new value once in a window and holds it in between
    step_s = float(np.median(np.diff(time_s)))
    every = max(round(window_s / step_s), 1)
    new: dict[str, Any] = {}
    for name, values in _arrays(run).items():
        channel = values if name in _NOT_AVERAGED else averaged(values)
        new[name] = channel[::every]
    return run._replace(**new)


def _arrays(run: Run) -> dict[str, np.ndarray]:
    return {
        name: values for name, values in run._asdict().items() if isinstance(values, np.ndarray)
    }


def _thinned(run: Run, folder: Path) -> Run:
    """Return the run with the sample time of a dataset; one with longer steps is not changed."""
    step_s = float(np.median(np.diff(run.time_s)))
    if step_s > SLOWEST_SAMPLE_S:
        raise ConfigError(
            f"{folder}: recorded every {step_s:g} s, but an explanation needs samples at most "
            f"{SLOWEST_SAMPLE_S:g} s apart; run it with loop.record_hz = 100"
        )
    ratio = Fraction(SAMPLE_TIME_S / step_s).limit_denominator(_LARGEST_DENOMINATOR)
    if ratio <= 1:
        return run
    new: dict[str, Any] = {}
    for name, values in _arrays(run).items():
        new[name] = resample_poly(
            values, ratio.denominator, ratio.numerator, axis=0, padtype="line"
        )
    samples = len(new["speed_m_s"])
    new["time_s"] = run.time_s[0] + SAMPLE_TIME_S * np.arange(samples)
    return run._replace(**new)
