"""Tunes the recovery of adhesion as the paper does: tau from measured transitions, with an interval.

Measured wheel speeds, loads and torques give the adhesion that acted; between the degraded and the
recovered curve it shows how far the contact had recovered, and by the work of sliding that should
be 1 - exp(-tau W). The contaminant's mu_cd is free in each run that does not state it; all other
parameters stay those of the dataset.

    [U1] T = (J domega/dt + C) / r,  f = T / N                                   paper eq. 19
    [U2] s = v - r omega,  W_sp = f N |s / v|, for one wheel                      paper eq. 20
    [U3] least squares over all samples of f - f_model(s, v, N; tau, mu_cd)       paper eq. 21
    [U4] the paper's own form: (f_r - f_d) (lambda - 1 + exp(-tau W_sp)), lambda = (f - f_d) / (f_r - f_d)

[U3] is [U4] with the work that the model predicts for the work measured, which contains the noise of
f and biases tau (upwards: [U4] is printed beside it). The interval is a bootstrap over runs and,
within a run, over blocks of 3 s; the declared calibration tolerance is drawn with it.
Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937, section 4.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rollerrig.configs.errors import ConfigError
from rollerrig.rig import wheelset
from rollerrig.rig.contact.adhesion import Law, Patch, patch_for
from rollerrig.rig.identify.dataset import Dataset
from rollerrig.rig.identify.preparation import Design, prepare
from rollerrig.rig.kernel import kernel

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
    """What a fit sees: arrays (n,); `run` counts the runs of the fit, `block` the 3 s blocks."""

    run: np.ndarray
    axle: np.ndarray
    block: np.ndarray
    time_s: np.ndarray
    sliding_m_s: np.ndarray
    speed_m_s: np.ndarray
    load_N: np.ndarray  # wheelset
    adhesion: np.ndarray
    creepage: np.ndarray  # not above the creepage beyond which nothing cleans better


class Tuned(NamedTuple):
    """The result: intervals, errors in f, and what the plots show."""

    tau_m_J: Interval
    mu_cd: dict[str, Interval]
    tau_paper_m_J: float  # [U4]
    rmse: float
    rmse_base: float  # with the dataset's tau, mu_cd fitted
    rmse_classic: float  # without recovery, mu_cd fitted
    samples: Samples
    transition: np.ndarray  # measured lambda, (n,)
    degraded: np.ndarray
    recovered: np.ndarray
    model: np.ndarray  # f
    warnings: list[str]

    @property
    def energy_J_m(self) -> np.ndarray:
        """Measured W_sp of one wheel [U2]."""
        return 0.5 * self.samples.adhesion * self.samples.load_N * self.samples.creepage


def contact(data: Dataset) -> tuple[Patch, Law, float]:
    """Patch, law and largest cleaning creepage of a dataset's base model."""
    v, law, c = (data.sections[k] for k in ("vehicle", "adhesion", "contact"))
    patch = patch_for(v["wheel_radius_m"], c["roller_radius_m"], c["lateral_radius_m"], c["young_Pa"],
                      c["shear_Pa"], c["poisson"])
    law = dict(law)
    cleaning = law.pop("cleaning_creepage")
    return patch, Law(**law), cleaning


