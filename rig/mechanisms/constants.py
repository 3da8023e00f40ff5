"""Mechanisms that change constants of the model: of vehicle, wheelsets and contact.

Their formulas take the constants by name, numbers or arrays, and return those that they change.
"""

from collections.abc import Mapping
from typing import Any

from rollerrig.configs.vehicle import RESISTANCE, running_resistance, track_gradient
from rollerrig.rig.mechanisms import mechanism as m
from rollerrig.rig.mechanisms.mechanism import CONTACT, VEHICLE, WHEEL, number, of_constants

Model = Mapping[str, Any]


def wheel_radius(model: Model, fraction: Any) -> dict[str, Any]:
    """r = r_0 (1 + fraction)"""
    return {"wheel_radius_m": model["wheel_radius_m"] * (1.0 + fraction)}


def wheel_inertia(model: Model, fraction: Any) -> dict[str, Any]:
    """J = J_0 (1 + fraction)"""
    return {"wheelset_inertia_kgm2": model["wheelset_inertia_kgm2"] * (1.0 + fraction)}


def roller_curvature(model: Model, stiffness_fraction: float) -> dict[str, Any]:
    """eps = (1 + stiffness_fraction) eps_0"""
    return {"eps1": model["eps1"] * (1.0 + stiffness_fraction)}


def interfacial_layer(model: Model, reduction: float, whole: float) -> dict[str, Any]:
    """k_ad, k_ar = (1 - reduction) of the base; whole = 1: k_sd, k_sr as well"""
    keys = ("k_ad", "k_ar") if whole == 0.0 else ("k_ad", "k_ar", "k_sd", "k_sr")
    return {key: model[key] * (1.0 - reduction) for key in keys}


def falling_friction(model: Model, fraction: float, height: float) -> dict[str, Any]:
    """gamma_d, gamma_r = (1 + fraction) of the base; height = 1: 1 / A_d - 1, 1 / A_r - 1 instead"""
    if height == 0.0:
        return {key: model[key] * (1.0 + fraction) for key in ("gamma_d_s_m", "gamma_r_s_m")}
    return {key: model[key] / (1.0 + (1.0 - model[key]) * fraction) for key in ("A_d", "A_r")}


ROWS = (
    of_constants(VEHICLE, running_resistance, tuple(RESISTANCE.values()),
                 (number("force_N", -5000.0, 5000.0, "N"), number("speed_power", 0.0, 2.0, "-")),
                 "the vehicle runs with another resistance", "form: Davis 1926"),
    of_constants(VEHICLE, track_gradient, ("resistance_A_N",), (number("gradient", -0.03, 0.03, "-"),),
                 "the track is not level", "mechanics"),
    of_constants(WHEEL, wheel_radius, ("wheel_radius_m",), (number("fraction", -0.06, 0.06, "-"), m.AXLE),
                 "the wheels of one axle have another radius", "assumption", in_coach=m.ALL_AXLES_ALIKE),
    of_constants(WHEEL, wheel_inertia, ("wheelset_inertia_kgm2",), (number("fraction", -0.5, 1.0, "-"), m.AXLE),
                 "the wheelsets have another inertia", "assumption", in_coach=m.ALL_AXLES_ALIKE),
    of_constants(CONTACT, roller_curvature, ("eps1",), (number("stiffness_fraction", -0.9, 2.0, "-"),),
                 "the patch is that of another curvature", "Hertz 1882; Kalker 1967", in_coach=m.NOT),
    of_constants(CONTACT, interfacial_layer, ("k_ad", "k_sd", "k_ar", "k_sr"),
                 (number("reduction", 0.0, 0.95, "-"), number("whole", 0.0, 1.0, "-")),
                 "a layer softens the contact", "Polach 2005"),
    of_constants(CONTACT, falling_friction, ("gamma_d_s_m", "gamma_r_s_m", "A_d", "A_r"),
                 (number("fraction", -0.95, 5.0, "-"), number("height", 0.0, 1.0, "-")),
                 "friction falls with sliding otherwise than told", "Polach 2005; CONTACT user guide"),
)
