"""How the innovations of a replay answer to a small change of anything: the linearised filter.

Any cause changes the acceleration of a wheel by some course in time. The filter passes that course
on to its innovations linearly, with coefficients that one replay has left behind, so the answer to
hundreds of possible causes costs little more than one replay.

    [S1] g = (r N f exp(m) - C) / J;  d omega' = F00 d omega + F01 d m + H d g,  d m' = keep d m
    [S2] d nu = -d omega;  after the sample d omega -= g0 d omega, d m -= g1 d omega
"""

import math
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.filter import memory_replay, replay
from rollerrig.rig.kernel import kernel, kernel_with_memory

# changes of the wheel's acceleration for a change of ln: friction, load, radius, the irregularity m
RATES = ("friction", "load", "radius", "irregularity")
_COEFFICIENTS = 6
# change of ln for which parameters are given
STEP = 0.01


class Linear(NamedTuple):
    """A replay with its coefficients: flat arrays (n,), (n, 6), (n, RATES)."""

    nu: np.ndarray
    variance: np.ndarray
    field: np.ndarray
    coefficients: np.ndarray
    rates: np.ndarray
    constants: np.ndarray  # (n, changes): the same for a step of other parameters, over the step
    sliding_m_s: np.ndarray  # (n,) known before the next sample, so are the next two
    energy_J_m: np.ndarray
    acceleration_rad_s2: np.ndarray
    vehicle_nu: np.ndarray
    vehicle_variance: np.ndarray


class Inputs(NamedTuple):
    """What a replay reads, changed by causes: flat arrays, segment and run rows."""

    torque_Nm: np.ndarray
    load_N: np.ndarray
    speed_m_s: np.ndarray
    friction_log: np.ndarray
    parameters: np.ndarray
    mass_kg: np.ndarray
    force_N: np.ndarray  # (vehicle samples,) added to the resistance


@kernel_with_memory
def coefficients_of(measured, torque, load, speed, friction_log, p, changed, step_s, nu, variance, field, co,
                    rates, constants, path):
    """One wheel: replays it, then stores [S1] along the filtered path; `changed` (changes, PARAMETERS)."""
    memory_replay.replay_wheel(measured, torque, load, speed, friction_log, p, step_s, nu, variance, field)
    r, inertia = p[0], p[1]
    noise = p[17] * p[17]
    h = 0.5 * step_s
    late = 0.0
    for k in range(measured.size):
        S = variance[k]
        p00 = max(S - noise, 0.0)
        omega = measured[k] - nu[k] + p00 / S * nu[k]
        v, N, C, log_mu = speed[k], load[k], torque[k], friction_log[k]
        share = 1.0
        if p[14] > 0.0:
            share = replay.closes(v, step_s, p)
        before = late
        f, rise, late = replay.wheel_adhesion(v - r * omega, v, 0.5 * N, log_mu, p, before, share)
        force = r * N * math.exp(field[k]) / inertia
        path[k, 0] = v - r * omega
        path[k, 1] = f * 0.5 * N * (v - r * omega) / v
        path[k, 2] = force * f - C / inertia
        a = -r * rise * force
        x = min(a * h, 5.0)
        growth = math.exp(x)
        phi = math.expm1(x) / x if abs(x) > 1e-6 else 1.0 + 0.5 * x
        keep = math.exp(-v * h / p[16])
        b = h * phi * force * f
        co[k, 0] = growth * growth
        co[k, 1] = b * (growth + keep)
        co[k, 2] = keep * keep
        co[k, 3] = h * phi * (1.0 + growth)
        co[k, 4] = p00 / S
        s = v - r * omega
        rates[k, 0] = force * (replay.wheel_adhesion(s, v, 0.5 * N, log_mu + STEP, p, before, share)[0]
                               - f) / STEP
        more = N * (1.0 + STEP)
        rates[k, 1] = force * (replay.wheel_adhesion(s, v, 0.5 * more, log_mu, p, before, share)[0]
                               * more / N - f) / STEP
        rates[k, 2] = force * f + a * omega  # lever, and sliding
        rates[k, 3] = force * f
        for i in range(changed.shape[0]):
            constants[k, i] = force * (replay.wheel_adhesion(s, v, 0.5 * N, log_mu, changed[i], before, share)[0]
                                       - f) / STEP


@kernel
def gains(variance, co, p, step_s, speed, load, torque):
    """Second gain of the filter, rebuilt with the covariances of [S1] into co[:, 5]."""
    noise = p[17] * p[17]
    p00, p01, p11 = noise, 0.0, p[15] * p[15]
    for k in range(variance.size):
        S = variance[k]
        co[k, 5] = p01 / S
        g0 = co[k, 4]
        p11 -= p01 * p01 / S
        p01 *= 1.0 - g0
        p00 = max(S - noise, 0.0) * (1.0 - g0)
        if k + 1 < variance.size:
            # the filter's own covariance bounds how fast it lets an error grow
            most = math.sqrt(max(variance[k + 1] - noise, 0.0) / max(p00, 1e-12))
            co[k, 0] = min(co[k, 0], most)
        F00, F01, keep = co[k, 0], co[k, 1], co[k, 2]
        q = p[15] * p[15] * (1.0 - keep * keep)
        p01 = keep * (F00 * p01 + F01 * p11) + 0.5 * F01 * q
        p11 = keep * keep * p11 + q


