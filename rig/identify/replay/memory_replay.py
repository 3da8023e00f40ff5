"""Replays a wheel whose recovery lags: the filter of `replay` with lambda as a third state.

An error of the wheel's speed moves the recovery, and that moves the wheel: only a filter that knows
this tells a lag from irregularity of the rail. Speed and lambda take an exact step of the linearised
pair in each substep; the irregularity comes up meanwhile as in `replay`.

    [Y1] d/dt (omega, lambda) = A (omega, lambda) + ...,
         A = [[-r^2 N f'_lambda e^m, r N (f_r - f_d) e^m] / J, [-r lambda_0', h - 1] v / length],
         h = d lambda_0 / d lambda, 0 unless lambda_0 is that of the work done
    [Y2] step e^(A h), inputs phi(A h) h with phi(z) = (e^z - 1) / z, on the two eigenvalues of A

Source: Simon, Optimal State Estimation (2006), section 13.2; Hochbruck and Ostermann, Exponential
integrators (2010), section 2.
"""

import math
from typing import NamedTuple

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.compiled.variants import variant
from rollerrig.rig.contact import adhesion
from rollerrig.rig.identify.replay import replay

_BEGINS = 0.02  # deviation of lambda at the start, when the wheel rolls


class State(NamedTuple):
    """The filter of a wheel: its speed in rad/s, the irregularity m, lambda, their covariances."""

    omega: float
    m: float
    late: float
    p00: float
    p01: float
    p11: float
    p02: float
    p12: float
    p22: float


@kernel_inlined
def phi(z, power):
    """(e^z - 1) / z, given e^z."""
    return (power - 1.0) / z if abs(z) > 1e-4 else 1.0 + 0.5 * z + z * z / 6.0


@kernel_inlined
def step_of(a, g, d, c, h):
    """e^(A h) and phi(A h) h of A = [[a, g], [d, c]], row by row: eight numbers [Y2]."""
    middle, square = 0.5 * (a + c), 0.25 * (a - c) ** 2 + g * d
    root = math.sqrt(abs(square))
    near = root * h < 1e-5
    root = 1e-5 / h if near else root
    # two real eigenvalues; a fall this steep is left within a sample
    z1, z2 = min((middle + root) * h, 5.0), (middle - root) * h
    e1, e2 = math.exp(z1), math.exp(z2)
    p1, p2 = phi(z1, e1) * h, phi(z2, e2) * h
    e, p, e0, p0 = (
        (e1 - e2) / (2.0 * root),
        (p1 - p2) / (2.0 * root),
        0.5 * (e1 + e2),
        0.5 * (p1 + p2),
    )
    if not near and square <= 0.0:  # a pair of conjugates x + i y
        x, y = min(middle * h, 5.0), root * h
        power, size = math.exp(x), x * x + y * y
        real, imaginary = power * math.cos(y), power * math.sin(y)
        of_real = (
            ((real - 1.0) * x + imaginary * y) / size
            if size > 1e-8
            else 1.0 + 0.5 * x + (x * x - y * y) / 6.0
        )
        of_imaginary = (
            (imaginary * x - (real - 1.0) * y) / size if size > 1e-8 else 0.5 * y + x * y / 3.0
        )
        e, p, e0, p0 = imaginary / root, of_imaginary * h / root, real, of_real * h
    return (
        e0 + e * (a - middle),
        e * g,
        e * d,
        e0 + e * (c - middle),
        p0 + p * (a - middle),
        p * g,
        p * d,
        p0 + p * (c - middle),
    )


@kernel_inlined
def begun(measured, p):
    """The filter before the first sample."""
    noise = p[17] * p[17]
    return State(measured, 0.0, 0.0, noise, 0.0, p[15] * p[15], 0.0, 0.0, _BEGINS * _BEGINS)


@kernel_inlined
def corrected(measured, state, p):
    """(innovation, its variance, the filter) after a sample."""
    omega, m, late, p00, p01, p11, p02, p12, p22 = state
    innovation, S = measured - omega, p00 + p[17] * p[17]
    taken, g0, g1, g2 = replay.bounded(innovation, S), p00 / S, p01 / S, p02 / S
    return (
        innovation,
        S,
        State(
            omega + g0 * taken,
            m + g1 * taken,
            min(max(late + g2 * taken, 0.0), 1.0),
            p00 * (1.0 - g0),
            p01 * (1.0 - g0),
            p11 - g1 * p01,
            p02 * (1.0 - g0),
            p12 - g1 * p02,
            p22 - g2 * p02,
        ),
    )


