"""Reports of tune and validate: pictures and tables in one HTML file without outside parts, and JSON.

Every number of a picture stands in the JSON too. Colours are Okabe and Ito's, safe for the
colour-blind; one colour means one run (or one model) throughout.
"""

import html
import io
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib.figure import Figure

from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper.polach_fit import NAMES, RECOMMENDED, Fitted, falls, model, patch_of
from rollerrig.rig.identify.paper.tuning import Interval, Tuned
from rollerrig.rig.identify.paper.validation import Verdict

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
MODELS = {"measured": ("#222222", "measured"), "new": ("#0072b2", "with recovery"),
          "classic": ("#d55e00", "classic, no recovery")}
_STYLE = ("body{font:15px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;"
          "color:#222}table{border-collapse:collapse;margin:1rem 0}td,th{padding:.2rem .7rem;"
          "border-bottom:1px solid #ddd;text-align:right}td:first-child,th:first-child{text-align:left}"
          "svg{width:100%;height:auto}.warn{color:#a33}.small{color:#666;font-size:13px}")


def page(title: str, parts: Sequence[str]) -> str:
    """A whole HTML page."""
    return (f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title>"
            f"<style>{_STYLE}</style><h1>{html.escape(title)}</h1>{''.join(parts)}</html>\n")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An HTML table of text."""
    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells) + "</tr>"

    return f"<table>{line(head, 'th')}{''.join(line(row, 'td') for row in rows)}</table>"


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of text."""
    return f"<p{f' class={kind}' if kind else ''}>{html.escape(text)}</p>"


def picture(draw: Callable[[Figure], None], size: tuple[float, float] = (9.0, 4.0)) -> str:
    """What a function draws, as SVG."""
    figure = Figure(figsize=size, layout="constrained")
    draw(figure)
    out = io.StringIO()
    # no date and a fixed salt: the same data give the same file
    with matplotlib.rc_context({"svg.hashsalt": "rollerrig"}):
        figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()[out.getvalue().index("<svg"):]


def _interval(v: Interval, scale: float = 1.0) -> str:
    return f"{v.value * scale:.4g} ({v.low * scale:.4g} to {v.high * scale:.4g})"


# --- tune ---

def tune_json(data: Dataset, t: Tuned) -> dict[str, Any]:
    """What tune found, as plain data."""
    return {
        "dataset": data.name, "kind": data.kind, "samples": len(t.model),
        "tau_m_J": _plain(t.tau_m_J), "tau_paper_form_m_J": t.tau_paper_m_J,
        "mu_cd": {run: _plain(v) for run, v in t.mu_cd.items()},
        "adhesion_rmse": {"tuned": t.rmse, "base": t.rmse_base, "classic": t.rmse_classic},
        "base_tau_m_J": data.sections["adhesion"]["tau_m_J"], "warnings": t.warnings,
    }


def _plain(v: Interval) -> dict[str, Any]:
    return {"value": v.value, "ci95": [v.low, v.high]}


def tune_page(data: Dataset, t: Tuned) -> str:
    """The report of a tuning."""
    rows = [["tau, 1e-4 m/J", _interval(t.tau_m_J, 1e4)],
            ["the same by the paper's least squares (eq. 21), biased by an irregular rail",
             f"{t.tau_paper_m_J * 1e4:.4g}"],
            ["base of the dataset", f"{data.sections['adhesion']['tau_m_J'] * 1e4:.4g}"],
            *([f"mu_cd of {run}", _interval(v)] for run, v in t.mu_cd.items())]
    errors = [["tuned", f"{t.rmse:.5f}"], ["dataset's tau, mu_cd fitted", f"{t.rmse_base:.5f}"],
              ["no recovery, mu_cd fitted", f"{t.rmse_classic:.5f}"]]
    return page(f"Tuning on {data.name}", [
        paragraph(f"{len(t.model)} samples of {len(data.group('tune'))} runs in which wheels slide. "
                  "Intervals hold the value in 95 of 100 cases (bootstrap over 3 s blocks of each run)."),
        *[paragraph(w, "warn") for w in t.warnings], table(["", "value (95 %)"], rows),
        table(["model", "rms error of f"], errors),
        "<h2>Transition against dissipated energy</h2>", picture(lambda f: _transition(f, data, t)),
        "<h2>Adhesion against sliding</h2>", picture(lambda f: _adhesion(f, data, t)),
        "<h2>Transition in time, wheelset 1</h2>", picture(lambda f: _course(f, data, t), (9.0, 5.0)),
        paragraph("lambda: 0 as contaminated, 1 fully recovered. Points: measured, by the wheel "
                  "balance. Line: 1 - exp(-tau W).", "small"),
    ])


