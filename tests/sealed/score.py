"""Judges the answers of a tool against the key.

An answer *detects* when its verdict is explained, partly or unexplained. The *set* of a cause
is its name together with the names of its alternatives, in `confusable_with`. The causes of
an answer are in order, the most likely first. The measures, which answers each of them counts, and
what is a hit:

    nothing hidden: consistent
        of sets with nothing hidden; hit: the verdict is "consistent"
    one cause: detected
        of sets with one cause; hit: the answer detects
    one cause: it is the most likely, or one of two, of detected
        of sets with one cause that are detected; hit: the hidden cause is the first name, or the
        first set has two names and the hidden cause is one of them
    one cause: it is identified, or an alternative, of detected
        of the same sets; hit: the hidden cause is in the set of any cause of the answer
    one cause: number of the most likely cause and its alternatives, mean
        of the same sets, where the answer has a cause; the mean number of names in its first set
    one cause: a false second cause
        of sets with one cause; hit: the answer has more than one cause
    two causes: both identified
        of sets with two causes; hit: the answer has exactly two causes, and each hidden cause is in
        one of their sets
    effect outside the library: identified as a cause
        of sets with an effect that is not in the rig's table; hit: the answer has a cause
    effect outside the library: reported as a remainder
        of the same sets; hit: the verdict is "partly" or "unexplained"
    data refused
        of all sets; hit: the verdict is "refused"
    95 % intervals contain the true value
        of answers with an interval for a parameter that the key has too (`meaning`); hit: the
        interval contains the true value
    gain on runs never fitted, share of the possible: median, quartiles
        of answers that claim a gain where one is possible; claimed reduction over possible gain
    within 20 s
        of answers with a time; hit: it is at most LONGEST_S

The possible gain is 1 - least_error / base_error of the key: what a perfect model would gain. Sets
where it is at most `LEAST_POSSIBLE` do not count. If an answer does not name its metric, the metric
with the largest possible gain counts.

Every rate has its count and its 95 % interval (Wilson, Journal of the American Statistical
Association 22, 1927). `wanted` is the share that the project requires of `explain`.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.benchmarks import figures
from sealed.answers import DETECTED, Answer
from sealed.cases import KINDS

# a possible gain below this share of the error is too small to divide by
LEAST_POSSIBLE = 0.02
# seconds that an answer may take
LONGEST_S = 20.0
# keys of a measure, which are the heads of its table
HEAD = ("measure", "yes", "of", "share", "low", "high", "wanted")


class Judged(NamedTuple):
    """An answer, next to what was hidden."""

    name: str
    kind: str  # one of KINDS
    hidden: dict[str, float]  # size by name of the effect
    verdict: str
    sets: list[set[str]]  # of each cause: its name and the names that it is confused with
    first: str  # name of the first cause; empty where the answer has none
    covered: bool | None  # whether the interval holds the truth; None: there is nothing to compare
    reduction: float | None  # claimed gain on the stops that were never fitted; None: not claimed
    possible: float | None  # the gain of a perfect model, by the metric of the answer
    seconds: float | None

    @property
    def truth(self) -> set[str]:
        """The names of the hidden effects."""
        return set(self.hidden)

    @property
    def detected(self) -> bool:
        return self.verdict in DETECTED

    @property
    def named(self) -> set[str]:
        """All names in all sets of the answer."""
        return set().union(*self.sets)

    @property
    def names_both(self) -> bool:
        """Whether there are exactly two causes, and each hidden cause is in one of the sets."""
        return len(self.sets) == 2 and self.truth <= self.named

    @property
    def first_or_in_two(self) -> bool:
        """Whether the hidden cause is the first name, or one of the two names of the first set."""
        if self.first in self.truth:
            return True
        return bool(self.sets) and len(self.sets[0]) == 2 and self.truth <= self.sets[0]

    @property
    def in_a_set(self) -> bool:
        """Whether the hidden cause is in the set of any cause."""
        return any(self.truth <= names for names in self.sets)


def judged(key: dict[str, Any], answers: dict[str, Answer]) -> list[Judged]:
    """Return each answer next to the truth of its set. Raises ConfigError for an unknown set."""
    unknown = sorted(set(answers) - set(key["sets"]))
    if unknown:
        raise ConfigError(
            f"answers to {', '.join(unknown[:3])}: the benchmark has no such set; its sets are "
            f"{min(key['sets'])} to {max(key['sets'])}"
        )
    return [_judged(name, key["sets"][name], answers[name]) for name in sorted(answers)]


def _judged(name: str, truth: dict[str, Any], answer: Answer) -> Judged:
    causes = answer["causes"]
    gain = answer["gain"]
    claimed = bool(gain.get("claimed"))
    return Judged(
        name=name,
        kind=truth["kind"],
        hidden=truth["effects"],
        verdict=answer["verdict"],
        sets=[{cause["name"], *cause["confusable_with"]} for cause in causes],
        first=causes[0]["name"] if causes else "",
        covered=_covered(truth["meaning"], causes),
        reduction=gain["reduction"] if claimed else None,
        possible=_possible_gain(truth, gain if claimed else {}),
        seconds=answer["elapsed_s"],
    )


def _covered(meaning: dict[str, Any], causes: list[dict[str, Any]]) -> bool | None:
    """Return whether the answer's interval holds the true value; None without one to compare.

    `meaning`: (parameter, true value) by cause. Of two causes with an entry the last one counts.
    """
    covered = None
    for cause in causes:
        if cause["name"] not in meaning:
            continue
        parameter, value = meaning[cause["name"]]
        interval = cause["parameters"].get(parameter)
        if interval is None:
            covered = None
        else:
            low, high = interval["ci95"]
            covered = bool(low <= value <= high)
    return covered


def _possible_gain(truth: dict[str, Any], gain: dict[str, Any]) -> float | None:
    """Return the gain of a perfect model by the metric of the answer; None where it is unknown.

    Where the answer names no metric, the largest possible gain counts.
    """
    possible = {
        metric: 1.0 - truth["least_error"][metric] / error
        for metric, error in truth["base_error"].items()
    }
    if "metric" in gain:
        return possible.get(gain["metric"])
    return max(possible.values(), default=None)


def rows(found: list[Judged]) -> list[figures.Result]:
    """Return all measures, by the rules of the module's docstring, with the keys of `HEAD`."""
    of_kind = {kind: [answer for answer in found if answer.kind == kind] for kind in KINDS}
    none, one, two, unknown = (of_kind[kind] for kind in KINDS)
    detected = [answer for answer in one if answer.detected]
    with_a_cause = [answer for answer in detected if answer.sets]
    with_an_interval = [answer for answer in found if answer.covered is not None]
    times_s = [answer.seconds for answer in found if answer.seconds is not None]
    return [
        rate(
            "nothing hidden: consistent",
            ">= 0.98",
            [answer.verdict == "consistent" for answer in none],
        ),
        rate("one cause: detected", "", [answer.detected for answer in one]),
        rate(
            "one cause: it is the most likely, or one of two, of detected",
            ">= 0.97",
            [answer.first_or_in_two for answer in detected],
        ),
        rate(
            "one cause: it is identified, or an alternative, of detected",
            ">= 0.99",
            [answer.in_a_set for answer in detected],
        ),
        _mean(
            "one cause: number of the most likely cause and its alternatives, mean",
            "<= 1.4",
            [len(answer.sets[0]) for answer in with_a_cause],
        ),
        rate(
            "one cause: a false second cause",
            "<= 0.05",
            [len(answer.sets) > 1 for answer in one],
        ),
        rate("two causes: both identified", ">= 0.85", [answer.names_both for answer in two]),
        rate(
            "effect outside the library: identified as a cause",
            "<= 0.05",
            [bool(answer.sets) for answer in unknown],
        ),
        rate(
            "effect outside the library: reported as a remainder",
            "",
            [answer.verdict in ("partly", "unexplained") for answer in unknown],
        ),
        rate("data refused", "", [answer.verdict == "refused" for answer in found]),
        rate(
            "95 % intervals contain the true value",
            "0.88 to 0.99",
            [answer.covered for answer in with_an_interval],
        ),
        _gain_row(found),
        rate(
            f"within {LONGEST_S:g} s",
            "all",
            [time_s <= LONGEST_S for time_s in times_s],
        ),
    ]


