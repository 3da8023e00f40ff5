"""A train: cars with couplers, a brake pipe, and the rail that their wheels clean for one another.

A car is a rig of the plant. Reading order: `coupler`, `motion`, `pipe`, `rail`.
"""
