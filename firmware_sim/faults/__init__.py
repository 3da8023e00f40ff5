"""The catalogue of faults, and their effects on the bus, on devices and in the tick."""
