"""How numerical code is compiled, cached and vectorised; the only room that imports the internals of numba."""
