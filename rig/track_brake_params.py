"""The constants of the magnetic track brake of a vehicle, and the checks of its section.

The physics is in `track_brake`, whose equations the names here follow.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import AXLES_OF_BOGIE


class MagneticTrackBrake(NamedTuple):
    """Section [magnetic_track_brake]. A share of a lag is that of one tick."""

    acts: bool  # False: the vehicle has none
    fitted: np.ndarray  # bool, (axles,): the bogie of the axle has magnets
    attraction_N: float  # of all magnets of a bogie, halved: one half for each of its axles
    friction_low: float
    friction_high: float
    friction_scale_m_s: float
    contamination_power: float
    drop_change: float  # of the way between raised and lowered, in one tick
    rise_change: float
    lag_share: float
    cut_below_m_s: float
    emergency_Pa: float
    cleaning_gain: float
    cleaning_scale_J_m: float


def build(sections: Mapping[str, Mapping[str, Any]], tick_s: float) -> MagneticTrackBrake:
    """Return the constants of the magnetic track brake; it does not act in a vehicle without one.

    `sections` are checked sections. Raises ConfigError for a brake that cannot work.
    """
    section = sections["magnetic_track_brake"]
    bogies = section["bogies"]
    if bogies:
        _check(section, sections)
    fitted = np.zeros(sections["vehicle"]["axles"], dtype=np.bool_)
    for bogie in bogies:
        first = AXLES_OF_BOGIE * (int(bogie) - 1)
        fitted[first : first + AXLES_OF_BOGIE] = True
    return MagneticTrackBrake(
        acts=bool(bogies),
        fitted=fitted,
        attraction_N=section["magnets"] * section["attraction_N"] / AXLES_OF_BOGIE,
        friction_low=section["friction_low"],
        friction_high=section["friction_high"],
        friction_scale_m_s=section["friction_scale_m_s"],
        contamination_power=section["contamination_power"],
        drop_change=tick_s / section["drop_time_s"],
        rise_change=tick_s / section["rise_time_s"],
        lag_share=-math.expm1(-tick_s / section["force_time_constant_s"]),
        cut_below_m_s=section["cut_below_m_s"],
        emergency_Pa=section["emergency_pressure_Pa"],
        cleaning_gain=section["cleaning_gain"],
        cleaning_scale_J_m=section["cleaning_scale_J_m"],
    )


def _check(section: Mapping[str, Any], sections: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise ConfigError for a magnetic track brake that cannot work."""
    where = "[magnetic_track_brake]"
    given = [f"{bogie:g}" for bogie in section["bogies"]]
    numbers = [int(bogie) for bogie in section["bogies"]]
    most = sections["vehicle"]["axles"] // AXLES_OF_BOGIE
    exact = all(number == bogie for number, bogie in zip(numbers, section["bogies"], strict=True))
    if not exact or len(set(numbers)) < len(numbers) or max(numbers) > most:
        raise ConfigError(
            f"{where} bogies = [{', '.join(given)}]: the vehicle has {most} bogies; list each "
            f"bogie with magnets once, by its number from 1 to {most}"
        )
    if section["attraction_N"] == 0.0:
        raise ConfigError(
            f"{where} bogies = [{', '.join(given)}] without a force; give attraction_N, above 0, "
            "or remove the bogies"
        )
    if section["friction_high"] > section["friction_low"]:
        raise ConfigError(
            f"{where} friction_high = {section['friction_high']:g} is above friction_low = "
            f"{section['friction_low']:g}; the friction of the pole shoes falls with the speed"
        )
    if sections["vehicle"]["model"] != "planar":
        raise ConfigError(
            f"{where} bogies = [{', '.join(given)}]: the coach in 3D has no magnets; allowed is "
            'vehicle.model = "planar"'
        )