def _transition(figure: Figure, data: Dataset, t: Tuned) -> None:
    axes = figure.subplots()
    W = t.energy_J_m
    top = float(np.percentile(W, 99.5))
    edges = np.linspace(0.0, top, 25)
    for i, run in enumerate(data.group("tune")):
        own = t.samples.run == i
        axes.plot(W[own][::3], t.transition[own][::3], ".", ms=2, alpha=0.25, color=COLOURS[i % 6],
                  rasterized=True)
        middle, low, high, at = [], [], [], []
        for a, b in itertools.pairwise(edges):
            inside = t.transition[own & (a <= W) & (b > W)]
            if inside.size > 15:
                q = np.percentile(inside, (25, 50, 75))
                low.append(q[1] - q[0])
                middle.append(q[1])
                high.append(q[2] - q[1])
                at.append(0.5 * (a + b))
        axes.errorbar(at, middle, (low, high), fmt="o", ms=4, color=COLOURS[i % 6], label=run.name)
    grid = np.linspace(0.0, top, 200)
    axes.plot(grid, -np.expm1(-t.tau_m_J.value * grid), "k", label="tuned")
    axes.plot(grid, -np.expm1(-data.sections["adhesion"]["tau_m_J"] * grid), "k--", lw=1, label="base")
    axes.fill_between(grid, -np.expm1(-t.tau_m_J.low * grid), -np.expm1(-t.tau_m_J.high * grid),
                      color="k", alpha=0.15, lw=0)
    axes.set(xlabel="dissipated energy W_sp of one wheel, J/m", ylabel="transition lambda",
             xlim=(0.0, top),
             ylim=(-0.05, min(1.1, 1.4 * -np.expm1(-t.tau_m_J.value * top) + 0.05)))
    axes.legend(fontsize=8)


def _adhesion(figure: Figure, data: Dataset, t: Tuned) -> None:
    axes = figure.subplots()
    s = t.samples
    axes.plot(s.sliding_m_s, s.adhesion, ".", ms=2, alpha=0.3, color=COLOURS[0], label="measured",
              rasterized=True)
    axes.plot(s.sliding_m_s, t.model, ".", ms=1, alpha=0.3, color=COLOURS[1], label="model",
              rasterized=True)
    axes.plot(s.sliding_m_s, t.degraded, ".", ms=1, alpha=0.2, color="#888888", label="f_d degraded",
              rasterized=True)
    axes.set(xlabel="sliding, m/s", ylabel="adhesion coefficient", xlim=(0.0, None), ylim=(0.0, None))
    axes.legend(fontsize=8, markerscale=4)


def _course(figure: Figure, data: Dataset, t: Tuned) -> None:
    runs = data.group("tune")
    many = figure.subplots(len(runs), 1, sharex=True, squeeze=False)[:, 0]
    for i, (axes, run) in enumerate(zip(many, runs, strict=True)):
        own = (t.samples.run == i) & (t.samples.axle == 0)
        time = t.samples.time_s[own]
        axes.plot(time, t.transition[own], ".", ms=2, color=COLOURS[i % 6])
        spread = np.maximum(t.recovered - t.degraded, 1e-9)[own]
        axes.plot(time, (t.model - t.degraded)[own] / spread, ".", ms=1, color="k")
        axes.set(ylabel=run.name, ylim=(-0.2, 1.2))
    many[-1].set_xlabel("time, s")


