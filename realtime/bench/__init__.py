"""One run: scenario, plant, devices on their bus, processes beside them, and the three pacings.

Reading order: scenario, options, tick_data, rig_bus, processes, parts, then free, lockstep, wall with its
supervisor, and bench, which puts them together.
"""
