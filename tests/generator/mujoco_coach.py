"""The UIC-Z1 coach as MuJoCo bodies, and one stop of it; for `mujoco_stops`.

The model is planar: the body moves along, up and in pitch. Each bogie hangs in it by a vertical
slide (secondary suspension) and a hinge (its pitch, at the height of the pivot), and each wheelset
in its bogie by a slide (primary suspension) and its axle. Load transfer, pitch and bounce follow
from MuJoCo's own equations and its semi-implicit Euler integrator. Masses and springs are those of
the paper's Tables 1 to 3, heights those of configs/vehicles/uic_z1.toml; dampers and rail are
assumptions.

In each step MuJoCo gets these forces: at each wheelset the contact (a vertical spring and damper of
the rail, and adhesion along it), the torque of the brake between wheelset and bogie, and the
resistance at the body. Creep is stiff (up to 5000 1/s at 4 m/s). So the rotation of each wheelset
is first carried through the step in SUBSTEPS linearly implicit parts, at the step's load and speed.
The mean of the force over these parts is what MuJoCo applies. So MuJoCo's rotation ends where the
parts ended, and the momentum that the rail takes is what the coach loses.

Signs: x ahead, z up, rotations about y: a wheel that rolls ahead turns positively, and braking
pitches the nose down.
"""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numba import njit

from . import mujoco_contact as contact
from .conditions import PAD_SPEED_M_S, Conditions, PadVariation, pad_variation

G_M_S2 = 9.81
# masses of the whole coach, a bogie, a wheelset; moment of inertia of a wheelset about its axle
MASS_KG = 43000.0
BOGIE_KG = 3000.0
WHEELSET_KG = 1820.0
AXLE_KGM2 = 160.0
RADIUS_M = 0.445
# distances along the coach: wheelsets of a bogie, pivots
WHEELBASE_M = 2.56
PIVOTS_M = 19.0
# heights above the rail: centres of mass of body and bogie, pivot
BODY_M = 1.8
BOGIE_M = 0.6
PIVOT_M = 0.9
RESISTANCE_N = 600.0
RESISTANCE_N_S2_M2 = 0.9375
# suspensions: primary of a wheelset, secondary of a bogie
PRIMARY_N_M = 1.58e6
PRIMARY_N_S_M = 1.6e4
SECONDARY_N_M = 6.8e5
SECONDARY_N_S_M = 4.0e4
# of a wheelset: contact on a rail on its pads and ballast
RAIL_N_M = 2.0e8
RAIL_N_S_M = 2.0e5
# of the wheelsets, behind the first
POSITIONS_M = (
    0.0,
    WHEELBASE_M,
    PIVOTS_M,
    PIVOTS_M + WHEELBASE_M,
)
STEP_S = 5e-4
SUBSTEPS = 4
# the rail is stored in cells from BEHIND_M behind the start of the first wheelset
CELL_M = 0.2
BEHIND_M = 40.0
# a stop is recorded down to this speed, and takes no longer than this
LAST_M_S = 4.1
LONGEST_S = 150.0
# cycle of the slide protection, and cycles from its command to the valve
CYCLE_S = 0.01
DEAD_TIME = 3

# effects that act while a stop runs, in the order of the array of sizes
ACTING = (
    "rail_cleaning",
    "adhesion_memory",
    "speed_dependent_friction",
    "negative_conditioning",
    "friction_trend",
    "brake_gain",
    "pad_fade",
    "torque_offset",
    "running_resistance",
    "wheel_out_of_round",
    "sanding",
    "interfacial_layer",
    "falling_friction",
    "torque_hysteresis",
    "axle_generator",
    "coupler_surge",
    "track_waves",
)
(
    CLEANING,
    MEMORY,
    SPEED,
    CONDITIONING,
    TREND,
    GAIN,
    FADE,
    OFFSET,
    RESISTANCE,
    ROUND,
    SAND,
    LAYER,
    FALLING,
    HYSTERESIS,
    GENERATOR,
    SURGE,
    WAVES,
) = range(len(ACTING))

