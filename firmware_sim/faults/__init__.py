"""The catalogue of faults and how each acts on bus, devices and brakes."""
