"""The report of `rollerrig explain` on a creep curve: JSON, sentences and the page.

`rig.identify.creep_curves` returns numbers. All their words are here.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from rollerrig.realtime.reports import page
from rollerrig.realtime.reports.creep_curve.tuned import (
    draw_maximum,
    fine_curve,
    legend_above,
    parameter_json,
    parameter_title,
    parameter_words,
    stiffness_words,
)
from rollerrig.realtime.reports.page import RUNS, paragraph, table
from rollerrig.realtime.reports.study import Model, StudyReport, verdict_and_sentences
from rollerrig.rig.identify.creep_curves import conditions, factors, laws
from rollerrig.rig.identify.creep_curves.conditions import Condition
from rollerrig.rig.identify.creep_curves.factors import Effect
from rollerrig.rig.identify.creep_curves.judgement import (
    FALLING_FRICTION,
    LEAST_FALL,
    Judgement,
    Shown,
)
from rollerrig.rig.identify.data.parameters import patch_of
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.mechanisms.table import TABLE

LAW = "law"
# names of checks in words, where the name is none
_WORDS = {LAW: "Polach's law"}
# condition -> name of its cause, and of its check
CAUSES = {
    conditions.SERIES: "series_differ",
    conditions.DIRECTION: "directions_differ",
    conditions.LOAD: "load_dependent_friction",
    conditions.SPEED: "speed_dependent_friction",
    conditions.TEMPERATURE: "temperature_dependent_friction",
    conditions.PRESSURE: "pressure_dependent_friction",
}
VERDICTS = {
    "consistent": "Nothing in these points is statistically significant.",
    "explained": "Everything in these points that is statistically significant has a cause.",
    "partly": "Some of what these points show has a cause; Polach's law does not fit the rest.",
    "unexplained": "Polach's law does not fit these points, and no cause in this list explains it.",
    "not_judged": "Nothing could be judged with these points.",
}


class Check(NamedTuple):
    """One question to the points: whether it could be judged, and what came out."""

    name: str
    why_not: str  # empty where it was judged
    found: bool
    smallest: float | None  # size that these points would have shown; None where not judged
    unit: str
    text: str  # a sentence without its full stop


def explain_report(data: Dataset, judged: Judgement) -> StudyReport:
    """Return the whole report of `rollerrig explain` on a creep curve."""
    result = explain_json(data, judged)
    sentences = story(data, judged)
    return StudyReport(
        result=result,
        page=explain_page(data, judged, sentences),
        summary=verdict_and_sentences(result["verdict"], data.name, sentences),
        model=Model(
            "extended.toml", f"# {data.name}: a creep curve has nothing that a scenario can load\n"
        ),
    )


# --- checks, in words ---


def checks(judged: Judgement) -> list[Check]:
    """Return the checks: falling friction, the conditions, and Polach's law."""
    shown = judged.shown
    by_name = {condition.name: condition for condition in shown.prepared.conditions}
    found = [_fall_check(shown)]
    for effect in shown.factors.effects:
        found.append(_effect_check(effect, by_name[effect.name]))
    found.append(_law_check(judged))
    return found


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def _interval(low: float, high: float) -> str:
    return f"{100.0 * low:.3g} to {100.0 * high:.3g} %"


def _fall_check(shown: Shown) -> Check:
    fall = shown.fall
    smallest = max(fall.smallest, LEAST_FALL)
    if shown.fall_why_not:
        text = f"Whether adhesion falls with creepage could not be judged: {shown.fall_why_not}"
        return Check(FALLING_FRICTION, shown.fall_why_not, False, None, "of the maximum", text)
    largest = float(shown.prepared.creepage[-1])
    if shown.falls:
        text = (
            f"Adhesion falls with creepage: by {_percent(fall.size)} "
            f"({_interval(fall.low, fall.high)}) from its maximum to the largest creepage, "
            f"{_percent(largest)}; {_where_is_the_maximum(shown)}"
        )
    else:
        if fall.high > smallest:
            begin = (
                f"No significant fall of adhesion with creepage up to {_percent(largest)}: it changes "
                f"by {_percent(-fall.size)} ({_interval(-fall.high, -fall.low)}) from its maximum on"
            )
        else:
            begin = (
                f"Adhesion does not fall with creepage up to {_percent(largest)}: "
                f"{_how_it_ends(shown)}"
            )
        text = f"{begin}. A fall of {_percent(smallest)} of the maximum would have been shown"
    return Check(FALLING_FRICTION, "", shown.falls, smallest, "of the maximum", text)


