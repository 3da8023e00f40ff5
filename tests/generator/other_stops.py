"""Braking stops with hidden effects, by a second author: six records of a coach on a soiled rail.

The wheels slide. A slide protection with thresholds of deceleration and sliding vents and refills
in pulses, and sensors with the declared noise write what they see. The hidden effects act in the
coach, the brake, the contact or a sensor, and no column shows them. Nothing is imported from the
bench: contact patch, adhesion, brake, controller, friction field and integrator are written anew in
this file. So a tool cannot have met in its own model what it finds in these sets.

[O1] F = 2 mu N / pi (k_A x / (1 + (k_A x)^2) + atan(k_S x)), x = pi G a b c11 e / (4 mu N)   Polach
[O2] mu = mu_c (1 + (1 / A - 1) exp(-gamma |s|))                                      eq 13
[O3] f = f_r - (f_r - f_d) exp(-tau N |e| f)                                           eqs 8 to 10
[O4] A / B from b / a by K and E of m = 1 - (b / a)^2                                  Hertz

Symbols: v speed of the coach in m/s, omega rotation in rad/s, s sliding in m/s, e creepage s / v,
N load of a wheel, f adhesion. (In functions, `e` is the vector of effects.)

Signs: brake torque C > 0 brakes; sliding s = v - r omega; J domega/dt = r T - C; M dv/dt = -sum T -
resistance. Sizes are fractions unless the table gives another unit. The torque that acts is
(1 + brake_gain) times the recorded one plus torque_offset times the run's demand. One worn wheelset
turns with r (1 + wheel_radius). A positive gradient rises.

Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937, eqs 8 to 15, Tables 1, 2, 4. The effects
are inventions, not measurements. A real rail has more than one of them.
"""

from collections.abc import Mapping
from math import atan, cos, exp, log1p, pi, sqrt, tanh
from pathlib import Path
from typing import NamedTuple

import numpy as np
from generator import conditions as measured
from numba import njit
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

# causes whose size has the meaning of a parameter in the rig's table: (parameter, sign)
SAME_MEANING = {
    "brake_gain": ("gain", 1.0),
    "wheel_radius": ("fraction", 1.0),
    "wheel_inertia": ("fraction", 1.0),
    "speed_sensor_delay": ("delay_s", 1.0),
    "torque_sensor_delay": ("delay_s", 1.0),
    "wheel_out_of_round": ("amplitude", 1.0),
    "roller_curvature": ("stiffness_fraction", -1.0),
}
# smallest size of each cause, for which nine of ten sets should be explained by its name
SMALLEST = {
    "rail_cleaning": 0.05,  # friction gained behind one wheelset that has cleaned well
    "adhesion_memory": 2.0,  # m, mean lag in distance
    "speed_dependent_friction": 0.05,  # fall for each 10 m/s, at 20 m/s
    "negative_conditioning": 0.10,  # loss after 100 m of sliding
    "contaminated_patch": 0.05,  # loss on the patch
    "friction_trend": 0.12,  # rise until friction stays
    "brake_gain": 0.04,  # below 4 % it hides in the declared calibration error of 0.3 %
    "pad_fade": 0.015,  # loss 100 K above the start; fast stops exceed that
    "torque_offset": 0.015,  # of the demand, only while the brake is applied
    "running_resistance": 150.0,  # N, mean of a force that varies along the rail
    "track_gradient": 0.0006,  # a force of 250 N
    "wheel_radius": 0.0005,  # one wheelset
    "wheel_inertia": 0.05,  # as much torque as 10 ms of delay
    "speed_sensor_delay": 0.005,  # s
    "torque_sensor_delay": 0.010,  # s
    "wheel_out_of_round": 0.02,  # of the load, once per turn, on one wheelset
    "load_transfer": 0.012,  # of the load, per m/s2
    "sanding": 0.05,  # gain on fresh sand
    "roller_curvature": 0.40,  # creep stiffness lost
    "interfacial_layer": 0.50,  # initial slope lost
    "falling_friction": 0.15,  # loss at very large sliding
}

# sizes beyond which an effect has no physical meaning: a roller of 20 mm, a layer softer than the
# contact
LARGEST = {"roller_curvature": 0.70, "interfacial_layer": 0.75}

# effects that are not in the rig's table of causes: one clearly visible size each
UNKNOWN = {
    "rail_joints": 0.08,  # friction wave along the rail
    "acceleration_softening": 0.12,  # friction falls while the wheel's speed changes fast
    "one_axle_drop": 0.12,  # one wheelset, from some moment of a stop on
    "sliding_hysteresis": 0.10,  # friction differs between growing and shrinking sliding
    "torsional_swing": 0.9,  # share of the torque that comes through a soft shaft
    "torque_ripple": 0.10,  # twice per turn, in the brake
    "bogie_coupling": 300.0,  # N m s/rad between the two wheelsets of a bogie
    "brake_play": 0.05,  # of the demand: torque sticks before it turns
    "speed_quantum": 0.6,  # rad/s, speeds read downwards to the next step
    "power_softening": 0.20,  # friction falls with the power of sliding
    "one_run_burst": 0.25,  # a shower in one stop only
}

