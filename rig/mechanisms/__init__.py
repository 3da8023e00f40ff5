"""Every effect beyond the base model: its formula and its place in the plant."""
