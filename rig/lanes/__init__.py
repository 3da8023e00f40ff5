"""Several stops abreast in the vector lanes of a core."""
