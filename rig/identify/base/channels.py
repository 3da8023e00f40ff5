"""Finds wheel speeds that answer to the torque of another wheelset, equal columns, reversed axles.

[B4] J domega/dt = r T - C: fast changes of the wheel's acceleration are those of -C
[B5] braking moves load forward: the load of the front half less that of the rear half grows
     with the deceleration
"""

from itertools import combinations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import linear_sum_assignment

from rollerrig.rig.identify.base.findings import Code, Finding
from rollerrig.rig.identify.data import units
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.data.smoothing import smoothed

# The correlations of two exchanged channels must grow by this, their sum over both wheelsets, if
# they are exchanged back, and in this share of the runs. Exchanges on two sets gave 0.5 to 0.8, and
# no exchange of a right set gives more than 0. Chosen.
LEAST_GAIN = 0.15
LEAST_SHARE_OF_RUNS = 0.6
# Share of equal samples with which two columns hold the same signal. A column of few values, as of
# counted pulses, is equal to another one by chance as often as to itself a sample later; of the
# other samples this share must be equal.
MOST_EQUAL = 0.5
# Largest load that moves to the rear, as a share of mass times deceleration. Right sets have 0.06
# to 0.11 to the front. Load sensors that miss the transfer can show less than 0, down to half of
# it: that is for the statistics to judge. Chosen.
LARGEST_TO_REAR = 0.045
# correlation of load and deceleration with which their slope counts
LEAST_CORRELATION = 0.5
LOAD_SMOOTHING_S = 0.2
LEAST_SPEED_M_S = 5.0
LEAST_MOVING_S = 4.0


def check(data: Dataset) -> list[Finding]:
    """Return findings on exchanged and equal channels."""
    return [*_check_equal(data), *_check_exchanged(data)]


# --- pairs of wheel speed and torque ---


def _check_exchanged(data: Dataset) -> list[Finding]:
    matrices = [_correlations(run, data.sections["vehicle"]) for run in data.runs]
    known = np.array([matrix for matrix in matrices if matrix is not None])
    if not known.size:
        return []
    mean = known.mean(axis=0)
    _, torque_of = linear_sum_assignment(-mean)
    axles = np.arange(data.axles)
    wrong = np.flatnonzero(torque_of != axles)
    if not wrong.size:
        return []

    # the sum over the wheelsets, after the exchange less before it
    gains = (known[:, wrong, torque_of[wrong]] - known[:, wrong, wrong]).sum(axis=1)
    if gains.mean() < LEAST_GAIN or np.mean(gains > 0.0) < LEAST_SHARE_OF_RUNS:
        return []
    return [
        Finding(
            Code.CHANNELS_EXCHANGED,
            measured=float(gains.mean()),
            allowed=LEAST_GAIN,
            axles=tuple(int(axle) + 1 for axle in wrong),
            detail=", ".join(f"{axle + 1} with {torque_of[axle] + 1}" for axle in wrong),
        )
    ]


def _correlations(run: Run, vehicle: dict[str, float]) -> np.ndarray | None:
    """Return the correlations [B4] of each wheel speed (rows) with each torque (columns).

    None if the run is too short.
    """
    step_s = float(np.mean(np.diff(run.time_s)))
    is_moving = run.speed_m_s > LEAST_SPEED_M_S
    if np.count_nonzero(is_moving) * step_s < LEAST_MOVING_S:
        return None
    window = units.derivative_window(step_s)
    width = max(int(1.0 / step_s), 4)
    inertial = []
    braking = []
    for j in range(run.axles):
        rate = smoothed(run.wheel_speed_rad_s[:, j], window, 3, 1, step_s)
        inertial.append(units.fast_part(vehicle["wheelset_inertia_kgm2"] * rate, width, is_moving))
        torque_Nm = smoothed(run.torque_Nm[:, j], window, 3)
        braking.append(units.fast_part(-torque_Nm, width, is_moving))
    return np.array(inertial) @ np.array(braking).T / np.count_nonzero(is_moving)


def _check_equal(data: Dataset) -> list[Finding]:
    """Return a finding for each two columns of the same quantity with the same samples.

    Torques that are the same at all axles are no mistake: they are computed from one pressure.
    """
    pairs = tuple(combinations(range(data.axles), 2))
    findings: list[Finding] = []
    for quantity, unit in (("wheel_speed", "rad_s"), ("brake_torque", "Nm")):
        equal = []
        for first, second in pairs:
            shares = []
            for run in data.runs:
                values = run.wheel_speed_rad_s if unit == "rad_s" else run.torque_Nm
                equal_share = float(np.mean(values[:, first] == values[:, second]))
                by_chance = float(np.mean(values[1:, first] == values[:-1, first]))
                shares.append((equal_share - by_chance) / max(1.0 - by_chance, 1e-9))
            if min(shares) > MOST_EQUAL:
                equal.append(
                    Finding(
                        Code.CHANNELS_EQUAL,
                        measured=min(shares),
                        allowed=MOST_EQUAL,
                        channels=tuple(f"{quantity}_{k + 1}_{unit}" for k in (first, second)),
                        axles=(first + 1, second + 1),
                    )
                )
        from_one_pressure = unit == "Nm" and len(equal) == len(pairs)
        if not from_one_pressure:
            findings += equal
    return findings


# --- order of the axles ---


def check_order(data: Dataset) -> list[Finding]:
    """Return a finding if braking moves load to the rear.

    Load sensors that miss the transfer of load show the same. So it is a suspicion only, unless
    the adhesion denies that the loads are wrong.
    """
    slopes = []
    for run in data.runs:
        slope = load_to_front(run)
        if slope is not None:
            slopes.append(slope)
    if not slopes:
        return []
    middle = float(np.median(slopes))
    if middle > -LARGEST_TO_REAR:
        return []
    return [Finding(Code.AXLES_REVERSED, measured=-middle, allowed=LARGEST_TO_REAR)]


def load_to_front(run: Run) -> float | None:
    """Return the load that moves to the front, as a share of mass times deceleration [B5].

    None where the loads do not follow the deceleration, or no vehicle is braked.
    """
    if not np.isfinite(run.mass_kg):
        return None
    step_s = float(np.mean(np.diff(run.time_s)))
    width = LOAD_SMOOTHING_S / step_s
    deceleration = -np.gradient(gaussian_filter1d(run.speed_m_s, width)) / step_s
    half = run.axles // 2
    to_front_N = run.load_N[:, :half].sum(axis=1) - run.load_N[:, half:].sum(axis=1)
    to_front_N = gaussian_filter1d(to_front_N, width)
    if deceleration.std() < 1e-9 or to_front_N.std() < 1e-9:
        return None
    correlation = float(np.corrcoef(deceleration, to_front_N)[0, 1])
    if abs(correlation) < LEAST_CORRELATION:
        return None
    return correlation * float(to_front_N.std() / deceleration.std()) / run.mass_kg
