"""Reports of tune and validate: what stands in their pages, and the same as plain data."""

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
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
from rollerrig.rig.identify.data.parameters import patch_of
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper.polach_fit import NAMES, RECOMMENDED, Fitted, falls, model
from rollerrig.rig.identify.paper.tuning import Interval, Tuned
from rollerrig.rig.identify.paper.validation import Verdict

MODELS = {
    "measured": (MEASURED, "measured"),
    "new": (EXTENDED, "with recovery"),
    "classic": (BASE, "classic, no recovery"),
}
_POINTS: dict[str, Any] = {
    "linestyle": "",
    "marker": ".",
    "markersize": 2,
    "alpha": 0.3,
    "rasterized": True,
}


HEAD = ("", "value (95 %)")


def _interval(v: Mapping[str, Any], scale: float = 1.0) -> str:
    return "{:.4g} ({:.4g} to {:.4g})".format(*(scale * x for x in (v["value"], *v["ci95"])))


def _plain(v: Interval) -> dict[str, Any]:
    return {"value": v.value, "ci95": [v.low, v.high]}


def tune_json(data: Dataset, t: Tuned) -> dict[str, Any]:
    """What tune found, as plain data."""
    return {
        "dataset": data.name,
        "kind": data.kind,
        "samples": len(t.model),
        "tau_m_J": _plain(t.tau_m_J),
        "tau_paper_form_m_J": t.tau_paper_m_J,
        "mu_cd": {run: _plain(v) for run, v in t.mu_cd.items()},
        "adhesion_rmse": {"tuned": t.rmse, "base": t.rmse_base, "classic": t.rmse_classic},
        "base_tau_m_J": data.sections["adhesion"]["tau_m_J"],
        "warnings": t.warnings,
    }