# state of a wheelset that MuJoCo does not have: columns of `state`
PRESSURE = 0  # torque that the cylinder would give, Nm
TORQUE = 1  # at the gauge, Nm
FRICTION = 2  # magnitude of the last adhesion
ENERGY_1 = 3  # specific work of sliding, in two lags in series, J/m
ENERGY_2 = 4
SLID_M = 5
BULK_K = 6  # excess temperature of the disc behind its face, and at its face
FACE_K = 7
CLAMP = 8  # torque behind the hysteresis of the caliper, Nm
PHASE = 9  # of the protection
SPIN_BEFORE = 10  # at the last cycle of the protection, rad/s
SPIN_RATE = 11  # smoothed, rad/s2
SINCE = 12  # time in the phase, s
COMMAND = 13  # at the valve
ANGLE = 14  # turned, rad
LOAD = 15  # static, N
CELL = 16  # of the rail under the wheel
SEEN = 17  # film on that cell when the wheel came to it
# behind these are the commands on their way to the valve
QUEUE = 18
# phases of the protection, and commands of the valve
VENT = -1.0
HOLD = 0.0
FILL = 1.0

# columns of a trace: time in s, speed in m/s, way in m; then four each: spins in rad/s, loads in N,
# torques at the gauge in Nm, forces of the rail in N, swings of the load in N, angles in rad
TIME = 0
SPEED_M_S = 1
WAY_M = 2
SPINS = 3
LOADS = 7
TORQUES = 11
FORCES = 15
SWINGS = 19
ANGLES = 23
COLUMNS = 27
# indices of `times` of a step, s
BRAKE_FROM = 0
RELIEF_FROM = 1
RELIEF_FOR = 2
SAND_FROM = 3
SAND_TO = 4


class Stop(NamedTuple):
    """What a stop starts from, with the hidden effects."""

    speed_m_s: float
    mu_cd: float
    demand_Nm: float  # brake torque of a wheelset
    begin_s: float  # of braking
    relief_s: tuple[float, float]  # the driver eases the brake from, for
    sand_s: tuple[float, float]  # sanders work from, to
    high: np.ndarray  # (4,) share of sliding at which a wheelset's protection vents
    factors: np.ndarray  # (4, cells) of the contaminant's friction at each place, for each axle
    sizes: np.ndarray  # (len(ACTING),)
    axle: int  # 0..3, of what acts at one
    radii_m: np.ndarray  # (4,)
    inertia_kgm2: float
    mass_kg: float
    roller_1_m: float = 0.0
    gradient: float = 0.0  # mean; ahead and up is positive
    sloshing: float = 0.0  # share of the coach's mass
    pads: PadVariation = pad_variation(Conditions(), 0, 0)


def model(stop: Stop, step_s: float) -> mujoco.MjModel:
    """Return the coach; it is at rest on the level rail where all coordinates are 0."""
    tank_kg = stop.sloshing * MASS_KG
    body_kg = stop.mass_kg - tank_kg - 2 * BOGIE_KG - 4 * WHEELSET_KG
    # what rests on each bogie
    above_N = (body_kg + tank_kg) * G_M_S2 / 2.0
    front = _bogie(PIVOTS_M / 2, above_N, stop.inertia_kgm2)
    rear = _bogie(-PIVOTS_M / 2, above_N, stop.inertia_kgm2)
    return mujoco.MjModel.from_xml_string(
        "<mujoco>"
        f'<option timestep="{step_s}" integrator="Euler" gravity="0 0 {-G_M_S2}"/>'
        "<worldbody>"
        f'<body pos="0 0 {BODY_M}">'
        '<joint type="slide" axis="1 0 0"/>'
        '<joint type="slide" axis="0 0 1"/>'
        '<joint type="hinge" axis="0 1 0"/>'
        f'<inertial pos="0 0 0" mass="{body_kg!r}" diaginertia="76400 1494400 1467160"/>'
        f"{front}{rear}{_tank(tank_kg)}"
        "</body>"
        "</worldbody>"
        "</mujoco>"
    )


def _spring(stiff: float, damping: float, load_N: float) -> str:
    """Return the attributes of a vertical slide whose spring carries a load where it is at 0."""
    return (
        f'type="slide" axis="0 0 1" stiffness="{stiff}" damping="{damping}" '
        f'springref="{-load_N / stiff!r}"'
    )