# --- validate ---

def validate_json(data: Dataset, tau: Interval, verdicts: list[Verdict]) -> dict[str, Any]:
    """Table 6 and what belongs to it, as plain data."""
    runs = {}
    for v in verdicts:
        runs[v.run] = {"initial_speed_m_s": v.initial_speed_m_s} | {name: {
            "mu_cd": _finite(s.mu_cd), "E1_m_s": _finite(s.speed_error_m_s),
            "sliding_mean_m_s": s.mean_m_s.tolist(), "sliding_std_m_s": s.deviation_m_s.tolist(),
            "adhesion_rmse": _finite(s.adhesion_rmse)} for name, s in v.statistics.items()}
    return {"dataset": data.name, "tau_m_J": _plain(tau), "runs": runs,
            "errors": {name: mean_errors(verdicts, name) for name in ("new", "classic")},
            "warnings": data.warnings}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def mean_errors(verdicts: list[Verdict], name: str) -> dict[str, float]:
    """Mean absolute errors of a model over runs, wheelset 1 as in the paper and all wheelsets."""
    mean = np.array([v.statistics[name].mean_m_s - v.statistics["measured"].mean_m_s for v in verdicts])
    spread = np.array([v.statistics[name].deviation_m_s - v.statistics["measured"].deviation_m_s
                       for v in verdicts])
    return {"mean_1_m_s": float(np.abs(mean[:, 0]).mean()), "mean_m_s": float(np.abs(mean).mean()),
            "std_1_m_s": float(np.abs(spread[:, 0]).mean()), "std_m_s": float(np.abs(spread).mean()),
            "E1_m_s": float(np.mean([v.statistics[name].speed_error_m_s for v in verdicts])),
            "adhesion_rmse": float(np.mean([v.statistics[name].adhesion_rmse for v in verdicts]))}


def table6(verdicts: list[Verdict]) -> tuple[list[str], list[list[str]]]:
    """Head and rows in the form of the paper's Table 6, for wheelset 1; classic beside new."""
    head = ["", *(v.run for v in verdicts)]

    def row(title: str, pick: Callable[[Verdict], float]) -> list[str]:
        return [title, *(f"{pick(v):.2f}" for v in verdicts)]

    rows = [row("initial speed, m/s", lambda v: v.initial_speed_m_s)]
    for name in ("new", "classic"):
        rows.append(row(f"E1, largest velocity error, {MODELS[name][1]}",
                        lambda v, name=name: v.statistics[name].speed_error_m_s))
    for title, field in (("mean sliding of wheelset 1", "mean_m_s"),
                         ("standard deviation", "deviation_m_s")):
        for name in MODELS:
            rows.append(row(f"{title}, {MODELS[name][1]}", lambda v, name=name, field=field: float(
                getattr(v.statistics[name], field)[0])))
    return head, rows


def validate_page(data: Dataset, tau: Interval, verdicts: list[Verdict]) -> str:
    """The report of a validation."""
    head, rows = table6(verdicts)
    off = [[MODELS[name][1], *(f"{value:.4f}" for value in mean_errors(verdicts, name).values())]
           for name in ("new", "classic")]
    parts = [
        paragraph(f"tau = {_interval(tau, 1e4)} 1e-4 m/J from the tuning runs. The runs below were not "
                  "fitted, except that both models get the contaminant level mu_cd of a run that does not "
                  "state it. Wheels run free in windows of 1 s under measured torque and load."),
        *[paragraph(w, "warn") for w in data.warnings],
        "<h2>Table 6</h2>", table(head, rows),
        "<h2>Mean absolute errors</h2>",
        table(["model", "mean, wheelset 1", "mean, all", "std, wheelset 1", "std, all", "E1",
               "rms of f"], off),
    ]
    for v in verdicts:
        parts += [f"<h2>{html.escape(v.run)}</h2>", picture(lambda f, v=v: _stop(f, v), (9.0, 5.5))]
    return page(f"Validation on {data.name}", parts)


