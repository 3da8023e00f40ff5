"""Answers of tools on the sets of a benchmark: our own through the same door as any other's.

An answer to a set is what report.json of `rollerrig explain` holds, or less: `verdict` (consistent, explained,
partly, unexplained, or refused: no data to conclude from), `causes` (each with `name`, `confusable_with` and
`parameters`, of these `ci95`), `gain` (`metric`, `reduction`, `claimed`) and `elapsed_s`; or, in short, `heldout_gain`
(the reduction, null: not claimed) and `seconds`. Answers stand in a table by set, in one file, or each in a file of its
own, SET.json, in a folder.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record.files import writing
from sealed import baselines, work
from sealed.cases import SETS

ANSWERS = "answers"
TOOLS = ("explain", *baselines.TOOLS)
FOUND = ("explained", "partly", "unexplained")
VERDICTS = ("consistent", *FOUND, "refused")
Answer = dict[str, Any]


def answer(folder: Path, tool: str, say: Callable[[str], None], alone: bool = False) -> Path:
    """Answer all sets with one of our tools, those that have no answer yet (one a core, or each `alone` on all);
    returns the folder of the answers."""
    out = folder / ANSWERS / tool
    with writing(out, "give another folder"):
        out.mkdir(parents=True, exist_ok=True)
    names = sorted(path.parent.name for path in (folder / SETS).glob("*/dataset.toml"))
    left = [name for name in names if not (out / f"{name}.json").exists()]
    for done, (name, found) in enumerate(
        work.all_of(partial(_one, folder / SETS, tool), left, alone), start=1
    ):
        part = out / f"{name}.part"
        with writing(part, "free some space"):
            part.write_text(json.dumps(found), encoding="utf-8")
            part.replace(out / f"{name}.json")
        named = " + ".join(
            "/".join((one["name"], *one["confusable_with"])) for one in found["causes"]
        )
        say(
            f"{tool}: {len(names) - len(left) + done} of {len(names)}: {name} {found['verdict']} {named} "
            f"({found['elapsed_s'] or 0.0:.0f} s)"
        )
    return out


def read(path: Path) -> dict[str, Answer]:
    """Answers by set, from a file or a folder. Raises ConfigError where one cannot be judged."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    try:
        texts = {file: json.loads(file.read_text(encoding="utf-8")) for file in files}
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: no answers can be read ({error}); wanted is a JSON file with an answer for each "
            "set, or a folder of files SET.json"
        ) from None
    found = {file.stem: one for file, one in texts.items()} if path.is_dir() else texts[path]
    if not isinstance(found, dict) or not found:
        raise ConfigError(
            f"{path}: no answers; wanted is a table with an entry for each set, or files SET.json"
        )
    return {name: _checked(f"{path}, {name}", one) for name, one in found.items()}


def _checked(where: str, given: Any) -> Answer:
    if not isinstance(given, dict) or given.get("verdict") not in VERDICTS:
        raise ConfigError(
            f"{where}: verdict is missing or another; allowed are {', '.join(VERDICTS)}"
        )
    causes = given.get("causes") or []
    if not isinstance(causes, list) or not all(
        isinstance(c, dict) and isinstance(c.get("name"), str) for c in causes
    ):
        raise ConfigError(f"{where}: causes is a list of tables, each with a name")
    for cause in causes:
        beside, values = cause.get("confusable_with") or [], cause.get("parameters") or {}
        if not isinstance(beside, list) or not isinstance(values, dict):
            raise ConfigError(
                f"{where}, {cause['name']}: confusable_with is a list of names, parameters a table"
            )
        for name, value in values.items():
            if not (isinstance(value, dict) and _is_interval(value.get("ci95"))):
                raise ConfigError(f"{where}, {cause['name']}: {name} needs ci95 = [low, high]")
    won, short = given.get("gain") or {}, given.get("heldout_gain")
    if short is not None and (not isinstance(short, int | float) or isinstance(short, bool)):
        raise ConfigError(
            f"{where}: heldout_gain is a share, as 0.2, or null where none is claimed"
        )
    if short is not None and not won:
        won = {"reduction": short, "claimed": True}
    if not isinstance(won, dict) or (
        won.get("claimed") and not isinstance(won.get("reduction"), int | float)
    ):
        raise ConfigError(
            f"{where}: gain is a table; where it is claimed it has a reduction (a share, as 0.2)"
        )
    seconds = given.get("elapsed_s", given.get("seconds"))
    return {
        "verdict": given["verdict"],
        "gain": won,
        "elapsed_s": seconds if isinstance(seconds, int | float) else None,
        "causes": [
            {
                "name": c["name"],
                "confusable_with": list(map(str, c.get("confusable_with") or [])),
                "parameters": c.get("parameters") or {},
            }
            for c in causes
        ],
    }


def _is_interval(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(v, int | float) for v in value)
    )


def _one(folder: Path, tool: str, name: str) -> tuple[str, Answer]:
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
