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
from rollerrig.rig.identify.files import units
from rollerrig.rig.identify.statistics import groups

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
# Least standard error of the share of momentum that the torques take, besides the declared
# calibration: it grows by up to 0.004 from fast to slow runs of fault-free sets.
SHARE_ERROR = 0.003
# probability that fault-free runs are parted by chance
_ALPHA = 0.001
# how near a measured share must be to that of another unit of torque
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
        torques = np.array([torques for _, torques in balances])
        error = max(data.accuracy["calibration_fraction"], SHARE_ERROR)
        findings += _check_torques(torques, [run.name for run in runs], error)
    return findings


def _code(loads: float, torques: float) -> Code:
    """Return which number is wrong where loads and weight disagree.

    A wrong mass changes both ratios by the same factor. Wrong loads do not change the torques.
    """
    if abs(torques - loads) < abs(torques - 1.0):
        return Code.MASS
    return Code.LOADS


def _check_torques(shares: np.ndarray, names: list[str], error: float) -> list[Finding]:
    """Return findings on the shares of momentum that the torques take in the runs (runs,).

    `error` is the standard error of a share.
    """
    known = shares[np.isfinite(shares)]
    if not known.size:
        return []
    middle = float(np.median(known))
    if known.size > 1 and np.ptp(known) > LARGEST_SPREAD * middle:
        return [_differing_torques(shares, names, error)]
    unit = _unit_of(middle)
    if unit:
        return [Finding(Code.TORQUE_UNIT, measured=middle, allowed=_SAME_UNIT, detail=unit)]
    if abs(middle - 1.0) > LARGEST_OF_SHARE:
        return [Finding(Code.TORQUE_SHARE, measured=middle, allowed=LARGEST_OF_SHARE)]
    return []


def _differing_torques(shares: np.ndarray, names: list[str], error: float) -> Finding:
    """Return the finding on shares that differ from run to run, with the runs that are apart.

    If these runs have the share of another unit of torque, it is a finding on that unit.
    """
    found = groups.find(shares, np.full(shares.size, error), _ALPHA, tests=1)
    low, high = np.nanmin(shares), np.nanmax(shares)
    if found is None:
        return Finding(
            Code.TORQUE_NOT_ACTING,
            measured=float(high - low),
            allowed=LARGEST_SPREAD,
            detail=f"{low:.2f} to {high:.2f}",
        )
    apart = tuple(names[k] for k in found.apart)
    ratio = float(np.mean(shares[list(found.apart)]) / np.mean(shares[list(found.others)]))
    unit = _unit_of(ratio)
    if unit:
        return Finding(
            Code.TORQUE_UNIT, measured=ratio, allowed=_SAME_UNIT, runs=apart, detail=unit
        )
    return Finding(
        Code.TORQUE_NOT_ACTING,
        measured=ratio,
        allowed=LARGEST_SPREAD,
        runs=apart,
        detail=f"{low:.2f} to {high:.2f}",
    )


def _unit_of(ratio: float) -> str:
    """Return the unit of torque whose numbers, taken for N m, have this ratio; "" for none."""
    for name in units.of_quantity(units.TORQUE):
        unit = units.find(name)
        assert unit is not None
        if unit.factor != 1.0 and abs(ratio * unit.factor - 1.0) < _SAME_UNIT:
            return name
    return ""
