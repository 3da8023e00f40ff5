"""Mechanisms that change constants of the model: of vehicle, wheelsets and contact.

A formula takes the constants by name, as numbers or arrays, and returns the constants that it
changes.
"""

from collections.abc import Mapping
from typing import Any

from rollerrig.configs.vehicle import RESISTANCE, running_resistance, track_gradient
from rollerrig.rig.mechanisms.mechanism import (
    ALONE,
    AXLE,
    CONTACT,
    MODELLED_ON_ALL_AXLES,
    NOT_MODELLED,
    VEHICLE,
    WHEEL,
    number,
    row_of,
)

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


def falling_friction(
    model: Model, fraction: float, height: float, contaminant_alone: float
) -> dict[str, Any]:
    """gamma_d, gamma_r = (1 + fraction) of the base; height = 1: 1 / A_d - 1, 1 / A_r - 1;
    contaminant_alone: d only"""
    kinds = "d" if contaminant_alone else "dr"
    if height == 0.0:
        return {f"gamma_{k}_s_m": model[f"gamma_{k}_s_m"] * (1.0 + fraction) for k in kinds}
    return {f"A_{k}": model[f"A_{k}"] / (1.0 + (1.0 - model[f"A_{k}"]) * fraction) for k in kinds}


ROWS = (
    row_of(
        VEHICLE,
        running_resistance,
        (number("force_N", -5000.0, 5000.0, "N"), number("speed_power", 0.0, 2.0, "-")),
        "the running resistance of the vehicle differs",
        "form: Davis 1926",
        tuple(RESISTANCE.values()),
    ),
    row_of(
        VEHICLE,
        track_gradient,
        (number("gradient", -0.03, 0.03, "-"),),
        "the track is not level",
        "mechanics",
        ("resistance_A_N",),
    ),
    row_of(
        WHEEL,
        wheel_radius,
        (number("fraction", -0.06, 0.06, "-"), AXLE),
        "the wheels of one axle differ in radius",
        "assumption",
        ("wheel_radius_m",),
        in_coach=MODELLED_ON_ALL_AXLES,
    ),
    row_of(
        WHEEL,
        wheel_inertia,
        (number("fraction", -0.5, 1.0, "-"), AXLE),
        "the inertia of the wheelsets differs",
        "assumption",
        ("wheelset_inertia_kgm2",),
        in_coach=MODELLED_ON_ALL_AXLES,
    ),
    row_of(
        CONTACT,
        roller_curvature,
        (number("stiffness_fraction", -0.9, 2.0, "-"),),
        "the curvature at the contact patch differs",
        "Hertz 1882; Kalker 1967",
        ("eps1",),
        in_coach=NOT_MODELLED,
    ),
    row_of(
        CONTACT,
        interfacial_layer,
        (number("reduction", 0.0, 0.95, "-"), number("whole", 0.0, 1.0, "-")),
        "a layer softens the contact",
        "Polach 2005",
        ("k_ad", "k_sd", "k_ar", "k_sr"),
    ),
    row_of(
        CONTACT,
        falling_friction,
        (number("fraction", -0.95, 5.0, "-"), number("height", 0.0, 1.0, "-"), ALONE),
        "the fall of friction with sliding differs from the stated one",
        "Polach 2005; CONTACT user guide",
        ("gamma_d_s_m", "gamma_r_s_m", "A_d", "A_r"),
    ),
)
