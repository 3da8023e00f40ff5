"""Validates a tuned model on runs that were never fitted, in the form of the paper's Table 6.

Stick and slip repeat in no detail, so runs are compared by the course of the vehicle's speed and by
the mean and the spread of sliding. Each wheelset runs free under its measured torque and load in
windows of one second, beginning where it was measured; the contact forces of these windows move a
vehicle of its own, which is never set back. The classic model (tau = 0) runs beside the new one.

    [V1] J domega/dt = r N f(v - r omega, v, N) - C, M dv/dt = -sum T - resistance
    [V2] E = max |v_model - v_measured|                                          paper eq. 22
    [V3] mean = 1/T integral of s dt                                             paper eq. 23
    [V4] deviation = sqrt(1/T integral of (s - mean)^2 dt)                       paper eq. 24

Each model gets the contaminant level mu_cd of each run that does not state it (a nuisance that no
model can know beforehand); nothing else is fitted here. Source: paper section 5. Limits: windows
longer than 1 to 2 s diverge, since neighbouring motions part.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig import wheelset
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import AXLES, Dataset
from rollerrig.rig.identify.paper import tuning

WINDOW_S = 1.0
SUBSTEPS = 10
SLOWEST_M_S = 2.0


class Statistics(NamedTuple):
    """Of one model (or the measurement) on one run; per axle shape (4,)."""

    mu_cd: float
    speed_error_m_s: float  # [V2]; nan for the measurement
    mean_m_s: np.ndarray  # [V3]
    deviation_m_s: np.ndarray  # [V4]
    adhesion_rmse: float  # one sample, no windows


class Verdict(NamedTuple):
    """One run: statistics by name (measured, new, classic) and the courses for plots, (n,) or (n, 4)."""

    run: str
    initial_speed_m_s: float
    statistics: dict[str, Statistics]
    time_s: np.ndarray
    speed_m_s: dict[str, np.ndarray]
    sliding_m_s: dict[str, np.ndarray]


@kernel
def free_run(
    omega_measured,
    surface_m_s,
    load_N,
    torque_Nm,
    mu_cd,
    step_s,
    window,
    params,
    patch,
    law,
    sliding,
    force_N,
):
    """Sliding and contact force of one wheelset in windows of samples [V1]; `params`: wheel radius, inertia, mu_cr."""
    r, inertia, mu_cr = params[0], params[1], params[2]
    h = step_s / SUBSTEPS  # linearly implicit Euler
    omega = omega_measured[0]
    for k in range(omega_measured.size):
        if k % window == 0:
            omega = omega_measured[k]
        last = min(k + 1, omega_measured.size - 1)
        total = 0.0
        sliding[k] = surface_m_s[k] - r * omega
        for i in range(SUBSTEPS):
            part = (i + 1.0) / SUBSTEPS
            v = surface_m_s[k] + part * (surface_m_s[last] - surface_m_s[k])
            N = load_N[k] + part * (load_N[last] - load_N[k])
            C = torque_Nm[k] + part * (torque_Nm[last] - torque_Nm[k])
            f, _, _, _, _, slope = wheelset.wheelset_adhesion(
                v - r * omega, v, N, mu_cd, mu_cr, patch, law
            )
            slope = max(slope, 0.0)
            damping = slope * N * r * r / inertia
            before = omega
            omega = max(0.0, omega + h * (r * f * N - C) / inertia / (1.0 + h * damping))
            total += N * (
                f - slope * r * (omega - before)
            )  # at the end of the step, as the balance has it
        force_N[k] = total / SUBSTEPS


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
        measured, slid = (
            design.speed_m_s[design.span(index * AXLES)],
            design.by_axle(design.sliding_m_s, index),
        )
        moving = measured > SLOWEST_M_S
        length = int(np.argmin(moving)) if not moving.all() else moving.size
        slid, speed, sliding = (
            slid[:length],
            {"measured": measured[:length]},
            {"measured": slid[:length]},
        )
        found = {
            "measured": Statistics(np.nan, np.nan, slid.mean(axis=0), slid.std(axis=0), np.nan)
        }
        for name, tau in (("new", tau_m_J), ("classic", 0.0)):
            found[name], speed[name], sliding[name] = _simulated(
                data, design, index, length, tau, run.mu_cd
            )
        verdicts.append(
            Verdict(
                run.name,
                float(np.median(run.speed_m_s[:20])),
                found,
                run.time_s[:length],
                speed,
                sliding,
            )
        )
    return verdicts


def _simulated(
    data: Dataset, design: Design, run: int, length: int, tau_m_J: float, stated: float | None
) -> tuple[Statistics, np.ndarray, np.ndarray]:
    patch, law = model = tuning.contact(data)
    samples = tuning.collect(design, law.cleaning_creepage)
    own = tuning.Samples(*(part[samples.run == run] for part in samples))
    mu_cd, rmse = tuning.contaminant(
        own._replace(run=np.zeros_like(own.run)), model, stated, tau_m_J
    )
    radius, inertia = (
        data.sections["vehicle"][key] for key in ("wheel_radius_m", "wheelset_inertia_kgm2")
    )
    one, other = np.empty((2, AXLES, length))
    for j in range(AXLES):
        surface, slid, load, torque = (
            flat[design.span(run * AXLES + j)][:length]
            for flat in (design.speed_m_s, design.sliding_m_s, design.load_N, design.torque_Nm)
        )
        free_run(
            (surface - slid) / radius,
            surface,
            load,
            torque,
            mu_cd,
            design.step_s,
            round(WINDOW_S / design.step_s),
            np.array([radius, inertia, law.mu_cr]),
            patch,
            law._replace(tau_m_J=tau_m_J),
            one[j],
            other[j],
        )
    sliding, force = one.T.copy(), other.T.copy()
    measured = design.speed_m_s[design.span(run * AXLES)][:length]
    A, B, C = design.resistance
    resisting = A + B * measured + C * measured * measured
    rate = -(force.sum(axis=1) + resisting) / design.mass_kg[run]
    speed = measured[0] + design.step_s * np.concatenate([[0.0], np.cumsum(rate[:-1])])
    error = float(np.max(np.abs(speed - measured)))  # [V2]
    return Statistics(mu_cd, error, sliding.mean(axis=0), sliding.std(axis=0), rmse), speed, sliding
