"""Courses in time of the friction causes: what one unit of a cause adds to ln mu at each sample.

The replay, the columns of the search, the simulator and the extended model all take a cause's shape
from here, so that they cannot drift apart.
"""

import numpy as np

from rollerrig.rig.identify.preparation import Design

NAMES = ("rail_cleaning", "speed_dependent_friction", "friction_trend", "negative_conditioning",
         "contaminated_patch", "sanding", "empirical")
MIDDLE_SPEED_M_S = 20.0


def course(d: Design, name: str, shape: dict[str, float]) -> np.ndarray:
    """ln mu for one unit of a cause in a shape, shape (n,). KeyError for an unknown cause."""
    if name == "rail_cleaning":
        return -np.expm1(-d.cleaned_J_m / shape["energy_J_m"])
    if name == "speed_dependent_friction":
        return d.speed_m_s - MIDDLE_SPEED_M_S
    if name == "friction_trend":
        if "time_s" not in shape:
            return d.time_s
        return -shape["time_s"] * np.expm1(-d.time_s / shape["time_s"])
    if name == "negative_conditioning":
        return np.expm1(-d.slid_m / shape["distance_m"])
    if name == "contaminated_patch":
        low = shape["start_m"]
        return -1.0 * ((d.place_m >= low) & (d.place_m < low + shape["length_m"]))
    if name == "sanding":
        return _windows(d, shape)
    raise KeyError(name)


def _windows(d: Design, shape: dict[str, float]) -> np.ndarray:
    out = np.zeros(d.time_s.size)
    for run, name in enumerate(d.names):
        low, length = shape.get(f"start_s {name}", 0.0), shape.get(f"duration_s {name}", 0.0)
        if length > 0.0:
            own = np.repeat(d.run == run, np.diff(d.start))
            out[own & (d.time_s >= low) & (d.time_s < low + length)] = 1.0
    return out
