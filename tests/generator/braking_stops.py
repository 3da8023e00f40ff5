"""Braking stops with hidden causes, by the first author. Shares no code with the rig.

A coach with four wheelsets brakes on a contaminated rail. A simple WSP pumps the brake. The base is
the adhesion law of the paper [B1..B5] with the measured quantities of a dataset. Hidden causes have
other forms here than in the rig's table of mechanisms: a rational law instead of an exponential
one, time instead of distance, a bell instead of a window. So a test of naming is not a test of
copying.

Symbols: v speed of the coach in m/s, omega rotation of a wheelset in rad/s, s sliding in m/s, N
load of a wheelset in N, C brake torque in N m, f adhesion, place a distance along the rail in m.

    [B1] f(s) = 2 mu / pi (k_A eps / (1 + (k_A eps)^2) + atan(k_S eps)),  eps = stiff creep / mu
    [B2] mu(s) = mu_c + (mu_c / A - mu_c) exp(-gamma s)
    [B3] stiff = pi / 4 G (c11 a b) / N: creep stiffness of one wheel, c11 a b grows as N^(2/3)
    [B4] f = (1 - lambda) f_d + lambda f_r,  lambda = 1 - exp(-tau W), W = f N creep of one wheel
    [B5] J domega/dt = r N f - C;  M dv/dt = -(sum of forces between wheels and rail) - resistance

Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014) 919-937. The causes are inventions.
"""

import math
from pathlib import Path

import numba
import numpy as np

AXLES = 4
# distance of each wheelset behind the first, m
PLACES = np.array([0.0, 2.56, 19.0, 21.56])
RADIUS = 0.445  # m
INERTIA = 160.0  # kg m2
GRAVITY = 9.80665  # m/s2
SHEAR_PA = 8.0e10
TAU_M_J = 1.9e-4
# running resistance: N, and N s2/m2
RESISTANCE_A = 600.0
RESISTANCE_C = 0.9375
# step of the simulation in s, and steps from one written row to the next
STEP_S = 0.0005
STEPS_PER_ROW = 2
ROW_S = STEP_S * STEPS_PER_ROW
# a sensor samples every tenth row
ROWS_PER_SAMPLE = 10
LONGEST_ROWS = 90000
# the stop is recorded down to this speed
LAST_M_S = 4.0

# the rail is stored from this far behind the start of the first wheelset, in cells of a quarter
# metre; the work of the wheels is stored in cells of one metre
BEHIND_M = 60.0
CELLS_PER_M = 4.0
RAIL_M = 2000.0
WORK_CELLS = 4000

# what may be hidden, in the order of the vector of effects e
EFFECTS = (
    "rail_cleaning",
    "adhesion_memory",
    "speed_dependent_friction",
    "negative_conditioning",
    "contaminated_patch",
    "friction_trend",
    "brake_gain",
    "pad_fade",
    "torque_offset",
    "running_resistance",
    "track_gradient",
    "wheel_radius",
    "wheel_inertia",
    "speed_sensor_delay",
    "torque_sensor_delay",
    "wheel_out_of_round",
    "load_transfer",
    "sanding",
    "roller_curvature",
    "interfacial_layer",
    "falling_friction",
    # not in the rig's table of causes
    "load_exponent",
    "joints",
    "sticky_turn",
    "late_axle",
    "sliding_resonance",
)
INDEX = {name: i for i, name in enumerate(EFFECTS)}
(
    CLEANING,
    MEMORY,
    SPEED,
    CONDITIONING,
    PATCH,
    TREND,
    GAIN,
    FADE,
    OFFSET,
    DRAG,
    GRADIENT,
    WHEEL_RADIUS,
    WHEEL_INERTIA,
    SPEED_DELAY,
    TORQUE_DELAY,
    OUT_OF_ROUND,
    TRANSFER,
    SAND,
    CURVATURE,
    LAYER,
    FALLING,
    LOAD_EXPONENT,
    JOINTS,
    STICKY_TURN,
    LATE_AXLE,
    RESONANCE,
) = range(len(EFFECTS))
# behind the effects, e has c11 a b of the contact over N^(2/3), and one place that is not used
CONTACT = len(EFFECTS)
PLACES_OF_E = len(EFFECTS) + 2

