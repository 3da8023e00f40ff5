"""Diagnoses as `explain` returns them, of causes that a test gives."""

from collections.abc import Sequence

from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data.preparation import prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.decision import Diagnosis, Verdict
from rollerrig.rig.identify.decide.evidence import ScoreTest


def score_test(cause: Cause, deviation: float = 1e-6, p_value: float = 0.001) -> ScoreTest:
    """Return the significant test of a cause; each coefficient has this standard deviation."""
    return ScoreTest(
        name=cause.name,
        axle=cause.axle,
        shape=cause.shape,
        estimate=cause.values,
        bias=(0.0,) * len(cause.values),
        deviation=(deviation,) * len(cause.values),
        statistic=99.0,
        p_value=p_value,
        expected=1.0,
        spread=1.0,
    )


def identified(cause: Cause, confusable: Sequence[str] = ()) -> IdentifiedCause:
    """Return a cause that the data support; `confusable` are those that look like it."""
    test = score_test(cause)
    return IdentifiedCause(
        score_test=test,
        cause=cause,
        likelihood_ratio=99.0,
        ratio_by_filter=(99.0,) * 5,
        deviation=test.deviation,
        confusable=tuple(confusable),
        rivals=(),
    )


def diagnosis(
    data: Dataset,
    causes: Sequence[IdentifiedCause],
    score_tests: Sequence[ScoreTest] = (),
    runs: int | None = None,
) -> Diagnosis:
    """Return the diagnosis of a dataset with these causes, on the untuned base model.

    It is consistent without causes, and else explained. `runs` is how many runs are prepared: all
    that are to be fitted, or fewer.
    """
    design = prepare(data, data.group("tune")[:runs])
    base = candidates.untuned(design)
    final = base._replace(causes=tuple(found.cause for found in causes))
    return Diagnosis(
        data=data,
        design=design,
        held_out=None,
        base=base,
        final=final if causes else base,
        verdict=Verdict.EXPLAINED if causes else Verdict.CONSISTENT,
        causes=list(causes),
        set_aside=[],
        score_tests=list(score_tests),
        remainder=[],
        gain=None,
        p_value=0.001,
        notes=[],
        formula=None,
        elapsed_s=1.0,
    )
