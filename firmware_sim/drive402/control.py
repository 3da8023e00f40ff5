"""The inner loops of the roller drives, called in the tick: torque and velocity.

While the rig control has a drive its demand stands. A master on the bus asks for a torque [D1] or a velocity, which a
proportional-integral loop holds [D2], also in a stop; a drive that is not enabled gives no torque. While somebody
else has the motor the integral follows the demand, so a change of hands makes no jump in torque.

    [D1] u = limit(u_target)
    [D2] u = limit(u_target + J w_c (Omega_target - Omega) + integral), the integral with w_c / 4,
         held while the limit acts

Gains are those of the rig's speed loop: w_c = drive.speed_loop_rad_s on the roller's inertia J.
"""

from rollerrig.firmware_sim.drive402 import axis
from rollerrig.rig.compiled.kernel import kernel


@kernel
def obey(state, drive, asked, tick_s):
    """Turn what each drive was asked, flat (axles * COMMANDS,), into motor torque demands in N m."""
    gain = drive.roller_inertia_kgm2 * drive.speed_loop_rad_s
    for j in range(state.roller_speed.size):
        at = j * axis.COMMANDS
        if asked[at + axis.ENABLED] == 0.0:
            state.motor_torque_demand[j] = 0.0
            state.speed_integral[j] = 0.0
            continue
        if asked[at + axis.LOOP] == axis.LOOP_RIG:
            state.speed_integral[j] = state.motor_torque_demand[j]
            continue
        most = min(asked[at + axis.TORQUE_LIMIT_Nm], drive.max_torque_Nm)
        wanted = asked[at + axis.TORQUE_Nm]
        if asked[at + axis.LOOP] == axis.LOOP_TORQUE:
            state.motor_torque_demand[j] = min(max(wanted, -most), most)  # [D1]
            state.speed_integral[j] = state.motor_torque_demand[j]
            continue
        error = asked[at + axis.VELOCITY_rad_s] - state.roller_speed[j]
        wanted += gain * error + state.speed_integral[j]
        state.motor_torque_demand[j] = min(max(wanted, -most), most)  # [D2]
        if state.motor_torque_demand[j] == wanted:
            state.speed_integral[j] += 0.25 * drive.speed_loop_rad_s * gain * error * tick_s
