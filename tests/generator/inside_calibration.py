"""Judges forces that were hidden in the kept sets by the rule on brakes inside their calibration.

    cd tests; python -m generator.inside_calibration

The rule is that of `decision.py`: a cause that acts on the brake or on the vehicle is a note if
brakes that all vary in the same way, inside their calibration, are at least as likely. The kept
answers do not contain the stops. So this command makes each set again whose one hidden cause is
such a force, if the kept answer names forces. It fits the causes of the answer and applies the
rule. It prints each set, and for each cause and size how many sets the rule takes from it and the
largest share of the braking force among them.
"""

import tempfile
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from generator import thresholds
from sealed import cases, work

from rollerrig.rig.identify.causes import candidates, table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.decide import decision, fitting, stopping
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.mechanisms.mechanism import TORQUE, VEHICLE

STEPS = 5


class Job(NamedTuple):
    """A kept set to be judged."""

    generator: str
    name: str
    case: cases.Case
    answer: tuple[tuple[str, float], ...]  # name and size of each cause of the kept answer


class Judged(NamedTuple):
    """What the rule does with the causes of a set."""

    job: Job
    is_note: bool
    share: float  # the largest of its causes, of the braking force


def acts_on(name: str) -> str:
    """Return on what a cause acts; an empty text for an effect outside the library."""
    return table.BY_NAME[name].mechanism.acts_on if name in table.BY_NAME else ""


def is_force(name: str) -> bool:
    """Return whether a cause acts on the brake or on the vehicle."""
    return acts_on(name) in (TORQUE, VEHICLE)


def jobs() -> list[Job]:
    """Return the kept sets with one hidden force whose answers name forces only."""
    found = []
    for folder in thresholds.folders():
        generator, key, answers = thresholds.read(folder)
        make = cases.generator(generator)
        stream = cases.stream(make, cases.read_key(folder)["seed"])
        made = {f"set_{k:04d}": case for k, case in enumerate(islice(stream, len(key)), start=1)}
        for name, answer in answers.items():
            case = made.get(name)
            if case is None or case.kind != "one" or case.effects != key[name]["effects"]:
                continue
            named = [(cause["name"], _size(cause)) for cause in answer["causes"]]
            if named and all(is_force(cause) for cause in [*case.effects, *dict(named)]):
                found.append(Job(generator, name, case, tuple(named)))
    return sorted(found, key=lambda job: (sorted(job.case.effects.items()), job.generator))


def _size(cause: dict[str, Any]) -> float:
    return float(next(iter(cause["parameters"].values()))["value"])


def judge(job: Job) -> Judged:
    """Make a set again, fit the causes of its answer, and apply the rule."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "set")
        cases.generator(job.generator).make(folder, job.case.effects, job.case.seed)
        data = dataset.load(folder)
        design = prepare(data, data.group("tune"))
    base = fitting.fit(design, candidates.untuned(design)).explanation
    explanation = base
    for name, size in job.answer:
        explanation = with_best_shape(design, explanation, name, size)

    found = [_identified(cause) for cause in explanation.causes]
    search = decision._Search(explanation, found, [], [], base)
    _, notes = decision._without_common_brake(design, base, search)
    shares = []
    for place_of_cause, cause in enumerate(explanation.causes):
        measure = stopping.force_share
        if acts_on(cause.name) == TORQUE:
            measure = stopping.torque_share
        shares.append(measure(design, explanation, place_of_cause))
    return Judged(job, bool(notes), max(shares))


def with_best_shape(
    design: Design, explanation: Explanation, name: str, size: float
) -> Explanation:
    """Return the explanation with a cause more, in the shape and on the axles that fit best."""
    row = table.BY_NAME[name]
    fits = []
    for shape in row.shapes:
        for axle in row.axles:
            cause = Cause(name, axle, shape, (size,))
            tried = explanation._replace(causes=(*explanation.causes, cause))
            fits.append(fitting.fit(design, tried, STEPS))
    return min(fits, key=lambda fit: fit.deviance).explanation


def _identified(cause: Cause) -> IdentifiedCause:
    """Return a fitted cause as a search returns it, without the bias of null simulations."""
    test = ScoreTest(
        name=cause.name,
        axle=cause.axle,
        shape=cause.shape,
        estimate=cause.values,
        bias=(0.0,) * len(cause.values),
        deviation=(0.0,) * len(cause.values),
        statistic=0.0,
        p_value=0.0,
        expected=1.0,
        spread=1.0,
    )
    return IdentifiedCause(
        score_test=test,
        cause=cause,
        likelihood_ratio=0.0,
        ratio_by_filter=(0.0,) * 5,
        deviation=(0.0,) * len(cause.values),
        confusable=(),
        rivals=(),
    )


def main() -> None:
    """Judge the sets, and print them and the table."""
    judged: dict[tuple[str, str], list[Judged]] = {}
    for one in work.all_of(judge, jobs()):
        hidden = " ".join(f"{name} {size:g}" for name, size in one.job.case.effects.items())
        what = "a note" if one.is_note else "kept"
        print(f"{one.job.generator} {one.job.name}: {hidden}: {what}, {one.share:.2%}", flush=True)
        judged.setdefault((hidden, one.job.generator), []).append(one)

    print("| hidden | generator | a note | of | largest share of a note |", "|---|---|---|---|---|")
    for (hidden, generator), ones in judged.items():
        notes = [one.share for one in ones if one.is_note]
        largest = f"{max(notes):.2%}" if notes else ""
        print(f"| {hidden} | {generator} | {len(notes)} | {len(ones)} | {largest} |")


if __name__ == "__main__":
    main()
