"""The reports of `rollerrig tune` and `rollerrig validate` on braking runs: JSON, tables and
pages.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rollerrig.realtime.record.summary import finite
from rollerrig.realtime.reports import page
from rollerrig.realtime.reports.page import (
    BASE,
    EXTENDED,
    GREY,
    INK,
    MEASURED,
    RUNS,
    element,
    paragraph,
    table,
)
from rollerrig.realtime.reports.study import Model, StudyReport, Table
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper.tuning import Interval, Tuned
from rollerrig.rig.identify.paper.validation import Verdict

# name in the JSON -> colour and words
MODELS = {
    "measured": (MEASURED, "measured"),
    "new": (EXTENDED, "with recovery"),
    "classic": (BASE, "classic, no recovery"),
}
# the models that are compared with the measurement
COMPARED = ("new", "classic")

# of a table of parameters
HEAD = ("", "value (95 %)")

# style of thousands of measured points
_POINTS: dict[str, Any] = {
    "linestyle": "",
    "marker": ".",
    "markersize": 2,
    "alpha": 0.3,
    "rasterized": True,
}

# the transition against energy: bins, and the fewest points of a bin
_BIN_EDGES = 25
_LEAST_POINTS = 15

# f_r - f_d is taken as at least this where something is divided by it
_LEAST_SPREAD = 1e-9

# m/J are shown in this unit
_TAU_SCALE = 1e4


def interval_json(interval: Interval) -> dict[str, Any]:
    """Return an interval as JSON."""
    return {"value": interval.value, "ci95": [interval.low, interval.high]}


def interval_words(interval: Mapping[str, Any], scale: float = 1.0) -> str:
    """Return an interval of the JSON in words, scaled."""
    value = scale * interval["value"]
    low, high = (scale * bound for bound in interval["ci95"])
    return f"{value:.4g} ({low:.4g} to {high:.4g})"


# --- tune ---


def tune_report(data: Dataset, tuned: Tuned) -> StudyReport:
    """Return the whole report of a tuning, with the tuned model."""
    result = tune_json(data, tuned)
    return StudyReport(
        result=result,
        page=tune_page(data, tuned),
        summary=((f"tuned on {data.name}", HEAD, tune_rows(result)),),
        model=Model(
            "tuned.toml",
            f"# tuned on {data.name} by rollerrig tune; load it with: rollerrig run ... --model\n"
            f"[adhesion]\ntau_m_J = {tuned.tau_m_J.value!r}\n",
        ),
    )


def tune_json(data: Dataset, tuned: Tuned) -> dict[str, Any]:
    """Return the content of tune.json."""
    return {
        "dataset": data.name,
        "kind": data.kind,
        "samples": len(tuned.model),
        "tau_m_J": interval_json(tuned.tau_m_J),
        "tau_paper_form_m_J": tuned.tau_paper_m_J,
        "mu_cd": {run: interval_json(mu_cd) for run, mu_cd in tuned.mu_cd.items()},
        "adhesion_rmse": {
            "tuned": tuned.rmse,
            "base": tuned.rmse_base,
            "classic": tuned.rmse_classic,
        },
        "base_tau_m_J": data.sections["adhesion"]["tau_m_J"],
        "warnings": tuned.warnings,
    }


def tune_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the content of tune.json as rows under HEAD."""
    paper_tau = f"{result['tau_paper_form_m_J'] * _TAU_SCALE:.4g}"
    base_tau = f"{result['base_tau_m_J'] * _TAU_SCALE:.4g}"
    rmse = result["adhesion_rmse"]
    rows = [
        ("tau, 1e-4 m/J", interval_words(result["tau_m_J"], _TAU_SCALE)),
        ("tau by the paper's least squares (eq. 21), biased by an irregular rail", paper_tau),
        ("tau of the dataset's base model", base_tau),
    ]
    for run, mu_cd in result["mu_cd"].items():
        rows.append((f"mu_cd of {run}", interval_words(mu_cd)))
    rows.append(("rms error of f, tuned", f"{rmse['tuned']:.5f}"))
    rows.append(("rms error of f, dataset's tau, mu_cd fitted", f"{rmse['base']:.5f}"))
    rows.append(("rms error of f, no recovery, mu_cd fitted", f"{rmse['classic']:.5f}"))
    return rows


def tune_page(data: Dataset, tuned: Tuned) -> str:
    """Return the page of a tuning."""
    return page.page(
        f"Tuning on {data.name}",
        paragraph(
            f"{len(tuned.model)} samples of {len(data.group('tune'))} runs in which wheels slide. "
            "Intervals hold the value in 95 of 100 cases (bootstrap over 3 s blocks of each run)."
        ),
        *(paragraph(warning, kind="warn") for warning in tuned.warnings),
        table(HEAD, tune_rows(tune_json(data, tuned))),
        element("h2", "Transition against dissipated energy"),
        page.picture(partial(_draw_transition, data=data, tuned=tuned)),
        element("h2", "Adhesion against sliding"),
        page.picture(partial(_draw_adhesion, tuned=tuned)),
        element("h2", "Transition in time, wheelset 1"),
        page.picture(partial(_draw_courses, data=data, tuned=tuned), (11.0, 6.0)),
        paragraph(
            "lambda: 0 is contaminated, 1 is fully recovered. Points: measured, by the balance of the "
            "wheel. Line: 1 - exp(-tau W)."
        ),
    )


