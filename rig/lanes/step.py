"""One step of the physics for the rigs in the lanes: air, motors, contacts, motion.

The order is that of `plant.step` and `wheelset.integrate`. Loops over all lanes compute the
quantities of the axles. Loops over the rigs compute those of the vehicles, which need the sum of
the contact forces. For a vehicle at standstill only the air and the pitch change; all other
quantities remain as they are.

A branch in a loop over the lanes would prevent vector instructions. Therefore these loops compute
both results and choose between them with a conditional expression.
"""

import math

from rollerrig.rig import vehicle as planar_vehicle
from rollerrig.rig import wheelset
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact import vector_secant as law
from rollerrig.rig.contact.patch import Patch
from rollerrig.rig.lanes import layout as row
from rollerrig.rig.state import FILL, VENT

_GAMMA = 1.0 - 1.0 / math.sqrt(2.0)  # of the implicit step, as in `wheelset`
# Torque at full power is power over speed. Below this speed the torque no longer grows.
_LEAST_RAD_S = 1e-3


@kernel
def step(w, rigs, axles):
    """Advance `rigs` rigs, each with so many axles, by one step."""
    lanes = rigs * axles
    pneumatics_and_motors(w, lanes)
    contacts(w, lanes)
    contacts_outside_domain(w, lanes)
    begin(w, lanes)
    predict(w, rigs, axles)
    contacts(w, lanes)
    contacts_outside_domain(w, lanes)
    finish(w, lanes)
    move(w, rigs, axles)


@kernel
def pneumatics_and_motors(w, lanes):
    """Compute brake demand, cylinders, motors and brake torques [B1] to [B4], [M1]."""
    for j in range(lanes):
        # the first stage computes the contacts with the values at the beginning of the step
        w[row.V_END + j] = w[row.V + j]
        w[row.FELT_END + j] = w[row.FELT + j]
        w[row.WHEEL_END + j] = w[row.WHEEL + j]
        w[row.ROLLER_END + j] = w[row.ROLLER + j]
        moving = w[row.MOVING + j] > 0.0

        # the brake demand, and the pressure of the cylinder
        before = w[row.DEMAND + j]
        target = w[row.TARGET + j]
        share = w[row.FILLS + j] if target > before else w[row.RELEASES + j]
        w[row.DEMAND + j] = before + (target - before) * share
        pressure = w[row.PRESSURE + j]
        valve = w[row.VALVE + j]
        filled = (before + 0.5 * (target - before) * share - pressure) * w[row.VALVE_FILLS + j]
        vented = -pressure * w[row.VALVE_VENTS + j] if valve == VENT else 0.0
        gain = filled if valve == FILL else vented
        w[row.PRESSURE + j] = pressure + gain
        w[row.AIR_NL + j] += max(gain, 0.0) * w[row.NL_PER_PA + j]

        # the torque of the roller's motor, within its limits
        speed = w[row.ROLLER + j]
        most = min(w[row.MOTOR_MOST + j], w[row.MOTOR_W + j] / max(abs(speed), _LEAST_RAD_S))
        limited = min(max(w[row.MOTOR_DEMAND + j], -most), most)
        too_fast = (limited * speed > 0.0) & (abs(speed) > w[row.MOTOR_FASTEST + j])
        limited = 0.0 if too_fast else limited
        motor = w[row.MOTOR + j]
        driven = moving & (w[row.ON_TRACK + j] == 0.0)
        w[row.MOTOR + j] = motor + (limited - motor) * w[row.MOTOR_SHARE + j] if driven else motor

        # the largest torque of the brake
        capacity = max(0.0, w[row.TORQUE_PER_PA + j] * (w[row.PRESSURE + j] - w[row.SPRING_PA + j]))
        w[row.BRAKE + j] = capacity if moving else w[row.BRAKE + j]


