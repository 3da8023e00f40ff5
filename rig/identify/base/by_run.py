"""Measures each run by itself, without a model of adhesion: what sensors and vehicle show of it.

Two rigs, a changed wheel, a payload that nobody declared or a sensor of another day make runs
differ. Pooled runs hide this. Each quantity has a standard error with which runs of one vehicle
and one set of sensors agree.

The balances are [B2] and [B3] of `weight`, rolling is [B1] of `rolling`, the load to the front is
[B5] of `channels`. Friction falls with sliding and with the speed, so fast runs have less of it.
That of a run is compared in cells of equal sliding and speed:

    [B6] mu = (J domega/dt + C) / (r N) while a wheel slides by more than LEAST_CREEPAGE
    [B7] ln median(mu) in a cell = x of the run + y of the cell, by least squares
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rollerrig.rig.identify.base import channels, rolling, weight
from rollerrig.rig.identify.data.preparation import estimated_noise
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.data.smoothing import smoothed

# standard error of the load of a wheelset as a share of all loads. Chosen: braking moves 0.01 of
# the load for each m/s^2.
LOAD_ERROR = 0.005
# Standard error of the friction of a run, as a share. Friction scatters by 5 % from run to run; of
# 42 runs of seven fault-free sets, 0.04 was the standard deviation of [B7].
FRICTION_ERROR = 0.06
# edges of the cells of sliding and speed, m/s
SLIDING_EDGES_M_S = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0)
SPEED_EDGES_M_S = (10.0, 15.0, 20.0, 25.0, 30.0, 35.0)
# standard error of the load that moves to the front, as a share of mass times deceleration. Chosen.
TO_FRONT_ERROR = 0.02
# standard error of the noise of a channel, as a share. Chosen.
NOISE_ERROR = 0.10

LEAST_CREEPAGE = 0.02
LEAST_SPEED_M_S = 5.0
LEAST_CELL_SAMPLES = 30
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
        by_run(Quantity.FRICTION, _ln_frictions(data).tolist(), FRICTION_ERROR),
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


class _Cell(NamedTuple):
    """The friction of a run in a cell of equal sliding and speed."""

    run: int
    cell: int
    ln_friction: float
    samples: int


def _ln_frictions(data: Dataset) -> np.ndarray:
    """Return the logarithm of the friction of each run, less the mean of all [B7] (runs,).

    NaN where a run hardly slides, or shares no cells with most of the other runs.
    """
    cells = [cell for k in range(len(data.runs)) for cell in _cells(k, data)]
    found = np.full(len(data.runs), np.nan)
    if not cells:
        return found
    run = np.array([one.run for one in cells])
    _, cell = np.unique([one.cell for one in cells], return_inverse=True)
    number = len(data.runs)

    # runs without a cell in common cannot be compared: the largest group of connected runs is kept
    nodes = number + int(cell.max()) + 1
    links = coo_array((np.ones(run.size), (run, number + cell)), shape=(nodes, nodes))
    _, part = connected_components(links, directed=False)
    largest = int(np.argmax(np.bincount(part[np.unique(run)])))
    kept = part[run] == largest

    design = np.zeros((int(kept.sum()), nodes))
    design[np.arange(design.shape[0]), run[kept]] = 1.0
    design[np.arange(design.shape[0]), number + cell[kept]] = 1.0
    weight = np.sqrt([one.samples for one in cells])[kept]
    frictions = np.array([one.ln_friction for one in cells])[kept]
    solution = np.linalg.lstsq(design * weight[:, None], frictions * weight, rcond=None)[0]
    compared = np.unique(run[kept])
    found[compared] = solution[compared] - solution[compared].mean()
    return found


def _cells(number_of_run: int, data: Dataset) -> list[_Cell]:
    """Return the friction of a run in all cells in which its wheels slide long enough [B6]."""
    run = data.runs[number_of_run]
    vehicle = data.sections["vehicle"]
    radius_m = vehicle["wheel_radius_m"]
    step_s = float(np.mean(np.diff(run.time_s)))
    window = 2 * max(int(0.5 * SMOOTHING_S / step_s), 2) + 1
    surface_m_s = rolling.surface_speed(run)
    numbers = []
    adhesions = []
    for axle in range(run.axles):
        rate = smoothed(run.wheel_speed_rad_s[:, axle], window, 3, 1, step_s)
        force_Nm = vehicle["wheelset_inertia_kgm2"] * rate + run.torque_Nm[:, axle]
        adhesion = force_Nm / (radius_m * float(run.load_N[:, axle].mean()))
        speed_m_s = surface_m_s[:, axle]
        sliding_m_s = speed_m_s - radius_m * run.wheel_speed_rad_s[:, axle]
        slides = (sliding_m_s > LEAST_CREEPAGE * speed_m_s) & (speed_m_s > LEAST_SPEED_M_S)
        slides &= adhesion > 0.0
        by_sliding = np.digitize(sliding_m_s[slides], SLIDING_EDGES_M_S)
        by_speed = np.digitize(speed_m_s[slides], SPEED_EDGES_M_S)
        numbers.append(by_sliding * (len(SPEED_EDGES_M_S) + 1) + by_speed)
        adhesions.append(adhesion[slides])
    number = np.concatenate(numbers)
    adhesion = np.concatenate(adhesions)
    found = []
    for cell in np.unique(number):
        inside = adhesion[number == cell]
        if inside.size >= LEAST_CELL_SAMPLES:
            ln_friction = float(np.log(np.median(inside)))
            found.append(_Cell(number_of_run, int(cell), ln_friction, inside.size))
    return found


def _ln_noise(values: np.ndarray) -> float:
    """Return the logarithm of the noise of a channel; NaN if it has none."""
    noise = estimated_noise(values)
    return float(np.log(noise)) if noise > 0.0 else np.nan
