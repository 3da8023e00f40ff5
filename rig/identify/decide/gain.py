"""Measures what an explanation is worth on stops that were never fitted.

The base and the extended model keep their parameters from the fitted runs. Only three things are
fitted again to the new stops, for both models: the level of the contaminant, the mass within its
tolerance, and causes with a finite step. The measure is the adhesion that a model lacks: what the
filter of the wheel has to add to it [G2]. This takes the noise of the sensors into account. For
causes in the vehicle the measure is the error of the speed that is predicted five seconds ahead. A
block bootstrap gives the interval. A gain whose interval contains 0 is not claimed.

    [G1] f = (J domega/dt + C) / (r N), with the model's J, C, r and N; for the pictures
    [G2] f (e^m - 1), f and the irregularity m along the filtered wheel speed
"""

from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.causes import discrepancy
from rollerrig.rig.identify.causes.candidates import Explanation, inputs
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import WINDOW_S, Design
from rollerrig.rig.identify.data.smoothing import smoothed
from rollerrig.rig.identify.decide import fitting
from rollerrig.rig.identify.decide.thresholds import (
    BLOCK_S,
    FREE_RUN_S,
    LEAST_LIKELIHOOD_OF_GAIN,
    SLOWEST_M_S,
)
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.identify.replay.sensitivity import Inputs
from rollerrig.rig.identify.statistics import resampling
from rollerrig.rig.mechanisms.mechanism import TORQUE, VEHICLE
from rollerrig.rig.mechanisms.table import BY_NAME

# metrics, root mean square: of the adhesion that a model lacks, of the speed that it predicts
ADHESION = "adhesion_rmse"
FREE_RUN = "free_running_speed_rmse_m_s"

# tolerances of a base are held within this number of declared standard deviations
TOLERANCES = 2.0
DRAWS = 500  # of the bootstrap
QUANTILES = (0.025, 0.975)
CUBIC = 3  # order of the smoothing polynomial of wheel speed and torque


class RunGain(NamedTuple):
    """The errors on some runs: before and after, and the 95 % interval of the reduction."""

    before: float
    after: float
    low: float
    high: float


class Gain(NamedTuple):
    """The gain of an extended model on runs that were never fitted."""

    runs: tuple[str, ...]
    metric: str  # ADHESION or FREE_RUN
    before: float  # error of the base
    after: float  # error of the extended model
    reduction: float  # share of the error that is gone
    ci95: tuple[float, float]  # 95 % interval of the reduction
    likelihood: float  # drop of -2 ln L on these runs
    by_run: dict[str, RunGain]

    @property
    def claimed(self) -> bool:
        """Whether the gain is statistically significant."""
        return self.ci95[0] > 0.0 and self.likelihood > LEAST_LIKELIHOOD_OF_GAIN


# --- what a model predicts ---


def predicted(i: Inputs, at: slice, omega: np.ndarray, p: np.ndarray, step_s: float) -> np.ndarray:
    """Return (sliding in m/s, adhesion) of one wheel along its speed `omega`, shape (2, n)."""
    sliding = i.speed_m_s[at] - p[parameters.RADIUS] * omega
    path = np.array([sliding, i.speed_m_s[at], i.load_N[at], *i.friction[:, at]])
    lagging = np.zeros(omega.size + 1)
    adhesion_of_law, *_ = sensitivity.replay_law(path, p, step_s, lagging, follow=True)
    return np.array([sliding, adhesion_of_law])


