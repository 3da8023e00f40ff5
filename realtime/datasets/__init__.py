"""Recorded runs as measured data: what the sensors of a rig would have measured."""
