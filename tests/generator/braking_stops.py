"""Makes measured stops with hidden causes, for tests of `explain`. Shares no code with the rig.

The base is the paper's law (Meli et al. 2014) with a simple WSP that pumps the brake. Causes have
other shapes here than in the rig's table of mechanisms: a rational law for an exponential one, time
for distance, a bell for a window, so that a test of naming is not a test of copying.
"""

import math
from pathlib import Path

import numba
import numpy as np

AXLES = 4
PLACES = np.array([0.0, 2.56, 19.0, 21.56])
RADIUS, INERTIA = 0.445, 160.0
# places of the coefficients in the kernel's vector of effects
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
    # not in the library
    "load_exponent",
    "joints",
    "sticky_turn",
    "late_axle",
    "sliding_resonance",
)
# sizes that can be seen in six stops, smallest
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
UNKNOWN = {
    "load_exponent": 1.0,
    "joints": 0.08,
    "sticky_turn": 0.08,
    "late_axle": 0.06,
    "sliding_resonance": 0.06,
}
LARGEST: dict[str, float] = {}
# causes whose size means here what the rig's table means by it: the coefficient to compare, its sign
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
INDEX = {name: i for i, name in enumerate(EFFECTS)}


@numba.njit(cache=True)
def polach(sliding, creepage, stiff, mu_c, A, gamma, k_a, k_s, rational):
    slow = math.exp(-gamma * sliding)
    mu = mu_c + (mu_c / A - mu_c) * slow * rational
    eps = stiff * creepage / mu
    part = k_a * eps / (1.0 + (k_a * eps) ** 2) + math.atan(k_s * eps)
    return 2.0 * mu / math.pi * part


@numba.njit(cache=True)
def limits(s, v, N, mu_cd, scale, e):
    """Degraded and recovered adhesion of one wheel at sliding s >= 0."""
    creep = s / max(v, 0.1)
    stiff = 0.25 * math.pi * 8.0e10 * e[26] * N ** (-1.0 / 3.0) * (1.0 + e[18])
    gamma = 1.0 + e[20]
    soft = 1.0 - e[19]
    bump = 1.0 + e[25] * math.sin(2.5 * s)
    f_d = polach(s, creep, stiff, mu_cd * scale * bump, 0.4, 0.2 * gamma, 0.3 * soft, 0.1, 1.0)
    f_r = polach(s, creep, stiff, 0.28 * scale * bump, 0.4, 0.6 * gamma, 1.0 * soft, 0.4, 1.0)
    return f_d, f_r


@numba.njit(cache=True)
def adhesion(s, v, N, mu_cd, scale, e):
    """(f, lambda) without memory, by Newton from above."""
    f_d, f_r = limits(s, v, N, mu_cd, scale, e)
    k = 1.9e-4 * N * s / max(v, 0.1)
    f = f_r
    for _ in range(8):
        x = math.exp(-k * f)
        f -= (f - f_r + (f_r - f_d) * x) / (1.0 - (f_r - f_d) * k * x)
    return f, 1.0 - math.exp(-k * f)