def _bogie(x: float, above_N: float, axle_kgm2: float) -> str:
    """Return a bogie with its wheelsets; its pivot is at x in the body."""
    secondary = _spring(SECONDARY_N_M, SECONDARY_N_S_M, above_N)
    primary = _spring(PRIMARY_N_M, PRIMARY_N_S_M, (above_N + BOGIE_KG * G_M_S2) / 2.0)
    wheelsets = ""
    for side in (1, -1):
        wheelsets += (
            f'<body pos="{side * WHEELBASE_M / 2} 0 {RADIUS_M - PIVOT_M}">'
            f"<joint {primary}/>"
            '<joint type="hinge" axis="0 1 0"/>'
            f'<inertial pos="0 0 0" mass="{WHEELSET_KG}" diaginertia="800 {axle_kgm2!r} 800"/>'
            "</body>"
        )
    return (
        f'<body pos="{x} 0 {PIVOT_M - BODY_M}">'
        f"<joint {secondary}/>"
        '<joint type="hinge" axis="0 1 0"/>'
        f'<inertial pos="0 0 {BOGIE_M - PIVOT_M}" mass="{BOGIE_KG}" diaginertia="2400 1900 4000"/>'
        f"{wheelsets}"
        "</body>"
    )


def _tank(tank_kg: float) -> str:
    """Return a liquid that swings along the coach with 2.2 rad/s; nothing without one."""
    if not tank_kg:
        return ""
    return (
        "<body>"
        '<joint type="slide" axis="1 0 0" '
        f'stiffness="{tank_kg * 2.2**2}" damping="{tank_kg * 0.15}"/>'
        f'<inertial pos="0 0 0" mass="{tank_kg}" diaginertia="500 500 500"/>'
        "</body>"
    )


# numbers that MuJoCo gives to bodies and joints: three joints of the body, then slide and hinge of
# each bogie and of each of its wheelsets
BODY = 1
WHEELS = np.array([3, 4, 6, 7])
SPIN_JOINTS = np.array([6, 8, 12, 14])


@njit(cache=True)
def _protect(one, speed_m_s, radius_m, high):
    """Run one cycle of the slide protection of a wheelset; `one` is its state.

    It vents a wheel that slides much or decelerates fast, holds, and then fills in pulses. `high`
    is the share of sliding that vents.
    """
    slip = 1.0 - radius_m * one[SPIN_BEFORE] / speed_m_s
    rate = one[SPIN_RATE] * radius_m
    one[SINCE] += CYCLE_S
    before = one[PHASE]
    if before >= HOLD:
        if slip > high or (slip > 0.5 * high and rate < -9.0):
            one[PHASE] = VENT
        elif before == HOLD and slip < 0.3 * high:
            one[PHASE] = FILL
    elif rate > 0.5 or (slip < 0.5 * high and rate > -0.5):
        one[PHASE] = HOLD
    if one[PHASE] != before:
        one[SINCE] = 0.0
    command = one[PHASE]
    # pulses of 90 ms in 200 ms for 1 s; afterwards open
    if command == FILL and one[SINCE] < 1.0 and one[SINCE] % 0.2 > 0.085:
        command = HOLD
    one[COMMAND] = one[QUEUE]
    for k in range(DEAD_TIME - 1):
        one[QUEUE + k] = one[QUEUE + k + 1]
    one[QUEUE + DEAD_TIME - 1] = command


@njit(cache=True)
def _brake(one, demand, spin, h):
    """Advance cylinder and pads, and the torque at the gauge between caliper and axle."""
    if one[COMMAND] == FILL:
        one[PRESSURE] += (demand - one[PRESSURE]) * (1.0 - math.exp(-h / 0.7))
    elif one[COMMAND] == VENT:
        one[PRESSURE] *= math.exp(-h / 0.18)
    elif demand < one[PRESSURE]:
        one[PRESSURE] += (demand - one[PRESSURE]) * (1.0 - math.exp(-h / 1.0))
    # pads grip less the faster the disc
    pads = one[PRESSURE] * (1.12 - 0.18 * spin / (spin + 60.0)) * min(1.0, spin / 0.5)
    one[TORQUE] += (pads - one[TORQUE]) * (1.0 - math.exp(-h / 0.04))


