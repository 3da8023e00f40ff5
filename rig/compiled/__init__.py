"""How numerical code is compiled, cached and vectorised; only this room imports numba internals."""
