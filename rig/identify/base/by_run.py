"""Measures each run by itself, without a model of adhesion: what sensors and vehicle show of it.

Two rigs, a changed wheel, a payload that nobody declared or a sensor of another day make runs
differ. Pooled runs hide this. Each quantity has a standard error with which runs of one vehicle
and one set of sensors agree.

The balances are [B2] and [B3] of `weight`, rolling is [B1] of `rolling`, the load to the front is
[B5] of `channels`. The friction of a run is the median of

    [B6] mu = (J domega/dt + C) / (r N) while a wheel slides by more than LEAST_CREEPAGE
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.base import channels, rolling, weight
from rollerrig.rig.identify.data.preparation import estimated_noise
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.data.smoothing import smoothed

# standard error of the load of a wheelset as a share of all loads. Chosen: braking moves 0.01 of
# the load for each m/s^2.
LOAD_ERROR = 0.005
# Standard error of the friction of a run, as a share. Chosen: friction scatters by 5 % from run to
# run, and the sliding of the runs differs.
FRICTION_ERROR = 0.10
# standard error of the load that moves to the front, as a share of mass times deceleration. Chosen.
TO_FRONT_ERROR = 0.02
# standard error of the noise of a channel, as a share. Chosen.
NOISE_ERROR = 0.10

LEAST_CREEPAGE = 0.02
LEAST_SPEED_M_S = 5.0
LEAST_SLIDING_SAMPLES = 50
SMOOTHING_S = 0.2


class Quantity(StrEnum):
    """What is measured of a run."""

    TORQUE = "torque"  # share of the momentum that the torques take, 1 is right
    LOAD = "load"  # all loads as a share of the weight
    LOAD_OF_AXLE = "load_of_axle"  # load of a wheelset as a share of all loads
    ROLLING = "rolling"  # ratio of the wheelsets' median to the vehicle
    ROLLING_OF_AXLE = "rolling_of_axle"  # ratio of a wheelset to that median
    TO_FRONT = "to_front"  # load that braking moves to the front
    FRICTION = "friction"  # logarithm of the friction while sliding
    NOISE = "noise"  # logarithm of the noise of a speed


class ByRun(NamedTuple):
    """A quantity of each run (runs,), with its standard error; NaN where a run does not show it."""

    quantity: Quantity
    channel: str  # column of a wheelset; "" for the whole vehicle
    sizes: np.ndarray
    errors: np.ndarray

    @property
    def is_logarithm(self) -> bool:
        """Whether the sizes are logarithms, so that a difference is a ratio."""
        return self.quantity in (Quantity.FRICTION, Quantity.NOISE)


def measure(data: Dataset) -> list[ByRun]:
    """Return all quantities of the runs of a dataset, in their order."""
    calibration = max(data.accuracy["calibration_fraction"], weight.SHARE_ERROR)
    rolls = rolling.by_run(data)
    middle = np.median(rolls, axis=1)
    balances = [_balance(run, data) for run in data.runs]

    def by_run(quantity: Quantity, sizes: list[float], error: float, channel: str = "") -> ByRun:
        values = np.array(sizes, dtype=float)
        return ByRun(quantity, channel, values, np.full(values.size, error))

    found = [
        by_run(Quantity.TORQUE, [one.torques for one in balances], calibration),
        by_run(Quantity.LOAD, [one.loads for one in balances], calibration),
        by_run(Quantity.ROLLING, middle.tolist(), rolling.BY_RUN_ERROR),
        by_run(Quantity.TO_FRONT, [_to_front(run) for run in data.runs], TO_FRONT_ERROR),
        by_run(Quantity.FRICTION, [_ln_friction(run, data) for run in data.runs], FRICTION_ERROR),
        by_run(
            Quantity.NOISE,
            [_ln_noise(run.speed_m_s) for run in data.runs],
            NOISE_ERROR,
            "vehicle_speed_m_s",
        ),
    ]
    for axle in range(data.axles):
        wheel = f"wheel_speed_{axle + 1}_rad_s"
        load = f"wheel_load_{axle + 1}_N"
        ratios = (rolls[:, axle] / middle).tolist()
        shares = [float(r.load_N[:, axle].sum() / r.load_N.sum()) for r in data.runs]
        noises = [_ln_noise(run.wheel_speed_rad_s[:, axle]) for run in data.runs]
        found += [
            by_run(Quantity.ROLLING_OF_AXLE, ratios, rolling.BY_RUN_ERROR, wheel),
            by_run(Quantity.LOAD_OF_AXLE, shares, LOAD_ERROR, load),
            by_run(Quantity.NOISE, noises, NOISE_ERROR, wheel),
        ]
    return found


def _balance(run: Run, data: Dataset) -> weight.Balance:
    """Return the balances of a run; NaN where drives held the speed."""
    if not np.isfinite(run.mass_kg):
        return weight.Balance(np.nan, np.nan)
    return weight.balance(run, data)


def _to_front(run: Run) -> float:
    to_front = channels.load_to_front(run)
    return np.nan if to_front is None else to_front


def _ln_friction(run: Run, data: Dataset) -> float:
    """Return the logarithm of the friction of a run [B6]; NaN if the wheels hardly slide."""
    vehicle = data.sections["vehicle"]
    radius_m = vehicle["wheel_radius_m"]
    step_s = float(np.mean(np.diff(run.time_s)))
    window = 2 * max(int(0.5 * SMOOTHING_S / step_s), 2) + 1
    surface_m_s = rolling.surface_speed(run)
    adhesion = []
    for axle in range(run.axles):
        rate = smoothed(run.wheel_speed_rad_s[:, axle], window, 3, 1, step_s)
        force_Nm = vehicle["wheelset_inertia_kgm2"] * rate + run.torque_Nm[:, axle]
        sliding_m_s = surface_m_s[:, axle] - radius_m * run.wheel_speed_rad_s[:, axle]
        slides = sliding_m_s > LEAST_CREEPAGE * surface_m_s[:, axle]
        slides &= surface_m_s[:, axle] > LEAST_SPEED_M_S
        load_N = float(run.load_N[:, axle].mean())
        adhesion.append(force_Nm[slides] / (radius_m * load_N))
    sliding = np.concatenate(adhesion)
    if sliding.size < LEAST_SLIDING_SAMPLES:
        return np.nan
    middle = float(np.median(sliding))
    return float(np.log(middle)) if middle > 0.0 else np.nan


def _ln_noise(values: np.ndarray) -> float:
    """Return the logarithm of the noise of a channel; NaN if it has none."""
    noise = estimated_noise(values)
    return float(np.log(noise)) if noise > 0.0 else np.nan
