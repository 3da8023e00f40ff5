"""What the sensors of a rig tell of a recorded run: the channels that measured data has.

A recording holds what the physics computed; an explanation must not see more of it than a train's sensors would. Wheel
speed is that of the speed sensor, torque is what the brake's data make of the cylinder pressure [G1], and load is what
the deceleration makes of the static one [G2], so that a brake or a load transfer other than the data say stays hidden
in the motion. Rollers give the speed of the surface under each wheelset.

    [G1] C = c (p - p_spring), not below 0; of a locked wheel what acts, as the rig's load cell has it
    [G2] N_j = N_static + d (+-body / 2 +- bogie), d the deceleration behind the lag of the pitch
    [G3] mean from t - d - T to t - d, T the window, d a tick and the time of half a tooth

A pole wheel tells the mean of a window past, so all other channels are averaged over it too; samples closer than the
dataset's are filtered without phase and thinned (scipy.signal.resample_poly).
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
from rollerrig.wsp_interface.signals import AXLES

SAMPLE_TIME_S = 0.01
SLOWEST_SAMPLE_S = 0.05
_AS_READ = ("time_s", "wheel_speed_rad_s")
# one standard deviation each; a recording has no noise of its own: it is laid over it, and declared
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
    """The channels of a recorded run until it is slower or longer than that, without added noise.

    Raises ConfigError for a recording that is too coarse, or lacks a channel, or a scenario without brake or vehicle.
    """
    slow = np.flatnonzero(
        (recorded.column("vehicle_speed_m_s") <= slowest_m_s)
        | (recorded.column("time_s") > longest_s)
    )
    end = int(slow[0]) if slow.size and slow[0] > 0 else len(recorded.table)
    plan = recorded.scenario

    def each(name: str, unit: str) -> np.ndarray:
        return np.column_stack(
            [recorded.column(f"{name}_{j}_{unit}")[:end] for j in range(1, AXLES + 1)]
        )

    surface = None
    if plan["rig"]["mode"] == "contaminated_rollers":
        surface = plan["contact"]["roller_radius_m"] * each("roller_speed", "rad_s")
    wheel_rad_s = each("measured_speed", "rad_s")
    if plan["rig"]["mode"] == params.VIRTUAL_TRACK:
        # the track is the virtual wheels'; what the motors miss of their turning is recorded beside it
        wheel_rad_s = (
            wheel_rad_s - each("tracking_error", "m_s") / plan["vehicle"]["wheel_radius_m"]
        )
    # what the scenario says of brake and vehicle, without mechanisms, as a planar vehicle
    sections = {name: dict(plan[name]) for name in params.ROWS if name in plan} | {"mechanisms": {}}
    sections["vehicle"] = {**sections.get("vehicle", {}), "model": "planar"}
    model = params.build(
        params.check(sections, str(recorded.folder / run_folder.SCENARIO)),
        params.Friction(*[np.zeros(0)] * len(params.Friction._fields)),
        params.Demand(*np.zeros((2, 0))),
        1e-3,
        10,
    )
    held_Nm = np.maximum(
        model.brake.torque_Nm_Pa
        * (each("cylinder_pressure", "Pa") - model.brake.spring_pressure_Pa),
        0.0,
    )  # [G1]
    run = Run(
        name=recorded.folder.resolve().name,
        group="tune",
        mu_cd=None,
        mass_kg=np.inf if plan["rig"].get("speed") == "held" else plan["vehicle"]["mass_kg"],
        time_s=recorded.column("time_s")[:end],
        speed_m_s=recorded.column("vehicle_speed_m_s")[:end],
        wheel_speed_rad_s=wheel_rad_s,
        # the multibody coach has no such formula
        load_N=_load(model.vehicle, recorded, end)
        if plan["vehicle"]["model"] == "planar"
        else each("wheel_load", "N"),
        torque_Nm=np.where(each("wheel_speed", "rad_s") > 0.0, held_Nm, each("brake_torque", "Nm")),
        position_m=recorded.column("position_m")[:end],
        surface_m_s=surface,
    )
    if plan["sensor"]["model"] == "pole_wheel":
        run = _averaged(run, plan)
    return _thinned(run, recorded.folder)


def noisy(run: Run, noise: Mapping[str, float], rng: np.random.Generator) -> Run:
    """The same with noise and scale errors of a declared size, as `NOISE` has them."""
    n, axles = run.load_N.shape
    scale = 1.0 + noise["calibration_fraction"] * rng.standard_normal((2, axles))
    static, most = float(run.load_N.mean()), float(np.max(np.abs(run.torque_Nm)))
    return run._replace(
        speed_m_s=run.speed_m_s + noise["speed_m_s"] * rng.standard_normal(n),
        wheel_speed_rad_s=run.wheel_speed_rad_s
        + noise["wheel_speed_rad_s"] * rng.standard_normal((n, axles)),
        load_N=run.load_N * scale[0]
        + noise["load_fraction"] * static * rng.standard_normal((n, axles)),
        torque_Nm=run.torque_Nm * scale[1]
        + noise["torque_fraction"] * most * rng.standard_normal((n, axles)),
    )


def _load(vehicle: params.Vehicle, run: records.Run, end: int) -> np.ndarray:
    """Loads in N, shape (n, 4) [G2]."""
    step_s = float(np.median(np.diff(run.column("time_s"))))
    keep = np.exp(-step_s / vehicle.pitch_time_constant_s)
    felt = lfilter(
        [0.5 * (1.0 - keep)] * 2, [1.0, -keep], run.column("vehicle_acceleration_m_s2")[:end]
    )
    body = 0.5 * vehicle.body_transfer_kg * np.array([1.0, 1.0, -1.0, -1.0])
    bogie = vehicle.bogie_transfer_kg * np.array([1.0, -1.0, 1.0, -1.0])
    return np.maximum(vehicle.static_load_N - felt[:, None] * (body + bogie), 0.0)


def _averaged(run: Run, plan: Mapping[str, Any]) -> Run:
    """All channels but the wheel speeds as their mean over what a pole wheel has measured [G3]."""
    time_s, window_s = run.time_s, plan["sensor"]["window_s"]
    pitch_rad = 2.0 * np.pi / plan["sensor"]["teeth"]
    late_s = 1.0 / plan["loop"]["tick_hz"] + 0.5 * pitch_rad / np.maximum(
        run.wheel_speed_rad_s, 1.0
    )

    def mean(values: np.ndarray, late_s: np.ndarray) -> np.ndarray:
        way = CubicSpline(time_s, values).antiderivative()
        out = (way(time_s - late_s) - way(time_s - late_s - window_s)) / window_s
        early = time_s - time_s[0] < window_s + late_s
        out[early] = values[early]
        return out

    def averaged(values: np.ndarray) -> np.ndarray:
        if values.ndim == 1:
            return mean(values, late_s.mean(axis=1))
        return np.column_stack([mean(values[:, j], late_s[:, j]) for j in range(AXLES)])

    # the reading is new once in a window and is held in between
    every = max(round(window_s / float(np.median(np.diff(time_s)))), 1)
    kept: dict[str, Any] = {
        name: (values if name in _AS_READ else averaged(values))[::every]
        for name, values in _arrays(run).items()
    }
    return run._replace(**kept)


def _arrays(run: Run) -> dict[str, np.ndarray]:
    return {
        name: values for name, values in run._asdict().items() if isinstance(values, np.ndarray)
    }


def _thinned(run: Run, folder: Path) -> Run:
    step_s = float(np.median(np.diff(run.time_s)))
    if step_s > SLOWEST_SAMPLE_S:
        raise ConfigError(
            f"{folder}: recorded every {step_s:g} s; a stop is explained from samples at most "
            f"{SLOWEST_SAMPLE_S:g} s apart: run it with loop.record_hz = 100"
        )
    ratio = Fraction(SAMPLE_TIME_S / step_s).limit_denominator(50)
    if ratio <= 1:
        return run
    kept: dict[str, Any] = {
        name: resample_poly(values, ratio.denominator, ratio.numerator, axis=0, padtype="line")
        for name, values in _arrays(run).items()
    }
    return run._replace(
        **kept | {"time_s": run.time_s[0] + SAMPLE_TIME_S * np.arange(len(kept["speed_m_s"]))}
    )
