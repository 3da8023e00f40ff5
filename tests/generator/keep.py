"""Keeps what `explain` answered to the sets of a benchmark, and the key, so that anybody can judge it again.

    cd tests; python -m generator.keep FOLDER ...

Each folder is one of `rollerrig bench explain --folder FOLDER`. Kept is what is judged, also by other limits, under
the generator's name beside this file. docs/explain.md has its table from there (`make docs`); to print it:

    rollerrig score tests/generator/kept/third tests/generator/kept/third/explain.json
"""

import json
import shutil
import sys
from pathlib import Path

from sealed import answers, cases

KEPT = Path(__file__).parent / "kept"
LIKELY = 0.03  # findings that are less likely by chance are kept
NEAR = 0.5  # and rivals of a cause that win a larger share of its likelihood


def rounded(value):
    """Plain data with six digits a number."""
    if isinstance(value, dict):
        return {key: rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [rounded(one) for one in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def told(report, causes):
    """What a verdict by other limits needs beside what is judged."""
    findings = {
        where: [f for f in found if f["p_value"] < LIKELY]
        for where, found in report.get("findings", {}).items()
    }
    evidence = [
        {
            "likelihood": one["evidence"]["likelihood"],
            "rivals": [rival for rival in one["evidence"]["rivals"] if rival["share"] > NEAR],
        }
        for one in report["causes"]
    ]
    return {
        "causes": [one | {"evidence": its} for one, its in zip(causes, evidence, strict=True)],
        "set_aside": report.get("set_aside", []),
        "findings": findings,
        "notes": report.get("notes", []),
    }


def write(folder, found):
    """Answers by set, a line each."""
    lines = [f"{json.dumps(name)}: {json.dumps(rounded(one))}" for name, one in found.items()]
    (folder / "explain.json").write_text("{" + ",\n".join(lines) + "}\n", encoding="utf-8")


def main(folders):
    for folder in map(Path, folders):
        to = KEPT / cases.read_key(folder)["generator"]
        to.mkdir(parents=True, exist_ok=True)
        shutil.copy(folder / cases.KEY, to / cases.KEY)
        given = folder / answers.ANSWERS / "explain"
        found = {
            name: one | told(json.loads((given / f"{name}.json").read_text()), one["causes"])
            for name, one in answers.read(given).items()
        }
        write(to, found)
        print(f"{to}: {len(found)} answers")


if __name__ == "__main__":
    main(sys.argv[1:])
