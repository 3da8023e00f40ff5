"""Gives the size of a cause in words and units, instead of a parameter and a number.

A row has the factor from the first parameter of the cause to the number in the words.
"""

from typing import NamedTuple

from rollerrig.configs.vehicle import MOST_AXLES, wheelsets_of
from rollerrig.rig.mechanisms.table import BY_NAME


class Words(NamedTuple):
    """The words around a number: `before`, the number times `factor`, `after`."""

    factor: float
    before: str
    after: str


_PERCENT = 100.0
_MILLISECONDS = 1000.0
WORDS = {
    "rail_cleaning": Words(_PERCENT, "", " % more friction on cleaned rail"),
    "speed_dependent_friction": Words(
        10.0 * _PERCENT, "friction that changes by ", " % for each 10 m/s of speed"
    ),
    "friction_trend": Words(_PERCENT, "friction that changes by ", " % in a second"),
    "negative_conditioning": Words(_PERCENT, "a loss of ", " % of friction by sliding"),
    "contaminated_patch": Words(_PERCENT, "", " % less friction at some place of the rail"),
    "sanding": Words(_PERCENT, "", " % more friction for some seconds"),
    "brake_gain": Words(_PERCENT, "a brake torque that is ", " % off"),
    "pad_fade": Words(_PERCENT, "a brake torque that fades by ", " % for each MJ of work"),
    "wet_pads": Words(_PERCENT, "", " % less torque of wet pads"),
    "torque_offset": Words(1.0, "an offset of the torque of ", " N m"),
    "running_resistance": Words(1.0, "a resistance that is ", " N off"),
    "track_gradient": Words(1000.0, "a gradient of ", " in 1000"),
    "wheel_radius": Words(_PERCENT, "a radius of one wheelset that is ", " % off"),
    "wheel_inertia": Words(_PERCENT, "an inertia of the wheelsets that is ", " % off"),
    "roller_curvature": Words(_PERCENT, "a contact that is ", " % stiffer or softer"),
    "interfacial_layer": Words(_PERCENT, "a contact that a layer makes ", " % softer"),
    "falling_friction": Words(
        _PERCENT, "a fall of friction with sliding that is ", " % off the stated one"
    ),
    "adhesion_memory": Words(1.0, "a recovery that lags by ", " m"),
    "speed_sensor_delay": Words(_MILLISECONDS, "wheel speeds that are ", " ms late"),
    "sensor_scale": Words(_PERCENT, "a speed sensor of one wheelset that is ", " % off"),
    "torque_sensor_delay": Words(_MILLISECONDS, "torques that are ", " ms late"),
    "wheel_out_of_round": Words(_PERCENT, "a load that swings by ", " % once a turn"),
    "load_transfer": Words(
        _PERCENT, "a transfer of load that is off by ", " % of the load for each m/s² of braking"
    ),
}


def in_words(name: str, size: float, digits: int = 2) -> str:
    """Return a size of a cause in words; `size` is that of its first parameter."""
    words = WORDS.get(name)
    if words is None:
        row = BY_NAME[name].parameters[0]
        return f"{row.name} = {abs(size):.{digits}g} {row.source}"
    value = float(f"{words.factor * abs(size):.{digits}g}")
    return f"{words.before}{value:g}{words.after}"


def place_in_words(axle: int) -> str:
    """Return where a cause acts: a wheelset, a bogie, or all wheelsets."""
    if axle < 0:
        # a bogie has the same wheelsets in all vehicles
        wheelsets = " and ".join(str(wheelset) for wheelset in wheelsets_of(axle, MOST_AXLES))
        return f"bogie {-axle} (wheelsets {wheelsets})"
    return f"wheelset {axle}" if axle else "all wheelsets"
