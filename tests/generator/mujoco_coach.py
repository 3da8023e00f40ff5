"""The UIC-Z1 coach as MuJoCo bodies, and one stop of it; for `mujoco_stops`.

Planar: the body moves along, up and in pitch; each bogie hangs in it by a vertical slide (secondary suspension) and a
hinge (its pitch, at the pivot's height), each wheelset in its bogie by a slide (primary suspension) and its axle.
Masses and springs: the paper's Tables 1 to 3, heights: configs/vehicles/uic_z1.toml, dampers and rail: assumptions.
Load transfer, pitch and bounce come from MuJoCo's own equations and its semi-implicit Euler integrator.

Forces go to MuJoCo each step: at each wheelset the contact (vertical spring and damper of the rail; adhesion along it),
the brake's torque between wheelset and bogie, resistance at the body. Creep is stiff (up to 5000 1/s at 4 m/s), so each
wheelset's rotation is first carried through the step in SUBSTEPS linearly implicit parts at the step's load and
speed; the mean of the force over them is what MuJoCo applies, so that its rotation ends where the parts ended and the
momentum that the rail takes is what the coach loses.

Signs: x ahead, z up, rotations about y: a wheel that rolls ahead turns positively, braking pitches the nose down.
"""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numba import njit

from . import mujoco_contact as contact

G_M_S2 = 9.81
MASS_KG, BOGIE_KG, WHEELSET_KG, AXLE_KGM2 = 43000.0, 3000.0, 1820.0, 160.0
RADIUS_M, WHEELBASE_M, PIVOTS_M, BODY_M, BOGIE_M, PIVOT_M = 0.445, 2.56, 19.0, 1.8, 0.6, 0.9
RESISTANCE_N, RESISTANCE_N_S2_M2 = 600.0, 0.9375
PRIMARY_N_M, PRIMARY_N_S_M, SECONDARY_N_M, SECONDARY_N_S_M = (
    1.58e6,
    1.6e4,
    6.8e5,
    4.0e4,
)  # of a wheelset, of a bogie
RAIL_N_M, RAIL_N_S_M = 2.0e8, 2.0e5  # of a wheelset: contact on a rail on its pads and ballast
POSITIONS_M = (
    0.0,
    WHEELBASE_M,
    PIVOTS_M,
    PIVOTS_M + WHEELBASE_M,
)  # of wheelsets, behind the first wheelset
STEP_S, SUBSTEPS, CELL_M = 5e-4, 4, 0.2
LAST_M_S = 4.1
DEAD_TIME = 3  # protection cycles from its command to the valve
CYCLE_S = 0.01

# what is hidden and acts while a stop runs: its place in the array of sizes
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

# state of an axle that MuJoCo does not have
(
    PRESSURE,
    TORQUE,
    FRICTION,
    ENERGY_1,
    ENERGY_2,
    SLID_M,
    BULK_K,
    FACE_K,
    CLAMP,
    PHASE,
    SPIN_BEFORE,
    SPIN_RATE,
    SINCE,
    COMMAND,
    ANGLE,
    LOAD,
    CELL,
    SEEN,
) = range(18)
QUEUE = 18  # commands on their way to the valve follow
VENT, HOLD, FILL = -1.0, 0.0, 1.0

# columns of a trace; from SPINS on four each
(TIME, SPEED_M_S, WAY_M), SPINS, LOADS, TORQUES, FORCES, SWINGS, ANGLES = (
    range(3),
    3,
    7,
    11,
    15,
    19,
    23,
)
COLUMNS = 27


class Stop(NamedTuple):
    """What a stop starts from, and what is told to nobody."""

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


