"""rollerrig for Python and notebooks: `run` a stop, `load` the folder of a run, `explain` stops.

    import rollerrig

    stop = rollerrig.run("velim_a1", adhesion="soap", initial_speed_m_s=20.0)
    stop.summary["stop_distance_m"]
    stop.table["sliding_1_m_s"]
    stop.frame().plot(x="time_s", y="sliding_1_m_s")

`run` and `explain` start the command of the same name in a separate process, so that a notebook and
a terminal get the same results. This file is the package `rollerrig` itself. Python loads it before
every other module of the package, so it imports almost nothing.
"""

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rollerrig.wsp_interface.events import Event

__all__ = ["Run", "__version__", "explain", "load", "run"]


def __getattr__(name: str) -> str:
    """Return `__version__`, which is looked up only on use. Raises AttributeError otherwise."""
    if name != "__version__":
        raise AttributeError(f"module 'rollerrig' has no attribute '{name}'")
    from importlib import metadata

    return metadata.version("rollerrig")


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
        return self.table.to_pandas()


def run(
    scenario: str | Path = "velim_a1",
    *,
    pacing: str = "free",
    wsp: str = "reference",
    out: str | Path | None = None,
    seed: int = 0,
    model: str | Path = "",
    faults: Iterable[str] = (),
    **values: Any,
) -> Run:
    """Brake the vehicle once and return the recorded run.

    `scenario` is the name of a packaged scenario or a TOML file. `pacing` is free (without a bus,
    as fast as possible), lockstep or wall (real time). `wsp` is reference, none or fmu:FILE.
    `model` is the file of an extended model. `faults` are texts such as
    "speed_sensor_stuck axle=2 at=5". `values` change the scenario as `--set` does, with a mapping
    for a table: `adhesion={"mu_cd": 0.05}`, `rig="full_scale"`.

    The run is recorded in `out` (default: runs/SCENARIO, with a number if that exists). A run that
    is not valid is returned with a warning. Raises RollerrigError with the message of the command.
    """
    import warnings

    words = ["run", str(scenario), "--pacing", pacing, "--wsp", wsp, "--seed", str(seed)]
    if model:
        words += ["--model", str(model)]
    if out:
        words += ["--out", str(out)]
    for fault in faults:
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

    Its messages are copied to standard error. Raises RollerrigError if the command fails.
    """
    import subprocess
    import tempfile

    from rollerrig.configs.errors import RollerrigError
    from rollerrig.configs.processes import children

    messages: list[str] = []
    # the result goes to a file, so that the command never waits for a reader of its output
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8") as output,
        subprocess.Popen(
            children.command(*children.module("rollerrig.realtime.cli", *words, "--json")),
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.PIPE,
        ) as process,
    ):
        assert process.stderr
        for line in process.stderr:
            messages.append(line)
            print(line, end="", file=sys.stderr)
        status = process.wait()
        output.seek(0)
        text = output.read()

    try:
        result: dict[str, Any] = json.loads(text)
    except ValueError:
        # no JSON: a usage error of the command line, or a crash; the last message has the reason
        last_message = messages[-1].strip() if messages else "it printed no message"
        result = {"error": last_message}
    if "error" in result:
        raise RollerrigError(f"rollerrig {words[0]}: exit status {status}: {result['error']}")
    return result