# the smallest size of each cause that can be seen in six stops, in the unit of its formula
SMALLEST = {
    "rail_cleaning": 0.06,
    "adhesion_memory": 2.0,
    "speed_dependent_friction": 0.06,
    "negative_conditioning": 0.12,
    "contaminated_patch": 0.07,
    "friction_trend": 0.12,
    "brake_gain": 0.04,
    "pad_fade": 0.0015,
    "torque_offset": 90.0,
    "running_resistance": 250.0,
    "track_gradient": 0.0008,
    "wheel_radius": 0.0008,
    "wheel_inertia": 0.12,
    "speed_sensor_delay": 0.010,
    "torque_sensor_delay": 0.012,
    "wheel_out_of_round": 0.013,
    "load_transfer": 0.014,
    "sanding": 0.08,
    "roller_curvature": 0.45,
    "interfacial_layer": 0.45,
    "falling_friction": 0.25,
}
# size of each effect that is not in the rig's table of causes
UNKNOWN = {
    "load_exponent": 1.0,
    "joints": 0.08,
    "sticky_turn": 0.08,
    "late_axle": 0.06,
    "sliding_resonance": 0.06,
}
# sizes beyond which an effect has no physical meaning
LARGEST: dict[str, float] = {}
# causes whose size has the meaning of a parameter in the rig's table: (parameter, sign)
SAME_MEANING = {
    "brake_gain": ("gain", 1.0),
    "wheel_radius": ("fraction", 1.0),
    "wheel_inertia": ("fraction", 1.0),
    "speed_sensor_delay": ("delay_s", 1.0),
    "torque_sensor_delay": ("delay_s", 1.0),
    "wheel_out_of_round": ("amplitude", 1.0),
    "torque_offset": ("offset_Nm", 1.0),
    "track_gradient": ("gradient", 1.0),
    "roller_curvature": ("stiffness_fraction", 1.0),
    "interfacial_layer": ("reduction", 1.0),
    "falling_friction": ("fraction", 1.0),
}
# pairs of causes that are hidden together, at twice their smallest sizes
PAIRS = tuple(
    {name: 2.0 * SMALLEST[name] for name in pair}
    for pair in (
        ("rail_cleaning", "running_resistance"),
        ("brake_gain", "friction_trend"),
        ("wheel_radius", "adhesion_memory"),
        ("pad_fade", "rail_cleaning"),
        ("torque_sensor_delay", "contaminated_patch"),
        ("load_transfer", "running_resistance"),
    )
)

# columns of the rows that `stop` writes; wheel speeds, loads and torques have four each
ROW_SPEED = 0
ROW_WHEELS = 1
ROW_LOADS = 5
ROW_TORQUES = 9
ROW_PLACE = 13
ROW_COLUMNS = 14

# state of the valve of a wheelset
FILL = 0
HOLD = 1
VENT = 2
# steps from one cycle of the WSP to the next: 10 ms
STEPS_PER_CYCLE = 20


# --- adhesion ---


@numba.njit(cache=True)
def polach(sliding, creepage, stiff, mu_c, A, gamma, k_a, k_s, rational):
    """Return the adhesion [B1] of a creep curve; `stiff` is eps mu / creepage [B3]."""
    slow = math.exp(-gamma * sliding)
    mu = mu_c + (mu_c / A - mu_c) * slow * rational  # [B2]
    eps = stiff * creepage / mu
    part = k_a * eps / (1.0 + (k_a * eps) ** 2) + math.atan(k_s * eps)
    return 2.0 * mu / math.pi * part


@numba.njit(cache=True)
def limits(s, v, N, mu_cd, scale, e):
    """Return (degraded, recovered) adhesion of one wheel under N at sliding s >= 0.

    `scale` multiplies the friction of both.
    """
    creep = s / max(v, 0.1)
    stiff = (
        0.25 * math.pi * SHEAR_PA * e[CONTACT] * N ** (-1.0 / 3.0) * (1.0 + e[CURVATURE])
    )  # [B3]
    gamma = 1.0 + e[FALLING]
    soft = 1.0 - e[LAYER]
    bump = 1.0 + e[RESONANCE] * math.sin(2.5 * s)
    f_d = polach(s, creep, stiff, mu_cd * scale * bump, 0.4, 0.2 * gamma, 0.3 * soft, 0.1, 1.0)
    f_r = polach(s, creep, stiff, 0.28 * scale * bump, 0.4, 0.6 * gamma, 1.0 * soft, 0.4, 1.0)
    return f_d, f_r


@numba.njit(cache=True)
def adhesion(s, v, N, mu_cd, scale, e):
    """Return (f, lambda) of one wheel without memory [B4], by Newton's method from above."""
    f_d, f_r = limits(s, v, N, mu_cd, scale, e)
    k = TAU_M_J * N * s / max(v, 0.1)
    f = f_r
    for _ in range(8):
        x = math.exp(-k * f)
        f -= (f - f_r + (f_r - f_d) * x) / (1.0 - (f_r - f_d) * k * x)
    return f, 1.0 - math.exp(-k * f)


