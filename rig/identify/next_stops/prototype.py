"""A stop that has not been run yet: its rough course for the simulator, and the file that runs it.

In the rough course the wheels slide as a WSP lets them: sliding swings about a share of the speed.
Where the brake torque is less than the adhesion there, the wheel creeps as much as its torque needs.
The torque is what these courses need [K1]. The simulator then gives torque and sliding their
dynamics. No wheelset is integrated here.

    [K1] C = r N f(s) - J domega/dt, not above what the brake gives at its pressure
"""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.vehicle import GRAVITY_M_S2, brake_torque_Nm_Pa
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.data.parameters import MU_CD, TAU, wheel_model
from rollerrig.rig.identify.data.runs import AXLES, Dataset, Run
from rollerrig.rig.identify.replay import replay

LONGEST_S = 45.0  # a stop that takes longer is cut off
SLOWEST_M_S = 4.0  # a stop ends at this speed
RELEASED_S = 1.0  # time with released brake, before the brake is applied
FILL_S = 1.3  # time constant of the brake cylinders

# sliding that a WSP lets wheels have: SHARE of the speed and LEAST_M_S, which swings by SWING of it
SHARE = 0.07
LEAST_M_S = 0.4
SWING = 0.5
PERIOD_S = 1.6
PHASE_S = 0.3  # of the swing, from wheelset to wheelset
CONTROL_S = 0.05  # the sliding is computed once in this time
SMOOTHING_S = 0.08
BISECTIONS = 14  # of the sliding of a creeping wheel


class Stop(NamedTuple):
    """A stop to run: how it begins and how it brakes."""

    initial_speed_m_s: float
    pressure_Pa: float
    mass_kg: float
    axle: int  # the only wheelset that brakes; 0: all brake
    held_s: float = 0.0  # above 0: the rig holds the speed for so long

    @property
    def last_speed_m_s(self) -> float:
        """The speed at which the stop ends.

        A single wheelset would need too long for a whole stop, so half the speed is its end.
        """
        return 0.5 * self.initial_speed_m_s if self.axle else SLOWEST_M_S

    @property
    def title(self) -> str:
        """A description in words."""
        where = f"on wheelset {self.axle} only" if self.axle else "on all wheelsets"
        speed = f"for {self.held_s:g} s at a held" if self.held_s else "from"
        return (
            f"{self.pressure_Pa / 1e5:g} bar {where} {speed} {self.initial_speed_m_s:g} m/s with "
            f"{self.mass_kg / 1e3:.3g} t"
        )


def rough_run(data: Dataset, base: np.ndarray, stop: Stop, explanation: Explanation) -> Run:
    """Returns the rough course of a stop under a fitted explanation, without noise.

    `base` (PARAMETERS,) are the parameters of the base model.
    """
    step_s = data.sample_time_s
    vehicle = data.sections["vehicle"]
    brake = data.sections["brake"]
    radius_m = vehicle["wheel_radius_m"]
    row = base.copy()
    row[TAU] *= math.exp(explanation.base.get("ln_tau", 0.0))
    row[MU_CD] *= math.exp(explanation.level)

    full_torque_Nm = max(
        brake_torque_Nm_Pa(brake) * (stop.pressure_Pa - brake["spring_pressure_Pa"]), 0.0
    )
    braked = np.array([stop.axle in (0, j + 1) for j in range(AXLES)])
    load_N = stop.mass_kg * GRAVITY_M_S2 / AXLES
    # a rig that holds the speed is a vehicle of infinite mass
    mass_kg = math.inf if stop.held_s else stop.mass_kg
    n = int((RELEASED_S + stop.held_s if stop.held_s else LONGEST_S) / step_s)

    speed = np.empty(n)
    sliding = np.zeros((n, AXLES))
    force_N = np.zeros((n, AXLES))
    samples_of_control = max(int(CONTROL_S / step_s), 1)
    v = stop.initial_speed_m_s
    for k in range(n):
        time_s = k * step_s
        if k % samples_of_control == 0:
            demand_Nm = full_torque_Nm * -math.expm1(-max(time_s - RELEASED_S, 0.0) / FILL_S)
            samples = slice(k, k + samples_of_control)
            for j in np.flatnonzero(braked):
                sliding[samples, j], force_N[samples, j] = braked_wheel(
                    v, demand_Nm / radius_m, load_N, row, time_s + PHASE_S * j
                )
        speed[k] = v
        coast_N = (
            vehicle["resistance_A_N"]
            + vehicle["resistance_B_N_s_m"] * v
            + vehicle["resistance_C_N_s2_m2"] * v * v
        )
        v -= step_s * (float(force_N[k].sum()) + coast_N) / mass_kg
        if v < stop.last_speed_m_s:
            n = k + 1
            break

    speed = speed[:n]
    sliding = gaussian_filter1d(sliding[:n], SMOOTHING_S / step_s, axis=0, mode="nearest")
    force_N = gaussian_filter1d(force_N[:n], SMOOTHING_S / step_s, axis=0, mode="nearest")
    wheel_rad_s = (speed[:, None] - sliding) / radius_m
    rate_rad_s2 = np.gradient(wheel_rad_s, step_s, axis=0)
    torque_Nm = radius_m * force_N - vehicle["wheelset_inertia_kgm2"] * rate_rad_s2  # [K1]
    on_rollers = math.isfinite(data.sections["contact"]["roller_radius_m"])
    return Run(
        name="planned",
        group="tune",
        mass_kg=mass_kg,
        mu_cd=None,
        time_s=step_s * np.arange(n),
        speed_m_s=speed,
        wheel_speed_rad_s=wheel_rad_s,
        load_N=np.full((n, AXLES), load_N),
        torque_Nm=np.maximum(torque_Nm, 0.0) * braked,
        position_m=None,
        surface_m_s=np.repeat(speed[:, None], AXLES, axis=1) if on_rollers else None,
    )


