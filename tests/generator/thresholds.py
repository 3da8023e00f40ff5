"""Which limits of a verdict the answers to one generator would set, and how these judge the others.

    cd tests; python -m generator.thresholds            # the tables of docs/explain_rates.md
    cd tests; python -m generator.thresholds --judge    # after a limit has changed

`make docs` writes the same tables; --judge keeps the verdicts of changed limits. The kept answers
(`keep.py`) are judged again by the rule of `explain` itself, from what they contain: no stop is
replayed. Two kinds of limits are set by the answers to each generator, and by those to the first
and the second together:

- ALPHA_CAUSE, by sets with nothing hidden: the largest p-value that lets at most 2 % of them have a
  finding, with the present SCORE_FLOOR. A finding is not yet a cause, which must also win its fit,
  so this is on the safe side.
- REMAINDER_SHARE, OWN_REMAINDER_SHARE and PARTLY_SHARE, by sets with something hidden: among the
  limits that give at most 5 % of the effects outside the library a name, those that name most
  causes right.

A second table is on form_fraction of a dataset's accuracy: among those values whose sets have at
most 1.4 causes in the mean, on the first and on the second generator, the one that names most
single causes first or in a set of two.
"""

import itertools
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from generator import keep
from sealed import cases

from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.decide import coherence, decision, evidence
from rollerrig.rig.identify.decide import thresholds as decide_thresholds

