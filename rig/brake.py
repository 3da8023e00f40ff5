"""Brake pneumatics and disc brake: demand, dump valve, cylinder, torque, air.

The distributor lets the demanded pressure rise and fall slowly [B1]. The dump valve of an axle
fills its cylinder towards that pressure, holds it or vents it [B2], each a dead time after its
magnets changed; only filling uses air [B3]. The pads press with the pressure beyond their springs
and the discs give a torque in proportion [B4].

    [B1] dp_d/dt = (p_target - p_d) / T_fill or T_release
    [B2] dp/dt = (p_d - p) / T_fill while filling, 0 while holding, -p / T_vent while venting
    [B3] air in normal litres: V dp / 101325 Pa for dp > 0
    [B4] C = c (p - p_spring), not below 0

First-order pneumatics with assumed constants: priors, not measurements of one brake.
"""

from rollerrig.rig.kernel import kernel, kernel_inlined
from rollerrig.rig.state import AXLES, FILL, VENT

NORMAL_PRESSURE_PA = 101325.0


@kernel
def valve_of(magnets):
    """Valve state of a magnet pattern (bit 0 hold, bit 1 vent): vent wins, none energised fills."""
    if int(magnets) & 2:
        return 2.0
    return float(int(magnets) & 1)


@kernel
def target(demand, time_s):
    """Pressure in Pa asked for at a time in s: the last step of the programme that has begun."""
    pressure_Pa = 0.0
    for i in range(demand.start_s.size):
        if time_s >= demand.start_s[i]:
            pressure_Pa = demand.pressure_Pa[i]
    return pressure_Pa


@kernel_inlined
def switch(state, delayed_magnets):
    """Set the valves to magnets that have passed the dead time, shape (4,); count new vents."""
    for j in range(AXLES):
        valve = valve_of(delayed_magnets[j])
        if valve == VENT and state.valve[j] != VENT:
            state.vents[j] += 1.0
        state.valve[j] = valve


@kernel_inlined
def fill(state, brake, target_Pa):
    """Advance demand and cylinder pressures by a step with constant valves and target.

    The demand is exact; the cylinders see its mean over the step, which is of second order.
    """
    before = state.brake_demand[0]
    share = brake.demand_fill_share if target_Pa > before else brake.demand_release_share
    state.brake_demand[0] = before + (target_Pa - before) * share  # [B1]
    p_d = before + 0.5 * (target_Pa - before) * share
    for j in range(AXLES):
        p = state.cylinder_pressure[j]
        if state.valve[j] == VENT:
            state.cylinder_pressure[j] = p - p * brake.valve_vent_share  # [B2]
        elif state.valve[j] == FILL:
            gain = (p_d - p) * brake.valve_fill_share
            state.cylinder_pressure[j] = p + gain
            state.air_consumption[0] += max(gain, 0.0) * brake.volume_L / NORMAL_PRESSURE_PA  # [B3]


@kernel
def capacity(pressure_Pa, brake):
    """Torque in N m that the discs of a wheelset can hold at a cylinder pressure [B4]."""
    return max(0.0, brake.torque_Nm_Pa * (pressure_Pa - brake.spring_pressure_Pa))