def model(stop: Stop, step_s: float) -> mujoco.MjModel:
    """At rest on the level rail where all coordinates are 0."""
    tank = stop.sloshing * MASS_KG
    body = stop.mass_kg - tank - 2 * BOGIE_KG - 4 * WHEELSET_KG

    def spring(stiff: float, damping: float, load_N: float) -> str:
        return f'type="slide" axis="0 0 1" stiffness="{stiff}" damping="{damping}" springref="{-load_N / stiff!r}"'

    def bogie(x: float) -> str:
        above_N = (body + tank) * G_M_S2 / 2.0
        primary = spring(PRIMARY_N_M, PRIMARY_N_S_M, (above_N + BOGIE_KG * G_M_S2) / 2.0)
        wheelsets = "".join(
            f'<body pos="{side * WHEELBASE_M / 2} 0 {RADIUS_M - PIVOT_M}"><joint {primary}/>'
            f'<joint type="hinge" axis="0 1 0"/><inertial pos="0 0 0" mass="{WHEELSET_KG}" '
            f'diaginertia="800 {stop.inertia_kgm2!r} 800"/></body>'
            for side in (1, -1)
        )
        return (
            f'<body pos="{x} 0 {PIVOT_M - BODY_M}"><joint {spring(SECONDARY_N_M, SECONDARY_N_S_M, above_N)}/>'
            f'<joint type="hinge" axis="0 1 0"/><inertial pos="0 0 {BOGIE_M - PIVOT_M}" mass="{BOGIE_KG}" '
            f'diaginertia="2400 1900 4000"/>{wheelsets}</body>'
        )

    slosh = (
        (
            f'<body><joint type="slide" axis="1 0 0" stiffness="{tank * 2.2**2}" damping="{tank * 0.15}"/>'
            f'<inertial pos="0 0 0" mass="{tank}" diaginertia="500 500 500"/></body>'
        )
        if tank
        else ""
    )
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{step_s}" integrator="Euler" gravity="0 0 {-G_M_S2}"/><worldbody>'
        f'<body pos="0 0 {BODY_M}"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
        f'<joint type="hinge" axis="0 1 0"/><inertial pos="0 0 0" mass="{body!r}" diaginertia="76400 1494400 1467160"/>'
        f"{bogie(PIVOTS_M / 2)}{bogie(-PIVOTS_M / 2)}{slosh}</body></worldbody></mujoco>"
    )


BODY, WHEELS, SPIN_JOINTS = (
    1,
    np.array([3, 4, 6, 7]),
    np.array([6, 8, 12, 14]),
)  # as MuJoCo numbers them: XZP SH SH SH


@njit(cache=True)
def _protect(one, speed_m_s, radius_m, high):
    """One cycle of the wheelset's slide protection: vent what slides deep or runs away, hold, then fill in pulses."""
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
    """Cylinder, pads; the torque that the gauge between caliper and axle tells, at the end of the step."""
    if one[COMMAND] == FILL:
        one[PRESSURE] += (demand - one[PRESSURE]) * (1.0 - math.exp(-h / 0.7))
    elif one[COMMAND] == VENT:
        one[PRESSURE] *= math.exp(-h / 0.18)
    elif demand < one[PRESSURE]:
        one[PRESSURE] += (demand - one[PRESSURE]) * (1.0 - math.exp(-h / 1.0))
    # pads grip less the faster the disc
    asked = one[PRESSURE] * (1.12 - 0.18 * spin / (spin + 60.0)) * min(1.0, spin / 0.5)
    one[TORQUE] += (asked - one[TORQUE]) * (1.0 - math.exp(-h / 0.04))


@njit(cache=True)
def _acting(one, told, demand, spin, sizes, here):
    """The torque that acts where the gauge tells `told`."""
    acting = told * (1.0 + sizes[GAIN]) * (1.0 - sizes[FADE] * one[FACE_K] / 100.0)
    if sizes[HYSTERESIS] > 0.0:
        play = 0.5 * sizes[HYSTERESIS] * demand
        one[CLAMP] = min(max(one[CLAMP], acting - play), acting + play)
        acting = one[CLAMP] * math.tanh(told / (0.05 * demand))
    acting += sizes[OFFSET] * demand * math.tanh(told / (0.05 * demand))
    if here and sizes[GENERATOR] > 0.0:
        acting += sizes[GENERATOR] / max(spin, 10.0)
    return acting


@njit(cache=True)
def _friction(one, i, t, v, sand, sizes):
    """Factor of the contaminant's friction from what goes on in the stop."""
    factor = ((20.0 + 12.2) / (v + 12.2)) ** (3.22 * sizes[SPEED])
    factor *= 1.0 - sizes[CONDITIONING] * 2.0 * one[SLID_M] / (one[SLID_M] + 100.0)
    factor *= math.exp(sizes[TREND] * (1.0 - math.exp(-t / 7.0)))
    factor *= 1.0 + sizes[CLEANING] * (1.0 - one[SEEN])
    factor *= 1.0 + sizes[SAND] * sand * 0.9**i
    return factor


