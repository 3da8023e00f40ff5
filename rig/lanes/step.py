"""One step of the physics for the rigs that stand abreast: air, motors, contacts, motion.

The order is that of `plant.step` and `wheelset.integrate`. What concerns an axle is a loop over all
lanes; what concerns a vehicle, the sum of its contact forces, is a loop over rigs. A vehicle that
stands keeps its lanes as they are, but for its air and its pitch.
"""

import math

from rollerrig.rig import vehicle as body
from rollerrig.rig import wheelset
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact import vector_law as law
from rollerrig.rig.contact.patch import Patch
from rollerrig.rig.lanes import layout as a
from rollerrig.rig.lanes.layout import LANES, RIGS
from rollerrig.rig.state import AXLES, FILL, VENT

_GAMMA = 1.0 - 1.0 / math.sqrt(2.0)


@kernel
def step(w, rigs):
    """Advance all lanes by one step; `rigs` are the four vehicles' parameters."""
    pneumatics_and_motors(w)
    contacts(w)
    contacts_outside_domain(w)
    begin(w)
    predict(w, rigs)
    contacts(w)
    contacts_outside_domain(w)
    finish(w)
    move(w, rigs)


@kernel
def pneumatics_and_motors(w):
    """Demand, cylinders, motors and what the discs can hold [B1] to [B4], [M1]."""
    for j in range(LANES):
        # the first stage looks at the beginning of the step
        w[a.V_END + j], w[a.FELT_END + j] = w[a.V + j], w[a.FELT + j]
        w[a.WHEEL_END + j], w[a.ROLLER_END + j] = w[a.WHEEL + j], w[a.ROLLER + j]
        moving = w[a.MOVING + j] > 0.0
        before, target = w[a.DEMAND + j], w[a.TARGET + j]
        share = w[a.FILLS + j] if target > before else w[a.RELEASES + j]
        w[a.DEMAND + j] = before + (target - before) * share
        p, valve = w[a.PRESSURE + j], w[a.VALVE + j]
        gain = (before + 0.5 * (target - before) * share - p) * w[a.VALVE_FILLS + j]
        gain = gain if valve == FILL else (-p * w[a.VALVE_VENTS + j] if valve == VENT else 0.0)
        w[a.PRESSURE + j] = p + gain
        w[a.AIR_NL + j] += max(gain, 0.0) * w[a.NL_PER_PA + j]
        speed = w[a.ROLLER + j]
        most = min(w[a.MOTOR_MOST + j], w[a.MOTOR_W + j] / max(abs(speed), 1e-3))
        wanted = min(max(w[a.MOTOR_ASKED + j], -most), most)
        too_fast = (wanted * speed > 0.0) & (abs(speed) > w[a.MOTOR_FASTEST + j])
        wanted = 0.0 if too_fast else wanted
        motor = w[a.MOTOR + j]
        driven = moving & (w[a.ON_TRACK + j] == 0.0)
        w[a.MOTOR + j] = motor + (wanted - motor) * w[a.MOTOR_SHARE + j] if driven else motor
        holds = max(0.0, w[a.TORQUE_PER_PA + j] * (w[a.PRESSURE + j] - w[a.SPRING_PA + j]))
        w[a.BRAKE + j] = holds if moving else w[a.BRAKE + j]


@kernel
def contacts(w):
    """Sliding, load and secant slope T / s of every contact, where the rows ..._END say."""
    for j in range(LANES):
        v = w[a.V_END + j]
        surface = v if w[a.ON_TRACK + j] != 0.0 else w[a.ROLLER_M + j] * w[a.ROLLER_END + j]
        sliding = surface - w[a.WHEEL_M + j] * w[a.WHEEL_END + j]
        load = max(0.0, w[a.STATIC_N + j] - w[a.FELT_END + j] * w[a.TRANSFER_KG + j])
        w[a.SLIDING + j], w[a.SURFACE + j], w[a.LOAD + j] = sliding, surface, load
        at, half = max(abs(sliding), wheelset.SMALL_M_S), 0.5 * load
        eps_mu = law.eps_mu(at, surface, half, w[a.EPS1 + j])
        here = a.law_of_lane(w, j)
        f_d = law.curve(at, eps_mu, here.mu_cd, here.A_d, here.gamma_d_s_m, here.k_ad, here.k_sd)
        f_r = law.curve(at, eps_mu, here.mu_cr, here.A_r, here.gamma_r_s_m, here.k_ar, here.k_sr)
        share, _ = adhesion.cleaning_share(at, surface, here.cleaning_creepage)
        creepage = at / max(abs(surface), law.SPEED_FLOOR_M_S)
        f, _, inside = law.recovered(f_d, f_r, here.tau_m_J * half * creepage * share)
        w[a.SLOPE + j] = f * load / at
        u = half * (1.0 / law.LOAD_N)
        w[a.INSIDE + j] = inside if (u > law.LIGHTER) & (u < law.HEAVIER) else 0.0