PAIRS = tuple(
    {name: 2.0 * SMALLEST[name] for name in pair}
    for pair in (
        ("rail_cleaning", "brake_gain"),
        ("adhesion_memory", "wheel_radius"),
        ("speed_dependent_friction", "torque_sensor_delay"),
        ("contaminated_patch", "running_resistance"),
        ("sanding", "load_transfer"),
        ("friction_trend", "speed_sensor_delay"),
        ("rail_cleaning", "pad_fade"),
        ("negative_conditioning", "wheel_out_of_round"),
    )
)

NAMES = (*SMALLEST, *UNKNOWN)
(
    CLEANING,
    MEMORY,
    SPEED,
    PASTE,
    PATCH,
    TREND,
    GAIN,
    FADE,
    OFFSET,
    DRAG,
    GRADIENT,
    WORN,
    INERTIA,
    SPEED_DELAY,
    TORQUE_DELAY,
    ROUND,
    TRANSFER,
    SAND,
    CURVATURE,
    LAYER,
    FALLING,
    JOINTS,
    ACCELERATION,
    DROP,
    HYSTERESIS,
    SWING,
    RIPPLE,
    COUPLING,
    PLAY,
    QUANTUM,
    POWER,
    BURST,
) = range(32)

# gravity in m/s2, wheel radius in m, moment of inertia of a wheelset in kg m2
G = 9.80665
R = 0.445
J = 160.0
# the adhesion law: recovered friction, and A, gamma (s/m), k_A, k_S of the degraded (D) and the
# recovered (R) curve; tau in m/J
MU_R = 0.28
A_D = 0.40
A_R = 0.40
GAMMA_D = 0.20
GAMMA_R = 0.60
TAU = 1.9e-4
KA_D = 0.3
KS_D = 0.1
KA_R = 1.0
KS_R = 0.4
# running resistance: N, and N s2/m2
DRAG_A = 600.0
DRAG_C = 0.9375
# load of a wheel for which `patch_product` is computed, N
N_REF = 52700.0
# distance of each wheelset behind the first, m
PLACES = np.array([0.0, 2.56, 19.0, 21.56])
# load that moves forward to each wheelset, as a share of mass times deceleration
PITCH = np.array([0.036, 0.013, -0.013, -0.036])
# the rail is stored from TAIL_M behind the start for LENGTH_M: work in cells, friction in points
TAIL_M = 30.0
LENGTH_M = 2600.0
CELL_M = 0.1
FIELD_M = 0.25
# speed about which the friction of the pads turns, m/s
PAD_SPEED_M_S = measured.PAD_SPEED_M_S
# deviation of the friction along the rail, and of each wheelset's, in every run
FIELD_DEVIATION = 0.0141
# step of the integrator, and of contact and record; steps per slow step, and per protection cycle
STEP_S = 0.00025
SLOW_S = 0.001
STEPS_SLOW = 4
STEPS_WSP = 40
# rows of a sample: 10 ms
ROWS_PER_SAMPLE = 10
LONGEST_ROWS = 90000
# commands of a valve
FILL = 0
HOLD = 1
VENT = 2
# a time or place that is not reached
NEVER = 1e9

RUNS = ("a1", "a2", "a3", "b1", "b2", "b3")
IDEAL = measured.Conditions()


class OtherRun(NamedTuple):
    """What differs in one run from the other runs of a set: its vehicle, rail or effects.

    The effects are in addition to those of the set. `load_shares` are added to the loads of the
    wheelsets, as shares of their mean.
    """

    effects: Mapping[str, float] = {}
    radius_fraction: float = 0.0  # of all wheels
    friction_fraction: float = 0.0  # of the contaminant
    load_shares: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


class Stop(NamedTuple):
    """One stop: the coach, its brake and protection, and where the effects strike."""

    v0: float
    mass_kg: float
    mu_d: float
    demand_Nm: float
    apply_s: float
    end_m_s: float
    start_m: float
    share: np.ndarray  # load of each wheelset over the mean
    # protection: sliding that is tolerated, and sliding that vents; both grow by 0.02 of the speed
    low_m_s: float
    high_m_s: float
    # rim deceleration that vents, and rim acceleration that holds
    brake_m_s2: float
    gain_m_s2: float
    dead: int  # cycles of 10 ms between command and valve
    fill_s: float
    vent_s: float
    axle: int  # the wheelset of the effects that strike one
    patch_m: float
    patch_length_m: float
    sand_s: float
    drop_s: float
    wave_m: float
    burst_s: float  # negative: not in this run
    slope: float  # pi G a b c11 / 4 at N_REF, N
    radius_m: float  # of the wheels
    pads: measured.PadVariation


