"""Tells what was found: report.json, report.html, the short story, and the courses for Rerun.

All words come from the table of mechanisms; every number of the page stands in the JSON too.
"""

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rollerrig.realtime.reports import page as html
from rollerrig.realtime.reports.page import BASE, EXTENDED, GREY, MEASURED
from rollerrig.rig.identify.data import preparation as prepared
from rollerrig.rig.identify.decide import evidence, extension, gain, simulate
from rollerrig.rig.identify.decide.choice import NamedCause
from rollerrig.rig.identify.decide.explain import Account
from rollerrig.rig.mechanisms.table import BY_NAME, TABLE

# deviations that a cause must lie from nothing to be found in nine of ten sets
_SEEN = 5.0


def as_json(a: Account) -> dict[str, Any]:
    """What report.json holds."""
    before, floor = _levels(a)
    return {
        "verdict": a.verdict,
        "dataset": a.data.name,
        "misfit": {"metric": "adhesion_rmse", "before": before, "noise_floor": floor,
                   "p_value": a.p_value, "worst_against": _worst(a)},
        "causes": [_cause(a, named) for named in a.causes],
        "gain": gain.as_json(a.gain),
        "unknown": _unknown(a),
        "screened": [_screened(a, row.name) for row in TABLE
                     if row.name not in {n.cause.name for n in a.causes}],
        "notes": a.notes,
        "elapsed_s": round(a.elapsed_s, 1),
    }


def _levels(a: Account) -> tuple[float, float]:
    """Rms error of the base on the fitted runs, and on simulated stops with nothing else in them."""
    def rms(design: prepared.Design, found: Any) -> float:
        lacking = gain.missing(design, found)[design.speed_m_s > gain.SLOWEST_M_S]
        return float(np.sqrt(np.mean(lacking**2)))

    measured = a.data.group("tune")
    made = simulate.runs(a.data, a.design, measured, a.final, np.random.default_rng(1))
    return rms(a.design, a.base), rms(prepared.prepare(a.data, made, a.design), a.final)


def _worst(a: Account) -> list[str]:
    smooth = [f for f in a.findings if evidence.generic(f.name)]
    smooth.sort(key=lambda f: f.p_value)
    return [evidence.against(f) for f in smooth[:3]]


def _bic(a: Account, statistic: float, size: int) -> float:
    return statistic - size * math.log(a.design.measured_rad_s.size)


def _cause(a: Account, named: NamedCause) -> dict[str, Any]:
    name = named.cause.name
    size = len(named.cause.values) + len(named.cause.shape)
    return {
        "name": name, "axles": [named.cause.axle] if named.cause.axle else None,
        "parameters": extension.parameters(named),
        "evidence": {"delta_bic": _bic(a, named.ratio, size),
                     "heldout_gain": None if a.gain is None else a.gain.reduction,
                     "detectability": _SEEN * named.deviation[0]},
        "confusable_with": list(named.confusable),
        "separating_test": "",  # the file's name, where one is written: see `planning`
    }


def _screened(a: Account, name: str) -> dict[str, Any]:
    found = next((f for f in a.findings if f.name == name), None)
    if found is None:
        return {"name": name, "delta_bic": 0.0, "rejected_because": "these runs cannot show it"}
    smallest = _SEEN * found.deviation[0]
    if not evidence.significant(found):
        why = (f"not beyond chance (p = {found.p_value:.2g}); this data would have shown "
               f"{smallest:.2g} or more")
    elif a.causes:
        why = f"explained by {a.causes[0].cause.name}, which fits better"
    else:
        why = "what is left does not follow its form"
    return {"name": name, "delta_bic": _bic(a, found.statistic, len(found.estimate)),
            "p_value": found.p_value, "detectability": smallest, "rejected_because": why}


def _unknown(a: Account) -> dict[str, Any] | None:
    if a.verdict != "unexplained":
        return None
    if a.unknown is not None:
        return {"formula": a.unknown.text + "; empirical", "against": list(a.unknown.against),
                "heldout_gain": a.unknown.gain.reduction}
    return {"formula": None, "against": _worst(a), "heldout_gain": None}


