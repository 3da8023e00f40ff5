"""Makes the sentences of the first screen: how sure, what it costs, what was not judged, what next.

The verdict and the causes come before them.
"""

import math

from rollerrig.realtime.reports.hints import runs, sizes, suspects
from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.decide import decision, evidence, stopping, thresholds
from rollerrig.rig.identify.decide.decision import Diagnosis, Verdict
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.notes import NoteCode

MOST_SUSPECTS = 3
MOST_NAMES = 6
# a p-value is near the limit if it is above this share of the family-wise level
CLEARLY_BELOW = 0.01
FAMILY_WISE_ALPHA = thresholds.ALPHA_CAUSE * thresholds.CAUSES_SEARCHED
# smaller p-values differ only by rounding
LEAST_P = 1e-12


def smallest_in_words(test: ScoreTest) -> str:
    """Return the smallest size of a cause that these runs would show in half of the cases."""
    return sizes.in_words(test.name, test.smallest)


def p_in_words(p_value: float) -> str:
    """Return a p-value in words; far tails are computed only to `LEAST_P`."""
    if p_value < LEAST_P:
        return f"p < {LEAST_P:.0e}"
    return f"p = {p_value:.1g}"


def how_sure(diagnosis: Diagnosis) -> str:
    """Return how sure the verdict is."""
    p_value = p_in_words(diagnosis.p_value)
    if any(note.code is NoteCode.RUNS_DIFFER for note in diagnosis.notes):
        return "How sure: in about 2 % of fault-free datasets some runs would differ as much by chance."
    if diagnosis.verdict == Verdict.CONSISTENT and any(note.allowed for note in diagnosis.notes):
        return (
            f"How sure: something differs from the base model ({p_value}), but a brake within its "
            "declared calibration may differ as much. A smaller calibration_fraction, if you can "
            "declare one, makes it a cause."
        )
    if diagnosis.verdict == Verdict.CONSISTENT:
        return (
            f"How sure: chance alone makes a cause look this significant with {p_value}; about "
            "2 % of fault-free datasets are not called consistent. Consistent means that no cause "
            "of the library is larger than the sizes that these runs can show."
        )
    sure = f"How sure: chance alone would do this with {p_value}"
    rivals = [name for cause in diagnosis.causes for name in cause.confusable]
    if rivals:
        return f"{sure}, but which cause it is stays open between {len(rivals) + 1} causes."
    if diagnosis.causes:
        return f"{sure}, and the data distinguish it from all other causes of the library."
    return f"{sure}; what it is stays open."


def cost(diagnosis: Diagnosis) -> str:
    """Return what the causes cost in metres of stopping distance, empty where nothing is known."""
    if not diagnosis.causes:
        return ""
    distance = stopping.costs(diagnosis.design, diagnosis.base, diagnosis.final)
    if distance is None:
        return "Cost: none in stopping distance; the causes change what sensors show or how wheels turn."
    how = "longer" if distance.longer_m > 0.0 else "shorter"
    return (
        f"Cost: a stop of this vehicle from {distance.from_m_s:.3g} m/s is "
        f"{abs(distance.longer_m):.0f} m {how} than the base model predicts "
        f"({distance.extended_m:.0f} m instead of {distance.base_m:.0f} m). This is an estimate at the "
        "mean deceleration and the sliding of the runs."
    )


def not_judged(diagnosis: Diagnosis) -> str:
    """Return which causes these runs could not show, empty if all were judged."""
    judged = {test.name for test in diagnosis.score_tests}
    judged |= {cause.cause.name for cause in diagnosis.causes}
    names = [row.name for row in table.TABLE if row.name not in judged and row.name != "empirical"]
    if not names:
        return ""
    return f"Not judged: {', '.join(names)} (these runs cannot show them; see what was ruled out)."


