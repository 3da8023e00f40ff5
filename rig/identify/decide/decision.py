"""Explains braking runs: fits the base, tests and fits causes, and checks what is left.

The order is the argument. First the base gets its best chance. Then null simulations of the same
design show what is ordinary. A cause is accepted if it is beyond that, alone or together with those
that cannot be distinguished from it. Then the remainder is judged in the same way, with the cause
in the null simulations.
"""

import time
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.base import check as base_checks
from rollerrig.rig.identify.base import rolling
from rollerrig.rig.identify.causes import candidates, table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide import (
    choice,
    coherence,
    empirical,
    estimates,
    evidence,
    fitting,
    gain,
    goodness,
    null_simulations,
    side_by_side,
    smallest,
    stopping,
    thresholds,
)
from rollerrig.rig.identify.decide.choice import BlockwiseFit, Candidate, IdentifiedCause
from rollerrig.rig.identify.decide.coherence import Contradicted, Contradiction
from rollerrig.rig.identify.decide.empirical import EmpiricalFormula
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.gain import Gain
from rollerrig.rig.identify.decide.notes import Note, NoteCode
from rollerrig.rig.identify.decide.null_simulations import Workspace
from rollerrig.rig.identify.decide.side_by_side import SideBySide
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.mechanisms.mechanism import TORQUE

_MEDIAN_OF_CHI_SQUARED = 0.455  # of one degree of freedom


class Verdict(StrEnum):
    """What the data show about the base model."""

    CONSISTENT = "consistent"  # nothing is statistically significant
    EXPLAINED = "explained"  # by one cause or two; a small remainder is a note
    PARTLY = "partly"  # causes are reported, and a remainder with them
    UNEXPLAINED = "unexplained"  # by no cause of the library


class Diagnosis(NamedTuple):
    """The result of explaining the braking runs of a dataset."""

    data: Dataset
    design: Design  # the runs that were fitted, prepared
    held_out: Design | None  # the runs that were never fitted, prepared; None: there are none
    base: Explanation  # the fitted base model, without causes
    final: Explanation  # the model that is reported; the same object as `base` if nothing is added
    verdict: Verdict
    causes: list[IdentifiedCause]  # that are reported, the most likely one first
    set_aside: list[IdentifiedCause]  # fitted, but not reported: too much remains
    score_tests: list[ScoreTest]  # of the base, the most significant first
    remainder: list[ScoreTest]  # tests of smooth functions with the causes in the model
    gain: Gain | None  # of `final` on the runs that were never fitted
    p_value: float  # of the base, for all causes together
    notes: list[Note]
    formula: EmpiricalFormula | None  # for what no cause explains
    elapsed_s: float
    side_by_side: SideBySide = side_by_side.NOTHING  # all runs, fitted or not


class _Search(NamedTuple):
    """What the search for causes leads to, before it is judged on other runs."""

    explanation: Explanation
    causes: list[IdentifiedCause]
    score_tests: list[ScoreTest]  # of the base
    remainder: list[ScoreTest] | None  # None: the causes do not brake like the recording
    smoother_base: Explanation  # the base with the irregularity that the best cause leaves
    contradicted: tuple[Contradicted, ...] = ()  # causes that won enough and are another effect