@njit(cache=True)
def _acting(one, shown, demand, spin, sizes, here):
    """Return the torque that acts where the gauge shows `shown`.

    `here`: this is the wheelset of the effects that act on one.
    """
    acting = shown * (1.0 + sizes[GAIN]) * (1.0 - sizes[FADE] * one[FACE_K] / 100.0)
    if sizes[HYSTERESIS] > 0.0:
        play = 0.5 * sizes[HYSTERESIS] * demand
        one[CLAMP] = min(max(one[CLAMP], acting - play), acting + play)
        acting = one[CLAMP] * math.tanh(shown / (0.05 * demand))
    acting += sizes[OFFSET] * demand * math.tanh(shown / (0.05 * demand))
    if here and sizes[GENERATOR] > 0.0:
        acting += sizes[GENERATOR] / max(spin, 10.0)
    return acting


@njit(cache=True)
def _vary(pads, i, t, v):
    """Return the change of the torque of wheelset i by its pads, as a share."""
    swing = 2.0 * math.pi * t / pads.period_s + pads.phase
    by_speed = pads.by_speed[i] * max(1.0 - v / PAD_SPEED_M_S, -1.0)
    return pads.constant[i] + pads.by_time[i] * math.cos(swing) + by_speed


@njit(cache=True)
def _friction(one, i, t, v, sand, sizes):
    """Return the factor of the hidden effects on the contaminant's friction under wheelset i."""
    factor = ((20.0 + 12.2) / (v + 12.2)) ** (3.22 * sizes[SPEED])
    factor *= 1.0 - sizes[CONDITIONING] * 2.0 * one[SLID_M] / (one[SLID_M] + 100.0)
    factor *= math.exp(sizes[TREND] * (1.0 - math.exp(-t / 7.0)))
    factor *= 1.0 + sizes[CLEANING] * (1.0 - one[SEEN])
    factor *= 1.0 + sizes[SAND] * sand * 0.9**i
    return factor


@njit(cache=True)
def _rotate(one, spin, v, load, torque, mu_cd, radius, inertia, K, sizes, h):
    """Return the mean force of the rail over a step, from linearly implicit parts.

    The magnitude of the adhesion is kept in `one`.
    """
    tau_W = contact.TAU_M_J * one[ENERGY_2] if sizes[MEMORY] > 0.0 else -1.0
    part = h / SUBSTEPS
    w = spin
    slope = 0.0
    for n in range(SUBSTEPS):
        s = v - radius * w
        mu = mu_cd * (1.0 - sizes[FALLING] * s * s / (s * s + 9.0))
        f = contact.adhesion(s, v, load / 2.0, mu, K, tau_W, one[FRICTION])
        one[FRICTION] = abs(f)
        if n == 0:
            ds = 1e-6 * v
            beside = contact.adhesion(s + ds, v, load / 2.0, mu, K, tau_W, one[FRICTION])
            slope = max((beside - f) * load / ds, 0.0)
        w += part * (radius * f * load - torque) / (inertia + part * radius * radius * slope)
    return (inertia * (w - spin) / h + torque) / radius