@numba.njit(cache=True)
def stop(v0, mass, mu_cd, most, e, rail, own, positions, sand_s, patch_m, axle, step, every, out):
    """One stop at `step`; writes every `every` steps (speed, wheel 4, load 4, torque 4, x)."""
    v, x, t = v0, 0.0, 0.0
    omega = np.full(4, v0 / RADIUS)
    if e[11] != 0.0:
        omega[axle] /= 1.0 + e[11]
    pressure, late, heat = np.zeros(4), np.zeros(4), np.zeros(4)
    spent, angle = np.zeros(4), np.zeros(4)
    state = np.zeros(4, dtype=np.int64)
    before = np.zeros(4)
    work = np.zeros((4, 4000))
    turning = np.zeros(4)
    static = mass * 9.80665 / 4.0
    a = 0.0
    rows = 0
    for k in range(out.shape[0] * every):
        demand = most if t > 1.0 else 0.0
        force = (
            600.0 + 0.9375 * v * v + e[9] * (0.6 + 0.4 * (v / 25.0) ** 2) + e[10] * mass * 9.80665
        )
        for j in range(4):
            r = RADIUS * (1.0 + (e[11] if j == axle else 0.0))
            inertia = INERTIA * (1.0 + e[12])
            s = v - r * omega[j]
            # a WSP: vents while sliding is large and grows, fills again behind
            if k % 20 == 0:
                growing = s - before[j]
                before[j] = s
                top = 0.085 * v + 0.7
                if s > top and growing > 0.0:
                    state[j] = 2
                elif s < 0.45 * top:
                    state[j] = 0
                elif growing < 0.0:
                    state[j] = 1
            if state[j] == 0:
                pressure[j] += (demand - pressure[j]) * step / 0.7
            elif state[j] == 2:
                pressure[j] -= pressure[j] * step / 0.35
            pitch = (1.0 if j < 2 else -1.0) * 0.0116 + (1.0 if j % 2 == 0 else -1.0) * 0.0116
            shown = static * (1.0 + pitch * a)
            N = shown * (
                1.0
                + e[16] * a * ((1.0 if j < 2 else -1.0) * 0.6 + (1.0 if j % 2 == 0 else -1.0) * 0.4)
            )
            if j == axle:
                N *= 1.0 + e[15] * math.sin(angle[j] + 0.7)
            place = x - positions[j]
            cell = min(max(int((place + 60.0) * 4.0), 0), rail.size - 2)
            irregular = math.exp(rail[cell] + own[j, cell])
            scale = 1.0
            if e[0] != 0.0:
                total = 0.0
                at = min(max(int(place + 60.0), 0), 3999)
                for i in range(j):
                    total += work[i, at]
                scale *= 1.0 + 2.0 * e[0] * total / (total + 350.0)
            scale *= ((7.5 / (3.6 * 20.0 + 44.0) + 0.161) / (7.5 / (3.6 * v + 44.0) + 0.161)) ** (
                -e[2] * 4.0
            )
            scale /= 1.0 + e[3] * spent[j] / 60.0
            scale *= 1.0 - e[4] * math.exp(-(((place - patch_m) / 45.0) ** 2))
            scale *= math.exp(-e[5] * (1.0 - math.exp(-t / 12.0)))
            if sand_s < t < sand_s + 7.0 and j > 0:
                scale *= 1.0 + e[17] * math.sin(math.pi * (t - sand_s) / 7.0) ** 0.5
            scale *= (N / 105000.0) ** (-e[21] * 0.5)
            scale *= 1.0 - e[22] * (math.sin(2.0 * math.pi * place / 30.0) > 0.6)
            scale *= 1.0 - e[23] * math.tanh(turning[j] / 2.0)
            if j == axle:
                scale *= 1.0 - e[24] * (t > 0.4 * 20.0)
            if s >= 0.0:
                f, now = adhesion(s, v, 0.5 * N, mu_cd, scale, e)
            else:
                f, now = adhesion(-s, v, 0.5 * N, mu_cd, scale, e)
                f = -f
            if e[1] > 0.0:
                f_d, f_r = limits(abs(s), v, 0.5 * N, mu_cd, scale, e)
                late[j] += (now - late[j]) * step / (e[1] / 22.0)
                f = math.copysign(f_d + (f_r - f_d) * late[j], s)
            # local slope for a linearly implicit step
            ds = 1e-4 + 1e-4 * abs(s)
            f1, _ = adhesion(abs(s), v, 0.5 * N, mu_cd, scale, e)
            f2, _ = adhesion(abs(s) + ds, v, 0.5 * N, mu_cd, scale, e)
            slope = max((f2 - f1) / ds, 0.0)
            T = N * f * irregular
            C0 = pressure[j]
            C = C0 * (1.0 + e[6]) / (1.0 + e[7] * heat[j]) + e[8] * (C0 > 200.0)
            acceleration = (r * T - C) / inertia
            change = step * acceleration / (1.0 + step * r * r * N * slope * irregular / inertia)
            omega[j] = max(omega[j] + change, 0.0)
            turning[j] += (change / step * -r - turning[j]) * step / 0.1
            angle[j] += omega[j] * step
            force += (C + inertia * change / step) / r
            heat[j] += (C * omega[j] / 1e6 - heat[j] / 300.0) * step
            spent[j] += abs(s) * step
            at = min(max(int(place + 60.0), 0), 3999)
            work[j, at] = max(work[j, at], abs(f) * 0.5 * N * abs(s) / max(v, 0.1))
            if k % every == 0:
                out[rows, 1 + j] = omega[j] - change
                out[rows, 5 + j] = shown
                out[rows, 9 + j] = C0
        if k % every == 0:
            out[rows, 0] = v
            out[rows, 13] = x
            rows += 1
            if v < 4.0:
                return rows
        a += (force / mass - a) * step / 0.1
        v -= step * force / mass
        x += step * v
        t += step
    return rows


