"""Tunes the recovery of adhesion as the paper does: tau from measured transitions, with an interval.

Measured wheel speeds, loads and torques give the adhesion that acted; between the degraded and the recovered curve it
shows how far the contact had recovered, and by the work of sliding that should be 1 - exp(-tau W). The contaminant's
mu_cd is free in each run; all other parameters stay those of the dataset, within its calibration tolerances.

    [U1] T = (J domega/dt + C) / r,  f = T / N                                   paper eq. 19
    [U2] s = v - r omega,  W_sp = f N |s / v|, for one wheel                      paper eq. 20
    [U3] least squares of (f_r - f_d) (lambda - 1 + exp(-tau W_sp)), lambda = (f - f_d) / (f_r - f_d)
                                                                                  paper eq. 21
    [U4] greatest likelihood of the measured wheel speeds, one sample ahead (`tuning`)

[U3] is biased where the rail is irregular: wheels slide more where friction is less, so that sliding
and friction go against each other, and the noise of f stands in W too. On sets with 2 % of
irregularity and a known tau its least squares were 1 to 5 % low. [U4] carries the irregularity as a
state and was right within 0.2 % in the mean; its value is the result, [U3] stands beside it. The
interval is a bootstrap of [U4]: blocks of 3 s within each run, and the declared tolerances.
Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937, section 4.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rollerrig.configs.errors import ConfigError
from rollerrig.rig import params, wheelset
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.contact.patch import Patch
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.data.parameters import TAU, patch_of
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide import fitting

LEAST_SLIDING_M_S, LEAST_SPEED_M_S = 0.3, 4.0
THINNED_TO_S = 0.05
BLOCK_S = 3.0
REPLICATES = 400
LEAST_SAMPLES = 100
TAU_BOUNDS = (1e-8, 1.0)
MU_BOUNDS = (1e-3, 1.0)


class Interval(NamedTuple):
    """A value and the bounds that hold it in 95 of 100 cases."""

    value: float
    low: float
    high: float


class Samples(NamedTuple):
    """What a fit sees: arrays (n,); `run` counts the runs of the fit."""

    run: np.ndarray
    axle: np.ndarray
    time_s: np.ndarray
    sliding_m_s: np.ndarray
    speed_m_s: np.ndarray
    load_N: np.ndarray  # wheelset
    adhesion: np.ndarray
    creepage: np.ndarray  # as much of it as cleans

    @property
    def energy_J_m(self) -> np.ndarray:
        """Measured W_sp of one wheel [U2]."""
        return 0.5 * self.adhesion * self.load_N * self.creepage


class Tuned(NamedTuple):
    """The result: intervals, errors in f, and what the plots show."""

    tau_m_J: Interval
    mu_cd: dict[str, Interval]
    tau_paper_m_J: float  # [U3]
    rmse: float
    rmse_base: float  # with the dataset's tau, mu_cd fitted
    rmse_classic: float  # without recovery, mu_cd fitted
    samples: Samples
    transition: np.ndarray  # measured lambda, (n,)
    degraded: np.ndarray
    recovered: np.ndarray
    model: np.ndarray  # f
    warnings: list[str]


def contact(data: Dataset) -> tuple[Patch, Law]:
    """Patch and law of a dataset's base model."""
    return patch_of(data), params.law_of(data.sections["adhesion"])


def collect(design: Design, cleaning_creepage: float) -> Samples:
    """The samples in which wheels slide under the brake, thinned to independent ones [U1] [U2]."""
    every = max(1, round(THINNED_TO_S / design.step_s))
    number = np.concatenate([np.arange(n) for n in np.diff(design.start)])
    run, axle = (np.repeat(x, np.diff(design.start)) for x in (design.run, design.axle))
    creepage = design.sliding_m_s / design.speed_m_s
    shares = np.array(
        [
            adhesion.cleaning_share(s, v, cleaning_creepage)[0]
            for s, v in zip(design.sliding_m_s, design.speed_m_s, strict=True)
        ]
    )
    keep = (
        (number % every == 0)
        & (design.sliding_m_s > LEAST_SLIDING_M_S)
        & (design.speed_m_s > LEAST_SPEED_M_S)
        & (creepage < 0.95)
    )
    return Samples(
        *(
            part[keep]
            for part in (
                run,
                axle,
                design.time_s,
                design.sliding_m_s,
                design.speed_m_s,
                design.load_N,
                design.adhesion,
                creepage * shares,
            )
        )
    )


