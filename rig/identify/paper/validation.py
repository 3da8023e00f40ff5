"""Validates a tuned model on runs that were never fitted, in the form of the paper's Table 6.

Stick and slip never repeat in detail. Therefore runs are compared by the course of the vehicle's
speed, and by mean and spread of sliding. Each wheelset runs free under its measured torque and load
in windows of one second, which begin at the measured state. The contact forces of these windows
move a vehicle that is never set back to the measurement. The classic model (tau = 0) runs for
comparison.

    [V1] J domega/dt = r N f(v - r omega, v, N) - C, M dv/dt = -sum T - resistance
    [V2] E = max |v_model - v_measured|                                          paper eq. 22
    [V3] mean = 1/T integral of s dt                                             paper eq. 23
    [V4] deviation = sqrt(1/T integral of (s - mean)^2 dt)                       paper eq. 24

Each model gets the contaminant level mu_cd of each run that does not state it, because no model can
know it beforehand. Nothing else is fitted here. Source: paper section 5. Limit: windows longer than
1 to 2 s diverge, because neighbouring motions separate.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig import wheelset
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper import tuning

# s. A wheelset runs free for so long before it is set to the measured speed again.
WINDOW_S = 1.0

# steps of the integration in one sample
SUBSTEPS = 10

# m/s. A run is judged until the vehicle is slower.
SLOWEST_M_S = 2.0

# samples whose median is the initial speed
_FIRST_SAMPLES = 20


class Statistics(NamedTuple):
    """Statistics of one model, or of the measurement, on one run; per wheelset shape (axles,)."""

    mu_cd: float
    speed_error_m_s: float  # [V2]; NaN for the measurement
    mean_m_s: np.ndarray  # [V3], sliding
    deviation_m_s: np.ndarray  # [V4], sliding
    adhesion_rmse: float  # of single samples, without windows


class Verdict(NamedTuple):
    """One run: statistics and courses by name (measured, new, classic).

    The courses have the shape (n,) or (n, axles).
    """

    run: str
    initial_speed_m_s: float
    statistics: dict[str, Statistics]
    time_s: np.ndarray
    speed_m_s: dict[str, np.ndarray]
    sliding_m_s: dict[str, np.ndarray]


class _Simulated(NamedTuple):
    """One model on one run: statistics, speed of the vehicle (n,) and sliding (n, axles)."""

    statistics: Statistics
    speed_m_s: np.ndarray
    sliding_m_s: np.ndarray


@kernel
def free_run(
    omega_measured,
    surface_m_s,
    load_N,
    torque_Nm,
    mu_cd,
    step_s,
    window,
    radius_m,
    inertia_kgm2,
    patch,
    law,
    sliding,
    force_N,
):
    """Write sliding and contact force of one wheelset in windows of samples [V1]; inputs (n,)."""
    h = step_s / SUBSTEPS  # linearly implicit Euler
    omega = omega_measured[0]
    for k in range(omega_measured.size):
        if k % window == 0:
            omega = omega_measured[k]
        following = min(k + 1, omega_measured.size - 1)
        force_sum = 0.0
        sliding[k] = surface_m_s[k] - radius_m * omega
        for i in range(SUBSTEPS):
            # inputs are linear between two samples
            share = (i + 1.0) / SUBSTEPS
            v = surface_m_s[k] + share * (surface_m_s[following] - surface_m_s[k])
            N = load_N[k] + share * (load_N[following] - load_N[k])
            C = torque_Nm[k] + share * (torque_Nm[following] - torque_Nm[k])
            f, _, _, _, _, slope = wheelset.wheelset_adhesion(
                v - radius_m * omega, v, N, mu_cd, law.mu_cr, patch, law
            )
            slope = max(slope, 0.0)
            damping = slope * N * radius_m * radius_m / inertia_kgm2
            before = omega
            omega = max(
                0.0, omega + h * (radius_m * f * N - C) / inertia_kgm2 / (1.0 + h * damping)
            )
            # the force at the end of the step, as in the balance
            force_sum += N * (f - slope * radius_m * (omega - before))
        force_N[k] = force_sum / SUBSTEPS


def validate(data: Dataset, tau_m_J: float, group: str = "validate") -> list[Verdict]:
    """Judge both models on the runs of a group. Raises ConfigError without such runs."""
    runs = data.group(group)
    if not runs:
        raise ConfigError(
            f'{data.folder / "dataset.toml"}: no run has group = "{group}"; mark the runs '
            "that shall be judged"
        )
    design = prepare(data, runs)
    verdicts = []
    for index, run in enumerate(runs):
        measured_m_s = design.speed_m_s[design.span(index * design.axles)]
        is_moving = measured_m_s > SLOWEST_M_S
        length = int(np.argmin(is_moving)) if not is_moving.all() else is_moving.size
        measured_m_s = measured_m_s[:length]
        sliding_m_s = design.by_axle(design.sliding_m_s, index)[:length]

        results = {
            "measured": _Simulated(
                Statistics(
                    mu_cd=np.nan,
                    speed_error_m_s=np.nan,
                    mean_m_s=sliding_m_s.mean(axis=0),
                    deviation_m_s=sliding_m_s.std(axis=0),
                    adhesion_rmse=np.nan,
                ),
                measured_m_s,
                sliding_m_s,
            ),
            "new": _simulate(data, design, index, length, tau_m_J, run.mu_cd),
            "classic": _simulate(data, design, index, length, 0.0, run.mu_cd),
        }
        verdicts.append(
            Verdict(
                run=run.name,
                initial_speed_m_s=float(np.median(run.speed_m_s[:_FIRST_SAMPLES])),
                statistics={name: result.statistics for name, result in results.items()},
                time_s=run.time_s[:length],
                speed_m_s={name: result.speed_m_s for name, result in results.items()},
                sliding_m_s={name: result.sliding_m_s for name, result in results.items()},
            )
        )
    return verdicts


def _simulate(
    data: Dataset,
    design: Design,
    run: int,
    length: int,
    tau_m_J: float,
    stated_mu_cd: float | None,
) -> _Simulated:
    """Run one model free on the first samples of a run."""
    model = tuning.contact(data)
    all_samples = tuning.collect(design, model.law)
    samples = tuning.Samples(*(column[all_samples.run == run] for column in all_samples))
    samples = samples._replace(run=np.zeros_like(samples.run))
    mu_cd, rmse = tuning.contaminant(samples, model, stated_mu_cd, tau_m_J)

    radius_m = data.sections["vehicle"]["wheel_radius_m"]
    axles = design.axles
    sliding_m_s = np.empty((axles, length))
    force_N = np.empty((axles, length))
    for j in range(axles):
        segment = design.span(run * axles + j)
        surface_m_s = design.speed_m_s[segment][:length]
        omega_rad_s = (surface_m_s - design.sliding_m_s[segment][:length]) / radius_m
        free_run(
            omega_rad_s,
            surface_m_s,
            design.load_N[segment][:length],
            design.torque_Nm[segment][:length],
            mu_cd,
            design.step_s,
            round(WINDOW_S / design.step_s),
            radius_m,
            data.sections["vehicle"]["wheelset_inertia_kgm2"],
            model.patch,
            model.law._replace(tau_m_J=tau_m_J),
            sliding_m_s[j],
            force_N[j],
        )
    # samples first; copied, so that sums over samples keep their order in memory
    sliding_m_s = sliding_m_s.T.copy()
    force_N = force_N.T.copy()

    measured_m_s = design.speed_m_s[design.span(run * axles)][:length]
    A, B, C = design.resistance
    resistance_N = A + B * measured_m_s + C * measured_m_s * measured_m_s
    acceleration = -(force_N.sum(axis=1) + resistance_N) / design.mass_kg[run]
    moved = np.concatenate([[0.0], np.cumsum(acceleration[:-1])])
    speed_m_s = measured_m_s[0] + design.step_s * moved
    statistics = Statistics(
        mu_cd=mu_cd,
        speed_error_m_s=float(np.max(np.abs(speed_m_s - measured_m_s))),  # [V2]
        mean_m_s=sliding_m_s.mean(axis=0),
        deviation_m_s=sliding_m_s.std(axis=0),
        adhesion_rmse=rmse,
    )
    return _Simulated(statistics, speed_m_s, sliding_m_s)
