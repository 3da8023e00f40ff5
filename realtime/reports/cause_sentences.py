"""Makes the sentences of the report on braking runs: story, notes, reasons of rejection.

The words for causes come from the table of mechanisms.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

from rollerrig.configs.number_text import rounded
from rollerrig.realtime.reports.hints import first_screen, runs, sizes
from rollerrig.rig.identify.decide import decision, estimates, evidence, thresholds
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.coherence import Contradicted, Contradiction
from rollerrig.rig.identify.decide.decision import Diagnosis, Verdict
from rollerrig.rig.identify.decide.empirical import EmpiricalFormula
from rollerrig.rig.identify.decide.estimates import Estimate
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.gain import ADHESION, FREE_RUN, Gain
from rollerrig.rig.identify.decide.notes import Note, NoteCode
from rollerrig.rig.mechanisms.mechanism import ALONE
from rollerrig.rig.mechanisms.table import BY_NAME

MOST_COVARIATES_SHOWN = 3
MOST_RUNS_SHOWN = 3

# metrics of the gain, in words
METRICS = {
    ADHESION: "the adhesion that the model lacks (rms, adhesion_rmse)",
    FREE_RUN: "the error of the predicted speed (rms in m/s, free_running_speed_rmse_m_s)",
}

# subject and verb of a sentence, for the causes with `unknown_in_other_runs`
UNKNOWN_SHAPES = {
    "wheel_out_of_round": "the angle of an out-of-round wheel at the start is",
    "sanding": "the moments of sanding are",
}


# --- words and numbers ---


def unit(name: str) -> str:
    """Return a unit with the space before it; an empty text for a number without a unit."""
    return "" if name in ("", "-") else f" {name}"


def covariate_of(test: ScoreTest) -> str:
    """Return the covariate of a smooth function, as the report names it.

    For example, "along speed" gives "speed". A covariate of a single wheelset contains the number
    of the wheelset: "along time of one axle" gives "time of axle 2".
    """
    covariate = test.name.removeprefix("along ")
    return covariate.replace("one axle", f"axle {test.axle}")


def worst_covariates(diagnosis: Diagnosis) -> list[str]:
    """Return the covariates along which the base is most significantly wrong, the worst first.

    Where a cause was contradicted, what contradicted it comes first.
    """
    failed = []
    for note in diagnosis.notes:
        if note.contradicted is not None and diagnosis.verdict == Verdict.UNEXPLAINED:
            failed.append(_failed_along(note.contradicted))
    smooth = [test for test in diagnosis.score_tests if evidence.is_smooth_function(test.name)]
    smooth = sorted(smooth, key=lambda test: test.p_value)
    against = [*failed, *(covariate_of(test) for test in smooth)]
    return list(dict.fromkeys(against))[:MOST_COVARIATES_SHOWN]


def _failed_along(contradicted: Contradicted) -> str:
    """Return the covariate that shows what contradicts a cause."""
    if contradicted.what is Contradiction.NO_TRIGGER:
        return "time"
    if contradicted.what is Contradiction.OTHER_PLACES:
        return "place"
    return "axle" if contradicted.cause.axle else "vehicle speed"


def formula_text(formula: EmpiricalFormula) -> str:
    """Return an empirical formula in symbols and numbers: a wave [N1], or a polynomial [N1, N2].

    The equations are in `decide.empirical`.
    """
    name = formula.covariate.word
    unit_of_x = formula.covariate.unit
    shape = formula.cause.shape
    a, b = formula.cause.values
    if "period" in shape:
        angle = f"2 pi {name} / {shape['period']:.4g} {unit_of_x}"
        return f"{_left_side(formula)} += {a:+.3g} cos({angle}) {b:+.3g} sin({angle})"
    # a term on the vehicle is a force; a term of friction has no unit
    force = " N" if formula.is_on_vehicle else ""
    polynomial = f"{a:+.3g}{force} z {b:+.3g}{force} z^2"
    centre = f"{shape['centre']:.4g} {unit_of_x}"
    scale = f"{shape['scale']:.4g} {unit_of_x}"
    return f"{_left_side(formula)} += {polynomial}, z = ({name} - {centre}) / {scale}"


def _left_side(formula: EmpiricalFormula) -> str:
    """Return the symbol of the quantity that a formula changes: a force, or the log of friction."""
    return "R" if formula.is_on_vehicle else "ln mu"


# --- notes ---


def notes(diagnosis: Diagnosis) -> list[str]:
    """Return the warnings of the dataset and the notes of the decision, without full stops."""
    return [*diagnosis.data.warnings, *(note_sentence(note) for note in diagnosis.notes)]


def only_runs_differ(diagnosis: Diagnosis) -> bool:
    """Return whether a diagnosis is unexplained only because runs differ from the others."""
    return any(note.code is NoteCode.RUNS_DIFFER for note in diagnosis.notes)


def immaterial_notes(diagnosis: Diagnosis) -> list[Note]:
    """Return the notes on what is significant and inside the declared calibration."""
    return [note for note in diagnosis.notes if note.allowed > 0.0]


def note_sentence(note: Note) -> str:
    """Return the sentence of a note, without a full stop."""
    causes = " and ".join(note.causes)
    remainder = "" if note.remainder is None else covariate_of(note.remainder)
    match note.code:
        case NoteCode.GAIN_NOT_JUDGED:
            unknown = UNKNOWN_SHAPES[note.causes[0]]
            return (
                f"{unknown} not known for the runs that were not fitted: the gain cannot be judged "
                "there"
            )
        case NoteCode.NOT_LIKE_RECORDING:
            return (
                f"simulated stops with {causes} do not brake like the recording: not reported as a "
                "cause"
            )
        case NoteCode.WORSE_ON_HELD_OUT_RUNS:
            return (
                f"{causes} would fit the tuning runs but makes runs that were not fitted worse: "
                "not reported as a cause"
            )
        case NoteCode.LARGE_REMAINDER:
            return (
                f"with {causes} in the model a large remainder is left along {remainder}: the "
                "cause, or its form, is not in the library"
            )
        case NoteCode.INTERVAL_HOLDS_NOTHING:
            return (
                f"the size of {causes} is not certain: its interval holds 0 at the level of the decision, "
                "although it would fit the runs better, so it is not reported as a cause"
            )
        case NoteCode.IMMATERIAL:
            return (
                f"{causes} is significant but immaterial: it changes the braking force by "
                f"{rounded(100.0 * note.share, 2)} %, {_tolerance(note)}"
            )
        case NoteCode.NO_TRIGGER | NoteCode.OTHER_PLACES | NoteCode.OTHER_FORCE:
            assert note.contradicted is not None
            return _contradicted_sentence(note.contradicted)
        case NoteCode.TWO_FORCES:
            return (
                f"{causes} together leave a remainder along {remainder}: they are two wrong forms of "
                "one force, and are not reported as causes"
            )
        case NoteCode.IMMATERIAL_REMAINDER:
            return (
                f"a remainder along {remainder} is significant but immaterial: it is "
                f"{rounded(100.0 * note.share, 2)} % of the braking force, {_tolerance(note)}"
            )
        case NoteCode.INSIDE_CALIBRATION:
            return _inside_calibration_sentence(note)
        case NoteCode.RUNS_DIFFER:
            return "the runs differ from each other, so the base model is not consistent with all of them"
        case NoteCode.SMALL_REMAINDER:
            return f"a small remainder is left along {remainder}"


def _inside_calibration_sentence(note: Note) -> str:
    """Return the sentence on forces that brakes inside their calibration explain as well."""
    found = list(note.causes)
    if note.remainder is not None:
        found.append(f"a remainder along {covariate_of(note.remainder)}")
    are = "is" if len(found) == 1 else "are together"
    return (
        f"{' and '.join(found)} {are} significant but immaterial: brakes that all vary in the same "
        f"way by {rounded(100.0 * note.share, 2)} % of the torque explain these runs nearly as "
        f"well or better, {_tolerance(note)}"
    )


def _contradicted_sentence(contradicted: Contradicted) -> str:
    """Return the sentence on a cause that does not show what its mechanism demands."""
    name = contradicted.cause.name
    size = sizes.in_words(name, contradicted.cause.values[0])
    if contradicted.what is Contradiction.OTHER_FORCE:
        return (
            f"{size} ({name}) would fit the wheels or the vehicle, but not both: one torque would slow "
            "both, so it is not reported as a cause"
        )
    unit_of_window = "s" if contradicted.what is Contradiction.NO_TRIGGER else "m"
    spans = [
        f"from {rounded(max(window.start, 0.0), 3)} to {rounded(window.end, 3)} {unit_of_window} "
        f"in run {window.run}"
        for window in contradicted.windows[:MOST_RUNS_SHOWN]
    ]
    more = len(contradicted.windows) - len(spans)
    where = ", ".join(spans) + (f" and in {more} more runs" if more else "")
    if contradicted.what is Contradiction.NO_TRIGGER:
        return (
            f"something raises friction {where}; it follows neither the brake, nor a slide, nor a "
            "speed, so it is not reported as sanding"
        )
    return (
        f"something lowers friction {where}, but its place differs from run to run, so it is not "
        "reported as a patch of the rail"
    )


def _tolerance(note: Note) -> str:
    """Return how an immaterial size compares with the declared calibration."""
    within = "inside" if note.share <= note.tolerance else "within twice"
    return f"{within} your {rounded(100.0 * note.tolerance, 2)} % (calibration_fraction)"


# --- remainder, and rejected causes ---


class Remainder(NamedTuple):
    """The evidence that the reported causes do not explain.

    The names of the fields are keys of the JSON report.
    """

    share: float  # that of the largest remainder in the evidence of the causes and itself
    against: list[str]  # covariates along which a remainder is left, the largest first


def remainder(diagnosis: Diagnosis) -> Remainder:
    """Return the evidence that the causes of a diagnosis do not explain."""
    left = [
        test
        for test in diagnosis.remainder
        if evidence.is_significant(test, thresholds.CLEAR_REMAINDER)
    ]
    left = sorted(left, key=lambda test: -test.statistic)
    return Remainder(
        share=decision.remainder_share(diagnosis.causes, diagnosis.remainder),
        against=[covariate_of(test) for test in left],
    )


def score_test_of(diagnosis: Diagnosis, name: str) -> ScoreTest | None:
    """Return the score test of a cause, None if these runs cannot show it."""
    for test in diagnosis.score_tests:
        if test.name == name:
            return test
    return None


def detectability(diagnosis: Diagnosis, name: str) -> float | None:
    """Return the smallest size of a cause that the runs would show in half of the cases.

    It was measured by planting the cause (`decide.smallest`). None if no size would be found.
    """
    test = score_test_of(diagnosis, name)
    if test is None or not math.isfinite(test.smallest):
        return None
    return test.smallest


def rejected_because(diagnosis: Diagnosis, name: str) -> str:
    """Return why a cause is not reported."""
    test = score_test_of(diagnosis, name)
    if test is None:
        return not_judged_because(name)
    if not evidence.is_significant(test):
        because = f"not statistically significant (p = {test.p_value:.2g})"
        if not math.isfinite(test.smallest):
            return f"{because}; these runs would show no size of it"
        return (
            f"{because}; these runs would show {first_screen.smallest_in_words(test)} in half of the "
            "cases, and larger sizes more often"
        )
    if diagnosis.causes:
        if any(name in cause.confusable for cause in diagnosis.causes):
            return "not ruled out: these runs cannot distinguish it from the reported cause"
        return (
            f"alone it would be significant ({first_screen.p_in_words(test.p_value)}, "
            f"{sizes.in_words(name, test.estimate[0])}), but "
            f"{diagnosis.causes[0].cause.name} explains the same error and fits better"
        )
    # significant by its score, but no cause was good enough after the fit
    return "the remainder does not have the form of this cause"


def not_judged_because(name: str) -> str:
    """Return why these runs could not show a cause."""
    if name == "sanding":
        return "not judged: friction was higher for some seconds in no run"
    if name == "contaminated_patch":
        return "not judged: friction was lower at no place, or the runs are too short for places"
    return "not judged: these runs cannot show it"


# --- the story ---


def story(diagnosis: Diagnosis) -> list[str]:
    """Return what is wrong, by how much, where, and what the extended model gains, in sentences."""
    lines = []
    inside = immaterial_notes(diagnosis)
    if diagnosis.verdict == Verdict.CONSISTENT and inside:
        most = max(inside, key=lambda note: note.share)
        lines.append(
            "The base model is consistent with this data within the declared calibration: what is "
            f"statistically significant is {rounded(100.0 * most.share, 2)} % of the braking force, "
            f"{_tolerance(most)}."
        )
    elif diagnosis.verdict == Verdict.CONSISTENT:
        lines.append(
            "Nothing is statistically significant: the base model is consistent with this data "
            f"(p = {diagnosis.p_value:.2g})."
        )
    worst = worst_covariates(diagnosis)
    for identified in diagnosis.causes:
        lines += _cause_sentences(identified)
    if diagnosis.verdict == Verdict.PARTLY:
        left = remainder(diagnosis)
    if diagnosis.verdict == Verdict.PARTLY and left.against:
        lines.append(
            f"A remainder is left along {', '.join(left.against)}: {left.share:.0%} of the evidence. "
            "No further cause of the library explains it."
        )
    if only_runs_differ(diagnosis):
        lines.append(
            "Nothing is statistically significant in the fitted runs together "
            f"(p = {diagnosis.p_value:.2g}), but the runs differ: no model is right for all of them."
        )
    elif first_screen.is_near_limit(diagnosis):
        lines.append(
            "The base model is possibly wrong: something is statistically significant, but near the "
            f"limit (p = {diagnosis.p_value:.2g}). It depends most on {', '.join(worst)}. Repeat one stop."
        )
    elif diagnosis.verdict == Verdict.UNEXPLAINED:
        lines.append(
            "The base model is wrong, and no mechanism of the library explains the error. The error "
            f"depends most significantly on {', '.join(worst)}."
        )
    if diagnosis.verdict == Verdict.UNEXPLAINED and not only_runs_differ(diagnosis):
        nearest = first_screen.nearest(diagnosis)
        if nearest:
            lines.append(nearest)
        if diagnosis.formula is None:
            lines.append("No formula was found that improves the runs that were never fitted.")
        else:
            lines.append(f"Empirical: {formula_text(diagnosis.formula)}.")
    lines += runs.story(diagnosis.side_by_side)
    screen = [
        first_screen.how_sure(diagnosis),
        first_screen.cost(diagnosis),
        first_screen.not_judged(diagnosis),
        *first_screen.what_next(diagnosis, worst),
    ]
    lines += [line for line in screen if line]
    if diagnosis.gain is not None:
        lines.append(_gain_sentence(diagnosis.gain))
    return lines + [f"Note: {note}." for note in notes(diagnosis)]


def _cause_sentences(identified: IdentifiedCause) -> Iterable[str]:
    """Yield the sentence of a cause, and a sentence on causes that look the same in these runs."""
    cause = identified.cause
    row = BY_NAME[cause.name]

    values = []
    windows: dict[str, list[float]] = {}
    for name, estimate in estimates.parameters(identified).items():
        kind, _, run = name.partition(" ")
        if run:
            # the start or the duration in one run: the headline has the range of all runs
            windows.setdefault(kind, []).append(estimate.value)
        elif name != ALONE.name:
            values.append(_value_in_words(name, estimate))
    for kind, of_runs in windows.items():
        span = f"{rounded(min(of_runs), 3)} to {rounded(max(of_runs), 3)}"
        runs = "1 run" if len(of_runs) == 1 else f"{len(of_runs)} runs"
        values.append(f"{kind} = {span} in {runs} (each is in report.json)")

    place = f" on {sizes.place_in_words(cause.axle)}" if cause.axle else ""
    if cause.shape.get(ALONE.name):
        place += ", only in the friction of the contaminant"
    yield f"Cause: {row.text}{place} [{row.name}]; {', '.join(values)}."

    if identified.confusable:
        shares = {rival.name: rival.share for rival in identified.rivals}
        alike = []
        for name in identified.confusable:
            if name in shares:
                alike.append(f"{name} (with {shares[name]:.0%} of its likelihood ratio)")
            else:
                alike.append(name)
        yield (
            f"  These runs cannot distinguish it from {', '.join(alike)}; separating_test.toml would."
        )


def _value_in_words(name: str, estimate: Estimate) -> str:
    """Return a parameter with its interval; a constant of the form has none."""
    value = f"{name} = {rounded(estimate.value, 3)}"
    if estimate.low == estimate.high:
        return f"{value}{unit(estimate.unit)}"
    interval = f"{rounded(estimate.low, 3)} to {rounded(estimate.high, 3)}"
    return f"{value} ({interval}){unit(estimate.unit)}"


def _gain_sentence(gain: Gain) -> str:
    """Return the sentence on what the extended model gains on runs that were never fitted."""
    low, high = gain.ci95
    sentence = (
        f"On runs that were never fitted ({', '.join(gain.runs)}) {METRICS[gain.metric]} falls from "
        f"{gain.before:.3g} to {gain.after:.3g}: {100 * gain.reduction:.1f} % "
        f"({100 * low:.1f} to {100 * high:.1f} %)"
    )
    return sentence + ("." if gain.claimed else "; no gain is claimed.")
