"""How a run is run."""

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
