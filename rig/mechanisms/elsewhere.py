"""Mechanisms of loads, of recovery and of sensors.

A course of a load is a share of it. The memory of recovery [X4] is computed in `wheelset` and in
the replay's `wheel`. The effect of a sensor is in the recording, not in the plant.
"""

import math

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.mechanisms.mechanism import (
    AXLE,
    CONTACT,
    LOAD,
    NOT_MODELLED,
    SENSOR,
    Mechanism,
    number,
    row_of,
)


@kernel
def wheel_out_of_round(angle_rad, phase_rad):
    """N = N_0 (1 + amplitude cos(angle + phase))"""
    return math.cos(angle_rad + phase_rad)


@kernel
def load_transfer(deceleration_m_s2, axle):
    """N = N_0 (1 + d (body b_j + bogie g_j)), d: deceleration, b = ++--, g = +-+-"""
    return deceleration_m_s2 if axle < 2 else -deceleration_m_s2


@kernel
def bogie_transfer(deceleration_m_s2, axle):
    """d g_j of the load transfer."""
    return deceleration_m_s2 if axle % 2 == 0 else -deceleration_m_s2


ROWS = (
    Mechanism(
        "adhesion_memory",
        CONTACT,
        (
            number("length_m", 0.0, 50.0, "m"),
            number("speed_power", 0.0, 1.0, "-"),
            number("of_work", 0.0, 1.0, "-"),
        ),
        "d lambda/dx = (lambda_0 - lambda) / (length (v / 20 m/s)^speed_power); of_work = 1: "
        "lambda_0 = 1 - exp(-tau W) of the work W done meanwhile, not that of the base model",
        "recovery lags the dissipated energy",
        "assumption",
        in_coach=NOT_MODELLED,
    ),
    Mechanism(
        "speed_sensor_delay",
        SENSOR,
        (number("delay_s", 0.0, 0.2, "s"), AXLE),
        "measured omega(t) = omega(t - delay)",
        "the wheel speed is measured late",
        "assumption",
    ),
    Mechanism(
        "sensor_scale",
        SENSOR,
        (number("fraction", -0.06, 0.06, "-"), AXLE),
        "measured omega = (1 + fraction) omega",
        "the speed sensor of one wheelset has a wrong scale",
        "assumption",
    ),
    Mechanism(
        "torque_sensor_delay",
        SENSOR,
        (number("delay_s", 0.0, 0.2, "s"),),
        "measured C(t) = C(t - delay)",
        "the torque is measured late",
        "assumption",
    ),
    row_of(
        LOAD,
        wheel_out_of_round,
        (number("amplitude", 0.0, 0.3, "-"), number("phase_rad", -6.3, 6.3, "rad"), AXLE),
        "the load swings once a turn",
        "assumption",
        share=True,
        in_coach=NOT_MODELLED,
    ),
    row_of(
        LOAD,
        load_transfer,
        (number("body_s2_m", -0.1, 0.1, "s2/m"), number("bogie_s2_m", -0.1, 0.1, "s2/m")),
        "braking shifts more load than stated",
        "mechanics",
        courses=(load_transfer, bogie_transfer),
        share=True,
        free=2,
        in_coach=NOT_MODELLED,
    ),
)