def rate(measure: str, wanted: str, hits: Iterable[Any]) -> figures.Result:
    """Return a measure that counts hits, with Wilson's 95 % interval of its share."""
    seen = [bool(hit) for hit in hits]
    yes = sum(seen)
    share = low = high = None
    if seen:
        share = yes / len(seen)
        low, high = binomtest(yes, len(seen)).proportion_ci(method="wilson")
    return {
        "measure": measure,
        "yes": yes,
        "of": len(seen),
        "wanted": wanted,
        "share": share,
        "low": low,
        "high": high,
    }


def _mean(measure: str, wanted: str, values: list[int]) -> figures.Result:
    """Return a measure that is a mean."""
    return {
        "measure": measure,
        "yes": None,
        "of": len(values),
        "wanted": wanted,
        "low": None,
        "high": None,
        "share": float(np.mean(values)) if values else None,
    }


def _gain_row(found: list[Judged]) -> figures.Result:
    """Return the median share of the possible gain, with quartiles, where one is claimed."""
    shares = []
    for answer in found:
        if answer.reduction is None or answer.possible is None:
            continue
        if answer.possible > LEAST_POSSIBLE:
            shares.append(answer.reduction / answer.possible)

    low = middle = high = None
    if shares:
        low, middle, high = (float(share) for share in np.quantile(shares, [0.25, 0.5, 0.75]))
    return {
        "measure": "gain on runs never fitted, share of the possible: median, quartiles",
        "yes": None,
        "of": len(shares),
        "wanted": ">= 0.90",
        "share": middle,
        "low": low,
        "high": high,
    }


def failed(found: list[Judged]) -> list[str]:
    """Return one line for each set that is not answered right: what was hidden, and the answer.

    Right is: "consistent" where nothing is hidden, no cause where the effect is unknown, exactly
    one cause whose set holds the hidden one, or exactly two causes whose sets hold both.
    """
    lines = []
    for answer in found:
        if _is_right(answer):
            continue
        hidden = ", ".join(f"{name} {size:g}" for name, size in answer.hidden.items())
        causes = " + ".join("/".join(sorted(names)) for names in answer.sets)
        line = f"{answer.name}: hidden {hidden or 'nothing'}; {answer.verdict} {causes}"
        lines.append(line.rstrip())
    return lines


def _is_right(answer: Judged) -> bool:
    if answer.kind == "none":
        return answer.verdict == "consistent"
    if answer.kind == "unknown":
        return not answer.sets
    if answer.kind == "one":
        return len(answer.sets) == 1 and answer.truth <= answer.sets[0]
    return answer.names_both