LIMITS = ("REMAINDER_SHARE", "OWN_REMAINDER_SHARE", "PARTLY_SHARE")
# values that are tried: of each of LIMITS, of ALPHA_CAUSE, of form_fraction
SHARES = (0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
ALPHAS = np.geomspace(1e-6, 0.02, 44)
FORMS = (0.0, 0.02, 0.04, 0.07, 0.1, 0.13, 0.16, 0.2)
# the present values: ALPHA_CAUSE and LIMITS, form_fraction
PRESENT_LIMITS = tuple(getattr(decide_thresholds, name) for name in LIMITS)
FORM = next(row.default for row in dataset.ACCURACY if row.name == "form_fraction")
# requirements: share of sets with nothing hidden that have a finding, share of unknown effects
# with a name, mean size of the first set of a single cause
FALSE_FINDINGS = 0.02
NAMED_UNKNOWN = 0.05
LARGEST_SET = 1.4
SETTERS = "first and second"  # the third judges, and sets nothing
# heads of both tables
HEAD = (
    "| set on | ALPHA_CAUSE | "
    + " | ".join(LIMITS)
    + " | judged on | none: a finding | one: a finding | "
    "hidden: identified rightly | unknown: identified |"
)
FORM_HEAD = (
    "| form_fraction | answers to | the most likely, or one of two | identified, or an alternative "
    "| number of the most likely and its alternatives, mean |"
)
# sentences of an answer's notes that decide its verdict
NOT_LIKE_THE_RECORDING = "do not brake like the recording"
WORSE_ON_OTHER_RUNS = "makes runs that were not fitted worse"

# --- judging one answer again ---


class KeptAnswer:
    """An answer that is kept, ready to be judged by other limits; `truth`: the key of its set."""

    def __init__(self, truth: dict[str, Any], answer: dict[str, Any]):
        self.kind = truth["kind"]
        self.truth = set(truth["effects"])
        self.verdict = answer["verdict"]
        self.refused = answer["verdict"] == "refused"

        # score tests before a cause was fitted, and behind the causes
        findings = answer["findings"] or {"before": [], "behind": []}
        self.before, behind = (score_tests(found) for found in findings.values())
        notes = " ".join(answer["notes"])
        self.remainder = None if NOT_LIKE_THE_RECORDING in notes else behind
        self.gain = SimpleNamespace(likelihood=-1.0) if WORSE_ON_OTHER_RUNS in notes else None

        # causes that the answer names, or has set aside because its verdict names none
        causes = []
        for cause in answer["causes"]:
            causes.append(cause | {"likelihood": cause["evidence"]["likelihood"]})
        if not causes:
            causes = answer.get("set_aside", [])
        self.causes = [
            SimpleNamespace(
                likelihood_ratio=cause["likelihood"],
                score_test=SimpleNamespace(name=cause["name"]),
            )
            for cause in causes
        ]
        self.sets = [{cause["name"], *cause["confusable_with"]} for cause in causes]
        self.rivals = [cause["evidence"]["rivals"] for cause in answer["causes"]]

        # causes that won their fit and do not show the same everywhere
        self.contradicted = [
            coherence.Contradicted(
                cause=SimpleNamespace(name=found["name"]),
                likelihood_ratio=found["likelihood"],
                what=coherence.Contradiction[found["what"].upper()],
                windows=(),
            )
            for found in answer.get("contradicted", [])
        ]

    def verdict_by(self, limits: tuple[float, ...]) -> str:
        """Return the verdict of `explain` by these values of LIMITS."""
        if self.refused:
            return "refused"
        vars(decide_thresholds).update(zip(LIMITS, limits, strict=True))
        verdict, _ = decision.decide_verdict(
            self.causes, self.remainder, self.gain, self.contradicted
        )
        vars(decide_thresholds).update(zip(LIMITS, PRESENT_LIMITS, strict=True))
        return verdict

    def sets_named_by(self, limits: tuple[float, ...]) -> list[set[str]]:
        """Return the sets of the causes that are named by these limits."""
        return self.sets if self.verdict_by(limits) in ("explained", "partly") else []

    def is_right_by(self, limits: tuple[float, ...]) -> bool:
        """Return whether all hidden causes are named by these limits, and no other one."""
        sets = self.sets_named_by(limits)
        return len(sets) == len(self.truth) and self.truth <= set().union(*sets)

    def first_set_by(self, form: float) -> tuple[str | None, set[str]]:
        """Return the first cause, and its confusable ones if laws may be wrong by this share."""
        if not self.causes or self.verdict not in ("explained", "partly"):
            return None, set()
        first = self.causes[0].score_test.name
        other_causes = {cause.score_test.name for cause in self.causes[1:]}
        # a rival that the data distinguish from the first cause is confusable if laws may be wrong
        distinguished = set()
        alike = set()
        for rival in self.rivals[0]:
            if rival["parted"]:
                distinguished.add(rival["name"])
                if rival["share"] > 1.0 - form:
                    alike.add(rival["name"])
        confusable = self.sets[0] - {first} - distinguished
        return first, confusable | (alike - other_causes)

    def has_a_finding_by(self, alpha: float) -> bool:
        """Return whether a finding counts if ALPHA_CAUSE is alpha."""
        return any(
            evidence.is_significant(test._replace(p_value=test.p_value * table.ALPHA_CAUSE / alpha))
            for test in self.before
        )


def score_tests(findings: list[dict[str, Any]]) -> list[evidence.ScoreTest]:
    """Return the score tests of an answer, with what a verdict needs."""
    tests = []
    for finding in findings:
        tests.append(
            evidence.ScoreTest(
                name=finding["name"],
                axle=finding["axle"],
                shape={},
                estimate=tuple(finding["coefficients"]),
                bias=(),
                deviation=(),
                statistic=finding["statistic"],
                p_value=finding["p_value"],
                expected=0.0,
                spread=0.0,
            )
        )
    return tests


# --- limits that some answers would set ---


def limits_within(
    answers: list[KeptAnswer], most_named: float
) -> list[tuple[int, tuple[float, ...]]]:
    """Return (causes that are named right, limits) of all limits that are admissible.

    Admissible limits give a name to at most so many unknown effects, and REMAINDER_SHARE is the
    smallest.
    """
    hidden = [answer for answer in answers if answer.kind in ("one", "two")]
    unknown = [answer for answer in answers if answer.kind == "unknown"]
    result = []
    for limits in itertools.product(SHARES, repeat=3):
        remainder, own_remainder, partly = limits
        if remainder > min(own_remainder, partly):
            continue
        if sum(bool(answer.sets_named_by(limits)) for answer in unknown) <= most_named:
            right = sum(answer.is_right_by(limits) for answer in hidden)
            result.append((right, limits))
    return result


def set_by(answers: list[KeptAnswer]) -> tuple[float, tuple[float, ...]]:
    """Return ALPHA_CAUSE and LIMITS that these answers would set."""
    clean = [answer for answer in answers if answer.kind == "none"]
    unknown = [answer for answer in answers if answer.kind == "unknown"]
    alphas = []
    for alpha in ALPHAS:
        findings = sum(answer.has_a_finding_by(alpha) for answer in clean)
        if findings <= FALSE_FINDINGS * len(clean):
            alphas.append(alpha)

    found = limits_within(answers, NAMED_UNKNOWN * len(unknown))
    most_right = max(found)[0]
    equal = np.array([limits for right, limits in found if right == most_right])
    # of those that are equally good, the one in the middle
    distance = np.abs(equal - np.median(equal, axis=0)).sum(axis=1)
    return max(alphas, default=ALPHAS[0]), tuple(equal[np.argmin(distance)])


class FormCounts(NamedTuple):
    """How single causes that were detected are named with a form_fraction."""

    first: int  # named first, or in a set of two
    in_set: int  # in the first set
    of: int
    sizes: list[int]  # of the first sets


def by_form(answers: list[KeptAnswer], form: float) -> FormCounts:
    """Return the counts of some answers with a form_fraction."""
    first_or_in_two = 0
    in_set = 0
    detected = 0
    sizes = []
    for answer in answers:
        if answer.kind != "one" or answer.verdict in ("consistent", "refused"):
            continue
        detected += 1
        first, confusable = answer.first_set_by(form)
        in_two = len(confusable) == 1 and answer.truth <= confusable
        first_or_in_two += {first} == answer.truth or in_two
        in_set += answer.truth <= confusable | {first}
        if first:
            sizes.append(1 + len(confusable))
    return FormCounts(first_or_in_two, in_set, detected, sizes)


def form_set_by(*generators: list[KeptAnswer]) -> float:
    """Return the form_fraction that the answers to some generators would set."""
    admissible = []
    for form in FORMS:
        if all(np.mean(by_form(answers, form).sizes) <= LARGEST_SET for answers in generators):
            admissible.append(form)

    def right_names(form: float) -> int:
        return sum(by_form(answers, form).first for answers in generators)

    # of those that are equally good, the smallest
    return max(admissible, key=lambda form: (right_names(form), -form))


# --- kept answers ---


def folders() -> list[Path]:
    """Return the folders of kept answers, one per generator."""
    return sorted(path.parent for path in keep.KEPT.glob("*/key"))


def read(folder: Path) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Return the generator of a folder of kept answers, the key by set, and the answers by set."""
    key = cases.read_key(folder)
    answers = json.loads((folder / "explain.json").read_text(encoding="utf-8"))
    return key["generator"], key["sets"], answers


def judged_again(
    truth: dict[str, Any], answer: dict[str, Any], limits: tuple[float, ...]
) -> dict[str, Any]:
    """Return an answer with the verdict of these limits; the same answer if it has that verdict.

    If the new verdict names no cause, the causes are set aside, as `explain` does.
    """
    verdict = KeptAnswer(truth, answer).verdict_by(limits)
    if verdict == answer["verdict"]:
        return answer
    if verdict != "unexplained":
        if not answer["causes"]:
            sys.exit(
                "a cause that was set aside would be named: let explain answer its set again, "
                "and keep the answer with keep.py"
            )
        return answer | {"verdict": verdict}
    set_aside = [
        {
            "name": cause["name"],
            "likelihood": cause["evidence"]["likelihood"],
            "confusable_with": cause["confusable_with"],
        }
        for cause in answer["causes"]
    ]
    return answer | {"verdict": verdict, "causes": [], "set_aside": set_aside, "gain": {}}


def kept_answers() -> dict[str, list[KeptAnswer]]:
    """Return the kept answers by generator; exit if verdicts are not those of the present
    limits.
    """
    result = {}
    for folder in folders():
        generator, key, answers = read(folder)
        for name, answer in answers.items():
            if judged_again(key[name], answer, PRESENT_LIMITS) is not answer:
                sys.exit(
                    f"{generator}: the verdict on {name} is not that of the present limits; "
                    "run python -m generator.thresholds --judge in the folder tests"
                )
        result[generator] = [KeptAnswer(key[name], answer) for name, answer in answers.items()]
    return result


def judge() -> None:
    """Keep the verdicts of the present limits."""
    for folder in folders():
        _, key, answers = read(folder)
        judged = {}
        for name, answer in answers.items():
            judged[name] = judged_again(key[name], answer, PRESENT_LIMITS)
        keep.write(folder, judged)


# --- tables ---


def rows():
    """Yield the lines of the table: who sets which limits, and how these judge all answers."""
    answers_to = kept_answers()
    setters = dict(answers_to)
    setters[SETTERS] = [answer for name in SETTERS.split(" and ") for answer in answers_to[name]]
    set_limits = {"shipped": (table.ALPHA_CAUSE, PRESENT_LIMITS)}
    for name, answers in setters.items():
        set_limits[name] = set_by(answers)

    for name, (alpha, limits) in set_limits.items():
        for generator, answers in answers_to.items():
            none, one, two, unknown = (
                [answer for answer in answers if answer.kind == kind] for kind in cases.KINDS
            )
            cells = (
                name,
                f"{alpha:.2g}",
                *(f"{limit:g}" for limit in limits),
                generator,
                share(answer.has_a_finding_by(alpha) for answer in none),
                share(answer.has_a_finding_by(alpha) for answer in one),
                share(answer.is_right_by(limits) for answer in one + two),
                share(bool(answer.sets_named_by(limits)) for answer in unknown),
            )
            yield "| " + " | ".join(cells) + " |"


def share(hits):
    """Return the text of how many of how many are hits."""
    seen = list(hits)
    return f"{sum(seen)} of {len(seen)}"


def form_rows():
    """Yield the lines of the table of form_fraction."""
    for generator, answers in kept_answers().items():
        for form in FORMS:
            counts = by_form(answers, form)
            yield (
                f"| {form:g} | {generator} | {counts.first} of {counts.of} "
                f"| {counts.in_set} of {counts.of} | {np.mean(counts.sizes):.2f} |"
            )


if __name__ == "__main__":
    if "--judge" in sys.argv[1:]:
        judge()
    print(HEAD, "|" + "---|" * (len(LIMITS) + 7), *rows(), sep="\n")
    print(FORM_HEAD, "|---|---|---|---|---|", *form_rows(), sep="\n")
