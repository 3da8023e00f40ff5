"""The shortest sequence of a stop, for tests of what is around a stop."""

WALKING_PACE = """title = "A stop from walking pace"
criteria = "none"
[start]
speed = "9 km/h"
adhesion = "dry"
[[step]]
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 0.01 m/s"
timeout = "20 s"
"""
