"""Brake pneumatics and disc brake: demand, dump valve, cylinder, torque, air.

The distributor lets the demanded pressure rise and fall slowly [B1]. The dump valve of an axle
fills its cylinder towards that pressure, holds it or vents it [B2], a dead time after its magnets
changed. Only filling uses air [B3]. The pads press with the pressure beyond their springs, and the
discs give a torque in proportion [B4].

    [B1] dp_d/dt = (p_target - p_d) / T_fill or T_release
    [B2] dp/dt = (p_d - p) / T_valve while filling, 0 while holding, -p / T_vent while venting
    [B3] air in normal litres: V dp / 101325 Pa for dp > 0
    [B4] C = c (p - p_spring), not below 0
    [B5] with a reservoir, and absolute pressures: q = K p_1 up to p_2 / p_1 = b, beyond it
         K p_1 sqrt(1 - ((p_2 / p_1 - b) / (1 - b))^2)
    [B6] V_r dp_r/dt = -(V dp/dt of all cylinders that fill) + 101325 Pa q of the supply

Source: [B5] ISO 6358-1. First-order pneumatics with assumed constants, air of one temperature:
these are priors, not measurements of one brake. A cylinder whose valve fills while the demand falls
is vented by the distributor [B2].
"""

import math

from rollerrig.configs.vehicle import HOLD_MAGNET, VENT_MAGNET
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.compiled.state_type import rig_of
from rollerrig.rig.state import FILL, HOLD, VENT

NORMAL_PRESSURE_PA = 101325.0


@kernel
def valve_of(magnets):
    """Return the valve state for a pair of magnets: vent wins, none energised fills."""
    energised = int(magnets)
    if energised & VENT_MAGNET:
        return float(VENT)
    if energised & HOLD_MAGNET:
        return float(HOLD)
    return float(FILL)


@kernel
def target(demand, time_s):
    """Return the pressure in Pa demanded at a time in s: the last step of the programme so far."""
    pressure_Pa = 0.0
    for i in range(demand.start_s.size):
        if time_s >= demand.start_s[i]:
            pressure_Pa = demand.pressure_Pa[i]
    return pressure_Pa


@kernel_inlined
def switch_valves(state, delayed_magnets):
    """Set the valves to magnets (axles,) that have passed the dead time, and count new vents."""
    for j in range(state.axles):
        valve = valve_of(delayed_magnets[j])
        if valve == VENT and state.valve[j] != VENT:
            state.vents[j] += 1.0
        state.valve[j] = valve


@kernel
def fill(state, plants):
    """Advance the demanded pressures and the cylinders by a step of constant valves.

    `plants` are the parameters of all rigs. The demand is exact. The cylinders follow its mean over
    the step, which is of second order; with blending they follow the demand of the step before.
    """
    for rig in range(len(plants)):
        demand(rig_of(state, rig, plants[rig].axles), plants[rig])
    for j in range(state.axles):
        p = state.cylinder_pressure[j]
        filled = (state.stage_demand[j] - p) * state.fill_share[j]
        vented = -p * state.vent_share[j] if state.valve[j] == VENT else 0.0
        gain = filled if state.valve[j] == FILL else vented
        state.cylinder_pressure[j] = p + gain  # [B2]
        state.air_filled[j] += max(gain, 0.0) * state.air_per_pressure[j]  # [B3]
    for rig in range(len(plants)):
        if plants[rig].brake.air.reservoir_L > 0.0:
            flow_through_valves(rig_of(state, rig, plants[rig].axles), plants[rig].brake)


@kernel_inlined
def demand(state, params):
    """Advance the demanded pressure of a rig, and set what each cylinder follows in this step."""
    brake = params.brake
    before = state.brake_demand[0]
    target_Pa = state.brake_target[0]
    share = brake.demand_fill_share if target_Pa > before else brake.demand_release_share
    state.brake_demand[0] = before + (target_Pa - before) * share  # [B1]
    mean_Pa = before + 0.5 * (target_Pa - before) * share
    # the motors of a vehicle that stands do not brake
    blends = params.dynamic.acts and state.standing[0] == 0.0
    for j in range(state.axles):
        state.stage_demand[j] = state.friction_demand[j] if blends else mean_Pa


