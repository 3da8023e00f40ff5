"""Runs of a campaign whose unit is a program of the user: each on a bench in lockstep.

Such a unit needs a bus, so a run is a `rollerrig run --pacing lockstep` in a process, with a
separate bus on a free port. Its record is deleted; the row of the campaign keeps its figures.
"""

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.processes import children
from rollerrig.realtime.record import records

_CLI = "rollerrig.realtime.cli"


class Done(NamedTuple):
    """A run that is done: its summary and channels, or the error because of which it has none."""

    summary: dict[str, Any]
    channels: dict[str, np.ndarray]
    error: str | None


def _failed(error: str) -> Done:
    return Done({}, {}, error)


def run(
    scenario: str,
    unit_command: str,
    settings: tuple[str, ...],
    faults: tuple[str, ...] = (),
    columns: tuple[str, ...] = (),
) -> Done:
    """Return the summary and some recorded columns of one run, or its error.

    `scenario` is a name or a file, `settings` are in the form of `--set`, `faults` in that
    of `--fault`.
    """
    with tempfile.TemporaryDirectory(prefix="rollerrig-campaign-") as place:
        folder = Path(place) / "run"
        words = ["run", *words_of(scenario, unit_command, settings, faults)]
        words += ["--out", str(folder), "--json"]
        done = subprocess.run(
            children.command(*children.module(_CLI, *words)),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
        )
        try:
            result: dict[str, Any] = json.loads(done.stdout)
        except ValueError:
            messages = done.stderr.decode(errors="replace").strip().splitlines()
            reason = messages[-1] if messages else "it printed no message"
            return _failed(f"the bench exited with status {done.returncode}: {reason}")
        if "error" in result:
            return _failed(str(result["error"]))
        channels: dict[str, np.ndarray] = {}
        if columns:
            recorded = records.load(folder)
            channels = {name: recorded.column(name) for name in columns}
    return Done(result, channels, None)


def words_of(
    scenario: str, unit_command: str, settings: tuple[str, ...], faults: tuple[str, ...] = ()
) -> list[str]:
    """Return the arguments of `rollerrig run` for one run."""
    words = [scenario, "--pacing", "lockstep", "--unit", unit_command]
    return words + options_of(settings, faults)


def options_of(settings: tuple[str, ...], faults: tuple[str, ...]) -> list[str]:
    """Return the options of `rollerrig run` that change values and add faults."""
    words = []
    for setting in settings:
        words += ["--set", setting]
    for fault in faults:
        words += ["--fault", fault]
    return words
