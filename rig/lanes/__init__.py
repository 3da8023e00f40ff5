"""Several stops in the vector lanes of a core."""
