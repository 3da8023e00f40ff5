"""Replays measured runs through the model, one sample ahead: what the model cannot say beforehand.

Each wheel has an extended Kalman filter that is fed the measured torque, load and vehicle speed and predicts the next
wheel speed. Its second state m is the irregularity of the rail, a random walk with a spring in distance: noise, never
an explanation. The vehicle has a filter of its own that knows no adhesion law: only torque, resistance and mass move
it. The innovations, divided by their predicted deviation, are white with variance 1 if the model is right.

    [R1] J domega/dt = r N f(v - r omega, v, N) exp(m) - C;  exponential step, exact when linear
    [R2] m: Ornstein-Uhlenbeck in distance, deviation sigma, correlation length L
    [R3] u = v + sum J omega / (M r), du/dt = -(sum C / r + resistance) / M
    [R5] cov of (omega, m) after a step h: (b^2 q / 3, b q / 2, q), q = sigma^2 (1 - e^(-2vh/L)),
         b = d omega / d m in h; without it m would come half a step late and look like a delay
    [R4] lambda lags by `adhesion` [A7], in each step by a share 1 - exp(-h rate)

Source: Simon, Optimal State Estimation (2006), section 13.2.
Limits: first-order filter; two substeps a sample keep its bias below the noise.
"""

import math
from typing import NamedTuple

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.contact import adhesion

SUBSTEPS = 2


@kernel_inlined
def curves(sliding, speed, load_N, degraded, recovered, p):
    """What `adhesion.curves` gives of one wheel under its own load, its two frictions times these factors."""
    base = adhesion.Law(p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11], p[12], p[19])
    here = adhesion.law_for_contaminant(p[2] * degraded, p[3] * recovered, 1.0, base)
    return adhesion.curves(sliding, speed, load_N, p[13], here)


@kernel
def wheel_adhesion(sliding, speed, load_N, degraded, recovered, p, remembered, share):
    """(f, df/dsliding, lambda) of one wheel, f odd; lambda closes a `share` of its way from `remembered` [R4]."""
    f_d, f_r, low, high, k, slope_k = curves(sliding, speed, load_N, degraded, recovered, p)
    lagging = remembered if share < 1.0 else adhesion.NO_MEMORY
    f, done, rise, steep = adhesion.f_and_lambda(f_d, f_r, low, high, k, slope_k, lagging, p[21])
    if share < 1.0:
        done = remembered + share * (done - remembered)
        f = adhesion.between(f_d, f_r, done)
        rise = adhesion.between(low, high, done) + share * (f_r - f_d) * steep
    return math.copysign(f, sliding), rise, done


@kernel
def closes(speed, step_s, p):
    """Share of its way that lambda goes in a step [R4]; all of it where recovery does not lag."""
    return -math.expm1(-step_s * adhesion.lag_rate_1_s(speed, p[14], p[20])) if p[14] > 0.0 else 1.0


@kernel
def along(sliding, speed, load, friction, p, step_s, late, follow, out):
    """(f, df/dsliding) of one wheel, shape (2, n), from lambda before each sample, `late` (n + 1), which may follow."""
    for k in range(sliding.size):
        share = closes(speed[k], step_s, p)
        out[0, k], out[1, k], done = wheel_adhesion(
            sliding[k], speed[k], 0.5 * load[k], friction[0, k], friction[1, k], p, late[k], share
        )
        if follow:
            late[k + 1] = done


class State(NamedTuple):
    """The filter of a wheel: its speed in rad/s, the irregularity m, their covariances."""

    omega: float
    m: float
    p00: float
    p01: float
    p11: float


@kernel_inlined
def begun(measured, p):
    """The filter before the first sample."""
    return State(measured, 0.0, p[17] * p[17], 0.0, p[15] * p[15])


@kernel_inlined
def bounded(innovation, S):
    """An innovation of which an outlier moves the state no further than six deviations."""
    most = 6.0 * math.sqrt(S)
    return math.copysign(most, innovation) if abs(innovation) > most else innovation


@kernel_inlined
def corrected(measured, state, p):
    """(innovation, its variance, the filter) after a sample."""
    omega, m, p00, p01, p11 = state
    innovation, S = measured - omega, p00 + p[17] * p[17]
    taken, g0, g1 = bounded(innovation, S), p00 / S, p01 / S
    return (
        innovation,
        S,
        State(
            omega + g0 * taken, m + g1 * taken, p00 * (1.0 - g0), p01 * (1.0 - g0), p11 - g1 * p01
        ),
    )


@kernel_inlined
def moved(state, v, N, C, degraded, recovered, p, step_s):
    """The filter after a substep of a sample."""
    omega, m, p00, p01, p11 = state
    r, inertia, h = p[0], p[1], step_s / SUBSTEPS
    q_omega = (step_s * p[18] / inertia) ** 2
    f, rise, _ = wheel_adhesion(v - r * omega, v, 0.5 * N, degraded, recovered, p, 0.0, 1.0)
    field = math.exp(m)
    drive = r * N * f * field
    a = -r * r * N * rise * field / inertia
    x = a * h
    if abs(x) > 1e-6:
        x = min(x, 5.0)
        growth = math.exp(x)
        phi = math.expm1(x) / x
    else:
        growth, phi = 1.0 + x, 1.0 + 0.5 * x
    omega += h * phi * (drive - C) / inertia  # exponential Euler
    b = h * phi * drive / inertia
    keep = math.exp(-v * h / p[16])
    n00 = growth * growth * p00 + 2.0 * growth * b * p01 + b * b * p11
    n01 = keep * (growth * p01 + b * p11)
    # noise of m acts while it comes up: [R5]
    q = p[15] * p[15] * (1.0 - keep * keep)
    return State(
        omega,
        m * keep,
        n00 + b * b * q / 3.0 + q_omega * phi * phi / SUBSTEPS,
        n01 + 0.5 * b * q,
        keep * keep * p11 + q,
    )


@kernel
def replay_wheel(measured, torque, load, speed, friction, p, step_s, nu, variance, field):
    """Innovations of one wheel [R1]: writes nu and variance, shape (n,), and filtered m in `field`."""
    state = begun(measured[0], p)
    for k in range(measured.size):
        nu[k], variance[k], state = corrected(measured[k], state, p)
        field[k] = state.m
        if k + 1 == measured.size:
            break
        for i in range(SUBSTEPS):
            w = (i + 0.5) / SUBSTEPS
            v = (1.0 - w) * speed[k] + w * speed[k + 1]
            N = (1.0 - w) * load[k] + w * load[k + 1]
            C = (1.0 - w) * torque[k] + w * torque[k + 1]
            degraded = (1.0 - w) * friction[0, k] + w * friction[0, k + 1]
            recovered = (1.0 - w) * friction[1, k] + w * friction[1, k + 1]
            state = moved(state, v, N, C, degraded, recovered, p, step_s)


@kernel
def replay_vehicle(measured, force_over_mass, step_s, noise, torque_noise, nu, variance):
    """Innovations of the vehicle's force balance [R3]; torque_noise in m/s2 of one sample."""
    u, P = measured[0], noise * noise
    for k in range(measured.size):
        S = P + noise * noise
        nu[k], variance[k] = measured[k] - u, S
        gain = P / S
        u += gain * nu[k]
        P *= 1.0 - gain
        if k + 1 < measured.size:
            u -= 0.5 * step_s * (force_over_mass[k] + force_over_mass[k + 1])
            P += (step_s * torque_noise) ** 2
