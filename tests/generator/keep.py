"""Keeps the answers of `explain` to the sets of a benchmark, and the key, for judging them again.

    cd tests; python -m generator.keep FOLDER ...

Each folder is one of `rollerrig bench explain --folder FOLDER`. What is judged, also by other
limits (`thresholds.py`), is kept in `kept/GENERATOR` next to this file. docs/explain_rates.md has
its table from there (`make docs`). This command prints it:

    rollerrig score tests/generator/kept/third tests/generator/kept/third/explain.json
"""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from sealed import answers, cases

KEPT = Path(__file__).parent / "kept"
# findings that are less likely by chance are kept
LARGEST_P_VALUE = 0.03
# rivals of a cause that win a larger share of its likelihood are kept
SMALLEST_SHARE = 0.5


def rounded(value: Any) -> Any:
    """Return plain data with six digits per number."""
    if isinstance(value, dict):
        return {key: rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [rounded(one) for one in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def needed_for_a_verdict(report: dict[str, Any], causes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what a verdict by other limits needs in addition to what `score` needs.

    `causes` are those of the answer, in the order of the report's.
    """
    findings = {}
    for where, tests in report.get("findings", {}).items():
        findings[where] = [test for test in tests if test["p_value"] < LARGEST_P_VALUE]

    causes_with_evidence = []
    for cause, reported in zip(causes, report["causes"], strict=True):
        evidence = reported["evidence"]
        rivals = [rival for rival in evidence["rivals"] if rival["share"] > SMALLEST_SHARE]
        kept = {"likelihood": evidence["likelihood"], "rivals": rivals}
        causes_with_evidence.append(cause | {"evidence": kept})
    return {
        "causes": causes_with_evidence,
        "set_aside": report.get("set_aside", []),
        "contradicted": report.get("contradicted", []),
        "immaterial": report.get("immaterial", []),
        "findings": findings,
        "notes": report.get("notes", []),
    }


def write(folder: Path, answers_by_set: dict[str, Any]) -> None:
    """Write answers to explain.json, one line per set."""
    lines = []
    for name, answer in answers_by_set.items():
        lines.append(f"{json.dumps(name)}: {json.dumps(rounded(answer))}")
    (folder / "explain.json").write_text("{" + ",\n".join(lines) + "}\n", encoding="utf-8")


def keep(folder: Path) -> None:
    """Keep the key and the answers of one folder of `bench explain`."""
    to = KEPT / cases.read_key(folder)["generator"]
    to.mkdir(parents=True, exist_ok=True)
    shutil.copy(folder / cases.KEY, to / cases.KEY)

    reports = folder / answers.ANSWERS / "explain"
    kept = {}
    for name, answer in answers.read(reports).items():
        report = json.loads((reports / f"{name}.json").read_text())
        kept[name] = answer | needed_for_a_verdict(report, answer["causes"])
    write(to, kept)
    print(f"{to}: {len(kept)} answers")


if __name__ == "__main__":
    for _folder in sys.argv[1:]:
        keep(Path(_folder))