def explain_braking_runs(
    data: Dataset, seed: int, progress: null_simulations.Progress
) -> Diagnosis:
    """Return the diagnosis of braking runs. Raises ConfigError if nothing can be concluded."""
    from threadpoolctl import threadpool_limits

    began_s = time.monotonic()
    base_checks.check(data)
    # the processes of the pool use all cores: numerical libraries must not start threads besides
    with threadpool_limits(1), null_simulations.worker_pool() as pool:
        measured = data.group("tune")
        design = prepare(data, measured)
        workspace = Workspace(data, measured, design, pool, progress)

        progress("fit of the base", 0.0)
        base_fit = fitting.fit(design, candidates.untuned(design))
        progress("fit of the base", 1.0)
        base = base_fit.explanation
        goodness.check_deviance(design, base_fit.deviance)
        _check_accuracy(design, base)
        shares = null_simulations.rail_shares(workspace, base, seed)
        search = _search_causes(workspace._replace(shares=shares), base_fit, seed)
        search, inside = _without_common_brake(design, base, search)
        search, immaterial = _without_immaterial(design, search)

        held_out = None
        if data.group("validate"):
            held_out = prepare(data, data.group("validate"))
        notes = inside + immaterial + _notes_on_gain(held_out, search.causes)
        measured_gain = None
        can_judge_gain = not any(note.code is NoteCode.GAIN_NOT_JUDGED for note in notes)
        if held_out is not None and search.causes and can_judge_gain:
            measured_gain = gain.measure(held_out, base, search.explanation, seed, fitted=design)
        contradicted = search.contradicted
        at = coherence.of_forces(design, search.explanation)
        if at is not None:
            found = search.causes[at]
            force = Contradicted(
                found.cause, found.likelihood_ratio, Contradiction.OTHER_FORCE, windows=()
            )
            contradicted = (*contradicted, force)
        verdict, more_notes = decide_verdict(
            search.causes, search.remainder, measured_gain, contradicted
        )
        notes += more_notes
        unclear = [f.cause.name for f in search.causes if not estimates.is_finding(f)]
        if unclear and verdict in (Verdict.EXPLAINED, Verdict.PARTLY):
            verdict = Verdict.UNEXPLAINED
            notes.append(Note(NoteCode.INTERVAL_HOLDS_NOTHING, causes=tuple(unclear)))
        if verdict == Verdict.CONSISTENT:
            goodness.check_fit(design, base)
        base_checks.check_order(data, [found.cause.name for found in search.causes])

        side = side_by_side.compare(workspace, search.explanation, search.score_tests)
        only_runs_differ = verdict == Verdict.CONSISTENT and side.contradicts_one_model
        if only_runs_differ:
            verdict = Verdict.UNEXPLAINED
            notes.append(Note(NoteCode.RUNS_DIFFER))

        final = search.explanation
        causes = search.causes
        set_aside: list[IdentifiedCause] = []
        if verdict not in (Verdict.EXPLAINED, Verdict.PARTLY):
            set_aside = causes
            causes = []
            final = base
            measured_gain = None

        formula = None
        if verdict == Verdict.UNEXPLAINED and not only_runs_differ:
            progress("formula", 0.0)
            smooth = _smooth_functions(search.score_tests)
            formula = empirical.find(design, held_out, search.smoother_base, smooth, seed)
            progress("formula", 1.0)
        if formula is not None:
            final = formula.explanation
            measured_gain = formula.gain

    smallest_p = min([test.p_value for test in search.score_tests], default=1.0)
    return Diagnosis(
        data=data,
        design=design,
        held_out=held_out,
        base=base,
        final=final,
        verdict=verdict,
        causes=causes,
        set_aside=set_aside,
        score_tests=search.score_tests,
        remainder=search.remainder or [],
        gain=measured_gain,
        p_value=float(1.0 - (1.0 - smallest_p) ** thresholds.CAUSES_SEARCHED),
        notes=notes,
        formula=formula,
        elapsed_s=time.monotonic() - began_s,
        side_by_side=side,
    )


def _check_accuracy(design: Design, base: Explanation) -> None:
    """Raise ConfigError if the innovations of the fitted base contradict the declared accuracy."""
    innovation, variance, *_ = sensitivity.innovations(design, candidates.inputs(design, base))
    ratio = float(np.median(innovation * innovation / variance) / _MEDIAN_OF_CHI_SQUARED)
    low = thresholds.LEAST_INNOVATION_VARIANCE
    if design.wheel_sensor.is_pulses:
        # the error of pulses is small most of the time, and larger where a wheel accelerates
        low = 0.0
    high = thresholds.MOST_INNOVATION_VARIANCE
    # negated, so that a ratio that is not a number is refused too
    if not low <= ratio <= high:
        raise ConfigError(
            f"the innovations have {ratio:.2g} times the variance that the declared accuracy allows "
            f"(1 is right, {low} to {high} is accepted): correct [accuracy] in dataset.toml, or leave "
            "its values out to have them estimated"
        )


