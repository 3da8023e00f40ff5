"""The motor of a roller: torque follows its demand with a lag, within torque, power and speed.

The equation of the roller is [W2] of `wheelset`.

[M1] du/dt = (limit(u_demand) - u) / T. The limit is the largest torque, the power over the speed,
and no driving torque above the largest speed. Gear and converter are inside the lag: assumption.
"""

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined

SLOWEST_RAD_S = 1e-3  # speed by which the power is divided at least


@kernel
def begin(state, params):
    """Write the constants of each axle's motor into the state of a rig."""
    drive = params.drive
    for j in range(state.axles):
        state.motor_most[j] = drive.max_torque_Nm
        state.motor_power[j] = drive.max_power_W
        state.motor_fastest[j] = drive.max_speed_rad_s
        state.motor_share[j] = 0.0 if params.mode == 0 else drive.torque_share


@kernel_inlined
def limit(demand_Nm, speed_rad_s, most_Nm, power_W, fastest_rad_s):
    """Return the torque in N m that the motor may give for a demand, at a roller speed.

    Demand and speed have either sign. The limits are the largest torque, the largest power, and the
    largest speed at which the motor drives.
    """
    largest_Nm = min(most_Nm, power_W / max(abs(speed_rad_s), SLOWEST_RAD_S))
    torque_Nm = min(max(demand_Nm, -largest_Nm), largest_Nm)
    too_fast = (torque_Nm * speed_rad_s > 0.0) & (abs(speed_rad_s) > fastest_rad_s)
    return 0.0 if too_fast else torque_Nm


@kernel
def respond(state):
    """Advance the motor torques by a step, exactly for a constant demand [M1]."""
    for j in range(state.axles):
        wanted_Nm = limit(
            state.motor_torque_demand[j],
            state.roller_speed[j],
            state.motor_most[j],
            state.motor_power[j],
            state.motor_fastest[j],
        )
        torque_Nm = state.motor_torque[j]
        moved_Nm = torque_Nm + (wanted_Nm - torque_Nm) * state.motor_share[j]
        # the motors of a vehicle that stands keep their torque
        state.motor_torque[j] = moved_Nm if state.stage_step[j] != 0.0 else torque_Nm
