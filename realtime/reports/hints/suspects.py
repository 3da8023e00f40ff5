"""Lists what may be behind an error that no cause of the library explains, and what to measure.

A row belongs to a covariate along which the base is wrong, as the search names it.
"""

from typing import NamedTuple


class Suspect(NamedTuple):
    """What usually makes an error along a covariate, and what would show it."""

    suspects: str
    measure: str


_VEHICLE = Suspect(
    "a force on the vehicle that is missing (gradient, wind, another brake, the train), hysteresis "
    "of the brake where torques are computed from pressures, or a scale of torque, mass or clock",
    "let the vehicle coast without a brake on the same track, raise and lower the brake demand "
    "slowly in one stop, log position_m and other brakes, and weigh the vehicle",
)
SUSPECTS = {
    "vehicle time": _VEHICLE,
    "vehicle speed": _VEHICLE,
    "deceleration": Suspect(
        "load that braking transfers, a moving payload, or a scale of torque or mass",
        "stops of the same speed with half of the brake demand, with the load of each wheelset",
    ),
    "load": Suspect(
        "load sensors that are late or off, or friction that depends on load",
        "weigh the wheelsets, and repeat stops with another payload",
    ),
    "sliding": Suspect(
        "a law of friction over sliding of another form, or a scale of the wheel speeds",
        "sliding at one constant speed on a roller rig, in steps from small to large",
    ),
    "speed": Suspect(
        "friction that depends on speed in another form, or a resistance",
        "sliding at two constant speeds of the surface, and stops from other initial speeds",
    ),
    "time": Suspect(
        "friction that changes in a stop (drying, heating, sand), or clocks that drift apart",
        "log sand and valve commands, and compare the clocks at the end of a stop",
    ),
    "energy": Suspect(
        "a recovery of another form, memory of the surface, or cleaning",
        "sliding at constant speed with the work of sliding in steps, up and down",
    ),
    "disc_heat": Suspect(
        "pads whose friction depends on heat in another form",
        "the acting torque (or the pressure and the heat of the discs) in repeated stops",
    ),
    "acceleration": Suspect(
        "a late or smoothed channel, a wrong inertia, or a shaft that twists",
        "raw samples with the stamp of each channel, and the inertia of the wheelset",
    ),
    "axle": Suspect(
        "one wheelset that differs: its radius, its brake, its tread, or exchanged channels",
        "the radius of each wheelset, and one stop in which a single wheelset brakes",
    ),
    "place": Suspect(
        "friction that changes along the track and from run to run (leaves, rain, a cleaned stretch)",
        "position_m from the same mark in all runs, and one stop three times from the same place",
    ),
    "wheel_angle": Suspect(
        "an out-of-round wheel, a bent pole wheel, or a brake that swings once a turn",
        "the wheel speed of the released wheelset at constant speed",
    ),
}
_SIZE = Suspect(
    "a cause whose size differs from run to run or with time, such as a drifting clock",
    "repeat one stop unchanged, three times",
)
_OTHER = Suspect("an effect that is not in the library", "repeat one stop unchanged, three times")


def suspect(covariate: str) -> Suspect:
    """Return the suspects of an error along a covariate, such as "speed" or "time of axle 2"."""
    if covariate in SUSPECTS:
        return SUSPECTS[covariate]
    if " in the size of " in covariate:
        return _SIZE
    if covariate.startswith("time of"):
        return SUSPECTS["axle"]
    return _OTHER