class State(NamedTuple):
    """What changes in a stop; arrays have the shape (4,), one value per wheelset, unless noted."""

    y: np.ndarray  # (5,) v and the four omega
    track: np.ndarray  # (5,) see TIME
    radius: np.ndarray
    load: np.ndarray  # as the sensors see it, N
    true: np.ndarray  # in the contact, N
    q: np.ndarray  # friction over the contaminant's
    slope: np.ndarray  # pi G a b c11 / (4 N)
    torque: np.ndarray  # recorded, Nm
    acting: np.ndarray  # at the wheelset, Nm
    play: np.ndarray  # torque behind the sticking brake, Nm
    heat: np.ndarray  # of the disc above the start, K
    angle: np.ndarray  # turned, rad
    slid: np.ndarray  # distance, m
    swerve: np.ndarray  # rate of sliding, m/s2
    recovery: np.ndarray  # share of recovery; negative: it follows from the work done now
    lag: np.ndarray  # (4, 2) work in two lags in series, J/m
    swing: np.ndarray  # (4, 2) torque behind a soft shaft in Nm, and its rate
    pitch: np.ndarray  # (2,) swinging deceleration of the load transfer, and its rate
    since: np.ndarray  # cycles since the last sliding
    rim: np.ndarray  # (4, 4) the last rim speeds, m/s
    valve: np.ndarray  # (4, 8) the last commands
    work: np.ndarray  # (4, cells) J/m that each wheelset left on each cell of the rail


# indices of State.track: time in s, place of the first wheelset in m, deceleration that the load
# sensors feel in m/s2, places between which sand lies in m
TIME = 0
PLACE = 1
FELT = 2
SAND_FROM = 3
SAND_TO = 4
# columns of the rows that `run` writes; wheel speeds, loads and torques have four each
ROW_SPEED = 0
ROW_WHEELS = 1
ROW_LOADS = 5
ROW_TORQUES = 9
ROW_PLACE = 13
ROW_COLUMNS = 14


# --- the contact ---


def patch_product(roller_radius_m: float = np.inf) -> float:
    """Return G a b c11 in N at N_REF: wheel on a rail (or roller), lateral radius 0.3 m [O4]."""
    young_Pa = 2.1e11
    shear_Pa = 8.0e10
    poisson = 0.3
    lateral_m = 0.3
    # half the curvatures of the gap, 1/m
    along = 0.5 * (1.0 / R + 1.0 / roller_radius_m)
    across = 0.5 / lateral_m
    flat = min(along, across) / max(along, across)

    def mismatch(ratio: float) -> float:
        """Return how far an ellipse of this ratio of axes is from the ratio of curvatures [O4]."""
        m = 1.0 - ratio * ratio
        k = ellipk(m)
        e = ellipe(m)
        return float((k - e) / (e / ratio**2 - k) - flat)

    ratio = brentq(mismatch, 0.02, 1.0 - 1e-6)
    m = 1.0 - ratio * ratio
    modulus = young_Pa / (2.0 * (1.0 - poisson**2))
    long = (
        3.0 * N_REF * ellipe(m) / (2.0 * pi * ratio**2 * 2.0 * modulus * 0.5 * (along + across))
    ) ** (1.0 / 3.0)
    # half axes in m: a along the rail, b across
    if along < across:
        a = long
        b = ratio * long
    else:
        a = ratio * long
        b = long
    return shear_Pa * a * b * kalker_c11(a / b, poisson)


def kalker_c11(ratio: float, poisson: float) -> float:
    """Return c11 of a patch with ratio = a / b, from Kalker's table.

    It is linear in g = min(a/b, b/a), and 1 / c11 is quadratic in Poisson's ratio nu.
    """
    table = Path(__file__).parents[1] / "data" / "kalker_coefficients.csv"
    half = "a/b" if ratio <= 1.0 else "b/a"
    # 1 / c11 by (g, nu); both halves of the table meet at a circle, g = 1
    inverse_of: dict[tuple[float, float], float] = {}
    for line in table.read_text().splitlines():
        if line[:3] not in ("a/b", "b/a"):
            continue
        row_half, g, nu, coefficient = line.split(",")[:4]
        if row_half == half or float(g) == 1.0:
            inverse_of.setdefault((float(g), float(nu)), 1.0 / float(coefficient))

    places = sorted({g for g, _ in inverse_of})
    inverse = []
    for nu in (0.0, 0.25, 0.5):
        column = [inverse_of[g, nu] for g in places]
        inverse.append(np.interp(min(ratio, 1.0 / ratio), places, column))
    return float(1.0 / np.polyval(np.polyfit((0.0, 0.25, 0.5), inverse, 2), poisson))


