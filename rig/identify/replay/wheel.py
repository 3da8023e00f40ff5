"""A wheelset under its brake: the adhesion and one time step, with their derivatives.

The filter of measured runs, simulated stops and the windows of the paper's validation all take
this step. The adhesion law is that of the plant, `adhesion`. Its inputs are the torque, the load
and the speed of the surface; exp(m) is a factor of the adhesion, the irregularity of the rail. Over
a step the equation is linearised and solved exactly. Without memory of recovery its state is the
wheel speed. With memory the remembered lambda is a second state: an error of the wheel speed
changes the recovery, and that changes the wheel speed.

    [R1] J domega/dt = r N f(v - r omega, v, N) exp(m) - C
    [R4] d lambda/dt = (lambda_0 - lambda) rate, `adhesion` [A7]; f is then that of lambda
    [Y1] d/dt (omega, lambda) = A (omega, lambda) + ...,
         A = [[-r^2 N f'_lambda e^m, r N (f_r - f_d) e^m] / J, [-r lambda_0', h - 1] rate],
         h = d lambda_0 / d lambda, 0 unless lambda_0 is that of the work done
    [Y2] step e^(A h), inputs phi(A h) h with phi(z) = (e^z - 1) / z, on the two eigenvalues of A

Source: Hochbruck and Ostermann, Exponential integrators (2010), section 2.
"""

import math
from typing import NamedTuple

from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.contact import adhesion

LARGEST_EXPONENT = 5.0  # of a step where adhesion falls steeply: the growth is limited to e^5
# eigenvalues whose half distance times the step is smaller count as this far apart: their
# difference has lost its digits
_LEAST_DISTANCE = 1e-5
_SMALL = 1e-4  # phi(z) is its series below it


class WheelAdhesion(NamedTuple):
    """The adhesion of a wheel; slopes are derivatives to the magnitude of sliding."""

    f: float  # with the sign of the sliding
    slope_s_m: float  # at constant lambda where recovery has a memory
    slope_by_lambda_s_m: float  # its change with lambda
    degraded: float  # magnitudes of the limits f_d and f_r
    recovered: float
    lambda_0: float  # transition without memory
    lambda_0_slope_s_m: float
    lambda_0_by_lambda: float  # h of [Y1]


@kernel_inlined
def wheel_adhesion(sliding_m_s, speed_m_s, load_N, degraded, recovered, model, lambda_):
    """Return the `WheelAdhesion` of one wheel by the law of the plant.

    Parameters
    ----------
    sliding_m_s : sliding of either sign
    speed_m_s : speed of the surface
    load_N : load on one wheel
    degraded, recovered : factors of the two frictions
    model : `WheelModel`
    lambda_ : remembered lambda by which the contact has recovered; None: recovery has no memory
    """
    # a WheelModel has all fields of the law
    law = adhesion.law_for_contaminant(model.mu_cd * degraded, model.mu_cr * recovered, 1.0, model)
    f_d, f_r, slope_d, slope_r, k, slope_k = adhesion.curves(
        sliding_m_s, speed_m_s, load_N, model.eps1, law
    )
    remembered = adhesion.NO_MEMORY if lambda_ is None else lambda_
    f, lambda_0, slope, slope_of_lambda_0 = adhesion.f_and_lambda(
        f_d, f_r, slope_d, slope_r, k, slope_k, remembered, model.memory_of_work
    )
    by_lambda = 0.0
    if lambda_ is not None:
        f = adhesion.between(f_d, f_r, lambda_)
        slope = adhesion.between(slope_d, slope_r, lambda_)
        if model.memory_of_work > 0.0:
            by_lambda = (1.0 - lambda_0) * k * (f_r - f_d)
    return WheelAdhesion(
        math.copysign(f, sliding_m_s),
        slope,
        slope_r - slope_d,
        f_d,
        f_r,
        lambda_0,
        slope_of_lambda_0,
        by_lambda,
    )


