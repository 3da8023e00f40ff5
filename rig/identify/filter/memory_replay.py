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

from rollerrig.rig.contact import adhesion
from rollerrig.rig.identify.filter import replay
from rollerrig.rig.kernel import kernel

_BEGINS = 0.02  # deviation of lambda at the start, when the wheel rolls


@kernel
def phi(z, power):
    """(e^z - 1) / z, given e^z."""
    return (power - 1.0) / z if abs(z) > 1e-4 else 1.0 + 0.5 * z + z * z / 6.0


@kernel
def step_of(a, g, d, c, h):
    """e^(A h) and phi(A h) h of A = [[a, g], [d, c]], row by row: eight numbers [Y2]."""
    middle, square = 0.5 * (a + c), 0.25 * (a - c) ** 2 + g * d
    root = math.sqrt(abs(square))
    if root * h < 1e-5:
        root, square = 1e-5 / h, 1.0
    if square > 0.0:
        z1, z2 = min((middle + root) * h, 5.0), (middle - root) * h  # a fall this steep is left within a sample
        e1, e2 = math.exp(z1), math.exp(z2)
        p1, p2 = phi(z1, e1) * h, phi(z2, e2) * h
        e, p, e0, p0 = (e1 - e2) / (2.0 * root), (p1 - p2) / (2.0 * root), 0.5 * (e1 + e2), 0.5 * (p1 + p2)
    else:  # a pair of conjugates
        z = complex(min(middle * h, 5.0), root * h)
        turned = math.exp(z.real) * complex(math.cos(z.imag), math.sin(z.imag))
        given = phi(z, turned) * h
        e, p, e0, p0 = turned.imag / root, given.imag / root, turned.real, given.real
    return (e0 + e * (a - middle), e * g, e * d, e0 + e * (c - middle),
            p0 + p * (a - middle), p * g, p * d, p0 + p * (c - middle))


@kernel
def replay_lagging(measured, torque, load, speed, friction, p, step_s, nu, variance, state):
    """Innovations of one wheel with a lagging recovery, as `replay.replay_wheel` writes them."""
    r, inertia = p[0], p[1]
    h = step_s / replay.SUBSTEPS
    noise = p[17] * p[17]
    omega, m, late = measured[0], 0.0, 0.0
    p00, p01, p11 = noise, 0.0, p[15] * p[15]
    p02, p12, p22 = 0.0, 0.0, _BEGINS * _BEGINS
    q_omega = (step_s * p[18] / inertia) ** 2 / replay.SUBSTEPS
    for k in range(measured.size):
        innovation = measured[k] - omega
        S = p00 + noise
        nu[k], variance[k] = innovation, S
        if abs(innovation) > 6.0 * math.sqrt(S):
            innovation = math.copysign(6.0 * math.sqrt(S), innovation)
        g0, g1, g2 = p00 / S, p01 / S, p02 / S
        omega += g0 * innovation
        m += g1 * innovation
        late = min(max(late + g2 * innovation, 0.0), 1.0)
        p11 -= g1 * p01
        p12 -= g1 * p02
        p22 -= g2 * p02
        p00, p01, p02 = p00 * (1.0 - g0), p01 * (1.0 - g0), p02 * (1.0 - g0)
        state[k] = m
        if k + 1 == measured.size:
            break
        for i in range(replay.SUBSTEPS):
            w = (i + 0.5) / replay.SUBSTEPS
            v = (1.0 - w) * speed[k] + w * speed[k + 1]
            N = (1.0 - w) * load[k] + w * load[k + 1]
            C = (1.0 - w) * torque[k] + w * torque[k + 1]
            degraded = (1.0 - w) * friction[0, k] + w * friction[0, k + 1]
            recovered = (1.0 - w) * friction[1, k] + w * friction[1, k + 1]
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
            e00, e01, e10, e11, b00, b01, b10, b11 = step_of(a, g, -r * rate * target, -rate * (1.0 - hangs), h)
            drive, pull = push * f - C / inertia, rate * (done - late)
            omega += b00 * drive + b01 * pull
            late = min(max(late + b10 * drive + b11 * pull, 0.0), 1.0)
            keep = math.exp(-v * h / p[16])
            m *= keep
            b0, b2 = b00 * push * f, b10 * push * f  # what m does to omega and lambda
            n00 = (e00 * e00 * p00 + e01 * e01 * p22 + b0 * b0 * p11
                   + 2.0 * (e00 * e01 * p02 + e00 * b0 * p01 + e01 * b0 * p12))
            n22 = (e10 * e10 * p00 + e11 * e11 * p22 + b2 * b2 * p11
                   + 2.0 * (e10 * e11 * p02 + e10 * b2 * p01 + e11 * b2 * p12))
            n02 = (e00 * e10 * p00 + e01 * e11 * p22 + b0 * b2 * p11
                   + (e00 * e11 + e01 * e10) * p02 + (e00 * b2 + e10 * b0) * p01 + (e01 * b2 + e11 * b0) * p12)
            n01 = keep * (e00 * p01 + e01 * p12 + b0 * p11)
            n12 = keep * (e10 * p01 + e11 * p12 + b2 * p11)
            q = p[15] * p[15] * (1.0 - keep * keep)
            p11 = keep * keep * p11 + q
            p00 = n00 + b0 * b0 * q / 3.0 + q_omega * (b00 / h) ** 2
            p02 = n02 + b0 * b2 * q / 3.0 + q_omega * b00 * b10 / (h * h)
            p22 = n22 + b2 * b2 * q / 3.0 + q_omega * (b10 / h) ** 2
            p01, p12 = n01 + 0.5 * b0 * q, n12 + 0.5 * b2 * q


@kernel
def replay_wheels(start, measured, torque, load, speed, friction, parameters, step_s, nu, variance, state):
    """Innovations of all segments, each by the filter that its `parameters` (segments, PARAMETERS) need."""
    for s in range(start.size - 1):
        a, b, p = start[s], start[s + 1], parameters[s]
        given = measured[a:b], torque[a:b], load[a:b], speed[a:b], friction[:, a:b]
        if p[14] > 0.0:
            replay_lagging(*given, p, step_s, nu[a:b], variance[a:b], state[a:b])
        else:
            replay.replay_wheel(*given, p, step_s, nu[a:b], variance[a:b], state[a:b])