@kernel
def contacts(w, lanes):
    """Compute sliding, load and secant slope T / s of each contact, from the rows ..._END."""
    for j in range(lanes):
        v = w[row.V_END + j]
        roller = w[row.ROLLER_M + j] * w[row.ROLLER_END + j]
        surface = v if w[row.ON_TRACK + j] != 0.0 else roller
        sliding = surface - w[row.WHEEL_M + j] * w[row.WHEEL_END + j]
        load = max(0.0, w[row.STATIC_N + j] - w[row.FELT_END + j] * w[row.TRANSFER_KG + j])
        w[row.SLIDING + j] = sliding
        w[row.SURFACE + j] = surface
        w[row.LOAD + j] = load

        # adhesion of one wheel [A1] to [A6], by the law of this lane
        size = max(abs(sliding), wheelset.SMALL_M_S)
        wheel_N = 0.5 * load
        solved = w[row.SOLVED + j]
        change = w[row.CHANGE_BEFORE + j]
        slope_1_m_s, cleaning, y, inside = law.secant_adhesion(
            size,
            surface,
            wheel_N,
            w[row.EPS1 + j],
            w[row.DECAY_D + j],
            w[row.DECAY_R + j],
            row.law_of_lane(w, j),
            solved + change,
        )
        w[row.SLOPE + j] = slope_1_m_s * load
        w[row.CLEANING + j] = cleaning
        w[row.INSIDE + j] = inside

        # The two stages of a step alternate. The change from one to the other differs little from
        # that in the step before, so the solution after the next one begins with this change.
        w[row.CHANGE_BEFORE + j] = w[row.CHANGE + j]
        w[row.CHANGE + j] = y - solved if inside != 0.0 else 0.0
        w[row.SOLVED + j] = y if inside != 0.0 else solved


@kernel
def contacts_outside_domain(w, lanes):
    """Compute the few contacts outside the domain of `vector_law` by the law itself."""
    for j in range(lanes):
        if w[row.INSIDE + j] == 0.0 and w[row.MOVING + j] > 0.0:
            slope = exact_slope(w, j)
            w[row.SLOPE + j] = slope
            # the next solution begins with this one
            size = max(abs(w[row.SLIDING + j]), wheelset.SMALL_M_S)
            loaded = w[row.LOAD + j] > 0.0
            f = slope * size / w[row.LOAD + j] if loaded else 0.0
            w[row.SOLVED + j] = w[row.CLEANING + j] * f


@kernel
def exact_slope(w, j):
    """Return the secant slope of lane j by `wheelset.contact_force`, for any contact."""
    here = row.law_of_lane(w, j)
    # the law of one wheel needs only eps1 of the patch
    patch = Patch(0.0, 0.0, 0.0, 0.0, 0.0, w[row.EPS1 + j], 0.0, 0.0, 0.0, None, 0, 0.0)
    size = max(abs(w[row.SLIDING + j]), wheelset.SMALL_M_S)
    T, _, _ = wheelset.contact_force(
        size,
        w[row.SURFACE + j],
        w[row.LOAD + j],
        here.mu_cd,
        here.mu_cr,
        patch,
        here,
        adhesion.NO_MEMORY,
        0.0,
    )
    return T / size


