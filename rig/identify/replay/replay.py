"""The filters that replay measured runs; the innovations are what the model cannot predict.

Each wheel has an extended Kalman filter. Its inputs are the measured torque, load and vehicle
speed, and it predicts the next wheel speed by the step of `wheel`. Its states are the wheel speed
and the irregularity m of the rail, and lambda where recovery has a memory: only a filter that knows
lambda can distinguish a lag of recovery from irregularity. m is a random walk with a spring in
distance. It is noise and never an explanation. The vehicle has a separate filter without an
adhesion law: only torque, resistance and mass move it. If the model is right, the innovations,
divided by their predicted deviation, are white with variance 1.

    [R2] m: Ornstein-Uhlenbeck in distance, deviation sigma, correlation length L
    [R3] u = v + sum J omega / (M r), du/dt = -(sum C / r + resistance) / M
    [R5] cov of (omega, m) after a step h: (b^2 q / 3, b q / 2, q), q = sigma^2 (1 - e^(-2vh/L)),
         b = d omega / d m in h; without it m would come half a step late and look like a delay.
         The same holds for (lambda, m)

Source: Simon, Optimal State Estimation (2006), section 13.2.
Limits: first-order filter; two substeps a sample keep its bias below the noise.
"""

import math
from typing import NamedTuple

from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.identify.replay import wheel

# steps of the filter a sample: its bias stays below the noise
SUBSTEPS = 2
OUTLIER_DEVIATIONS = 6.0  # a larger innovation moves the state no further than this one
_INITIAL_DEVIATION = 0.02  # of lambda at the start, when the wheel rolls


class FilterState(NamedTuple):
    """The state of a wheel's filter: wheel speed, irregularity m, lambda, and their covariances.

    lambda and its covariances are 0 in a model without memory.
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
def initial_state(measured, model):
    """Return the state of the filter before the first sample."""
    deviation = _INITIAL_DEVIATION if model.memory_m > 0.0 else 0.0
    return FilterState(
        omega=measured,
        m=0.0,
        lambda_=0.0,
        p00=model.speed_noise_rad_s * model.speed_noise_rad_s,
        p01=0.0,
        p11=model.irregularity_deviation * model.irregularity_deviation,
        p02=0.0,
        p12=0.0,
        p22=deviation * deviation,
    )


@kernel_inlined
def correct(measured, state, model):
    """Return (innovation, its variance, the state) after a measured wheel speed."""
    innovation = measured - state.omega
    variance = state.p00 + model.speed_noise_rad_s * model.speed_noise_rad_s
    largest = OUTLIER_DEVIATIONS * math.sqrt(variance)
    bounded = min(max(innovation, -largest), largest)
    per_variance = 1.0 / variance
    gain_omega = state.p00 * per_variance
    gain_m = state.p01 * per_variance
    gain_lambda = state.p02 * per_variance
    corrected = FilterState(
        omega=state.omega + gain_omega * bounded,
        m=state.m + gain_m * bounded,
        lambda_=min(max(state.lambda_ + gain_lambda * bounded, 0.0), 1.0),
        p00=state.p00 * (1.0 - gain_omega),
        p01=state.p01 * (1.0 - gain_omega),
        p11=state.p11 - gain_m * state.p01,
        p02=state.p02 * (1.0 - gain_omega),
        p12=state.p12 - gain_m * state.p02,
        p22=state.p22 - gain_lambda * state.p02,
    )
    return innovation, variance, corrected


@kernel_inlined
def predict(state, speed, load, torque, degraded, recovered, model, step_s, memory):
    """Return the state of the filter after a substep.

    `step_s` is the time of a whole sample. `memory` is None for models whose recovery has none:
    then the filter is compiled without its third state.
    """
    h = step_s / SUBSTEPS
    lambda_ = None if memory is None else state.lambda_
    step = wheel.wheel_step(
        state.omega, lambda_, state.m, speed, load, torque, degraded, recovered, model, h
    )
    keep = math.exp(-speed * h / model.irregularity_length_m)
    # the noise of m acts on the wheel while it accumulates [R5]
    sigma = model.irregularity_deviation
    q = sigma * sigma * (1.0 - keep * keep)
    # the noise of the torque, as accelerations that are constant in a substep
    q_rate = SUBSTEPS * (model.torque_noise_Nm / model.wheelset_inertia_kgm2) ** 2

    e00 = step.e00
    b0 = step.b00 * step.drive_rad_s2  # d omega after the step / d m
    p00 = e00 * e00 * state.p00 + b0 * b0 * (state.p11 + q / 3.0) + 2.0 * e00 * b0 * state.p01
    p00 += q_rate * step.b00 * step.b00
    p01 = keep * (e00 * state.p01 + b0 * state.p11) + 0.5 * b0 * q
    p02 = 0.0
    p12 = 0.0
    p22 = 0.0
    if memory is not None:
        # what lambda adds
        e01 = step.e01
        e10 = step.e10
        e11 = step.e11
        b2 = step.b10 * step.drive_rad_s2  # d lambda after the step / d m
        p00 += e01 * (e01 * state.p22 + 2.0 * (e00 * state.p02 + b0 * state.p12))
        p01 += keep * e01 * state.p12
        p02 = (
            e00 * e10 * state.p00
            + e01 * e11 * state.p22
            + b0 * b2 * (state.p11 + q / 3.0)
            + (e00 * e11 + e01 * e10) * state.p02
            + (e00 * b2 + e10 * b0) * state.p01
            + (e01 * b2 + e11 * b0) * state.p12
            + q_rate * step.b00 * step.b10
        )
        p12 = keep * (e10 * state.p01 + e11 * state.p12 + b2 * state.p11) + 0.5 * b2 * q
        p22 = (
            e10 * e10 * state.p00
            + e11 * e11 * state.p22
            + b2 * b2 * (state.p11 + q / 3.0)
            + 2.0 * (e10 * e11 * state.p02 + e10 * b2 * state.p01 + e11 * b2 * state.p12)
            + q_rate * step.b10 * step.b10
        )
    return FilterState(
        omega=step.omega,
        m=state.m * keep,
        lambda_=step.lambda_,
        p00=p00,
        p01=p01,
        p11=keep * keep * state.p11 + q,
        p02=p02,
        p12=p12,
        p22=p22,
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
