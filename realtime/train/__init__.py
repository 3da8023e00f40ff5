"""Stops of a train: its scenario, its ticks, its run and its record.

Reading order: `plan`, `ticks`, `stop`, `record`.
"""
