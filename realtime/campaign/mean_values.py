"""The brake calculation by mean values of the vehicle of a scenario, beside its simulated dry stop.

Forces follow from the parameters of the brake. The response time follows from the cylinder pressure
of the simulated stop, so the filling of the cylinders is modelled once, by the plant.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import (
    EQUIPMENT_KEYS,
    brake_factors,
    brake_torque_Nm_Pa,
    equipment_of,
    weighed_share,
)
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.campaign import dry_stop
from rollerrig.realtime.campaign.stops import stops_in_lanes
from rollerrig.rig import brake_calculation
from rollerrig.wsp_interface import braking

# until the vehicle stands
_LONGEST_S = 300.0


class Dry(NamedTuple):
    """The vehicle of a scenario for the calculation, and what its simulated dry stop gives.

    distance_m: from the demand to standstill; NaN if it does not stop within 300 s.
    """

    vehicle: brake_calculation.Vehicle
    speed_m_s: float
    distance_m: float


def of_scenario(resolved: scenario.Scenario) -> Dry:
    """Return the vehicle of a scenario with the response times of its brake. Raises ConfigError.

    The demand is the largest one of the scenario, from the first moment on.
    """
    sections = resolved.resolved
    for name in sorted(equipment_of(sections)):
        raise ConfigError(
            f"{resolved.name}: has a {name}, whose force is no mean value of the friction brake; "
            f"isolate it with --set {name}.{EQUIPMENT_KEYS[name]}=[]"
        )
    demanded_Pa = max((demand["pressure_Pa"] for demand in sections["demand"]), default=0.0)
    brake = sections["brake"]
    pressure_Pa = demanded_Pa * weighed_share(sections["air"], sections["vehicle"])
    above_Pa = pressure_Pa - brake["spring_pressure_Pa"]
    if above_Pa <= 0.0:
        raise ConfigError(
            f"{resolved.name}: demands {demanded_Pa:g} Pa, which its springs hold; demand more with "
            "[[demand]] pressure_Pa"
        )
    axles = sections["vehicle"]["axles"]
    channels = _dry_stop(resolved, demanded_Pa, axles)
    time_s = channels["time_s"]
    begin = braking.begin(channels["brake_demand_Pa"])
    assert begin is not None
    stands = np.flatnonzero(channels["vehicle_speed_m_s"] <= braking.STANDS_M_S)
    end = int(stands[0]) if stands.size else len(time_s) - 1
    at_s = (time_s[begin:end] - time_s[begin]).tolist()

    radius_m = sections["vehicle"]["wheel_radius_m"]
    units = []
    for axle, factor in enumerate(brake_factors(sections), start=1):
        measured_Pa = channels[f"cylinder_pressure_{axle}_Pa"][begin:end]
        shares = np.maximum(measured_Pa - brake["spring_pressure_Pa"], 0.0) / above_Pa
        units.append(
            brake_calculation.Unit(
                name=f"axle {axle}",
                number=1,
                force_N=factor * brake_torque_Nm_Pa(brake) * above_Pa / radius_m,
                response_s=brake_calculation.response_s(at_s, shares.tolist()),
                mass_kg=sections["vehicle"]["mass_kg"] / axles,
                rotating_mass_kg=sections["vehicle"]["wheelset_inertia_kgm2"] / radius_m**2,
            )
        )
    vehicle = brake_calculation.Vehicle(
        sections["title"],
        tuple(units),
        tuple(sections["vehicle"][f"resistance_{key}"] for key in ("A_N", "B_N_s_m", "C_N_s2_m2")),
    )
    distance_m = float(channels["position_m"][end] - channels["position_m"][begin])
    return Dry(vehicle, sections["initial_speed_m_s"], distance_m if stands.size else float("nan"))


def _dry_stop(resolved: scenario.Scenario, demanded_Pa: float, axles: int) -> dict[str, np.ndarray]:
    """Return channels of the stop on dry rails with one demand."""
    dry = dry_stop.dry_scenario(resolved.resolved, ((0.0, demanded_Pa),))
    dry["duration_max_s"] = _LONGEST_S
    # some samples of standstill
    dry["stand_s"] = 0.5
    plan = scenario.read(dry, Path("dry.toml"))
    columns = [
        *("time_s", "brake_demand_Pa", "vehicle_speed_m_s", "position_m"),
        *(f"cylinder_pressure_{axle}_Pa" for axle in range(1, axles + 1)),
    ]
    (finished,) = stops_in_lanes.together([("dry", plan)], "none", columns)
    return finished.channels
