"""Stops that run together: in the vector lanes of a core, or on a GPU."""