def _draw_transition(figure: Figure, data: Dataset, tuned: Tuned) -> None:
    """Draw the measured transition against energy, and the exponentials of tau and of the base."""
    axes = figure.subplots()
    energy = tuned.samples.energy_J_m
    highest = float(np.percentile(energy, 99.5))
    for i, (run, colour) in enumerate(zip(data.group("tune"), itertools.cycle(RUNS))):
        of_run = tuned.samples.run == i
        axes.plot(energy[of_run][::3], tuned.transition[of_run][::3], color=colour, **_POINTS)
        _draw_quartiles(axes, energy[of_run], tuned.transition[of_run], highest, colour, run.name)

    def recovered(tau_m_J: float, energy_J_m: Any) -> Any:
        return -np.expm1(-tau_m_J * energy_J_m)

    tau = tuned.tau_m_J
    grid = np.linspace(0.0, highest, 200)
    base = recovered(data.sections["adhesion"]["tau_m_J"], grid)
    axes.plot(grid, recovered(tau.value, grid), INK, label="tuned")
    axes.plot(grid, base, "--", color=INK, label="base")
    axes.fill_between(
        grid,
        recovered(tau.low, grid),
        recovered(tau.high, grid),
        color=INK,
        alpha=0.15,
        lw=0,
    )
    axes.set(
        xlabel="dissipated energy W_sp of one wheel, J/m",
        ylabel="transition lambda",
        xlim=(0.0, highest),
        ylim=(-0.05, min(1.1, 1.4 * recovered(tau.value, highest) + 0.05)),
    )
    axes.legend()


def _draw_quartiles(
    axes: Axes,
    energy: np.ndarray,
    transition: np.ndarray,
    highest: float,
    colour: str,
    label: str,
) -> None:
    """Draw median and quartiles of the transition in bins of energy; bins with few points are left
    out.
    """
    middles = []
    quartiles = []
    for start, end in itertools.pairwise(np.linspace(0.0, highest, _BIN_EDGES)):
        inside = transition[(start <= energy) & (end > energy)]
        if inside.size > _LEAST_POINTS:
            middles.append(0.5 * (start + end))
            quartiles.append(np.percentile(inside, (25, 50, 75)))
    low, median, high = np.reshape(quartiles, (-1, 3)).T
    bars = (median - low, high - median)
    axes.errorbar(middles, median, bars, fmt="o", ms=4, color=colour, label=label)


def _draw_adhesion(figure: Figure, tuned: Tuned) -> None:
    axes = figure.subplots()
    for values, colour, label in (
        (tuned.samples.adhesion, RUNS[0], "measured"),
        (tuned.model, RUNS[1], "model"),
        (tuned.degraded, GREY, "f_d degraded"),
    ):
        axes.plot(tuned.samples.sliding_m_s, values, color=colour, label=label, **_POINTS)
    axes.set(
        xlabel="sliding, m/s", ylabel="adhesion coefficient", xlim=(0.0, None), ylim=(0.0, None)
    )
    axes.legend(markerscale=4)


def _draw_courses(figure: Figure, data: Dataset, tuned: Tuned) -> None:
    """Draw measured transition and model over time, wheelset 1 of each run."""
    runs = data.group("tune")
    plots = figure.subplots(len(runs), 1, sharex=True, squeeze=False)[:, 0]
    for i, (axes, run, colour) in enumerate(zip(plots, runs, itertools.cycle(RUNS))):
        shown = (tuned.samples.run == i) & (tuned.samples.axle == 0)
        time_s = tuned.samples.time_s[shown]
        spread = np.maximum(tuned.recovered - tuned.degraded, _LEAST_SPREAD)[shown]
        model = (tuned.model - tuned.degraded)[shown] / spread
        axes.plot(time_s, tuned.transition[shown], ".", ms=2, color=colour)
        axes.plot(time_s, model, ".", ms=1, color=INK)
        axes.set(ylabel=f"lambda in {run.name}", ylim=(-0.2, 1.2))
    plots[-1].set_xlabel("time, s")


# --- validate ---


def validate_report(data: Dataset, tau: Interval, verdicts: Sequence[Verdict]) -> StudyReport:
    """Return the whole report of a validation."""
    result = validate_json(data, tau, verdicts)
    head, rows = table6(verdicts)
    errors = [
        f"{name:8} mean absolute error: mean sliding {error['mean_1_m_s']:.3f} m/s, "
        f"standard deviation {error['std_1_m_s']:.3f} m/s (wheelset 1); "
        f"rms of f {error['adhesion_rmse']:.4f}"
        for name, error in result["errors"].items()
    ]
    title = f"{data.name}: Table 6 with tau = {tau.value:.4g} m/J, m/s"
    return StudyReport(
        result=result,
        page=validate_page(data, tau, verdicts),
        summary=((title, head, rows), *errors),
    )