@kernel
def contacts_outside_domain(w):
    """Ask the law itself for the few contacts that lie outside the fast one's domain."""
    for j in range(LANES):
        if w[a.INSIDE + j] == 0.0 and w[a.MOVING + j] > 0.0:
            w[a.SLOPE + j] = exact_slope(w, j)


@kernel
def exact_slope(w, j):
    """The secant slope of lane j by `wheelset.contact_force`, whatever the contact."""
    here = a.law_of_lane(w, j)
    patch = Patch(0.0, 0.0, 0.0, 0.0, 0.0, w[a.EPS1 + j], 0.0, 0.0, 0.0, 0, 0, 0.0)
    at = max(abs(w[a.SLIDING + j]), wheelset.SMALL_M_S)
    T, _, _ = wheelset.contact_force(
        at,
        w[a.SURFACE + j],
        w[a.LOAD + j],
        here.mu_cd,
        here.mu_cr,
        patch,
        here,
        adhesion.NO_MEMORY,
        0.0,
    )
    return T / at


@kernel_inlined
def stage(w, j, wheel, brake_Nm, motor_Nm, wheel_before, roller_before):
    """A stage in lane j: (wheel_k, roller_k, pull_N, brake_Nm) [W1] to [W4]; `.._before` is taken off undamped."""
    r, R = w[a.WHEEL_M + j], w[a.ROLLER_M + j]
    slope, track = w[a.SLOPE + j], w[a.ON_TRACK + j] != 0.0
    T, g = slope * w[a.SLIDING + j], max(slope, 0.0)
    drive_Nm = r * T
    locked = (wheel <= 0.0) & (drive_Nm <= brake_Nm)
    acts_Nm = max(drive_Nm, 0.0) if locked else brake_Nm
    wheel_k = 0.0 if locked else (drive_Nm - brake_Nm) / w[a.WHEEL_KGM2 + j]
    roller_k = 0.0 if track else (motor_Nm - R * T) / w[a.ROLLER_KGM2 + j]
    wheel_k -= wheel_before
    roller_k -= roller_before
    p_wheel = 0.0 if locked else r / w[a.WHEEL_KGM2 + j]
    p_roller = 0.0 if track else -R / w[a.ROLLER_KGM2 + j]
    reach = _GAMMA * w[a.STEP + j]
    share = (
        reach
        * (g * (R * roller_k - r * wheel_k))
        / (1.0 + reach * g * (r * p_wheel - R * p_roller))
    )
    return wheel_k + p_wheel * share, roller_k + p_roller * share, T + share, acts_Nm


@kernel
def begin(w):
    """First stage: slopes at the beginning of the step, and what they predict for its end."""
    for j in range(LANES):
        wheel = w[a.WHEEL + j]
        wheel_k, roller_k, pull_N, brake_Nm = stage(
            w, j, wheel, w[a.CAPACITY + j], w[a.MOTOR_BEFORE + j], 0.0, 0.0
        )
        w[a.WHEEL_K + j], w[a.ROLLER_K + j], w[a.PULL + j] = wheel_k, roller_k, pull_N
        w[a.PULL_BEFORE + j], w[a.BRAKE_BEFORE + j] = pull_N, brake_Nm
        w[a.WHEEL_END + j] = max(0.0, wheel + w[a.STEP + j] * wheel_k)
        w[a.ROLLER_END + j] = w[a.ROLLER + j] + w[a.STEP + j] * roller_k


@kernel
def total(w, first, resistance_N):
    """All that holds a vehicle back in N; `first` is its first lane."""
    for j in range(first, first + AXLES):
        resistance_N += w[a.PULL + j]
    return resistance_N


@kernel
def predict(w, rigs):
    """Speed and felt acceleration of every vehicle at the end of the step, as the first stage has it."""
    for rig in range(RIGS):
        at, vehicle = rig * AXLES, rigs[rig]
        h, v, felt = w[a.STEP + at], w[a.V + at], w[a.FELT + at]
        resistance_N = body.resistance(v, vehicle)
        rate = -total(w, at, resistance_N) / vehicle.mass_kg
        felt_rate = (rate - felt) / vehicle.pitch_time_constant_s
        for j in range(at, at + AXLES):
            w[a.V_END + j], w[a.FELT_END + j] = v + h * rate, felt + h * felt_rate
            w[a.RATE_BEFORE + j], w[a.FELT_RATE + j] = rate, felt_rate
            w[a.RESISTING + j] = 0.5 * resistance_N


