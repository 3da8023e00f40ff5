"""Writes the report on braking runs: report.json, report.html, and what Rerun shows.

Every number of the page is in the JSON too.
"""

import math
from functools import partial
from typing import Any

import numpy as np

from rollerrig.configs.vehicle import wheelsets_of
from rollerrig.realtime.pictures.panel import Panel
from rollerrig.realtime.reports import cause_pictures as pictures
from rollerrig.realtime.reports import cause_sentences as sentences
from rollerrig.realtime.reports import page as html
from rollerrig.realtime.reports.hints import runs
from rollerrig.rig.identify.causes import simulate
from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.decide import estimates, evidence, gain, stopping
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.coherence import Contradicted
from rollerrig.rig.identify.decide.decision import Diagnosis, Verdict
from rollerrig.rig.identify.decide.estimates import Estimate
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.gain import Gain
from rollerrig.rig.identify.decide.notes import Note
from rollerrig.rig.mechanisms.table import BY_NAME, TABLE

NOISE_FLOOR_SEED = 1
EMPIRICAL = "empirical"

# sizes of pictures in inches
_CAUSE_SIZE = (11.0, 4.2)
_STRETCH_SIZE = (11.0, 5.0)
_GAIN_SIZE = (11.0, 2.8)
_RUNS_SIZE = (11.0, 3.4)


# --- report.json ---


def as_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the contents of report.json."""
    reported_names = {identified.cause.name for identified in diagnosis.causes}
    not_reported = [row.name for row in TABLE if row.name not in reported_names]

    unknown = None
    if diagnosis.verdict == Verdict.UNEXPLAINED:
        unknown = _unknown(diagnosis)
    remainder = None
    if diagnosis.verdict == Verdict.PARTLY:
        remainder = sentences.remainder(diagnosis)._asdict()

    return {
        "verdict": diagnosis.verdict,
        "dataset": diagnosis.data.name,
        "misfit": _misfit(diagnosis),
        "causes": [_cause(diagnosis, identified) for identified in diagnosis.causes],
        "gain": gain_as_json(diagnosis.gain),
        "stopping_distance": _stopping_distance(diagnosis),
        "unknown": unknown,
        "remainder": remainder,
        "screened": [_screened(diagnosis, name) for name in not_reported],
        "set_aside": [_set_aside(identified) for identified in diagnosis.set_aside],
        "contradicted": [
            _contradicted(note.contradicted) for note in diagnosis.notes if note.contradicted
        ],
        "findings": {
            "before": [_score_test(test) for test in diagnosis.score_tests],
            "behind": [_score_test(test) for test in diagnosis.remainder],
        },
        "runs": runs.as_json(diagnosis.side_by_side),
        "immaterial": [_immaterial(note) for note in sentences.immaterial_notes(diagnosis)],
        "notes": sentences.notes(diagnosis),
        "elapsed_s": round(diagnosis.elapsed_s, 1),
    }


def _misfit(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the entry on how far the base model misses the data."""
    return {
        "metric": gain.ADHESION,
        "before": _missing_adhesion_rms(diagnosis.design, diagnosis.base),
        "noise_floor": _noise_floor(diagnosis),
        "p_value": diagnosis.p_value,
        "worst_against": sentences.worst_covariates(diagnosis),
    }


def _stopping_distance(diagnosis: Diagnosis) -> dict[str, float] | None:
    """Return the entry on what the causes cost in metres, None where they cost none."""
    if not diagnosis.causes:
        return None
    distance = stopping.costs(diagnosis.design, diagnosis.base, diagnosis.final)
    if distance is None:
        return None
    return distance._asdict() | {"longer_m": distance.longer_m}


def _immaterial(note: Note) -> dict[str, Any]:
    """Return the entry of what is significant and inside the declared calibration."""
    along = None
    if note.remainder is not None:
        along = sentences.covariate_of(note.remainder)
    return {
        "code": note.code.value,
        "causes": list(note.causes),
        "along": along,
        "share": note.share,
        "calibration_fraction": note.tolerance,
        "allowed_share": note.allowed,
    }


def _set_aside(identified: IdentifiedCause) -> dict[str, Any]:
    """Return the entry of a cause that was identified but is not reported."""
    return {
        "name": identified.score_test.name,
        "likelihood": identified.likelihood_ratio,
        "confusable_with": list(identified.confusable),
    }


def _contradicted(contradicted: Contradicted) -> dict[str, Any]:
    """Return the entry of a cause that won its fit and does not show what its mechanism demands."""
    return {
        "name": contradicted.cause.name,
        "likelihood": contradicted.likelihood_ratio,
        "what": contradicted.what.name.lower(),
    }


