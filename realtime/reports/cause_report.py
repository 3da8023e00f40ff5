"""Tells what was found: report.json, report.html, the short story, and the courses for Rerun.

All words come from the table of mechanisms; every number of the page stands in the JSON too.
"""

import math
from functools import partial
from typing import Any

import numpy as np

from rollerrig.realtime.pictures.panel import Panel
from rollerrig.realtime.reports import cause_pictures as pictures
from rollerrig.realtime.reports import page as html
from rollerrig.rig.identify.data import preparation as prepared
from rollerrig.rig.identify.decide import decision, evidence, extended_model, gain, simulate
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.mechanisms.mechanism import ALONE
from rollerrig.rig.mechanisms.table import BY_NAME, TABLE

# deviations that a cause must lie from nothing to be found in nine of ten sets
_SEEN = 5.0


def as_json(a: Diagnosis) -> dict[str, Any]:
    """What report.json holds."""
    # the noise floor: simulated stops with nothing else in them
    made = simulate.runs(a.data, a.design, a.data.group("tune"), a.final, np.random.default_rng(1))
    named = {one.cause.name for one in a.causes}
    unknown = (
        {"formula": None, "against": _worst(a), "heldout_gain": None}
        if a.unknown is None
        else {
            "formula": a.unknown.text + "; empirical",
            "against": list(a.unknown.against),
            "heldout_gain": a.unknown.gain.reduction,
        }
    )
    return {
        "verdict": a.verdict,
        "dataset": a.data.name,
        "misfit": {
            "metric": "adhesion_rmse",
            "before": _rms(a.design, a.base),
            "noise_floor": _rms(prepared.prepare(a.data, made, a.design), a.final),
            "p_value": a.p_value,
            "worst_against": _worst(a),
        },
        "causes": [_cause(a, one) for one in a.causes],
        "gain": gain.as_json(a.gain),
        "unknown": unknown if a.verdict == "unexplained" else None,
        "remainder": _remainder(a) if a.verdict == "partly" else None,
        "screened": [_screened(a, row.name) for row in TABLE if row.name not in named],
        "set_aside": [
            {
                "name": one.finding.name,
                "likelihood": one.ratio,
                "confusable_with": list(one.confusable),
            }
            for one in a.set_aside
        ],
        "findings": {
            where: [
                {
                    "name": f.name,
                    "axle": f.axle,
                    "coefficients": list(f.estimate),
                    "p_value": f.p_value,
                    "statistic": f.statistic,
                }
                for f in found
            ]
            for where, found in (("before", a.findings), ("behind", a.remainder))
        },
        "notes": a.notes,
        "elapsed_s": round(a.elapsed_s, 1),
    }


def _rms(design: prepared.Design, found: Any) -> float:
    return float(
        np.sqrt(
            np.mean(gain.missing_adhesion(design, found)[design.speed_m_s > gain.SLOWEST_M_S] ** 2)
        )
    )


def _worst(a: Diagnosis) -> list[str]:
    smooth = sorted(
        (f for f in a.findings if evidence.is_smooth_function(f.name)), key=lambda f: f.p_value
    )
    return [evidence.against(f) for f in smooth[:3]]


def _number(value: float, digits: int = 3) -> str:
    """Three significant digits without an exponent where a reader needs none."""
    return f"{float(f'{value:.{digits}g}'):g}"


def _remainder(a: Diagnosis) -> dict[str, Any]:
    left = sorted(
        (f for f in a.remainder if evidence.is_significant(f, 20.0)), key=lambda f: -f.statistic
    )
    return {
        "share": decision.remainder_share(a.causes, a.remainder),
        "against": [evidence.against(f) for f in left],
    }


def _bic(a: Diagnosis, statistic: float, size: int) -> float:
    return statistic - size * math.log(a.design.measured_rad_s.size)


def _cause(a: Diagnosis, named: IdentifiedCause) -> dict[str, Any]:
    return {
        "name": named.cause.name,
        "axles": [named.cause.axle] if named.cause.axle else None,
        "parameters": extended_model.parameters(named),
        "evidence": {
            "likelihood": named.ratio,
            "delta_bic": _bic(a, named.ratio, len(named.cause.values) + len(named.cause.shape)),
            "heldout_gain": None if a.gain is None else a.gain.reduction,
            "detectability": _SEEN * named.deviation[0],
            "rivals": [rival._asdict() for rival in named.rivals],
        },
        "confusable_with": list(named.confusable),
        "separating_test": "",
    }  # the file's name, where one is written: see `planning`


def _screened(a: Diagnosis, name: str) -> dict[str, Any]:
    found = next((f for f in a.findings if f.name == name), None)
    if found is None:
        return {"name": name, "delta_bic": None, "rejected_because": "these runs cannot show it"}
    smallest, row = _SEEN * found.deviation[0], BY_NAME[name].parameters[0]
    if not evidence.is_significant(found):
        why = (
            f"not beyond chance (p = {found.p_value:.2g}); these runs would have shown "
            f"{row.name} = {_number(smallest, 2)}{_unit(row.source)} or more"
        )
    elif a.causes:
        why = f"explained by {a.causes[0].cause.name}, which fits better"
    else:
        why = "what is left does not follow its form"
    return {
        "name": name,
        "delta_bic": _bic(a, found.statistic, len(found.estimate)),
        "p_value": found.p_value,
        "detectability": smallest,
        "rejected_because": why,
    }


