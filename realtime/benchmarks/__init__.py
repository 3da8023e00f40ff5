"""The project's own benchmarks, one a file: `run` measures, `table` shows, `figures` is the form.

Reading order: figures, contact, vehicle, wall (a wall-paced run to measure on), loop, bus, client.
"""
