"""A plausible stop for tests of what records and draws: four axles, a bang-bang WSP, adhesion that
recovers with the energy dissipated. Not the rig's physics: simple enough to be read at a glance.
"""

import numpy as np

from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code, make

RADIUS_M, ROLLER_M, INERTIA_KGM2, LOAD_N, MASS_KG = 0.445, 1.0, 160.0, 105e3, 43e3
STEP_S = 0.002


def _limits(s, v, mu_cd):
    def polach(mu_c, gamma, k):
        mu = mu_c + (mu_c / 0.4 - mu_c) * np.exp(-gamma * s)
        return mu * 2 / np.pi * np.arctan(k * s / max(v, 0.5) / mu)

    return polach(mu_cd, 0.2, 12.0), polach(0.28, 0.6, 40.0)


def stop(speed_m_s=42.3, record_hz=100, mu_cd=0.05, lock_axle=None, end_s=90.0):
    """Rows of all signals, shape (n, columns), from the brake demand to standstill.

    The brake of `lock_axle` grips twice as hard for two seconds, and its valve fills.
    """
    v, x, omega = speed_m_s, 0.0, np.full(4, speed_m_s / RADIUS_M)
    angle, roller = np.zeros(4), np.zeros(4)
    pressure, valve, since, vents = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4)
    work, lock, longest, air = np.zeros(4), np.zeros(4), np.zeros(4), 0.0
    mu, rows, reference = mu_cd * np.array([0.9, 1.0, 1.15, 1.3]), [], speed_m_s
    for step in range(int(end_s / STEP_S)):
        t = step * STEP_S
        demand = 3.8e5 if t >= 1.0 else 0.0
        s = np.maximum(v - RADIUS_M * omega, 0.0)
        fd, fr = _limits(s, v, mu)
        f = fd.copy()
        for _ in range(6):
            f = fr - (fr - fd) * np.exp(-1.9e-4 * f * LOAD_N / 2 * s / max(v, 0.5))
        energy = f * LOAD_N / 2 * s / max(v, 0.5)
        torque = np.where(omega > 1e-3, 1.0, 0.0) * pressure * 0.019
        if lock_axle is not None and 6.0 < t < 8.0:
            torque[lock_axle - 1] *= 2.0
        if step % 10 == 0:
            reference = max(float(np.max(RADIUS_M * omega)), reference - 1.4 * 0.02)
            slip = reference - RADIUS_M * omega
            new = np.where(slip > 0.06 * reference + 0.2, 1, 0)
            new = np.where(slip > 0.16 * reference + 0.5, 2, new)
            if lock_axle is not None and 6.0 < t < 8.0:
                new[lock_axle - 1] = 0
            vents += (new == 2) & (valve != 2)
            valve = new.astype(float)
        if step % round(1 / record_hz / STEP_S) == 0:
            rows.append(_row(locals()))
        if v <= 0.0 and t > 2:
            break
        target = np.where(valve == 0, demand, np.where(valve == 2, 0.0, pressure))
        step_p = (target - pressure) * STEP_S / np.where(valve == 2, 0.2, 0.5)
        air += float(np.sum(np.maximum(step_p, 0))) * 4e-5
        pressure = pressure + step_p
        omega = np.maximum(omega + (RADIUS_M * f * LOAD_N - torque) / INERTIA_KGM2 * STEP_S, 0.0)
        omega = np.minimum(omega, v / RADIUS_M)
        locked = (omega < 1e-3) & (v > 3.0)
        lock = np.where(locked, lock + STEP_S, 0.0)
        longest = np.maximum(longest, lock)
        work += f * LOAD_N * s * STEP_S
        v = max(v - (np.sum(f) * LOAD_N + 1200) / MASS_KG * STEP_S, 0.0)
        x, angle, roller = x + v * STEP_S, angle + omega * STEP_S, roller + v / ROLLER_M * STEP_S
    return np.array(rows)


def _row(at):
    v, s, f = at["v"], at["s"], at["f"]
    row = np.full(len(signals.COLUMNS), np.nan)
    values = {
        "time": at["t"],
        "vehicle_speed": v,
        "position": at["x"],
        "vehicle_acceleration": -np.sum(f) * LOAD_N / MASS_KG,
        "brake_demand": at["demand"],
        "wheel_speed": at["omega"],
        "wheel_circumferential_speed": RADIUS_M * at["omega"],
        "wheel_angle": at["angle"],
        "tooth_frequency": at["omega"] * 100 / 6.2832,
        "pulse_count": np.floor(at["angle"] * 100 / 6.2832),
        "roller_speed": np.full(4, v / ROLLER_M),
        "roller_angle": at["roller"],
        "sliding": s,
        "creepage": s / max(v, 0.5),
        "adhesion": f,
        "adhesion_degraded": at["fd"],
        "adhesion_recovered": at["fr"],
        "transition": 1 - np.exp(-1.9e-4 * at["energy"]),
        "dissipated_energy": at["energy"],
        "sliding_work": at["work"],
        "friction_degraded": at["mu"],
        "wheel_load": np.full(4, LOAD_N),
        "brake_torque": at["torque"],
        "cylinder_pressure": at["pressure"],
        "valve": at["valve"],
        "vents": at["vents"],
        "longest_lock": at["longest"],
        "air_consumption": at["air"],
        "motor_torque_demand": f * LOAD_N * ROLLER_M,
        "motor_torque": 0.98 * f * LOAD_N * ROLLER_M,
        "wsp_reference_speed": at["reference"],
        "magnets": np.array([0, 1, 3])[at["valve"].astype(int)],
        "tick_lateness": 20 + 60 * abs(np.sin(at["t"] * 7)),
        "tick_duration": 25.0,
        "ticks_missed": 0,
    }
    for name, value in values.items():
        row[signals.span(name)] = value
    return row


EVENTS = [
    make(0.0, Code.OPERATOR_NOTE, note="run velim_a1 begins"),
    make(1.0, Code.TEST_BRAKE, pressure_Pa=3.8e5),
    make(2.4, Code.UNIT_STATE, node=32, state="OPERATIONAL"),
    make(12.6, Code.WHEEL_FLAT, axle=1, length_m=0.01),
    make(13.1, Code.HEARTBEAT_LOST, node=17, partner=32, silent_s=0.2),
]
