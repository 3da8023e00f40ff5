"""Replays a wheel whose recovery lags: the filter of `replay` with lambda as a third state.

An error of the wheel's speed changes the recovery, and that changes the wheel's speed. Only a
filter that knows this can distinguish a lag from irregularity of the rail. Speed and lambda take an
exact step of the linearised pair in each substep. The irregularity accumulates meanwhile as in
`replay`.

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
from rollerrig.rig.identify.data.parameters import MEMORY
from rollerrig.rig.identify.replay import replay

_INITIAL_DEVIATION = 0.02  # of lambda at the start, when the wheel rolls


class MemoryFilterState(NamedTuple):
    """The state of a wheel's filter: wheel speed, irregularity m, lambda, and their covariances.

    The first two fields are those of `replay.FilterState`.
    """

    omega: float  # rad/s
    m: float
    lambda_: float
    p00: float  # of omega
    p01: float  # of omega and m
    p11: float  # of m
    p02: float  # of omega and lambda
    p12: float  # of m and lambda
    p22: float  # of lambda


@kernel_inlined
def phi(z, exponential):
    """Return (e^z - 1) / z; `exponential` is e^z."""
    return (exponential - 1.0) / z if abs(z) > 1e-4 else 1.0 + 0.5 * z + z * z / 6.0


@kernel_inlined
def matrix_step(a, g, d, c, h):
    """Return e^(A h) and phi(A h) h of A = [[a, g], [d, c]], row by row: eight numbers [Y2].

    Both are e0 + e (A - middle), of the mean eigenvalue `middle` and half the distance `root` of
    the eigenvalues.
    """
    middle = 0.5 * (a + c)
    square = 0.25 * (a - c) ** 2 + g * d
    root = math.sqrt(abs(square))
    equal = root * h < 1e-5  # the eigenvalues are so close that their difference loses all digits
    if equal:
        root = 1e-5 / h

    # two real eigenvalues; a growth of more than e^5 in a substep is limited
    z1 = min((middle + root) * h, replay.LARGEST_EXPONENT)
    z2 = (middle - root) * h
    e1 = math.exp(z1)
    e2 = math.exp(z2)
    p1 = phi(z1, e1) * h
    p2 = phi(z2, e2) * h
    e = (e1 - e2) / (2.0 * root)
    p = (p1 - p2) / (2.0 * root)
    e0 = 0.5 * (e1 + e2)
    p0 = 0.5 * (p1 + p2)

    if not equal and square <= 0.0:
        # a pair of conjugate eigenvalues x + i y
        x = min(middle * h, replay.LARGEST_EXPONENT)
        y = root * h
        power = math.exp(x)
        size = x * x + y * y
        real = power * math.cos(y)
        imaginary = power * math.sin(y)
        if size > 1e-8:
            phi_real = ((real - 1.0) * x + imaginary * y) / size
            phi_imaginary = (imaginary * x - (real - 1.0) * y) / size
        else:
            phi_real = 1.0 + 0.5 * x + (x * x - y * y) / 6.0
            phi_imaginary = 0.5 * y + x * y / 3.0
        e = imaginary / root
        p = phi_imaginary * h / root
        e0 = real
        p0 = phi_real * h

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
def initial_state(measured, model):
    """Return the state of the filter before the first sample."""
    return MemoryFilterState(
        measured,
        0.0,
        0.0,
        model.speed_noise_rad_s * model.speed_noise_rad_s,
        0.0,
        model.irregularity_deviation * model.irregularity_deviation,
        0.0,
        0.0,
        _INITIAL_DEVIATION * _INITIAL_DEVIATION,
    )


@kernel_inlined
def correct(measured, state, model):
    """Return (innovation, its variance, the state) after a measured wheel speed."""
    omega, m, lambda_, p00, p01, p11, p02, p12, p22 = state
    innovation = measured - omega
    variance = p00 + model.speed_noise_rad_s * model.speed_noise_rad_s
    bounded = replay.bounded_innovation(innovation, variance)
    gain_omega = p00 / variance
    gain_m = p01 / variance
    gain_lambda = p02 / variance
    corrected = MemoryFilterState(
        omega + gain_omega * bounded,
        m + gain_m * bounded,
        min(max(lambda_ + gain_lambda * bounded, 0.0), 1.0),
        p00 * (1.0 - gain_omega),
        p01 * (1.0 - gain_omega),
        p11 - gain_m * p01,
        p02 * (1.0 - gain_omega),
        p12 - gain_m * p02,
        p22 - gain_lambda * p02,
    )
    return innovation, variance, corrected


@kernel_inlined
def predict(state, speed, load, torque, degraded, recovered, model, step_s):
    """Return the state of the filter after a substep; `step_s` is the time of a whole sample."""
    omega, m, lambda_, p00, p01, p11, p02, p12, p22 = state
    r = model.wheel_radius_m
    inertia = model.wheelset_inertia_kgm2
    h = step_s / replay.SUBSTEPS

    # adhesion at this lambda, and the lambda that recovery tends to
    s = speed - r * omega
    f_d, f_r, slope_d, slope_r, k, slope_k = replay.curves(
        s, speed, 0.5 * load, degraded, recovered, model
    )
    _, target, _, slope_of_target = adhesion.f_and_lambda(
        f_d, f_r, slope_d, slope_r, k, slope_k, lambda_, model.memory_of_work
    )
    target_by_lambda = 0.0  # d lambda_0 / d lambda
    if model.memory_of_work > 0.0:
        target_by_lambda = (1.0 - target) * k * (f_r - f_d)
    target_by_sliding = math.copysign(slope_of_target, s)  # d lambda_0 / ds
    lag_1_s = adhesion.lag_rate_1_s(
        max(speed, adhesion.SPEED_FLOOR_M_S), model.memory_m, model.memory_speed_power
    )

    # the linearised pair [Y1]
    push = r * load * math.exp(m) / inertia
    sign = 1.0 if s >= 0.0 else -1.0
    f = sign * adhesion.between(f_d, f_r, lambda_)
    e00, e01, e10, e11, b00, b01, b10, b11 = matrix_step(
        -r * push * adhesion.between(slope_d, slope_r, lambda_),
        push * (f_r - f_d) * sign,
        -r * lag_1_s * target_by_sliding,
        -lag_1_s * (1.0 - target_by_lambda),
        h,
    )
    omega_rate = push * f - torque / inertia
    lambda_rate = lag_1_s * (target - lambda_)
    omega += b00 * omega_rate + b01 * lambda_rate
    lambda_ = min(max(lambda_ + b10 * omega_rate + b11 * lambda_rate, 0.0), 1.0)

    # covariances: what becomes of the old ones; b0 and b2 are what m does to omega and lambda
    keep = math.exp(-speed * h / model.irregularity_length_m)
    b0 = b00 * push * f
    b2 = b10 * push * f
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

    # the noise of m acts while it accumulates (`replay` [R5]); q_omega is the noise of the torque
    sigma = model.irregularity_deviation
    q = sigma * sigma * (1.0 - keep * keep)
    q_omega = (step_s * model.torque_noise_Nm / inertia) ** 2 / replay.SUBSTEPS
    return MemoryFilterState(
        omega,
        m * keep,
        lambda_,
        n00 + b0 * b0 * q / 3.0 + q_omega * (b00 / h) ** 2,
        n01 + 0.5 * b0 * q,
        keep * keep * p11 + q,
        n02 + b0 * b2 * q / 3.0 + q_omega * b00 * b10 / (h * h),
        n12 + 0.5 * b2 * q,
        n22 + b2 * b2 * q / 3.0 + q_omega * (b10 / h) ** 2,
    )


_replay_wheel_with_memory = variant(
    replay.replay_wheel, initial_state=initial_state, correct=correct, predict=predict
)


@kernel
def replay_wheels(
    start, measured, torque, load, speed, friction, parameters, step_s, nu, variance, field
):
    """Write the innovations of all segments as `replay.replay_wheel` does, one after the other.

    `start` (segments + 1,) is where the segments begin and end in the flat arrays, `parameters` has
    the shape (segments, PARAMETERS). Each segment has the filter that its parameters need.
    """
    for s in range(start.size - 1):
        a = start[s]
        b = start[s + 1]
        row = parameters[s]
        inputs = measured[a:b], torque[a:b], load[a:b], speed[a:b], friction[:, a:b]
        if row[MEMORY] > 0.0:
            _replay_wheel_with_memory(*inputs, row, step_s, nu[a:b], variance[a:b], field[a:b])
        else:
            replay.replay_wheel(*inputs, row, step_s, nu[a:b], variance[a:b], field[a:b])