@kernel
def curves(sliding_m_s, speed_m_s, load_N, mu_cd, patch, law, out):
    """f, f_d, f_r of the model at each sample, into out (n, 3)."""
    for i in range(sliding_m_s.size):
        f, f_d, f_r, _, _, _ = wheelset.wheelset_adhesion(
            sliding_m_s[i], speed_m_s[i], load_N[i], mu_cd[i], law.mu_cr, patch, law
        )
        out[i, 0], out[i, 1], out[i, 2] = f, f_d, f_r


def predicted(
    s: Samples, tau_m_J: float, mu_cd: np.ndarray, model: tuple[Patch, Law]
) -> np.ndarray:
    """(n, 3) f, f_d, f_r for a recovery and the contaminants of the runs, mu_cd (runs,)."""
    patch, law = model
    out = np.empty((s.run.size, 3))
    curves(
        s.sliding_m_s,
        s.speed_m_s,
        s.load_N,
        mu_cd[s.run],
        patch,
        law._replace(tau_m_J=tau_m_J),
        out,
    )
    return out


class _Fit:
    """Free parameters as logarithms: tau if it is free, then mu_cd of the runs that leave it free."""

    def __init__(
        self,
        s: Samples,
        model: tuple[Patch, Law],
        stated: list[float | None],
        tau_m_J: float | None,
    ) -> None:
        self.s, self.model, self.stated, self.tau = s, model, stated, tau_m_J
        self.free = [i for i, mu in enumerate(stated) if mu is None and np.any(s.run == i)]

    def unpack(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        mu = np.array([self.model[1].mu_cd if m is None else m for m in self.stated])
        mu[self.free] = np.exp(x[-len(self.free) :]) if self.free else mu[self.free]
        return (float(np.exp(x[0])) if self.tau is None else self.tau), mu

    def residual(self, x: np.ndarray) -> np.ndarray:
        tau, mu = self.unpack(x)
        return predicted(self.s, tau, mu, self.model)[:, 0] - self.s.adhesion

    def paper_residual(self, x: np.ndarray) -> np.ndarray:
        tau, mu = self.unpack(x)
        _, f_d, f_r = predicted(self.s, tau, mu, self.model).T
        return (
            self.s.adhesion
            - f_d
            - (f_r - f_d) * -np.expm1(-tau * np.maximum(self.s.energy_J_m, 0.0))
        )  # [U3]

    def solve(
        self, residual: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> tuple[np.ndarray, float]:
        """(x, rms of the residual)."""
        head = [np.log(max(self.model[1].tau_m_J, 1e-5))] if self.tau is None else []
        x0 = np.array(head + [np.log(self.model[1].mu_cd)] * len(self.free))
        if not x0.size:
            return x0, rms(self.residual(x0))
        bounds = np.log([TAU_BOUNDS] * len(head) + [MU_BOUNDS] * len(self.free)).T
        found = least_squares(
            residual or self.residual, x0, bounds=bounds, x_scale=0.3, ftol=1e-12, xtol=1e-10
        )
        return found.x, rms(found.fun)


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values * values)))


def tune(data: Dataset, seed: int = 0) -> Tuned:
    """Fit tau to the tuning runs of a dataset. Raises ConfigError where wheels hardly slide."""
    runs = data.group("tune")
    design = prepare(data, runs)
    model = contact(data)
    s = collect(design, model[1].cleaning_creepage)
    if s.run.size < LEAST_SAMPLES:
        raise ConfigError(
            f"{data.folder}: wheels slide by more than {LEAST_SLIDING_M_S} m/s in {s.run.size} samples "
            f"of the tuning runs, {LEAST_SAMPLES} are needed; give runs in which the WSP works"
        )
    intervals = likeliest(design, model[1].mu_cd, seed)
    tau = intervals.pop("tau")
    fit, base, classic, paper = (
        _Fit(s, model, [None] * len(runs), one) for one in (tau.value, model[1].tau_m_J, 0.0, None)
    )
    x, rmse = fit.solve()
    f, f_d, f_r = predicted(s, *fit.unpack(x), model).T
    warnings = list(data.warnings)
    if not TAU_BOUNDS[0] * 1.01 < tau.value < TAU_BOUNDS[1] * 0.99 or tau.low <= 0.0:
        warnings.append(
            f"tau = {tau.value:.3g} m/J stands at a bound: the runs do not show recovery"
        )
    if len(runs) < 3:
        warnings.append(
            f"tau comes from {len(runs)} runs: what changes from run to run is not in its interval"
        )
    return Tuned(
        tau_m_J=tau,
        mu_cd=dict(zip([run.name for run in runs], intervals.values(), strict=True)),
        tau_paper_m_J=float(np.exp(paper.solve(paper.paper_residual)[0][0])),
        rmse=rmse,
        rmse_base=base.solve()[1],
        rmse_classic=classic.solve()[1],
        samples=s,
        transition=(s.adhesion - f_d) / np.maximum(f_r - f_d, 1e-9),
        degraded=f_d,
        recovered=f_r,
        model=f,
        warnings=warnings,
    )


