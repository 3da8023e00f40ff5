"""rollerrig from Python and from notebooks: `run` a stop, `load` a run's folder, `explain` measured stops.

    import rollerrig

    stop = rollerrig.run("velim_a1", adhesion="soap", initial_speed_m_s=20.0)
    stop.summary["stop_distance_m"], stop.table["sliding_1_m_s"], stop.frame().plot(x="time_s", y="sliding_1_m_s")

Each call is the command of the same name in a process of its own, so that a notebook and a terminal do the same. This
file is the package `rollerrig` itself: it is loaded before every other one, and so imports next to nothing.
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
    if name != "__version__":
        raise AttributeError(f"module 'rollerrig' has no attribute '{name}'")
    from importlib import metadata

    return metadata.version("rollerrig")


class Run(NamedTuple):
    """A recorded run.

    `summary` is what summary.json holds (empty while the run goes on), `table` a pyarrow Table with one row a sample
    and one column a channel, in SI with the unit in the name. Each of `events` has time_s, level, text, code and
    fields; programs use code and fields. `scenario` is the resolved one.
    """

    summary: dict[str, Any]
    table: Any
    events: "list[Event]"
    scenario: dict[str, Any]
    folder: Path

    def frame(self) -> Any:
        """The table as a pandas DataFrame. Raises ImportError where pandas is not installed."""
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
    """Brake the vehicle once, and return what was recorded.

    `scenario` is a packaged one or a TOML file, `pacing` free (without a bus, as fast as it goes), lockstep or wall
    (real time), `wsp` reference, none or fmu:FILE. `values` change the scenario as `--set` does, a table as a mapping:
    `adhesion={"mu_cd": 0.05}`, `rig="full_scale"`. `faults` are texts such as "speed_sensor_stuck axle=2 at=5". The run
    is recorded in `out` (default: runs/SCENARIO, with a number if it exists). A run that is not valid is returned as
    well, with a warning. Raises RollerrigError with what the command says: where, what, what is allowed.
    """
    import warnings

    words = ["run", str(scenario), "--pacing", pacing, "--wsp", wsp, "--seed", str(seed)]
    words += ["--model", str(model)] if model else []
    words += ["--out", str(out)] if out else []
    words += [word for fault in faults for word in ("--fault", fault)]
    words += [word for setting in _settings(values) for word in ("--set", setting)]
    found = load(_call(words)["folder"])
    if because := found.summary.get("invalid_because"):
        warnings.warn(f"{found.folder}: the run is not valid: {'; '.join(because)}", stacklevel=2)
    return found


def load(folder: str | Path) -> Run:
    """The record of a run, also of one that still runs or was killed. Raises ConfigError for no run's folder."""
    from rollerrig.realtime.record import records

    found = records.load(folder)
    return Run(found.summary, found.table, found.events, found.scenario, found.folder)


def explain(
    stops: str | Path | Run | Iterable[str | Path | Run],
    *,
    out: str | Path | None = None,
    seed: int = 0,
    validate: Iterable[str | Path | Run] = (),
    next: int = 0,
) -> dict[str, Any]:
    """What measured stops do otherwise than the simulation, and why: the report as `report.json` has it.

    `stops` is the name or folder of a dataset, or several runs; `validate` runs that are never fitted, `next` how many
    further stops to propose. The report, and the model that has the causes, stand in `out` (default:
    reports/explain_NAME). Raises RollerrigError with what the command says.
    """
    several = [stops] if isinstance(stops, str | Path | Run) else stops
    words = ["explain", *map(_place, several), "--seed", str(seed), "--next", str(next)]
    words += ["--validate", *map(_place, validate)] if validate else []
    return _call([*words, *(["--out", str(out)] if out else [])])


def _place(one: str | Path | Run) -> str:
    return str(one.folder if isinstance(one, Run) else one)


def _settings(values: Mapping[str, Any], section: str = "") -> list[str]:
    """As `--set` takes them: SECTION.KEY=VALUE."""
    found: list[str] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            found += _settings(value, f"{section}{key}.")
        else:
            text = (
                value
                if isinstance(value, str)
                else json.dumps(value, default=lambda one: one.item())
            )
            found.append(f"{section}{key}={text}")
    return found


def _call(words: list[str]) -> dict[str, Any]:
    """The command's one object; what it says meanwhile goes to standard error."""
    import subprocess
    import tempfile

    from rollerrig.configs.errors import RollerrigError
    from rollerrig.configs.processes import children

    said: list[str] = []
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8") as result,
        subprocess.Popen(
            children.command(sys.executable, "-m", "rollerrig.realtime.cli", *words, "--json"),
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=result,
            stderr=subprocess.PIPE,
        ) as process,
    ):
        assert process.stderr
        for line in process.stderr:
            said.append(line)
            print(line, end="", file=sys.stderr)
        status = process.wait()
        result.seek(0)
        text = result.read()
    try:
        found: dict[str, Any] = json.loads(text)
    except ValueError:  # the usage of the command line, or a crash
        found = {"error": (said or ["no word"])[-1].strip()}
    if "error" in found:
        raise RollerrigError(f"rollerrig {words[0]} ended with status {status}: {found['error']}")
    return found
