"""How the innovations of a replay answer to a small change of anything: the linearised filter.

Any cause changes the acceleration of a wheel by some course in time. The filter passes that course
on to its innovations linearly, with coefficients that one replay has left behind, so the answer to
hundreds of possible causes costs little more than one replay.

    [S1] g = (r N f exp(m) - C) / J;  d omega' = F00 d omega + F01 d m + H d g,  d m' = keep d m
    [S2] d nu = -d omega;  after the sample d omega -= g0 d omega, d m -= g1 d omega
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.compiled.kernel import kernel, kernel_with_memory
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.replay import lanes, memory_replay, replay

# changes of the wheel's acceleration for a change of ln: friction, load, radius, the irregularity m
RATES = ("friction", "load", "radius", "irregularity")
_COEFFICIENTS = 6
STEP = 0.01  # change of ln for which parameters are given
LEAST = 1e-16  # a smaller answer is none: products of such numbers are subnormal, and a hundred times slower


class Linear(NamedTuple):
    """A replay with its coefficients: flat arrays (n,), (n, 6), (RATES, n)."""

    nu: np.ndarray
    variance: np.ndarray
    field: np.ndarray
    coefficients: np.ndarray
    rates: np.ndarray
    constants: np.ndarray  # (changes, n): the same for a step of other parameters, over the step
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
    friction: np.ndarray  # (2, n) factors of the degraded and of the recovered
    parameters: np.ndarray
    mass_kg: np.ndarray
    force_N: np.ndarray  # (vehicle samples,) added to the resistance


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
            out[k, c] = -w * scale if abs(w * scale) > LEAST else 0.0
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
            out[k, c] = -d_u[c] * scale if abs(d_u[c] * scale) > LEAST else 0.0
            if not last:
                d_u[c] = kept * d_u[c] + 0.5 * step_s * (changes[k, c] + changes[k + 1, c])


def linearise(design: Design, inputs: Inputs, changed: np.ndarray) -> Linear:
    """Replay all, keep coefficients; `changed` (segments, changes, PARAMETERS): parameters, one of them STEP larger."""
    n = design.measured_rad_s.size
    found = nu, variance, field = replay_wheels(design, inputs)
    co, rates, path = np.empty((n, _COEFFICIENTS)), np.empty((len(RATES), n)), np.empty((3, n))
    constants = np.empty((changed.shape[1], n))
    for s in range(design.segments):
        at, p = design.span(s), inputs.parameters[s]
        _coefficients(
            design,
            inputs,
            s,
            changed[s],
            found[:, at],
            co[at],
            rates[:, at],
            constants[:, at],
            path[:, at],
        )
        gains(
            variance[at],
            co[at],
            p,
            design.step_s,
            inputs.speed_m_s[at],
            inputs.load_N[at],
            inputs.torque_Nm[at],
        )
    vehicle_nu, vehicle_variance = replay_vehicles(design, inputs)
    return Linear(
        nu=nu,
        variance=variance,
        field=field,
        coefficients=co,
        rates=rates,
        constants=constants,
        sliding_m_s=path[0],
        energy_J_m=path[1],
        acceleration_rad_s2=path[2],
        vehicle_nu=vehicle_nu,
        vehicle_variance=vehicle_variance,
    )


def _coefficients(
    design: Design,
    inputs: Inputs,
    s: int,
    changed: np.ndarray,
    found: np.ndarray,
    co: np.ndarray,
    rates: np.ndarray,
    constants: np.ndarray,
    path: np.ndarray,
) -> None:
    """One wheel: stores [S1] along the filtered path."""
    at, p, (nu, S, field) = design.span(s), inputs.parameters[s], found
    r, inertia, h = p[parameters.RADIUS], p[parameters.INERTIA], 0.5 * design.step_s
    p00 = np.maximum(S - p[parameters.SPEED_NOISE] ** 2, 0.0)
    omega = design.measured_rad_s[at] - nu + p00 / S * nu
    v, N, mu = inputs.speed_m_s[at], inputs.load_N[at], inputs.friction[:, at]
    sliding, late = v - r * omega, np.zeros(v.size + 1)
    f, rise = replay_law(sliding, v, N, mu, p, design.step_s, late, True)

    def changes(load: np.ndarray, friction: np.ndarray, row: np.ndarray) -> np.ndarray:
        return replay_law(sliding, v, load, friction, row, design.step_s, late, False)[0]

    force = r * N * np.exp(field) / inertia
    path[:] = sliding, f * 0.5 * N * sliding / v, force * f - inputs.torque_Nm[at] / inertia
    a = -r * rise * force
    x = np.minimum(a * h, 5.0)
    growth, keep = np.exp(x), np.exp(-v * h / p[parameters.IRREGULARITY_LENGTH])
    some = np.where(np.abs(x) > 1e-6, x, 1.0)
    phi = np.where(np.abs(x) > 1e-6, np.expm1(some) / some, 1.0 + 0.5 * x)
    b = h * phi * force * f
    co[:, :5] = np.array(
        [growth * growth, b * (growth + keep), keep * keep, h * phi * (1.0 + growth), p00 / S]
    ).T
    rates[0] = force * (changes(N, mu * math.exp(STEP), p) - f) / STEP
    more = N * (1.0 + STEP)
    rates[1] = force * (changes(more, mu, p) * more / N - f) / STEP
    rates[2] = force * f + a * omega  # lever, and sliding
    rates[3] = force * f
    for i, row in enumerate(changed):
        constants[i] = force * (changes(N, mu, row) - f) / STEP


def replay_law(
    sliding: np.ndarray,
    speed: np.ndarray,
    load: np.ndarray,
    friction: np.ndarray,
    p: np.ndarray,
    step_s: float,
    late: np.ndarray,
    follow: bool,
) -> np.ndarray:
    """(f, df/dsliding) along a path, shape (2, n); with `follow` writes lambda before each sample into `late`."""
    out, friction = np.empty((2, sliding.size)), np.ascontiguousarray(friction)
    if p[parameters.MEMORY] == 0.0:
        lanes.along(sliding, speed, load, friction, p, np.empty(lanes.LONG), out)
    if p[parameters.MEMORY] > 0.0 or not np.all(np.isfinite(out)):
        replay.along(sliding, speed, load, friction, p, step_s, late, follow, out)
    return out


def innovations(design: Design, inputs: Inputs) -> tuple[np.ndarray, ...]:
    """(nu, variance, filtered m, vehicle nu, vehicle variance)."""
    return (*replay_wheels(design, inputs), *replay_vehicles(design, inputs))


def replay_wheels(design: Design, i: Inputs) -> np.ndarray:
    """(nu, variance, filtered m) of all wheels, shape (3, n)."""
    return replays(design, [i])[0]


def replays(design: Design, several: Sequence[Inputs]) -> np.ndarray:
    """The replays of all wheels under several inputs, shape (inputs, 3, n)."""
    given = [np.array([i.speed_m_s, i.load_N, i.torque_Nm, *i.friction]) for i in several]
    out, cells = np.empty((len(several), 3, design.measured_rad_s.size)), np.empty(lanes.CELLS)
    starts = [
        design.start[run * AXLES : (run + 1) * AXLES + 1] for run in range(design.mass_kg.size)
    ]
    own = [
        [i.parameters[run * AXLES : (run + 1) * AXLES] for run in range(len(starts))]
        for i in several
    ]
    # two at once, the longest first: a pair takes as long as the longer one
    jobs = sorted(
        np.ndindex(len(several), len(starts)),
        key=lambda job: int(starts[job[1]][0] - starts[job[1]][1]),
    )
    for (k, run), (m, other) in zip(
        jobs[::2], jobs[1::2] + jobs[-1:] * (len(jobs) % 2), strict=True
    ):
        lanes.replay_runs(
            starts[run],
            starts[other],
            design.measured_rad_s,
            given[k],
            given[m],
            np.concatenate([own[k][run], own[m][other]]),
            design.step_s,
            cells,
            out[k],
            out[m],
        )
    for k, run in jobs:
        if not np.all(np.isfinite(out[k, 0, int(starts[run][0]) : int(starts[run][-1])])):
            i = several[k]
            memory_replay.replay_wheels(
                starts[run],
                design.measured_rad_s,
                i.torque_Nm,
                i.load_N,
                i.speed_m_s,
                i.friction,
                own[k][run],
                design.step_s,
                *out[k],
            )
    return out


def momentum_m_s(design: Design, inputs: Inputs, run: int) -> np.ndarray:
    """Measured u of [R3], shape (samples,)."""
    p = inputs.parameters[run * AXLES : (run + 1) * AXLES]
    turning = design.by_axle(design.measured_rad_s, run) @ (
        p[:, parameters.INERTIA] / p[:, parameters.RADIUS]
    )
    return design.vehicle_m_s[design.vehicle_span(run)] + turning / inputs.mass_kg[run]


def vehicle_force(design: Design, inputs: Inputs, run: int) -> np.ndarray:
    """Force over mass on a vehicle, m/s2, shape (samples,)."""
    v = design.speed_m_s[design.span(run * AXLES)]
    A, B, C = design.resistance
    force = A + B * v + C * v * v + inputs.force_N[design.vehicle_span(run)]
    for s in range(run * AXLES, (run + 1) * AXLES):
        force = force + inputs.torque_Nm[design.span(s)] / inputs.parameters[s, parameters.RADIUS]
    return force / inputs.mass_kg[run]


def replay_vehicles(design: Design, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
    """Innovations and variances of all vehicles."""
    total = int(design.vehicle_start[-1])
    nu, variance = np.empty(total), np.empty(total)
    for run in range(design.mass_kg.size):
        at = design.vehicle_span(run)
        # deviation in m/s2 of one sample of the measured force over mass
        noise_m_s2 = float(
            2.0
            * design.torque_noise_Nm[run]
            / (design.base[parameters.RADIUS] * design.mass_kg[run])
        )
        replay.replay_vehicle(
            momentum_m_s(design, inputs, run),
            vehicle_force(design, inputs, run),
            design.step_s,
            design.speed_noise_m_s,
            noise_m_s2,
            nu[at],
            variance[at],
        )
    return nu, variance
