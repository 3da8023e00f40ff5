"""The motor of a roller: torque follows its demand with a lag, within torque, power and speed.

[M1] du/dt = (limit(u_demand) - u) / T. The limit is the largest torque, the power over the speed,
and no driving torque above the largest speed. Gear and converter are inside the lag: assumption.
"""

from rollerrig.rig.compiled.kernel import kernel

SLOWEST_RAD_S = 1e-3  # speed by which the power is divided at least


@kernel
def limit(demand_Nm, speed_rad_s, drive):
    """Return the torque in N m that the motor may give for a demand, at a roller speed.

    Demand and speed have either sign; `drive` is `params.Drive`.
    """
    largest = min(drive.max_torque_Nm, drive.max_power_W / max(abs(speed_rad_s), SLOWEST_RAD_S))
    torque = min(max(demand_Nm, -largest), largest)
    drives = torque * speed_rad_s > 0.0
    if drives and abs(speed_rad_s) > drive.max_speed_rad_s:
        return 0.0
    return torque


@kernel
def respond(state, drive):
    """Advance the motor torques by a step, exactly for a constant demand [M1]."""
    for j in range(state.axles):
        wanted = limit(state.motor_torque_demand[j], state.roller_speed[j], drive)
        state.motor_torque[j] += (wanted - state.motor_torque[j]) * drive.torque_share
