"""Rig control: computes the torque demands of the roller motors, once a tick.

Contaminated rollers with electric inertia simulation: the rollers weigh far less than the vehicle.
Each motor therefore makes the surface of its roller keep the speed of the virtual vehicle. The
demand comes from a speed loop with the deceleration of the vehicle as feed-forward [R1]. A
disturbance observer estimates the contact torque from motor torque and roller speed alone [R2].

Virtual track (Allotta, Conti, Meli, Ridolfi: Firenze-Osmannoro): the rollers are dry, and the
wheels hardly slide on them. A virtual vehicle on the degraded track is simulated in parallel. Each
motor makes its real wheelset turn as the virtual one does [R3]. Both wheelsets have the same brake
torque, so the roller must apply the virtual contact force.

In an emergency stop the drives stop the rollers, and the inertia of the vehicle is no longer
simulated. The vehicle then has the mean speed of its rollers, but never becomes faster [R4].

    [R1] u = J w_c (v / R - Omega) + J a / R + d
    [R2] dz/dt = w_o (u_motor - d), d = z - w_o J Omega, which follows R T with bandwidth w_o
    [R3] u = R T_v + J_R (r / R) domega_v/dt + w_c (J_R r / R + J R / r) (omega_v - omega)
    [R4] v = min(v, mean of R Omega), not below 0

`state` and `drive` are those of rig.state and rig.params. The speed v and the acceleration a come
from the virtual vehicle, whose contact forces are measured without error (assumption: an ideal load
cell).
"""

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined


@kernel
def hold_surface_speed(state, drive, tick_s):
    """Write the motor torque demands in N m of all rollers for the coming tick."""
    for j in range(state.axles):
        if state.standing[0] != 0.0:
            state.motor_torque_demand[j] = 0.0
            continue
        state.motor_torque_demand[j], state.observer[j] = held(
            state.roller_speed[j],
            state.observer[j],
            state.motor_torque[j],
            state.vehicle_speed[0],
            state.vehicle_acceleration[0],
            drive.roller_inertia_kgm2,
            drive.roller_radius_m,
            drive.speed_loop_rad_s,
            drive.observer_rad_s,
            tick_s,
        )


@kernel_inlined
def held(omega, observer, motor_Nm, v, a, J, R, speed_loop_rad_s, observer_rad_s, tick_s):
    """Return the torque demand in N m of a motor, and its observer after the tick [R1], [R2].

    Parameters
    ----------
    omega, motor_Nm : speed of the roller in rad/s, torque of its motor
    observer : z of [R2] in N m
    v, a : speed and acceleration of the vehicle
    J, R : inertia and radius of the roller
    speed_loop_rad_s, observer_rad_s : w_c and w_o
    """
    disturbance = observer - observer_rad_s * J * omega  # [R2]
    error = v / R - omega
    demand_Nm = J * speed_loop_rad_s * error + J * a / R + disturbance  # [R1]
    return demand_Nm, observer + tick_s * observer_rad_s * (motor_Nm - disturbance)


@kernel
def follow_virtual_wheels(state, virtual, drive, radius_m, inertia_kgm2):
    """Write the motor torque demands in N m that make the wheels of `state` turn as `virtual`'s.

    radius_m and inertia_kgm2 (axles,) are those of the wheelsets.
    """
    R = drive.roller_radius_m
    for j in range(state.axles):
        if virtual.standing[0] != 0.0:
            state.motor_torque_demand[j] = 0.0
            continue
        r = radius_m[j]
        J = inertia_kgm2[j]
        rolled = drive.roller_inertia_kgm2 * r / R  # J_R r / R of [R3]
        force_N = virtual.adhesion[j] * virtual.wheel_load[j]
        wheel_rate = (r * force_N - virtual.brake_torque[j]) / J
        error = virtual.wheel_speed[j] - state.wheel_speed[j]
        state.motor_torque_demand[j] = (
            R * force_N
            + rolled * wheel_rate
            + drive.speed_loop_rad_s * (rolled + J * R / r) * error
        )  # [R3]


@kernel
def stop_with_rollers(state, rollers, drive):
    """Limit the speed of the vehicle to that of its rollers [R4]; `rollers` is their state."""
    rim_m_s = drive.roller_radius_m * rollers.roller_speed.mean()
    state.vehicle_speed[0] = min(state.vehicle_speed[0], max(rim_m_s, 0.0))
