"""A run's folder: what a run writes there, and which files of an earlier run it may replace.

A folder that a bench has begun contains the file MARK. There the files of a run are replaced by
name, and everything else is kept: notes, exports, folders. A folder without MARK is used only if it
is empty.
"""

import time
from collections.abc import Sequence
from pathlib import Path

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, write_text, writing

SCENARIO = "scenario.toml"
CHANNELS = "channels.parquet"
TAIL = "channels.tail"
EVENTS = "events.jsonl"
SUMMARY = "summary.json"
CAN_LOG = "can.log"
RRD = "run.rrd"
UNIT_LOG = "wsp.log"
UNIT_CAN_LOG = "unit_can.log"
TRACE = "harness.csv"
FILES = (SCENARIO, CHANNELS, TAIL, EVENTS, SUMMARY, CAN_LOG, RRD, UNIT_LOG, UNIT_CAN_LOG, TRACE)
MARK = ".rollerrig"


def begin(folder: Path) -> None:
    """Make a run's folder, or remove the files of an earlier run from it. Raises ConfigError."""
    with writing(folder):
        make_folder(folder)
        if any(folder.iterdir()) and not _is_run(folder):
            raise ConfigError(
                f"{folder} is not empty and not a run's folder: nothing in it is replaced; give a new "
                "folder with --out"
            )
        write_text(
            folder / MARK,
            "A folder of rollerrig run: its next run replaces the files of this one.\n",
        )
        for name in FILES:
            (folder / name).unlink(missing_ok=True)


def earlier_run(folder: Path) -> str:
    """Return what the run in a folder is, and which files a new run replaces, as a phrase.

    "" if the folder holds no run.
    """
    files = [name for name in FILES if (folder / name).is_file()]
    if not files or not _is_run(folder):
        return ""
    try:
        summary = user_files.read_json(folder / SUMMARY, within=folder)
        what = f"a run of {summary['scenario']} ({summary['pacing']}, {summary['ended']})"
    except (ConfigError, KeyError, TypeError):
        what = "a run that has no summary"
    begun = time.strftime("%Y-%m-%d %H:%M", time.localtime((folder / files[0]).stat().st_mtime))
    return f"{what}, begun at {begun}: {', '.join(files)}"


def _is_run(folder: Path) -> bool:
    """Return whether a bench has begun this folder: it has MARK, or an older version's summary."""
    if (folder / MARK).is_file():
        return True
    try:
        return "config_hash" in user_files.read_json(folder / SUMMARY, within=folder)
    except (ConfigError, TypeError):
        return False


def short_names(folders: Sequence[Path]) -> list[str]:
    """Return a name to show for each run's folder: its last part, or as many as make names differ.

    The same folder, given twice, has the same name twice.
    """
    whole = [folder.resolve().parts for folder in folders]
    names: list[str] = []
    for parts in whole:
        others = [other for other in whole if other != parts]
        count = 1
        while count < len(parts) and any(other[-count:] == parts[-count:] for other in others):
            count += 1
        names.append("/".join(parts[-count:]))
    return names
