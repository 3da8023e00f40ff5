"""Magnetic track brake: electromagnets between the wheelsets of a bogie, attracted by the rail.

The magnets of a bogie are lowered onto the rail when the brake is demanded, and raised after it
[T1]. On the rail their attraction builds up with a lag [T2]. Their pole shoes rub on the rail with
a friction that falls with the speed and is lower on a contaminated rail [T3]. The force acts on the
vehicle, not through the wheels: it needs no adhesion. It also rubs the contaminant off the rail, so
the wheels behind the magnets find more friction [T4].

    [T1] dh/dt = 1 / T_drop while demanded, -1 / T_rise otherwise; h from 0 (raised) to 1 (lowered)
    [T2] da/dt = (1 - a) / T_a at h = 1 while demanded, -a / T_a otherwise
    [T3] F = a N_m mu(v) (mu_cd / mu_cr)^n, mu(v) = mu_high + (mu_low - mu_high) exp(-v / v_0)
    [T4] ln mu_cd += gain (1 - exp(-E / E_0)), E: work of all magnets before on this metre, in J/m

Source: [T3] the friction of pole shoes falls with the speed, as in the brake calculations of
EN 14531 (recollection); its form, [T4] and every default are assumptions, not measurements. A
contact is cleaned no further than its clean limit. The work reaches the next wheel after the
distance between them as a first-order lag of that length, as in `mechanisms.applied.remember`.

The demand comes from the bus, or from a demanded brake pressure of an emergency. Below the cut-off
speed the magnets are switched off. All quantities are per axle: an axle has half of its bogie's.
"""

import math

from rollerrig.configs.vehicle import AXLES_OF_BOGIE
from rollerrig.rig.compiled.kernel import kernel


@kernel
def advance(state, target_Pa, params, brake):
    """Advance the magnets by a tick; nothing without a magnetic track brake.

    `target_Pa` is the demanded brake pressure, before it is weighed.
    """
    if brake.acts:
        lower(state, target_Pa, brake)
        press(state, brake)
        clean(state, params, brake)


@kernel
def lower(state, target_Pa, brake):
    """Lower or raise the magnets, and let their attraction follow [T1], [T2]."""
    fast = state.vehicle_speed[0] > brake.cut_below_m_s
    emergency = target_Pa >= brake.emergency_Pa
    for j in range(state.axles):
        demanded = emergency or state.track_brake_command[j] != 0.0
        works = brake.fitted[j] and state.track_brake_failed[j] == 0.0
        acts = demanded and works and fast and state.standing[0] == 0.0
        state.track_brake_demand[j] = 1.0 if demanded else 0.0
        change = brake.drop_change if acts else -brake.rise_change
        state.track_brake_lowered[j] = min(max(state.track_brake_lowered[j] + change, 0.0), 1.0)
        attracted = 1.0 if acts and state.track_brake_lowered[j] >= 1.0 else 0.0
        state.track_brake_attraction[j] += brake.lag_share * (
            attracted - state.track_brake_attraction[j]
        )


@kernel
def press(state, brake):
    """Set the force of each axle's magnets over mu(v) [T3]."""
    for j in range(state.axles):
        # the rail as the leading axle of the bogie has met it
        first = j - j % AXLES_OF_BOGIE
        contamination = state.friction_degraded[first] / state.friction_recovered[first]
        share = math.pow(contamination, brake.contamination_power) if contamination < 1.0 else 1.0
        state.track_brake_pressure[j] = state.track_brake_attraction[j] * brake.attraction_N * share


@kernel
def clean(state, params, brake):
    """Advance the work of the magnets that the rail under each axle has met [T4]."""
    speed_m_s = state.vehicle_speed[0]
    friction = shoe_friction(speed_m_s, brake)
    work_J_m = 0.0
    for j in range(state.axles):
        if j > 0:
            length_m = params.axle_position_m[j] - params.axle_position_m[j - 1]
            share = -math.expm1(-speed_m_s * params.tick_s / length_m)
            state.track_brake_cleaning[j] += (work_J_m - state.track_brake_cleaning[j]) * share
        # the magnets of a bogie lie behind its first axle: its other axle meets their whole work
        if j % AXLES_OF_BOGIE == 0:
            for i in range(j, j + AXLES_OF_BOGIE):
                work_J_m += state.track_brake_pressure[i] * friction


@kernel
def shoe_friction(speed_m_s, brake):
    """Return the friction mu(v) of the pole shoes [T3]; 0 for a vehicle that stands."""
    if speed_m_s <= 0.0:
        return 0.0
    return brake.friction_high + (brake.friction_low - brake.friction_high) * math.exp(
        -speed_m_s / brake.friction_scale_m_s
    )


@kernel
def force_N(state, speed_m_s, brake):
    """Return the force in N of all magnets at a speed; 0 without a magnetic track brake."""
    pressed_N = 0.0
    if not brake.acts:
        return pressed_N
    for j in range(state.axles):
        pressed_N += state.track_brake_pressure[j]
    return pressed_N * shoe_friction(speed_m_s, brake) if pressed_N > 0.0 else 0.0


@kernel
def cleaning(state, axle, brake):
    """Return the change of ln mu_cd under an axle [T4]."""
    work_J_m = state.track_brake_cleaning[axle]
    return -brake.cleaning_gain * math.expm1(-work_J_m / brake.cleaning_scale_J_m)


@kernel
def observe(state, brake):
    """Write the force of each axle's magnets at the speed of the vehicle."""
    if not brake.acts:
        return
    friction = shoe_friction(state.vehicle_speed[0], brake)
    for j in range(state.axles):
        state.track_brake_force[j] = state.track_brake_pressure[j] * friction
