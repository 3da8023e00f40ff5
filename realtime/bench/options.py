"""How a run is run, and the folder it leaves behind."""

from pathlib import Path
from typing import NamedTuple

from rollerrig.configs.errors import ConfigError


class Options(NamedTuple):
    """How a run is run; the scenario says what. `unit`: reference, external or none."""

    pacing: str = "wall"
    unit: str = "reference"
    out: Path = Path("runs/run")
    live: bool = False
    seed: int = 0
    unit_wait_s: float = 60.0
    start: str = "now"
    harness: bool = False


class Progress(NamedTuple):
    """What the progress line shows."""

    time_s: float
    speed_m_s: float
    sliding_m_s: float
    missed: int
    message: str = ""


def check_options(options: Options) -> None:
    """Refuse options that contradict each other. Raises ConfigError."""
    if options.pacing == "free" and options.unit == "external":
        raise ConfigError("--pacing free waits for no bus, so no external unit can answer; use "
                          "--pacing lockstep (repeatable) or wall (real time)")


def prepare_folder(out: Path) -> None:
    """Make the run's folder, without what an earlier run left there. Raises ConfigError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        foreign = [path.name for path in out.iterdir() if path.is_dir()]
        if foreign or (any(out.iterdir()) and not (out / "scenario.toml").is_file()):
            raise ConfigError(f"{out} is not empty and not a run's folder; give a new one with --out")
        for path in out.iterdir():
            path.unlink()
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}; give another folder with "
                          "--out") from None
