"""Explains a dataset: fit the base, judge every cause, fit those that count, check what is left.

The order is the argument: first the base gets its best chance; then clean sets of the same design
say what is ordinary; a cause is taken when it is beyond that, alone or beside those that cannot be
told from it; then the remainder is judged again in the same way, with the cause in the clean sets.
"""

import time
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.causes import candidates, table
from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide import (
    choice,
    empirical,
    evidence,
    fitting,
    gain,
    null_simulations,
)
from rollerrig.rig.identify.decide.empirical import EmpiricalFormula
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.gain import Gain
from rollerrig.rig.identify.replay import sensitivity

CLEAN_SETS, MOST_PROMISING, MOST_FITTED = 60, 4, 5
# a remainder above this share of the causes' likelihood is not a matter of their shape, unless it
# lies along what the cause itself goes by: there its shape may differ more
REMAINDER_SHARE, OWN_REMAINDER_SHARE = 0.08, 0.2
PARTLY_SHARE = 0.15  # up to here a cause is named beside the remainder: "partly"


class Diagnosis(NamedTuple):
    """All that was found about braking runs."""

    data: Dataset
    design: Design
    held: Design | None
    base: Explanation
    final: Explanation
    verdict: str
    causes: list[choice.IdentifiedCause]
    set_aside: list[
        choice.IdentifiedCause
    ]  # fitted, and not named: what remains behind them is too much
    findings: list[ScoreTest]
    remainder: list[ScoreTest]
    gain: Gain | None
    p_value: float
    notes: list[str]
    unknown: EmpiricalFormula | None
    elapsed_s: float


def explain_braking_runs(
    data: Dataset, seed: int, progress: null_simulations.Progress
) -> Diagnosis:
    """The account of a set of braking runs. Raises ConfigError where nothing can be concluded."""
    from threadpoolctl import threadpool_limits

    began = time.monotonic()
    with threadpool_limits(1), null_simulations.worker_pool() as pool:
        measured = data.group("tune")
        design = prepare(data, measured)
        setting = null_simulations.Workspace(data, measured, design, pool, progress)
        progress("fit of the base", 0.0)
        base, value, _ = fitting.fit(design, candidates.untuned(design))
        progress("fit of the base", 1.0)
        _check(design, base)
        likely = evidence.most_promising(
            design, fitting.normal_equations(design, base)[0], MOST_PROMISING
        )
        quiet, promising = choice.with_remaining_irregularity(setting, base, likely)
        found, scored, nulls = null_simulations.score_against_nulls(
            setting, quiet, CLEAN_SETS, seed
        )
        rivals = choice.fit_significant(setting, base, found, MOST_FITTED, promising)
        rivals = choice.add_ready_fits(value, rivals, promising, scored, nulls)
        explanation, causes = choice.refine_scales(
            design, *choice.choose(design, base, value, rivals)
        )
        remainder: list[ScoreTest] | None = [
            f for f in found if evidence.is_smooth_function(f.name)
        ]
        if causes:
            explanation, causes, remainder = choice.add_second_cause(
                setting, explanation, causes, rivals, seed
            )
        explanation = explanation._replace(causes=tuple(named.unbiased for named in causes))
        held = prepare(data, data.group("validate")) if data.group("validate") else None
        notes = list(data.warnings)
        won = _gain(held, base, explanation, causes, seed, notes)
        verdict, formula, set_aside = _verdict(causes, remainder, won, notes), None, []
        if verdict not in ("explained", "partly"):
            causes, set_aside, explanation, won = [], causes, base, None
        if verdict == "unexplained":
            progress("formula", 0.0)
            formula = empirical.find(
                design, held, quiet, [f for f in found if evidence.is_smooth_function(f.name)], seed
            )
            progress("formula", 1.0)
        if formula is not None:
            explanation, won = formula.explanation, formula.gain
    p_value = min([f.p_value for f in found], default=1.0)
    return Diagnosis(
        data,
        design,
        held,
        base,
        explanation,
        verdict,
        causes,
        set_aside,
        found,
        remainder or [],
        won,
        float(1.0 - (1.0 - p_value) ** 30),
        notes,
        formula,
        time.monotonic() - began,
    )


def _check(design: Design, base: Explanation) -> None:
    nu, S, *_ = sensitivity.innovations(design, candidates.inputs(design, base))
    spread = float(np.median(nu * nu / S) / 0.455)
    if spread > 2.5 or spread < 0.3:
        raise ConfigError(
            f"the innovations have {spread:.2g} times the variance that the declared accuracy allows (1 "
            "is right, 0.3 to 2.5 is accepted): correct [accuracy] in dataset.toml, or leave its values "
            "out to have them estimated"
        )


def _gain(
    held: Design | None,
    base: Explanation,
    explanation: Explanation,
    causes: list[choice.IdentifiedCause],
    seed: int,
    notes: list[str],
) -> Gain | None:
    hidden = [
        what
        for named in causes
        if (what := table.BY_NAME[named.finding.name].unknown_in_other_runs)
    ]
    if held is not None and hidden:
        notes.append(
            f"{hidden[0]} not known for the runs that were not fitted: the gain cannot be judged there"
        )
    return (
        None
        if held is None or hidden or not causes
        else gain.measure(held, base, explanation, seed)
    )


def _verdict(
    causes: list[choice.IdentifiedCause],
    remainder: list[ScoreTest] | None,
    won: Gain | None,
    notes: list[str],
) -> str:
    """consistent, explained, partly or unexplained; a small remainder becomes a note."""
    if remainder is None:
        told = " and ".join(named.finding.name for named in causes)
        notes.append(f"simulated stops with {told} do not brake like the recording: not named")
        return "unexplained"
    left = [f for f in remainder if evidence.is_significant(f, 20.0)]
    if not causes:
        return "unexplained" if left else "consistent"
    if won is not None and won.likelihood < 0.0:
        notes.append(
            f"{causes[0].finding.name} would fit the tuning runs but makes runs that were "
            "not fitted worse: not named"
        )
        return "unexplained"
    total = sum(named.ratio for named in causes)
    # two causes that leave a third thing may be what two forms make of one that the library does not have
    alone = len(causes) == 1
    own = {
        f"along {name}"
        for named in causes
        if alone
        for name in table.BY_NAME[named.finding.name].remainder_along
    }
    much = [
        f
        for f in left
        if f.statistic > total * (OWN_REMAINDER_SHARE if f.name in own else REMAINDER_SHARE)
    ]
    if much and (not alone or remainder_share(causes, much) > PARTLY_SHARE):
        notes.append(
            f"behind {' and '.join(named.finding.name for named in causes)} much remains along "
            f"{evidence.against(much[0])}: the cause, or its form, is not in the library"
        )
        return "unexplained"
    if left and not much:
        notes.append(f"a small part remains along {evidence.against(left[0])}")
    return "partly" if much else "explained"


def remainder_share(causes: list[choice.IdentifiedCause], remainder: list[ScoreTest]) -> float:
    """Likelihood that the largest remainder would win, over that of the causes and itself."""
    most = max((f.statistic for f in remainder if evidence.is_significant(f, 20.0)), default=0.0)
    return most / max(most + sum(named.ratio for named in causes), 1e-9)
