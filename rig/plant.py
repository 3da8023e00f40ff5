"""The plant: the table of contents of the physics, in the order in which it happens.

`advance` moves the whole rig by one tick of several steps under magnets and motor demands that
stay constant; `observe` writes what can be seen. Energy: what vehicle, wheelsets and rollers lose
is what contacts, brakes and resistance take, less what the motors give.
"""

import math

import numpy as np

from rollerrig.rig import brake, heat, motor, vehicle, wheelset
from rollerrig.rig.contact import adhesion
from rollerrig.rig.kernel import kernel, kernel_inlined
from rollerrig.rig.mechanisms import applied
from rollerrig.rig.multibody import coach_state, on_rig
from rollerrig.rig.params import Params
from rollerrig.rig.state import AXLES, SIZE, State, views

# a wheel slower than this at its rim counts as locked, m/s
LOCKED_BELOW_M_S = 0.1


class Plant:
    """Parameters, state and memory of the valves' dead time: what one run carries."""

    def __init__(self, params: Params, initial_speed_m_s: float) -> None:
        self.params = params
        self.buffer = np.zeros(SIZE if params.coach is None else SIZE + coach_state.SIZE)
        self.state: State = views(self.buffer)
        self.delay = np.zeros((params.brake.dead_time_ticks + 1, AXLES))
        start(self.state, params, initial_speed_m_s)


@kernel
def start(state, params, initial_speed_m_s):
    """Set a rig that rolls at a speed in m/s, brakes released, wheels and rollers without sliding."""
    state.vehicle_speed[0] = initial_speed_m_s
    for j in range(AXLES):
        state.wheel_speed[j] = initial_speed_m_s / params.wheels.table[vehicle.RADIUS_M + j]
        if params.mode != 0:
            state.roller_speed[j] = initial_speed_m_s / params.drive.roller_radius_m
        state.observer[j] = (params.drive.observer_rad_s * params.drive.roller_inertia_kgm2
                             * state.roller_speed[j])
    begin(state, params, params.coach)
    heat.begin(state, params.heat)
    friction(state, params)
    observe(state, params)


@kernel_inlined
def begin(state, params, coach):
    """Set the multibody coach rolling, where the vehicle is one."""
    if coach is not None:
        on_rig.start(state, coach)


@kernel_inlined
def friction(state, params):
    """Set the contaminant under each axle for this time and place."""
    plan = params.friction
    if params.effects.on_friction or params.effects.on_torque:
        applied.remember(state, params.axle_position_m, params.tick_s)
    for j in range(AXLES):
        state.friction_degraded[j] = params.law.mu_cd
        state.friction_recovered[j] = params.law.mu_cr
        place = state.position[0] - params.axle_position_m[j]
        for i in range(plan.start.size):
            here = place if plan.by_place[i] else state.time[0]
            if here >= plan.start[i] and (plan.axles[i] >> j) & 1:
                state.friction_degraded[j] = plan.mu_cd[i]
                state.friction_recovered[j] = plan.mu_cr[i]
        asked = state.friction_asked[j]
        if asked > 0.0:
            state.friction_degraded[j] = asked
            state.friction_recovered[j] = max(params.law.mu_cr, asked)
        if params.effects.on_friction:
            factor = applied.friction_factor(state, j, place, params.effects)
            state.friction_degraded[j] *= factor
            state.friction_recovered[j] *= factor


@kernel_inlined
def advance(state, delay, magnets, demand_Pa, tick, params):
    """Advance by tick number `tick` under magnets (4,); `delay` (dead time + 1, 4) is kept for it.

    `demand_Pa` is a brake demand from outside; NaN: the programme's own.
    """
    target_Pa = prepare(state, delay, magnets, demand_Pa, tick, params)
    for i in range(params.substeps):
        step(state, target_Pa, params)
        state.time[0] = (tick * params.substeps + i + 1) * params.step_s
    heat.warm(state, params.heat)


@kernel_inlined
def prepare(state, delay, magnets, demand_Pa, tick, params):
    """Set what stays constant for a tick, valves and friction; returns the pressure asked for in Pa."""
    for j in range(AXLES):
        delay[tick % delay.shape[0], j] = magnets[j]
    brake.switch(state, delay[(tick + 1) % delay.shape[0]])
    friction(state, params)
    if np.isnan(demand_Pa):
        return brake.target(params.demand, state.time[0])
    return demand_Pa


