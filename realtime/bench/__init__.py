"""The bench: a scenario, its pacing, its bus, its processes."""
