"""Tunes the recovery of adhesion as in the paper: tau from measured transitions, with an interval.

Measured wheel speeds, loads and torques give the adhesion that acted. Its place between the
degraded and the recovered curve shows how far the contact had recovered. By the work of sliding
that should be 1 - exp(-tau W). The contaminant's mu_cd is free in each run. All other parameters
stay those of the dataset, within its calibration tolerances.

    [U1] T = (J domega/dt + C) / r,  f = T / N                                   paper eq. 19
    [U2] s = v - r omega,  W_sp = f N |s / v|, for one wheel                      paper eq. 20
    [U3] least squares of (f_r - f_d) (lambda - 1 + exp(-tau W_sp)),
         lambda = (f - f_d) / (f_r - f_d)                                         paper eq. 21
    [U4] greatest likelihood of the measured wheel speeds, one sample ahead (`fitting`)

[U3] is biased where the rail is irregular. Wheels slide more where friction is less, so that
sliding and friction are correlated, and the noise of f is also in W. On datasets with 2 % of
irregularity and a known tau its least squares were 1 to 5 % low. [U4] estimates the irregularity as
a state and was right within 0.2 % in the mean. Its value is the result; [U3] is reported for
comparison. The interval is a bootstrap of [U4]: blocks of 3 s within each run, and the declared
tolerances. Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937, section 4.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.data.parameters import LAW, MU_CD, TAU
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide import fitting
from rollerrig.rig.identify.replay import sensitivity

# Samples count where the wheel slides by more, the vehicle is faster, and the wheel does not lock.
LEAST_SLIDING_M_S = 0.3
LEAST_SPEED_M_S = 4.0
MOST_CREEPAGE = 0.95

# s. Samples this far apart count as independent.
THINNED_TO_S = 0.05

# samples. With fewer the runs do not show recovery.
LEAST_SAMPLES = 100

# samples. With fewer in one run its mu_cd is not fitted.
LEAST_SAMPLES_OF_RUN = 10

# s. Blocks of the bootstrap, and number of its replicates.
BLOCK_S = 3.0
REPLICATES = 400

# runs. With fewer the interval does not include what changes from run to run.
LEAST_RUNS = 3

# bounds of the fits: tau in m/J
TAU_BOUNDS = (1e-8, 1.0)
MU_BOUNDS = (1e-3, 1.0)

# m/J. A fit of tau starts here if the base model has no recovery.
_LEAST_START_TAU_M_J = 1e-5

# standard deviations. A larger deviation of a wheel speed is an outlier.
_MOST_DEVIATIONS = 6.0

# f_r - f_d is taken as at least this where something is divided by it
_LEAST_SPREAD = 1e-9

# number of a block = number of its run x this + block within the run
_BLOCKS_OF_RUN = 100_000


class Interval(NamedTuple):
    """A value with the bounds of its 95 % interval."""

    value: float
    low: float
    high: float


class Samples(NamedTuple):
    """The samples of a fit: arrays (n,); `run` counts the runs of the fit."""

    run: np.ndarray
    axle: np.ndarray
    time_s: np.ndarray
    sliding_m_s: np.ndarray
    speed_m_s: np.ndarray
    load_N: np.ndarray  # of the wheelset
    adhesion: np.ndarray
    creepage: np.ndarray  # the part that cleans

    @property
    def energy_J_m(self) -> np.ndarray:
        """Measured W_sp of one wheel [U2]."""
        return 0.5 * self.adhesion * self.load_N * self.creepage


class Tuned(NamedTuple):
    """The result: intervals, errors of f, and the courses for plots (n,)."""

    tau_m_J: Interval
    mu_cd: dict[str, Interval]  # by run
    tau_paper_m_J: float  # [U3]
    rmse: float
    rmse_base: float  # with the dataset's tau, mu_cd fitted
    rmse_classic: float  # without recovery, mu_cd fitted
    samples: Samples
    transition: np.ndarray  # measured lambda
    degraded: np.ndarray  # f_d
    recovered: np.ndarray  # f_r
    model: np.ndarray  # f
    warnings: list[str]


def collect(design: Design, law: Law) -> Samples:
    """Return the samples of sliding braked wheels, thinned to independent samples [U1] [U2]."""
    samples_of_segment = np.diff(design.start)
    number_in_segment = np.concatenate([np.arange(count) for count in samples_of_segment])
    run = np.repeat(design.run, samples_of_segment)
    axle = np.repeat(design.axle, samples_of_segment)

    creepage = design.sliding_m_s / design.speed_m_s
    every = max(1, round(THINNED_TO_S / design.step_s))
    keep = (
        (number_in_segment % every == 0)
        & (design.sliding_m_s > LEAST_SLIDING_M_S)
        & (design.speed_m_s > LEAST_SPEED_M_S)
        & (creepage < MOST_CREEPAGE)
    )
    sliding_m_s = design.sliding_m_s[keep]
    speed_m_s = design.speed_m_s[keep]
    cleaning_shares = [
        adhesion.cleaning_share(sliding, speed, law)[0]
        for sliding, speed in zip(sliding_m_s, speed_m_s, strict=True)
    ]
    return Samples(
        run=run[keep],
        axle=axle[keep],
        time_s=design.time_s[keep],
        sliding_m_s=sliding_m_s,
        speed_m_s=speed_m_s,
        load_N=design.load_N[keep],
        adhesion=design.adhesion[keep],
        creepage=creepage[keep] * np.array(cleaning_shares),
    )


class Predicted(NamedTuple):
    """Adhesion of the model at each sample, (n,)."""

    f: np.ndarray
    degraded: np.ndarray  # f_d
    recovered: np.ndarray  # f_r


def predicted(s: Samples, tau_m_J: float, mu_cd: np.ndarray, base: np.ndarray) -> Predicted:
    """Return the adhesion for a recovery and the contaminants of the runs, mu_cd (runs,).

    `base` (PARAMETERS,) holds the parameters of the base model.
    """
    row = base.copy()
    row[TAU] = tau_m_J
    row[MU_CD] = 1.0
    # the factor of the degraded friction is then mu_cd
    path = np.array([s.sliding_m_s, s.speed_m_s, s.load_N, mu_cd[s.run], np.ones(s.run.size)])
    f, _, degraded, recovered = sensitivity.replay_law(path, row)
    return Predicted(f, degraded, recovered)


class _Fit:
    """A least-squares fit of tau, and of mu_cd of the runs that do not state it.

    The free parameters are logarithms: first tau, unless it is given, then mu_cd of the free runs.
    """

    def __init__(
        self,
        s: Samples,
        base: np.ndarray,
        stated_mu_cd: list[float | None],
        tau_m_J: float | None,
    ) -> None:
        self.s = s
        self.base = base
        self.tau_m_J = tau_m_J
        self._mu_cd = np.array(
            [base[MU_CD] if stated is None else stated for stated in stated_mu_cd]
        )
        self._free_runs = [
            run
            for run, stated in enumerate(stated_mu_cd)
            if stated is None and np.any(s.run == run)
        ]

    def unpack(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return tau, m/J, and mu_cd (runs,)."""
        mu_cd = self._mu_cd.copy()
        if self._free_runs:
            mu_cd[self._free_runs] = np.exp(x[-len(self._free_runs) :])
        tau_m_J = float(np.exp(x[0])) if self.tau_m_J is None else self.tau_m_J
        return tau_m_J, mu_cd

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return the error of f (n,)."""
        tau_m_J, mu_cd = self.unpack(x)
        return predicted(self.s, tau_m_J, mu_cd, self.base).f - self.s.adhesion

    def paper_residual(self, x: np.ndarray) -> np.ndarray:
        """Return the paper's error (n,) [U3]."""
        tau_m_J, mu_cd = self.unpack(x)
        _, f_d, f_r = predicted(self.s, tau_m_J, mu_cd, self.base)
        transition = -np.expm1(-tau_m_J * np.maximum(self.s.energy_J_m, 0.0))
        return self.s.adhesion - f_d - (f_r - f_d) * transition  # [U3]

    def solve(
        self, residual: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> tuple[np.ndarray, float]:
        """Return the free parameters and the rms of the residual."""
        start = []
        bounds = []
        if self.tau_m_J is None:
            start.append(np.log(max(self.base[TAU], _LEAST_START_TAU_M_J)))
            bounds.append(TAU_BOUNDS)
        for _ in self._free_runs:
            start.append(np.log(self.base[MU_CD]))
            bounds.append(MU_BOUNDS)

        x0 = np.array(start)
        if not x0.size:
            return x0, rms(self.residual(x0))
        solution = least_squares(
            residual or self.residual,
            x0,
            bounds=np.log(bounds).T,
            x_scale=0.3,
            ftol=1e-12,
            xtol=1e-10,
        )
        return solution.x, rms(solution.fun)


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values * values)))


