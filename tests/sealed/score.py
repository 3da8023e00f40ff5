"""Judges answers against the key: how often a tool is right, each rate with its count and 95 % interval."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.benchmarks import figures
from sealed.answers import FOUND, Answer
from sealed.cases import KINDS

# a smaller gain than this share of the error is not worth a quotient
LEAST_POSSIBLE = 0.02
LONGEST_S = 20.0
HEAD = ("measure", "yes", "of", "share", "low", "high", "wanted")


class Judged(NamedTuple):
    """An answer beside what was hidden."""

    name: str
    kind: str
    hidden: dict[str, float]
    verdict: str
    sets: list[set[str]]  # each named cause with those that it is confused with
    first: str  # the cause that is named first, or nothing
    covered: bool | None
    reduction: float | None  # gain on runs never fitted, where it is claimed
    possible: float | None  # the same for a model that leaves only what noise leaves
    seconds: float | None

    @property
    def truth(self) -> set[str]:
        """The names of what was hidden."""
        return set(self.hidden)


def judged(key: dict[str, Any], answers: dict[str, Answer]) -> list[Judged]:
    """Each answer beside its set's key. Raises ConfigError for a set that the key does not have."""
    if strange := sorted(set(answers) - set(key["sets"])):
        raise ConfigError(
            f"answers to {', '.join(strange[:3])}: the benchmark has no such set; its sets are "
            f"{min(key['sets'])} to {max(key['sets'])}"
        )
    return [_judged(name, key["sets"][name], answers[name]) for name in sorted(answers)]


def _judged(name: str, truth: dict[str, Any], answer: Answer) -> Judged:
    covered = None
    for cause in answer["causes"]:
        if meant := truth["meaning"].get(cause["name"]):
            interval = cause["parameters"].get(meant[0])
            covered = (
                None
                if interval is None
                else bool(interval["ci95"][0] <= meant[1] <= interval["ci95"][1])
            )
    won = answer["gain"] if answer["gain"].get("claimed") else None
    possible = {
        metric: 1.0 - truth["least_error"][metric] / error
        for metric, error in truth["base_error"].items()
    }
    return Judged(
        name,
        truth["kind"],
        truth["effects"],
        answer["verdict"],
        [{c["name"], *c["confusable_with"]} for c in answer["causes"]],
        answer["causes"][0]["name"] if answer["causes"] else "",
        covered,
        won["reduction"] if won else None,
        # a gain without its metric is held against that in which most can be won
        possible.get(won["metric"])
        if won and "metric" in won
        else max(possible.values(), default=None),
        answer["elapsed_s"],
    )


def rows(found: list[Judged]) -> list[figures.Result]:
    """What is counted, and the share that is wanted."""
    kinds: dict[str, list[Judged]] = {kind: [f for f in found if f.kind == kind] for kind in KINDS}
    seen = [f for f in kinds["one"] if f.verdict in FOUND]
    named = [f for f in seen if f.sets]
    seconds = [f.seconds for f in found if f.seconds is not None]
    return [
        rate(
            "nothing hidden: consistent",
            ">= 0.98",
            (f.verdict == "consistent" for f in kinds["none"]),
        ),
        rate("one cause: detected", "", (f.verdict in FOUND for f in kinds["one"])),
        rate(
            "one cause: named first or in a set of two, of detected",
            ">= 0.97",
            (
                f.first in f.truth or (f.sets and len(f.sets[0]) == 2 and f.truth <= f.sets[0])
                for f in seen
            ),
        ),
        rate(
            "one cause: in the named set, of detected",
            ">= 0.99",
            (any(f.truth <= s for s in f.sets) for f in seen),
        ),
        _mean("one cause: size of the first set, mean", "<= 1.4", [len(f.sets[0]) for f in named]),
        rate("one cause: a false second cause", "<= 0.05", (len(f.sets) > 1 for f in kinds["one"])),
        rate(
            "two causes: both named",
            ">= 0.85",
            (f.truth <= set().union(*f.sets) and len(f.sets) == 2 for f in kinds["two"]),
        ),
        rate(
            "cause not in the library: given a name",
            "<= 0.05",
            (bool(f.sets) for f in kinds["unknown"]),
        ),
        rate(
            "cause not in the library: told as a remainder",
            "",
            (f.verdict in ("partly", "unexplained") for f in kinds["unknown"]),
        ),
        rate("data refused", "", (f.verdict == "refused" for f in found)),
        rate(
            "95 % intervals hold the truth",
            "0.88 to 0.99",
            (f.covered for f in found if f.covered is not None),
        ),
        _gain_row(found),
        rate(f"within {LONGEST_S:g} s", "all", (taken <= LONGEST_S for taken in seconds)),
    ]


def rate(measure: str, wanted: str, hits: Iterable[Any]) -> figures.Result:
    """A rate with Wilson's interval (Journal of the American Statistical Association 22, 1927)."""
    seen = list(map(bool, hits))
    low, high = (
        binomtest(sum(seen), len(seen)).proportion_ci(method="wilson") if seen else (None, None)
    )
    return {
        "measure": measure,
        "yes": sum(seen),
        "of": len(seen),
        "wanted": wanted,
        "share": sum(seen) / len(seen) if seen else None,
        "low": low,
        "high": high,
    }


def _mean(measure: str, wanted: str, values: list[int]) -> figures.Result:
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
    """Median share of the possible gain, with quartiles, over the sets where a gain is claimed and possible."""
    shares = [
        f.reduction / f.possible
        for f in found
        if f.reduction is not None and f.possible is not None and f.possible > LEAST_POSSIBLE
    ]
    low, middle, high = (
        map(float, np.quantile(shares, [0.25, 0.5, 0.75])) if shares else (None, None, None)
    )
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
    """A line for each set that was not told rightly: what was hidden, what was said."""
    lines = []
    for f in found:
        right = {
            "none": f.verdict == "consistent",
            "unknown": not f.sets,
            "one": len(f.sets) == 1 and f.truth <= f.sets[0],
            "two": len(f.sets) == 2 and f.truth <= set().union(*f.sets),
        }[f.kind]
        if not right:
            hidden = ", ".join(f"{name} {size:g}" for name, size in f.hidden.items()) or "nothing"
            said = " + ".join("/".join(sorted(s)) for s in f.sets)
            lines.append(f"{f.name}: hidden {hidden}; {f.verdict} {said}".rstrip())
    return lines
