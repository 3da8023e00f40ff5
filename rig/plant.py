"""The plant: the table of contents of the physics, in the order in which it happens.

`advance` moves a rig by one tick of several steps, during which magnets and motor demands are
constant: `prepare`, so many times `step`, `finish`. `observe` writes the observed quantities.
Energy: vehicle, wheelsets and rollers lose the energy that contacts, brakes and resistance take,
less the energy that the motors give.

A step advances all rigs of a campaign, or the one rig of a bench. What every axle has is a loop
over the axles of all rigs. What only some rigs have follows in a loop over the rigs.
"""

import math

import numpy as np

from rollerrig.rig import (
    brake,
    dynamic_brake,
    heat,
    motor,
    surface,
    track_brake,
    vehicle,
    wheelset,
)
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.compiled.record_type import table_of_one
from rollerrig.rig.compiled.state_type import rig_of
from rollerrig.rig.contact import adhesion
from rollerrig.rig.mechanisms import applied, pads, wheel_flat
from rollerrig.rig.mechanisms.friction import dose_share, film_share
from rollerrig.rig.multibody import coach_state, on_rig
from rollerrig.rig.params import Params
from rollerrig.rig.state import SIZE, State, views


class Plant:
    """Parameters, state and memory of the valves' dead time: everything that one run carries."""

    def __init__(
        self, params: Params, initial_speed_m_s: float, seat: tuple[np.ndarray, int] | None = None
    ) -> None:
        """Return a plant that rolls at a speed.

        seat: a buffer of several rigs with the same number of axles, and the number of this one,
        counted from 0; None: a buffer of its own.
        """
        self.params = params
        if seat is None:
            memory_of_coach = 0 if params.coach is None else coach_state.SIZE
            seat = np.zeros(SIZE + memory_of_coach), 0
        self.buffer: np.ndarray = seat[0]
        self.number = seat[1]
        self.state: State = views(self.buffer, params.axles, self.number)
        for view in self.state:
            if view is not None:
                view[:] = 0.0
        self.delay = np.zeros((params.brake.dead_time_ticks + 1, params.axles))
        start(self.state, params, initial_speed_m_s)


@kernel
def start(state, params, initial_speed_m_s):
    """Set a rig that rolls at a speed in m/s, with released brakes and without sliding."""
    state.vehicle_speed[0] = initial_speed_m_s
    for j in range(state.axles):
        state.wheel_speed[j] = initial_speed_m_s / params.wheels.table[vehicle.RADIUS_M, j]
        if params.mode != 0:
            state.roller_speed[j] = initial_speed_m_s / params.drive.roller_radius_m
        state.observer[j] = (
            params.drive.observer_rad_s * params.drive.roller_inertia_kgm2 * state.roller_speed[j]
        )
    begin(state, params, params.coach)
    wheelset.begin(state, params)
    motor.begin(state, params)
    heat.begin(state, params.heat)
    brake.begin(state, params.brake)
    dynamic_brake.begin(state, params.dynamic)
    surface.begin(state, params)
    friction(state, params)
    observe(state, params)


@kernel
def begin(state, params, coach):
    """Set the multibody coach rolling; nothing for the planar vehicle, where `coach` is None."""
    if coach is not None:
        on_rig.start(state, coach)


@kernel
def friction(state, params):
    """Set the friction of the contaminant under each axle for this time and place.

    In this order: the programme, a command from the bus, mechanisms ([X1] of `mechanisms.table`),
    sand ([S2] of `surface`), roller film ([F1]) and the magnets ahead ([T4] of `track_brake`).
    """
    plan = params.friction
    if params.effects.on_friction or params.effects.on_torque:
        applied.remember(state, params.axle_position_m, params.tick_s)
    for j in range(state.axles):
        state.friction_degraded[j] = params.law.mu_cd
        state.friction_recovered[j] = params.law.mu_cr

        # the last change of the programme that has begun at this place or time
        place = state.position[0] - params.axle_position_m[j]
        for i in range(plan.start.size):
            here = place if plan.by_place[i] else state.time[0]
            if here >= plan.start[i] and (plan.axles[i] >> j) & 1:
                state.friction_degraded[j] = plan.mu_cd[i]
                state.friction_recovered[j] = plan.mu_cr[i]

        # a command replaces the programme
        commanded = state.friction_command[j]
        if commanded > 0.0:
            state.friction_degraded[j] = commanded
            state.friction_recovered[j] = max(params.law.mu_cr, commanded)

        if params.effects.on_friction:
            state.friction_degraded[j] *= applied.friction_factor(
                state, j, place, params.effects, False
            )
            state.friction_recovered[j] *= applied.friction_factor(
                state, j, place, params.effects, True
            )
        if params.sanders.axles != 0:
            share = dose_share(state.sand_dose[j], params.sanders.dose_scale_kg_m)
            raise_friction(state, j, params.sanders.gain * share, params)
        if params.film.acts:
            raise_friction(state, j, params.film.gain * film_share(state.film[j]), params)
        if params.track_brake.acts:
            raise_friction(state, j, track_brake.cleaning(state, j, params.track_brake), params)


