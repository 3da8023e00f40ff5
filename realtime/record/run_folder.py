"""A run's folder: what a run writes there, and what of an earlier run it may replace.

A folder that a bench has begun bears its mark. In one, files of a run are replaced by name and all else
is kept: notes, exports, folders. A folder without the mark is only used when it is empty.
"""

import json
from pathlib import Path

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record.files import writing

SCENARIO, CHANNELS, TAIL, EVENTS, SUMMARY, CAN_LOG, RRD, UNIT_LOG, TRACE = FILES = (
    "scenario.toml",
    "channels.parquet",
    "channels.tail",
    "events.jsonl",
    "summary.json",
    "can.log",
    "run.rrd",
    "wsp.log",
    "harness.csv",
)
MARK = ".rollerrig"


def begin(folder: Path) -> None:
    """Make a run's folder, or take away what an earlier run left in one. Raises ConfigError."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()) and not _is_run(folder):
            raise ConfigError(
                f"{folder} is not empty and not a run's folder: nothing in it is replaced; give a new "
                "one with --out"
            )
        (folder / MARK).write_text(
            "A folder of rollerrig run: its next run replaces the files of this one.\n",
            encoding="utf-8",
        )
        for name in FILES:
            (folder / name).unlink(missing_ok=True)


def _is_run(folder: Path) -> bool:
    """Whether a bench has begun this folder: its mark, or the summary of a run of before there were marks."""
    if (folder / MARK).is_file():
        return True
    try:
        return "config_hash" in json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return False
