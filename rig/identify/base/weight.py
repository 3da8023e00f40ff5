"""Compares loads with the weight, and torques with the momentum that the vehicle loses.

[B2] sum N = M g
[B3] integral of sum C / r dt = M (v0 - v1) + sum J (omega0 - omega1) / r - resistance
"""

from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import GRAVITY_M_S2
from rollerrig.rig.identify.base.findings import Code, Finding
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.data.units import torque_share

# Largest deviation of the loads from the weight, and the same in units of the declared calibration.
# It is below 0.8 % on 105 sets with a declared calibration of 0.3 %. Chosen.
LARGEST_DEVIATION = 0.03
LARGEST_IN_CALIBRATIONS = 6.0
# Largest difference between the shares of momentum that the torques take in different runs. Chosen
# above a brake that is 6 % stronger in half of the runs, which is for the statistics to judge.
LARGEST_SPREAD = 0.12
# Largest deviation of that share from 1, the same in all runs: a gradient of 25 in 1000, which no
# stop on a level track explains. Chosen.
LARGEST_OF_SHARE = 0.25
# shares of other units of torque, and how near a measured share must be
_UNITS = ((0.73756, "lbf ft"),)
_SAME_UNIT = 0.012


class Balance(NamedTuple):
    """The balances of a run as ratios: 1 is right."""

    loads: float  # [B2]
    torques: float  # [B3]; NaN: the brakes took too little momentum


def balance(run: Run, data: Dataset) -> Balance:
    """Return the balances of a run on a track."""
    loads_N = float(run.load_N.sum(axis=1).mean())
    share = torque_share(run, data.sections["vehicle"])
    return Balance(loads_N / (run.mass_kg * GRAVITY_M_S2), float("nan") if share is None else share)


def check(data: Dataset) -> list[Finding]:
    """Return findings on mass, loads and torques of the runs on a track."""
    runs = [run for run in data.runs if np.isfinite(run.mass_kg)]
    if not runs:
        return []
    balances = [balance(run, data) for run in runs]
    allowed = max(
        LARGEST_DEVIATION, LARGEST_IN_CALIBRATIONS * data.accuracy["calibration_fraction"]
    )

    findings = []
    for code in (Code.MASS, Code.LOADS):
        wrong = [
            k
            for k, (loads, torques) in enumerate(balances)
            if abs(loads - 1.0) > allowed and _code(loads, torques) is code
        ]
        if wrong:
            findings.append(
                Finding(
                    code,
                    measured=float(np.median([balances[k].loads for k in wrong])),
                    allowed=allowed,
                    runs=tuple(runs[k].name for k in wrong),
                )
            )
    if not findings:
        findings += _check_torques(np.array([torques for _, torques in balances]))
    return findings


def _code(loads: float, torques: float) -> Code:
    """Return which number is wrong where loads and weight disagree.

    A wrong mass changes both ratios by the same factor. Wrong loads do not change the torques.
    """
    if abs(torques - loads) < abs(torques - 1.0):
        return Code.MASS
    return Code.LOADS


def _check_torques(shares: np.ndarray) -> list[Finding]:
    """Return findings on the shares of momentum that the torques take in the runs."""
    shares = shares[np.isfinite(shares)]
    if not shares.size:
        return []
    middle = float(np.median(shares))
    if shares.size > 1 and np.ptp(shares) > LARGEST_SPREAD * middle:
        return [
            Finding(
                Code.TORQUE_NOT_ACTING,
                measured=float(np.ptp(shares)),
                allowed=LARGEST_SPREAD,
                detail=f"{shares.min():.2f} to {shares.max():.2f}",
            )
        ]
    for share, unit in _UNITS:
        if abs(middle / share - 1.0) < _SAME_UNIT:
            return [Finding(Code.TORQUE_UNIT, measured=middle, allowed=_SAME_UNIT, detail=unit)]
    if abs(middle - 1.0) > LARGEST_OF_SHARE:
        return [Finding(Code.TORQUE_SHARE, measured=middle, allowed=LARGEST_OF_SHARE)]
    return []
