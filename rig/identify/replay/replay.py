"""Replays measured runs through the model; the innovations are what the model cannot predict.

Each wheel has an extended Kalman filter. Its inputs are the measured torque, load and vehicle
speed, and it predicts the next wheel speed. Its second state m is the irregularity of the rail, a
random walk with a spring in distance. It is noise and never an explanation. The vehicle has a
separate filter without an adhesion law: only torque, resistance and mass move it. If the model is
right, the innovations, divided by their predicted deviation, are white with variance 1.

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
from rollerrig.rig.identify.data.parameters import wheel_model

SUBSTEPS = 2
LARGEST_EXPONENT = 5.0  # of a step where adhesion falls steeply: the growth is limited to e^5
SMALLEST_EXPONENT = 1e-6  # below it (e^x - 1) / x is 1 + x / 2
OUTLIER_DEVIATIONS = 6.0  # a larger innovation moves the state no further than this one


@kernel_inlined
def curves(sliding, speed, load_N, degraded, recovered, model):
    """Return what `adhesion.curves` returns for one wheel with this load.

    `degraded` and `recovered` are factors of its two frictions, `model` is a WheelModel.
    """
    # a WheelModel has all fields of the law
    law = adhesion.law_for_contaminant(model.mu_cd * degraded, model.mu_cr * recovered, 1.0, model)
    return adhesion.curves(sliding, speed, load_N, model.eps1, law)


@kernel
def wheel_adhesion(sliding, speed, load_N, degraded, recovered, model, lagging, share):
    """Return (f, df/dsliding, lambda) of one wheel. f has the sign of the sliding.

    lambda goes a `share` of its way from `lagging` to its target [R4]. With a share of 1 recovery
    does not lag, and `lagging` has no effect.
    """
    f_d, f_r, slope_d, slope_r, k, slope_k = curves(
        sliding, speed, load_N, degraded, recovered, model
    )
    lagging_or_none = lagging if share < 1.0 else adhesion.NO_MEMORY
    f, lambda_, rise, lambda_slope = adhesion.f_and_lambda(
        f_d, f_r, slope_d, slope_r, k, slope_k, lagging_or_none, model.memory_of_work
    )
    if share < 1.0:
        lambda_ = lagging + share * (lambda_ - lagging)
        f = adhesion.between(f_d, f_r, lambda_)
        rise = adhesion.between(slope_d, slope_r, lambda_) + share * (f_r - f_d) * lambda_slope
    return math.copysign(f, sliding), rise, lambda_


@kernel
def lag_share(speed, step_s, model):
    """Return the share of its way that lambda goes in a step [R4]; 1: recovery does not lag."""
    if model.memory_m > 0.0:
        rate_1_s = adhesion.lag_rate_1_s(speed, model.memory_m, model.memory_speed_power)
        return -math.expm1(-step_s * rate_1_s)
    return 1.0


@kernel
def adhesion_along(sliding, speed, load, friction, row, step_s, lagging, follow, out):
    """Write (f, df/dsliding) of one wheel along a path to `out`, shape (2, n).

    `sliding`, `speed` and the wheelset's `load` have the shape (n,), the factors of `friction` (2,
    n). `row` (PARAMETERS,) is a row of parameters. `lagging` (n + 1,) is lambda before each sample;
    with `follow` it is written, otherwise only read.
    """
    model = wheel_model(row)
    for k in range(sliding.size):
        share = lag_share(speed[k], step_s, model)
        out[0, k], out[1, k], lambda_ = wheel_adhesion(
            sliding[k],
            speed[k],
            0.5 * load[k],
            friction[0, k],
            friction[1, k],
            model,
            lagging[k],
            share,
        )
        if follow:
            lagging[k + 1] = lambda_


class FilterState(NamedTuple):
    """The state of a wheel's filter: wheel speed, irregularity m, and their covariances."""

    omega: float  # rad/s
    m: float
    p00: float  # of omega
    p01: float
    p11: float  # of m


@kernel_inlined
def initial_state(measured, model):
    """Return the state of the filter before the first sample."""
    return FilterState(
        measured,
        0.0,
        model.speed_noise_rad_s * model.speed_noise_rad_s,
        0.0,
        model.irregularity_deviation * model.irregularity_deviation,
    )


@kernel_inlined
def bounded_innovation(innovation, variance):
    """Return the innovation, limited to `OUTLIER_DEVIATIONS` standard deviations."""
    largest = OUTLIER_DEVIATIONS * math.sqrt(variance)
    if abs(innovation) > largest:
        return math.copysign(largest, innovation)
    return innovation


