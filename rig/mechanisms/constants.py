"""Mechanisms that change constants of the model: of vehicle, wheelsets and contact.

Their formulas take the constants by name, numbers or arrays, and return those that they change.
"""

from collections.abc import Mapping
from typing import Any

from rollerrig.configs.vehicle import RESISTANCE, running_resistance, track_gradient
from rollerrig.rig.mechanisms.mechanism import (
    ALL_AXLES_ALIKE,
    AXLE,
    CONTACT,
    NOT,
    VEHICLE,
    WHEEL,
    Mechanism,
    parameter,
)


def wheel_radius(model: Mapping[str, Any], fraction: Any) -> dict[str, Any]:
    """r_0 (1 + fraction)."""
    return {"wheel_radius_m": model["wheel_radius_m"] * (1.0 + fraction)}


def wheel_inertia(model: Mapping[str, Any], fraction: Any) -> dict[str, Any]:
    """J_0 (1 + fraction)."""
    return {"wheelset_inertia_kgm2": model["wheelset_inertia_kgm2"] * (1.0 + fraction)}


def roller_curvature(model: Mapping[str, Any], stiffness_fraction: float) -> dict[str, Any]:
    """eps_0 (1 + stiffness_fraction)."""
    return {"eps1": model["eps1"] * (1.0 + stiffness_fraction)}


def interfacial_layer(model: Mapping[str, Any], reduction: float, whole: float) -> dict[str, Any]:
    """Factors of adhesion, of the whole contact those of slip as well, times (1 - reduction)."""
    keys = ("k_ad", "k_ar") if whole == 0.0 else ("k_ad", "k_ar", "k_sd", "k_sr")
    return {key: model[key] * (1.0 - reduction) for key in keys}


def falling_friction(model: Mapping[str, Any], fraction: float, height: float) -> dict[str, Any]:
    """Decay of friction with sliding, or the height of its fall 1 / A - 1, times (1 + fraction)."""
    if height == 0.0:
        return {key: model[key] * (1.0 + fraction) for key in ("gamma_d_s_m", "gamma_r_s_m")}
    return {key: model[key] / (1.0 + (1.0 - model[key]) * fraction) for key in ("A_d", "A_r")}


ROWS = (
    Mechanism(
        "running_resistance", VEHICLE,
        (parameter("force_N", -5000.0, 5000.0, "N"), parameter("speed_power", 0.0, 2.0, "-")),
        "R = R_0 + force (v / 20 m/s)^speed_power", "the vehicle runs with another resistance",
        "form: Davis 1926", constants=running_resistance, changes=tuple(RESISTANCE.values())),
    Mechanism(
        "track_gradient", VEHICLE, (parameter("gradient", -0.03, 0.03, "-"),),
        "R = R_0 + M g gradient; uphill is positive", "the track is not level", "mechanics",
        constants=track_gradient, changes=("resistance_A_N",)),
    Mechanism(
        "wheel_radius", WHEEL, (parameter("fraction", -0.06, 0.06, "-"), AXLE),
        "r = r_0 (1 + fraction)", "the wheels of one axle have another radius", "bounds: wear, assumption",
        constants=wheel_radius, changes=("wheel_radius_m",), in_coach=ALL_AXLES_ALIKE),
    Mechanism(
        "wheel_inertia", WHEEL, (parameter("fraction", -0.5, 1.0, "-"), AXLE),
        "J = J_0 (1 + fraction)", "the wheelsets have another inertia", "assumption",
        constants=wheel_inertia, changes=("wheelset_inertia_kgm2",), in_coach=ALL_AXLES_ALIKE),
    Mechanism(
        "roller_curvature", CONTACT, (parameter("stiffness_fraction", -0.9, 2.0, "-"),),
        "eps = (1 + stiffness_fraction) eps_0", "the patch is that of another curvature",
        "Hertz 1882; Kalker 1967", constants=roller_curvature, changes=("eps1",), in_coach=NOT),
    Mechanism(
        "interfacial_layer", CONTACT,
        (parameter("reduction", 0.0, 0.95, "-"), parameter("whole", 0.0, 1.0, "-")),
        "k_ad, k_ar = (1 - reduction) of the base; whole = 1: k_sd, k_sr as well",
        "a layer softens the contact", "Polach 2005",
        constants=interfacial_layer, changes=("k_ad", "k_sd", "k_ar", "k_sr")),
    Mechanism(
        "falling_friction", CONTACT,
        (parameter("fraction", -0.95, 5.0, "-"), parameter("height", 0.0, 1.0, "-")),
        "gamma_d, gamma_r = (1 + fraction) of the base; height = 1: 1 / A_d - 1, 1 / A_r - 1 instead",
        "friction falls with sliding otherwise than told", "Polach 2005; CONTACT user guide",
        constants=falling_friction, changes=("gamma_d_s_m", "gamma_r_s_m", "A_d", "A_r")),
)