def collect(design: Design, cleaning_creepage: float) -> Samples:
    """The samples in which wheels slide under the brake, thinned to independent ones [U1] [U2]."""
    every = max(1, round(THINNED_TO_S / design.step_s))
    number = np.concatenate([np.arange(n) for n in np.diff(design.start)])
    run, axle = (np.repeat(x, np.diff(design.start)) for x in (design.run, design.axle))
    creepage = design.sliding_m_s / design.speed_m_s
    keep = ((number % every == 0) & (design.sliding_m_s > LEAST_SLIDING_M_S)
            & (design.speed_m_s > LEAST_SPEED_M_S) & (creepage < 0.95))
    block = run * 100_000 + (design.time_s // BLOCK_S).astype(int)
    s = Samples(run, axle, block, design.time_s, design.sliding_m_s, design.speed_m_s, design.load_N,
                design.adhesion, np.minimum(creepage, cleaning_creepage))
    return Samples(*(part[keep] for part in s))


@kernel
def curves(sliding_m_s, speed_m_s, load_N, mu_cd, patch, law, cleaning_creepage, out):
    """f, f_d, f_r of the model at each sample, into out (n, 3)."""
    for i in range(sliding_m_s.size):
        f, f_d, f_r, _, _, _ = wheelset.creep(sliding_m_s[i], speed_m_s[i], load_N[i], mu_cd[i],
                                              law.mu_cr, patch, law, cleaning_creepage)
        out[i, 0], out[i, 1], out[i, 2] = f, f_d, f_r


def predicted(s: Samples, tau_m_J: float, mu_cd: np.ndarray, model: tuple[Patch, Law, float],
              ) -> np.ndarray:
    """(n, 3) f, f_d, f_r for a recovery and the contaminants of the runs, mu_cd (runs,)."""
    patch, law, cleaning = model
    out = np.empty((s.run.size, 3))
    curves(s.sliding_m_s, s.speed_m_s, s.load_N, mu_cd[s.run], patch, law._replace(tau_m_J=tau_m_J),
           cleaning, out)
    return out


class _Fit:
    """Free parameters as logarithms: tau if it is free, then mu_cd of the runs that leave it free."""

    def __init__(self, s: Samples, model: tuple[Patch, Law, float], stated: list[float | None],
                 tau_m_J: float | None) -> None:
        self.s, self.model, self.stated, self.tau = s, model, stated, tau_m_J
        self.free = [i for i, mu in enumerate(stated) if mu is None and np.any(s.run == i)]

    def unpack(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        mu = np.array([self.model[1].mu_cd if m is None else m for m in self.stated])
        mu[self.free] = np.exp(x[-len(self.free):]) if self.free else mu[self.free]
        return (float(np.exp(x[0])) if self.tau is None else self.tau), mu

    def residual(self, x: np.ndarray) -> np.ndarray:
        tau, mu = self.unpack(x)
        return predicted(self.s, tau, mu, self.model)[:, 0] - self.s.adhesion  # [U3]

    def paper_residual(self, x: np.ndarray) -> np.ndarray:
        tau, mu = self.unpack(x)
        _, f_d, f_r = predicted(self.s, tau, mu, self.model).T
        W = 0.5 * self.s.adhesion * self.s.load_N * self.s.creepage
        return self.s.adhesion - f_d - (f_r - f_d) * -np.expm1(-tau * np.maximum(W, 0.0))  # [U4]

    def solve(self, residual: str = "residual") -> tuple[np.ndarray, np.ndarray, float]:
        """(x, jacobian, rms of the residual)."""
        head = [np.log(max(self.model[1].tau_m_J, 1e-5))] if self.tau is None else []
        x0 = np.array(head + [np.log(self.model[1].mu_cd)] * len(self.free))
        if not x0.size:
            return x0, np.zeros((self.s.run.size, 0)), _rms(self.residual(x0))
        low = [np.log(TAU_BOUNDS[0])] * len(head) + [np.log(MU_BOUNDS[0])] * len(self.free)
        high = [np.log(TAU_BOUNDS[1])] * len(head) + [np.log(MU_BOUNDS[1])] * len(self.free)
        found = least_squares(getattr(self, residual), x0, bounds=(low, high), x_scale=0.3, ftol=1e-12,
                              xtol=1e-10)
        return found.x, found.jac, _rms(found.fun)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values * values)))