def tune_rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What `tune_json` has, for people."""
    return [
        ("tau, 1e-4 m/J", _interval(found["tau_m_J"], 1e4)),
        (
            "the same by the paper's least squares (eq. 21), biased by an irregular rail",
            f"{found['tau_paper_form_m_J'] * 1e4:.4g}",
        ),
        ("base of the dataset", f"{found['base_tau_m_J'] * 1e4:.4g}"),
        *((f"mu_cd of {run}", _interval(v)) for run, v in found["mu_cd"].items()),
        *(
            (f"rms error of f, {title}", f"{found['adhesion_rmse'][key]:.5f}")
            for title, key in (
                ("tuned", "tuned"),
                ("dataset's tau, mu_cd fitted", "base"),
                ("no recovery, mu_cd fitted", "classic"),
            )
        ),
    ]


def tune_page(data: Dataset, t: Tuned) -> str:
    """The report of a tuning."""
    return page.page(
        f"Tuning on {data.name}",
        paragraph(
            f"{len(t.model)} samples of {len(data.group('tune'))} runs in which wheels slide. "
            "Intervals hold the value in 95 of 100 cases (bootstrap over 3 s blocks of each run)."
        ),
        *(paragraph(w, kind="warn") for w in t.warnings),
        table(HEAD, tune_rows(tune_json(data, t))),
        element("h2", "Transition against dissipated energy"),
        page.picture(lambda f: _transition(f, data, t)),
        element("h2", "Adhesion against sliding"),
        page.picture(lambda f: _adhesion(f, t)),
        element("h2", "Transition in time, wheelset 1"),
        page.picture(lambda f: _course(f, data, t), (11.0, 6.0)),
        paragraph(
            "lambda: 0 as contaminated, 1 fully recovered. Points: measured, by the wheel "
            "balance. Line: 1 - exp(-tau W)."
        ),
    )


def _transition(figure: Figure, data: Dataset, t: Tuned) -> None:
    axes = figure.subplots()
    W = t.samples.energy_J_m
    top = float(np.percentile(W, 99.5))
    edges = np.linspace(0.0, top, 25)
    for i, (run, colour) in enumerate(zip(data.group("tune"), itertools.cycle(RUNS))):
        own = t.samples.run == i
        axes.plot(W[own][::3], t.transition[own][::3], color=colour, **_POINTS)
        known = [
            (0.5 * (a + b), np.percentile(inside, (25, 50, 75)))
            for a, b in itertools.pairwise(edges)
            if (inside := t.transition[own & (a <= W) & (b > W)]).size > 15
        ]
        at, (low, middle, high) = (
            [x for x, _ in known],
            np.reshape([q for _, q in known], (-1, 3)).T,
        )
        axes.errorbar(
            at, middle, (middle - low, high - middle), fmt="o", ms=4, color=colour, label=run.name
        )
    grid = np.linspace(0.0, top, 200)
    axes.plot(grid, -np.expm1(-t.tau_m_J.value * grid), INK, label="tuned")
    axes.plot(
        grid, -np.expm1(-data.sections["adhesion"]["tau_m_J"] * grid), "--", color=INK, label="base"
    )
    axes.fill_between(
        grid,
        -np.expm1(-t.tau_m_J.low * grid),
        -np.expm1(-t.tau_m_J.high * grid),
        color=INK,
        alpha=0.15,
        lw=0,
    )
    axes.set(
        xlabel="dissipated energy W_sp of one wheel, J/m",
        ylabel="transition lambda",
        xlim=(0.0, top),
        ylim=(-0.05, min(1.1, 1.4 * -np.expm1(-t.tau_m_J.value * top) + 0.05)),
    )
    axes.legend()


def _adhesion(figure: Figure, t: Tuned) -> None:
    axes = figure.subplots()
    for values, colour, label in (
        (t.samples.adhesion, RUNS[0], "measured"),
        (t.model, RUNS[1], "model"),
        (t.degraded, GREY, "f_d degraded"),
    ):
        axes.plot(t.samples.sliding_m_s, values, color=colour, label=label, **_POINTS)
    axes.set(
        xlabel="sliding, m/s", ylabel="adhesion coefficient", xlim=(0.0, None), ylim=(0.0, None)
    )
    axes.legend(markerscale=4)


def _course(figure: Figure, data: Dataset, t: Tuned) -> None:
    runs = data.group("tune")
    many = figure.subplots(len(runs), 1, sharex=True, squeeze=False)[:, 0]
    for i, (axes, run, colour) in enumerate(zip(many, runs, itertools.cycle(RUNS))):
        own = (t.samples.run == i) & (t.samples.axle == 0)
        spread = np.maximum(t.recovered - t.degraded, 1e-9)[own]
        axes.plot(t.samples.time_s[own], t.transition[own], ".", ms=2, color=colour)
        axes.plot(t.samples.time_s[own], (t.model - t.degraded)[own] / spread, ".", ms=1, color=INK)
        axes.set(ylabel=f"lambda in {run.name}", ylim=(-0.2, 1.2))
    many[-1].set_xlabel("time, s")


def validate_json(data: Dataset, tau: Interval, verdicts: list[Verdict]) -> dict[str, Any]:
    """Table 6 and what belongs to it, as plain data."""
    runs = {
        v.run: {"initial_speed_m_s": v.initial_speed_m_s}
        | {
            name: {
                "mu_cd": finite(s.mu_cd),
                "E1_m_s": finite(s.speed_error_m_s),
                "sliding_mean_m_s": s.mean_m_s.tolist(),
                "sliding_std_m_s": s.deviation_m_s.tolist(),
                "adhesion_rmse": finite(s.adhesion_rmse),
            }
            for name, s in v.statistics.items()
        }
        for v in verdicts
    }
    return {
        "dataset": data.name,
        "tau_m_J": _plain(tau),
        "runs": runs,
        "errors": {name: mean_errors(verdicts, name) for name in ("new", "classic")},
        "warnings": data.warnings,
    }


def mean_errors(verdicts: list[Verdict], name: str) -> dict[str, float]:
    """Mean absolute errors of a model over runs, wheelset 1 as in the paper and all wheelsets."""
    mean, spread = (
        np.abs(
            [
                getattr(v.statistics[name], field) - getattr(v.statistics["measured"], field)
                for v in verdicts
            ]
        )
        for field in ("mean_m_s", "deviation_m_s")
    )
    return {
        "mean_1_m_s": float(mean[:, 0].mean()),
        "mean_m_s": float(mean.mean()),
        "std_1_m_s": float(spread[:, 0].mean()),
        "std_m_s": float(spread.mean()),
        "E1_m_s": float(np.mean([v.statistics[name].speed_error_m_s for v in verdicts])),
        "adhesion_rmse": float(np.mean([v.statistics[name].adhesion_rmse for v in verdicts])),
    }


def table6(verdicts: list[Verdict]) -> tuple[list[str], list[list[str]]]:
    """Head and rows in the form of the paper's Table 6, for wheelset 1; classic beside new."""

    def row(title: str, pick: Callable[[Verdict], float]) -> list[str]:
        return [title, *(f"{pick(v):.2f}" for v in verdicts)]

    return ["", *(v.run for v in verdicts)], [
        row("initial speed, m/s", lambda v: v.initial_speed_m_s),
        *(
            row(
                f"E1, largest velocity error, {MODELS[name][1]}",
                lambda v, name=name: v.statistics[name].speed_error_m_s,
            )
            for name in ("new", "classic")
        ),
        *(
            row(
                f"{title}, {label}",
                lambda v, name=name, field=field: float(getattr(v.statistics[name], field)[0]),
            )
            for title, field in (
                ("mean sliding of wheelset 1", "mean_m_s"),
                ("standard deviation", "deviation_m_s"),
            )
            for name, (_, label) in MODELS.items()
        ),
    ]