# --- one stop ---


@numba.njit(cache=True)
def stop(v0, mass, mu_cd, most, e, rail, own, positions, sand_s, patch_m, axle, step, every, out):
    """Simulate one stop, and return the number of rows that are written.

    Parameters
    ----------
    v0, mass : initial speed (m/s), true mass (kg)
    mu_cd : friction of the contaminant, before all effects
    most : torque of a full brake on a wheelset, Nm
    e : sizes of the effects, and the contact (see CONTACT)
    rail, own : ln of the friction's irregularity along the rail (cells,), and for each wheelset
        (AXLES, cells)
    positions : of the wheelsets behind the first, m
    sand_s, patch_m : when sand is used, where the middle of the patch is
    axle : the wheelset of the effects that act on one
    step, every : step in s, and steps per row
    out : rows (speed, wheel speeds, loads, torques, place), see ROW_SPEED
    """
    v = v0
    x = 0.0
    t = 0.0
    omega = np.full(4, v0 / RADIUS)
    if e[WHEEL_RADIUS] != 0.0:
        omega[axle] /= 1.0 + e[WHEEL_RADIUS]
    pressure = np.zeros(4)  # torque that the brake would hold, Nm
    late = np.zeros(4)  # lambda with memory
    heat = np.zeros(4)  # of the disc, MJ
    spent = np.zeros(4)  # distance that the wheelset has slid, m
    angle = np.zeros(4)  # that the wheelset has turned, rad
    state = np.zeros(4, dtype=np.int64)  # of the valve
    before = np.zeros(4)  # sliding at the last cycle of the WSP, m/s
    work = np.zeros((4, WORK_CELLS))  # that each wheelset has done on each metre, J/m
    turning = np.zeros(4)  # smoothed deceleration of the tread, m/s2
    static = mass * GRAVITY / 4.0
    a = 0.0  # smoothed deceleration of the coach, m/s2
    rows = 0
    for k in range(out.shape[0] * every):
        demand = most if t > 1.0 else 0.0
        # resistance, and then the forces of the wheels, N
        force = (
            RESISTANCE_A
            + RESISTANCE_C * v * v
            + e[DRAG] * (0.6 + 0.4 * (v / 25.0) ** 2)
            + e[GRADIENT] * mass * GRAVITY
        )
        for j in range(4):
            r = RADIUS * (1.0 + (e[WHEEL_RADIUS] if j == axle else 0.0))
            inertia = INERTIA * (1.0 + e[WHEEL_INERTIA])
            s = v - r * omega[j]

            # the WSP vents while sliding is large and grows, holds while it shrinks, then fills
            if k % STEPS_PER_CYCLE == 0:
                growing = s - before[j]
                before[j] = s
                top = 0.085 * v + 0.7
                if s > top and growing > 0.0:
                    state[j] = VENT
                elif s < 0.45 * top:
                    state[j] = FILL
                elif growing < 0.0:
                    state[j] = HOLD
            if state[j] == FILL:
                pressure[j] += (demand - pressure[j]) * step / 0.7
            elif state[j] == VENT:
                pressure[j] -= pressure[j] * step / 0.35

            # load: the sensors see `shown`, and the contact has N
            pitch = (1.0 if j < 2 else -1.0) * 0.0116 + (1.0 if j % 2 == 0 else -1.0) * 0.0116
            shown = static * (1.0 + pitch * a)
            N = shown * (
                1.0
                + e[TRANSFER]
                * a
                * ((1.0 if j < 2 else -1.0) * 0.6 + (1.0 if j % 2 == 0 else -1.0) * 0.4)
            )
            if j == axle:
                N *= 1.0 + e[OUT_OF_ROUND] * math.sin(angle[j] + 0.7)

            # friction at this place: irregularity, and the hidden effects
            place = x - positions[j]
            cell = min(max(int((place + BEHIND_M) * CELLS_PER_M), 0), rail.size - 2)
            irregular = math.exp(rail[cell] + own[j, cell])
            scale = 1.0
            if e[CLEANING] != 0.0:
                # the wheelsets in front have cleaned this metre, by a rational law
                total = 0.0
                at = min(max(int(place + BEHIND_M), 0), WORK_CELLS - 1)
                for i in range(j):
                    total += work[i, at]
                scale *= 1.0 + 2.0 * e[CLEANING] * total / (total + 350.0)
            # by speed, relative to 20 m/s: the formula of Curtius and Kniffler (km/h)
            scale *= ((7.5 / (3.6 * 20.0 + 44.0) + 0.161) / (7.5 / (3.6 * v + 44.0) + 0.161)) ** (
                -e[SPEED] * 4.0
            )
            scale /= 1.0 + e[CONDITIONING] * spent[j] / 60.0
            scale *= 1.0 - e[PATCH] * math.exp(-(((place - patch_m) / 45.0) ** 2))
            scale *= math.exp(-e[TREND] * (1.0 - math.exp(-t / 12.0)))
            if sand_s < t < sand_s + 7.0 and j > 0:
                scale *= 1.0 + e[SAND] * math.sin(math.pi * (t - sand_s) / 7.0) ** 0.5
            scale *= (N / 105000.0) ** (-e[LOAD_EXPONENT] * 0.5)
            scale *= 1.0 - e[JOINTS] * (math.sin(2.0 * math.pi * place / 30.0) > 0.6)
            scale *= 1.0 - e[STICKY_TURN] * math.tanh(turning[j] / 2.0)
            if j == axle:
                scale *= 1.0 - e[LATE_AXLE] * (t > 0.4 * 20.0)

            # adhesion of one wheel, odd in the sliding
            if s >= 0.0:
                f, now = adhesion(s, v, 0.5 * N, mu_cd, scale, e)
            else:
                f, now = adhesion(-s, v, 0.5 * N, mu_cd, scale, e)
                f = -f
            if e[MEMORY] > 0.0:
                # lambda lags in time; 22 m/s turns the size into a distance
                f_d, f_r = limits(abs(s), v, 0.5 * N, mu_cd, scale, e)
                late[j] += (now - late[j]) * step / (e[MEMORY] / 22.0)
                f = math.copysign(f_d + (f_r - f_d) * late[j], s)

            # rotation [B5], by a linearly implicit step with the local slope of f
            ds = 1e-4 + 1e-4 * abs(s)
            f1, _ = adhesion(abs(s), v, 0.5 * N, mu_cd, scale, e)
            f2, _ = adhesion(abs(s) + ds, v, 0.5 * N, mu_cd, scale, e)
            slope = max((f2 - f1) / ds, 0.0)
            T = N * f * irregular
            C0 = pressure[j]  # as recorded
            C = C0 * (1.0 + e[GAIN]) / (1.0 + e[FADE] * heat[j]) + e[OFFSET] * (C0 > 200.0)
            acceleration = (r * T - C) / inertia
            change = step * acceleration / (1.0 + step * r * r * N * slope * irregular / inertia)
            omega[j] = max(omega[j] + change, 0.0)

            turning[j] += (change / step * -r - turning[j]) * step / 0.1
            angle[j] += omega[j] * step
            force += (C + inertia * change / step) / r
            heat[j] += (C * omega[j] / 1e6 - heat[j] / 300.0) * step
            spent[j] += abs(s) * step
            at = min(max(int(place + BEHIND_M), 0), WORK_CELLS - 1)
            work[j, at] = max(work[j, at], abs(f) * 0.5 * N * abs(s) / max(v, 0.1))
            if k % every == 0:
                # as at the start of this step
                out[rows, ROW_WHEELS + j] = omega[j] - change
                out[rows, ROW_LOADS + j] = shown
                out[rows, ROW_TORQUES + j] = C0

        if k % every == 0:
            out[rows, ROW_SPEED] = v
            out[rows, ROW_PLACE] = x
            rows += 1
            if v < LAST_M_S:
                return rows
        a += (force / mass - a) * step / 0.1
        v -= step * force / mass
        x += step * v
        t += step
    return rows


