"""One function decides which source of the brake demand counts."""

import math

import pytest

from rollerrig.realtime.bench import brake_demand
from rollerrig.realtime.bench.brake_demand import ModbusDemand

NONE = math.nan
# three different demands, so that a test sees which of them counts
EMERGENCY_PA = 3.8e5
SET_POINT_PA = 2.0e5
NODE_PA = 1.0e5


@pytest.mark.parametrize(
    ("emergency_stop", "set_point_Pa", "node_Pa", "wanted_Pa"),
    [
        (True, SET_POINT_PA, NODE_PA, EMERGENCY_PA),
        (True, NONE, NONE, EMERGENCY_PA),
        (False, SET_POINT_PA, NODE_PA, SET_POINT_PA),
        (False, SET_POINT_PA, NONE, SET_POINT_PA),
        (False, NONE, NODE_PA, NODE_PA),
    ],
)
def test_an_emergency_stop_counts_before_a_set_point_and_a_set_point_before_node_17(
    emergency_stop, set_point_Pa, node_Pa, wanted_Pa
):
    modbus = ModbusDemand(EMERGENCY_PA, emergency_stop, set_point_Pa)
    assert brake_demand.decide(modbus, node_Pa) == wanted_Pa


def test_without_any_demand_the_programme_of_the_scenario_counts():
    assert math.isnan(brake_demand.decide(ModbusDemand(EMERGENCY_PA), NONE))


def test_a_set_point_of_zero_releases_the_brakes():
    modbus = ModbusDemand(EMERGENCY_PA, set_point_Pa=0.0)
    assert brake_demand.decide(modbus, NODE_PA) == 0.0
