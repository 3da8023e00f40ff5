"""Measures how often `explain` is right on stops with realistic sensors, brakes and rails.

    cd tests; python -m generator.discrepancy_rates FOLDER --generator second --sets 24
    cd tests; python -m generator.discrepancy_rates FOLDER --kinds "pulses timed" --causes

Makes sets of each kind of `conditions.KINDS` with nothing hidden, or with --causes one cause in
each, lets `explain` answer them, and prints the rates with Wilson's 95 % intervals and the sets
that are not answered right. The sets and answers stay in FOLDER, and the same command goes on after
an interruption. --again answers all sets anew.
"""

import argparse
import itertools
import json
from functools import partial
from pathlib import Path
from typing import Any

from generator.conditions import KINDS
from scipy.stats import binomtest
from sealed import answers, cases, work

# generators that know conditions
GENERATORS = ("second", "third")
SEED = 710_000
SEEDS_PER_KIND = 1_000
EXPLAIN = "explain"


def main() -> None:
    """Make the sets, let `explain` answer them, and print the rates."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--generator", choices=GENERATORS, default="second")
    parser.add_argument("--sets", type=int, default=24, help="of each kind")
    parser.add_argument("--kinds", default=",".join(KINDS), help="separated by commas")
    parser.add_argument("--causes", action="store_true", help="one cause in each set")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--again", action="store_true", help="answer all sets anew")
    given = parser.parse_args()

    wanted = given.kinds.split(",")
    unknown = set(wanted) - set(KINDS)
    if unknown:
        parser.error(f"--kinds: {', '.join(sorted(unknown))}; there are {', '.join(KINDS)}")
    lines = []
    failed: list[str] = []
    for kind in wanted:
        hidden = hidden_effects(given.generator, given.sets, given.causes)
        folder = given.folder / given.generator / kind.replace(" ", "_")
        folder /= "one_cause" if given.causes else "none"
        seed = given.seed + SEEDS_PER_KIND * list(KINDS).index(kind)
        judged = answer(folder, given.generator, kind, hidden, seed, given.again)
        lines += rows(kind, judged)
        failed += failures(kind, judged)
    print(
        "| conditions | measure | yes | of | share | 95 % interval |", "|---|---|---|---|---|---|"
    )
    print(*lines, sep="\n")
    print(*failed, sep="\n")


def hidden_effects(generator: str, sets: int, causes: bool) -> list[dict[str, float]]:
    """Return what is hidden in each set: nothing, or each cause in turn at two sizes."""
    if not causes:
        return [{}] * sets
    make = cases.generator(generator)
    one = []
    for multiple, (cause, smallest) in itertools.product(cases.SIZES[::-1], make.SMALLEST.items()):
        one.append({cause: min(multiple * smallest, make.LARGEST.get(cause, float("inf")))})
    return list(itertools.islice(itertools.cycle(one), sets))


Job = tuple[str, dict[str, float], int]


def answer(
    folder: Path,
    generator: str,
    kind: str,
    hidden: list[dict[str, float]],
    seed: int,
    again: bool,
) -> dict[str, tuple[dict[str, float], dict[str, Any]]]:
    """Return what is hidden in each set, and the answer of `explain`, by the name of the set."""
    out = folder / answers.ANSWERS
    out.mkdir(parents=True, exist_ok=True)
    jobs: dict[str, Job] = {}
    for number, effects in enumerate(hidden):
        name = f"{number:03d}_{'_'.join(effects) or 'none'}"
        jobs[name] = (name, effects, seed + number)
    left = [job for name, job in jobs.items() if again or not (out / f"{name}.json").exists()]
    for name, one in work.all_of(partial(_answer_one, folder, generator, kind), left):
        (out / f"{name}.json").write_text(json.dumps(one), encoding="utf-8")
        causes = ", ".join(cause["name"] for cause in one["causes"])
        print(f"{kind}: {name}: {one['verdict']} {causes}", flush=True)
    judged = {}
    for name, (_, effects, _) in jobs.items():
        judged[name] = (effects, json.loads((out / f"{name}.json").read_text(encoding="utf-8")))
    return judged


def _answer_one(folder: Path, generator: str, kind: str, job: Job) -> tuple[str, answers.Answer]:
    """Make a set unless it is there, and return its name and the answer of `explain`."""
    name, effects, seed = job
    sets = folder / cases.SETS
    if not (sets / name / "dataset.toml").exists():
        make = cases.generator(generator)
        make.make(sets / name, effects, seed, conditions=KINDS[kind])
    return answers.answer_one(sets, EXPLAIN, name)


def rows(kind: str, judged: dict[str, tuple[dict[str, float], dict[str, Any]]]) -> list[str]:
    """Return the lines of the table: a measure, how often, of how many, and the interval."""
    nothing = [one for effects, one in judged.values() if not effects]
    hidden = [(effects, one) for effects, one in judged.values() if effects]
    lines = []
    if nothing:
        consistent = [one["verdict"] == "consistent" for one in nothing]
        named = [bool(one["causes"]) for one in nothing]
        lines.append(_row(kind, "nothing hidden: consistent", consistent))
        lines.append(_row(kind, "nothing hidden: a cause is reported", named))
    if hidden:
        detected = [pair for pair in hidden if pair[1]["verdict"] in answers.DETECTED]
        first = [_is_first_or_in_two(effects, one) for effects, one in detected]
        second = [len(one["causes"]) > 1 for _, one in hidden]
        lines.append(_row(kind, "one cause: detected", [pair in detected for pair in hidden]))
        lines.append(
            _row(kind, "one cause: it is the most likely, or one of two, of detected", first)
        )
        lines.append(_row(kind, "one cause: a false second cause", second))
    return lines


def _row(kind: str, measure: str, hits: list[bool]) -> str:
    if not hits:
        return f"| {kind} | {measure} | 0 | 0 | | |"
    interval = binomtest(sum(hits), len(hits)).proportion_ci(method="wilson")
    share = sum(hits) / len(hits)
    return (
        f"| {kind} | {measure} | {sum(hits)} | {len(hits)} | {share:.3f} "
        f"| {interval.low:.3f} to {interval.high:.3f} |"
    )


def _is_first_or_in_two(effects: dict[str, float], one: dict[str, Any]) -> bool:
    """Return whether the hidden cause is named first, or in a first set of two."""
    if not one["causes"]:
        return False
    first = one["causes"][0]
    names = {first["name"], *first["confusable_with"]}
    return first["name"] in effects or (len(names) == 2 and set(effects) <= names)


def failures(kind: str, judged: dict[str, tuple[dict[str, float], dict[str, Any]]]) -> list[str]:
    """Return a line for each set that is not answered right."""
    lines = []
    for name, (effects, one) in judged.items():
        names = [cause["name"] for cause in one["causes"]]
        is_right = one["verdict"] == "consistent"
        if effects:
            is_right = _is_first_or_in_two(effects, one) and len(names) == 1
        if not is_right:
            notes = "; ".join(one["notes"])
            lines.append(f"not answered right: {kind}, {name}: {one['verdict']} {names} {notes}")
    return lines


if __name__ == "__main__":
    main()
