"""Courses in time of the friction causes: what one unit of a cause adds to ln mu at each sample.

The replay, the columns of the search, the simulator and the extended model all take a cause's shape
from here, so that they cannot drift apart.
"""

import numpy as np

from rollerrig.rig.identify.data.preparation import Design

NAMES = ("rail_cleaning", "speed_dependent_friction", "friction_trend", "negative_conditioning",
         "contaminated_patch", "sanding")
# covariates of an empirical term; their places are its code, 0 is none
COVARIATES = ("none", "speed", "time", "place", "sliding", "load", "energy", "disc_heat", "slid",
              "wheel_angle")
MIDDLE_SPEED_M_S = 20.0
# a scale as wide as this is none
WIDE = 1e4


def course(d: Design, name: str, shape: dict[str, float]) -> np.ndarray:
    """ln mu for one unit of a cause in a shape, shape (n,). KeyError for an unknown cause."""
    if name == "rail_cleaning":
        return -np.expm1(-d.cleaned_J_m / shape["energy_J_m"])
    if name == "speed_dependent_friction":
        above = d.speed_m_s - MIDDLE_SPEED_M_S
        knee = shape.get("knee_m_s", WIDE)
        return above if knee >= WIDE else -knee * np.expm1(-above / knee)
    if name == "friction_trend":
        if "time_s" not in shape:
            return d.time_s
        return -shape["time_s"] * np.expm1(-d.time_s / shape["time_s"])
    if name == "negative_conditioning":
        return np.expm1(-d.slid_m / shape["distance_m"])
    if name == "contaminated_patch":
        return -patch(d.place_m, shape["start_m"], shape["length_m"], shape.get("ramp", 0.0))
    if name == "sanding":
        return _windows(d, shape)
    raise KeyError(name)


def patch(place_m: np.ndarray, start_m: float, length_m: float, ramp: float) -> np.ndarray:
    """1 inside a patch, 0 outside, with cosine edges over a share `ramp` of its length."""
    if ramp <= 0.0:
        return ((place_m >= start_m) & (place_m < start_m + length_m)).astype(float)
    edge = np.minimum(place_m - start_m, start_m + length_m - place_m)
    return np.sin(0.5 * np.pi * np.clip(edge / (0.5 * ramp * max(length_m, 1e-9)), 0.0, 1.0)) ** 2


def covariate(d: Design, name: str) -> np.ndarray:
    """A covariate of an empirical term at each sample, shape (n,)."""
    return {"speed": d.speed_m_s, "time": d.time_s, "place": d.place_m, "sliding": d.sliding_m_s,
            "load": d.load_N, "energy": d.energy_J_m, "disc_heat": d.heat_MJ, "slid": d.slid_m,
            "wheel_angle": d.angle_rad}[name]


def empirical(d: Design, shape: dict[str, float]) -> np.ndarray:
    """Two courses of an empirical term, shape (n, 2): z and z^2, or a wave's cosine and sine."""
    x = covariate(d, COVARIATES[int(shape["covariate"])])
    if "period" in shape:
        turn = 2.0 * np.pi * x / shape["period"]
        return np.column_stack([np.cos(turn), np.sin(turn)])
    z = (x - shape["centre"]) / shape["scale"]
    return np.column_stack([z, z * z])


def of_vehicle(d: Design, values: np.ndarray) -> np.ndarray:
    """Those of the samples that belong to the first wheelset of each run, the vehicle's."""
    return np.concatenate([values[d.span(4 * run)] for run in range(d.mass_kg.size)])


def heat(d: Design, shape: dict[str, float]) -> np.ndarray:
    """Brake work in MJ that fades, shape (n,)."""
    scale = shape.get("heat_MJ", WIDE)
    return d.heat_MJ if scale >= WIDE else -scale * np.expm1(-d.heat_MJ / scale)


def resistance(d: Design, shape: dict[str, float]) -> np.ndarray:
    """Course of a resistance on the vehicles' samples, 1 at 20 m/s, shape (vehicle samples,)."""
    speed = np.concatenate([d.speed_m_s[d.span(4 * run)] for run in range(d.mass_kg.size)])
    return (speed / MIDDLE_SPEED_M_S) ** shape.get("speed_power", 0.0)


def applied(d: Design, shape: dict[str, float]) -> np.ndarray:
    """Where a torque offset acts, 0 or 1, shape (n,)."""
    return (d.brake_Nm > shape.get("from_Nm", -WIDE)).astype(float)


def _windows(d: Design, shape: dict[str, float]) -> np.ndarray:
    out = np.zeros(d.time_s.size)
    for run, name in enumerate(d.names):
        low, length = shape.get(f"start_s {name}", 0.0), shape.get(f"duration_s {name}", 0.0)
        if length > 0.0:
            rows = (d.run == run) & ((d.axle > 0) | (shape.get("behind", 0.0) == 0.0))
            own = np.repeat(rows, np.diff(d.start))
            out[own & (d.time_s >= low) & (d.time_s < low + length)] = 1.0
    return out