@kernel
def count_air(state):
    """Count the air that all cylinders of a rig have taken so far."""
    total_NL = 0.0
    for j in range(state.axles):
        total_NL += state.air_filled[j]
    state.air_consumption[0] = total_NL


@kernel
def begin(state, brake):
    """Fill the reservoir, where there is one, and write the constants of each axle."""
    air = brake.air
    state.reservoir_pressure[0] = air.begin_Pa if air.reservoir_L > 0.0 else 0.0
    state.reservoir_least[0] = state.reservoir_pressure[0]
    # cylinders on a reservoir fill and vent by choked flow
    lags = air.reservoir_L == 0.0
    for j in range(state.axles):
        state.torque_per_pressure[j] = brake.torque_Nm_Pa[j]
        state.spring_pressure[j] = brake.spring_pressure_Pa
        state.air_per_pressure[j] = brake.volume_L / NORMAL_PRESSURE_PA
        state.fill_share[j] = brake.valve_fill_share if lags else 0.0
        state.vent_share[j] = brake.valve_vent_share if lags else 0.0


@kernel
def flow(from_Pa, to_Pa, conductance, critical_ratio):
    """Return the flow of air in NL/s from one pressure to another [B5]; 0 to a higher pressure.

    Parameters
    ----------
    from_Pa, to_Pa : pressures above that of the atmosphere
    conductance : K in NL/(s Pa)
    critical_ratio : b, the ratio of pressures below which the flow is choked
    """
    p_1 = from_Pa + NORMAL_PRESSURE_PA
    ratio = (to_Pa + NORMAL_PRESSURE_PA) / p_1
    if ratio >= 1.0:
        return 0.0
    x = max(ratio - critical_ratio, 0.0) / (1.0 - critical_ratio)
    return conductance * p_1 * math.sqrt(1.0 - x * x)


@kernel
def flow_through_valves(state, brake):
    """Advance cylinders and reservoir of a rig by a step of choked flow [B5], [B6].

    p_d is that of [B2], or with blending p_f of [E4] in `dynamic_brake`.
    """
    air = brake.air
    p_r = state.reservoir_pressure[0]
    room = air.reservoir_L / NORMAL_PRESSURE_PA  # NL for each Pa
    cylinder = brake.volume_L / NORMAL_PRESSURE_PA  # NL for each Pa

    # the supply feeds the reservoir, at most up to its own pressure
    fed_NL = flow(air.supply_Pa, p_r, air.supply, air.critical_ratio) * air.step_s
    fed_NL = min(fed_NL, max(air.supply_Pa - p_r, 0.0) * room)
    state.air_supplied[0] += fed_NL
    p_r += fed_NL / room

    for j in range(state.axles):
        p = state.cylinder_pressure[j]
        p_d = state.stage_demand[j]
        if state.valve[j] == VENT:
            gone_NL = flow(p, 0.0, air.vent, air.critical_ratio) * air.step_s
            state.cylinder_pressure[j] = max(0.0, p - gone_NL / cylinder)
        elif state.valve[j] == FILL and p_d <= p:
            # the distributor vents the cylinder
            state.cylinder_pressure[j] = p + (p_d - p) * brake.valve_fill_share  # [B2]
        elif state.valve[j] == FILL:
            # neither beyond the demand nor beyond the pressure at which both are equal
            gain_NL = min(
                flow(p_r, p, air.fill, air.critical_ratio) * air.step_s,
                (p_d - p) * cylinder,
                max(p_r - p, 0.0) * cylinder * room / (cylinder + room),
            )
            state.cylinder_pressure[j] = p + gain_NL / cylinder
            state.air_filled[j] += gain_NL
            p_r -= gain_NL / room  # [B6]
    state.reservoir_pressure[0] = p_r
    state.reservoir_least[0] = min(state.reservoir_least[0], p_r)


@kernel
def set_capacities(state):
    """Set the torque that the discs of each axle can hold at the pressure of its cylinder [B4]."""
    for j in range(state.axles):
        state.brake_torque[j] = torque_at(
            state.cylinder_pressure[j], state.torque_per_pressure[j], state.spring_pressure[j]
        )


@kernel_inlined
def torque_at(pressure_Pa, torque_Nm_Pa, spring_Pa):
    """Return the torque in N m that a wheelset's discs can hold at a cylinder pressure [B4]."""
    return max(0.0, torque_Nm_Pa * (pressure_Pa - spring_Pa))