@kernel
def braked_wheel(speed, wanted_N, load_N, row, time_s):
    """Returns (sliding in m/s, force in N) of a braked wheelset: as the WSP lets it, or as it creeps.

    `wanted_N` is the force that the brake torque needs, `row` (PARAMETERS,) the wheelset's parameters.
    """
    model = wheel_model(row)
    swing = SWING * math.sin(2.0 * math.pi * time_s / PERIOD_S)
    high = (SHARE * speed + LEAST_M_S) * (1.0 + swing)
    f, _, _ = replay.wheel_adhesion(high, speed, 0.5 * load_N, 1.0, 1.0, model, 0.0, 1.0)
    if wanted_N >= load_N * f:
        return high, load_N * f

    # the brake is too weak for this sliding: find the creep that gives the wanted force
    low = 0.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        f, _, _ = replay.wheel_adhesion(middle, speed, 0.5 * load_N, 1.0, 1.0, model, 0.0, 1.0)
        if load_N * f < wanted_N:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high), wanted_N


def sequence(stop: Stop, reason: str, data: Dataset, explanation: Explanation) -> dict[str, Any]:
    """Returns the stop as a sequence on the fitted base model: plain data for a TOML file.

    `rollerrig sequence` runs that file.
    """
    sections = data.sections
    law = dict(sections["adhesion"])
    law["mu_cd"] = float(law["mu_cd"] * math.exp(explanation.level))
    law["tau_m_J"] = float(law["tau_m_J"] * math.exp(explanation.base.get("ln_tau", 0.0)))
    on_rollers = math.isfinite(sections["contact"]["roller_radius_m"])

    step: dict[str, Any] = {
        "title": stop.title,
        "at": f"{RELEASED_S:g} s",
        "set": {"brake_demand": f"{stop.pressure_Pa / 1e5:g} bar"},
    }
    if stop.held_s:
        step["for"] = f"{stop.held_s:g} s"
        step["expect"] = [f"vehicle_speed > {0.99 * stop.initial_speed_m_s:.4g} m/s"]
    else:
        step["until"] = f"vehicle_speed < {stop.last_speed_m_s:g} m/s"
        step["timeout"] = "280 s"
    if stop.axle:
        # The dump valves of the other wheelsets stay open. So one wheelset slides at a speed that
        # hardly decreases.
        others = [j for j in range(1, AXLES + 1) if j != stop.axle]
        step["fault"] = [f"vent_magnet_stuck axle={j}" for j in others]

    return {
        "title": f"Proposed by explain: {stop.title}",
        "criteria": "none",
        "notes": reason,
        "start": {
            "speed": f"{stop.initial_speed_m_s:g} m/s",
            "mass": f"{stop.mass_kg:.6g} kg",
            "adhesion": "soap",
            "tables": {
                "adhesion": law,
                "contact": dict(sections["contact"]),
                "vehicle": dict(sections["vehicle"]),
                "brake": dict(sections["brake"]),
                "rig": {
                    "mode": "contaminated_rollers" if on_rollers else "track",
                    "speed": "held" if stop.held_s else "vehicle",
                },
                "loop": {"record_hz": round(1.0 / data.sample_time_s)},
            },
        },
        "step": [step],
    }