def validate_page(data: Dataset, tau: Interval, verdicts: list[Verdict]) -> str:
    """The report of a validation."""
    head, rows = table6(verdicts)
    off = [
        [MODELS[name][1], *(f"{value:.4f}" for value in mean_errors(verdicts, name).values())]
        for name in ("new", "classic")
    ]
    return page.page(
        f"Validation on {data.name}",
        paragraph(
            f"tau = {_interval(_plain(tau), 1e4)} 1e-4 m/J from the tuning runs. The runs below were not "
            "fitted, except that both models get the contaminant level mu_cd of a run that does not "
            "state it. Wheels run free in windows of 1 s under measured torque and load."
        ),
        *(paragraph(w, kind="warn") for w in data.warnings),
        element("h2", "Table 6, m/s"),
        table(head, rows),
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
            off,
        ),
        *(
            part
            for v in verdicts
            for part in (
                element("h2", v.run),
                page.picture(lambda f, v=v: _stop(f, v), (11.0, 6.0)),
            )
        ),
    )


def _stop(figure: Figure, v: Verdict) -> None:
    speed, sliding = figure.subplots(2, 1, sharex=True)
    for name, (colour, label) in MODELS.items():
        speed.plot(v.time_s, v.speed_m_s[name], color=colour, label=label)
        sliding.plot(v.time_s, v.sliding_m_s[name][:, 0], color=colour)
    speed.set_ylabel("vehicle speed, m/s")
    speed.legend()
    sliding.set(xlabel="time, s", ylabel="sliding of wheelset 1, m/s")


def polach_json(data: Dataset, found: Fitted) -> dict[str, Any]:
    """What a creep-curve fit found, as plain data."""
    points = data.curve.creepage.size if data.curve else 0
    return {
        "dataset": data.name,
        "kind": data.kind,
        "points": points,
        "parameters": {name: _plain(v) for name, v in found.values.items()},
        "rms": found.rms,
        "rms_without_falling_friction": found.rms_no_fall,
        "rms_without_falling_friction_k_s_below_k_a": found.rms_no_fall_ordered,
        "scatter_floor": found.floor,
        "falling_friction_supported": falls(found, points),
        "mean_error_of_recommended_sets": found.means,
        "names": list(NAMES),
        "correlation": np.round(found.correlation, 3).tolist(),
        "warnings": data.warnings,
    }


def polach_rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What `polach_json` has, for people."""
    return [
        *((f"Polach's {name}", _interval(v)) for name, v in found["parameters"].items()),
        *(
            (title, f"{found[key]:.4f}")
            for title, key in (
                ("rms error, five parameters", "rms"),
                (
                    "rms error, friction does not fall (k_A, k_S free within 0 .. 1)",
                    "rms_without_falling_friction",
                ),
                ("the same with k_S <= k_A", "rms_without_falling_friction_k_s_below_k_a"),
                ("scatter of the points about their neighbours", "scatter_floor"),
            )
        ),
        *(
            (f"mean error of Polach's {name} set", f"{off:+.3f}")
            for name, off in found["mean_error_of_recommended_sets"].items()
        ),
    ]


def polach_page(data: Dataset, found: Fitted) -> str:
    """The report of a creep-curve fit."""
    plain = polach_json(data, found)
    return page.page(
        f"Creep curve of {data.name}",
        *(paragraph(w, kind="warn") for w in data.warnings),
        table(HEAD, polach_rows(plain)),
        paragraph(
            f"Falling friction {'is' if plain['falling_friction_supported'] else 'is not'} supported."
        ),
        page.picture(lambda f: _creep_curve(f, data, found), (11.0, 6.0)),
    )


def _creep_curve(figure: Figure, data: Dataset, found: Fitted) -> None:
    """Points, fits and recommended sets against creepage."""
    assert data.curve is not None
    curve, patch = data.curve, patch_of(data)
    axes = figure.subplots()
    axes.plot(
        100 * curve.creepage, curve.adhesion, ".", color=GREY, label="measured", rasterized=True
    )
    grid = np.linspace(0.0, float(curve.creepage.max()), 400)
    fine = curve._replace(
        creepage=grid,
        adhesion=grid,
        series=grid,
        speed_m_s=np.full(grid.size, np.median(curve.speed_m_s)),
        load_N=np.full(grid.size, np.median(curve.load_N)),
    )
    sets = [
        (
            "-",
            RUNS[0],
            f"Polach, five parameters, rms {found.rms:.4f}",
            [found.values[name].value for name in NAMES],
        ),
        (
            "-",
            RUNS[1],
            f"friction that does not fall, rms {found.rms_no_fall:.4f}",
            [found.values_no_fall[name] for name in NAMES],
        ),
        *(
            (style, INK, f"Polach's {name} set, {found.means[name]:+.3f} off", at)
            for style, (name, at) in zip(("--", ":"), RECOMMENDED.items(), strict=True)
        ),
    ]
    for style, colour, label, at in sets:
        axes.plot(100 * grid, model(np.array(at), fine, patch), style, color=colour, label=label)
    axes.set(
        xlabel="creepage, %", ylabel="adhesion coefficient", xlim=(0.0, None), ylim=(0.0, None)
    )
    axes.legend()
