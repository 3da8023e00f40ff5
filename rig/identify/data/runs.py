"""The types of measured data: a run (one stop), a creep curve, and the dataset that holds them."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

# adhesion of a measured creep curve: wheels with grousers on sand reach 2.2, tyres of racing cars
# 3.9 in single samples at small loads
LARGEST_ADHESION = 4.0


class Run(NamedTuple):
    """One measured stop. Arrays have the shape (n,), or (n, axles) with one column per wheelset."""

    name: str
    group: str  # "tune" or "validate"
    mass_kg: float  # inf: drives held the speed of the surface, whatever force the wheels had
    mu_cd: float | None  # friction of the degraded contact; None: it is estimated
    time_s: np.ndarray
    speed_m_s: np.ndarray
    wheel_speed_rad_s: np.ndarray
    load_N: np.ndarray
    torque_Nm: np.ndarray
    position_m: np.ndarray | None  # None: not measured
    surface_m_s: np.ndarray | None  # roller surface speed on a rig, (n, axles); None: on a track
    date: str = ""  # year-month-day; "": not given
    rig: str = ""  # name of the rig, the vehicle or the equipment; "": not given

    @property
    def axles(self) -> int:
        """The number of wheelsets of the vehicle."""
        return self.wheel_speed_rad_s.shape[1]


class Curve(NamedTuple):
    """A measured creep curve. All arrays have the shape (n,)."""

    creepage: np.ndarray
    adhesion: np.ndarray
    speed_m_s: np.ndarray
    load_N: np.ndarray
    series: np.ndarray  # number of the measured series of each point
    temperature_K: np.ndarray | None = None  # None: not measured
    pressure_Pa: np.ndarray | None = None  # of a tyre, or of the contact; None: not measured

    def chosen(self, points: np.ndarray) -> "Curve":
        """Return the points with these places (k,), in this order."""
        temperature_K = self.temperature_K
        pressure_Pa = self.pressure_Pa
        return Curve(
            creepage=self.creepage[points],
            adhesion=self.adhesion[points],
            speed_m_s=self.speed_m_s[points],
            load_N=self.load_N[points],
            series=self.series[points],
            temperature_K=None if temperature_K is None else temperature_K[points],
            pressure_Pa=None if pressure_Pa is None else pressure_Pa[points],
        )


class Dataset(NamedTuple):
    """Checked measured data. `sections` are the parameter tables that `params.check` returns."""

    name: str
    kind: str  # one of the kinds of `dataset.HEAD`
    folder: Path
    sample_time_s: float
    sections: dict[str, dict[str, Any]]
    accuracy: dict[str, float]  # by the names of `dataset.ACCURACY`
    axle_position_m: np.ndarray  # (axles,), distance behind the first wheelset
    runs: list[Run]
    curve: Curve | None  # of a dataset of the kind creep_curve
    warnings: list[str]

    @property
    def axles(self) -> int:
        """The number of wheelsets of the vehicle."""
        return self.axle_position_m.size

    def group(self, name: str) -> list[Run]:
        """Return the runs of a group."""
        return [run for run in self.runs if run.group == name]
