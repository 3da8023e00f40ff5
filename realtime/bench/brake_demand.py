"""The brake demand of a run: which of its sources counts.

    priority  source                                        set by
    1         emergency stop over Modbus (coil)             realtime.bench.plc
    2         set point over Modbus (register)              realtime.bench.plc
    3         object 6411h of node 17, or its fail-safe     firmware_sim.io401, over the bus
    4         programme of the scenario ([[demand]])        rig.plant, where the command is NaN

`decide` applies this order; no other place does. Its result goes down one way: the command row of
the tick (`realtime.loop.tick.DEMAND`), the plant, the distributor, the cylinders (`rig.brake`).
"""

import math
from dataclasses import dataclass


@dataclass
class ModbusDemand:
    """What a Modbus client requires: an emergency stop, or a set point in Pa (NaN: none)."""

    emergency_pressure_Pa: float
    emergency_stop: bool = False
    set_point_Pa: float = math.nan


def decide(modbus: ModbusDemand, node_Pa: float) -> float:
    """Return the brake demand in Pa for the command row; NaN for the programme of the scenario.

    `node_Pa` is the demand that node 17 has received from the bus, NaN if it has received none.
    """
    if modbus.emergency_stop:
        return modbus.emergency_pressure_Pa
    if not math.isnan(modbus.set_point_Pa):
        return modbus.set_point_Pa
    return node_Pa
