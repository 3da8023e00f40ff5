"""The inner loops of the roller drives, called in the tick: torque and velocity.

If the rig control moves a drive, its torque demand is left unchanged. A master on the bus commands
a torque [D1], or a velocity, which a proportional-integral loop controls [D2], also in a stop. A
drive that is not enabled gives no torque. While the velocity loop is not active, its integral
follows the torque demand, so that a change of the source causes no jump in torque.

    [D1] u = limit(u_target)
    [D2] u = limit(u_target + J w_c (Omega_target - Omega) + integral), the integral with w_c / 4,
         held while the limit acts

Gains are those of the rig's speed loop: w_c = drive.speed_loop_rad_s on the roller's inertia J.
"""

from rollerrig.firmware_sim.drive402 import axis
from rollerrig.rig.compiled.kernel import kernel


@kernel
def obey(state, drive, commands, tick_s):
    """Write the motor torque demands in N m that follow from the commands of each drive.

    `commands` is the flat array of all drives, shape (axles * COMMANDS,).
    """
    gain = drive.roller_inertia_kgm2 * drive.speed_loop_rad_s
    for j in range(state.axles):
        at = j * axis.COMMANDS
        if commands[at + axis.ENABLED] == 0.0:
            state.motor_torque_demand[j] = 0.0
            state.speed_integral[j] = 0.0
            continue
        if commands[at + axis.LOOP] == axis.LOOP_RIG:
            state.speed_integral[j] = state.motor_torque_demand[j]
            continue
        most_Nm = min(commands[at + axis.TORQUE_LIMIT_Nm], drive.max_torque_Nm)
        torque_Nm = commands[at + axis.TORQUE_Nm]
        if commands[at + axis.LOOP] == axis.LOOP_TORQUE:
            state.motor_torque_demand[j] = min(max(torque_Nm, -most_Nm), most_Nm)  # [D1]
            state.speed_integral[j] = state.motor_torque_demand[j]
            continue
        error = commands[at + axis.VELOCITY_rad_s] - state.roller_speed[j]
        torque_Nm += gain * error + state.speed_integral[j]
        state.motor_torque_demand[j] = min(max(torque_Nm, -most_Nm), most_Nm)  # [D2]
        if state.motor_torque_demand[j] == torque_Nm:  # the limit does not act
            state.speed_integral[j] += 0.25 * drive.speed_loop_rad_s * gain * error * tick_s
