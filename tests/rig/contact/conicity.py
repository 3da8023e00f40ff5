"""Equivalent conicity: the cone on which a wheelset would run with the same wavelength.

A wheelset that is shifted sideways rolls on two different radii, and their difference steers it
back. Here it is laid down so that both wheels just touch. The difference is tabulated over the
shift. The wavelength of the motion of a given amplitude follows by integration. A cone with the
same wavelength has the equivalent conicity.

[E1] y'' = -dr(y) / (e r0), e between the running circles, dr = r_left - r_right for a shift y
[E2] lambda = 4 int_0^A dy / sqrt(2 (V(A) - V(y))), V = int dr / (e r0) dy
[E3] tan gamma_e = (2 pi / lambda)^2 e r0 / 2

Source: EN 15302, annex on integration; Klingel 1883. Rigid contact: no patch, no load.
"""

import math

import numpy as np

from rollerrig.rig.contact import geometry
from rollerrig.rig.contact.profiles import Rail, Wheel

# Newton steps that lay a wheelset down
_STEPS = 12
# points of the integral over a quarter of the motion
_QUARTER_POINTS = 4000


def settle(
    y_m: float, wheel: Wheel, rail: Rail, roller_m: float = math.inf
) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Lay a wheelset shifted by y_m (left positive) down on both rails.

    Returns its height in m, its roll in rad, and the deepest contact of the left and of the right
    wheel, each a row of `geometry.COLUMNS`.
    """
    z = float(wheel.fine[int(-wheel.start_m / wheel.spacing_m), 0])
    roll = 0.0
    for _ in range(_STEPS):
        left = geometry.contacts((0.0, y_m, z, roll, 0.0, 0.0), wheel, rail, roller_m)[0]
        right = geometry.contacts((0.0, -y_m, z, -roll, 0.0, 0.0), wheel, rail, roller_m)[0]
        # d gap = n_z dz +- (Y n_z - Z n_y) droll
        arm_left = left[geometry.Y] * left[geometry.NZ] - left[geometry.Z] * left[geometry.NY]
        arm_right = right[geometry.Y] * right[geometry.NZ] - right[geometry.Z] * right[geometry.NY]
        system = np.array(((left[geometry.NZ], arm_left), (right[geometry.NZ], -arm_right)))
        move = np.linalg.solve(system, -np.array((left[geometry.GAP], right[geometry.GAP])))
        z = z + move[0]
        roll = roll + move[1]
        if np.abs(move).max() < 1e-10:
            break
    return z, roll, left, right


def radius_difference(
    shifts_m: np.ndarray, wheel: Wheel, rail: Rail, roller_m: float = math.inf
) -> np.ndarray:
    """Return the rolling radius of the left wheel less that of the right one, in m, by shift."""
    differences = []
    for shift in shifts_m:
        _, _, left, right = settle(float(shift), wheel, rail, roller_m)
        differences.append(left[geometry.RADIUS] - right[geometry.RADIUS])
    return np.array(differences)


def equivalent(
    amplitude_m: float, wheel: Wheel, rail: Rail, roller_m: float = math.inf, points: int = 61
) -> float:
    """Return the equivalent conicity tan gamma_e at an amplitude in m [E1 to E3].

    Raises ValueError where the wheelset is not steered back over the whole amplitude.
    """
    shifts = np.linspace(0.0, amplitude_m, points)
    steering = radius_difference(shifts, wheel, rail, roller_m)

    # the potential V [E2], by the trapezoidal rule
    fine = np.linspace(0.0, amplitude_m, 20001)
    slope = np.interp(fine, shifts, steering)
    areas = 0.5 * (slope[1:] + slope[:-1]) * np.diff(fine)
    V = np.concatenate(([0.0], np.cumsum(areas)))

    # y = A sin(t) removes the singularity at the turning point
    step = 0.5 * math.pi / _QUARTER_POINTS
    t = (np.arange(_QUARTER_POINTS) + 0.5) * step
    y = amplitude_m * np.sin(t)
    remaining = V[-1] - np.interp(y, fine, V)
    if np.any(remaining <= 0.0):
        raise ValueError(
            f"equivalent conicity at {amplitude_m * 1e3:g} mm: the rolling radii do not steer the "
            "wheelset back over the whole amplitude; take another amplitude or profile"
        )
    # e r0 cancels between [E2] and [E3]
    integrand = amplitude_m * np.cos(t) / np.sqrt(2.0 * remaining)
    wavelength = 4.0 * np.sum(integrand) * step
    return float(0.5 * (2.0 * math.pi / wavelength) ** 2)  # [E3]