@kernel
def raise_friction(state, axle, log_factor, params):
    """Multiply the degraded friction of an axle by exp(log_factor).

    The result is at most the value at which degraded and recovered static friction are equal.
    """
    most = state.friction_recovered[axle] * params.law.A_d / params.law.A_r
    mu = state.friction_degraded[axle]
    state.friction_degraded[axle] = max(mu, min(mu * math.exp(log_factor), most))


@kernel
def advance(state, delay, magnets, demand_Pa, tick, params):
    """Advance the rig by a tick.

    Parameters
    ----------
    state : `State`
    delay : (dead time in ticks + 1, axles), memory of the magnets; kept from tick to tick
    magnets : (axles,) or more, pattern of each axle
    demand_Pa : demanded pressure, NaN for the one of the programme
    tick : number of the tick
    params : `Params`
    """
    prepare(state, delay, magnets, demand_Pa, tick, params)
    for _ in range(params.substeps):
        step(state, table_of_one(params))
    finish(state, tick, params)


@kernel
def finish(state, tick, params):
    """Do what follows the steps of a tick: time, air, heat, wear, sand and films of a rig."""
    state.time[0] = (tick * params.substeps + params.substeps) * params.step_s
    brake.count_air(state)
    heat.advance(state, params.heat)
    if params.flats.wear_m3_J > 0.0:
        wear(state, params)
    if params.sanders.axles != 0:
        surface.advance_sand(state, params.sanders, params.axle_position_m, params.tick_s)
    if params.film.acts:
        surface.advance_films(state, params.film, params.tick_s)


@kernel
def wear(state, params):
    """Let the sliding of locked wheels in this tick grind their flats."""
    for j in range(state.axles):
        work_J = state.sliding_work[j] - state.sliding_work_before[j]
        state.sliding_work_before[j] = state.sliding_work[j]
        if state.wheel_speed[j] > 0.0:
            state.lock_work[j] = 0.0
            continue

        state.lock_work[j] += 0.5 * max(work_J, 0.0)  # of one of two wheels
        length_m = wheel_flat.length_m(
            state.lock_work[j],
            params.flats.wear_m3_J,
            params.flats.width_m,
            params.wheels.table[vehicle.RADIUS_M, j],
        )
        # only the longest flat of an axle is kept
        if length_m > state.flat_length[j]:
            state.flat_length[j] = length_m
            state.flat_angle[j] = state.wheel_angle[j]


@kernel
def prepare(state, delay, magnets, demand_Pa, tick, params):
    """Set valves, friction and demands of a rig, which stay constant for a tick.

    Arguments as for `advance`.
    """
    # `delay` is a ring: the row after the one just written is the oldest
    for j in range(state.axles):
        delay[tick % delay.shape[0], j] = magnets[j]
    brake.switch_valves(state, delay[(tick + 1) % delay.shape[0]])
    friction(state, params)
    target_Pa = demand_Pa
    if np.isnan(demand_Pa):
        target_Pa = brake.target(params.demand, state.time[0])
    state.brake_target[0] = target_Pa * params.brake.weighed_share
    dynamic_brake.prepare(state, params.dynamic)
    track_brake.advance(state, target_Pa, params, params.track_brake)


@kernel
def step(state, plants):
    """Advance all rigs by one step of the physics.

    Parameters
    ----------
    state : `State` of all rigs
    plants : table of their `Params`, which have the same number of axles
    """
    if brake_and_drive(state, plants) == 0:
        return
    integrate(state, plants, plants[0].coach)
    for rig in range(len(plants)):
        mine = rig_of(state, rig, plants[rig].axles)
        vehicle.settle(mine)
        dynamic_brake.settle(mine)


@kernel
def brake_and_drive(state, plants):
    """Set the torques of a step of brakes and motors; return how many vehicles move.

    Arguments as for `step`.
    """
    moving = 0
    for rig in range(len(plants)):
        mine = rig_of(state, rig, plants[rig].axles)
        moves = mine.standing[0] == 0.0
        moving += moves
        for j in range(mine.axles):
            mine.stage_step[j] = plants[rig].step_s if moves else 0.0

    brake.fill(state, plants)
    for rig in range(len(plants)):
        params = plants[rig]
        mine = rig_of(state, rig, params.axles)
        if params.pads.vary:
            clamp(mine, params)
        if mine.standing[0] != 0.0:
            swing_out(mine, params, params.coach)
    if moving == 0:
        return 0

    motor.respond(state)
    brake.set_capacities(state)
    for rig in range(len(plants)):
        params = plants[rig]
        mine = rig_of(state, rig, params.axles)
        if params.dynamic.acts and mine.standing[0] == 0.0:
            dynamic_brake.advance(mine, params)
        if params.pads.vary or params.effects.on_torque:
            # the most that the discs can hold at the step's end; `observe` writes what acts
            for j in range(params.axles):
                mine.brake_torque[j] = capacity(mine, j, params)
    return moving


