"""The replay: what the wheels' filter makes of a run, and how that moves with every parameter."""
