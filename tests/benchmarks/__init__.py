"""Benchmarks of the project that a user does not need on a new machine; they run from a clone.

Each file has `run(given, say)`, which measures and returns a table of figures, and `table(result)`,
which shows it; the form is that of `rollerrig.realtime.benchmarks.figures`.
"""
