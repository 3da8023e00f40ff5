"""The rough course of a stop that has not been run yet, for the simulator.

In the rough course the wheels slide as a WSP lets them: their sliding swings about a share of the
speed. Where the brake torque is smaller than the adhesion at that sliding, the wheel creeps as much
as the torque needs. The torque follows from these courses [K1]. The simulator then gives torque and
sliding their dynamics. No wheelset is integrated here.

    [K1] C = r N f(s) - J domega/dt, at least 0; r N f(s) is at most the torque of the brake
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.vehicle import GRAVITY_M_S2, brake_torque_Nm_Pa
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import adhesion
from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.data.parameters import MU_CD, TAU, wheel_model
from rollerrig.rig.identify.data.runs import Dataset, Run

LONGEST_S = 45.0  # a stop that takes longer is cut off
SLOWEST_M_S = 4.0  # a stop ends at this speed
RELEASED_S = 1.0  # time with released brake, before the brake is applied
FILL_S = 1.3  # time constant of the brake cylinders

# Sliding that a WSP lets wheels have: SHARE of the speed plus LEAST_M_S, which swings by the share
# SWING of itself.
SHARE = 0.07
LEAST_M_S = 0.4
SWING = 0.5
PERIOD_S = 1.6  # of the swing
PHASE_S = 0.3  # lead of the swing from each wheelset to the next
CONTROL_S = 0.05  # the sliding is computed once in this time
SMOOTHING_S = 0.08  # of sliding and force
BISECTIONS = 14  # of the sliding of a creeping wheel


class Stop(NamedTuple):
    """A stop to run: how it begins and how it brakes."""

    initial_speed_m_s: float
    pressure_Pa: float
    mass_kg: float
    axle: int  # the only wheelset that brakes; 0: all brake
    held_s: float = 0.0  # above 0: the rig holds the speed for this time

    @property
    def last_speed_m_s(self) -> float:
        """The speed at which the stop ends.

        It is half the initial speed if only one wheelset brakes: a whole stop would take too long.
        """
        if self.axle:
            return 0.5 * self.initial_speed_m_s
        return SLOWEST_M_S


def is_on_rollers(data: Dataset) -> bool:
    """Return whether the runs of a dataset are those of a roller rig, not of a track."""
    return math.isfinite(data.sections["contact"]["roller_radius_m"])


# --- the rough course ---


class _Course(NamedTuple):
    """The speed of the vehicle, and sliding and force of the wheelsets."""

    speed_m_s: np.ndarray  # (n,)
    sliding_m_s: np.ndarray  # (n, axles)
    force_N: np.ndarray  # (n, axles)


def rough_run(data: Dataset, base: np.ndarray, stop: Stop, explanation: Explanation) -> Run:
    """Return the rough course of a stop under a fitted explanation, without noise.

    `base` (PARAMETERS,) holds the parameters of the base model.
    """
    step_s = data.sample_time_s
    vehicle = data.sections["vehicle"]
    radius_m = vehicle["wheel_radius_m"]
    row = base.copy()
    row[TAU] *= math.exp(explanation.base.get("ln_tau", 0.0))
    row[MU_CD] *= math.exp(explanation.level)

    # a rig that holds the speed is a vehicle of infinite mass
    mass_kg = math.inf if stop.held_s else stop.mass_kg
    axles = data.axles
    is_braked = np.array([stop.axle in (0, axle) for axle in range(1, axles + 1)])
    load_N = stop.mass_kg * GRAVITY_M_S2 / axles
    course = _course(data, stop, row, is_braked, mass_kg)

    # the sliding is computed in steps of CONTROL_S: smooth them
    speed_m_s = course.speed_m_s
    window = SMOOTHING_S / step_s
    sliding_m_s = gaussian_filter1d(course.sliding_m_s, window, axis=0, mode="nearest")
    force_N = gaussian_filter1d(course.force_N, window, axis=0, mode="nearest")

    wheel_rad_s = (speed_m_s[:, None] - sliding_m_s) / radius_m
    rate_rad_s2 = np.gradient(wheel_rad_s, step_s, axis=0)
    torque_Nm = radius_m * force_N - vehicle["wheelset_inertia_kgm2"] * rate_rad_s2  # [K1]

    surface_m_s = None
    if is_on_rollers(data):
        surface_m_s = np.repeat(speed_m_s[:, None], axles, axis=1)
    n = speed_m_s.size
    return Run(
        name="planned",
        group="tune",
        mass_kg=mass_kg,
        mu_cd=None,
        time_s=step_s * np.arange(n),
        speed_m_s=speed_m_s,
        wheel_speed_rad_s=wheel_rad_s,
        load_N=np.full((n, axles), load_N),
        torque_Nm=np.maximum(torque_Nm, 0.0) * is_braked,
        position_m=None,
        surface_m_s=surface_m_s,
    )


def _course(
    data: Dataset, stop: Stop, row: np.ndarray, is_braked: np.ndarray, mass_kg: float
) -> _Course:
    """Return the course of a stop until its last speed or its longest time.

    `row` (PARAMETERS,) holds the parameters of the wheelsets, `is_braked` (axles,) is true for
    those that brake. `mass_kg` is infinite if the rig holds the speed.
    """
    step_s = data.sample_time_s
    vehicle = data.sections["vehicle"]
    brake = data.sections["brake"]
    radius_m = vehicle["wheel_radius_m"]
    load_N = stop.mass_kg * GRAVITY_M_S2 / data.axles
    full_torque_Nm = max(
        brake_torque_Nm_Pa(brake) * (stop.pressure_Pa - brake["spring_pressure_Pa"]), 0.0
    )

    duration_s = RELEASED_S + stop.held_s if stop.held_s else LONGEST_S
    n = int(duration_s / step_s)
    speed_m_s = np.empty(n)
    sliding_m_s = np.zeros((n, data.axles))
    force_N = np.zeros((n, data.axles))

    samples_of_control = max(int(CONTROL_S / step_s), 1)
    v = stop.initial_speed_m_s
    for k in range(n):
        time_s = k * step_s
        if k % samples_of_control == 0:
            # the cylinders fill after the released time
            demand_Nm = full_torque_Nm * -math.expm1(-max(time_s - RELEASED_S, 0.0) / FILL_S)
            samples = slice(k, k + samples_of_control)
            for j in np.flatnonzero(is_braked):
                sliding_m_s[samples, j], force_N[samples, j] = braked_wheel(
                    v, demand_Nm / radius_m, load_N, row, time_s + PHASE_S * j
                )
        speed_m_s[k] = v

        resistance_N = (
            vehicle["resistance_A_N"]
            + vehicle["resistance_B_N_s_m"] * v
            + vehicle["resistance_C_N_s2_m2"] * v * v
        )
        v -= step_s * (float(force_N[k].sum()) + resistance_N) / mass_kg
        if v < stop.last_speed_m_s:
            n = k + 1
            break
    return _Course(speed_m_s[:n], sliding_m_s[:n], force_N[:n])


@kernel
def braked_wheel(speed, wanted_N, load_N, row, time_s):
    """Return (sliding in m/s, force in N) of a braked wheelset.

    It slides as the WSP lets it, or creeps if the brake is too weak for that. `wanted_N` is the
    force that the brake torque needs, `row` (PARAMETERS,) holds the wheelset's parameters.
    """
    model = wheel_model(row)
    swing = SWING * math.sin(2.0 * math.pi * time_s / PERIOD_S)
    high = (SHARE * speed + LEAST_M_S) * (1.0 + swing)
    largest_N = _force_N(high, speed, load_N, model)
    if wanted_N >= largest_N:
        return high, largest_N

    # the brake is too weak for this sliding: find the creep that gives the wanted force
    low = 0.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if _force_N(middle, speed, load_N, model) < wanted_N:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high), wanted_N


@kernel_inlined
def _force_N(sliding, speed, load_N, model):
    """Return the contact force of a wheelset with this load."""
    # a WheelModel has all fields of patch and law that the adhesion needs
    f, _, _, _, _, _ = adhesion.wheel_adhesion(sliding, speed, 0.5 * load_N, model, model)
    return load_N * f