@kernel_inlined
def correct(measured, state, model):
    """Return (innovation, its variance, the state) after a measured wheel speed."""
    omega, m, p00, p01, p11 = state
    innovation = measured - omega
    variance = p00 + model.speed_noise_rad_s * model.speed_noise_rad_s
    bounded = bounded_innovation(innovation, variance)
    gain_omega = p00 / variance
    gain_m = p01 / variance
    corrected = FilterState(
        omega + gain_omega * bounded,
        m + gain_m * bounded,
        p00 * (1.0 - gain_omega),
        p01 * (1.0 - gain_omega),
        p11 - gain_m * p01,
    )
    return innovation, variance, corrected


@kernel_inlined
def predict(state, speed, load, torque, degraded, recovered, model, step_s):
    """Return the state of the filter after a substep; `step_s` is the time of a whole sample."""
    omega, m, p00, p01, p11 = state
    r = model.wheel_radius_m
    inertia = model.wheelset_inertia_kgm2
    h = step_s / SUBSTEPS

    # exponential Euler step of the wheelset [R1]
    f, slope, _ = wheel_adhesion(
        speed - r * omega, speed, 0.5 * load, degraded, recovered, model, 0.0, 1.0
    )
    roughness = math.exp(m)
    drive_Nm = r * load * f * roughness
    error_rate_1_s = -r * r * load * slope * roughness / inertia  # d (domega/dt) / d omega
    x = error_rate_1_s * h
    if abs(x) > SMALLEST_EXPONENT:
        x = min(x, LARGEST_EXPONENT)
        growth = math.exp(x)
        mean_growth = math.expm1(x) / x
    else:
        growth = 1.0 + x
        mean_growth = 1.0 + 0.5 * x
    omega += h * mean_growth * (drive_Nm - torque) / inertia
    b = h * mean_growth * drive_Nm / inertia  # d omega after the step / d m
    keep = math.exp(-speed * h / model.irregularity_length_m)

    # covariances: what becomes of the old ones
    n00 = growth * growth * p00 + 2.0 * growth * b * p01 + b * b * p11
    n01 = keep * (growth * p01 + b * p11)
    # the noise of m acts on the wheel while it accumulates [R5]
    sigma = model.irregularity_deviation
    q = sigma * sigma * (1.0 - keep * keep)
    # the noise of the torque
    q_omega = (step_s * model.torque_noise_Nm / inertia) ** 2
    return FilterState(
        omega,
        m * keep,
        n00 + b * b * q / 3.0 + q_omega * mean_growth * mean_growth / SUBSTEPS,
        n01 + 0.5 * b * q,
        keep * keep * p11 + q,
    )


@kernel
def replay_wheel(measured, torque, load, speed, friction, row, step_s, nu, variance, field):
    """Write the innovations of one wheel [R1] to `nu`, their variance to `variance`, shape (n,).

    The filtered irregularity m is written to `field` (n,). The inputs have the shape (n,),
    `friction` (2, n), and `row` (PARAMETERS,) is the wheelset's row of parameters.
    """
    model = wheel_model(row)
    state = initial_state(measured[0], model)
    for k in range(measured.size):
        nu[k], variance[k], state = correct(measured[k], state, model)
        field[k] = state.m
        if k + 1 == measured.size:
            break
        for i in range(SUBSTEPS):
            w = (i + 0.5) / SUBSTEPS  # the middle of the substep, between the two samples
            state = predict(
                state,
                (1.0 - w) * speed[k] + w * speed[k + 1],
                (1.0 - w) * load[k] + w * load[k + 1],
                (1.0 - w) * torque[k] + w * torque[k + 1],
                (1.0 - w) * friction[0, k] + w * friction[0, k + 1],
                (1.0 - w) * friction[1, k] + w * friction[1, k + 1],
                model,
                step_s,
            )


@kernel
def replay_vehicle(measured, force_over_mass, step_s, noise, torque_noise, nu, variance):
    """Write the innovations of the vehicle's force balance [R3] and their variance, shape (n,).

    `noise` is that of `measured`, in m/s; `torque_noise` that of the force over mass, in m/s2 of
    one sample.
    """
    u = measured[0]
    p = noise * noise
    for k in range(measured.size):
        variance_of_sample = p + noise * noise
        nu[k] = measured[k] - u
        variance[k] = variance_of_sample
        gain = p / variance_of_sample
        u += gain * nu[k]
        p *= 1.0 - gain
        if k + 1 < measured.size:
            u -= 0.5 * step_s * (force_over_mass[k] + force_over_mass[k + 1])
            p += (step_s * torque_noise) ** 2