@kernel_inlined
def moved(state, v, N, C, degraded, recovered, p, step_s):
    """The filter after a substep of a sample."""
    omega, m, late, p00, p01, p11, p02, p12, p22 = state
    r, inertia, h = p[0], p[1], step_s / replay.SUBSTEPS
    q_omega = (step_s * p[18] / inertia) ** 2 / replay.SUBSTEPS
    s = v - r * omega
    f_d, f_r, low, high, k_f, slope_k = replay.curves(s, v, 0.5 * N, degraded, recovered, p)
    _, done, _, steep = adhesion.f_and_lambda(f_d, f_r, low, high, k_f, slope_k, late, p[21])
    hangs = (1.0 - done) * k_f * (f_r - f_d) if p[21] > 0.0 else 0.0  # d lambda_0 / d lambda
    target = math.copysign(steep, s)  # d lambda_0 / ds
    rate = adhesion.lag_rate_1_s(max(v, adhesion.SPEED_FLOOR_M_S), p[14], p[20])
    push = r * N * math.exp(m) / inertia
    sign = 1.0 if s >= 0.0 else -1.0
    f = sign * adhesion.between(f_d, f_r, late)
    a, g = -r * push * adhesion.between(low, high, late), push * (f_r - f_d) * sign
    e00, e01, e10, e11, b00, b01, b10, b11 = step_of(
        a, g, -r * rate * target, -rate * (1.0 - hangs), h
    )
    drive, pull = push * f - C / inertia, rate * (done - late)
    omega += b00 * drive + b01 * pull
    late = min(max(late + b10 * drive + b11 * pull, 0.0), 1.0)
    keep = math.exp(-v * h / p[16])
    b0, b2 = b00 * push * f, b10 * push * f  # what m does to omega and lambda
    n00 = (
        e00 * e00 * p00
        + e01 * e01 * p22
        + b0 * b0 * p11
        + 2.0 * (e00 * e01 * p02 + e00 * b0 * p01 + e01 * b0 * p12)
    )
    n22 = (
        e10 * e10 * p00
        + e11 * e11 * p22
        + b2 * b2 * p11
        + 2.0 * (e10 * e11 * p02 + e10 * b2 * p01 + e11 * b2 * p12)
    )
    n02 = (
        e00 * e10 * p00
        + e01 * e11 * p22
        + b0 * b2 * p11
        + (e00 * e11 + e01 * e10) * p02
        + (e00 * b2 + e10 * b0) * p01
        + (e01 * b2 + e11 * b0) * p12
    )
    n01 = keep * (e00 * p01 + e01 * p12 + b0 * p11)
    n12 = keep * (e10 * p01 + e11 * p12 + b2 * p11)
    q = p[15] * p[15] * (1.0 - keep * keep)
    return State(
        omega,
        m * keep,
        late,
        n00 + b0 * b0 * q / 3.0 + q_omega * (b00 / h) ** 2,
        n01 + 0.5 * b0 * q,
        keep * keep * p11 + q,
        n02 + b0 * b2 * q / 3.0 + q_omega * b00 * b10 / (h * h),
        n12 + 0.5 * b2 * q,
        n22 + b2 * b2 * q / 3.0 + q_omega * (b10 / h) ** 2,
    )


_replay_lagging = variant(replay.replay_wheel, begun=begun, corrected=corrected, moved=moved)


@kernel
def replay_wheels(
    start, measured, torque, load, speed, friction, parameters, step_s, nu, variance, field
):
    """Innovations of all segments, each by the filter that its `parameters` (segments, PARAMETERS) need."""
    for s in range(start.size - 1):
        a, b, p = start[s], start[s + 1], parameters[s]
        given = measured[a:b], torque[a:b], load[a:b], speed[a:b], friction[:, a:b]
        if p[14] > 0.0:
            _replay_lagging(*given, p, step_s, nu[a:b], variance[a:b], field[a:b])
        else:
            replay.replay_wheel(*given, p, step_s, nu[a:b], variance[a:b], field[a:b])
