"""The forces and the work of friction brake, motors and magnets, from the recorded channels.

A vehicle without motors and magnets has only its friction brake, and nothing is computed for it.
Forces are those of all axles together; those of the friction brake and of the motors are at the
rims of the wheels.

    [K1] W = integral of sum_j C_j omega_j dt, C_j the torque of the friction brake on wheelset j

The channels `dynamic_work` and `track_brake_work` have the work of motors and magnets.
"""

from collections.abc import Callable

import numpy as np

from rollerrig.configs.vehicle import Kind
from rollerrig.wsp_interface import signals

FRICTION = "friction"
MOTORS = "motors"
MAGNETS = "magnets"
# name of each brake for people
TITLES = {FRICTION: "friction brake", MOTORS: "motors", MAGNETS: "magnets"}

# returns a recorded channel by name, shape (n,)
Channel = Callable[[str], np.ndarray]


def brakes(kind: Kind) -> tuple[str, ...]:
    """Return the brakes of a kind of vehicle; none if there is only a friction brake."""
    found = []
    if kind.dynamic_brake:
        found.append(MOTORS)
    if kind.magnetic_track_brake:
        found.append(MAGNETS)
    return (FRICTION, *found) if found else ()


def forces_N(kind: Kind, channel: Channel, radius_m: float) -> dict[str, np.ndarray]:
    """Return the force of each brake on the vehicle, shape (n,), negative in traction.

    `kind` is that of the vehicle, `radius_m` is the radius of the wheels.
    """
    found = {}
    for brake in brakes(kind):
        if brake == MAGNETS:
            found[brake] = _sum(kind, channel, "track_brake_force")
        else:
            name = "brake_torque" if brake == FRICTION else "dynamic_torque"
            found[brake] = _sum(kind, channel, name) / radius_m
    return found


def of(kind: Kind, channel: Channel, radius_m: float) -> dict[str, dict[str, float | None]]:
    """Return work in J, share of the work of all brakes, and largest force in N of each brake.

    The share is None where the brakes together took no energy, or where motors drove the vehicle.
    """
    time_s = channel("time_s")
    if not len(time_s):
        return {}
    works_J = {}
    for brake in brakes(kind):
        if brake == MOTORS:
            works_J[brake] = float(_sum(kind, channel, "dynamic_work")[-1])
        elif brake == MAGNETS:
            works_J[brake] = float(channel("track_brake_work_J")[-1])
        else:
            works_J[brake] = _friction_work_J(kind, channel, time_s)
    total_J = sum(works_J.values())
    shared = total_J > 0.0 and min(works_J.values()) >= 0.0

    forces = forces_N(kind, channel, radius_m)
    return {
        brake: {
            "work_J": work_J,
            "share": work_J / total_J if shared else None,
            "force_max_N": float(np.max(forces[brake])),
        }
        for brake, work_J in works_J.items()
    }


def _friction_work_J(kind: Kind, channel: Channel, time_s: np.ndarray) -> float:
    """Return the work of the friction brakes of all wheelsets [K1]."""
    power_W = np.zeros(len(time_s))
    for axle in range(1, kind.axles + 1):
        power_W += channel(f"brake_torque_{axle}_Nm") * channel(f"wheel_speed_{axle}_rad_s")
    return float(np.trapezoid(power_W, time_s))


def _sum(kind: Kind, channel: Channel, name: str) -> np.ndarray:
    """Return the sum of a signal over all axles, shape (n,)."""
    columns = signals.columns(signals.table(kind).by_name[name])
    return np.sum([channel(column) for column in columns], axis=0)