def _search_causes(workspace: Workspace, base_fit: fitting.Fit, seed: int) -> _Search:
    """Return the causes that the fitted runs support, and what they leave."""
    design = workspace.design
    base, base_deviance, _ = base_fit

    # score tests on the rail that the most promising causes leave
    normal, *_ = fitting.normal_equations(design, base)
    promising = evidence.most_promising(design, normal, thresholds.MOST_PROMISING)
    rolling_causes = _causes_of_rolling(workspace.data)
    names = {cause.name for cause in rolling_causes}
    promising = [cause for cause in promising if cause.name not in names] + rolling_causes
    smoother_base, promising_fits = choice.with_remaining_irregularity(workspace, base, promising)
    tests, normal, nulls = null_simulations.score_against_nulls(
        workspace, smoother_base, thresholds.MOST_NULL_SIMULATIONS, seed
    )
    tests = smallest.with_smallest(smallest.Planting(design, smoother_base, normal, nulls), tests)

    # the most likely cause
    fitted = choice.fit_significant(
        workspace, base, tests, thresholds.MOST_FITTED, ready=promising_fits
    )
    fitted = choice.add_ready_fits(base_deviance, fitted, promising_fits, normal, nulls)
    for ready in promising_fits:
        if ready.explanation.causes[-1].name in names:
            fitted = _with_rolling_cause(design, base_deviance, fitted, ready)
    explanation, causes, rejected = _choose_coherent(design, base_fit, fitted)

    # a second cause, and the remainder
    remainder: list[ScoreTest] | None = _smooth_functions(tests)
    if causes:
        found = choice.add_second_cause(workspace, explanation, causes, fitted, seed)
        explanation, causes, remainder, rejected = found
    unbiased = tuple(identified.unbiased for identified in causes)
    return _Search(
        explanation=explanation._replace(causes=unbiased),
        causes=causes,
        score_tests=tests,
        remainder=remainder,
        smoother_base=smoother_base,
        contradicted=() if rejected is None else (rejected,),
    )


def _causes_of_rolling(data: Dataset) -> list[Cause]:
    """Return the radius, and the scale of the sensor, that the rolling wheels of a wheelset show.

    The list is empty if all wheelsets are nearly alike. A radius that is wrong by more than the
    creepage at which adhesion is largest is far from what the linearised replay shows of it. While
    the brake is released, the wheels show it directly.
    """
    odd = rolling.odd_radius(data)
    if odd is None:
        return []
    fraction = 1.0 / (1.0 + odd.fraction) - 1.0
    return [
        Cause("wheel_radius", odd.axle, {}, (odd.fraction,)),
        Cause("sensor_scale", odd.axle, {}, (fraction,)),
    ]


def _with_rolling_cause(
    design: Design, base_deviance: float, fitted: list[Candidate], ready: BlockwiseFit
) -> list[Candidate]:
    """Return the candidates with the best fit that began at what the rolling wheels show.

    `ready` began at the fitted base, which explains the wrong radius by other parameters. So
    another fit begins at the untuned base. Null simulations on a base with a wrong radius do not
    show the errors of this estimate, so it has its nominal error and no bias.
    """
    untuned = candidates.untuned(design)._replace(causes=ready.explanation.causes)
    restarted = fitting.fit(design, untuned)
    if restarted.deviance < ready.deviance:
        blocks = choice.deviance_by_block(design, restarted.explanation)
        ready = BlockwiseFit(*restarted, blocks=blocks)
    cause = ready.explanation.causes[-1]
    ratio = base_deviance - ready.deviance
    was_solved = ready.covariance.size > 0
    if not was_solved or ratio < thresholds.CERTAIN_RATIO:
        return fitted
    test = ScoreTest(
        name=cause.name,
        axle=cause.axle,
        shape=cause.shape,
        estimate=cause.values,
        bias=(0.0,),
        deviation=(float(np.sqrt(ready.covariance[-1, -1])),),
        statistic=ratio,
        p_value=0.0,
        expected=1.0,
        spread=1.0,
        trials=design.axles,
    )
    others = [candidate for candidate in fitted if candidate.test.name != cause.name]
    return [*others, Candidate(test, ready)]


def _choose_coherent(
    design: Design, base_fit: fitting.Fit, fitted: list[Candidate]
) -> tuple[Explanation, list[IdentifiedCause], Contradicted | None]:
    """Return the explanation with the most likely cause, that cause, and None.

    If the most likely cause is sand without a trigger or a patch at several places, another cause
    takes its place only if it is nearly as likely. Else no cause is returned, and the contradicted
    one is.
    """
    base = base_fit.explanation
    explanation, causes = choice.choose(design, base, base_fit.deviance, fitted)
    explanation, causes = choice.refine_scales(design, explanation, causes)
    if not causes:
        return explanation, causes, None
    first = causes[0]
    rejected = coherence.of_window(design, explanation, 0, first.likelihood_ratio)
    if rejected is None:
        return explanation, causes, None

    others = [one for one in fitted if one.test.name != first.cause.name]
    explanation, causes = choice.choose(design, base, base_fit.deviance, others)
    explanation, causes = choice.refine_scales(design, explanation, causes)
    least = thresholds.CLEARLY_LESS_SHARE * first.likelihood_ratio
    if causes and causes[0].likelihood_ratio > least:
        ratio = causes[0].likelihood_ratio
        if coherence.of_window(design, explanation, 0, ratio) is None:
            return explanation, causes, None
    return base, [], rejected