def likeliest(design: Design, mu_cd: float, seed: int) -> dict[str, Interval]:
    """tau and mu_cd of each run by [U4], with their intervals; keys "tau", "mu_cd_0" ...

    A replicate draws the 3 s blocks of each run anew and the declared tolerances, and takes one
    Gauss-Newton step from the optimum. What whole runs pull apart is added: blocks do not know it.
    """
    explanation, _, _ = fitting.fit(design, candidates.untuned(design))
    found, linear, responses = fitting.normal_equations(design, explanation, False)
    at = fitting.base_columns(found.matrix)
    labels = [found.matrix.columns[c].label for c in at]
    prior = np.array([found.matrix.columns[c].prior for c in at])
    Z = fitting.wheel_responses(design, responses, at)
    z = np.clip(linear.nu / np.sqrt(linear.variance), -6.0, 6.0)
    rest = found.A[np.ix_(at, at)] - Z.T @ Z  # the vehicle's balance and the tolerances
    run = np.repeat(design.run, np.diff(design.start))
    blocks, of = np.unique(
        run * 100_000 + (design.time_s // BLOCK_S).astype(int), return_inverse=True
    )
    A = np.array([Z[of == i].T @ Z[of == i] for i in range(blocks.size)])
    b = np.array([Z[of == i].T @ z[of == i] for i in range(blocks.size)])
    of_run = [np.flatnonzero(blocks // 100_000 == i) for i in range(design.mass_kg.size)]
    between = _between_runs(rest + A.sum(axis=0), np.array([b[m].sum(axis=0) for m in of_run]))
    b -= b.mean(axis=0)
    rng = np.random.default_rng(seed)
    spread = np.empty((REPLICATES, len(at)))
    for i in range(REPLICATES):
        picked = np.concatenate([rng.choice(m, m.size) for m in of_run])
        shift = np.where(
            prior > 0.0, rng.standard_normal(prior.size) / np.maximum(prior, 1e-12), 0.0
        )
        spread[i] = fitting.solve(rest + A[picked].sum(axis=0), b[picked].sum(axis=0) + shift)[0]
    low, high = np.percentile(spread, (2.5, 97.5), axis=0)
    wider = np.hypot(1.0, between / np.maximum(spread.std(axis=0), 1e-12))
    low, high = low * wider, high * wider
    units = {"ln_tau": float(design.base[TAU])} | {
        f"ln_mu_cd_{i}": mu_cd for i in range(design.mass_kg.size)
    }
    return {
        label.removeprefix("ln_"): Interval(
            *(
                float(unit * np.exp(explanation.base.get(label, 0.0) + y))
                for y in (0.0, low[k], high[k])
            )
        )
        for label, unit in units.items()
        for k in (labels.index(label),)
    }


def _between_runs(A: np.ndarray, pulls: np.ndarray) -> np.ndarray:
    """Deviation of each coefficient from one run to another, `pulls` (runs, coefficients)."""
    runs = len(pulls)
    if runs < 2:
        return np.zeros(len(A))
    moves = np.array([fitting.solve(A, pull)[0] for pull in pulls])
    return np.sqrt((moves**2).sum(axis=0) * runs / (runs - 1))


def contaminant(
    s: Samples, model: tuple[Patch, Law], stated: float | None, tau_m_J: float
) -> tuple[float, float]:
    """(mu_cd, rmse of f) of one run for a given recovery; mu_cd is fitted unless it is stated."""
    if s.run.size < 10:
        return stated or model[1].mu_cd, float("nan")
    fit = _Fit(s, model, [stated], tau_m_J)
    x, rmse = fit.solve()
    return float(fit.unpack(x)[1][0]), rmse