def what_next(diagnosis: Diagnosis, worst: list[str]) -> list[str]:
    """Return what to measure next. `worst` are the covariates along which the base is wrong.

    Runs that differ come before suspects, which are those of all runs alike.
    """
    differing = runs.what_next(diagnosis.side_by_side)
    if differing and not diagnosis.causes:
        return [differing]
    if diagnosis.verdict == Verdict.CONSISTENT:
        weak = _hardest_to_see(diagnosis)
        if not weak:
            return []
        return [
            f"Measure next: to see less than {weak}, add stops from other initial speeds "
            "(--next 2 proposes them)."
        ]
    if diagnosis.causes:
        if any(cause.confusable for cause in diagnosis.causes):
            return ["Measure next: run the separating test of this report."]
        return [
            "Measure next: one more stop, after the cause is corrected if it can be (--next 1 "
            "proposes one)."
        ]
    if is_near_limit(diagnosis):
        return [
            "Measure next: repeat one stop unchanged, three times, and explain all stops together. A "
            "real error becomes clearer, one by chance goes."
        ]
    # two covariates may have the same suspects
    along: dict[suspects.Suspect, list[str]] = {}
    for covariate in worst[:MOST_SUSPECTS]:
        along.setdefault(suspects.suspect(covariate), []).append(covariate)
    return [
        f"Suspect along {' and '.join(covariates)}: {one.suspects}. Measure next: {one.measure}."
        for one, covariates in along.items()
    ]


def _hardest_to_see(diagnosis: Diagnosis) -> str:
    """Return the smallest visible sizes of the most usual causes of friction and brake."""
    usual = ("brake_gain", "rail_cleaning", "wheel_radius")
    found = {test.name: test for test in diagnosis.score_tests}
    names = [name for name in usual if name in found and math.isfinite(found[name].smallest)]
    return " or ".join(smallest_in_words(found[name]) for name in names)


def is_near_limit(diagnosis: Diagnosis) -> bool:
    """Return whether an unexplained error may be one by chance: its p-value is near the limit.

    A cause that won a fit, or that was contradicted, is no chance.
    """
    is_bare = diagnosis.verdict == Verdict.UNEXPLAINED and not diagnosis.set_aside
    if not is_bare or any(note.contradicted is not None for note in diagnosis.notes):
        return False
    return diagnosis.p_value > CLEARLY_BELOW * FAMILY_WISE_ALPHA


def nearest(diagnosis: Diagnosis) -> str:
    """Return the causes of the library that come nearest to an unexplained error, and how near.

    The nearness of a cause is the ratio of two evidences: that of the cause, and that of the smooth
    function that shows the error best. The score tests are of the base model, so each cause is
    tested without the others.
    """
    tests = [
        test
        for test in diagnosis.score_tests
        if not evidence.is_smooth_function(test.name) and evidence.is_significant(test)
    ]
    tests = sorted(tests, key=lambda test: -test.statistic)[:MOST_SUSPECTS]
    if not tests:
        return ""
    smooth = [test for test in diagnosis.score_tests if evidence.is_smooth_function(test.name)]
    shown = max(smooth, key=lambda test: test.statistic, default=None)
    names = []
    for test in tests:
        size = sizes.in_words(test.name, test.estimate[0])
        if test.axle:
            size += f" on {sizes.place_in_words(test.axle)}"
        near = ""
        if shown is not None and shown.statistic > test.statistic:
            share = 100.0 * test.statistic / shown.statistic
            near = f", {share:.0f} % of the error {shown.name}"
        names.append(f"{size} ({test.name}{near})")
    story = f"Nearest in the library, though none fits well enough: {'; '.join(names)}."
    if not diagnosis.set_aside or not diagnosis.remainder:
        return story
    fitted = " and ".join(found.score_test.name for found in diagnosis.set_aside)
    left = decision.remainder_share(diagnosis.set_aside, diagnosis.remainder)
    return f"{story} Fitted, {fitted} would leave {100.0 * left:.0f} % of the evidence."