@kernel
def finish(w):
    """Second stage, and the motion of wheels and rollers that both stages make."""
    for j in range(LANES):
        moving, h = w[a.MOVING + j] > 0.0, w[a.STEP + j]
        wheel1, roller1, motor_Nm = w[a.WHEEL_K + j], w[a.ROLLER_K + j], w[a.MOTOR + j]
        wheel_k, roller_k, pull_N, brake_Nm = stage(
            w, j, w[a.WHEEL_END + j], w[a.BRAKE + j], motor_Nm, 2.0 * wheel1, 2.0 * roller1
        )
        w[a.PULL + j] = pull_N
        force_N = 0.5 * w[a.PULL_BEFORE + j] + 0.5 * pull_N
        mean_Nm = 0.5 * w[a.BRAKE_BEFORE + j] + 0.5 * brake_Nm
        wheel, roller = w[a.WHEEL + j], w[a.ROLLER + j]
        wheel_end = max(0.0, wheel + h * (1.5 * wheel1 + 0.5 * wheel_k))
        roller_end = roller + h * (1.5 * roller1 + 0.5 * roller_k)
        wheel_rad, roller_rad = 0.5 * h * (wheel + wheel_end), 0.5 * h * (roller + roller_end)
        slid_m = w[a.ROLLER_M + j] * roller_rad - w[a.WHEEL_M + j] * wheel_rad
        w[a.WHEEL + j] = wheel_end if moving else wheel
        w[a.ROLLER + j] = roller_end if moving else roller
        w[a.WHEEL_RAD + j] += wheel_rad if moving else 0.0
        w[a.ROLLER_RAD + j] += roller_rad if moving else 0.0
        w[a.SLIDING_WORK + j] += force_N * slid_m if moving else 0.0
        w[a.BRAKE_WORK + j] += mean_Nm * wheel_rad if moving else 0.0
        w[a.MOTOR_WORK + j] += (
            0.5 * (w[a.MOTOR_BEFORE + j] + motor_Nm) * roller_rad if moving else 0.0
        )
        w[a.FORCE + j] = force_N if moving else w[a.FORCE + j]
        w[a.BRAKE_MEAN + j] = mean_Nm if moving else w[a.BRAKE_MEAN + j]
        w[a.CAPACITY + j] = w[a.BRAKE + j] if moving else w[a.CAPACITY + j]
        w[a.MOTOR_BEFORE + j] = motor_Nm if moving else w[a.MOTOR_BEFORE + j]


@kernel
def move(w, rigs):
    """Move every vehicle, and bring to rest those that hardly move."""
    for rig in range(RIGS):
        at, vehicle = rig * AXLES, rigs[rig]
        h, v, felt = w[a.STEP + at], w[a.V + at], w[a.FELT + at]
        if w[a.MOVING + at] == 0.0:
            broadcast(w, a.FELT, at, felt * math.exp(-h / vehicle.pitch_time_constant_s))
            continue
        v2, felt2 = w[a.V_END + at], w[a.FELT_END + at]
        resistance_N = body.resistance(v2, vehicle)
        rate = -total(w, at, resistance_N) / vehicle.mass_kg
        felt_rate = (rate - felt2) / vehicle.pitch_time_constant_s
        mean = 0.5 * (w[a.RATE_BEFORE + at] + rate)
        end = max(0.0, v + h * mean)
        way_m = 0.5 * h * (v + end)
        broadcast(w, a.FELT, at, felt + 0.5 * h * (w[a.FELT_RATE + at] + felt_rate))
        broadcast(w, a.PLACE, at, w[a.PLACE + at] + way_m)
        resisting_N = w[a.RESISTING + at] + 0.5 * resistance_N
        broadcast(w, a.RESISTANCE_WORK, at, w[a.RESISTANCE_WORK + at] + resisting_N * way_m)
        broadcast(w, a.V, at, end)
        broadcast(w, a.RATE, at, mean)
        for j in range(at, at + AXLES):
            w[a.SLIDING_WORK + j] += w[a.ON_TRACK + j] * w[a.FORCE + j] * way_m
        if end < body.STANDING_M_S:
            settle(w, at)


@kernel
def broadcast(w, row, first, value):
    """Write a vehicle's value into its four lanes."""
    for j in range(first, first + AXLES):
        w[row + j] = value


@kernel
def settle(w, first):
    """Bring a vehicle to rest, with its wheels and rollers."""
    for row in (a.V, a.RATE, a.WHEEL, a.ROLLER, a.MOTOR, a.BRAKE, a.MOVING):
        broadcast(w, row, first, 0.0)