def _missing_adhesion_rms(design: Design, explanation: Explanation) -> float:
    """Return the root mean square of the adhesion that a model lacks."""
    missing = gain.missing_adhesion(design, explanation)
    counts = design.speed_m_s > gain.SLOWEST_M_S
    return float(np.sqrt(np.mean(missing[counts] ** 2)))


def _noise_floor(diagnosis: Diagnosis) -> float:
    """Return the missing adhesion in simulated stops that obey the final model exactly."""
    simulated = simulate.runs(
        diagnosis.data,
        diagnosis.design,
        diagnosis.data.group("tune"),
        diagnosis.final,
        np.random.default_rng(NOISE_FLOOR_SEED),
    )
    design = prepare(diagnosis.data, simulated, diagnosis.design)
    return _missing_adhesion_rms(design, diagnosis.final)


def _unknown(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the entry on what no cause explains."""
    formula = diagnosis.formula
    if sentences.only_runs_differ(diagnosis):
        return {"formula": None, "against": ["run"], "heldout_gain": None}
    if formula is None:
        return {
            "formula": None,
            "against": sentences.worst_covariates(diagnosis),
            "heldout_gain": None,
        }
    return {
        "formula": sentences.formula_text(formula) + "; empirical",
        "against": [formula.covariate.word],
        "heldout_gain": formula.gain.reduction,
    }


def _score_test(test: ScoreTest) -> dict[str, Any]:
    return {
        "name": test.name,
        "axle": test.axle,
        "coefficients": list(test.estimate),
        "p_value": test.p_value,
        "statistic": test.statistic,
    }


def _delta_bic(diagnosis: Diagnosis, likelihood_ratio: float, size: int) -> float:
    """Return the change of the Bayesian information criterion by a cause with `size` parameters."""
    return likelihood_ratio - size * math.log(diagnosis.design.measured_rad_s.size)


def _cause(diagnosis: Diagnosis, identified: IdentifiedCause) -> dict[str, Any]:
    """Return the entry of a reported cause.

    The name of its separating test is empty until `explain` has written that test.
    """
    cause = identified.cause
    parameter_count = len(cause.values) + len(cause.shape)
    parameters = estimates.parameters(identified)
    heldout_gain = None
    if diagnosis.gain is not None:
        heldout_gain = diagnosis.gain.reduction
    axles = None
    if cause.axle:
        axles = list(wheelsets_of(cause.axle, diagnosis.data.axles))
    rivals = [
        {"name": rival.name, "share": rival.share, "parted": rival.is_distinguishable}
        for rival in identified.rivals
    ]
    return {
        "name": cause.name,
        "axles": axles,
        "parameters": {name: _estimate(found) for name, found in parameters.items()},
        "evidence": {
            "likelihood": identified.likelihood_ratio,
            "delta_bic": _delta_bic(diagnosis, identified.likelihood_ratio, parameter_count),
            "heldout_gain": heldout_gain,
            "detectability": sentences.detectability(diagnosis, cause.name),
            "decided": _decided(identified),
            "rivals": rivals,
        },
        "confusable_with": list(identified.confusable),
        "separating_test": "",
    }


def _decided(identified: IdentifiedCause) -> dict[str, Any]:
    """Return the interval that decided that a cause is reported: it excludes 0."""
    size = estimates.family_wise(identified)
    level = 1.0 - evidence.alpha_of(identified.score_test)
    return {"level": level, "interval": [size.low, size.high]}


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return {
        "value": estimate.value,
        "ci95": [estimate.low, estimate.high],
        "unit": estimate.unit,
    }


def _screened(diagnosis: Diagnosis, name: str) -> dict[str, Any]:
    """Return the entry of a cause that is not reported."""
    why = sentences.rejected_because(diagnosis, name)
    test = sentences.score_test_of(diagnosis, name)
    if test is None:
        return {"name": name, "judged": False, "delta_bic": None, "rejected_because": why}
    return {
        "name": name,
        "judged": True,
        "delta_bic": _delta_bic(diagnosis, test.statistic, len(test.estimate)),
        "p_value": test.p_value,
        "detectability": sentences.detectability(diagnosis, name),
        "rejected_because": why,
    }


def gain_as_json(measured: Gain | None) -> dict[str, Any] | None:
    """Return the entry of a gain."""
    if measured is None:
        return None
    return {
        "runs": list(measured.runs),
        "metric": measured.metric,
        "before": measured.before,
        "after": measured.after,
        "reduction": measured.reduction,
        "ci95": list(measured.ci95),
        "claimed": measured.claimed,
        "by_run": {name: list(of_run) for name, of_run in measured.by_run.items()},
    }


# --- report.html, and the text next to the pictures in Rerun ---


def panels(diagnosis: Diagnosis, report: dict[str, Any]) -> tuple[list[Panel], list[Panel]]:
    """Return the panels of where the base is wrong, and a panel of each cause."""
    where = pictures.where(diagnosis, report["misfit"]["worst_against"])
    return where, [pictures.cause(diagnosis, identified) for identified in diagnosis.causes]


def ruled_out(diagnosis: Diagnosis, report: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the entries of causes that are ruled out: alternatives of a cause are not."""
    alternatives = {name for cause in diagnosis.causes for name in cause.confusable}
    return [entry for entry in report["screened"] if entry["name"] not in alternatives]


def page(diagnosis: Diagnosis, report: dict[str, Any]) -> str:
    """Return the HTML page, without external parts.

    It shows the verdict, where the base is wrong, the causes, the gain, what to run next, and what
    was ruled out.
    """
    where, of_causes = panels(diagnosis, report)
    parts = [html.paragraph(f"Verdict: {diagnosis.verdict}", kind="note")]
    for line in sentences.story(diagnosis):
        parts.append(html.paragraph(line))

    parts.append(html.element("h2", "Where it shows"))
    parts.append(html.picture(partial(pictures.draw, panels=where)))

    compared = diagnosis.side_by_side
    if compared.runs:
        parts.append(html.element("h2", "Runs side by side"))
        parts.append(html.picture(partial(pictures.runs, compared=compared), _RUNS_SIZE))

    if of_causes:
        parts.append(html.element("h2", "The cause" if len(of_causes) == 1 else "The causes"))
        for panel in of_causes:
            parts.append(html.picture(partial(pictures.draw, panels=[panel]), _CAUSE_SIZE))

    if diagnosis.final is not diagnosis.base:
        parts.append(html.element("h2", "Where base and extended model differ most"))
        parts.append(html.picture(partial(pictures.stretch, diagnosis=diagnosis), _STRETCH_SIZE))

    if diagnosis.gain is not None:
        by_run = diagnosis.gain.by_run
        metric = diagnosis.gain.metric
        parts.append(html.element("h2", "On runs that were never fitted"))
        parts.append(
            html.picture(
                lambda figure: pictures.gains(figure.subplots(), by_run, metric),
                _GAIN_SIZE,
            )
        )

    if report.get("next"):
        parts.append(html.element("h2", "What to run next"))
        for stop in report["next"]:
            command = f"rollerrig sequence {stop['file']}"
            parts.append(html.paragraph(f"{stop['title']}; {stop['reason']}: {command}"))

    parts.append(html.element("h2", "What was ruled out"))
    rows = [
        [BY_NAME[entry["name"]].text, entry["name"], entry["rejected_because"]]
        for entry in ruled_out(diagnosis, report)
        if entry["name"] != EMPIRICAL
    ]
    parts.append(html.table(["cause", "name", "why not"], rows))
    return html.page(f"What the model gets wrong: {diagnosis.data.name}", *parts)


def as_markdown(diagnosis: Diagnosis, report: dict[str, Any]) -> str:
    """Return verdict, story and what was ruled out, as Markdown."""
    reasons = [
        f"- {BY_NAME[entry['name']].text}: {entry['rejected_because']}"
        for entry in ruled_out(diagnosis, report)
        if entry["name"] in BY_NAME
    ]
    parts = [
        f"# {diagnosis.verdict}",
        *sentences.story(diagnosis),
        "## What was ruled out",
        "\n".join(reasons),
    ]
    return "\n\n".join(parts)


def adhesion_courses(diagnosis: Diagnosis) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return by Rerun path (time in s, adhesion (n, 3): measured, base, extended model).

    The measured adhesion is that of the extended model, with its inertia and torque.
    """
    design = diagnosis.design
    _, base, _ = gain.adhesion(design, diagnosis.base)
    measured, extended, _ = gain.adhesion(design, diagnosis.final)
    courses = {}
    for s in range(design.segments):
        at = design.span(s)
        run = design.names[int(design.run[s])]
        axle = int(design.axle[s]) + 1
        values = np.column_stack([measured[at], base[at], extended[at]])
        courses[f"/{run}/adhesion_{axle}"] = (design.time_s[at], values)
    return courses