def _unit(name: str) -> str:
    """A unit behind its number; nothing for a plain number."""
    return "" if name in ("", "-") else f" {name}"


def story(a: Diagnosis) -> list[str]:
    """What is wrong, by how much, where, why, and what it is worth: a few sentences."""
    lines = []
    if a.verdict == "consistent":
        lines.append(
            "Nothing is wrong beyond chance: the base model is consistent with this data "
            f"(p = {a.p_value:.2g})."
        )
    for named in a.causes:
        row = BY_NAME[named.cause.name]
        values = ", ".join(
            f"{k} = {_number(v['value'])} ({' to '.join(map(_number, v['ci95']))})"
            f"{_unit(v['unit'])}"
            for k, v in extended_model.parameters(named).items()
            if k != ALONE.name
        )
        of = f" on wheelset {named.cause.axle}" if named.cause.axle else ""
        of += ", that of the contaminant alone" if named.cause.shape.get(ALONE.name) else ""
        lines.append(f"Cause: {row.text}{of} [{row.name}]; {values}.")
        if named.confusable:
            wins = {rival.name: f" (wins {rival.share:.0%} as much)" for rival in named.rivals}
            alike = ", ".join(f"{name}{wins.get(name, '')}" for name in named.confusable)
            lines.append(f"  It cannot be told from {alike} here; separating_test.toml would tell.")
    if a.verdict == "partly":
        left = _remainder(a)
        lines.append(
            f"That is not all: along {', '.join(left['against'])} something remains, {left['share']:.0%} of "
            "what was found, and no further cause of the library accounts for it."
        )
    if a.verdict == "unexplained":
        lines += [
            "Something is wrong that no mechanism of the library explains; it shows against "
            f"{', '.join(_worst(a))}.",
            f"Empirical: {a.unknown.text}."
            if a.unknown
            else "No formula was found that holds on runs never fitted.",
        ]
    if a.gain is not None:
        g = a.gain
        lines.append(
            f"On runs never fitted ({', '.join(g.runs)}) {g.metric} falls from {g.before:.3g} to "
            f"{g.after:.3g}: {100 * g.reduction:.1f} % ({100 * g.ci95[0]:.1f} to {100 * g.ci95[1]:.1f} %)"
            + ("." if g.claimed else "; no gain is claimed.")
        )
    return lines + [f"Note: {note}." for note in a.notes]


def panels(a: Diagnosis, report: dict[str, Any]) -> tuple[list[Panel], list[Panel]]:
    """Where it shows, and each cause."""
    return pictures.where(a, report["misfit"]["worst_against"]), [
        pictures.cause(a, named) for named in a.causes
    ]


def page(a: Diagnosis, report: dict[str, Any]) -> str:
    """The HTML page, without outside parts: verdict, where it shows, the cause, the gain, what was ruled out."""
    where, of_causes = panels(a, report)
    causes = [html.picture(partial(pictures.draw, panels=[one]), (7.5, 3.8)) for one in of_causes]
    changed = a.final is not a.base
    proposed = [
        f"{one['title']}; {one['reason']}: rollerrig sequence {one['file']}"
        for one in report.get("next", [])
    ]
    return html.page(
        f"What the model gets wrong: {a.data.name}",
        html.paragraph(f"Verdict: {a.verdict}", kind="note"),
        *(html.paragraph(line) for line in story(a)),
        html.element("h2", "Where it shows"),
        html.picture(partial(pictures.draw, panels=where)),
        *(
            (html.element("h2", "The cause" if len(causes) == 1 else "The causes"), *causes)
            if causes
            else ()
        ),
        *(
            (
                html.element("h2", "Where base and extended model differ most"),
                html.picture(partial(pictures.stretch, a=a), (11.0, 5.0)),
            )
            if changed
            else ()
        ),
        *((html.element("h2", "On runs never fitted"), _gains(a.gain)) if a.gain else ()),
        *(
            (html.element("h2", "What to run next"), *map(html.paragraph, proposed))
            if proposed
            else ()
        ),
        html.element("h2", "What was ruled out"),
        html.table(
            ["cause", "name", "why not"],
            [
                [BY_NAME[s["name"]].text, s["name"], s["rejected_because"]]
                for s in report["screened"]
                if s["name"] != "empirical"
            ],
        ),
    )


def _gains(g: gain.Gain) -> html.Markup:
    return html.picture(
        lambda figure: pictures.gains(figure.subplots(), g.by_run, g.metric), (7.5, 2.6)
    )


def in_words(a: Diagnosis, report: dict[str, Any]) -> str:
    """Verdict, story and what was ruled out, as Markdown."""
    out = [
        f"- {BY_NAME[s['name']].text}: {s['rejected_because']}"
        for s in report["screened"]
        if s["name"] in BY_NAME
    ]
    return "\n\n".join((f"# {a.verdict}", *story(a), "## What was ruled out", "\n".join(out)))


def courses(a: Diagnosis) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Rerun path -> (time s, values (n, 3): measured, base, extended adhesion)."""
    measured, base, _ = gain.adhesion(a.design, a.base)
    _, better, _ = gain.adhesion(a.design, a.final)
    found = {}
    for s in range(a.design.segments):
        at = a.design.span(s)
        path = f"/{a.design.names[int(a.design.run[s])]}/adhesion_{int(a.design.axle[s]) + 1}"
        found[path] = (a.design.time_s[at], np.column_stack([measured[at], base[at], better[at]]))
    return found