# --- sets ---


def irregularity(rng: np.random.Generator, metres: float) -> np.ndarray:
    """Return ln of a friction's irregularity: a Gaussian field in cells of a quarter metre.

    Its correlation falls to 1/e in 8 m. Its deviation is 1.6 %, so rail and wheelset together have
    2.3 %.
    """
    cells = int(metres * CELLS_PER_M)
    keep = math.exp(-0.25 / 8.0)
    out = np.empty(cells)
    out[0] = rng.normal()
    for i in range(1, cells):
        out[i] = keep * out[i - 1] + math.sqrt(1.0 - keep * keep) * rng.normal()
    return 0.016 * out


def delayed(values: np.ndarray, fine_s: float, delay_s: float) -> np.ndarray:
    """Return values(t - delay) on the same grid of `fine_s`; the first value is repeated."""
    shift = round(delay_s / fine_s)
    first = np.repeat(values[:1], max(shift, 0), axis=0)
    return np.concatenate([first, values])[: len(values)]


def make(folder: Path, effects: dict[str, float], seed: int) -> Path:
    """Write a dataset of six stops with hidden effects; return its folder.

    `effects` has the size of each effect by its name. The same seed writes the same bytes.
    """
    rng = np.random.default_rng(seed)
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    # name, group, initial speed (m/s), declared mass (kg)
    plan = (
        ("a1", "tune", 42.3, 43000.0),
        ("a2", "tune", 33.0, 43000.0),
        ("a3", "tune", 27.0, 49450.0),
        ("b1", "validate", 41.1, 43000.0),
        ("b2", "validate", 36.0, 49450.0),
        ("b3", "validate", 25.0, 43000.0),
    )
    e = np.zeros(PLACES_OF_E)
    for name, size in effects.items():
        e[INDEX[name]] = size
    e[CONTACT] = _contact()

    # of the whole set; the order of the draws decides every stop
    axle = int(rng.integers(0, 4))
    rail = irregularity(rng, RAIL_M)
    patch_m = rng.uniform(120.0, 320.0)
    gain = 1.0 + rng.normal(0.0, 0.003)
    lift = 1.0 + rng.normal(0.0, 0.003)
    weight = 1.0 + rng.normal(0.0, 0.003)
    level = 0.06 * rng.uniform(0.6, 0.75)

    text = _HEAD
    for name, group, v0, mass in plan:
        own = np.array([irregularity(rng, RAIL_M) for _ in range(AXLES)])
        fine = np.zeros((LONGEST_ROWS, ROW_COLUMNS))
        mu_cd = level * (1.0 + 0.05 * rng.normal())
        most_Nm = rng.uniform(6000.0, 8200.0)
        sand_s = rng.uniform(3.0, 9.0)
        rows = stop(
            v0,
            mass * weight,
            mu_cd,
            most_Nm,
            e,
            rail,
            own,
            PLACES,
            sand_s,
            patch_m,
            axle,
            STEP_S,
            STEPS_PER_ROW,
            fine,
        )
        _write(folder / "runs" / f"{name}.csv", fine[:rows], e, mass, gain, lift, rng)
        text += f'\n[[run]]\nfile = "runs/{name}.csv"\ngroup = "{group}"\n'
        text += f"initial_speed_m_s = {v0}\n"
        if mass > 43000.0:
            text += f"mass_kg = {mass}\n"
    (folder / "dataset.toml").write_text(text)
    return folder