@njit(cache=True)
def step(
    k,
    h,
    inertias,
    cvel,
    xipos,
    centre,
    xfrc,
    qfrc,
    state,
    trace,
    film,
    sand,
    speed0,
    mu_cd,
    demand_Nm,
    times,
    high,
    factors,
    sizes,
    axle,
    radii,
    inertia,
    K,
    pads,
):
    """Write the forces of step k, and its row of the trace; return False at the end of the stop.

    Parameters
    ----------
    k, h : number of the step, and its length in s
    inertias : masses of the bodies whose momentum counts as the coach's, kg
    cvel, xipos, centre : MuJoCo's speeds and positions of the bodies at the start of the step
    xfrc, qfrc : MuJoCo's external forces at bodies and joints, which are written
    state, trace : see QUEUE and COLUMNS
    film, sand : of each cell of the rail: share that is not cleaned, and sand
    speed0, mu_cd, demand_Nm, high, factors, sizes, axle, radii, inertia : those of `Stop`
    times : of the stop, see BRAKE_FROM
    K : stiffness of the contact, from `mujoco_contact.stiffness`
    pads : a PadVariation
    """
    t = k * h
    # speed of the coach: its momentum over its mass
    momentum = 0.0
    mass = 0.0
    for b in range(1, inertias.shape[0]):
        momentum += inertias[b] * (cvel[b, 3] + cvel[b, 1] * (xipos[b, 2] - centre[2]))
        mass += inertias[b]
    v = momentum / mass
    if v < LAST_M_S:
        return False
    row = trace[k]
    row[TIME] = t
    row[SPEED_M_S] = v
    row[WAY_M] = trace[k - 1, WAY_M] + (v + trace[k - 1, SPEED_M_S]) / 2.0 * h if k else 0.0
    demand = 0.0
    if t >= times[BRAKE_FROM]:
        relief = times[RELIEF_FROM] <= t < times[RELIEF_FROM] + times[RELIEF_FOR]
        demand = demand_Nm * (0.35 if relief else 1.0)
    front = int((row[WAY_M] + BEHIND_M) / CELL_M)
    if sizes[SAND] > 0.0:
        # through a hose with a lag of 0.6 s; sand falls 0.4 m ahead of the first wheel
        on = max(t - times[SAND_FROM], 0.0)
        off = max(t - times[SAND_TO], 0.0)
        sand[front + 2] = math.exp(-off / 0.6) - math.exp(-on / 0.6)
    protect = k % round(CYCLE_S / h) == 0
    for i in range(4):
        one = state[i]
        b = WHEELS[i]
        spin = cvel[b, 1]
        vx = cvel[b, 3] + spin * (xipos[b, 2] - centre[2])
        vz = cvel[b, 5] - spin * (xipos[b, 0] - centre[0])
        # the rail under the wheel, and its load
        rise = 0.0
        climb = 0.0
        if sizes[WAVES] > 0.0:
            wave = 2.0 * math.pi / 9.0
            rise = sizes[WAVES] * (
                math.sin(wave * (row[WAY_M] - POSITIONS_M[i])) + math.sin(wave * POSITIONS_M[i])
            )
            climb = sizes[WAVES] * wave * v * math.cos(wave * (row[WAY_M] - POSITIONS_M[i]))
        still = mass * G_M_S2 / 4.0
        load = max(
            one[LOAD] - RAIL_N_M * (xipos[b, 2] - RADIUS_M - rise) - RAIL_N_S_M * (vz - climb), 0.0
        )
        # an unbalanced wheel presses on the rail once per turn
        swing = 0.0
        if sizes[ROUND] > 0.0 and i == axle:
            swing = sizes[ROUND] * still * math.sin(one[ANGLE] + 1.0)
        if protect:
            one[SPIN_RATE] += 0.4 * ((spin - one[SPIN_BEFORE]) / CYCLE_S - one[SPIN_RATE])
            one[SPIN_BEFORE] = spin
            _protect(one, v, radii[i], high[i])
        row[SPINS + i] = spin
        row[LOADS + i] = load + swing
        row[TORQUES + i] = one[TORQUE]
        row[SWINGS + i] = swing
        row[ANGLES + i] = one[ANGLE]
        # the torque of the step is the mean of its start and its end
        shown = one[TORQUE]
        _brake(one, demand, spin, h)
        torque = _acting(one, (shown + one[TORQUE]) / 2.0, demand_Nm, spin, sizes, i == axle)
        torque *= 1.0 + _vary(pads, i, t, v)
        # the wheelset between brake and rail
        cell = int((row[WAY_M] - POSITIONS_M[i] + BEHIND_M) / CELL_M)
        if cell != one[CELL]:
            one[CELL] = cell
            one[SEEN] = film[cell]
        mu = mu_cd * factors[i, cell] * _friction(one, i, t, v, sand[cell], sizes)
        # a layer of constant thickness yields in addition to the patch, which yields with its
        # length, N^(1/3)
        soft = 1.0 + sizes[LAYER] / (1.0 - sizes[LAYER]) * (still / (load + 1.0)) ** (1.0 / 3.0)
        force = _rotate(
            one, spin, vx, load + swing, torque, mu, radii[i], inertia, K / soft, sizes, h
        )
        row[FORCES + i] = force
        xfrc[b, 0] = -force
        xfrc[b, 2] = load
        xfrc[b, 4] = radii[i] * force
        qfrc[SPIN_JOINTS[i]] = -torque
        # what sliding leaves behind
        slid = max(vx - radii[i] * spin, 0.0)
        W = abs(force) / 2.0 * slid / vx
        if sizes[MEMORY] > 0.0:
            kept = math.exp(-v * h / (sizes[MEMORY] / 2.0))
            one[ENERGY_1] = W + (one[ENERGY_1] - W) * kept
            one[ENERGY_2] = one[ENERGY_1] + (one[ENERGY_2] - one[ENERGY_1]) * kept
        film[cell] *= math.exp(-W / 250.0 * v * h / CELL_M)
        one[SLID_M] += slid * h
        one[ANGLE] += spin * h
        # disc: 25 kJ/K at its face, from which 3 kW/K flow into 90 kJ/K behind it
        inward = 3e3 * (one[FACE_K] - one[BULK_K])
        one[FACE_K] += h * (torque * spin - inward) / 2.5e4
        one[BULK_K] += h * inward / 9e4
    drag = (
        RESISTANCE_N
        + RESISTANCE_N_S2_M2 * v * v
        + sizes[RESISTANCE] * 2.0 * v / (speed0 + LAST_M_S)
    )
    drag += sizes[SURGE] * math.sin(2.2 * t + 0.4 * math.sin(0.5 * t))
    xfrc[BODY, 0] = -drag
    return True


