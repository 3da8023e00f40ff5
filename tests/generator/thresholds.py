"""Which limits of a verdict one generator's answers would set, and how these judge the answers to the others.

    cd tests; python -m generator.thresholds            # the table of docs/explain.md, as `make docs` writes it
    cd tests; python -m generator.thresholds --judge    # after a limit was moved: keeps the verdicts that it makes

The kept answers (`keep.py`) are judged again by `explain`'s own rule from what they hold: no stop is replayed. Two
kinds of limits are set, by each generator's answers, and by those of the first and the second together:

- ALPHA_CAUSE, by sets with nothing hidden: the largest p-value that lets at most 2 % of them have a finding, with the
  present SCORE_FLOOR. A finding is not yet a cause, which must win its fit as well, so this is on the safe side.
- REMAINDER_SHARE, OWN_REMAINDER_SHARE and PARTLY_SHARE, by sets with something hidden: of the limits that give at most
  5 % of the effects outside the library a name, those that name most causes rightly.

A second table has form_fraction of a dataset's accuracy: of those whose sets have at most 1.4 causes in the mean, on
the first and on the second, the one that names most single causes first or in a set of two.
"""

import itertools
import json
import sys
from types import SimpleNamespace

import numpy as np
from generator import keep
from sealed import cases

from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.decide import decision, evidence
from rollerrig.rig.identify.decide import thresholds as decide_thresholds

