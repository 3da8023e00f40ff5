"""Measures what an explanation is worth on stops that were never fitted.

Base and extended model each keep what they learned on the tuning runs; only the level of the contaminant of each new
stop is found anew, for both alike. What counts is the adhesion that each model lacks: what the filter of the wheel has
to add to it [G2], which knows the sensors' noise; for causes in the vehicle it is the speed that five seconds of free
running predict. A block bootstrap gives the interval, and a gain whose interval holds 0 is not claimed.

    [G1] f = (J domega/dt + C) / (r N), with what the model says of J, C, r and N; for the pictures
    [G2] f (e^m - 1), f and the irregularity m along the filtered wheel speed
"""

from typing import Any, NamedTuple

import numpy as np

from rollerrig.rig.identify.causes.candidates import Explanation, inputs
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import WINDOW_S, Design
from rollerrig.rig.identify.data.smoothing import smoothed
from rollerrig.rig.identify.decide import fitting
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.identify.replay.sensitivity import Inputs
from rollerrig.rig.mechanisms.mechanism import TORQUE, VEHICLE
from rollerrig.rig.mechanisms.table import BY_NAME

BLOCK_S, FREE_RUN_S, SLOWEST_M_S = 3.0, 5.0, 5.0
ADHESION, FREE_RUN = "adhesion_rmse", "free_running_speed_rmse_m_s"


class Gain(NamedTuple):
    """Root mean square errors before and after on some runs, and the share that went away."""

    runs: tuple[str, ...]
    metric: str
    before: float
    after: float
    reduction: float
    ci95: tuple[float, float]
    likelihood: float  # drop of the deviance on these runs
    by_run: dict[
        str, tuple[float, float, float, float]
    ]  # errors before and after, 95 % interval of the reduction

    @property
    def claimed(self) -> bool:
        """Whether the gain is beyond doubt."""
        return self.ci95[0] > 0.0 and self.likelihood > 0.0


def predicted(i: Inputs, at: slice, omega: np.ndarray, p: np.ndarray, step_s: float) -> np.ndarray:
    """(sliding, adhesion) of one wheel along its speed, each shape (n,)."""
    sliding = i.speed_m_s[at] - p[parameters.RADIUS] * omega
    f, _ = sensitivity.replay_law(
        sliding,
        i.speed_m_s[at],
        i.load_N[at],
        i.friction[:, at],
        p,
        step_s,
        np.zeros(omega.size + 1),
        True,
    )
    return np.array([sliding, f])


