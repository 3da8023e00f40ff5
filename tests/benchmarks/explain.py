"""How often `explain` is right: sets with known hidden effects, answered and judged as any other tool's answers.

Sets, key and answers stay in a folder: an interrupted run goes on with the same command, more sets are added to those
that are there. `rollerrig score` judges answers of any tool on the same sets.
"""

import argparse
from pathlib import Path

from rich.table import Table
from sealed import answers, cases, score

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say


def run(given: argparse.Namespace, say: Say) -> Result:
    """Rows (measure, right, of, share, its interval, wanted) for the tool that was asked for."""
    if given.sets < 0 or given.seed < 0:
        raise ConfigError(f"--sets {given.sets}, --seed {given.seed}: allowed are 0 and more")
    folder = (
        given.export
        or given.folder
        or Path("reports", f"bench_explain_{given.generator}_{given.seed}")
    )
    cases.export(folder, given.generator, given.sets, given.seed, say)
    if given.export:
        return {
            "rows": [],
            "title": f"sets in {folder / cases.SETS}, key: {folder / cases.KEY}",
            "notes": [f"judge answers with: rollerrig score {folder} ANSWERS"],
        }
    found = judge(folder, answers.answer(folder, given.tool, say, given.alone))
    return found | {"notes": [*found["notes"], f"sets, key and answers: {folder}"]}


def judge(folder: Path, of: Path) -> Result:
    """The measures of some answers. Raises ConfigError where key or answers cannot be read."""
    key = cases.read_key(folder)
    found = score.judged(key, answers.read(of))
    seconds = figures.quantiles([f.seconds for f in found if f.seconds is not None])
    notes = [f"not told rightly: {line}" for line in score.failed(found)]
    if left := len(key["sets"]) - len(found):
        notes.append(f"{left} of {len(key['sets'])} sets have no answer")
    if seconds:
        notes.append(f"seconds a set: median {seconds['p50']:.0f}, longest {seconds['max']:.0f}")
    title = (
        f"{of.stem} on {len(found)} sets with known hidden effects, {key['generator']} generator"
    )
    return {
        "sets": len(found),
        "generator": key["generator"],
        "title": title,
        "rows": score.rows(found),
        "seconds": seconds,
        "notes": notes,
    }


def table(result: Result) -> Table:
    """The measures, with counts and 95 % intervals."""
    return figures.table(
        result["title"], score.HEAD, [[row[key] for key in score.HEAD] for row in result["rows"]]
    )
