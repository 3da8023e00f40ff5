"""`rollerrig bench explain`: how often `explain` is right on sets with known hidden effects.

The sets, their key and the answers stay in a folder. The same command continues after an
interruption, and a larger --sets adds sets to those that are there. `rollerrig score` judges the
answers of any tool to the same sets.
"""

import argparse
from pathlib import Path

from rich.table import Table
from sealed import answers, cases, score

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say


def run(given: argparse.Namespace, say: Say) -> Result:
    """Make the sets, let the requested tool answer them, and return the measures of `judge`.

    With --export only the sets and the key are made. Raises ConfigError.
    """
    if given.sets < 0 or given.seed < 0:
        raise ConfigError(
            f"--sets {given.sets}, --seed {given.seed}: both must be 0 or more; "
            "--sets 0 means one round of the matrix"
        )
    default = Path("reports", f"bench_explain_{given.generator}_{given.seed}")
    folder = given.export or given.folder or default
    cases.export(folder, given.generator, given.sets, given.seed, say)
    if given.export:
        return {
            "rows": [],
            "title": f"sets in {folder / cases.SETS}, key: {folder / cases.KEY}",
            "notes": [f"judge answers with: rollerrig score {folder} ANSWERS"],
        }

    answered = answers.answer(folder, given.tool, say, given.alone)
    result = judge(folder, answered)
    result["notes"].append(f"sets, key and answers: {folder}")
    return result


def judge(folder: Path, of: Path) -> Result:
    """Return the measures of the answers in `of`, a file or a folder, to the sets of `folder`.

    `rows` has the measures of `score.rows`, and `notes` one line for each set that is not answered
    right. Raises ConfigError where the key or the answers cannot be read.
    """
    key = cases.read_key(folder)
    judged = score.judged(key, answers.read(of))
    seconds = figures.quantiles([one.seconds for one in judged if one.seconds is not None])

    notes = [f"not answered right: {line}" for line in score.failed(judged)]
    unanswered = len(key["sets"]) - len(judged)
    if unanswered:
        notes.append(f"{unanswered} of {len(key['sets'])} sets have no answer")
    if seconds:
        notes.append(f"seconds per set: median {seconds['p50']:.0f}, longest {seconds['max']:.0f}")
    return {
        "sets": len(judged),
        "generator": key["generator"],
        "title": f"{of.stem} on {len(judged)} sets with known hidden effects, "
        f"{key['generator']} generator",
        "rows": score.rows(judged),
        "seconds": seconds,
        "notes": notes,
    }


def table(result: Result) -> Table:
    """Return the table of the measures, with counts and 95 % intervals."""
    rows = [[row[key] for key in score.HEAD] for row in result["rows"]]
    return figures.table(result["title"], score.HEAD, rows)
