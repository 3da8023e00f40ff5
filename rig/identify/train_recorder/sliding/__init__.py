"""Wheels that do not roll: slides, short drops, driving slip, and the smallest size that shows."""
