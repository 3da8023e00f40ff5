"""`rollerrig bench discover`: how often `discover` solves a sealed rig within nine stops.

A rig is solved when `discover` reports the hidden causes, each without a confusable one, and no
other. Rigs, stops and answers stay in a folder: the same command continues after an interruption,
and a larger --sets adds rigs.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

from rich.table import Table
from sealed import score

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import replaced, writing
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say
from rollerrig.realtime.discover import discover, sealed_rig

RIGS = 40
MOST_STOPS = 9
# the stop from which each rig starts
SCENARIO = "velim_a1"


def run(given: argparse.Namespace, say: Say) -> Result:
    """Return the measures by number of hidden effects, and a note for each rig that is not solved.

    Raises ConfigError.
    """
    if given.sets < 0 or given.seed < 0:
        raise ConfigError(
            f"--sets {given.sets}, --seed {given.seed}: both must be 0 or more; "
            f"--sets 0 means {RIGS} rigs"
        )
    folder = given.folder or Path("reports", f"bench_discover_{given.seed}")
    answers = []
    for k in range(given.sets or RIGS):
        answers.append(_answer(folder, f"rig_{given.seed + k:04d}", say))

    one_effect = [answer for answer in answers if len(answer["hidden"]) == 1]
    two_effects = [answer for answer in answers if len(answer["hidden"]) == 2]
    rows = [
        *_rates("one hidden effect", one_effect),
        *_rates("two hidden effects", two_effects),
        *_rates("all", answers, wanted=">= 0.90"),
    ]
    stops = [float(answer["stops"]) for answer in answers if _solved(answer)]
    notes = [
        f"{answer['rig']}: hidden {' and '.join(answer['hidden'])}; {answer['said']}"
        for answer in answers
        if not _solved(answer)
    ]
    return {
        "rows": rows,
        "title": f"{len(answers)} sealed rigs, at most {MOST_STOPS} stops each",
        "stops": figures.quantiles(stops),
        "notes": [*notes, f"rigs, stops and answers: {folder}"],
    }


def _rates(kind: str, answers: list[Result], wanted: str = "") -> list[Result]:
    """Return the two measures of some rigs; `wanted` is the required share of solved ones."""

    def rate(measure: str, wanted: str, right: Callable[[Result], bool]) -> Result:
        return score.rate(f"{kind}: {measure}", wanted, map(right, answers))

    return [
        rate("solved: each cause named alone, and no other", wanted, _solved),
        rate("all causes named, perhaps among others", "", _named_among_others),
    ]


def _answer(folder: Path, name: str, say: Say) -> Result:
    """Return the answer to a rig; a rig without an answer is hidden and solved first."""
    rig = folder / f"{name}.toml"
    file = folder / f"{name}.json"
    if not file.is_file():
        _write_answer(folder, name, say)

    answer: Result = json.loads(file.read_text(encoding="utf-8"))
    causes = " + ".join("/".join(names) for names in answer["causes"])
    answer["said"] = f"{answer['verdict']} {causes}"
    answer["hidden"] = sorted(sealed_rig.causes(rig))
    say(f"{name}: {answer['said']}; {answer['stops']} stops, {answer['seconds']} s")
    return answer


def _write_answer(folder: Path, name: str, say: Say) -> None:
    """Hide a rig, let `discover` work on it, and write its answer."""
    rig = folder / f"{name}.toml"
    file = folder / f"{name}.json"
    seed = int(name.removeprefix("rig_"))
    began_s = time.monotonic()
    sealed_rig.hide(SCENARIO, seed, 0, rig, rig.with_suffix(".key"))
    try:
        account, history = discover.find_out(
            str(rig), folder / name, MOST_STOPS, 0, say, lambda *_: None
        )
        last = history["rounds"][-1]
        answer: Result = {
            "causes": last["causes"],
            "stops": last["stops"],
            "rig": name,
            "verdict": account.verdict,
        }
    except ConfigError as error:
        answer = {"causes": [], "stops": MOST_STOPS, "rig": name, "verdict": f"refused: {error}"}
    answer["seconds"] = round(time.monotonic() - began_s)
    with writing(file), replaced(file) as new:
        new.write_text(json.dumps(answer) + "\n", encoding="utf-8")


def _solved(answer: Result) -> bool:
    """Whether each hidden cause is named without a confusable one, and no other is named."""
    if answer["verdict"] != "explained":
        return False
    if any(len(names) > 1 for names in answer["causes"]):
        return False
    return sorted(names[0] for names in answer["causes"]) == answer["hidden"]


def _named_among_others(answer: Result) -> bool:
    named = {name for names in answer["causes"] for name in names}
    return set(answer["hidden"]) <= named


def table(result: Result) -> Table:
    """Return the table of the measures, with counts and 95 % intervals."""
    rows = [[row[key] for key in score.HEAD] for row in result["rows"]]
    return figures.table(result["title"], score.HEAD, rows)