def _without_common_brake(
    design: Design, base: Explanation, search: _Search
) -> tuple[_Search, list[Note]]:
    """Return the search without forces that brakes inside their calibration explain, and a note.

    All causes that act on the brake or on the vehicle are judged together, with the force on the
    vehicle that they leave, against brakes that vary in all wheelsets alike
    (`coherence.varying_brake`).
    """
    forces = [found for found in search.causes if coherence.is_force(found.cause.name)]
    on_vehicle = coherence.on_vehicle(search.remainder)
    if not forces and not on_vehicle:
        return search, []
    rival = coherence.varying_brake(
        design, base, search.explanation, [found.cause for found in search.causes], on_vehicle
    )
    if rival is None:
        return search, []

    note = Note(
        NoteCode.INSIDE_CALIBRATION,
        causes=tuple(found.cause.name for found in forces),
        remainder=on_vehicle[0] if on_vehicle else None,
        share=rival.share,
        tolerance=design.calibration,
        allowed=thresholds.IMMATERIAL_DEVIATIONS * design.calibration,
    )
    kept = [found for found in search.causes if not coherence.is_force(found.cause.name)]
    left = search.remainder
    if left is not None:
        # what the size of a dropped cause leaves goes with that cause
        sizes = tuple(f"in the size of {found.cause.name}" for found in forces)
        left = [test for test in left if test not in on_vehicle and not test.name.endswith(sizes)]
    elif not kept:
        # the stops that did not brake like the recording had only these causes
        left = []
    explanation = search.explanation._replace(causes=tuple(found.unbiased for found in kept))
    return search._replace(explanation=explanation, causes=kept, remainder=left), [note]


def _without_immaterial(design: Design, search: _Search) -> tuple[_Search, list[Note]]:
    """Return the search without what lies inside the declared calibration, and the notes on that.

    Such a cause changes the torque by no more than the dataset declares as its error. So does such
    a remaining force on the vehicle. It is no error of the model, however significant it is. A
    cause that acts on the vehicle was judged against such brakes before.
    """
    kept = []
    notes = []
    for place, found in enumerate(search.causes):
        mechanism = table.BY_NAME[found.cause.name].mechanism
        share = 0.0
        most = thresholds.IMMATERIAL_DEVIATIONS * design.calibration
        if mechanism.acts_on == TORQUE:
            share = stopping.torque_share(design, search.explanation, place)
        if 0.0 < share <= most:
            notes.append(
                Note(
                    NoteCode.IMMATERIAL,
                    causes=(found.cause.name,),
                    share=share,
                    tolerance=design.calibration,
                    allowed=most,
                )
            )
        else:
            kept.append(found)

    left = []
    for test in search.remainder or []:
        share = np.inf
        if test.name in (stopping.TIME, stopping.SPEED):
            share = stopping.remaining_force_share(design, test.name, test.estimate)
        most = thresholds.IMMATERIAL_DEVIATIONS * design.calibration
        is_immaterial = share <= most
        if is_immaterial and evidence.is_significant(test, thresholds.CLEAR_REMAINDER):
            note = Note(NoteCode.IMMATERIAL_REMAINDER, remainder=test, share=float(share))
            notes.append(note._replace(tolerance=design.calibration, allowed=most))
        else:
            left.append(test)
    if not notes:
        return search, []
    if search.remainder is not None:
        search = search._replace(remainder=left)
    unbiased = tuple(found.unbiased for found in kept)
    explanation = search.explanation._replace(causes=unbiased)
    return search._replace(explanation=explanation, causes=kept), notes


def _smooth_functions(tests: list[ScoreTest]) -> list[ScoreTest]:
    return [test for test in tests if evidence.is_smooth_function(test.name)]


def _notes_on_gain(held_out: Design | None, causes: list[IdentifiedCause]) -> list[Note]:
    """Return a note if the gain cannot be judged, since other runs do not show a cause's shape."""
    if held_out is None:
        return []
    names = [identified.score_test.name for identified in causes]
    hidden = [name for name in names if table.BY_NAME[name].unknown_in_other_runs]
    if not hidden:
        return []
    return [Note(NoteCode.GAIN_NOT_JUDGED, causes=(hidden[0],))]