def adhesion(design: Design, explanation: Explanation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (measured [G1], modelled adhesion, sliding in m/s) at every sample, flat."""
    i = inputs(design, explanation)
    samples = design.measured_rad_s.size
    measured = np.empty(samples)
    model = np.empty(samples)
    sliding = np.empty(samples)
    window = max(5, 2 * int(0.5 * WINDOW_S / design.step_s) + 1)
    for s in range(design.segments):
        at = design.span(s)
        p = i.parameters[s]
        omega = smoothed(design.measured_rad_s[at], window, CUBIC)
        rate = smoothed(design.measured_rad_s[at], window, CUBIC, 1, design.step_s)
        torque = smoothed(i.torque_Nm[at], window, CUBIC)
        force_Nm = p[parameters.INERTIA] * rate + torque
        measured[at] = force_Nm / (p[parameters.RADIUS] * i.load_N[at])
        sliding[at], modelled = predicted(i, at, omega, p, design.step_s)
        model[at] = smoothed(modelled, window, CUBIC)
    return measured, model, sliding


def missing_adhesion(design: Design, explanation: Explanation) -> np.ndarray:
    """Return the adhesion that a model lacks [G2] at every sample, flat; 0 below SLOWEST_M_S."""
    i = inputs(design, explanation)
    # the difference of measured and modelled adhesion at measured sliding would be larger for a
    # stiffer contact, only because of the noise of that sliding
    innovation, variance, irregularity, _, _ = sensitivity.innovations(design, i)
    modelled = np.empty(innovation.size)
    for s in range(design.segments):
        at = design.span(s)
        p = i.parameters[s]
        noise_variance = p[parameters.SPEED_NOISE] ** 2
        omega = design.measured_rad_s[at] - innovation[at] * noise_variance / variance[at]
        _, modelled[at] = predicted(i, at, omega, p, design.step_s)
    is_judged = design.speed_m_s > SLOWEST_M_S
    return np.where(is_judged, modelled * np.expm1(irregularity), 0.0)


def free_running(design: Design, explanation: Explanation) -> np.ndarray:
    """Return the error in m/s of the speed that the force balance predicts FREE_RUN_S ahead.

    The result has a value for each sample of the vehicles. It is 0 in the first FREE_RUN_S of a
    run.
    """
    i = inputs(design, explanation)
    out = np.zeros(design.vehicle_m_s.size)
    ahead = int(FREE_RUN_S / design.step_s)
    half_second = 2 * int(0.5 / design.step_s) + 1
    for run in range(design.mass_kg.size):
        at = design.vehicle_span(run)
        lost_m_s = np.cumsum(sensitivity.vehicle_force(design, i, run)) * design.step_s
        # constant if the balance is right
        kept_m_s = smoothed(sensitivity.momentum_m_s(design, i, run) + lost_m_s, half_second, 1)
        out[at][ahead:] = kept_m_s[ahead:] - kept_m_s[:-ahead]
    return out


# errors of a metric at every sample, 0 where it is not judged
_ERRORS = {ADHESION: missing_adhesion, FREE_RUN: free_running}


# --- on runs that were never fitted ---


def fit_level(design: Design, explanation: Explanation, metric: str = ADHESION) -> fitting.Fit:
    """Fit to new runs only their contaminant level, their mass, and causes with a finite step.

    For the metric FREE_RUN mass and scale errors are held within TOLERANCES of what the dataset
    declares: a mass that is 8 % off would hide a brake that is 8 % too strong. Within it the mass
    is fitted for both models, else a brake that is 0.9 % too strong would gain what is a tolerance.
    """
    is_of_vehicle = metric == FREE_RUN
    most = TOLERANCES * design.calibration
    base = {}
    for label, value in explanation.base.items():
        if label.startswith(("ln_mu_cd", "mass", discrepancy.BRAKE)):
            continue
        if is_of_vehicle and label.startswith(("torque_gain", "load_gain")):
            value = float(np.clip(value, -most, most))
        base[label] = value
    for run in range(design.mass_kg.size):
        base[f"ln_mu_cd_{run}"] = explanation.level
    fit = fitting.fit(
        design,
        explanation._replace(base=base),
        4,
        noise=False,
        free=("ln_mu_cd", "mass"),
    )
    if not is_of_vehicle:
        return fit
    for label, value in fit.explanation.base.items():
        base[label] = value
        if label.startswith("mass"):
            base[label] = float(np.clip(value, -most, most))
    held = fit.explanation._replace(base=base)
    return fit._replace(explanation=held, deviance=fitting.deviance(design, held))


def error(design: Design, explanation: Explanation, metric: str) -> float:
    """Return the root mean square error of a model on new runs, after their level is fitted."""
    errors = _ERRORS[metric](design, fit_level(design, explanation, metric).explanation)
    return float(np.sqrt(np.mean(errors * errors)))


def metric_of(fitted: Design | None, base: Explanation, extended: Explanation) -> str:
    """Return the metric that shows what the causes of an extended model change.

    A torque that is wrong in scale hides in the friction level, but not from the vehicle. Where
    causes of both kinds act, the metric is the one that falls more on the fitted runs; the runs
    that judge the gain have no part in the choice.
    """
    of_vehicle = [BY_NAME[cause.name].acts_on in (VEHICLE, TORQUE) for cause in extended.causes]
    if all(of_vehicle):
        return FREE_RUN
    if fitted is None or not any(of_vehicle):
        return ADHESION
    base = base._replace(sigma=extended.sigma, length_m=extended.length_m)
    left = {}
    for metric, errors_of in _ERRORS.items():
        before, after = (np.mean(errors_of(fitted, one) ** 2) for one in (base, extended))
        left[metric] = float(after / max(before, 1e-30))
    return min(left, key=lambda metric: left[metric])


def measure(
    design: Design,
    base: Explanation,
    extended: Explanation,
    seed: int,
    fitted: Design | None = None,
) -> Gain:
    """Return the gain of an extended model over the base on runs that were never fitted.

    `fitted` are the runs that were fitted. With them the metric suits causes of both kinds.
    """
    # both get the same irregularity of the rail
    base = base._replace(sigma=extended.sigma, length_m=extended.length_m)
    metric = metric_of(fitted, base, extended)
    before = fit_level(design, base, metric)
    after = fit_level(design, extended, metric)

    if metric == FREE_RUN:
        part_sizes = np.diff(design.vehicle_start)  # a part is a vehicle in a run
        run_of_part = np.arange(design.mass_kg.size)
    else:
        metric = ADHESION
        part_sizes = np.diff(design.start)  # a part is a wheelset in a run
        run_of_part = design.run
    squares = np.array([_ERRORS[metric](design, fit.explanation) ** 2 for fit in (before, after)])

    def gain_on(chosen: np.ndarray) -> RunGain:
        """Return the errors on some parts, `chosen` (parts,), and the interval of the reduction."""
        part = squares[:, np.repeat(chosen, part_sizes)]
        rms_before, rms_after = np.sqrt(part.mean(axis=1))
        low, high = _interval(part, part_sizes[chosen], design.step_s, seed)
        return RunGain(float(rms_before), float(rms_after), low, high)

    whole = gain_on(run_of_part >= 0)
    return Gain(
        runs=design.names,
        metric=metric,
        before=whole.before,
        after=whole.after,
        reduction=1.0 - whole.after / whole.before,
        ci95=(whole.low, whole.high),
        likelihood=before.deviance - after.deviance,
        by_run={name: gain_on(run_of_part == run) for run, name in enumerate(design.names)},
    )


def _interval(
    squares: np.ndarray, sizes: np.ndarray, step_s: float, seed: int
) -> tuple[float, float]:
    """Return the 95 % interval of the reduction, by a bootstrap of blocks of BLOCK_S.

    `squares` (2, n) are the squared errors before and after, one part of `sizes` after the other.
    """
    length = int(BLOCK_S / step_s)
    sums = []
    for part in np.split(squares, np.cumsum(sizes)[:-1], axis=1):
        for begin in range(0, part.shape[1], length):
            sums.append(part[:, begin : begin + length].sum(axis=1))
    blocks = np.array(sums)

    rng = np.random.default_rng(seed)
    total = resampling.drawn(len(blocks), rng, DRAWS) @ blocks
    before = np.maximum(total[:, 0], 1e-30)
    low, high = np.quantile(1.0 - np.sqrt(total[:, 1] / before), QUANTILES)
    return float(low), float(high)