@kernel_inlined
def step(state, target_Pa, params):
    """Advance by one step of the physics."""
    brake.fill(state, params.brake, target_Pa)
    if state.standing[0] != 0.0:
        rest(state, params, params.coach)
        return
    if params.mode != 0:
        motor.respond(state, params.drive)
    # what the discs can hold at the step's end; `observe` writes what acts
    for j in range(AXLES):
        state.brake_torque[j] = capacity(state, j, params)
    integrate(state, params, params.coach)
    vehicle.settle(state)


@kernel
def capacity(state, axle, params):
    """Torque in N m that the discs of an axle can hold now."""
    found = brake.capacity(state.cylinder_pressure[axle], params.brake)
    if params.effects.on_torque:
        place_m = state.position[0] - params.axle_position_m[axle]
        found = applied.torque(found, state, axle, place_m, params.effects)
    return found


@kernel_inlined
def integrate(state, params, coach):
    """Advance the vehicle, planar or multibody, with its wheelsets and rollers by one step."""
    if coach is None:
        wheelset.integrate(state, params)
    else:
        on_rig.integrate(state, params, vehicle.resistance(state.vehicle_speed[0], params.vehicle),
                         coach)


@kernel_inlined
def rest(state, params, coach):
    """Let a standing vehicle swing out."""
    vehicle.rest(state, params.vehicle, params.step_s)
    if coach is not None:
        on_rig.rest(state, coach)


@kernel_inlined
def observe(state, params):
    """Write what can be seen of the present state: contact, torques, loads, sensors, locks."""
    for j in range(AXLES):
        r = params.wheels.table[vehicle.RADIUS_M + j]
        planar_N = vehicle.swinging_load(vehicle.load(j, state.felt_acceleration[0], params.vehicle), j,
                                         state.wheel_angle[j], params.wheels)
        load_N = on_rig.load(j, planar_N, state, params.coach)
        surface = state.vehicle_speed[0]
        if params.mode != 0:
            surface = params.drive.roller_radius_m * state.roller_speed[j]
        sliding = surface - r * state.wheel_speed[j]
        f, f_d, f_r, transition, energy, _ = wheelset.adhesion_under(
            on_rig.slip(j, sliding, state, params.coach), surface, load_N,
            state.friction_degraded[j], state.friction_recovered[j], params.patch, params.law)
        if params.effects.memory_m > 0.0:
            instantaneous, transition = f, state.lagged_transition[j]
            f = math.copysign(adhesion.between(f_d, f_r, transition), f)
            energy *= f / instantaneous if instantaneous != 0.0 else 0.0
        f = on_rig.adhesion(j, f, load_N, state, params.coach)
        state.sliding[j] = sliding
        state.creepage[j] = 0.0 if surface <= 0.0 else sliding / surface
        state.adhesion[j], state.transition[j], state.dissipated_energy[j] = f, transition, energy
        state.adhesion_degraded[j], state.adhesion_recovered[j] = f_d, f_r
        state.wheel_load[j] = load_N
        torque = capacity(state, j, params)
        if state.wheel_speed[j] <= 0.0:
            torque = min(torque, max(0.0, r * f * load_N))
        state.brake_torque[j] = torque
        state.wheel_circumferential_speed[j] = r * state.wheel_speed[j]
        teeth_per_rad = params.teeth / (2.0 * np.pi)
        state.tooth_frequency[j] = state.wheel_speed[j] * teeth_per_rad
        state.pulse_count[j] = np.floor(state.wheel_angle[j] * teeth_per_rad)
        watch_lock(state, j, params)


@kernel_inlined
def watch_lock(state, axle, params):
    """Count how long a wheelset has been locked while the vehicle still runs."""
    runs = state.vehicle_speed[0] > params.lock_above_m_s
    if runs and state.wheel_circumferential_speed[axle] < LOCKED_BELOW_M_S:
        state.locked_since[axle] += params.tick_s
        state.longest_lock[axle] = max(state.longest_lock[axle], state.locked_since[axle])
    else:
        state.locked_since[axle] = 0.0