def tune(data: Dataset, seed: int = 0) -> Tuned:
    """Fit tau to the tuning runs of a dataset. Raises ConfigError where wheels hardly slide."""
    runs = data.group("tune")
    design = prepare(data, runs)
    model = contact(data)
    s = collect(design, model[2])
    if s.run.size < LEAST_SAMPLES:
        raise ConfigError(
            f"{data.folder}: wheels slide by more than {LEAST_SLIDING_M_S} m/s in {s.run.size} samples "
            f"of the tuning runs, {LEAST_SAMPLES} are needed; give runs in which the WSP works")
    stated = [run.mu_cd for run in runs]
    fit = _Fit(s, model, stated, None)
    x, jacobian, rmse = fit.solve()
    tau, mu = fit.unpack(x)
    spread = bootstrap(s, fit.residual(x), jacobian, data.accuracy["calibration_fraction"], seed)
    bounds = np.exp(x + np.percentile(spread, (2.5, 97.5), axis=0))
    f, f_d, f_r = predicted(s, tau, mu, model).T
    warnings = list(data.warnings)
    if not TAU_BOUNDS[0] * 1.01 < tau < TAU_BOUNDS[1] * 0.99:
        warnings.append(f"tau = {tau:.3g} m/J stands at a bound: the runs do not show recovery")
    if len(runs) < 3:
        warnings.append(f"{len(runs)} runs are few for a bootstrap over runs: the interval may be narrow")
    names = [run.name for run in runs]
    contaminants = {names[i]: Interval(float(mu[i]), float(bounds[0, 1 + k]), float(bounds[1, 1 + k]))
                    for k, i in enumerate(fit.free)}
    return Tuned(
        Interval(tau, float(bounds[0, 0]), float(bounds[1, 0])), contaminants,
        float(np.exp(fit.solve("paper_residual")[0][0])), rmse,
        _Fit(s, model, stated, model[1].tau_m_J).solve()[2], _Fit(s, model, stated, 0.0).solve()[2],
        s, (s.adhesion - f_d) / np.maximum(f_r - f_d, 1e-9), f_d, f_r, f, warnings)


def bootstrap(s: Samples, residual: np.ndarray, jacobian: np.ndarray, calibration: float,
              seed: int) -> np.ndarray:
    """Deviations of the parameters, (replicates, parameters): runs, then their blocks, drawn anew.

    Each replicate is one Gauss-Newton step from the optimum; torque and load are off by a common
    factor each, of the declared tolerance.
    """
    rng = np.random.default_rng(seed)
    blocks, of = np.unique(s.block, return_inverse=True)
    k = jacobian.shape[1]
    A, b, c = (np.zeros((blocks.size, *shape)) for shape in ((k, k), (k,), (k,)))
    np.add.at(A, of, jacobian[:, :, None] * jacobian[:, None, :])
    np.add.at(b, of, jacobian * residual[:, None])
    np.add.at(c, of, jacobian * s.adhesion[:, None])
    runs = blocks // 100_000
    present = np.unique(runs)
    out = np.empty((REPLICATES, k))
    for i in range(REPLICATES):
        drawn = rng.choice(present, present.size)
        picked = np.concatenate([rng.choice(m := np.flatnonzero(runs == run), m.size) for run in drawn])
        shift = calibration * np.hypot(*rng.standard_normal(2)) * rng.choice((-1.0, 1.0))
        # a run that was not drawn leaves its contaminant where it is
        normal = A[picked].sum(axis=0) + 1e-12 * np.trace(A.sum(axis=0)) * np.eye(k)
        out[i] = np.linalg.solve(normal, shift * c[picked].sum(axis=0) - b[picked].sum(axis=0))
    return out


def contaminant(s: Samples, model: tuple[Patch, Law, float], stated: float | None, tau_m_J: float,
                ) -> tuple[float, float]:
    """(mu_cd, rmse of f) of one run for a given recovery; mu_cd is fitted unless it is stated."""
    if s.run.size < 10:
        return stated or model[1].mu_cd, float("nan")
    fit = _Fit(s, model, [stated], tau_m_J)
    x, _, rmse = fit.solve()
    return float(fit.unpack(x)[1][0]), rmse
