"""Lets a tool answer the sets of a benchmark, and reads the answers of any tool.

Our tools answer in the same form as any other tool. The answer to a set is a table; report.json of
`rollerrig explain` is such a table, with more in it than is needed:

    verdict      required; one of `VERDICTS`; "refused" means that the data allow no conclusion
    causes       list of tables, the most likely cause first; may be missing or empty
    gain         optional table with `claimed` (true or false), `reduction` and `metric`, see below
    elapsed_s    optional; seconds that the tool took

Each cause has a `name` of the rig's table of causes, and may have `confusable_with` (list of names
that the data cannot distinguish from it) and `parameters` (table by parameter, each with `ci95`,
the limits of the 95 % interval). A gain is a reduction of the error on the stops that were never
fitted, as a share: 0.2 means that the error with the answered causes is 20 % less than that of the
fitted base. `metric` names the error: "adhesion_rmse" or "free_running_speed_rmse_m_s".

A short form exists: `heldout_gain` in place of `gain` (the reduction, or null where none is
claimed), and `seconds` in place of `elapsed_s`.

The answers to all sets are in one JSON file, as a table by set, or in a folder with one file
SET.json for each set.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import writing
from sealed import baselines, work
from sealed.cases import SETS

# folder of our answers in the folder of the sets
ANSWERS = "answers"
TOOLS = ("explain", *baselines.TOOLS)
# verdicts of a tool that has detected something
DETECTED = ("explained", "partly", "unexplained")
VERDICTS = ("consistent", *DETECTED, "refused")
Answer = dict[str, Any]


def answer(folder: Path, tool: str, say: Callable[[str], None], alone: bool = False) -> Path:
    """Let one of our tools answer all sets that have no answer yet; return the folder of answers.

    One set runs per core, or with `alone` one set after another on all cores.
    """
    out = folder / ANSWERS / tool
    with writing(out, "give another folder"):
        out.mkdir(parents=True, exist_ok=True)

    names = sorted(path.parent.name for path in (folder / SETS).glob("*/dataset.toml"))
    left = [name for name in names if not (out / f"{name}.json").exists()]
    answered = len(names) - len(left)
    for name, answer_of_set in work.all_of(partial(answer_one, folder / SETS, tool), left, alone):
        # written under another name first, so that an interruption leaves no half answer
        part = out / f"{name}.part"
        with writing(part, "free some space"):
            part.write_text(json.dumps(answer_of_set), encoding="utf-8")
            part.replace(out / f"{name}.json")
        answered += 1
        causes = " + ".join(
            "/".join([cause["name"], *cause["confusable_with"]])
            for cause in answer_of_set["causes"]
        )
        say(
            f"{tool}: {answered} of {len(names)}: {name} {answer_of_set['verdict']} {causes} "
            f"({answer_of_set['elapsed_s'] or 0.0:.0f} s)"
        )
    return out


def answer_one(folder: Path, tool: str, name: str) -> tuple[str, Answer]:
    """Return the name of a set and the answer of a tool to it."""
    from rollerrig.realtime.reports import cause_report as report
    from rollerrig.rig.identify.data import dataset
    from rollerrig.rig.identify.decide import decision

    try:
        data = dataset.load(folder / name)
        if tool != "explain":
            return name, baselines.TOOLS[tool](data)
        return name, report.as_json(decision.explain_braking_runs(data, 0, lambda *_: None))
    except ConfigError as error:
        return name, {
            "verdict": "refused",
            "causes": [],
            "gain": None,
            "notes": [str(error)],
            "elapsed_s": None,
        }


def read(path: Path) -> dict[str, Answer]:
    """Return the answers by set, from a file or a folder, in the long form.

    Raises ConfigError where an answer cannot be judged.
    """
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    content = {}
    try:
        for file in files:
            content[file] = user_files.read_json(file)
    except ConfigError as error:
        raise ConfigError(
            f"{path}: no answers can be read ({error}); give a JSON file with one answer per set, "
            "or a folder with one file SET.json per set"
        ) from None

    # a file has the table of all answers, and each file of a folder has one answer
    by_set = content.get(path)
    if path.is_dir():
        by_set = {file.stem: one for file, one in content.items()}
    if not isinstance(by_set, dict) or not by_set:
        raise ConfigError(
            f"{path}: there are no answers; give a table with an entry for each set, "
            "or files SET.json"
        )
    return {name: _checked(f"{path}, {name}", one) for name, one in by_set.items()}


def _checked(where: str, given: Any) -> Answer:
    """Return an answer in the long form, with all keys; `where` begins the message of an error."""
    if not isinstance(given, dict) or given.get("verdict") not in VERDICTS:
        raise ConfigError(
            f"{where}: verdict is missing or unknown; allowed are {', '.join(VERDICTS)}"
        )
    causes = _checked_causes(where, given.get("causes") or [])
    gain = _checked_gain(where, given)

    seconds = given.get("elapsed_s", given.get("seconds"))
    if not isinstance(seconds, int | float):
        seconds = None
    return {"verdict": given["verdict"], "gain": gain, "elapsed_s": seconds, "causes": causes}


def _checked_causes(where: str, causes: Any) -> list[dict[str, Any]]:
    if not isinstance(causes, list) or not all(
        isinstance(cause, dict) and isinstance(cause.get("name"), str) for cause in causes
    ):
        raise ConfigError(f"{where}: causes must be a list of tables, each with a name")

    checked = []
    for cause in causes:
        name = cause["name"]
        confusable = cause.get("confusable_with") or []
        parameters = cause.get("parameters") or {}
        if not isinstance(confusable, list) or not isinstance(parameters, dict):
            raise ConfigError(
                f"{where}, {name}: confusable_with must be a list of names, and parameters a table"
            )
        for parameter, value in parameters.items():
            if not (isinstance(value, dict) and _is_interval(value.get("ci95"))):
                raise ConfigError(f"{where}, {name}: {parameter} needs ci95 = [low, high]")
        checked.append(
            {
                "name": name,
                "confusable_with": [str(other) for other in confusable],
                "parameters": parameters,
            }
        )
    return checked


def _checked_gain(where: str, given: dict[str, Any]) -> dict[str, Any]:
    gain = given.get("gain") or {}
    short = given.get("heldout_gain")
    if short is not None and (not isinstance(short, int | float) or isinstance(short, bool)):
        raise ConfigError(
            f"{where}: heldout_gain must be a share, as 0.2, or null where none is claimed"
        )
    if short is not None and not gain:
        gain = {"reduction": short, "claimed": True}

    if not isinstance(gain, dict):
        raise ConfigError(f"{where}: gain must be a table with claimed and reduction")
    if gain.get("claimed") and not isinstance(gain.get("reduction"), int | float):
        raise ConfigError(f"{where}: a gain that is claimed must have a reduction, a share as 0.2")
    return gain


def _is_interval(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(limit, int | float) for limit in value)
    )
