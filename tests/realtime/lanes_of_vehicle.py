"""Compares the stops of vehicles in lanes with the same stops alone, and prints what it found.

A process simulates one number of axles, so `test_vehicles_in_lanes` starts this file for each. For
each packaged scenario that fits, it runs one stop more than the lanes hold, from different speeds
and on different contaminants, so that a place is used twice.
"""

import json

import numpy as np

from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign import stops_in_lanes
from rollerrig.rig.lanes.layout import RIGS
from rollerrig.wsp_interface import signals


def plans_of(name):
    """Return scenarios of short stops of a vehicle, with more of them than places."""
    return {
        f"{name} {number}": scenario.load(
            name,
            settings=(
                f"initial_speed_m_s={6.0 + number}",
                f"adhesion.mu_cd={0.03 + 0.01 * number}",
            ),
        )
        for number in range(RIGS + 1)
    }


def distance_m(channels):
    return float(channels["position_m"][-1])


def compared(plans):
    """Return figures of the largest differences between stops together and alone."""
    found = {"distance": 0.0, "channel": 0.0, "same_samples": True, "depends_on_others": False}
    for finished in stops_in_lanes.together(plans.items()):
        alone = free.channels(free.simulate(plans[finished.tag]))
        among = finished.channels
        found["same_samples"] &= len(among["time_s"]) == len(alone["time_s"])
        missed = abs(distance_m(among) / distance_m(alone) - 1.0)
        found["distance"] = max(found["distance"], missed)
        for name in signals.COLUMNS:
            # the tracking error is a small difference of large numbers
            if not name.startswith("tracking_error"):
                scale = 1.0 + np.abs(alone[name])
                differs = np.nanmax(np.abs(among[name] - alone[name]) / scale, initial=0.0)
                found["channel"] = max(found["channel"], float(differs))

        [without_others] = stops_in_lanes.together([(0, plans[finished.tag])])
        for name in signals.COLUMNS:
            is_equal = np.array_equal(without_others.channels[name], among[name], equal_nan=True)
            found["depends_on_others"] |= not is_equal
    return found


def main():
    found = {}
    for name in scenario.names():
        plans = plans_of(name)
        if all(stops_in_lanes.fits(plan) for plan in plans.values()):
            found[name] = compared(plans)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