def _where_is_the_maximum(shown: Shown) -> str:
    fall = shown.fall
    if fall.points_before == 0:
        smallest = float(shown.prepared.creepage[0])
        return (
            f"the maximum is at or below the smallest creepages, from {_percent(smallest)} on, so "
            "the fall may be larger"
        )
    return f"the maximum of the smooth curve is at a creepage of {_percent(fall.peak_creepage)}"


def _how_it_ends(shown: Shown) -> str:
    fall = shown.fall
    if fall.rise_low > 0.0 and fall.rise >= LEAST_FALL:
        return (
            f"it still rises there, by {_percent(fall.rise)} "
            f"({_interval(fall.rise_low, fall.rise_high)}) over the last third of the range, so its "
            "maximum is not in the data"
        )
    return (
        f"it rises to a limit and changes by {_percent(fall.rise)} "
        f"({_interval(fall.rise_low, fall.rise_high)}) over the last third of the range"
    )


def _effect_check(effect: Effect, condition: Condition) -> Check:
    name = CAUSES[effect.name]
    unit = "of adhesion"
    if not effect.judged:
        text = f"Whether friction depends on {effect.name} could not be judged: {effect.why_not}"
        return Check(name, effect.why_not, False, None, unit, text)
    if not effect.is_reported:
        smallest = _smallest_words(effect, condition)
        return Check(name, "", False, effect.smallest, unit, smallest)
    if effect.series:
        text = _series_words(effect)
    elif effect.name == conditions.DIRECTION:
        text = _direction_words(effect)
    else:
        text = _condition_words(effect, condition)
    if effect.together_with:
        others = " and ".join(effect.together_with)
        text += (
            f". {others.capitalize()} changes together with it, and these data cannot distinguish"
        )
    return Check(name, "", True, effect.smallest, unit, text)


def _smallest_words(effect: Effect, condition: Condition) -> str:
    measured = f"{_percent(effect.size)} ({_interval(effect.low, effect.high)})"
    if effect.name == conditions.SERIES:
        begin = f"The series do not differ significantly: {measured}"
    elif effect.name == conditions.DIRECTION:
        begin = f"Braking and traction do not differ significantly: {measured}"
    else:
        begin = f"Friction does not change significantly with {effect.name}: {measured}"
    if not effect.low <= 0.0 <= effect.high:
        begin += f". The interval excludes 0, but a cause needs p < {factors.ALPHA:g}"
    if condition.name in (conditions.SERIES, conditions.DIRECTION):
        return f"{begin}; a difference of {_percent(effect.smallest)} would have been shown"
    return (
        f"{begin}; a change of {_percent(effect.smallest)} from {_range(condition)} would have been "
        "shown"
    )


def _series_words(effect: Effect) -> str:
    """Return the words of series that differ."""
    most, change = max(effect.series.items(), key=lambda item: abs(item[1]))
    direction = "less" if change < 0.0 else "more"
    text = (
        f"The series differ: series {most:g} has {_percent(abs(change))} {direction} adhesion than "
        f"the first series"
    )
    if math.isclose(change, effect.size):
        low, high = sorted((abs(effect.low), abs(effect.high)))
        text += f" ({_interval(low, high)})"
    if len(effect.series) > 1:
        others = ", ".join(
            f"series {number:g} {100.0 * share:+.3g} %"
            for number, share in effect.series.items()
            if number != most
        )
        text += f"; {others}"
    return text


