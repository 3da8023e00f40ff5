"""rollerrig for Python and notebooks: each function does the work of the command of its name.

`run` brakes once, `load` reads the folder of a run, `plot` draws it, `compare` compares runs,
`campaign` does many runs, `sequence` plays scripted tests, and `explain` explains measured stops.
`bench` starts a bench that a Python program commands as a test harness.

    import rollerrig

    stop = rollerrig.run("velim_a1", adhesion="soap", initial_speed_m_s=20.0)
    stop.summary["stop_distance_m"]
    stop.table["sliding_1_m_s"]
    stop.frame().plot(x="time_s", y="sliding_1_m_s")

All functions but `load`, `plot` and `bench` start the command of the same name in a separate
process, so that a notebook and a terminal get the same results. Errors that a user can correct are
`RollerrigError`, or one of its subclasses in `rollerrig.configs.errors`.

This file is the package `rollerrig` itself. Python loads it before every other module of the
package, so it imports almost nothing.
"""

import json
import sys
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rollerrig.configs.errors import RollerrigError

if TYPE_CHECKING:
    from rollerrig.wsp_interface.events import Event
    from rollerrig.wsp_interface.harness_client import Harness

__all__ = [
    "Campaign",
    "Picture",
    "RollerrigError",
    "Run",
    "__version__",
    "bench",
    "campaign",
    "compare",
    "explain",
    "load",
    "plot",
    "run",
    "sequence",
]

_NEEDS_PANDAS = (
    "frame() needs pandas: pip install pandas; without it, use `table`, which is a pyarrow Table"
)


def __getattr__(name: str) -> str:
    """Return `__version__`, which is looked up only on use. Raises AttributeError otherwise."""
    if name != "__version__":
        raise AttributeError(f"module 'rollerrig' has no attribute '{name}'")
    from importlib import metadata

    return metadata.version("rollerrig")


def __dir__() -> list[str]:
    """Return the public names only, without the names that this file imports."""
    return sorted(__all__)


def _frame(table: Any) -> Any:
    """Return a pyarrow Table as a pandas DataFrame. Raises ImportError without pandas."""
    from importlib.util import find_spec

    if find_spec("pandas") is None:
        raise ImportError(_NEEDS_PANDAS)
    return table.to_pandas()


class Run(NamedTuple):
    """A recorded run.

    `summary` is the content of summary.json; it is empty while the run is in progress. `table` is a
    pyarrow Table with one row per sample and one column per channel, in SI units with the unit in
    the name. Each of `events` has time_s, level, text, code and fields; programs use code and
    fields. `scenario` is the resolved scenario, with every default written out.
    """

    summary: dict[str, Any]
    table: Any
    events: "list[Event]"
    scenario: dict[str, Any]
    folder: Path

    def frame(self) -> Any:
        """Return the table as a pandas DataFrame. Raises ImportError if pandas is not installed."""
        return _frame(self.table)

    def __repr__(self) -> str:
        """Return the run in three lines: its result, its record, and its folder."""
        samples = f"{self.table.num_rows} samples of {self.table.num_columns} channels"
        return (
            f"<Run {_result(self.summary)}\n"
            f"     {samples}, {len(self.events)} events\n"
            f"     {self.folder}>"
        )


class Campaign(NamedTuple):
    """A finished campaign.

    `summary` is what the command prints: the counts of runs, the worst cases with the command that
    repeats each, and the runs that are not valid. `table` is a pyarrow Table with one row per run:
    the varied values, the figures, and an error if the run failed. `report` is the page.
    """

    summary: dict[str, Any]
    table: Any
    folder: Path
    report: Path

    def frame(self) -> Any:
        """Return the table as a pandas DataFrame. Raises ImportError if pandas is not installed."""
        return _frame(self.table)

    def __repr__(self) -> str:
        """Return the campaign in three lines: its runs, its report, and its folder."""
        count, not_valid = self.summary["runs"], self.summary["not_valid"]
        failed = self.summary["failed"]
        return (
            f"<Campaign {count} runs, {not_valid} not valid, {failed} with an error\n"
            f"     {self.report}\n"
            f"     {self.folder}>"
        )


class Picture(NamedTuple):
    """A picture of a run in a file; a notebook shows it."""

    path: Path

    def _repr_svg_(self) -> str:
        """Return the picture for a notebook."""
        from rollerrig.configs import user_files

        return user_files.read_text(self.path, user_files.PAGE)


def _result(summary: Mapping[str, Any]) -> str:
    """Return the scenario and the result of a run in one line, from its summary."""
    if not summary:
        return "in progress"
    way = f"{summary.get('pacing', '-')}, unit {summary.get('wsp', {}).get('unit') or '-'}"
    validity = "valid" if summary.get("valid") else "not valid"
    result = "did not stop"
    if summary.get("stopped"):
        result = (
            f"stopped after {summary['stop_distance_m']:.1f} m in {summary['stop_time_s']:.1f} s"
        )
    return f"{summary.get('scenario', '-')}: {result}, {way}, {validity}"


