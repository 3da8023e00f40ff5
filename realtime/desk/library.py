"""The library of runs: the folders that runs have left below a folder, with their figures, verdicts and notes."""

import datetime
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children
from rollerrig.realtime.record import compare, figures, records, run_folder, validity
from rollerrig.realtime.record import export as formats
from rollerrig.realtime.record.files import replaced, writing

NOTE = "note.txt"
_DEPTH = 3  # reports of sequences keep their runs in folders of their own
_MOST = 500
FORMATS = {"csv": "CSV", "mdf4": "MDF4", "mat": "MAT", "svg": "Picture"}


def rows(folder: Path) -> list[dict[str, Any]]:
    """A row for each run, the newest first: name, time, scenario, unit, verdict, figures by name, note."""
    found = {
        mark.parent
        for depth in range(1, _DEPTH + 1)
        for mark in folder.glob("/".join(["*"] * depth + [run_folder.SCENARIO]))
    }
    newest = sorted(found, key=_changed, reverse=True)[:_MOST]
    return [_row(folder, one) for one in newest]


def _changed(run: Path) -> float:
    try:
        return (run / run_folder.SCENARIO).stat().st_mtime
    except OSError:
        return 0.0  # it was taken away meanwhile


def _row(folder: Path, run: Path) -> dict[str, Any]:
    when = datetime.datetime.fromtimestamp(_changed(run)).strftime("%Y-%m-%d %H:%M:%S")
    row: dict[str, Any] = {"name": str(run.relative_to(folder)), "when": when, "note": note(run)}
    try:
        summary = records.summary(run)
    except ConfigError as error:
        return row | {"verdict": f"damaged: {error}"}
    because = validity.because(summary)
    return (
        row
        | {
            "scenario": summary.get("scenario"),
            "unit": summary.get("wsp", {}).get("unit"),
            "verdict": "; ".join(because) if because else "valid",
        }
        | {
            one.name: None if (value := one.shown(summary)) is None else float(f"{value:.4g}")
            for one in figures.FIGURES
        }
    )


def note(run: Path) -> str:
    """The note that is kept in a run's folder."""
    try:
        return (run / NOTE).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def write_note(run: Path, text: str) -> None:
    """Keep a note in a run's folder. Raises ConfigError where that cannot be written; the old one is kept then."""
    with writing(run / NOTE, "make room; the old note is kept"), replaced(run / NOTE) as new:
        new.write_text(text.strip() + "\n", encoding="utf-8")


def compared(
    first: Path, second: Path
) -> tuple[list[tuple[str, str, float | None, float | None]], list[Any]]:
    """Figures of two runs side by side (title, unit, values), and their most different channels. Raises ConfigError."""
    runs = [records.load(first), records.load(second)]
    beside = [
        (one.title, one.unit, one.shown(runs[0].summary), one.shown(runs[1].summary))
        for one in figures.FIGURES
    ]
    return beside, compare.differences(runs, {})


def channel(run: Path, name: str, factor: float, points: int = 600) -> list[tuple[float, float]]:
    """A channel of a run, times a factor, over time, some points of it. Raises ConfigError."""
    loaded = records.load(run)
    time_s, values = loaded.column("time_s"), factor * loaded.column(name)
    step = max(1, len(time_s) // points)
    return [
        (round(float(t), 3), round(float(v), 4))
        for t, v in zip(time_s[::step], values[::step], strict=True)
    ]


def export(run: Path, kind: str) -> tuple[str, bytes]:
    """A run as `rollerrig export` writes it, several files as a ZIP: name and content. Raises ConfigError."""
    with tempfile.TemporaryDirectory(prefix="rollerrig-desk-") as place:
        out = Path(place) / f"{run.name}{formats.SUFFIX[kind]}"
        done = subprocess.run(
            children.command(
                sys.executable,
                "-m",
                "rollerrig.realtime.cli",
                "export",
                str(run),
                "--format",
                kind,
                "--out",
                str(out),
                "--json",
            ),
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
        )
        files = sorted(Path(place).iterdir())
        if done.returncode or not files:
            raise ConfigError(
                done.stderr.strip().rpartition("\n")[2]
                or f"{run}: the export failed without a word"
            )
        if len(files) == 1:
            return files[0].name, files[0].read_bytes()
        packed = Path(place) / f"{run.name}.zip"
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in files:
                archive.write(file, file.name)
        return packed.name, packed.read_bytes()