def _direction_words(effect: Effect) -> str:
    direction = "less" if effect.size < 0.0 else "more"
    low, high = sorted((abs(effect.low), abs(effect.high)))
    return (
        f"Braking and traction differ: traction has {_percent(abs(effect.size))} "
        f"({_interval(low, high)}) {direction} adhesion, or the force or the creepage has an offset"
    )


def _condition_words(effect: Effect, condition: Condition) -> str:
    direction = "falls" if effect.size < 0.0 else "rises"
    low, high = sorted((abs(effect.low), abs(effect.high)))
    return (
        f"Friction {direction} with {effect.name}: by {_percent(abs(effect.size))} "
        f"({_interval(low, high)}) from {_range(condition)}"
    )


def _range(condition: Condition) -> str:
    if condition.name == conditions.PRESSURE:
        return f"{1e-3 * condition.low:.4g} to {1e-3 * condition.high:.4g} kPa"
    return f"{condition.low:.4g} to {condition.high:.4g} {condition.unit}"


def _law_check(judged: Judgement) -> Check:
    law = judged.law
    scatter = judged.shown.smooth.scatter
    unit = "adhesion, rms beyond scatter"
    if judged.law_why_not:
        text = f"Whether Polach's law fits could not be judged: {judged.law_why_not}"
        return Check(LAW, judged.law_why_not, False, None, unit, text)
    kind = "with falling friction" if law.has_fall else "without falling friction"
    if law.is_stiffer:
        kind += (
            f" and a contact that is {law.parameters['k_a'].value:.3g} times as stiff as the computed "
            "one"
        )
    measured = (
        f"it leaves an error of {law.rms:.3g} (rms), and the points scatter by {scatter:.3g} about a "
        "smooth curve"
    )
    largest = float(np.max(judged.shown.prepared.adhesion))
    share = _percent(law.beyond_scatter / largest)
    if not law.fits:
        direction = "above" if law.largest_deviation > 0.0 else "below"
        text = (
            f"Polach's law {kind} does not fit: {measured}. It is farthest off near a creepage of "
            f"{_percent(law.deviation_creepage)}, {abs(law.largest_deviation):.2g} {direction} the "
            "points"
        )
    elif law.is_exact:
        visible = _percent(law.smallest / largest)
        text = (
            f"Polach's law {kind} fits: {measured}. A misfit of {visible} of the largest adhesion would "
            "have been shown"
        )
    else:
        text = (
            f"Polach's law {kind} is close: {measured}. What it leaves beyond scatter is {share} of "
            f"the largest adhesion; {_percent(laws.LEAST_MISFIT)} and more is reported as a misfit"
        )
    return Check(LAW, "", not law.fits, law.smallest, unit, text)


def story(data: Dataset, judged: Judgement) -> list[str]:
    """Return the report in sentences: verdict, what was found, what was not, what to do next."""
    all_checks = checks(judged)
    lines = [VERDICTS[judged.verdict]]
    lines += [f"{check.text}." for check in all_checks if check.found]
    lines += [f"{check.text}." for check in all_checks if not check.found and not check.why_not]
    lines += [f"{check.text}." for check in all_checks if check.why_not]
    lines += [f"{sentence}." for sentence in _about_the_patch(data, judged)]
    lines += [f"Next: {sentence}." for sentence in _what_to_measure(judged)]
    notes = [*data.warnings, "no points were held out: no gain is claimed"]
    lines += [f"Note: {note}." for note in notes]
    return lines


def _about_the_patch(data: Dataset, judged: Judgement) -> list[str]:
    """Return what the contact patch has to do with a law that needs a stiffer contact."""
    law = judged.law
    if judged.law_why_not or not (law.is_stiffer or law.parameters["k_a"].bound == "high"):
        return []
    load_N = float(np.median(judged.shown.prepared.curve.load_N))
    return [stiffness_words(data, load_N, law.parameters["k_a"].value)]