def irregularity(rng: np.random.Generator, metres: float) -> np.ndarray:
    """Gaussian field with 8 m correlation on a quarter of a metre; rail and axle make 2.3 %."""
    n = int(metres * 4)
    keep = math.exp(-0.25 / 8.0)
    out = np.empty(n)
    out[0] = rng.normal()
    for i in range(1, n):
        out[i] = keep * out[i - 1] + math.sqrt(1.0 - keep * keep) * rng.normal()
    return 0.016 * out


def delayed(values: np.ndarray, fine_s: float, delay_s: float) -> np.ndarray:
    """values(t - delay) on a fine grid."""
    shift = round(delay_s / fine_s)
    return np.concatenate([np.repeat(values[:1], max(shift, 0), axis=0), values])[: len(values)]


def make(folder: Path, effects: dict[str, float], seed: int) -> Path:
    """Write a dataset of six stops with hidden effects; returns its folder."""
    rng = np.random.default_rng(seed)
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    plan = (
        ("a1", "tune", 42.3, 43000.0),
        ("a2", "tune", 33.0, 43000.0),
        ("a3", "tune", 27.0, 49450.0),
        ("b1", "validate", 41.1, 43000.0),
        ("b2", "validate", 36.0, 49450.0),
        ("b3", "validate", 25.0, 43000.0),
    )
    e = np.zeros(28)
    for name, size in effects.items():
        e[INDEX[name]] = size
    e[26] = _patch()
    axle = int(rng.integers(0, 4))
    rail, patch_m = irregularity(rng, 2000.0), rng.uniform(120.0, 320.0)
    gain, lift = 1.0 + rng.normal(0.0, 0.003), 1.0 + rng.normal(0.0, 0.003)
    weight = 1.0 + rng.normal(0.0, 0.003)
    level = 0.06 * rng.uniform(0.6, 0.75)
    text = _HEAD
    for name, group, v0, mass in plan:
        own = np.array([irregularity(rng, 2000.0) for _ in range(AXLES)])
        fine = np.zeros((90000, 14))
        rows = stop(
            v0,
            mass * weight,
            level * (1.0 + 0.05 * rng.normal()),
            rng.uniform(6000.0, 8200.0),
            e,
            rail,
            own,
            PLACES,
            rng.uniform(3.0, 9.0),
            patch_m,
            axle,
            0.0005,
            2,
            fine,
        )
        _write(folder / "runs" / f"{name}.csv", fine[:rows], e, mass, gain, lift, rng)
        text += (
            f'\n[[run]]\nfile = "runs/{name}.csv"\ngroup = "{group}"\n'
            f"initial_speed_m_s = {v0}\n" + (f"mass_kg = {mass}\n" if mass > 43000.0 else "")
        )
    (folder / "dataset.toml").write_text(text)
    return folder


def _patch() -> float:
    """c11 a b of the contact over N^(2/3): wheel 0.445 m on a rail, lateral radius 0.3 m."""
    # shared material: N = 52.7 kN gives a = 5.692 mm, b = 4.377 mm; c11 4.593
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
    wheel = delayed(fine[:, 1:5], 0.001, e[INDEX["speed_sensor_delay"]])[::10]
    torque = delayed(fine[:, 9:13], 0.001, e[INDEX["torque_sensor_delay"]])[::10]
    fine = fine[::10]
    n = len(fine)
    v = fine[:, 0] + rng.normal(0.0, 0.03, n)
    wheel = wheel + rng.normal(0.0, 0.03 / RADIUS, wheel.shape)
    load = fine[:, 5:9] * lift + rng.normal(0.0, 0.01 * mass * 9.80665 / 4.0, wheel.shape)
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