def tune(data: Dataset, seed: int = 0) -> Tuned:
    """Fit tau to the tuning runs of a dataset. Raises ConfigError where wheels hardly slide."""
    runs = data.group("tune")
    design = prepare(data, runs)
    base = design.base
    s = collect(design, Law(*base[LAW]))
    if s.run.size < LEAST_SAMPLES:
        raise ConfigError(
            f"{data.folder}: wheels slide by more than {LEAST_SLIDING_M_S} m/s in {s.run.size} samples "
            f"of the tuning runs; {LEAST_SAMPLES} are needed; give runs in which the WSP works"
        )

    intervals = likeliest(design, seed)
    tau = intervals.pop("tau")
    mu_cd = dict(zip([run.name for run in runs], intervals.values(), strict=True))

    # the error of f with this tau, the dataset's tau and no recovery; mu_cd is fitted each time
    nothing_stated: list[float | None] = [None] * len(runs)
    fit = _Fit(s, base, nothing_stated, tau.value)
    x, rmse = fit.solve()
    _, rmse_base = _Fit(s, base, nothing_stated, float(base[TAU])).solve()
    _, rmse_classic = _Fit(s, base, nothing_stated, 0.0).solve()
    paper_fit = _Fit(s, base, nothing_stated, None)
    paper_x, _ = paper_fit.solve(paper_fit.paper_residual)
    tau_paper_m_J, _ = paper_fit.unpack(paper_x)

    tau_m_J, fitted_mu_cd = fit.unpack(x)
    f, f_d, f_r = predicted(s, tau_m_J, fitted_mu_cd, base)
    return Tuned(
        tau_m_J=tau,
        mu_cd=mu_cd,
        tau_paper_m_J=tau_paper_m_J,
        rmse=rmse,
        rmse_base=rmse_base,
        rmse_classic=rmse_classic,
        samples=s,
        transition=(s.adhesion - f_d) / np.maximum(f_r - f_d, _LEAST_SPREAD),
        degraded=f_d,
        recovered=f_r,
        model=f,
        warnings=[*data.warnings, *_warnings(tau, len(runs))],
    )