def decide_verdict(
    causes: list[IdentifiedCause],
    remainder: list[ScoreTest] | None,
    measured_gain: Gain | None,
    contradicted: Sequence[Contradicted] = (),
) -> tuple[Verdict, list[Note]]:
    """Return the verdict on some causes, by what they leave and gain, with its notes.

    `contradicted` are causes that won enough and are another effect (`coherence`).
    """
    verdict, notes = _verdict_on(causes, remainder, measured_gain)
    notes += [_note_on(one) for one in contradicted]
    if not contradicted or verdict == Verdict.UNEXPLAINED:
        return verdict, notes
    if any(one.what is Contradiction.OTHER_FORCE for one in contradicted) or not causes:
        return Verdict.UNEXPLAINED, notes

    # what was no second cause is a remainder
    ratio = sum(identified.likelihood_ratio for identified in causes)
    share = max(one.likelihood_ratio for one in contradicted) / ratio
    if share > thresholds.PARTLY_SHARE:
        return Verdict.UNEXPLAINED, notes
    return (Verdict.PARTLY if share > thresholds.REMAINDER_SHARE else verdict), notes


def _note_on(contradicted: Contradicted) -> Note:
    """Return the note on a cause that is another effect."""
    code = NoteCode[contradicted.what.name]
    return Note(code, causes=(contradicted.cause.name,), contradicted=contradicted)


def _verdict_on(
    causes: list[IdentifiedCause], remainder: list[ScoreTest] | None, measured_gain: Gain | None
) -> tuple[Verdict, list[Note]]:
    """Return the verdict on some causes, as if nothing contradicted them, with its notes."""
    names = tuple(identified.score_test.name for identified in causes)
    if remainder is None:
        return Verdict.UNEXPLAINED, [Note(NoteCode.NOT_LIKE_RECORDING, causes=names)]

    left = [test for test in remainder if evidence.is_significant(test, thresholds.CLEAR_REMAINDER)]
    if not causes:
        return (Verdict.UNEXPLAINED if left else Verdict.CONSISTENT), []
    if left and len(causes) > 1 and all(coherence.is_force(name) for name in names):
        return Verdict.UNEXPLAINED, [Note(NoteCode.TWO_FORCES, causes=names, remainder=left[0])]
    if measured_gain is not None and measured_gain.likelihood < 0.0:
        return Verdict.UNEXPLAINED, [Note(NoteCode.WORSE_ON_HELD_OUT_RUNS, causes=names[:1])]

    swing = _remaining_swing(names, left)
    ratio = sum(identified.likelihood_ratio for identified in causes)
    if swing is not None and swing.statistic > thresholds.SWING_REMAINDER_SHARE * ratio:
        return Verdict.UNEXPLAINED, [Note(NoteCode.LARGE_REMAINDER, causes=names, remainder=swing)]

    # two causes that leave a third effect may be two wrong forms of a cause outside the library
    is_alone = len(causes) == 1
    own_covariates = _own_covariates(names) if is_alone else set()
    large = []
    for test in left:
        share = thresholds.REMAINDER_SHARE
        if test.name in own_covariates:
            share = thresholds.OWN_REMAINDER_SHARE
        if test.statistic > ratio * share:
            large.append(test)

    if large:
        if not is_alone or remainder_share(causes, large) > thresholds.PARTLY_SHARE:
            note = Note(NoteCode.LARGE_REMAINDER, causes=names, remainder=large[0])
            return Verdict.UNEXPLAINED, [note]
        return Verdict.PARTLY, []
    if left:
        return Verdict.EXPLAINED, [Note(NoteCode.SMALL_REMAINDER, remainder=left[0])]
    return Verdict.EXPLAINED, []


def _remaining_swing(names: tuple[str, ...], left: list[ScoreTest]) -> ScoreTest | None:
    """Return the largest remainder along the wheel angle behind a cause that swings once a turn.

    None: there is no such cause, or no remainder. The cause takes the whole swing of a load, so
    what is left is no load: a pole wheel off centre swings in the sensor, also without a brake.
    """
    if not any(table.BY_NAME[name].phase for name in names):
        return None
    swings = [test for test in left if test.name.startswith("along wheel_angle")]
    return max(swings, key=lambda test: test.statistic, default=None)


def _own_covariates(names: tuple[str, ...]) -> set[str]:
    """Return the smooth functions along which the shapes of some causes may differ."""
    covariates = set()
    for name in names:
        for covariate in table.BY_NAME[name].remainder_along:
            covariates.add(f"along {covariate}")
    return covariates


def remainder_share(causes: list[IdentifiedCause], remainder: list[ScoreTest]) -> float:
    """Return the evidence of the largest remainder over that of the causes and itself."""
    clear = [
        test for test in remainder if evidence.is_significant(test, thresholds.CLEAR_REMAINDER)
    ]
    most = max((test.statistic for test in clear), default=0.0)
    ratio = sum(identified.likelihood_ratio for identified in causes)
    return most / max(most + ratio, 1e-9)