def story(a: Account) -> list[str]:
    """What is wrong, by how much, where, why, and what it is worth: a few sentences."""
    lines = []
    if a.verdict == "consistent":
        lines.append("Nothing is wrong beyond chance: the base model is consistent with this data "
                     "(one clean set in fifty would say otherwise).")
    for named in a.causes:
        row = BY_NAME[named.cause.name]
        values = ", ".join(f"{k} = {v['value']:.3g} ({v['ci95'][0]:.3g} to {v['ci95'][1]:.3g}) "
                           f"{v['unit']}" for k, v in extension.parameters(named).items())
        axle = f" on wheelset {named.cause.axle}" if named.cause.axle else ""
        lines.append(f"Cause: {row.text}{axle} [{row.name}]; {values}.")
        if named.confusable:
            lines.append(f"  It cannot be told from {', '.join(named.confusable)} here; "
                         "separating_test.toml would tell.")
    if a.verdict == "unexplained":
        lines.append("Something is wrong that no mechanism of the library explains; it shows "
                     f"against {', '.join(_worst(a))}.")
        lines.append(f"Empirical: {a.unknown.text}." if a.unknown else
                     "No formula was found that holds on runs never fitted.")
    if a.gain is not None:
        g = a.gain
        lines.append(
            f"On runs never fitted ({', '.join(g.runs)}) {g.metric} falls from {g.before:.3g} to "
            f"{g.after:.3g}: {100 * g.reduction:.1f} % ({100 * g.ci95[0]:.1f} to "
            f"{100 * g.ci95[1]:.1f} %)" + ("." if g.claimed else "; no gain is claimed."))
    return lines + [f"Note: {note}." for note in a.notes]


def page(a: Account, report: dict[str, Any]) -> str:
    """The HTML page, without outside parts."""
    return html.page(
        f"What the model gets wrong: {a.data.name}",
        html.paragraph(f"Verdict: {a.verdict}"), *(html.paragraph(line) for line in story(a)),
        html.picture(lambda figure: _against(figure, a)),
        html.picture(lambda figure: _course(figure, a), (11.0, 7.0)),
        html.table(["rejected", "delta BIC", "because"],
                   [[s["name"], f"{s['delta_bic']:.1f}", s["rejected_because"]] for s in report["screened"]]))


def _against(figure: Figure, a: Account) -> None:
    measured, base, sliding = gain.adhesion(a.design, a.base)
    _, better, _ = gain.adhesion(a.design, a.final)
    axes = figure.subplots(1, 3)
    for axis, values, name in zip(axes, (sliding, a.design.speed_m_s, a.design.time_s),
                                  ("sliding, m/s", "speed, m/s", "time, s"), strict=True):
        edges = np.quantile(values, np.linspace(0.0, 1.0, 13))
        at = np.clip(np.digitize(values, edges) - 1, 0, 11)
        for model, colour, label in ((base, BASE, "base"), (better, EXTENDED, "extended")):
            middle, error = ([part[at == k].mean() for k in np.unique(at)]
                             for part in (values, measured - model))
            axis.plot(middle, error, "o-", color=colour, label=label)
        axis.axhline(0.0, color=GREY)
        axis.set_xlabel(name)
    axes[0].set_ylabel("measured - model adhesion")
    axes[0].legend()


def _course(figure: Figure, a: Account) -> None:
    measured, base, _ = gain.adhesion(a.design, a.base)
    _, better, _ = gain.adhesion(a.design, a.final)
    axes = figure.subplots(4, 1, sharex=True)
    for j, axis in enumerate(axes):
        at = a.design.span(j)
        for values, colour, label in ((measured, MEASURED, "measured"), (base, BASE, "base"),
                                      (better, EXTENDED, "extended")):
            axis.plot(a.design.time_s[at], values[at], color=colour, lw=0.8, label=label)
        axis.set_ylabel(f"axle {j + 1}")
    axes[0].legend(ncol=3)
    axes[0].set_title("adhesion coefficient f of each wheelset", fontsize="medium")
    axes[-1].set_xlabel(f"time in run {a.design.names[0]}, s")


def courses(a: Account) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rerun path -> (time s, values (n, 3): measured, base, extended adhesion)."""
    measured, base, _ = gain.adhesion(a.design, a.base)
    _, better, _ = gain.adhesion(a.design, a.final)
    found = {}
    for s in range(a.design.segments):
        at = a.design.span(s)
        path = f"/{a.design.names[int(a.design.run[s])]}/adhesion_{int(a.design.axle[s]) + 1}"
        found[path] = (a.design.time_s[at], np.column_stack([measured[at], base[at], better[at]]))
    return found
