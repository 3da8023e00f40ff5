"""Measures how often `explain` finds a cause of the smallest size that it states for a dataset.

    cd tests; python -m generator.smallest_rates FOLDER --generator first --sets 8

Answers fault-free sets of a generator first: their reports have the smallest size of each cause.
Then the same stops are made with one cause of this size, and of twice this size, and are answered
too. A cause is found if it is identified, or listed as an alternative. Only causes whose size means
the same in the generator and in the report are made. Prints the rates with Wilson's 95 % intervals.
The same command goes on after an interruption.
"""

import argparse
import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from scipy.stats import binomtest
from sealed import answers, cases, work

SEED = 960_000
MULTIPLES = (1.0, 2.0)
EXPLAIN = "explain"


class Planted(NamedTuple):
    """A cause that is made in the stops of a seed; an empty name: nothing."""

    seed: int
    cause: str = ""
    multiple: float = 0.0  # of the smallest size that the report of the fault-free stops states
    size: float = 0.0

    @property
    def file(self) -> str:
        return f"{self.seed}_{self.cause or 'none'}_{self.multiple:g}.json"


def main() -> None:
    """Answer fault-free sets and sets with a cause, and print the rates."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--generator", choices=("first", "second", "third"), default="first")
    parser.add_argument("--sets", type=int, default=8)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--causes", default="", help="separated by commas; default: all")
    given = parser.parse_args()

    make = cases.generator(given.generator)
    causes = given.causes.split(",") if given.causes else list(make.SAME_MEANING)
    unknown = set(causes) - set(make.SAME_MEANING)
    if unknown:
        parser.error(f"--causes: {', '.join(sorted(unknown))}; there are {list(make.SAME_MEANING)}")
    folder = given.folder / given.generator
    folder.mkdir(parents=True, exist_ok=True)
    found = rates(folder, given.generator, range(given.seed, given.seed + given.sets), causes)
    print(*table(found), sep="\n")


Rates = dict[tuple[str, float], list[bool]]


def rates(folder: Path, generator: str, seeds: range, causes: list[str]) -> Rates:
    """Return whether each cause of each multiple of its smallest size is found, for each seed."""
    fault_free = answered(folder, generator, [Planted(seed) for seed in seeds])
    make = cases.generator(generator)
    planted = []
    for nothing, answer in fault_free.items():
        stated = {one["name"]: one.get("detectability") for one in answer.get("screened", [])}
        for cause in causes:
            _, sign = make.SAME_MEANING[cause]
            for multiple in MULTIPLES:
                if stated.get(cause) is not None:
                    size = sign * multiple * stated[cause]
                    planted.append(Planted(nothing.seed, cause, multiple, size))
    found: Rates = {}
    for one, answer in answered(folder, generator, planted).items():
        names = {cause["name"] for cause in answer["causes"]}
        for cause in answer["causes"]:
            names.update(cause["confusable_with"])
        found.setdefault((one.cause, one.multiple), []).append(one.cause in names)
    return found


def answered(folder: Path, generator: str, planted: list[Planted]) -> dict[Planted, dict[str, Any]]:
    """Return the answers to sets; those that are in the folder are not computed again."""
    left = [one for one in planted if not (folder / one.file).exists()]
    for one, answer in work.all_of(partial(_answer, generator), left):
        (folder / one.file).write_text(json.dumps(answer), encoding="utf-8")
        names = ", ".join(cause["name"] for cause in answer["causes"])
        print(f"{one.file}: {one.size:.3g}: {answer['verdict']} {names}", flush=True)
    return {one: json.loads((folder / one.file).read_text(encoding="utf-8")) for one in planted}


def _answer(generator: str, one: Planted) -> tuple[Planted, answers.Answer]:
    """Make a set and return the answer of `explain`."""
    effects = {one.cause: one.size} if one.cause else {}
    with tempfile.TemporaryDirectory(prefix="rollerrig-planted-") as place:
        cases.generator(generator).make(Path(place, "set"), effects, one.seed)
        _, answer = answers.answer_one(Path(place), EXPLAIN, "set")
    return one, answer


def table(found: Rates) -> list[str]:
    """Return the lines of the table: a row by cause and multiple, and all causes together."""
    for multiple in MULTIPLES:
        everything = [hit for (_, of), hits in found.items() if of == multiple for hit in hits]
        found = {**found, ("all", multiple): everything}
    lines = [
        "| cause | times the smallest size | found | of | 95 % interval |",
        "|---|---|---|---|---|",
    ]
    for (cause, multiple), hits in sorted(found.items()):
        if hits:
            interval = binomtest(sum(hits), len(hits)).proportion_ci(method="wilson")
            lines.append(
                f"| {cause} | {multiple:g} | {sum(hits)} | {len(hits)} "
                f"| {interval.low:.2f} to {interval.high:.2f} |"
            )
    return lines


if __name__ == "__main__":
    main()
