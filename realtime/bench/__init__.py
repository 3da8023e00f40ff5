"""One run: scenario, plant, devices on their bus, further processes, and the three pacings.

Reading order: scenario, options, tick_data, brake_demand, rig_bus, processes, parts; then free,
lockstep, and wall with its plc; then bench, which puts them together.
"""