def run(
    scenario: str | Path = "velim_a1",
    *,
    pacing: str = "free",
    wsp: str = "reference",
    out: str | Path | None = None,
    seed: int = 0,
    model: str | Path = "",
    faults: Iterable[str] = (),
    unit: str = "",
    **values: Any,
) -> Run:
    """Brake the vehicle once and return the recorded run.

    `scenario` is the name of a packaged scenario or a TOML file. `pacing` is free (without a bus,
    as fast as possible), lockstep or wall (real time). `wsp` is reference, none or fmu:FILE.
    `unit` is the command that starts a WSP unit instead, as in "./unit {host} {port}", which needs
    pacing lockstep or wall. `model` is the file of an extended model. `faults` are texts such as
    "speed_sensor_stuck axle=2 at=5". `values` change the scenario as `--set` does, with a mapping
    for a table: `adhesion={"mu_cd": 0.05}`, `rig="full_scale"`.

    The run is recorded in `out` (default: runs/SCENARIO, with a number if that exists). A run that
    is not valid is returned with a warning. Raises RollerrigError with the message of the command.
    """
    import warnings

    words = ["run", str(scenario), "--pacing", pacing, "--seed", str(seed)]
    words += _unit_words(wsp, unit)
    if model:
        words += ["--model", str(model)]
    if out:
        words += ["--out", str(out)]
    for fault in _texts(faults):
        words += ["--fault", fault]
    for setting in _settings(values):
        words += ["--set", setting]

    result = _call_command(words)
    recorded = load(result["folder"])
    reasons = recorded.summary.get("invalid_because")
    if reasons:
        # stacklevel 2: the warning names the line that called run()
        warnings.warn(
            f"{recorded.folder}: the run is not valid: {'; '.join(reasons)}", stacklevel=2
        )
    return recorded


def load(folder: str | Path) -> Run:
    """Return the record of a run, also of a run that is in progress or was killed.

    Raises ConfigError if the folder holds no run.
    """
    from rollerrig.realtime.record import records

    record = records.load(folder)
    return Run(
        summary=record.summary,
        table=record.table,
        events=record.events,
        scenario=record.scenario,
        folder=record.folder,
    )


def explain(
    stops: str | Path | Run | Iterable[str | Path | Run],
    *,
    out: str | Path | None = None,
    seed: int = 0,
    validate: Iterable[str | Path | Run] = (),
    next: int = 0,
) -> dict[str, Any]:
    """Return how measured stops differ from the simulation, and why: the content of `report.json`.

    `stops` is the name or folder of a dataset, or several runs. `validate` are runs that are never
    fitted. `next` is how many further stops the report proposes. The report and the extended model
    are written to `out` (default: reports/explain_NAME). Raises RollerrigError with the message of
    the command.
    """
    several = [stops] if isinstance(stops, str | Path | Run) else stops
    words = ["explain", *map(_path_text, several), "--seed", str(seed), "--next", str(next)]
    if validate:
        words += ["--validate", *map(_path_text, validate)]
    if out:
        words += ["--out", str(out)]
    return _call_command(words)


