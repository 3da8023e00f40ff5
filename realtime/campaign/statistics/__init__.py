"""Statistics of many runs, as pure functions: quantiles, tails, laws of inputs, drivers."""