@kernel_inlined
def stage(w, j, wheel, brake_Nm, motor_Nm, wheel_before, roller_before):
    """Return (wheel_k, roller_k, pull_N, brake_Nm) of a stage in lane j [W1] to [W4].

    wheel_k and roller_k are the slopes of the speeds in rad/s2, pull_N is the contact force,
    brake_Nm the torque of the brake that acts. `wheel_before` and `roller_before` are subtracted
    from the slopes before the implicit part is added.
    """
    r = w[row.WHEEL_M + j]
    R = w[row.ROLLER_M + j]
    slope = w[row.SLOPE + j]
    track = w[row.ON_TRACK + j] != 0.0

    # explicit part
    T = slope * w[row.SLIDING + j]
    drive_Nm = r * T
    locked = (wheel <= 0.0) & (drive_Nm <= brake_Nm)
    acts_Nm = max(drive_Nm, 0.0) if locked else brake_Nm
    wheel_k = 0.0 if locked else (drive_Nm - brake_Nm) * w[row.PER_WHEEL_KGM2 + j]
    roller_k = 0.0 if track else (motor_Nm - R * T) * w[row.PER_ROLLER_KGM2 + j]
    wheel_k -= wheel_before
    roller_k -= roller_before

    # implicit part: the force that the change of sliding adds; p: effect of 1 N on wheel and roller
    g = max(slope, 0.0)
    p_wheel = 0.0 if locked else r * w[row.PER_WHEEL_KGM2 + j]
    p_roller = 0.0 if track else -R * w[row.PER_ROLLER_KGM2 + j]
    reach = _GAMMA * w[row.STEP + j]
    added_N = (
        reach
        * (g * (R * roller_k - r * wheel_k))
        / (1.0 + reach * g * (r * p_wheel - R * p_roller))
    )
    return wheel_k + p_wheel * added_N, roller_k + p_roller * added_N, T + added_N, acts_Nm


@kernel
def begin(w, lanes):
    """Compute the first stage: slopes at the start of the step, and the prediction for its end."""
    for j in range(lanes):
        wheel = w[row.WHEEL + j]
        wheel_k, roller_k, pull_N, brake_Nm = stage(
            w, j, wheel, w[row.CAPACITY + j], w[row.MOTOR_BEFORE + j], 0.0, 0.0
        )
        w[row.WHEEL_K + j] = wheel_k
        w[row.ROLLER_K + j] = roller_k
        w[row.PULL + j] = pull_N
        w[row.PULL_BEFORE + j] = pull_N
        w[row.BRAKE_BEFORE + j] = brake_Nm
        w[row.WHEEL_END + j] = max(0.0, wheel + w[row.STEP + j] * wheel_k)
        w[row.ROLLER_END + j] = w[row.ROLLER + j] + w[row.STEP + j] * roller_k


@kernel
def total(w, first, axles, resistance_N):
    """Return the force in N that holds a vehicle back; `first` is its first lane."""
    for j in range(first, first + axles):
        resistance_N += w[row.PULL + j]
    return resistance_N


@kernel
def predict(w, rigs, axles):
    """Predict speed and felt acceleration of each vehicle for the end of the step."""
    for rig in range(rigs):
        at = rig * axles
        h = w[row.STEP + at]
        v = w[row.V + at]
        felt = w[row.FELT + at]

        resistance_N = planar_vehicle.resistance(v, row.resisted(w, at))
        rate = -total(w, at, axles, resistance_N) / w[row.MASS_KG + at]
        felt_rate = (rate - felt) / w[row.PITCH_S + at]
        for j in range(at, at + axles):
            w[row.V_END + j] = v + h * rate
            w[row.FELT_END + j] = felt + h * felt_rate
            w[row.RATE_BEFORE + j] = rate
            w[row.FELT_RATE + j] = felt_rate
            w[row.RESISTING + j] = 0.5 * resistance_N


