"""A stop that has not been run: its rough course for the simulator, and the file that runs it.

The rough course has the wheels slide as a WSP lets them, swinging about a share of the speed; where
the brake is weaker than the adhesion there, the wheel creeps as much as its torque needs. Torque is
what these courses take [K1]; the simulator then gives both their own dynamics.

    [K1] C = r N f(s) - J domega/dt, not above what the brake gives at its pressure
"""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.vehicle import GRAVITY_M_S2, brake_torque_Nm_Pa
from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.data.parameters import MU_CD, TAU
from rollerrig.rig.identify.data.runs import AXLES, Dataset, Run
from rollerrig.rig.identify.replay import replay

LONGEST_S, SLOWEST_M_S, RELEASED_S, FILL_S = 45.0, 4.0, 1.0, 1.3
# sliding that a WSP lets wheels have: share of the speed, and how it swings
SHARE, LEAST_M_S, SWING, PERIOD_S = 0.07, 0.4, 0.5, 1.6


class Stop(NamedTuple):
    """Where a stop begins, how it brakes, on which wheelset (0: on all); or so long at a speed that the rig holds."""

    initial_speed_m_s: float
    pressure_Pa: float
    mass_kg: float
    axle: int
    held_s: float = 0.0

    @property
    def last_speed_m_s(self) -> float:
        """Where it ends; half its speed where one wheelset brakes alone, which would take for ever."""
        return 0.5 * self.initial_speed_m_s if self.axle else SLOWEST_M_S

    @property
    def title(self) -> str:
        """In words."""
        where = f"on wheelset {self.axle} only" if self.axle else "on all wheelsets"
        speed = f"for {self.held_s:g} s at a held" if self.held_s else "from"
        return (
            f"{self.pressure_Pa / 1e5:g} bar {where} {speed} {self.initial_speed_m_s:g} m/s with "
            f"{self.mass_kg / 1e3:.3g} t"
        )


def run(data: Dataset, parameters: np.ndarray, stop: Stop, explanation: Explanation) -> Run:
    """The rough course of a stop under a fitted explanation, without noise; `parameters` (PARAMETERS,) of the base."""
    step_s = data.sample_time_s
    vehicle = data.sections["vehicle"]
    radius, inertia = vehicle["wheel_radius_m"], vehicle["wheelset_inertia_kgm2"]
    p = parameters.copy()
    p[TAU] *= math.exp(explanation.base.get("ln_tau", 0.0))
    p[MU_CD] *= math.exp(explanation.level)
    brake = data.sections["brake"]
    most_Nm = max(brake_torque_Nm_Pa(brake) * (stop.pressure_Pa - brake["spring_pressure_Pa"]), 0.0)
    braked = np.array([stop.axle in (0, j + 1) for j in range(AXLES)])
    n = int((RELEASED_S + stop.held_s if stop.held_s else LONGEST_S) / step_s)
    speed, sliding, force = np.empty(n), np.zeros((n, AXLES)), np.zeros((n, AXLES))
    load_N, mass_kg = stop.mass_kg * GRAVITY_M_S2 / AXLES, math.inf if stop.held_s else stop.mass_kg
    v, every = stop.initial_speed_m_s, max(int(0.05 / step_s), 1)
    for k in range(n):
        time_s = k * step_s
        if k % every == 0:
            demand = most_Nm * -math.expm1(-max(time_s - RELEASED_S, 0.0) / FILL_S)
            for j in np.flatnonzero(braked):
                sliding[k : k + every, j], force[k : k + every, j] = _creeping(
                    v, demand, load_N, radius, p, time_s + 0.3 * j
                )
        speed[k] = v
        coast = (
            vehicle["resistance_A_N"]
            + vehicle["resistance_B_N_s_m"] * v
            + vehicle["resistance_C_N_s2_m2"] * v * v
        )
        v -= step_s * (float(force[k].sum()) + coast) / mass_kg
        if v < stop.last_speed_m_s:
            n = k + 1
            break
    speed, *rough = speed[:n], sliding[:n], force[:n]
    sliding, force = (
        gaussian_filter1d(course, 0.08 / step_s, axis=0, mode="nearest") for course in rough
    )
    wheel = (speed[:, None] - sliding) / radius
    torque = np.maximum(radius * force - inertia * np.gradient(wheel, step_s, axis=0), 0.0) * braked
    on_rollers = math.isfinite(data.sections["contact"]["roller_radius_m"])
    return Run(
        "planned",
        "tune",
        mass_kg,
        None,
        step_s * np.arange(n),
        speed,
        wheel,
        np.full((n, AXLES), load_N),
        torque,
        None,
        np.repeat(speed[:, None], AXLES, axis=1) if on_rollers else None,
    )


def _creeping(
    speed: float, demand_Nm: float, load_N: float, radius: float, p: np.ndarray, time_s: float
) -> tuple[float, float]:
    """(sliding in m/s, force in N) of a braked wheel: as the WSP lets it, or as its torque needs."""
    wanted_N = demand_Nm / radius

    def force(s: float) -> float:
        return load_N * float(
            replay.wheel_adhesion(s, speed, 0.5 * load_N, 1.0, 1.0, p, 0.0, 1.0)[0]
        )

    high = (SHARE * speed + LEAST_M_S) * (1.0 + SWING * math.sin(2.0 * math.pi * time_s / PERIOD_S))
    if wanted_N >= force(high):
        return high, force(high)
    low = 0.0
    for _ in range(14):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if force(middle) < wanted_N else (low, middle)
    return 0.5 * (low + high), wanted_N


def sequence(stop: Stop, reason: str, data: Dataset, explanation: Explanation) -> dict[str, Any]:
    """The stop as a sequence, plain data that as TOML `rollerrig sequence` runs, on the fitted base."""
    sections = data.sections
    law = dict(sections["adhesion"])
    law["mu_cd"] = float(law["mu_cd"] * math.exp(explanation.level))
    law["tau_m_J"] = float(law["tau_m_J"] * math.exp(explanation.base.get("ln_tau", 0.0)))
    rolled = math.isfinite(sections["contact"]["roller_radius_m"])
    brake: dict[str, Any] = {
        "title": stop.title,
        "at": f"{RELEASED_S:g} s",
        "set": {"brake_demand": f"{stop.pressure_Pa / 1e5:g} bar"},
    }
    held = {
        "for": f"{stop.held_s:g} s",
        "expect": [f"vehicle_speed > {0.99 * stop.initial_speed_m_s:.4g} m/s"],
    }
    brake |= (
        held
        if stop.held_s
        else {"until": f"vehicle_speed < {stop.last_speed_m_s:g} m/s", "timeout": "280 s"}
    )
    if stop.axle:
        # the dump valves of the others stay open: sliding at a speed that hardly falls
        brake["fault"] = [
            f"vent_magnet_stuck axle={j}" for j in range(1, AXLES + 1) if j != stop.axle
        ]
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
                    "mode": "contaminated_rollers" if rolled else "track",
                    "speed": "held" if stop.held_s else "vehicle",
                },
                "loop": {"record_hz": round(1.0 / data.sample_time_s)},
            },
        },
        "step": [brake],
    }
