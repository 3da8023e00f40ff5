"""Stops in numba's simulator of a GPU against the same stops in lanes; prints differences as JSON.

Runs as a program with NUMBA_ENABLE_CUDASIM=1: cases of `test_stops_in_lanes`, and vehicles with
other numbers of axles.
"""

import json
import sys

import numpy as np
from test_stops_in_lanes import CASES

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.campaign.stops import stops_in_lanes, stops_on_device

VEHICLES = {
    "two axles": ("bogie_low", ("initial_speed_m_s=6.0",)),
    "six axles, motors and magnets": ("tram_emergency_magnetic", ("initial_speed_m_s=4.0",)),
    "eight axles": ("multiple_unit_low_dynamic", ("initial_speed_m_s=4.0",)),
}
# whole stops from high speed
LONG = {"whole stop": ("velim_a1", ()), "whole dry stop": ("dry_stop", ())}


def largest_differences(cases):
    """Return the largest relative difference of any channel, by case."""
    plans = {name: scenario.load(stem, settings=given) for name, (stem, given) in cases.items()}
    lanes = {stop.tag: stop for stop in stops_in_lanes.together(plans.items())}
    found = {}
    for stop in stops_on_device.together(plans.items()):
        worst = 0.0
        for name, there in stop.channels.items():
            here = lanes[stop.tag].channels[name]
            assert here.shape == there.shape, (stop.tag, name)
            assert np.array_equal(np.isnan(here), np.isnan(there)), (stop.tag, name)
            size = np.maximum(np.abs(here), 1.0)
            worst = max(worst, float(np.nanmax(np.abs(there - here) / size, initial=0.0)))
        assert stop.ended == lanes[stop.tag].ended
        found[stop.tag] = worst
    return found


if __name__ == "__main__":
    print(json.dumps(largest_differences(LONG if "long" in sys.argv else CASES | VEHICLES)))
