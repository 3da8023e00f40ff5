"""How often `discover` finds out a sealed rig within nine stops: the hidden causes named, each alone, and no other.

Rigs, stops and answers stay in a folder: an interrupted run goes on with the same command, and grows with --sets.
"""

import argparse
import json
import time
from pathlib import Path

from rich.table import Table
from sealed import score

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say
from rollerrig.realtime.discover import discover, sealed_rig
from rollerrig.realtime.record.files import replaced, writing

RIGS, STOPS, SCENARIO = 40, 9, "velim_a1"


def run(given: argparse.Namespace, say: Say) -> Result:
    """Rows (measure, yes, of, share, its interval, wanted), and a line for each rig that was not found out."""
    if given.sets < 0 or given.seed < 0:
        raise ConfigError(f"--sets {given.sets}, --seed {given.seed}: allowed are 0 and more")
    folder = given.folder or Path("reports", f"bench_discover_{given.seed}")
    names = [f"rig_{given.seed + k:04d}" for k in range(given.sets or RIGS)]
    found = [_found_out(folder, name, say) for name in names]
    kinds = [
        ("one hidden effect", [one for one in found if len(one["hidden"]) == 1]),
        ("two hidden effects", [one for one in found if len(one["hidden"]) == 2]),
        ("all", found),
    ]
    rows = [
        score.rate(f"{kind}: {what}", wanted if kind == "all" else "", map(right, of))
        for kind, of in kinds
        for what, wanted, right in (
            ("found out: named alone, and no other", ">= 0.90", _solved),
            ("all named, perhaps among others", "", _among),
        )
    ]
    stops = [float(one["stops"]) for one in found if _solved(one)]
    notes = [
        f"{one['rig']}: hidden {' and '.join(one['hidden'])}; {one['said']}"
        for one in found
        if not _solved(one)
    ]
    return {
        "rows": rows,
        "title": f"{len(found)} sealed rigs, at most {STOPS} stops each",
        "stops": figures.quantiles(stops),
        "notes": [*notes, f"rigs, stops and answers: {folder}"],
    }


def _found_out(folder: Path, name: str, say: Say) -> Result:
    """What was said of a rig, which is hidden and found out where that has not been done yet."""
    rig, answer = folder / f"{name}.toml", folder / f"{name}.json"
    if not answer.is_file():
        began = time.monotonic()
        sealed_rig.hide(SCENARIO, int(name.removeprefix("rig_")), 0, rig, rig.with_suffix(".key"))
        try:
            account, history = discover.find_out(
                str(rig), folder / name, STOPS, 0, say, lambda *_: None
            )
            said, last = account.verdict, history["rounds"][-1]
            content: Result = {"causes": last["causes"], "stops": last["stops"]}
        except ConfigError as error:
            said, content = f"refused: {error}", {"causes": [], "stops": STOPS}
        content |= {"rig": name, "verdict": said, "seconds": round(time.monotonic() - began)}
        with writing(answer), replaced(answer) as new:
            new.write_text(json.dumps(content) + "\n", encoding="utf-8")
    given: Result = json.loads(answer.read_text(encoding="utf-8"))
    given["said"] = " ".join(
        [given["verdict"], " + ".join("/".join(names) for names in given["causes"])]
    )
    given["hidden"] = sorted(sealed_rig.causes(rig))
    say(f"{name}: {given['said']}; {given['stops']} stops, {given['seconds']} s")
    return given


def _solved(one: Result) -> bool:
    return (
        one["verdict"] == "explained"
        and sorted(names[0] for names in one["causes"]) == one["hidden"]
        and all(len(names) == 1 for names in one["causes"])
    )


def _among(one: Result) -> bool:
    return set(one["hidden"]) <= {name for names in one["causes"] for name in names}


def table(result: Result) -> Table:
    """The measures, with counts and 95 % intervals."""
    return figures.table(
        result["title"], score.HEAD, [[row[key] for key in score.HEAD] for row in result["rows"]]
    )
