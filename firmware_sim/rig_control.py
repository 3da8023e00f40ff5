"""Rig control: what the bench asks of the roller motors, once a tick.

Contaminated rollers with electric inertia simulation: the rollers weigh far less than the vehicle,
so each motor makes its roller's surface keep the virtual vehicle's speed. The demand is a speed
loop [R1] with the vehicle's own deceleration fed forward and the contact torque estimated by a
disturbance observer from motor torque and roller speed alone [R2].

    [R1] u = J w_c (v / R - Omega) + J a / R + d
    [R2] dz/dt = w_o (u_motor - d), d = z - w_o J Omega, which follows R T with bandwidth w_o

`state` and `drive` are those of rig.state and rig.params; v and a come from the virtual vehicle,
whose contact forces are taken as measured without error (assumption: an ideal load cell).
"""

from rollerrig.rig.kernel import kernel


@kernel
def hold_surface_speed(state, drive, tick_s):
    """Write the motor torque demands in N m of all rollers for the coming tick."""
    J, R = drive.roller_inertia_kgm2, drive.roller_radius_m
    for j in range(state.roller_speed.size):
        if state.standing[0] != 0.0:
            state.motor_torque_demand[j] = 0.0
            continue
        disturbance = state.observer[j] - drive.observer_rad_s * J * state.roller_speed[j]  # [R2]
        state.observer[j] += tick_s * drive.observer_rad_s * (state.motor_torque[j] - disturbance)
        error = state.vehicle_speed[0] / R - state.roller_speed[j]
        state.motor_torque_demand[j] = (J * drive.speed_loop_rad_s * error
                                        + J * state.vehicle_acceleration[0] / R + disturbance)  # [R1]