def _what_to_measure(judged: Judgement) -> list[str]:
    """Return proposals for further points, where a question is open."""
    shown = judged.shown
    fall = shown.fall
    found = []
    if shown.fall_why_not:
        found.append("measure at more creepages, and each of them more than once")
    elif not shown.falls and fall.rise_low > 0.0:
        found.append(
            f"measure beyond a creepage of {_percent(float(shown.prepared.creepage[-1]))} to see "
            "whether adhesion has a maximum"
        )
    same = [
        effect.name
        for effect in shown.factors.effects
        if not effect.judged and effect.name in (conditions.LOAD, conditions.SPEED)
    ]
    if same:
        found.append(f"measure at a second {' and a second '.join(same)} to judge the effect")
    return found


# --- JSON ---


def explain_json(data: Dataset, judged: Judgement) -> dict[str, Any]:
    """Return the content of report.json."""
    shown = judged.shown
    law = judged.law
    all_checks = checks(judged)
    unknown = None
    if judged.law_fails:
        text = next(check.text for check in all_checks if check.name == LAW)
        unknown = {
            "formula": "",
            "against": ["creepage"],
            "heldout_gain": None,
            "text": text,
        }
    reported = {FALLING_FRICTION} | set(CAUSES.values())
    return {
        "verdict": judged.verdict,
        "kind": "creep_curve",
        "dataset": data.name,
        "points": int(shown.prepared.creepage.size),
        "misfit": {
            "metric": "adhesion_rmse",
            "before": law.rms,
            "noise_floor": shown.smooth.scatter,
            "p_value": law.p_value,
            "worst_against": ["creepage"],
        },
        "causes": _causes_json(judged),
        "checks": [_check_json(check) for check in all_checks],
        "law": {
            "name": "Polach",
            "falling_friction": law.has_fall,
            "fits": None if judged.law_why_not else law.fits,
            "rms": law.rms,
            "beyond_scatter": law.beyond_scatter,
            "parameters": {
                name: parameter_json(*parameter) for name, parameter in law.parameters.items()
            },
        },
        "gain": None,
        "unknown": unknown,
        "screened": [
            {
                "name": mechanism.name,
                "delta_bic": 0.0,
                "rejected_because": "a creep curve, without time, place or axles, cannot show it",
            }
            for mechanism in TABLE
            if mechanism.name not in reported
        ],
        "notes": [*data.warnings, "no points were held out: no gain is claimed"],
    }