def _contact() -> float:
    """Return c11 a b over N^(2/3) of a wheel of 0.445 m on a rail, lateral radius 0.3 m [B3]."""
    # for N = 52.7 kN: a = 5.692 mm, b = 4.377 mm, c11 = 4.593
    return 4.593 * 5.692e-3 * 4.377e-3 / 52700.0 ** (2.0 / 3.0)


def _write(
    path: Path,
    fine: np.ndarray,
    e: np.ndarray,
    mass: float,
    gain: float,
    lift: float,
    rng: np.random.Generator,
) -> None:
    """Write the CSV of a stop as its sensors see it.

    `fine` has the rows of `stop`. `gain` and `lift` are the calibration of torque and load; every
    sensor has noise.
    """
    wheels = fine[:, ROW_WHEELS : ROW_WHEELS + AXLES]
    torques = fine[:, ROW_TORQUES : ROW_TORQUES + AXLES]
    wheel = delayed(wheels, ROW_S, e[SPEED_DELAY])[::ROWS_PER_SAMPLE]
    torque = delayed(torques, ROW_S, e[TORQUE_DELAY])[::ROWS_PER_SAMPLE]
    fine = fine[::ROWS_PER_SAMPLE]
    n = len(fine)
    v = fine[:, ROW_SPEED] + rng.normal(0.0, 0.03, n)
    wheel = wheel + rng.normal(0.0, 0.03 / RADIUS, wheel.shape)
    load_noise_N = rng.normal(0.0, 0.01 * mass * GRAVITY / 4.0, wheel.shape)
    load = fine[:, ROW_LOADS : ROW_LOADS + AXLES] * lift + load_noise_N
    torque = torque * gain + rng.normal(0.0, 0.015 * torque.max(), torque.shape)

    names = ["time_s", "vehicle_speed_m_s"]
    for kind in ("wheel_speed_{}_rad_s", "wheel_load_{}_N", "brake_torque_{}_Nm"):
        names += [kind.format(j) for j in range(1, AXLES + 1)]
    table = np.column_stack([np.arange(n) * 0.01, v, wheel, load, torque])
    np.savetxt(path, table, delimiter=",", fmt="%.6g", header=",".join(names), comments="")


_HEAD = """kind = "braking_runs"
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