def validate_json(data: Dataset, tau: Interval, verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Return the content of validate.json: Table 6 and its errors."""
    return {
        "dataset": data.name,
        "tau_m_J": interval_json(tau),
        "runs": {verdict.run: _run_json(verdict) for verdict in verdicts},
        "errors": {name: mean_errors(verdicts, name) for name in COMPARED},
        "warnings": data.warnings,
    }


def _run_json(verdict: Verdict) -> dict[str, Any]:
    result: dict[str, Any] = {"initial_speed_m_s": verdict.initial_speed_m_s}
    for name, statistics in verdict.statistics.items():
        result[name] = {
            "mu_cd": finite(statistics.mu_cd),
            "E1_m_s": finite(statistics.speed_error_m_s),
            "sliding_mean_m_s": statistics.mean_m_s.tolist(),
            "sliding_std_m_s": statistics.deviation_m_s.tolist(),
            "adhesion_rmse": finite(statistics.adhesion_rmse),
        }
    return result


def mean_errors(verdicts: Sequence[Verdict], name: str) -> dict[str, float]:
    """Return the mean absolute errors of a model over runs: wheelset 1, as in the paper, and
    all.
    """
    modelled = [verdict.statistics[name] for verdict in verdicts]
    measured = [verdict.statistics["measured"] for verdict in verdicts]
    pairs = list(zip(modelled, measured, strict=True))
    mean = np.abs([model.mean_m_s - true.mean_m_s for model, true in pairs])
    deviation = np.abs([model.deviation_m_s - true.deviation_m_s for model, true in pairs])
    return {
        "mean_1_m_s": float(mean[:, 0].mean()),
        "mean_m_s": float(mean.mean()),
        "std_1_m_s": float(deviation[:, 0].mean()),
        "std_m_s": float(deviation.mean()),
        "E1_m_s": float(np.mean([model.speed_error_m_s for model in modelled])),
        "adhesion_rmse": float(np.mean([model.adhesion_rmse for model in modelled])),
    }


def table6(verdicts: Sequence[Verdict]) -> Table:
    """Return head and rows in the form of the paper's Table 6, for wheelset 1, with both models."""

    def row(title: str, value: Callable[[Verdict], float]) -> list[str]:
        return [title, *(f"{value(verdict):.2f}" for verdict in verdicts)]

    def speed_error(verdict: Verdict, name: str) -> float:
        return verdict.statistics[name].speed_error_m_s

    def mean_sliding(verdict: Verdict, name: str) -> float:
        return float(verdict.statistics[name].mean_m_s[0])

    def deviation(verdict: Verdict, name: str) -> float:
        return float(verdict.statistics[name].deviation_m_s[0])

    rows = [row("initial speed, m/s", lambda verdict: verdict.initial_speed_m_s)]
    for title, value, names in (
        ("E1, largest velocity error", speed_error, COMPARED),
        ("mean sliding of wheelset 1", mean_sliding, MODELS),
        ("standard deviation", deviation, MODELS),
    ):
        for name in names:
            _, label = MODELS[name]
            rows.append(row(f"{title}, {label}", partial(value, name=name)))
    return ["", *(verdict.run for verdict in verdicts)], rows


def validate_page(data: Dataset, tau: Interval, verdicts: Sequence[Verdict]) -> str:
    """Return the page of a validation."""
    error_rows = []
    for name in COMPARED:
        _, label = MODELS[name]
        values = mean_errors(verdicts, name).values()
        error_rows.append([label, *(f"{value:.4f}" for value in values)])

    courses: list[str] = []
    for verdict in verdicts:
        courses.append(element("h2", verdict.run))
        courses.append(page.picture(partial(_draw_stop, verdict=verdict), (11.0, 6.0)))

    return page.page(
        f"Validation on {data.name}",
        paragraph(
            f"tau = {interval_words(interval_json(tau), _TAU_SCALE)} 1e-4 m/J from the tuning runs. The "
            "runs below were not fitted, except that both models get the contaminant level mu_cd of a "
            "run that does not state it. Wheels run free in windows of 1 s under measured torque and "
            "load."
        ),
        *(paragraph(warning, kind="warn") for warning in data.warnings),
        element("h2", "Table 6, m/s"),
        table(*table6(verdicts)),
        element("h2", "Mean absolute errors, m/s"),
        table(
            [
                "model",
                "mean, wheelset 1",
                "mean, all",
                "std, wheelset 1",
                "std, all",
                "E1",
                "rms of f",
            ],
            error_rows,
        ),
        *courses,
    )


def _draw_stop(figure: Figure, verdict: Verdict) -> None:
    """Draw vehicle speed and sliding of wheelset 1, measured and of both models."""
    speed, sliding = figure.subplots(2, 1, sharex=True)
    for name, (colour, label) in MODELS.items():
        speed.plot(verdict.time_s, verdict.speed_m_s[name], color=colour, label=label)
        sliding.plot(verdict.time_s, verdict.sliding_m_s[name][:, 0], color=colour)
    speed.set_ylabel("vehicle speed, m/s")
    speed.legend()
    sliding.set(xlabel="time, s", ylabel="sliding of wheelset 1, m/s")