class WheelStep(NamedTuple):
    """A wheelset after a step, and what the step makes of small changes [Y2]."""

    omega: float  # rad/s; a braked wheel that locks would turn backwards: the caller limits it
    lambda_: float
    e00: float  # of omega, by a change of omega before the step
    e01: float  # of omega, by lambda
    e10: float  # of lambda, by omega
    e11: float  # of lambda, by lambda
    b00: float  # of omega, by an acceleration during the step
    b10: float  # of lambda, by an acceleration during the step
    drive_rad_s2: float  # acceleration by the contact, which is also its change with m


@kernel_inlined
def wheel_step(omega, lambda_, m, speed, load, torque, degraded, recovered, model, h):
    """Return the `WheelStep` of a wheelset in a step of h seconds.

    `omega` is the wheel speed in rad/s, `m` the irregularity, `speed` that of the surface in m/s,
    `load` that of the wheelset in N, `torque` that of its brake in N m. The other arguments are
    those of `wheel_adhesion`.
    """
    r = model.wheel_radius_m
    sliding = speed - r * omega
    a = wheel_adhesion(sliding, speed, 0.5 * load, degraded, recovered, model, lambda_)
    push = r * load * math.exp(m) / model.wheelset_inertia_kgm2  # acceleration for f = 1
    drive = push * a.f
    omega_rate = drive - torque / model.wheelset_inertia_kgm2
    error_rate_1_s = -r * push * a.slope_s_m  # d (domega/dt) / d omega
    if lambda_ is None:
        x = min(error_rate_1_s * h, LARGEST_EXPONENT)
        growth = math.exp(x)
        b00 = h * phi(x, growth)
        return WheelStep(omega + b00 * omega_rate, 0.0, growth, 0.0, 0.0, 0.0, b00, 0.0, drive)

    lag_1_s = adhesion.lag_rate_1_s(
        max(speed, adhesion.SPEED_FLOOR_M_S), model.memory_m, model.memory_speed_power
    )
    sign = 1.0 if sliding >= 0.0 else -1.0
    e00, e01, e10, e11, b00, b01, b10, b11 = matrix_step(
        error_rate_1_s,
        push * (a.recovered - a.degraded) * sign,
        -r * lag_1_s * a.lambda_0_slope_s_m * sign,
        -lag_1_s * (1.0 - a.lambda_0_by_lambda),
        h,
    )
    lambda_rate = lag_1_s * (a.lambda_0 - lambda_)
    following = lambda_ + b10 * omega_rate + b11 * lambda_rate
    return WheelStep(
        omega + b00 * omega_rate + b01 * lambda_rate,
        min(max(following, 0.0), 1.0),
        e00,
        e01,
        e10,
        e11,
        b00,
        b10,
        drive,
    )


@kernel_inlined
def phi(z, exponential):
    """Return (e^z - 1) / z; `exponential` is e^z."""
    return (exponential - 1.0) / z if abs(z) > _SMALL else 1.0 + 0.5 * z + z * z / 6.0


@kernel_inlined
def matrix_step(a, g, d, c, h):
    """Return e^(A h) and phi(A h) h of A = [[a, g], [d, c]], row by row: eight numbers [Y2].

    Both are e0 + e (A - middle), of the mean eigenvalue `middle` and half the distance `root` of
    the eigenvalues.
    """
    middle = 0.5 * (a + c)
    square = 0.25 * (a - c) ** 2 + g * d
    root = math.sqrt(abs(square))
    equal = root * h < _LEAST_DISTANCE
    if equal:
        root = _LEAST_DISTANCE / h

    # two real eigenvalues; a growth of more than e^5 in a step is limited
    z1 = min((middle + root) * h, LARGEST_EXPONENT)
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
        x = min(middle * h, LARGEST_EXPONENT)
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
def lag_share(speed, step_s, model):
    """Return the share of its way that lambda goes in a step to a constant lambda_0 [R4]."""
    rate_1_s = adhesion.lag_rate_1_s(speed, model.memory_m, model.memory_speed_power)
    return -math.expm1(-step_s * rate_1_s)