@njit(cache=True)
def _rotate(one, spin, v, load, torque, mu_cd, radius, inertia, K, sizes, h):
    """Mean force of the rail over a step, from linearly implicit parts; keeps the adhesion in `one`."""
    tau_W = contact.TAU_M_J * one[ENERGY_2] if sizes[MEMORY] > 0.0 else -1.0
    part, w, slope = h / SUBSTEPS, spin, 0.0
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
):
    """Forces of step k from the positions and speeds that MuJoCo has at its beginning; its trace. False: the end.

    inertias: masses of the bodies whose momentum counts as the coach's (kg). times: begin, relief from and for, sand
    from and to (s).
    """
    t = k * h
    momentum = mass = 0.0
    for b in range(1, inertias.shape[0]):
        momentum += inertias[b] * (cvel[b, 3] + cvel[b, 1] * (xipos[b, 2] - centre[2]))
        mass += inertias[b]
    v = momentum / mass
    if v < LAST_M_S:
        return False
    row = trace[k]
    row[TIME], row[SPEED_M_S] = t, v
    row[WAY_M] = trace[k - 1, WAY_M] + (v + trace[k - 1, SPEED_M_S]) / 2.0 * h if k else 0.0
    demand = 0.0
    if t >= times[0]:
        demand = demand_Nm * (0.35 if times[1] <= t < times[1] + times[2] else 1.0)
    front = int((row[WAY_M] + 40.0) / CELL_M)
    if sizes[SAND] > 0.0:
        # a hose of 0.6 s; it falls 0.4 m ahead of the first wheel
        on, off = max(t - times[3], 0.0), max(t - times[4], 0.0)
        sand[front + 2] = math.exp(-off / 0.6) - math.exp(-on / 0.6)
    protect = k % round(CYCLE_S / h) == 0
    for i in range(4):
        one, b = state[i], WHEELS[i]
        spin = cvel[b, 1]
        vx = cvel[b, 3] + spin * (xipos[b, 2] - centre[2])
        vz = cvel[b, 5] - spin * (xipos[b, 0] - centre[0])
        # the rail under the wheel, and its load
        rise = climb = 0.0
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
        # an unbalanced wheel presses on the rail once a turn
        swing = 0.0
        if sizes[ROUND] > 0.0 and i == axle:
            swing = sizes[ROUND] * still * math.sin(one[ANGLE] + 1.0)
        if protect:
            one[SPIN_RATE] += 0.4 * ((spin - one[SPIN_BEFORE]) / CYCLE_S - one[SPIN_RATE])
            one[SPIN_BEFORE] = spin
            _protect(one, v, radii[i], high[i])
        row[SPINS + i], row[LOADS + i], row[TORQUES + i] = spin, load + swing, one[TORQUE]
        row[SWINGS + i], row[ANGLES + i] = swing, one[ANGLE]
        told = one[TORQUE]
        _brake(one, demand, spin, h)
        torque = _acting(one, (told + one[TORQUE]) / 2.0, demand_Nm, spin, sizes, i == axle)
        # the wheelset between brake and rail
        cell = int((row[WAY_M] - POSITIONS_M[i] + 40.0) / CELL_M)
        if cell != one[CELL]:
            one[CELL], one[SEEN] = cell, film[cell]
        mu = mu_cd * factors[i, cell] * _friction(one, i, t, v, sand[cell], sizes)
        # a layer of constant thickness yields beside the patch, which yields with its length, N^(1/3)
        soft = 1.0 + sizes[LAYER] / (1.0 - sizes[LAYER]) * (still / (load + 1.0)) ** (1.0 / 3.0)
        force = _rotate(
            one, spin, vx, load + swing, torque, mu, radii[i], inertia, K / soft, sizes, h
        )
        row[FORCES + i] = force
        xfrc[b, 0], xfrc[b, 2], xfrc[b, 4] = -force, load, radii[i] * force
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
        # disc: 25 kJ/K at its face, 3 kW/K into 90 kJ/K behind
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
    """(steps, COLUMNS) of the stop until LAST_M_S; loads are those in the contact, torques those of the gauge."""
    coach = model(stop, step_s)
    data = mujoco.MjData(coach)
    data.qvel[0] = stop.speed_m_s
    for joint, radius in zip(SPIN_JOINTS, stop.radii_m, strict=True):
        data.qvel[joint] = stop.speed_m_s / radius
    state = np.zeros((4, QUEUE + DEAD_TIME))
    state[:, QUEUE:], state[:, COMMAND], state[:, PHASE], state[:, SINCE] = FILL, FILL, FILL, 9.0
    state[:, SPIN_BEFORE], state[:, FRICTION], state[:, SEEN] = (
        stop.speed_m_s / stop.radii_m,
        0.1,
        1.0,
    )
    state[:, LOAD] = stop.mass_kg * G_M_S2 / 4.0
    film, sand = np.ones(stop.factors.shape[1]), np.zeros(stop.factors.shape[1])
    trace = np.zeros((int(150.0 / step_s), COLUMNS))
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
    )
    k = 0
    while True:
        mujoco.mj_step1(coach, data)
        if not step(k, step_s, *seen, *rest):
            return trace[:k]
        if stop.gradient:
            # the track's slope swells and ebbs over 200 m
            slope = stop.gradient * (1.0 + 0.5 * math.sin(trace[k, WAY_M] * 2.0 * math.pi / 200.0))
            coach.opt.gravity[0] = -slope * G_M_S2
        mujoco.mj_step2(coach, data)
        k += 1


def four(trace: np.ndarray, first: int) -> np.ndarray:
    """(steps, 4) of a trace: the columns of the wheelsets from this one on."""
    end = first + 4
    return trace[:, first:end]