def _stop(figure: Figure, v: Verdict) -> None:
    speed, sliding = figure.subplots(2, 1, sharex=True)
    for name, (colour, label) in MODELS.items():
        speed.plot(v.time_s, v.speed_m_s[name], color=colour, lw=1.2, label=label)
        sliding.plot(v.time_s, v.sliding_m_s[name][:, 0], color=colour, lw=0.8)
    speed.set_ylabel("vehicle speed, m/s")
    speed.legend(fontsize=8)
    sliding.set(xlabel="time, s", ylabel="sliding of wheelset 1, m/s")


# --- creep curves ---

def polach_json(data: Dataset, found: Fitted) -> dict[str, Any]:
    """What a creep-curve fit found, as plain data."""
    points = data.curve.creepage.size if data.curve else 0
    return {"dataset": data.name, "kind": data.kind, "points": points,
            "parameters": {name: _plain(v) for name, v in found.values.items()},
            "rms": found.rms, "rms_without_falling_friction": found.rms_no_fall,
            "rms_without_falling_friction_k_s_below_k_a": found.rms_no_fall_ordered,
            "scatter_floor": found.floor, "falling_friction_supported": falls(found, points),
            "mean_error_of_recommended_sets": found.means, "names": list(NAMES),
            "correlation": np.round(found.correlation, 3).tolist()}


def polach_page(data: Dataset, found: Fitted) -> str:
    """The report of a creep-curve fit."""
    rows = [[name, _interval(v)] for name, v in found.values.items()]
    supported = "is" if polach_json(data, found)["falling_friction_supported"] else "is not"
    return page(f"Creep curve of {data.name}", [
        table(["Polach's parameter", "value (95 %)"], rows),
        table(["fit", "rms error"], [
            ["five parameters", f"{found.rms:.4f}"],
            ["friction that does not fall (k_A, k_S free within 0 .. 1)", f"{found.rms_no_fall:.4f}"],
            ["the same with k_S <= k_A", f"{found.rms_no_fall_ordered:.4f}"],
            ["scatter of the points about their neighbours", f"{found.floor:.4f}"]]),
        paragraph(f"Falling friction {supported} supported. Mean errors of the recommended sets: "
                  + ", ".join(f"{k} {v:+.3f}" for k, v in found.means.items()) + "."),
        picture(lambda f: creep_figure(f, data, found))])


def creep_figure(figure: Figure, data: Dataset, found: Fitted) -> None:
    """Points, fits and recommended sets against creepage."""
    assert data.curve is not None
    curve, patch = data.curve, patch_of(data)
    axes = figure.subplots()
    axes.plot(100 * curve.creepage, curve.adhesion, ".", color="#666666", label="measured",
              rasterized=True)
    grid = np.linspace(0.0, float(curve.creepage.max()), 400)
    fine = curve._replace(creepage=grid, adhesion=grid, series=grid,
                          speed_m_s=np.full(grid.size, np.median(curve.speed_m_s)),
                          load_N=np.full(grid.size, np.median(curve.load_N)))
    fitted = np.array([found.values[name].value for name in NAMES])
    flat = np.array([found.values_no_fall[name] for name in NAMES])
    axes.plot(100 * grid, model(fitted, fine, patch), color=COLOURS[0],
              label=f"Polach, five parameters, rms {found.rms:.4f}")
    axes.plot(100 * grid, model(flat, fine, patch), color=COLOURS[1],
              label=f"friction that does not fall, rms {found.rms_no_fall:.4f}")
    for (name, at), style in zip(RECOMMENDED.items(), ("--", ":"), strict=True):
        axes.plot(100 * grid, model(np.array(at), fine, patch), style, color="#999999", lw=1,
                  label=f"Polach's {name} set, {found.means[name]:+.3f} off")
    axes.set(xlabel="creepage, %", ylabel="adhesion coefficient", xlim=(0.0, None), ylim=(0.0, None))
    axes.legend(fontsize=8)


