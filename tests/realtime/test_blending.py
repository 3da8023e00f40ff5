"""Motors and friction brake together give what is demanded, over whole runs and at every tick.

The sum may exceed the demand only by what the motors still give above their own demands, because
they follow these with a lag and a limited rate, and by what the friction brake alone gives above
the demand. The friction force is that of the cylinder pressure, as a brake control unit knows it.
"""

import functools

import numpy as np
import pytest

from rollerrig.configs.vehicle import brake_torque_Nm_Pa
from rollerrig.realtime.bench import free, scenario

# scenario: settings, and which shares of the demand are required in a dry stop
RUNS = {
    "tram_low": ("tram_low_dynamic", ()),
    "tram_very_low": ("tram_low_dynamic", ("adhesion=very_low", "initial_speed_m_s=11.1")),
    "tram_dry": ("tram_low_dynamic", ("adhesion=dry",)),
    "tram_traction_unit": ("tram_low_dynamic", ("dynamic_brake.slide_control=traction_unit",)),
    "tram_by_bogie": ("tram_low_dynamic", ("dynamic_brake.blending=bogie",)),
    "multiple_unit_low": ("multiple_unit_low_dynamic", ()),
    "multiple_unit_dry": ("multiple_unit_low_dynamic", ("adhesion=dry",)),
}
# one run in each night but the first
NAMES = [
    name if name == "tram_low" else pytest.param(name, marks=pytest.mark.nightly) for name in RUNS
]
WITHIN = 0.005  # of the demand: the steps of the integration


class Run:
    """The forces at the rims of the axles that blend together, shape (groups, n), in N."""

    def __init__(self, name):
        base, settings = RUNS[name]
        self.plan = scenario.load(base, settings=(*settings, "loop.record_hz=1000"))
        rows = free.moving(free.simulate(self.plan), 0.05)
        channels = free.channels(rows, self.plan.table)
        brake = self.plan["brake"]
        motors = self.plan["dynamic_brake"]
        radius_m = self.plan["vehicle"]["wheel_radius_m"]
        self.friction_N_Pa = brake_torque_Nm_Pa(brake) / radius_m
        spring_Pa = brake["spring_pressure_Pa"]
        blends_with = self.plan.params.dynamic.blends_with
        axles = range(1, self.plan.kind.axles + 1)

        def by_group(values):
            return np.array(
                [values[blends_with == group].sum(axis=0) for group in set(blends_with)]
            )

        def of(channel, unit):
            return np.array([channels[f"{channel}_{axle}{unit}"] for axle in axles])

        above_Pa = np.maximum(channels["brake_demand_Pa"] - spring_Pa, 0.0)
        number = np.bincount(blends_with)[:, np.newaxis]
        pressures_Pa = of("cylinder_pressure", "_Pa")
        self.time_s = channels["time_s"]
        self.speed_m_s = channels["vehicle_speed_m_s"]
        self.demand_N = number * (motors["demand_N_Pa"] or self.friction_N_Pa) * above_Pa
        self.friction_N = by_group(self.friction_N_Pa * np.maximum(pressures_Pa - spring_Pa, 0.0))
        torques_Nm = of("dynamic_torque", "_Nm")
        self.motors_N = by_group(torques_Nm / radius_m)
        own_demands_Nm = of("dynamic_share", "") * of("dynamic_torque_demand", "_Nm")
        self.behind_N = by_group(np.maximum(torques_Nm - own_demands_Nm, 0.0) / radius_m)

    @property
    def excess_N(self):
        """The force above the demand."""
        return self.friction_N + self.motors_N - self.demand_N


@functools.cache
def run_of(name):
    return Run(name)


@pytest.mark.parametrize("name", NAMES)
def test_both_brakes_exceed_the_demand_by_no_more_than_the_lag_of_the_motors(name):
    run = run_of(name)
    friction_alone_N = np.maximum(run.friction_N - run.demand_N, 0.0)
    over_N = run.excess_N - run.behind_N - friction_alone_N
    assert over_N.max() <= WITHIN * run.demand_N.max()
