"""Benchmarks that a user runs on a new machine, one per file; `rollerrig bench` calls them.

Each has `run(given, say)`, which measures and returns a table of figures, and `table(result)`,
which shows it. Read first: figures (the form of a result), wall (a run in real time to measure on),
client (a process on the bus of that run). Then: loop, bus, vehicle, start, campaign.
"""
