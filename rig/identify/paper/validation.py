"""Validates a tuned model on runs that were never fitted, in the form of the paper's Table 6.

Stick and slip never repeat in detail. Therefore runs are compared by the course of the vehicle's
speed, and by mean and spread of sliding. Each wheelset runs free (`free_run`) under its measured
torque and load in windows of one second, which begin at the measured state. The contact forces of
these windows move a vehicle that is never set back to the measurement. The classic model (tau = 0)
runs for comparison.

    [V1] J domega/dt = r N f(v - r omega, v, N) - C, M dv/dt = -sum T - resistance, where v of the
         wheels is the measured one
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
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.identify.data.parameters import LAW, MU_CD, RADIUS, TAU
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper import tuning
from rollerrig.rig.identify.replay import free_run

# s. A wheelset runs free for so long before it is set to the measured speed again.
WINDOW_S = 1.0

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


def validate(data: Dataset, tau_m_J: float, group: str = "validate") -> list[Verdict]:
    """Judge both models on the runs of a group. Raises ConfigError without such runs."""
    runs = data.group(group)
    if not runs:
        raise ConfigError(
            f'{data.folder / "dataset.toml"}: no run has group = "{group}"; mark the runs '
            "that shall be judged"
        )
    design = prepare(data, runs)
    samples = tuning.collect(design, Law(*design.base[LAW]))
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
            "new": _simulate(design, samples, index, length, tau_m_J, run.mu_cd),
            "classic": _simulate(design, samples, index, length, 0.0, run.mu_cd),
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
    design: Design,
    samples: tuning.Samples,
    run: int,
    length: int,
    tau_m_J: float,
    stated_mu_cd: float | None,
) -> _Simulated:
    """Run one model free on the first samples of a run; `samples` are those of all runs."""
    of_this = tuning.Samples(*(column[samples.run == run] for column in samples))
    of_this = of_this._replace(run=np.zeros_like(of_this.run))
    mu_cd, rmse = tuning.contaminant(of_this, design.base, stated_mu_cd, tau_m_J)

    def of_run(flat: np.ndarray) -> np.ndarray:
        return design.by_axle(flat, run)[:length]

    row = design.base.copy()
    row[TAU] = tau_m_J
    row[MU_CD] = mu_cd
    surface_m_s = of_run(design.speed_m_s)
    unchanged = np.ones_like(surface_m_s)
    motion = free_run.run(
        free_run.Stop(
            surface_m_s=surface_m_s,
            load_N=of_run(design.load_N),
            torque_Nm=of_run(design.torque_Nm),
            degraded=unchanged,
            recovered=unchanged,
            sliding_m_s=of_run(design.sliding_m_s),
            parameters=np.tile(row, (design.axles, 1)),
            mass_kg=design.mass_kg[run],
            extra_N=np.zeros(length),
            resistance=tuple(design.resistance),
            field=np.zeros((2, design.axles)),
            axle_position_m=np.zeros(design.axles),
            step_s=design.step_s,
            on_rollers=True,
            feedback_Ns=0.0,
            window=round(WINDOW_S / design.step_s),
        )
    )
    sliding_m_s = surface_m_s - row[RADIUS] * motion.wheel_rad_s
    measured_m_s = surface_m_s[:, 0]
    statistics = Statistics(
        mu_cd=mu_cd,
        speed_error_m_s=float(np.max(np.abs(motion.speed_m_s - measured_m_s))),  # [V2]
        mean_m_s=sliding_m_s.mean(axis=0),
        deviation_m_s=sliding_m_s.std(axis=0),
        adhesion_rmse=rmse,
    )
    return _Simulated(statistics, motion.speed_m_s, sliding_m_s)
