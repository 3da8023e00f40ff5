"""A stop that can be computed by hand: constant deceleration, one axle locked for a while."""

import numpy as np

from rollerrig.realtime.bench import scenario
from rollerrig.wsp_interface.harness_client import reception
from rollerrig.wsp_interface.sequences.record import Record

GOOD = """title = "A stop from forty on soap"
criteria = "stop"

[start]
speed = "40 km/h"
adhesion = "soap"

[[step]]
title = "brake"
at = "1 s"
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 1 km/h"
timeout = "60 s"
"""

SPEED_M_S = 20.0
RATE_M_S2 = 1.0
COAST_S = 1.0
LOCK_S = 0.5  # of axle 2
SLIP_M_S = 1.0  # error of the unit's reference speed


def record(sends_reference: bool = True, vents: float = 0.0) -> Record:
    """Return a stop: 1 s of coasting, then 1 m/s2 to standstill; axle 2 locks from 5.0 to 5.5 s.

    sends_reference: whether the unit sends a reference speed.
    vents: how often the dump valve of axle 2 vents.
    """
    scenario_of_stop = scenario.load("velim_a1")
    plan = scenario_of_stop.resolved
    time_s = np.round(np.arange(0.0, COAST_S + SPEED_M_S / RATE_M_S2 + 1.0, 0.01), 2)
    speed = np.clip(SPEED_M_S - RATE_M_S2 * np.clip(time_s - COAST_S, 0.0, None), 0.0, None)
    columns = {name: np.zeros(len(time_s)) for name in reception(scenario_of_stop.table).columns}
    columns["time_s"] = time_s
    columns["vehicle_speed_m_s"] = speed
    travelled_m = np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time_s))
    columns["position_m"] = np.concatenate(([0.0], travelled_m))
    radius_m = plan["vehicle"]["wheel_radius_m"]
    for axle in range(1, 5):
        columns[f"measured_speed_{axle}_rad_s"] = speed / radius_m
        columns[f"wheel_circumferential_speed_{axle}_m_s"] = speed.copy()
        columns[f"adhesion_{axle}"] = np.full(len(time_s), 0.08)
    locked = (time_s >= 5.0) & (time_s < 5.0 + LOCK_S)
    columns["measured_speed_2_rad_s"] = np.where(locked, 0.0, speed / radius_m)
    columns["wheel_circumferential_speed_2_m_s"] = np.where(locked, 0.0, speed)
    columns["sliding_2_m_s"] = np.where(locked, speed, 0.0)
    columns["valve_2"] = np.where(locked, 2.0, 0.0)
    columns["brake_demand_Pa"] = np.where(time_s > COAST_S, 3.8e5, 0.0)
    reference = speed - SLIP_M_S if sends_reference else np.full(len(time_s), np.nan)
    columns["wsp_reference_speed_m_s"] = reference
    for axle in range(1, 5):
        columns[f"cylinder_pressure_{axle}_Pa"] = columns["brake_demand_Pa"].copy()
    finals = {
        "wheel_load": (1e5,) * 4,
        "longest_lock": (0.0, LOCK_S, 0.0, 0.0),
        "sliding_work": (0.0, 2e6, 0.0, 0.0),
        "vents": (0.0, vents, 0.0, 0.0),
        "air_consumption": (100.0,),
    }
    return Record(columns, ((COAST_S, 3.8e5),), finals, plan, dry_m=180.0)