def _check_json(check: Check) -> dict[str, Any]:
    """Return a check in the form that recordings have, too."""
    smallest = _finite(check.smallest)
    return {
        "name": check.name,
        "judged": not check.why_not,
        "reason": check.why_not or None,
        "found": check.found,
        "smallest": None if smallest is None else {"value": smallest, "unit": check.unit},
        "text": check.text,
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _causes_json(judged: Judgement) -> list[dict[str, Any]]:
    shown = judged.shown
    by_name = {condition.name: condition for condition in shown.prepared.conditions}
    causes = []
    if shown.falls:
        fall = shown.fall
        parameters: dict[str, Any] = {
            "fall": {"value": fall.size, "ci95": [fall.low, fall.high], "unit": "of the maximum"},
        }
        for name, parameter in judged.law.parameters.items():
            parameters[name] = parameter_json(*parameter) | {"unit": ""}
        causes.append(_cause_json(FALLING_FRICTION, parameters, fall.p_value, []))
    for effect in shown.reported:
        condition = by_name[effect.name]
        parameters = {
            "change": {
                "value": effect.size,
                "ci95": [effect.low, effect.high],
                "unit": "of adhesion",
            }
        }
        if effect.series:
            parameters["by_series"] = {f"{n:g}": share for n, share in effect.series.items()}
        elif effect.name != conditions.DIRECTION:
            parameters["from"] = {"value": condition.low, "ci95": None, "unit": condition.unit}
            parameters["to"] = {"value": condition.high, "ci95": None, "unit": condition.unit}
        together = [CAUSES[name] for name in effect.together_with]
        causes.append(_cause_json(CAUSES[effect.name], parameters, None, together))
    return causes


def _cause_json(
    name: str, parameters: dict[str, Any], p_value: float | None, confusable: list[str]
) -> dict[str, Any]:
    return {
        "name": name,
        "axles": None,
        "parameters": parameters,
        "evidence": {
            "p_value": p_value,
            "delta_bic": None,
            "heldout_gain": None,
            "detectability": None,
        },
        "confusable_with": confusable,
        "separating_test": "",
    }


# --- page ---


def explain_page(data: Dataset, judged: Judgement, sentences: list[str]) -> str:
    """Return the page: the sentences, the points with the judged law, checks and parameters."""
    rows = []
    for check in checks(judged):
        smallest = _finite(check.smallest)
        rows.append(
            (
                _WORDS.get(check.name, check.name.replace("_", " ")),
                _result_words(check),
                check.why_not,
                "" if smallest is None else f"{smallest:.2g} {check.unit}",
            )
        )
    parameters = [
        (parameter_title(name), parameter_words(parameter_json(*parameter)))
        for name, parameter in judged.law.parameters.items()
    ]
    return page.page(
        f"Creep curve of {data.name}",
        paragraph(f"Verdict: {judged.verdict.replace('_', ' ')}. {sentences[0]}", kind="note"),
        *(paragraph(sentence) for sentence in sentences[1:]),
        page.picture(partial(_draw, data=data, judged=judged), (11.0, 6.0)),
        table(("check", "result", "why not", "smallest size that is shown"), rows),
        table(("the drawn law", "value (95 %)"), parameters),
    )


def _result_words(check: Check) -> str:
    """Return what a check found: of Polach's law a misfit, of the others an effect."""
    if check.why_not:
        return "could not be judged"
    if check.name == LAW:
        return "does not fit" if check.found else "fits"
    return "found" if check.found else "not found"


_MOST_DRAWN_GROUPS = 12


def _draw(figure: Figure, data: Dataset, judged: Judgement) -> None:
    """Draw points, smooth curves and the judged law against creepage, each group in its colour."""
    prepared = judged.shown.prepared
    smooth = judged.shown.smooth
    axes = figure.subplots()
    numbers = np.unique(prepared.group)
    patch = patch_of(data)
    for k, number in enumerate(numbers[:_MOST_DRAWN_GROUPS]):
        here = np.flatnonzero(prepared.group == number)
        colour = RUNS[k % len(RUNS)]
        creepage = 100.0 * prepared.creepage[here]
        axes.plot(
            creepage,
            prepared.adhesion[here],
            ".",
            color=colour,
            alpha=0.5,
            label=_group_label(judged, here),
            rasterized=True,
        )
        # a smooth curve with conditions that vary within the group is no line
        if all(part.nuisance.shape[1] == 1 for part in smooth.groups):
            label = "smooth curve" if k == 0 else None
            axes.plot(creepage, smooth.fitted[here], "--", color=colour, label=label)

        fine = fine_curve(prepared.curve.chosen(here))
        columns = np.tile(np.median(judged.law_columns[here], axis=0), (fine.creepage.size, 1))
        adhesion = laws.modelled(judged.law.x, judged.law.beta, columns, fine, patch)
        label = f"Polach's law, rms {judged.law.rms:.3g}" if k == 0 else None
        axes.plot(100.0 * fine.creepage, adhesion, "-", color=colour, label=label)
        draw_maximum(axes, fine.creepage, adhesion, colour)
    axes.set(
        xlabel="creepage, %", ylabel="adhesion coefficient", xlim=(0.0, None), ylim=(0.0, None)
    )
    legend_above(axes)


def _group_label(judged: Judgement, here: np.ndarray) -> str:
    """Return the conditions of a group in words."""
    words = []
    for condition in judged.shown.prepared.conditions:
        if condition.name == conditions.DIRECTION and condition.varies:
            words.append("braking" if np.median(condition.values[here]) > 0.0 else "traction")
        elif condition.varies and condition.is_levels:
            words.append(
                f"{condition.name} {np.median(condition.values[here]):.4g} {condition.unit}".strip()
            )
    return ", ".join(words) or "measured"