def _warnings(tau: Interval, runs: int) -> list[str]:
    warnings = []
    lowest, highest = TAU_BOUNDS
    if not lowest * 1.01 < tau.value < highest * 0.99 or tau.low <= 0.0:
        warnings.append(f"tau = {tau.value:.3g} m/J is at a bound: the runs do not show recovery")
    if runs < LEAST_RUNS:
        warnings.append(
            f"tau comes from {runs} runs: its interval does not include changes from run to run"
        )
    return warnings


def likeliest(design: Design, seed: int) -> dict[str, Interval]:
    """Return tau and mu_cd of each run by [U4] with their intervals; keys "tau", "mu_cd_0" ...

    A replicate of the bootstrap draws the 3 s blocks of each run and the declared tolerances anew,
    and takes one Gauss-Newton step from the optimum. Blocks do not contain what changes from run
    to run, so this deviation is added.
    """
    explanation, _, _ = fitting.fit(design, candidates.untuned(design))
    normal, linear, responses = fitting.normal_equations(design, explanation, False)
    columns = fitting.base_columns(normal.matrix)
    labels = [normal.matrix.columns[column].label for column in columns]
    prior = np.array([normal.matrix.columns[column].prior for column in columns])

    # scaled sensitivities Z (samples, coefficients) and deviations z (samples,) of the wheel speeds
    Z = fitting.wheel_responses(design, responses, columns)
    z = np.clip(linear.nu / np.sqrt(linear.variance), -_MOST_DEVIATIONS, _MOST_DEVIATIONS)
    # what the wheel speeds do not give: the vehicle's balance and the tolerances
    rest = normal.A[np.ix_(columns, columns)] - Z.T @ Z

    # normal equations of each block
    run_of_sample = np.repeat(design.run, np.diff(design.start))
    block_of_sample = run_of_sample * _BLOCKS_OF_RUN + (design.time_s // BLOCK_S).astype(int)
    blocks, block_index = np.unique(block_of_sample, return_inverse=True)
    A = np.array([Z[block_index == i].T @ Z[block_index == i] for i in range(blocks.size)])
    b = np.array([Z[block_index == i].T @ z[block_index == i] for i in range(blocks.size)])

    runs = design.mass_kg.size
    blocks_of_run = [np.flatnonzero(blocks // _BLOCKS_OF_RUN == run) for run in range(runs)]
    b_of_run = np.array([b[members].sum(axis=0) for members in blocks_of_run])
    between_runs = _deviation_between_runs(rest + A.sum(axis=0), b_of_run)
    b -= b.mean(axis=0)

    rng = np.random.default_rng(seed)
    moves = np.empty((REPLICATES, len(columns)))
    for i in range(REPLICATES):
        drawn = np.concatenate([rng.choice(members, members.size) for members in blocks_of_run])
        tolerance = rng.standard_normal(prior.size) / np.maximum(prior, 1e-12)
        shift = np.where(prior > 0.0, tolerance, 0.0)
        moves[i] = fitting.solve(rest + A[drawn].sum(axis=0), b[drawn].sum(axis=0) + shift)[0]
    low, high = np.percentile(moves, (2.5, 97.5), axis=0)
    wider = np.hypot(1.0, between_runs / np.maximum(moves.std(axis=0), 1e-12))
    low = low * wider
    high = high * wider

    # the coefficients are logarithms of a parameter over its base value
    base_values = {"ln_tau": float(design.base[TAU])}
    for run in range(runs):
        base_values[f"ln_mu_cd_{run}"] = float(design.base[MU_CD])
    intervals = {}
    for label, base_value in base_values.items():
        at = labels.index(label)
        optimum = explanation.base.get(label, 0.0)
        intervals[label.removeprefix("ln_")] = Interval(
            value=float(base_value * np.exp(optimum)),
            low=float(base_value * np.exp(optimum + low[at])),
            high=float(base_value * np.exp(optimum + high[at])),
        )
    return intervals


def _deviation_between_runs(A: np.ndarray, b_of_run: np.ndarray) -> np.ndarray:
    """Return the deviation of each coefficient from run to run; 0 for a single run.

    `A` is the normal matrix of all runs, `b_of_run` (runs, coefficients) the right side of each
    run.
    """
    runs = len(b_of_run)
    if runs < 2:
        return np.zeros(len(A))
    moves = np.array([fitting.solve(A, b)[0] for b in b_of_run])
    return np.sqrt((moves**2).sum(axis=0) * runs / (runs - 1))


def contaminant(
    s: Samples, base: np.ndarray, stated_mu_cd: float | None, tau_m_J: float
) -> tuple[float, float]:
    """Return mu_cd and the rms error of f of one run for a given recovery.

    mu_cd is fitted unless it is stated. The error is NaN where the run has too few samples.
    """
    if s.run.size < LEAST_SAMPLES_OF_RUN:
        return stated_mu_cd or float(base[MU_CD]), float("nan")
    fit = _Fit(s, base, [stated_mu_cd], tau_m_J)
    x, rmse = fit.solve()
    _, mu_cd = fit.unpack(x)
    return float(mu_cd[0]), rmse