def friction_field(
    rng: np.random.Generator, deviation: float, shape: tuple[int, ...] = ()
) -> np.ndarray:
    """Return a random field every FIELD_M along LENGTH_M, of this deviation.

    It is a sum of waves with the spectrum of Matern 3/2; its correlation falls to 1/e after 8 m.
    """
    scale = 8.0 * sqrt(3.0) / 2.1462
    waves = 150
    place = np.arange(int(LENGTH_M / FIELD_M)) * FIELD_M
    field = np.zeros((*shape, len(place)))
    for index in np.ndindex(*shape):
        wave = rng.standard_t(3.0, waves) / scale
        phase = rng.uniform(0.0, 2.0 * pi, waves)
        for k, p in zip(wave, phase, strict=True):
            field[index] += np.cos(k * place + p)
    return deviation * sqrt(2.0 / waves) * field


@njit(cache=True)
def polach(x, mu, k_a, k_s):
    """Return the adhesion of a creep curve; x is that of [O1] times mu."""
    y = k_a * x / mu
    return 2.0 * mu / pi * (y / (1.0 + y * y) + atan(k_s * x / mu))  # [O1]


@njit(cache=True)
def adhesion(sliding, v, load, q, slope, mu_d, recovery):
    """Return the adhesion coefficient, with the sign of the sliding.

    `load` is that of a wheelset in N, and `slope` is x mu / e of [O1] at that load. `recovery` is
    the share of recovery; negative: it follows from the work done now [O3], by Newton's method.
    """
    s = abs(sliding)
    e = abs(sliding) / max(abs(v), 0.5)
    normal = 0.5 * load
    x = slope * e
    f_d = polach(x, q * mu_d * (1.0 + (1.0 / A_D - 1.0) * exp(-GAMMA_D * s)), KA_D, KS_D)  # [O2]
    f_r = polach(x, q * MU_R * (1.0 + (1.0 / A_R - 1.0) * exp(-GAMMA_R * s)), KA_R, KS_R)
    if recovery >= 0.0:
        f = f_d + recovery * (f_r - f_d)
    else:
        k = TAU * normal * e
        f = f_r
        for _ in range(7):
            rest = (f_r - f_d) * exp(-k * f)
            newton = (f - f_r + rest) / (1.0 - k * rest)
            f -= newton
            if abs(newton) < 1e-11:
                break
    return f if sliding >= 0.0 else -f


@njit(cache=True)
def friction(e, stop, now, j, sliding, place):
    """Return the factor of the hidden effects on the friction of wheelset j; 1 without them."""
    s = abs(sliding)
    q = 1.0
    t = now.track[TIME]
    # the wheelsets in front have cleaned this cell
    for i in range(j):
        done = (now.work[i, int((place + TAIL_M) / CELL_M)] / 500.0) ** 1.5
        q *= 1.0 + e[CLEANING] * done / (1.0 + done)
    q *= (max(now.y[0], 2.0) / 20.0) ** (-2.0 * e[SPEED])
    q *= 1.0 - e[PASTE] * log1p(now.slid[j] / 8.0) / log1p(100.0 / 8.0)
    into = min(place - stop.patch_m, stop.patch_m + stop.patch_length_m - place)
    q *= 1.0 - e[PATCH] * min(max(into / 12.0, 0.0), 1.0)
    q *= 1.0 + e[TREND] * min(t / 18.0, 1.0)
    into = min(place - now.track[SAND_FROM], now.track[SAND_TO] - place)
    q *= 1.0 + e[SAND] * (1.0 - 0.1 * j) * min(max(into / 4.0, 0.0), 1.0)
    q *= 1.0 - e[FALLING] * s * s / (s * s + 16.0)
    q *= 1.0 + e[JOINTS] * cos(2.0 * pi * place / stop.wave_m)
    q *= 1.0 - e[ACCELERATION] * tanh(abs(now.swerve[j]) / 3.0)
    q *= 1.0 + e[HYSTERESIS] * tanh(now.swerve[j] / 2.0)
    if j == stop.axle and t > stop.drop_s:
        q *= 1.0 - e[DROP]
    if stop.burst_s >= 0.0 and 0.0 < t - stop.burst_s < 4.0:
        q *= 1.0 - e[BURST]
    return q


@njit(cache=True)
def between(field, place):
    """Return the value of a field at a place, linear between its points."""
    at = (place + TAIL_M) / FIELD_M
    k = int(at)
    return field[k] + (at - k) * (field[k + 1] - field[k])