def run(stop: Stop, step_s: float = STEP_S) -> np.ndarray:
    """Return the trace of a stop until LAST_M_S, shape (steps, COLUMNS).

    Loads are those in the contact, and torques those at the gauge.
    """
    coach = model(stop, step_s)
    data = mujoco.MjData(coach)
    data.qvel[0] = stop.speed_m_s
    for joint, radius in zip(SPIN_JOINTS, stop.radii_m, strict=True):
        data.qvel[joint] = stop.speed_m_s / radius
    state = np.zeros((4, QUEUE + DEAD_TIME))
    state[:, QUEUE:] = FILL
    state[:, COMMAND] = FILL
    state[:, PHASE] = FILL
    state[:, SINCE] = 9.0  # longer than the pulses
    state[:, SPIN_BEFORE] = stop.speed_m_s / stop.radii_m
    state[:, FRICTION] = 0.1
    state[:, SEEN] = 1.0
    state[:, LOAD] = stop.mass_kg * G_M_S2 / 4.0
    cells = stop.factors.shape[1]
    film = np.ones(cells)
    sand = np.zeros(cells)
    trace = np.zeros((int(LONGEST_S / step_s), COLUMNS))
    masses = coach.body_mass.copy()
    if stop.sloshing:
        masses[-1] = 0.0
    times = np.array([stop.begin_s, *stop.relief_s, *stop.sand_s])
    K = contact.stiffness(RADIUS_M, stop.roller_1_m)
    seen = (
        masses,
        data.cvel,
        data.xipos,
        data.subtree_com[BODY],
        data.xfrc_applied,
        data.qfrc_applied,
    )
    rest = (
        state,
        trace,
        film,
        sand,
        stop.speed_m_s,
        stop.mu_cd,
        stop.demand_Nm,
        times,
        stop.high,
        stop.factors,
        stop.sizes,
        stop.axle,
        stop.radii_m,
        stop.inertia_kgm2,
        K,
        stop.pads,
    )
    k = 0
    while True:
        mujoco.mj_step1(coach, data)
        if not step(k, step_s, *seen, *rest):
            return trace[:k]
        if stop.gradient:
            # the slope of the track varies over 200 m
            slope = stop.gradient * (1.0 + 0.5 * math.sin(trace[k, WAY_M] * 2.0 * math.pi / 200.0))
            coach.opt.gravity[0] = -slope * G_M_S2
        mujoco.mj_step2(coach, data)
        k += 1


def four(trace: np.ndarray, first: int) -> np.ndarray:
    """Return the four columns of the wheelsets from `first` on, shape (steps, 4)."""
    end = first + 4
    return trace[:, first:end]
