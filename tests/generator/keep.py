"""Keeps what `explain` answered to the sets of a benchmark, and the key, so that anybody can judge it again.

    python tests/generator/keep.py FOLDER ...

Each folder is one of `rollerrig bench explain --folder FOLDER`. Kept is what is judged, under the generator's name
beside this file; docs/explain.md has its table from there (`make docs`), and `rollerrig score` prints it:

    rollerrig score tests/generator/kept/third tests/generator/kept/third/explain.json
"""

import json
import shutil
import sys
from pathlib import Path

from rollerrig.realtime.benchmarks.sealed import answers, cases

KEPT = Path(__file__).parent / "kept"


def rounded(value):
    """Plain data with six digits a number."""
    if isinstance(value, dict):
        return {key: rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [rounded(one) for one in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def main(folders):
    for folder in map(Path, folders):
        to = KEPT / cases.read_key(folder)["generator"]
        to.mkdir(parents=True, exist_ok=True)
        shutil.copy(folder / cases.KEY, to / cases.KEY)
        found = answers.read(folder / answers.ANSWERS / "explain")
        lines = [f"{json.dumps(name)}: {json.dumps(rounded(one))}" for name, one in found.items()]
        (to / "explain.json").write_text("{" + ",\n".join(lines) + "}\n", encoding="utf-8")
        print(f"{to}: {len(found)} answers")


if __name__ == "__main__":
    main(sys.argv[1:])