@njit(cache=True)
def meet_rail(e, stop, now, j, rail, own):
    """Set load, creep stiffness, friction, work and recovery of wheelset j for the next SLOW_S."""
    v = now.y[0]
    place = now.track[PLACE] - PLACES[j]
    s = v - now.radius[j] * now.y[1 + j]
    now.load[j] = stop.mass_kg * (0.25 * G * stop.share[j] + PITCH[j] * now.track[FELT])
    now.true[j] = now.load[j] * (1.0 + e[TRANSFER] * now.pitch[0] * PITCH[j] / PITCH[0])
    if j == stop.axle:
        now.true[j] *= 1.0 + e[ROUND] * (cos(now.angle[j]) + 0.3 * cos(3.0 * now.angle[j]))
    now.slope[j] = stop.slope / N_REF * (2.0 * N_REF / now.true[j]) ** (1.0 / 3.0)
    if e[LAYER] > 0.0:
        # a soft layer of constant flexibility, in series with the contact, whose flexibility grows
        # with its size
        now.slope[j] /= 1.0 + e[LAYER] / (1.0 - e[LAYER]) * (2.0 * N_REF / now.load[j]) ** (
            1.0 / 3.0
        )
    now.q[j] = (
        friction(e, stop, now, j, s, place)
        * (1.0 + between(rail, place))
        * (1.0 + between(own[j], place))
    )
    force = (
        0.5
        * now.true[j]
        * abs(adhesion(s, v, now.true[j], now.q[j], now.slope[j], stop.mu_d, now.recovery[j]))
    )
    now.q[j] *= 1.0 - e[POWER] * force * abs(s) / (force * abs(s) + 20000.0)
    now.work[j, int((place + TAIL_M) / CELL_M)] = force * abs(s) / v
    now.slid[j] += SLOW_S * abs(s)
    if e[MEMORY] > 0.0:
        part = 1.0 - exp(-v * SLOW_S / (0.5 * e[MEMORY]))
        now.lag[j, 0] += part * (force * abs(s) / v - now.lag[j, 0])
        now.lag[j, 1] += part * (now.lag[j, 0] - now.lag[j, 1])
        now.recovery[j] = 1.0 - exp(-TAU * now.lag[j, 1])


@njit(cache=True)
def act(e, stop, now, j):
    """Set the torque at wheelset j from the recorded one.

    Gain, fade, offset, ripple, a soft shaft and a sticking brake act on it.
    """
    torque = now.torque[j]
    omega = now.y[1 + j]
    c = torque * (1.0 + e[GAIN]) * (1.0 - e[FADE] * max(now.heat[j] - 25.0, 0.0) / 75.0)
    # pads within their calibration
    swing = 2.0 * pi * now.track[TIME] / stop.pads.period_s + stop.pads.phase
    vary = stop.pads.constant[j] + stop.pads.by_time[j] * cos(swing)
    vary += stop.pads.by_speed[j] * max(1.0 - now.y[0] / PAD_SPEED_M_S, -1.0)
    c *= 1.0 + vary
    c += e[OFFSET] * stop.demand_Nm * tanh(torque / 250.0)
    c *= 1.0 + e[RIPPLE] * cos(2.0 * now.angle[j])
    c += e[SWING] * (now.swing[j, 0] - torque)
    if e[PLAY] > 0.0:
        c += now.play[j] - torque
    now.acting[j] = c
    now.heat[j] += STEP_S * (c * omega / 55000.0 - now.heat[j] / 90.0)
    now.angle[j] += STEP_S * omega


@njit(cache=True)
def command(stop, slip, rim, since, cycle, v):
    """Return the command to the valve of one wheelset for the next 10 ms.

    `slip` is its sliding in m/s, `rim` the acceleration of its rim in m/s2, and `since` the number
    of cycles since it slid.
    """
    low = stop.low_m_s + 0.02 * v
    high = stop.high_m_s + 0.02 * v
    if rim < stop.gain_m_s2 and (slip > high or (rim < -stop.brake_m_s2 and slip > low)):
        return VENT
    if slip > low:
        # between the limits, short pulses look for more adhesion
        return FILL if rim > -2.0 and rim < stop.gain_m_s2 and cycle % 30 < 10 else HOLD
    return FILL if since > 120 or cycle % 10 < 5 else HOLD


@njit(cache=True)
def protect(stop, now, cycle):
    """Run one cycle of the slide protection, which knows the coach's speed from a radar."""
    for j in range(4):
        rim = R * now.y[1 + j]
        slip = now.y[0] - rim
        gain = (rim - now.rim[j, (cycle + 1) % 4]) / 0.03  # over the last 30 ms
        now.since[j] = 0 if slip > stop.low_m_s else now.since[j] + 1
        now.valve[j, cycle % 8] = command(stop, slip, gain, now.since[j], cycle + 7 * j, now.y[0])
        now.rim[j, cycle % 4] = rim
        if cycle < 4:
            now.valve[j, cycle % 8] = FILL