def compare(
    *runs: str | Path | Run, tolerances: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """Return how runs differ from the first of them, as `rollerrig compare --json` prints it.

    `tolerances` are the largest allowed differences by unit or channel: {"m_s": 0.1}. The result
    has `figures`, `differences` by channel, and `passed`. Raises RollerrigError.
    """
    words = ["compare", *map(_path_text, runs)]
    for name, value in (tolerances or {}).items():
        words += ["--tolerance", f"{name}={value!r}"]
    return _call_command(words)


def plot(run: str | Path | Run, out: str | Path | None = None) -> Picture:
    """Draw a run over time: speeds, slip, pressures, adhesion and valves of all axles.

    The picture is an SVG in `out` (default: stop.svg in the folder of the run). A notebook shows
    the returned value. Raises RollerrigError if the folder holds no run, or an empty one.
    """
    from rollerrig.realtime.record import export, records
    from rollerrig.realtime.reports import stop

    recorded = records.load(_path_text(run))
    path = Path(out) if out else recorded.folder / "stop.svg"
    export.write(recorded, "svg", path, {"svg": stop.write})
    return Picture(path)


def campaign(
    plan: str | Path,
    *,
    out: str | Path | None = None,
    unit: str = "",
    workers: int = 0,
    worst: str = "braking_distance_m",
) -> Campaign:
    """Do the runs of a plan that are not done yet, and return their results.

    `plan` is the name of a packaged campaign or a TOML file. `out` is the folder of the results
    (default: campaigns/PLAN). `unit` is a command that starts a WSP unit for each run, as in
    "./unit {host} {port}". `workers` is the number of processes (0: one per core). `worst` is the
    figure that ranks the worst cases. Raises RollerrigError.
    """
    words = ["campaign", str(plan), "--workers", str(workers), "--worst", worst]
    if out:
        words += ["--out", str(out)]
    if unit:
        words += ["--unit", unit]
    result = _call_command(words)

    # imported after the command has checked the plan, because it loads the kernels
    from rollerrig.realtime.campaign import campaign as campaigns

    folder = Path(result["folder"])
    return Campaign(result, campaigns.result(folder), folder, Path(result["report"]))


def sequence(
    *sequences: str | Path,
    out: str | Path = "report",
    wsp: str = "",
    unit: str = "",
    pacing: str = "lockstep",
    seed: int = 0,
    about: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Play scripted tests, each on a bench, and return their results and the path of the report.

    `sequences` are names of packaged sequences, TOML files or folders (default: all packaged ones).
    `wsp` and `unit` are as in `run`. `about` are entries of the title block of the report. The
    result has `result` (pass, fail or error), and the result of each sequence in `sequences`.
    Raises RollerrigError if a sequence is wrong.
    """
    words = ["sequence", *map(str, sequences), "--out", str(out)]
    words += ["--pacing", pacing, "--seed", str(seed), *_unit_words(wsp, unit)]
    for key, value in (about or {}).items():
        words += ["--about", f"{key}={value}"]
    return _call_command(words)


def bench(
    scenario: str = "", folder: str | Path | None = None, **options: Any
) -> "AbstractContextManager[Harness]":
    """Return a context manager that starts a bench and yields a harness, which commands it.

        with rollerrig.bench(initial_speed_km_h=60.0, adhesion="soap") as rig:
            rig.brake(bar=3.8)
            rig.stop()

    It is `rollerrig.wsp_interface.harness.bench`, which explains the options.
    """
    from rollerrig.wsp_interface import harness

    return harness.bench(scenario, folder, **options)


def _unit_words(wsp: str, unit: str) -> list[str]:
    """Return the options for a WSP unit: a command wins over the default, the reference unit."""
    if unit:
        return ["--unit", unit]
    return ["--wsp", wsp] if wsp else []


def _texts(given: Iterable[str]) -> list[str]:
    """Return texts as a list; one text is a list of one."""
    return [given] if isinstance(given, str) else list(given)


def _path_text(stop: str | Path | Run) -> str:
    """Return a stop as the command line takes it: the folder of a run, a path or a name."""
    if isinstance(stop, Run):
        return str(stop.folder)
    return str(stop)


def _settings(values: Mapping[str, Any], section: str = "") -> list[str]:
    """Return values as the option --set takes them: SECTION.KEY=VALUE.

    `section` is the prefix of all keys, with its last dot.
    """
    settings: list[str] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            settings += _settings(value, f"{section}{key}.")
        elif isinstance(value, str):
            settings.append(f"{section}{key}={value}")
        else:
            # JSON does not know the scalars of numpy: `item` returns them as numbers of Python
            text = json.dumps(value, default=lambda scalar: scalar.item())
            settings.append(f"{section}{key}={text}")
    return settings


def _call_command(words: list[str]) -> dict[str, Any]:
    """Run a command with --json and return the object that it prints.

    Its progress is copied to standard error. Raises RollerrigError, or the subclass that the
    command reports, if the command fails; the message is in the error only.
    """
    import subprocess
    import tempfile

    from rollerrig.configs import errors
    from rollerrig.configs.processes import children

    last_line = ""
    # the result goes to a file, so that the command never waits for a reader of its output
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8") as output,
        subprocess.Popen(
            children.command(
                *children.module("rollerrig.realtime.cli", *words, "--json", "--from-python")
            ),
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.PIPE,
        ) as process,
    ):
        assert process.stderr
        for line in process.stderr:
            last_line = line.strip() or last_line
            print(line, end="", file=sys.stderr)
        status = process.wait()
        output.seek(0)
        text = output.read()

    try:
        result: dict[str, Any] = json.loads(text)
    except ValueError:
        # no JSON: the command crashed or was killed; its last message may have the reason
        reason = last_line or "it printed no message"
        raise RollerrigError(
            f"rollerrig {words[0]} exited with status {status}: {reason}"
        ) from None
    # a sequence counts its errors under the key "error"
    if {"error", "kind"} <= set(result):
        kind = getattr(errors, str(result.get("kind")), RollerrigError)
        raise kind(result["error"])
    return result