SHARES = (0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
LIMITS = ("REMAINDER_SHARE", "OWN_REMAINDER_SHARE", "PARTLY_SHARE")
ALPHAS = np.geomspace(1e-6, 0.02, 44)
SHIPPED = (table.ALPHA_CAUSE, tuple(getattr(decide_thresholds, name) for name in LIMITS))
FORMS = (0.0, 0.02, 0.04, 0.07, 0.1, 0.13, 0.16, 0.2)
FORM = next(row.default for row in dataset.ACCURACY if row.name == "form_fraction")
LARGEST_SET = 1.4  # the first set of a single cause, mean
FORM_HEAD = "| form_fraction | answers to | named first or in a set of two | in the named set | size of the set, mean |"
SETTERS = "first and second"  # the third judges, and sets nothing
HEAD = (
    "| set on | ALPHA_CAUSE | "
    + " | ".join(LIMITS)
    + " | judged on | clean: a finding | one: a finding | "
    "hidden: named rightly | unknown: given a name |"
)


def score_tests(entries):
    """The score tests of a report's entries, with what a verdict needs of them."""
    tests = []
    for entry in entries:
        tests.append(
            evidence.ScoreTest(
                name=entry["name"],
                axle=entry["axle"],
                shape={},
                estimate=tuple(entry["coefficients"]),
                bias=(),
                deviation=(),
                statistic=entry["statistic"],
                p_value=entry["p_value"],
                expected=0.0,
                spread=0.0,
            )
        )
    return tests


class Told:
    """An answer, ready to be judged by other limits."""

    def __init__(self, truth, answer):
        self.kind = truth["kind"]
        self.truth = set(truth["effects"])
        self.verdict = answer["verdict"]
        self.refused = self.verdict == "refused"

        found = answer["findings"] or {"before": [], "behind": []}
        self.before = score_tests(found["before"])
        self.behind = score_tests(found["behind"])

        # causes that were fitted, reported or not
        fitted = [
            cause | {"likelihood": cause["evidence"]["likelihood"]} for cause in answer["causes"]
        ]
        if not fitted:
            fitted = answer.get("set_aside", [])
        self.causes = []
        for cause in fitted:
            test = SimpleNamespace(name=cause["name"])
            self.causes.append(
                SimpleNamespace(likelihood_ratio=cause["likelihood"], score_test=test)
            )
        self.sets = [{cause["name"], *cause["confusable_with"]} for cause in fitted]
        self.rivals = [cause["evidence"]["rivals"] for cause in answer["causes"]]

        # what the answer does not hold as a number follows from its notes
        notes = " ".join(answer["notes"])
        self.remainder = self.behind
        if "do not brake like the recording" in notes:
            self.remainder = None
        self.won = None
        if "makes runs that were not fitted worse" in notes:
            self.won = SimpleNamespace(likelihood=-1.0)

    def judged(self, limits):
        if self.refused:
            return "refused"
        vars(decide_thresholds).update(zip(LIMITS, limits, strict=True))
        verdict, _ = decision.decide_verdict(self.causes, self.remainder, self.won)
        vars(decide_thresholds).update(zip(LIMITS, SHIPPED[1], strict=True))
        return verdict

    def names(self, limits):
        """Sets of causes that are named by these limits."""
        return self.sets if self.judged(limits) in ("explained", "partly") else []

    def named(self, form):
        """(the cause named first, those that it is confused with) where laws may be wrong by this share."""
        if not self.causes or self.verdict not in ("explained", "partly"):
            return None, set()
        first = self.causes[0].score_test.name
        nearly = {one["name"]: one["share"] > 1.0 - form for one in self.rivals[0] if one["parted"]}
        others = {one.score_test.name for one in self.causes[1:]}
        return first, {one for one in self.sets[0] - {first} if one not in nearly} | {
            one for one, alike in nearly.items() if alike
        } - others

    def right(self, limits):
        found = self.names(limits)
        return len(found) == len(self.truth) and self.truth <= set().union(*found)

    def alarm(self, alpha):
        """Whether a finding counts where causes may be as unlikely as alpha."""
        return any(
            evidence.is_significant(f._replace(p_value=f.p_value * table.ALPHA_CAUSE / alpha))
            for f in self.before
        )


def share(hits):
    hits = list(hits)
    return f"{sum(hits)} of {len(hits)}"


def rightly(told, most_named):
    """(how many causes are named rightly, limits) of all limits that name at most so many unknown effects."""
    hidden = [t for t in told if t.kind in ("one", "two")]
    unknown = [t for t in told if t.kind == "unknown"]
    return [
        (sum(t.right(limits) for t in hidden), limits)
        for limits in itertools.product(SHARES, repeat=3)
        if limits[0] <= min(limits[1:])
        and sum(bool(t.names(limits)) for t in unknown) <= most_named
    ]


def set_by(told):
    """(alpha, limits) that these answers would set."""
    clean, unknown = ([t for t in told if t.kind == kind] for kind in ("none", "unknown"))
    fits = [a for a in ALPHAS if sum(t.alarm(a) for t in clean) <= 0.02 * len(clean)]
    found = rightly(told, 0.05 * len(unknown))
    equal = np.array([limits for right, limits in found if right == max(found)[0]])
    # of those that are equally good the one in the middle
    middle = tuple(equal[np.argmin(np.abs(equal - np.median(equal, axis=0)).sum(axis=1))])
    return max(fits, default=ALPHAS[0]), middle


def by_form(told, form):
    """(named first or in a set of two, in the set, of how many that were detected; sizes of sets) of single causes."""
    seen = [
        (*t.named(form), t.truth)
        for t in told
        if t.kind == "one" and t.verdict not in ("consistent", "refused")
    ]
    sizes = [1 + len(others) for first, others, _ in seen if first]
    return (
        sum(
            {first} == truth or (len(others) == 1 and truth <= others)
            for first, others, truth in seen
        ),
        sum(truth <= others | {first} for first, others, truth in seen),
        len(seen),
        sizes,
    )


def form_set_by(*natures):
    """The form_fraction that the answers to some generators would set."""
    fits = [
        form
        for form in FORMS
        if all(np.mean(by_form(told, form)[3]) <= LARGEST_SET for told in natures)
    ]
    return max(fits, key=lambda form: (sum(by_form(told, form)[0] for told in natures), -form))


def read(folder):
    """The generator of a folder of kept answers, what was hidden by set, and the answers."""
    key = cases.read_key(folder)
    return (
        key["generator"],
        key["sets"],
        json.loads((folder / "explain.json").read_text(encoding="utf-8")),
    )


def judged_again(truth, answer, limits):
    """An answer with the verdict of other limits; without one, causes are set aside, as `explain` does."""
    verdict = Told(truth, answer).judged(limits)
    if verdict == answer["verdict"]:
        return answer
    if verdict != "unexplained":
        if not answer["causes"]:
            sys.exit("a cause that was set aside would be named: its set is to be answered anew")
        return answer | {"verdict": verdict}
    aside = [
        {
            "name": one["name"],
            "likelihood": one["evidence"]["likelihood"],
            "confusable_with": one["confusable_with"],
        }
        for one in answer["causes"]
    ]
    return answer | {"verdict": verdict, "causes": [], "set_aside": aside, "gain": {}}


def natures():
    """Kept answers by generator, ready to be judged. SystemExit where verdicts are of other limits than the present."""
    found = {}
    for folder in sorted(path.parent for path in keep.KEPT.glob("*/key")):
        name, truth, given = read(folder)
        changed = [
            one
            for one in given
            if judged_again(truth[one], given[one], SHIPPED[1]) is not given[one]
        ]
        if changed:
            sys.exit(
                f"{name}: {len(changed)} verdicts are not of the limits as they stand ({changed[0]}): --judge"
            )
        found[name] = [Told(truth[one], answer) for one, answer in given.items()]
    return found


def judge():
    """Keep the verdicts of the limits as they stand."""
    for folder in sorted(path.parent for path in keep.KEPT.glob("*/key")):
        _, truth, given = read(folder)
        keep.write(
            folder,
            {one: judged_again(truth[one], answer, SHIPPED[1]) for one, answer in given.items()},
        )


def rows():
    """Lines of the table: whose answers set the limits, which, and how these judge everybody's answers."""
    told = natures()
    by = told | {SETTERS: [t for name in SETTERS.split(" and ") for t in told[name]]}
    for name, (alpha, limits) in (
        {"shipped": SHIPPED} | {one: set_by(by[one]) for one in by}
    ).items():
        for on, answers in told.items():
            of = {kind: [t for t in answers if t.kind == kind] for kind in cases.KINDS}
            row = (
                name,
                f"{alpha:.2g}",
                *(f"{v:g}" for v in limits),
                on,
                share(t.alarm(alpha) for t in of["none"]),
                share(t.alarm(alpha) for t in of["one"]),
                share(t.right(limits) for t in of["one"] + of["two"]),
                share(bool(t.names(limits)) for t in of["unknown"]),
            )
            yield "| " + " | ".join(row) + " |"


def form_rows():
    """Lines of the table of form_fraction."""
    for (name, told), form in itertools.product(natures().items(), FORMS):
        first, within, of, sizes = by_form(told, form)
        yield f"| {form:g} | {name} | {first} of {of} | {within} of {of} | {np.mean(sizes):.2f} |"


if __name__ == "__main__":
    if "--judge" in sys.argv[1:]:
        judge()
    print(HEAD, "|" + "---|" * (len(LIMITS) + 7), *rows(), sep="\n")
    print(FORM_HEAD, "|---|---|---|---|---|", *form_rows(), sep="\n")