@njit(cache=True)
def move_valve(e, stop, now, j, cycle):
    """Advance the recorded torque, its soft shaft and its sticking brake by one step.

    The valve follows its command after a dead time.
    """
    state = now.valve[j, (cycle - stop.dead) % 8]
    if now.track[TIME] >= stop.apply_s and state == FILL:
        now.torque[j] += STEP_S * (stop.demand_Nm - now.torque[j]) / stop.fill_s
    elif state == VENT:
        now.torque[j] -= STEP_S * now.torque[j] / stop.vent_s
    width = e[PLAY] * stop.demand_Nm
    now.play[j] = min(max(now.play[j], now.torque[j] - width), now.torque[j] + width)
    now.swing[j, 1] += STEP_S * (1900.0 * (now.torque[j] - now.swing[j, 0]) - 4.0 * now.swing[j, 1])
    now.swing[j, 0] += STEP_S * now.swing[j, 1]


@njit(cache=True)
def slopes(y, e, stop, now, extra_N, rate):
    """Write the time derivatives of v and the four omega at y into `rate`."""
    total = DRAG_A + DRAG_C * y[0] * y[0] + extra_N
    for j in range(4):
        s = y[0] - now.radius[j] * y[1 + j]
        force = now.true[j] * adhesion(
            s, y[0], now.true[j], now.q[j], now.slope[j], stop.mu_d, now.recovery[j]
        )
        total += force
        # the other wheelset of the bogie is j ^ 1
        twist = e[COUPLING] * (y[1 + j] - y[1 + (j ^ 1)])
        rate[1 + j] = (now.radius[j] * force - now.acting[j] - twist) / (J * (1.0 + e[INERTIA]))
    rate[0] = -total / stop.mass_kg


@njit(cache=True)
def advance(e, stop, now, rate):
    """Advance by one Runge-Kutta step of fourth order, with constant contact and brake.

    `rate` (5, 5) is working memory.
    """
    x = now.track[PLACE]
    extra_N = e[DRAG] * (1.0 + 0.4 * cos(2.0 * pi * x / 170.0))
    extra_N += e[GRADIENT] * stop.mass_kg * G * min((x - stop.start_m) / 30.0, 1.0)
    slopes(now.y, e, stop, now, extra_N, rate[0])
    for stage in range(1, 4):
        ahead = STEP_S if stage == 3 else 0.5 * STEP_S
        for k in range(5):
            rate[4, k] = now.y[k] + ahead * rate[stage - 1, k]
        slopes(rate[4], e, stop, now, extra_N, rate[stage])
    step = (rate[0] + 2.0 * rate[1] + 2.0 * rate[2] + rate[3]) / 6.0
    now.track[PLACE] += STEP_S * (now.y[0] + 0.5 * STEP_S * step[0])
    now.y[:] += STEP_S * step
    for j in range(4):
        # a brake holds a standing wheel, it does not turn it backwards
        now.y[1 + j] = max(now.y[1 + j], 0.0)
        now.swerve[j] += STEP_S * (step[0] - now.radius[j] * step[1 + j] - now.swerve[j]) / 0.02
    # the load sensors see a first-order pitch; the hidden transfer swings at 1 Hz
    now.track[FELT] -= STEP_S * (step[0] + now.track[FELT]) / 0.25
    now.pitch[1] -= STEP_S * (39.5 * (step[0] + now.pitch[0]) + 3.8 * now.pitch[1])
    now.pitch[0] += STEP_S * now.pitch[1]