def adhesion(design: Design, explanation: Explanation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(measured [G1], modelled, sliding) adhesion at every sample, flat."""
    i = inputs(design, explanation)
    measured, model, sliding = np.empty((3, design.measured_rad_s.size))
    window = max(5, 2 * int(0.5 * WINDOW_S / design.step_s) + 1)
    for s in range(design.segments):
        at, p = design.span(s), i.parameters[s]
        omega = smoothed(design.measured_rad_s[at], window, 3)
        rate = smoothed(design.measured_rad_s[at], window, 3, 1, design.step_s)
        torque = smoothed(i.torque_Nm[at], window, 3)
        measured[at] = (p[parameters.INERTIA] * rate + torque) / (
            p[parameters.RADIUS] * i.load_N[at]
        )
        sliding[at], model[at] = predicted(i, at, omega, p, design.step_s)
        model[at] = smoothed(model[at], window, 3)
    return measured, model, sliding


def free_running(design: Design, explanation: Explanation) -> np.ndarray:
    """Error in m/s of the speed that the force balance gives 5 s ahead, per vehicle sample."""
    i = inputs(design, explanation)
    out = np.zeros(design.vehicle_m_s.size)
    ahead = int(FREE_RUN_S / design.step_s)
    for run in range(design.mass_kg.size):
        at = design.vehicle_span(run)
        lost = np.cumsum(sensitivity.vehicle_force(design, i, run)) * design.step_s
        smooth = smoothed(
            sensitivity.momentum_m_s(design, i, run) + lost, 2 * int(0.5 / design.step_s) + 1, 1
        )
        out[at][ahead:] = smooth[ahead:] - smooth[:-ahead]
    return out


def level(design: Design, explanation: Explanation) -> tuple[Explanation, float]:
    """An explanation on new runs: only their contaminant level, mass and irregularity are fitted."""
    base = {k: v for k, v in explanation.base.items() if not k.startswith(("ln_mu_cd", "mass"))}
    base |= {f"ln_mu_cd_{run}": explanation.level for run in range(design.mass_kg.size)}
    found, value, _ = fitting.fit(
        design, explanation._replace(base=base), 4, False, free=("ln_mu_cd", "mass")
    )
    return found, value


def missing_adhesion(design: Design, explanation: Explanation) -> np.ndarray:
    """Adhesion that a model lacks [G2] at every sample, flat; 0 below 5 m/s."""
    i = inputs(design, explanation)
    # measured less modelled adhesion at measured sliding would punish a stiffer contact for the noise of that sliding
    nu, S, field, _, _ = sensitivity.innovations(design, i)
    out = np.empty(nu.size)
    for s in range(design.segments):
        at, p = design.span(s), i.parameters[s]
        omega = design.measured_rad_s[at] - nu[at] * p[parameters.SPEED_NOISE] ** 2 / S[at]
        out[at] = predicted(i, at, omega, p, design.step_s)[1]
    return np.where(design.speed_m_s > SLOWEST_M_S, out * np.expm1(field), 0.0)


_ERRORS = {
    ADHESION: missing_adhesion,
    FREE_RUN: free_running,
}  # errors of a metric at every sample, 0 where it is not judged


def error(design: Design, explanation: Explanation, metric: str) -> float:
    """Root mean square error of a model in a metric on new runs, their level found anew."""
    errors = _ERRORS[metric](design, level(design, explanation)[0])
    return float(np.sqrt(np.mean(errors * errors)))


def measure(design: Design, base: Explanation, extended: Explanation, seed: int) -> Gain:
    """The gain of an extended model on runs that were not fitted."""
    before, cost_before = level(
        design, base._replace(sigma=extended.sigma, length_m=extended.length_m)
    )
    after, cost_after = level(design, extended)
    # a torque that is wrong in scale hides in the friction level, but not from the vehicle
    vehicle = all(BY_NAME[c.name].acts_on in (VEHICLE, TORQUE) for c in extended.causes)
    metric = FREE_RUN if vehicle else ADHESION
    size = np.diff(design.vehicle_start if vehicle else design.start)
    squares = np.array(
        [_ERRORS[metric](design, explanation) ** 2 for explanation in (before, after)]
    )
    run = np.arange(design.mass_kg.size) if vehicle else design.run

    def of(chosen: np.ndarray) -> tuple[float, float, float, float]:
        """Errors before and after on some segments, and the interval of the reduction."""
        part = squares[:, np.repeat(chosen, size)]
        rms = np.sqrt(part.mean(axis=1))
        return float(rms[0]), float(rms[1]), *_interval(part, size[chosen], design.step_s, seed)

    rms_before, rms_after, low, high = of(run >= 0)
    return Gain(
        runs=design.names,
        metric=metric,
        before=rms_before,
        after=rms_after,
        reduction=1.0 - rms_after / rms_before,
        ci95=(low, high),
        likelihood=cost_before - cost_after,
        by_run={name: of(run == r) for r, name in enumerate(design.names)},
    )


def _interval(
    squares: np.ndarray, sizes: np.ndarray, step_s: float, seed: int
) -> tuple[float, float]:
    """95 % interval of the reduction, by 500 draws of blocks of 3 s."""
    length = int(BLOCK_S / step_s)
    table = np.array(
        [
            part[:, low : low + length].sum(axis=1)
            for part in np.split(squares, np.cumsum(sizes)[:-1], axis=1)
            for low in range(0, part.shape[1], length)
        ]
    )
    chosen = np.random.default_rng(seed).integers(0, len(table), (500, len(table)))
    total = table[chosen].sum(axis=1)
    low, high = np.quantile(
        1.0 - np.sqrt(total[:, 1] / np.maximum(total[:, 0], 1e-30)), [0.025, 0.975]
    )
    return float(low), float(high)


def as_json(gain: Gain | None) -> dict[str, Any] | None:
    """The report's entry."""
    if gain is None:
        return None
    return {
        "runs": list(gain.runs),
        "metric": gain.metric,
        "before": gain.before,
        "after": gain.after,
        "reduction": gain.reduction,
        "ci95": list(gain.ci95),
        "claimed": gain.claimed,
        "by_run": {k: list(v) for k, v in gain.by_run.items()},
    }
