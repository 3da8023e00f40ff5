"""Finds a vehicle speed that is computed from the wheel speeds.

Two independent sensors differ by their noise at every sample. A speed that equals the fastest
wheel, the second fastest, or the mean, to far less than the noise, was made of them. Then sliding
is no measurement: a wheel that slides pulls its reference along.
"""

import numpy as np

from rollerrig.rig.identify.base.findings import Code, Finding
from rollerrig.rig.identify.data.preparation import estimated_noise
from rollerrig.rig.identify.data.runs import Dataset, Run

# A sample equals a function of the wheels if it differs by less than this share of the noise of one
# rim. Of independent samples at most 0.08 do so. Chosen.
SAME = 0.1
MOST_SAME = 0.3
LEAST_SPEED_M_S = 5.0
# share by which radii may be wrong in the computed speed
_SCALE = 0.05


def functions_of_rims(rims_m_s: np.ndarray) -> dict[str, np.ndarray]:
    """Return usual references of the rims' speeds (n, axles) by their names, (n,) each."""
    order = np.sort(rims_m_s, axis=1)
    functions = {
        "the fastest wheelset": order[:, -1],
        "the second fastest wheelset": order[:, -2],
        "the mean of all wheelsets": rims_m_s.mean(axis=1),
        "the median of all wheelsets": np.median(rims_m_s, axis=1),
        "the mean of the two fastest wheelsets": order[:, -2:].mean(axis=1),
    }
    for axle in range(rims_m_s.shape[1]):
        functions[f"wheelset {axle + 1}"] = rims_m_s[:, axle]
    return functions


def shares_same(run: Run, radius_m: float) -> dict[str, float]:
    """Return the share of samples in which the vehicle's speed equals each function of the rims."""
    fast = run.speed_m_s > LEAST_SPEED_M_S
    speed_m_s = run.speed_m_s[fast]
    rims_m_s = radius_m * run.wheel_speed_rad_s[fast]
    noise_m_s = radius_m * estimated_noise(run.wheel_speed_rad_s)
    shares = {}
    for name, function in functions_of_rims(rims_m_s).items():
        # the computed speed may have another radius: compare with its most usual scale
        scale = float(np.median(speed_m_s / np.maximum(function, 1e-9)))
        if abs(scale - 1.0) > _SCALE:
            continue
        shares[name] = float(np.mean(np.abs(speed_m_s - scale * function) < SAME * noise_m_s))
    return shares


def check(data: Dataset) -> list[Finding]:
    """Return a finding if the vehicle's speed is a function of the wheel speeds."""
    if any(run.surface_m_s is not None for run in data.runs):
        return []  # on a rig the surface has its speed, whatever the vehicle's is made of
    radius_m = data.sections["vehicle"]["wheel_radius_m"]
    by_name: dict[str, list[float]] = {}
    for run in data.runs:
        if np.count_nonzero(run.speed_m_s > LEAST_SPEED_M_S) > 100:
            for name, share in shares_same(run, radius_m).items():
                by_name.setdefault(name, []).append(share)
    largest = {name: float(np.median(shares)) for name, shares in by_name.items()}
    name = max(largest, key=lambda one: largest[one], default="")
    if not name or largest[name] < MOST_SAME:
        return []
    return [Finding(Code.REFERENCE, measured=largest[name], allowed=MOST_SAME, detail=name)]