@kernel
def finish(w, lanes):
    """Compute the second stage, and the motion of wheels and rollers by both stages."""
    for j in range(lanes):
        moving = w[row.MOVING + j] > 0.0
        h = w[row.STEP + j]
        wheel1 = w[row.WHEEL_K + j]
        roller1 = w[row.ROLLER_K + j]
        motor_Nm = w[row.MOTOR + j]
        wheel_k, roller_k, pull_N, brake_Nm = stage(
            w, j, w[row.WHEEL_END + j], w[row.BRAKE + j], motor_Nm, 2.0 * wheel1, 2.0 * roller1
        )
        w[row.PULL + j] = pull_N
        force_N = 0.5 * w[row.PULL_BEFORE + j] + 0.5 * pull_N
        mean_Nm = 0.5 * w[row.BRAKE_BEFORE + j] + 0.5 * brake_Nm

        wheel = w[row.WHEEL + j]
        roller = w[row.ROLLER + j]
        wheel_end = max(0.0, wheel + h * (1.5 * wheel1 + 0.5 * wheel_k))
        roller_end = roller + h * (1.5 * roller1 + 0.5 * roller_k)
        wheel_rad = 0.5 * h * (wheel + wheel_end)
        roller_rad = 0.5 * h * (roller + roller_end)
        slid_m = w[row.ROLLER_M + j] * roller_rad - w[row.WHEEL_M + j] * wheel_rad
        motor_mean_Nm = 0.5 * (w[row.MOTOR_BEFORE + j] + motor_Nm)

        w[row.WHEEL + j] = wheel_end if moving else wheel
        w[row.ROLLER + j] = roller_end if moving else roller
        w[row.WHEEL_RAD + j] += wheel_rad if moving else 0.0
        w[row.ROLLER_RAD + j] += roller_rad if moving else 0.0
        w[row.SLIDING_WORK + j] += force_N * slid_m if moving else 0.0
        w[row.BRAKE_WORK + j] += mean_Nm * wheel_rad if moving else 0.0
        w[row.MOTOR_WORK + j] += motor_mean_Nm * roller_rad if moving else 0.0
        w[row.FORCE + j] = force_N if moving else w[row.FORCE + j]
        w[row.BRAKE_MEAN + j] = mean_Nm if moving else w[row.BRAKE_MEAN + j]
        w[row.CAPACITY + j] = w[row.BRAKE + j] if moving else w[row.CAPACITY + j]
        w[row.MOTOR_BEFORE + j] = motor_Nm if moving else w[row.MOTOR_BEFORE + j]


@kernel
def move(w, rigs, axles):
    """Move every vehicle, and bring to rest those that hardly move."""
    for rig in range(rigs):
        at = rig * axles
        h = w[row.STEP + at]
        v = w[row.V + at]
        felt = w[row.FELT + at]
        if w[row.MOVING + at] == 0.0:
            # the body pitches back
            broadcast(w, row.FELT, at, axles, felt * math.exp(-h / w[row.PITCH_S + at]))
            continue

        # the second stage of the vehicle, at the predicted values
        v2 = w[row.V_END + at]
        felt2 = w[row.FELT_END + at]
        resistance_N = planar_vehicle.resistance(v2, row.resisted(w, at))
        rate = -total(w, at, axles, resistance_N) / w[row.MASS_KG + at]
        felt_rate = (rate - felt2) / w[row.PITCH_S + at]

        # the mean of both stages moves it
        mean = 0.5 * (w[row.RATE_BEFORE + at] + rate)
        end = max(0.0, v + h * mean)
        way_m = 0.5 * h * (v + end)
        broadcast(w, row.FELT, at, axles, felt + 0.5 * h * (w[row.FELT_RATE + at] + felt_rate))
        broadcast(w, row.PLACE, at, axles, w[row.PLACE + at] + way_m)
        resisting_N = w[row.RESISTING + at] + 0.5 * resistance_N
        worked_J = w[row.RESISTANCE_WORK + at] + resisting_N * way_m
        broadcast(w, row.RESISTANCE_WORK, at, axles, worked_J)
        broadcast(w, row.V, at, axles, end)
        broadcast(w, row.RATE, at, axles, mean)

        # on a track the rail moves under the wheel with the vehicle
        for j in range(at, at + axles):
            w[row.SLIDING_WORK + j] += w[row.ON_TRACK + j] * w[row.FORCE + j] * way_m
        if end < planar_vehicle.STANDING_M_S:
            settle(w, at, axles)


@kernel
def broadcast(w, first_of_row, first_lane, axles, value):
    """Write a value of a vehicle into its lanes."""
    for j in range(first_lane, first_lane + axles):
        w[first_of_row + j] = value


@kernel
def settle(w, first_lane, axles):
    """Bring a vehicle to rest, with its wheels and rollers."""
    for place in (row.V, row.RATE, row.WHEEL, row.ROLLER, row.MOTOR, row.BRAKE, row.MOVING):
        broadcast(w, place, first_lane, axles, 0.0)
