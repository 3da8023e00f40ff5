"""Scripted tests.

Reading order:

    conditions     quantities with units, and conditions, as a person writes them
    sequence       the TOML file of a test: read and checked
    measures       what a run is judged by, computed from the data of the harness
    verdict        measures against limits
    running_bench  compares a bench that already runs with the start of a sequence
    play           plays a sequence on a bench, and judges it
"""
