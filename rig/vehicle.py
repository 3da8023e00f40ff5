"""The virtual vehicle: one mass on its wheelsets, its running resistance and its load transfer.

[V1] M dv/dt = -sum T - (A + B v + C v^2).
[V2] The body's centre of mass lies above the pivots, so braking at d loads the leading bogie:
     m_body d (h_body - h_pivot) / bogie distance. A body on more bogies is rigid (assumption):
     the forces on its bogies vary with their distance from its middle.
[V3] Body, frame and wheelsets pull above the rail, so each bogie loads its leading wheelset:
     (m_body / bogies h_pivot + m_bogie h_bogie + 2 m_ws r) d / wheelbase.
[V4] A wheel out of round varies the load of its axle once a turn: N (1 + a cos(angle + phase)).
The pitch of body and frames is not modelled here: the transfer follows the deceleration with a lag.
"""

import math

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.mechanisms.elsewhere import wheel_out_of_round

# Below this speed a braked or resisted vehicle stands: resistance is dry friction there.
STANDING_M_S = 0.005
# Rows of the table of the wheels (`mechanisms.applied.Wheels`), with one value for each axle:
# radius, inertia, radius over inertia (rad/s2 for each newton, so that no step has to divide), and
# the share of the load that varies once a turn.
RADIUS_M, INERTIA_KGM2, RESPONSE_1_KGM, SWING = range(4)


@kernel
def resistance(speed_m_s, vehicle):
    """Return the running resistance in N at a speed [V1]; `vehicle` is `params.Vehicle`."""
    return (
        vehicle.resistance_A_N
        + vehicle.resistance_B_N_s_m * speed_m_s
        + vehicle.resistance_C_N_s2_m2 * speed_m_s * speed_m_s
    )


@kernel
def load(axle, felt_acceleration_m_s2, vehicle):
    """Return the load in N of a wheelset (0 the leading one) at the felt acceleration [V2, V3].

    The felt acceleration is the one that the pitch of body and bogies has followed; it is negative
    in braking.
    """
    transfer_N = felt_acceleration_m_s2 * vehicle.transfer_kg[axle]
    return max(0.0, vehicle.static_load_N - transfer_N)


@kernel
def swinging_load(load_N, axle, angle_rad, wheels):
    """Return the load in N of a wheelset at an angle of its wheels, round or not [V4]."""
    if not wheels.swings:
        return load_N
    return load_N * (
        1.0 + wheels.table[SWING, axle] * wheel_out_of_round(angle_rad, wheels.swing_phase_rad)
    )


@kernel_inlined
def pitch_back(state, vehicle, step_s):
    """Let body and bogies of a standing vehicle pitch back: its loads become the static ones."""
    state.felt_acceleration[0] *= math.exp(-step_s / vehicle.pitch_time_constant_s)


@kernel_inlined
def settle(state):
    """Bring a vehicle that hardly moves to rest, with its wheels and rollers."""
    if state.standing[0] == 0.0 and state.vehicle_speed[0] < STANDING_M_S:
        state.standing[0] = 1.0
        state.vehicle_speed[0] = 0.0
        state.vehicle_acceleration[0] = 0.0
        for j in range(state.axles):
            state.wheel_speed[j] = 0.0
            state.roller_speed[j] = 0.0
            state.motor_torque[j] = 0.0
            state.brake_torque[j] = 0.0
