"""Scripted tests: steps, conditions, measures and verdicts."""
