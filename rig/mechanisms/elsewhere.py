"""Mechanisms of loads, of recovery and of sensors, which act at places of their own.

Courses of a load are shares of it. The memory of recovery [X4] stands in `wheelset` and in the replay's
`memory_replay`; what a sensor does to the truth lies in the recording, not in the plant.
"""

import math

from rollerrig.rig.kernel import kernel
from rollerrig.rig.mechanisms.mechanism import AXLE, CONTACT, LOAD, NOT, SENSOR, Mechanism, parameter


@kernel
def wheel_out_of_round(angle_rad, phase_rad):
    """cos(angle + phase)."""
    return math.cos(angle_rad + phase_rad)


@kernel
def body_transfer(deceleration_m_s2, axle):
    """d on the leading bogie, -d on the trailing one."""
    return deceleration_m_s2 if axle < 2 else -deceleration_m_s2


@kernel
def bogie_transfer(deceleration_m_s2, axle):
    """d on the leading wheelset of a bogie, -d on the trailing one."""
    return deceleration_m_s2 if axle % 2 == 0 else -deceleration_m_s2


ROWS = (
    Mechanism(
        "adhesion_memory", CONTACT,
        (parameter("length_m", 0.0, 50.0, "m"), parameter("speed_power", 0.0, 1.0, "-"),
         parameter("of_work", 0.0, 1.0, "-")),
        "d lambda/dx = (lambda_0 - lambda) / (length (v / 20 m/s)^speed_power); of_work = 1: "
        "lambda_0 = 1 - exp(-tau W) of the work W done meanwhile, not that of the base model",
        "recovery lags the dissipated energy", "assumption", in_coach=NOT),
    Mechanism(
        "speed_sensor_delay", SENSOR, (parameter("delay_s", 0.0, 0.2, "s"), AXLE),
        "measured omega(t) = omega(t - delay)", "the wheel speed is told late", "assumption"),
    Mechanism(
        "torque_sensor_delay", SENSOR, (parameter("delay_s", 0.0, 0.2, "s"),),
        "measured C(t) = C(t - delay)", "the torque is told late", "assumption"),
    Mechanism(
        "wheel_out_of_round", LOAD,
        (parameter("amplitude", 0.0, 0.3, "-"), parameter("phase_rad", -6.3, 6.3, "rad"), AXLE),
        "N = N_0 (1 + amplitude cos(angle + phase))", "the load swings once a turn", "assumption",
        (wheel_out_of_round,), share=True, in_coach=NOT),
    Mechanism(
        "load_transfer", LOAD,
        (parameter("body_s2_m", -0.1, 0.1, "s2/m"), parameter("bogie_s2_m", -0.1, 0.1, "s2/m")),
        "N = N_0 (1 + d (body b_j + bogie g_j)), d: deceleration, b = ++--, g = +-+-",
        "braking shifts more load than told", "mechanics", (body_transfer, bogie_transfer), share=True,
        free=2, in_coach=NOT),
)