@kernel
def clamp(state, params):
    """Let the pads of each axle be clamped by the pressure of its cylinder, with hysteresis."""
    for j in range(state.axles):
        state.clamp_pressure[j] = pads.clamped(
            state.clamp_pressure[j], state.cylinder_pressure[j], params.pads.clamp_hysteresis
        )


@kernel
def capacity(state, axle, params):
    """Return the torque in N m that the discs of an axle can hold now."""
    if params.pads.vary:
        pressure_Pa = state.clamp_pressure[axle]
        rim_m_s = params.wheels.table[vehicle.RADIUS_M, axle] * state.wheel_speed[axle]
        share = pads.friction_share(rim_m_s, pressure_Pa, state.disc_temperature[axle], params.pads)
    else:
        pressure_Pa = state.cylinder_pressure[axle]
        share = 1.0
    torque_Nm = share * brake.torque_at(
        pressure_Pa, state.torque_per_pressure[axle], state.spring_pressure[axle]
    )
    if params.effects.on_torque:
        place_m = state.position[0] - params.axle_position_m[axle]
        torque_Nm = applied.torque(torque_Nm, state, axle, place_m, params.effects)
    return torque_Nm


@kernel
def integrate(state, plants, coach):
    """Advance the vehicles, planar or multibody, with their wheelsets and rollers by one step."""
    if coach is None:
        wheelset.integrate(state, plants)
    else:
        # a rig with a coach is computed alone
        params = plants[0]
        resistance_N = vehicle.resistance(state.vehicle_speed[0], params.vehicle)
        on_rig.integrate(state, params, resistance_N, coach)


@kernel
def swing_out(state, params, coach):
    """Let body and bogies of a standing vehicle come to rest."""
    vehicle.pitch_back(state, params.vehicle, params.step_s)
    if coach is not None:
        on_rig.rest(state, coach)


@kernel
def observe(state, params):
    """Write the observed quantities of this state: contact, torques, loads, sensors, locks."""
    for j in range(state.axles):
        r = params.wheels.table[vehicle.RADIUS_M, j]
        planar_N = vehicle.load(j, state.felt_acceleration[0], params.vehicle)
        planar_N = wheelset.uneven_load(planar_N, j, state.wheel_angle[j], state, params)
        load_N = on_rig.load(j, planar_N, state, params.coach)

        # contact
        surface_m_s = state.vehicle_speed[0]
        if params.mode != 0:
            surface_m_s = params.drive.roller_radius_m * state.roller_speed[j]
        sliding = surface_m_s - r * state.wheel_speed[j]
        f, f_d, f_r, transition, energy, _ = wheelset.wheelset_adhesion(
            on_rig.slip(j, sliding, state, params.coach),
            surface_m_s,
            load_N,
            state.friction_degraded[j],
            state.friction_recovered[j],
            params.patch,
            params.law,
        )
        if params.effects.memory_m > 0.0:
            # with memory the contact has recovered by the remembered lambda [A7 of `adhesion`]
            instantaneous = f
            transition = state.lagged_transition[j]
            f = math.copysign(adhesion.between(f_d, f_r, transition), f)
            energy *= f / instantaneous if instantaneous != 0.0 else 0.0
        f = on_rig.adhesion(j, f, load_N, state, params.coach)
        state.sliding[j] = sliding
        state.creepage[j] = 0.0 if surface_m_s <= 0.0 else sliding / surface_m_s
        state.adhesion[j] = f
        state.adhesion_degraded[j] = f_d
        state.adhesion_recovered[j] = f_r
        state.transition[j] = transition
        state.dissipated_energy[j] = energy
        state.wheel_load[j] = load_N

        # a locked wheel takes no more torque than its contact gives
        torque = capacity(state, j, params)
        if state.wheel_speed[j] <= 0.0:
            driven_Nm = r * f * load_N - state.dynamic_torque[j]
            torque = min(torque, max(0.0, driven_Nm))
        state.brake_torque[j] = torque

        # speed sensor
        teeth_per_rad = params.teeth / (2.0 * np.pi)
        state.tooth_frequency[j] = state.wheel_speed[j] * teeth_per_rad
        state.pulse_count[j] = np.floor(state.wheel_angle[j] * teeth_per_rad)
        watch_lock(state, j, params)
    track_brake.observe(state, params.track_brake)


@kernel
def watch_lock(state, axle, params):
    """Count how long a wheelset has been locked while the vehicle still runs.

    A tick that nobody observes needs only this of `observe`.
    """
    radius_m = params.wheels.table[vehicle.RADIUS_M, axle]
    state.wheel_circumferential_speed[axle] = radius_m * state.wheel_speed[axle]
    state.locked_since[axle], state.longest_lock[axle] = wheelset.lock_s(
        state.locked_since[axle],
        state.longest_lock[axle],
        state.wheel_circumferential_speed[axle],
        state.vehicle_speed[0],
        params.lock_above_m_s,
        params.tick_s,
    )
