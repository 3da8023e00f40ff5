"""What measured data is once it is read: stops, a creep curve, and the set that holds them."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.rig.state import AXLES as AXLES


class Run(NamedTuple):
    """One stop: arrays (n,) or (n, 4), SI units; `position_m` may be None."""

    name: str
    group: str
    mass_kg: float  # inf: drives held the speed of the surface, whatever the wheels did
    mu_cd: float | None
    time_s: np.ndarray
    speed_m_s: np.ndarray
    wheel_speed_rad_s: np.ndarray
    load_N: np.ndarray
    torque_Nm: np.ndarray
    position_m: np.ndarray | None
    surface_m_s: np.ndarray | None  # (n, 4): roller surface speed on a rig; None on a track


class Curve(NamedTuple):
    """Measured creep curve: arrays (n,)."""

    creepage: np.ndarray
    adhesion: np.ndarray
    speed_m_s: np.ndarray
    load_N: np.ndarray
    series: np.ndarray


class Dataset(NamedTuple):
    """Checked data. `sections` are checked parameter tables as `params.check` gives them."""

    name: str
    kind: str
    folder: Path
    sample_time_s: float
    sections: dict[str, dict[str, Any]]
    accuracy: dict[str, float]
    axle_position_m: np.ndarray
    runs: list[Run]
    curve: Curve | None
    warnings: list[str]

    def group(self, name: str) -> list[Run]:
        """The runs of a group."""
        return [run for run in self.runs if run.group == name]
