"""Many stops: in memory, four at a time, over processes or a cluster."""
