"""Heat of brake discs and roller motors: the heat of a stop, and how they lose it again.

All work of a wheelset's brake becomes heat of its discs, which give it to the air [H1]. The losses
of a motor grow with the square of its torque, so its winding approaches a rise above the air that
is the rated one at the rated torque [H2]. A drive reacts to its temperature. The temperature of the
discs acts back where pads vary (`mechanisms.pads`). The mechanism `pad_fade` depends on the work
alone.

    [H1] C dT/dt = dW/dt - C (T - T_air) / t_d, W the brake work, C of all discs of a wheelset
    [H2] t_m dT/dt = (u / u_rated)^2 dT_rated - (T - T_air), u the motor torque

One step a tick, the decay exact. Source: heat balance of a lumped body; IEC 60034-1 gives the rated
rise of an insulation class. Doubt: one body for a disc set and one for a motor, cooling that does
not depend on speed; every constant is an assumption.
"""

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined


@kernel_inlined
def begin(state, heat):
    """Set discs and motors to the temperature of the air; `heat` is `params.Heat`."""
    for j in range(state.axles):
        state.disc_temperature[j] = heat.air_K
        state.motor_temperature[j] = heat.air_K
        state.brake_work_before[j] = state.brake_work[j]


@kernel
def advance(state, heat):
    """Advance the temperatures by a tick; `heat` is `params.Heat`."""
    for j in range(state.axles):
        # work of this tick
        work_J = state.brake_work[j] - state.brake_work_before[j]
        state.brake_work_before[j] = state.brake_work[j]
        state.disc_temperature[j] = disc_K(
            state.disc_temperature[j], work_J, heat.air_K, heat.disc_J_K, heat.disc_share
        )
        state.motor_temperature[j] = motor_K(
            state.motor_temperature[j],
            state.motor_torque[j],
            heat.air_K,
            heat.rated_torque_Nm,
            heat.motor_rise_K,
            heat.motor_share,
        )


@kernel_inlined
def disc_K(before_K, work_J, air_K, disc_J_K, disc_share):
    """Return the temperature of a disc set after a tick with this brake work [H1]."""
    return before_K + (work_J / disc_J_K - (before_K - air_K) * disc_share)


@kernel_inlined
def motor_K(before_K, torque_Nm, air_K, rated_torque_Nm, motor_rise_K, motor_share):
    """Return the temperature of a motor after a tick at this torque [H2]."""
    load = torque_Nm / rated_torque_Nm
    return before_K + (load * load * motor_rise_K - (before_K - air_K)) * motor_share