@njit(cache=True)
def run(stop, e, now, rail, own, fine):
    """Simulate one stop; return the number of rows, one per SLOW_S, that are written to `fine`."""
    rate = np.zeros((5, 5))
    rows = 0
    for n in range(STEPS_SLOW * len(fine)):
        now.track[TIME] = n * STEP_S
        if now.y[0] < stop.end_m_s:
            break
        # the sander blows for 5 s, and leaves sand between two places
        for k in range(2):
            if now.track[TIME] >= stop.sand_s + 5.0 * k and now.track[SAND_FROM + k] > 1e8:
                now.track[SAND_FROM + k] = now.track[PLACE]
        for j in range(4):
            if n % STEPS_SLOW == 0:
                meet_rail(e, stop, now, j, rail, own)
            act(e, stop, now, j)
        if n % STEPS_SLOW == 0:
            fine[rows, 0:5] = now.y
            fine[rows, 5:9] = now.load
            fine[rows, 9:13] = now.torque
            fine[rows, ROW_PLACE] = now.track[PLACE]
            rows += 1
        if n % STEPS_WSP == 0:
            protect(stop, now, n // STEPS_WSP)
        advance(e, stop, now, rate)
        for j in range(4):
            move_valve(e, stop, now, j, n // STEPS_WSP)
    return rows


def rolling(stop: Stop, e: np.ndarray) -> State:
    """Return the coach before the brake is applied: every wheel rolls."""
    radius = np.full(4, stop.radius_m)
    radius[stop.axle] *= 1.0 + e[WORN]
    return State(
        y=np.array([stop.v0, *(stop.v0 / radius)]),
        track=np.array([0.0, stop.start_m, 0.0, NEVER, NEVER]),
        radius=radius,
        load=np.zeros(4),
        true=np.zeros(4),
        q=np.zeros(4),
        slope=np.zeros(4),
        torque=np.zeros(4),
        acting=np.zeros(4),
        play=np.zeros(4),
        heat=np.zeros(4),
        angle=np.zeros(4),
        slid=np.zeros(4),
        swerve=np.zeros(4),
        recovery=np.full(4, -1.0),
        lag=np.zeros((4, 2)),
        swing=np.zeros((4, 2)),
        pitch=np.zeros(2),
        since=np.full(4, 1000),
        rim=np.zeros((4, 4)),
        valve=np.zeros((4, 8), np.int64),
        work=np.zeros((4, int(LENGTH_M / CELL_M))),
    )


# --- sets ---


def make(
    folder: Path,
    effects: dict[str, float],
    seed: int,
    runs: tuple[str, ...] = RUNS,
    conditions: measured.Conditions = IDEAL,
    other: Mapping[str, OtherRun] | None = None,
) -> Path:
    """Write a dataset of six stops with hidden effects; return its folder.

    `effects` has the size of each effect by its name in SMALLEST or UNKNOWN. `other` has the runs
    that differ, by their names. The same seed writes the same bytes, and the same stop for any
    choice of `runs`.
    """
    draw = np.random.default_rng((71, seed))
    of_set = _sizes(effects)
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    # calibration of load sensors, torque gauges, and the declared mass
    gains = 1.0 + draw.normal(0.0, 0.003, 3)
    of_rail, of_wheelset = measured.rail_deviations(conditions, FIELD_DEVIATION)
    rail = friction_field(draw, of_rail)
    text = _HEAD
    if conditions.sensor:
        # nobody declares the noise of such a sensor: it depends on the speed
        text = text.replace(_WHEEL_NOISE, "")
    for name, stop, mass, mapped in _plan(draw, of_set, gains[2]):
        if name not in runs:
            continue
        number = RUNS.index(name)
        stop = stop._replace(pads=measured.pad_variation(conditions, seed, number))
        e = of_set
        if other and name in other:
            e = of_set + _sizes(other[name].effects)
            stop = _differing(stop, e, other[name])
        rng = np.random.default_rng((71, seed, number))
        own = friction_field(rng, of_wheelset, (4,))
        fine = np.zeros((LONGEST_ROWS, ROW_COLUMNS))
        rows = run(stop, e, rolling(stop, e), rail, own, fine)
        fine = fine[:rows]
        wheels = None
        if conditions.sensor:
            ms = 0.001 * np.arange(rows)
            wheels = measured.wheel_speeds(
                conditions,
                ms,
                fine[:, ROW_WHEELS : ROW_WHEELS + 4],
                ms[::ROWS_PER_SAMPLE] - e[SPEED_DELAY],
                measured.pole_wheels(seed, number),
            )
        _record(folder / "runs" / f"{name}.csv", fine, e, mass, gains, mapped, rng, wheels)
        text += _RUN.format(
            name=name, group="tune" if name[0] == "a" else "validate", v0=stop.v0, mass=mass
        )
    (folder / "dataset.toml").write_text(text)
    return folder


def _sizes(effects: Mapping[str, float]) -> np.ndarray:
    """Return the vector of effects of their sizes by name."""
    e = np.zeros(len(NAMES))
    for name, size in effects.items():
        e[NAMES.index(name)] = size
    return e


def _differing(stop: Stop, e: np.ndarray, other: OtherRun) -> Stop:
    """Return the stop of a run that differs, with its effects `e`."""
    return stop._replace(
        share=stop.share + np.array(other.load_shares),
        mu_d=stop.mu_d * (1.0 + other.friction_fraction),
        radius_m=stop.radius_m * (1.0 + other.radius_fraction),
        slope=0.25 * pi * _curved(e[CURVATURE]),
    )


def _plan(
    draw: np.random.Generator, e: np.ndarray, weight: float
) -> list[tuple[str, Stop, float, bool]]:
    """Return the six stops: name, stop, declared mass, whether the record has positions.

    `weight` is the true mass over the declared one. The order of the draws decides every stop.
    """
    share = 1.0 + draw.normal(0.0, 0.012, 4)
    low = draw.uniform(1.6, 2.8)
    common = dict(
        share=share / share.mean(),
        low_m_s=low,
        high_m_s=low + draw.uniform(1.8, 3.6),
        brake_m_s2=draw.uniform(4.0, 7.0),
        gain_m_s2=draw.uniform(1.0, 2.5),
        dead=int(draw.integers(2, 6)),
        fill_s=draw.uniform(0.25, 0.5),
        vent_s=draw.uniform(0.12, 0.28),
        axle=int(draw.integers(0, 4)),
        patch_m=draw.uniform(50.0, 120.0),
        patch_length_m=draw.uniform(70.0, 130.0),
        wave_m=draw.uniform(14.0, 25.0),
        slope=0.25 * pi * _curved(e[CURVATURE]),
        radius_m=R,
        pads=measured.pad_variation(IDEAL, 0, 0),
    )
    soiled = draw.uniform(0.033, 0.043)
    burst = draw.choice(RUNS)  # the run with the shower
    # where positions are recorded, the stops may begin at different places of the same rail
    mapped = draw.uniform() < 0.4
    plan = []
    for name, (slow, fast) in zip(RUNS, _SPEEDS_M_S, strict=True):
        v0 = round(draw.uniform(slow, fast), 1)
        mass = round(draw.uniform(40000.0, 50000.0), -1)
        shower = draw.uniform(4.0, 9.0)
        stop = Stop(
            v0=v0,
            mass_kg=mass * weight,
            mu_d=soiled * (1.0 + 0.05 * draw.normal()),
            demand_Nm=draw.uniform(7000.0, 9800.0),
            apply_s=draw.uniform(0.5, 1.5),
            end_m_s=draw.uniform(3.5, 5.0),
            start_m=float(mapped) * draw.uniform(0.0, 60.0),
            sand_s=draw.uniform(3.0, 9.0),
            drop_s=draw.uniform(6.0, 12.0),
            burst_s=shower if name == burst else -1.0,
            **common,
        )
        plan.append((name, stop, mass, mapped))
    return plan


def _curved(lost: float) -> float:
    """Return G a b c11 on the rail, or on the roller whose curvature loses this share of it."""
    rail = patch_product()
    if lost == 0.0:
        return rail
    return patch_product(brentq(lambda r: patch_product(r) - rail * (1.0 - lost), 0.02, 50.0))


def _record(
    path: Path,
    fine: np.ndarray,
    e: np.ndarray,
    mass: float,
    gains: np.ndarray,
    mapped: bool,
    rng: np.random.Generator,
    from_pulses: np.ndarray | None = None,
) -> None:
    """Write the CSV of a stop as its sensors see it, every 10 ms.

    `fine` has the rows of `run`, `gains` the calibration of load and torque. `mapped`: the record
    has positions. `from_pulses` (samples, 4) replaces wheel speeds of ideal sensors.
    """
    ms = np.arange(len(fine))
    at = np.arange(0, len(fine), ROWS_PER_SAMPLE)

    def sensed(columns: slice, delay_s: float = 0.0) -> np.ndarray:
        late_ms = at - 1000.0 * delay_s
        return np.column_stack([np.interp(late_ms, ms, column) for column in fine[:, columns].T])

    speed = fine[at, ROW_SPEED] + rng.normal(0.0, 0.03, len(at))
    wheel = sensed(slice(1, 5), e[SPEED_DELAY]) + rng.normal(0.0, 0.03 / R, (len(at), 4))
    if from_pulses is not None:
        wheel = from_pulses
    if e[QUANTUM] > 0.0:
        wheel = np.floor(wheel / e[QUANTUM]) * e[QUANTUM]
    load = sensed(slice(5, 9)) * gains[0] + rng.normal(0.0, 0.0025 * mass * G, (len(at), 4))
    torque = sensed(slice(9, 13), e[TORQUE_DELAY]) * gains[1]
    torque += rng.normal(0.0, 0.015 * fine[:, 9:13].max(), torque.shape)
    names = [
        "time_s",
        "vehicle_speed_m_s",
        *(f"wheel_speed_{j}_rad_s" for j in range(1, 5)),
        *(f"wheel_load_{j}_N" for j in range(1, 5)),
        *(f"brake_torque_{j}_Nm" for j in range(1, 5)),
    ]
    table = [0.001 * at, speed, wheel, load, torque]
    if mapped:
        names.append("position_m")
        table.append(fine[at, ROW_PLACE])
    np.savetxt(
        path, np.column_stack(table), delimiter=",", fmt="%.7g", header=",".join(names), comments=""
    )


# range of the initial speed of each run; tuning and validation both have slow and fast stops
_SPEEDS_M_S = ((37.0, 44.0), (29.0, 36.0), (22.0, 28.0), (38.0, 44.0), (30.0, 37.0), (23.0, 30.0))

_RUN = """
[[run]]
file = "runs/{name}.csv"
group = "{group}"
initial_speed_m_s = {v0}
mass_kg = {mass}
"""

_WHEEL_NOISE = "wheel_speed_rad_s = 0.06742\n"
_HEAD = """title = "Six stops of a coach on a soiled rail"
kind = "braking_runs"
vehicle = "uic_z1"
sample_time_s = 0.01

[axles]
positions_m = [0.0, 2.56, 19.0, 21.56]

[accuracy]
speed_m_s = 0.03
wheel_speed_rad_s = 0.06742
torque_fraction = 0.015
load_fraction = 0.01
calibration_fraction = 0.003
"""