@kernel_with_memory
def answer(changes, variance, co, out):
    """Whitened innovations' answer to changes of the acceleration, shape (n, columns) [S2]."""
    columns = changes.shape[1]
    d_omega, d_m = np.zeros(columns), np.zeros(columns)
    for k in range(changes.shape[0]):
        scale = 1.0 / math.sqrt(variance[k])
        F00, F01, keep, H, g0, g1 = co[k, 0], co[k, 1], co[k, 2], co[k, 3], co[k, 4], co[k, 5]
        for c in range(columns):
            w = d_omega[c]
            out[k, c] = -w * scale
            m = d_m[c] - g1 * w
            w -= g0 * w
            d_omega[c] = F00 * w + F01 * m + H * changes[k, c]
            d_m[c] = keep * m


@kernel_with_memory
def vehicle_answer(changes, variance, noise, step_s, out):
    """The same for the vehicle's balance; changes of du/dt, shape (n, columns)."""
    columns = changes.shape[1]
    d_u = np.zeros(columns)
    for k in range(changes.shape[0]):
        scale = 1.0 / math.sqrt(variance[k])
        kept = noise * noise / variance[k]
        last = k + 1 == changes.shape[0]
        for c in range(columns):
            out[k, c] = -d_u[c] * scale
            if not last:
                d_u[c] = kept * d_u[c] + 0.5 * step_s * (changes[k, c] + changes[k + 1, c])


def linearise(design: Design, inputs: Inputs, changed: np.ndarray) -> Linear:
    """Replay all wheels and vehicles and keep the coefficients.

    `changed` (segments, changes, PARAMETERS) are parameters of which one differs by STEP of its ln.
    """
    n = design.measured_rad_s.size
    nu, variance, field = np.empty(n), np.empty(n), np.empty(n)
    co, rates, path = np.empty((n, _COEFFICIENTS)), np.empty((n, len(RATES))), np.empty((n, 3))
    constants = np.empty((n, changed.shape[1]))
    for s in range(design.segments):
        at = design.span(s)
        p = inputs.parameters[s]
        coefficients_of(design.measured_rad_s[at], inputs.torque_Nm[at], inputs.load_N[at],
                        inputs.speed_m_s[at], inputs.friction_log[at], p, changed[s], design.step_s, nu[at],
                        variance[at], field[at], co[at], rates[at], constants[at], path[at])
        gains(variance[at], co[at], p, design.step_s, inputs.speed_m_s[at], inputs.load_N[at],
              inputs.torque_Nm[at])
    vehicle_nu, vehicle_variance = replay_vehicles(design, inputs)
    return Linear(
        nu=nu, variance=variance, field=field, coefficients=co, rates=rates, constants=constants,
        sliding_m_s=path[:, 0], energy_J_m=path[:, 1], acceleration_rad_s2=path[:, 2], vehicle_nu=vehicle_nu,
        vehicle_variance=vehicle_variance)


def innovations(design: Design, inputs: Inputs) -> tuple[np.ndarray, ...]:
    """(nu, variance, filtered m, vehicle nu, vehicle variance)."""
    n = design.measured_rad_s.size
    nu, variance, field = np.empty(n), np.empty(n), np.empty(n)
    memory_replay.replay_wheels(
        design.start, design.measured_rad_s, inputs.torque_Nm, inputs.load_N, inputs.speed_m_s,
        inputs.friction_log, inputs.parameters, design.step_s, nu, variance, field)
    return (nu, variance, field, *replay_vehicles(design, inputs))


def vehicle_force(design: Design, inputs: Inputs, run: int) -> np.ndarray:
    """Force over mass on a vehicle, m/s2, shape (samples,)."""
    spans = [design.span(run * AXLES + j) for j in range(AXLES)]
    v = design.speed_m_s[spans[0]]
    A, B, C = design.resistance
    own = design.vehicle_span(run)
    force = A + B * v + C * v * v + inputs.force_N[own]
    for j, at in enumerate(spans):
        force = force + inputs.torque_Nm[at] / inputs.parameters[run * AXLES + j, parameters.RADIUS]
    return force / inputs.mass_kg[run]


def vehicle_torque_noise(design: Design, run: int) -> float:
    """Deviation in m/s2 of one sample of the measured force over mass."""
    return float(2.0 * design.torque_noise_Nm[run] / (design.base[0] * design.mass_kg[run]))


def replay_vehicles(design: Design, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
    """Innovations and variances of all vehicles."""
    total = int(design.vehicle_start[-1])
    nu, variance = np.empty(total), np.empty(total)
    for run in range(design.mass_kg.size):
        at = design.vehicle_span(run)
        replay.replay_vehicle(
            design.vehicle_m_s[at] + design.wheels_m_s[at], vehicle_force(design, inputs, run),
            design.step_s, design.speed_noise_m_s, vehicle_torque_noise(design, run), nu[at],
            variance[at])
    return nu, variance
