"""The library of runs: all run folders below a folder, with their figures, verdicts and notes."""

import datetime
import functools
import re
import subprocess
import tempfile
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

from rollerrig.configs import store, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import write_text, writing
from rollerrig.configs.processes import children
from rollerrig.realtime.record import compare, figures, records, run_folder, validity
from rollerrig.realtime.record import export as formats
from rollerrig.realtime.reports import sequences as sequence_report
from rollerrig.wsp_interface.events import Code

NOTE = "note.txt"
FORMATS = {"csv": "CSV", "mdf4": "MDF4", "mat": "MAT", "svg": "Picture"}
_DEEPEST = 4  # levels of folders: programmes keep a folder for each report, and reports one a run
_MOST_RUNS = 500
_KM_H_PER_M_S = 3.6
# the folder of a car in that of its train
_CAR = re.compile(r"car_\d+")


class ComparedFigure(NamedTuple):
    """One figure of two runs; None where a run does not have it."""

    title: str
    unit: str
    first: float | None
    second: float | None


def rows(folder: Path) -> list[dict[str, Any]]:
    """A row for each run, the newest first.

    A row has name, time, scenario, unit, initial speed, adhesion, faults, test, verdict, note, and
    the figures by their names. `cars` is the number of cars of a train, None for a vehicle. `test`
    is the result of the sequence that was played (pass, fail or error), empty for another run.
    `verdict` is whether the run is valid, or why it is not.
    """
    runs = set()
    for depth in range(1, _DEEPEST + 1):
        pattern = "*/" * depth + run_folder.SCENARIO
        runs |= {file.parent for file in folder.glob(pattern)}
    # a car of a train is opened from the row of the train
    runs = {run for run in runs if not (run.parent in runs and _CAR.fullmatch(run.name))}
    newest_first = sorted(runs, key=_changed_s, reverse=True)
    return [_row(folder, run) for run in newest_first[:_MOST_RUNS]]


def _changed_s(run: Path) -> float:
    """The time at which a run began, in s since 1970."""
    try:
        return (run / run_folder.SCENARIO).stat().st_mtime
    except OSError:
        return 0.0  # the run was removed in the meantime


def _row(folder: Path, run: Path) -> dict[str, Any]:
    begun = datetime.datetime.fromtimestamp(_changed_s(run))
    row: dict[str, Any] = {
        "name": str(run.relative_to(folder)),
        "when": begun.strftime("%Y-%m-%d %H:%M:%S"),
        "note": note(run),
        "cars": None,
        "test": _test_result(run),
    }
    try:
        summary = records.summary(run)
    except ConfigError as error:
        row["verdict"] = f"damaged: {error}"
        return row

    row["scenario"] = summary.get("scenario")
    row["cars"] = len(summary.get("cars") or []) or None
    row["unit"] = summary.get("wsp", {}).get("unit")
    speed_m_s = summary.get("initial_speed_m_s")
    if isinstance(speed_m_s, int | float):
        row["initial_km_h"] = round(_KM_H_PER_M_S * speed_m_s, 1)
    row["adhesion"] = _adhesion(run / run_folder.SCENARIO, _changed_s(run))
    row["faults"] = ", ".join(_faults(summary.get("events") or []))
    row["verdict"] = "; ".join(validity.because(summary)) or "valid"
    for figure in figures.FIGURES:
        value = figure.shown(summary)
        row[figure.name] = None if value is None else float(f"{value:.4g}")
    return row


def _test_result(run: Path) -> str:
    """The result of the sequence that a run has played, from the report above it; else empty."""
    report = run.parent / sequence_report.JSON
    try:
        changed_s = report.stat().st_mtime
    except OSError:
        return ""
    return _results(report, changed_s).get(run.name, "")


@functools.lru_cache(maxsize=_MOST_RUNS)
def _results(report: Path, changed_s: float) -> dict[str, str]:
    """The results of the sequences of a report, by their names; empty if it cannot be read.

    `changed_s` is when the file was written: a file is read only once.
    """
    try:
        content = user_files.read_json(report, within=report.parent)
        return {str(one["name"]): str(one["result"]) for one in content["sequences"]}
    except (ConfigError, KeyError, TypeError):
        return {}


@functools.lru_cache(maxsize=4 * _MOST_RUNS)
def _adhesion(scenario: Path, changed_s: float) -> str:
    """The adhesion of a resolved scenario, as its name and its friction mu_cd; empty if unknown.

    `changed_s` is when the file was written: a file is read only once.
    """
    try:
        content = store.parse(scenario, within=scenario.parent)
        mu = float(content["adhesion"]["mu_cd"])
    except (ConfigError, ValueError, KeyError, TypeError):
        return ""
    return f"{content.get('adhesion_set', '')} {mu:.3g}".strip()


def _faults(events: list[Any]) -> list[str]:
    """The faults that began in a run, each once, from the events of its summary."""
    found: dict[str, None] = {}
    for event in events:
        if isinstance(event, dict) and event.get("code") == Code.FAULT_BEGINS:
            found[str((event.get("fields") or {}).get("fault", ""))] = None
    return list(found)


def note(run: Path) -> str:
    """The note in the folder of a run; empty if there is none that may be read."""
    try:
        return user_files.read_text(run / NOTE, user_files.NOTE, within=run).strip()
    except ConfigError:
        return ""


def write_note(run: Path, text: str) -> None:
    """Write a note into the folder of a run.

    Raises ConfigError if this is not possible; the old note is kept then.
    """
    with writing(run / NOTE, "make room; the old note is kept"):
        write_text(run / NOTE, text.strip() + "\n")


def compared(first: Path, second: Path) -> tuple[list[ComparedFigure], list[Any]]:
    """The figures of two runs, and their channels with the largest differences first.

    Raises ConfigError.
    """
    runs = [records.load(first), records.load(second)]
    both = []
    for figure in figures.FIGURES:
        values = [figure.shown(run.summary) for run in runs]
        both.append(ComparedFigure(figure.title, figure.unit, *values))
    return both, compare.differences(runs, {})


def channel(run: Path, name: str, factor: float, points: int = 600) -> list[tuple[float, float]]:
    """Points (time in s, value times `factor`) of a channel, thinned to about `points`.

    Raises ConfigError.
    """
    loaded = records.load(run)
    time_s = loaded.column("time_s")
    values = factor * loaded.column(name)
    step = max(1, len(time_s) // points)
    return [
        (round(float(at_s), 3), round(float(value), 4))
        for at_s, value in zip(time_s[::step], values[::step], strict=True)
    ]


def export(run: Path, kind: str) -> tuple[str, bytes]:
    """The name and content of the file that `rollerrig export` writes for a run.

    Several files are packed into a ZIP. Raises ConfigError.
    """
    with tempfile.TemporaryDirectory(prefix="rollerrig-desk-") as folder:
        out = Path(folder) / f"{run.name}{formats.SUFFIX[kind]}"
        words = ["export", str(run), "--format", kind, "--out", str(out), "--json"]
        done = subprocess.run(
            children.command(*children.module("rollerrig.realtime.cli", *words)),
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
        )
        files = sorted(Path(folder).iterdir())
        if done.returncode or not files:
            last_line = done.stderr.strip().rpartition("\n")[2]
            raise ConfigError(last_line or f"{run}: the export failed without a message")
        if len(files) == 1:
            return files[0].name, files[0].read_bytes()
        return _packed(files, Path(folder) / f"{run.name}.zip")


def _packed(files: list[Path], archive_path: Path) -> tuple[str, bytes]:
    with zipfile.ZipFile(archive_path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.name)
    return archive_path.name, archive_path.read_bytes()
