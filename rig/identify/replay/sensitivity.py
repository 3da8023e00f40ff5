"""Linearises the filter: how the innovations of a replay respond to a small change of anything.

Any cause changes the acceleration of a wheel by some course in time. The filter transmits that
course to its innovations linearly, with coefficients that one replay provides. So the response to
hundreds of possible causes costs little more than one replay.

    [S1] g = (r N f exp(m) - C) / J;  d omega' = F00 d omega + F01 d m + H d g,  d m' = keep d m
    [S2] d nu = -d omega;  after the sample d omega -= g0 d omega, d m -= g1 d omega
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import exprel

from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.parameters import wheel_model
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.replay import lanes, replay, wheel

# A change of the wheel's acceleration is known for a change of the logarithm of each of these; the
# last one is the irregularity m.
RATES = ("friction", "load", "radius", "irregularity")
STEP = 0.01  # change of the logarithm of a parameter, by which its derivative is taken
# A smaller response counts as 0: products of such numbers are subnormal, which is a hundred times
# slower.
LEAST_RESPONSE = 1e-16

# columns of the coefficients [S1], [S2]
F00 = 0
F01 = 1
KEEP = 2
H = 3
G0 = 4
G1 = 5
_COEFFICIENTS = 6


class LinearisedReplay(NamedTuple):
    """A replay with its coefficients. Arrays are flat (n,) where no other shape is stated."""

    nu: np.ndarray  # innovations of the wheels
    variance: np.ndarray
    field: np.ndarray  # filtered irregularity m
    coefficients: np.ndarray  # (n, 6), columns F00 .. G1
    rates: np.ndarray  # (RATES, n), change of the acceleration
    constants: np.ndarray  # (changes, n), the same for changed parameters, over STEP
    # of the filter after each sample, so known before the next sample
    sliding_m_s: np.ndarray
    energy_J_m: np.ndarray
    acceleration_rad_s2: np.ndarray
    vehicle_nu: np.ndarray  # innovations of the vehicles
    vehicle_variance: np.ndarray


class Innovations(NamedTuple):
    """The innovations of a replay of all wheels (n,) and vehicles (vehicle samples,)."""

    nu: np.ndarray
    variance: np.ndarray
    field: np.ndarray  # filtered irregularity m
    vehicle_nu: np.ndarray
    vehicle_variance: np.ndarray


class Inputs(NamedTuple):
    """The inputs of a replay, as causes have changed them."""

    torque_Nm: np.ndarray
    load_N: np.ndarray
    speed_m_s: np.ndarray
    friction: np.ndarray  # (2, n) factors of the degraded and of the recovered friction
    parameters: np.ndarray  # (segments, PARAMETERS)
    mass_kg: np.ndarray  # (runs,)
    force_N: np.ndarray  # (vehicle samples,) added to the resistance


@kernel
def second_gain(variance, coefficients, row):
    """Write the second gain of the filter of one wheel to the column G1 of the coefficients.

    The covariances are computed again with [S1]. Column F00 is limited where the covariance of the
    filter shows that an error grows more slowly.
    """
    model = wheel_model(row)
    noise = model.speed_noise_rad_s * model.speed_noise_rad_s
    sigma_squared = model.irregularity_deviation * model.irregularity_deviation
    p00 = noise
    p01 = 0.0
    p11 = sigma_squared
    for k in range(variance.size):
        # after the sample
        coefficients[k, G1] = p01 / variance[k]
        g0 = coefficients[k, G0]
        p11 -= p01 * p01 / variance[k]
        p01 *= 1.0 - g0
        p00 = max(variance[k] - noise, 0.0) * (1.0 - g0)

        if k + 1 < variance.size:
            # the covariance of the filter limits how fast it lets an error grow
            largest = math.sqrt(max(variance[k + 1] - noise, 0.0) / max(p00, 1e-12))
            coefficients[k, F00] = min(coefficients[k, F00], largest)

        # until the next sample
        f00 = coefficients[k, F00]
        f01 = coefficients[k, F01]
        keep = coefficients[k, KEEP]
        q = sigma_squared * (1.0 - keep * keep)
        p01 = keep * (f00 * p01 + f01 * p11) + 0.5 * f01 * q
        p11 = keep * keep * p11 + q


@kernel
def response(changes, variance, coefficients, d_omega, d_m, out):
    """Write the response of one wheel's whitened innovations to `out`, shape (n, columns) [S2].

    `changes` (n, columns) are changes of the wheel's acceleration, `d_omega` and `d_m` (columns,)
    are work space with zeros.
    """
    columns = changes.shape[1]
    for k in range(changes.shape[0]):
        scale = 1.0 / math.sqrt(variance[k])
        f00 = coefficients[k, F00]
        f01 = coefficients[k, F01]
        keep = coefficients[k, KEEP]
        h = coefficients[k, H]
        g0 = coefficients[k, G0]
        g1 = coefficients[k, G1]
        for c in range(columns):
            w = d_omega[c]
            out[k, c] = -w * scale if abs(w * scale) > LEAST_RESPONSE else 0.0
            m = d_m[c] - g1 * w
            w -= g0 * w
            d_omega[c] = f00 * w + f01 * m + h * changes[k, c]
            d_m[c] = keep * m


@kernel
def vehicle_response(changes, variance, noise, step_s, d_u, out):
    """Write the response of the whitened innovations of one vehicle to `out`, shape (n, columns).

    `changes` (n, columns) are changes of du/dt, `noise` is that of the vehicle's speed, `d_u`
    (columns,) is work space with zeros.
    """
    columns = changes.shape[1]
    for k in range(changes.shape[0]):
        scale = 1.0 / math.sqrt(variance[k])
        remaining = noise * noise / variance[k]
        last = k + 1 == changes.shape[0]
        for c in range(columns):
            out[k, c] = -d_u[c] * scale if abs(d_u[c] * scale) > LEAST_RESPONSE else 0.0
            if not last:
                d_u[c] = remaining * d_u[c] + 0.5 * step_s * (changes[k, c] + changes[k + 1, c])


@kernel
def add_squares(squares, columns, places, A):
    """Add the products of whitened courses to the normal equations A (columns, columns).

    `squares` (courses, courses) are the products, `columns` (used,) the numbers of the columns that
    act, `places` (used,) those of their courses.
    """
    for i in range(columns.size):
        for j in range(columns.size):
            A[columns[i], columns[j]] += squares[places[i], places[j]]


def linearise(
    design: Design, inputs: Inputs, changed: np.ndarray, replayed: Innovations | None = None
) -> LinearisedReplay:
    """Return the replay of all wheels and vehicles, with its coefficients.

    `changed` (segments, changes, PARAMETERS) are parameters of which one is larger by STEP.
    `replayed` are the innovations of these inputs, if they are known.
    """
    n = design.measured_rad_s.size
    if replayed is None:
        replayed = innovations(design, inputs)
    linear = LinearisedReplay(
        nu=replayed.nu,
        variance=replayed.variance,
        field=replayed.field,
        coefficients=np.empty((n, _COEFFICIENTS)),
        rates=np.empty((len(RATES), n)),
        constants=np.empty((changed.shape[1], n)),
        sliding_m_s=np.empty(n),
        energy_J_m=np.empty(n),
        acceleration_rad_s2=np.empty(n),
        vehicle_nu=replayed.vehicle_nu,
        vehicle_variance=replayed.vehicle_variance,
    )
    for s in range(design.segments):
        _linearise_wheel(design, inputs, s, changed[s], linear)
        at = design.span(s)
        second_gain(linear.variance[at], linear.coefficients[at], inputs.parameters[s])
    return linear


def _linearise_wheel(
    design: Design, inputs: Inputs, s: int, changed: np.ndarray, linear: LinearisedReplay
) -> None:
    """Write [S1] of the segment s along the filtered path.

    `changed` (changes, PARAMETERS) are the changed parameters of this segment.
    """
    at = design.span(s)
    row = inputs.parameters[s]
    nu = linear.nu[at]
    variance = linear.variance[at]
    rates = linear.rates[:, at]
    coefficients = linear.coefficients[at]
    r = row[parameters.RADIUS]
    inertia = row[parameters.INERTIA]
    h = design.step_s / replay.SUBSTEPS

    # the filter after each sample
    p00 = np.maximum(variance - row[parameters.SPEED_NOISE] ** 2, 0.0)
    g0 = p00 / variance
    omega = design.measured_rad_s[at] - nu + g0 * nu
    v = inputs.speed_m_s[at]
    load_N = inputs.load_N[at]
    sliding = v - r * omega
    path = np.array([sliding, v, load_N, *inputs.friction[:, at]])
    lagging = np.zeros(v.size + 1)
    f, slope, _, _ = replay_law(path, row, design.step_s, lagging, follow=True)
    force = r * load_N * np.exp(linear.field[at]) / inertia  # acceleration for an adhesion of 1
    linear.sliding_m_s[at] = sliding
    linear.energy_J_m[at] = f * 0.5 * load_N * sliding / v
    linear.acceleration_rad_s2[at] = force * f - inputs.torque_Nm[at] / inertia

    # two substeps of the filter, as in `replay.predict`
    error_rate_1_s = -r * slope * force  # d (domega/dt) / d omega
    x = np.minimum(error_rate_1_s * h, wheel.LARGEST_EXPONENT)
    growth = np.exp(x)
    keep = np.exp(-v * h / row[parameters.IRREGULARITY_LENGTH])
    mean_growth = exprel(x)
    of_irregularity = h * mean_growth * force * f
    coefficients[:, F00] = growth * growth
    coefficients[:, F01] = of_irregularity * (growth + keep)
    coefficients[:, KEEP] = keep * keep
    coefficients[:, H] = h * mean_growth * (1.0 + growth)
    coefficients[:, G0] = g0

    def adhesion_with(path: np.ndarray, model: np.ndarray) -> np.ndarray:
        """Return f along the same sliding, with other inputs or parameters."""
        return replay_law(path, model, design.step_s, lagging)[0]

    larger_N = load_N * (1.0 + STEP)
    with_friction = np.array([sliding, v, load_N, *(inputs.friction[:, at] * math.exp(STEP))])
    with_load = np.array([sliding, v, larger_N, *inputs.friction[:, at]])
    rates[0] = force * (adhesion_with(with_friction, row) - f) / STEP
    rates[1] = force * (adhesion_with(with_load, row) * larger_N / load_N - f) / STEP
    # a larger radius is a longer lever, and less sliding
    rates[2] = force * f + error_rate_1_s * omega
    rates[3] = force * f
    for i, other_row in enumerate(changed):
        linear.constants[i, at] = force * (adhesion_with(path, other_row) - f) / STEP


def replay_law(
    path: np.ndarray,
    row: np.ndarray,
    step_s: float = 0.0,
    lagging: np.ndarray | None = None,
    follow: bool = False,
) -> np.ndarray:
    """Return (f, df/dsliding, f_d, f_r) of one wheel along a path, shape (4, n).

    Parameters
    ----------
    path : (5, n), sliding and speed in m/s, load of the wheelset in N, factors of both frictions
    row : (PARAMETERS,), parameters of the wheelset
    step_s, lagging, follow : where recovery has a memory: time of a sample, lambda before each
        sample (n + 1,), and whether it is written
    """
    out = np.empty((lanes.PATH_RESULTS, path.shape[1]))
    if row[parameters.MEMORY] > 0.0:
        lanes.lagging_adhesion_along(path, row, step_s, lagging, follow, out)
        return out
    cells = np.empty(lanes.PATH_CELLS)
    lanes.adhesion_along(path, row, None, cells, out)
    # the vector code gives NaN where recovered adhesion is below degraded
    if not np.all(np.isfinite(out)):
        lanes.adhesion_along(path, row, True, cells, out)
    return out


def innovations(design: Design, inputs: Inputs) -> Innovations:
    """Return the innovations of all wheels and vehicles."""
    nu, variance, field = replay_wheels(design, inputs)
    vehicle_nu, vehicle_variance = replay_vehicles(design, inputs)
    return Innovations(nu, variance, field, vehicle_nu, vehicle_variance)


def replay_wheels(design: Design, inputs: Inputs) -> np.ndarray:
    """Return (nu, variance, filtered m) of all wheels, shape (3, n)."""
    return replays(design, [inputs])[0]


def replays(design: Design, several: Sequence[Inputs]) -> np.ndarray:
    """Return the replays of all wheels under each of several inputs, shape (inputs, 3, n)."""
    axles = design.axles
    out = np.empty((len(several), 3, design.measured_rad_s.size))
    runs: dict[bool, list[lanes.Run]] = {False: [], True: []}  # by whether recovery has a memory
    for i, out_of_inputs in zip(several, out, strict=True):
        stacked = np.array([i.speed_m_s, i.load_N, i.torque_Nm, *i.friction])
        has_memory = bool(np.any(i.parameters[:, parameters.MEMORY] > 0.0))
        for first in range(0, design.segments, axles):
            run = lanes.Run(
                start=design.start[first : first + axles + 1],
                measured_rad_s=design.measured_rad_s,
                inputs=stacked,
                parameters=i.parameters[first : first + axles],
                out=out_of_inputs,
            )
            runs[has_memory].append(run)
    for has_memory, alike in runs.items():
        _replay_pairs(alike, design.step_s, has_memory or None)
    return out


def _replay_pairs(runs: list[lanes.Run], step_s: float, memory: bool | None) -> None:
    """Replay runs whose models have the same states; `memory` as for `lanes.replay_runs`.

    Two runs are replayed simultaneously, the longest first: a pair takes as long as its longer run.
    The last one of an odd number is replayed together with itself.
    """
    cells = np.empty(lanes.CELLS)
    longest_first = sorted(runs, key=lambda run: int(run.start[0] - run.start[-1]))
    seconds = longest_first[1::2] + longest_first[-1:]
    for run, other in zip(longest_first[::2], seconds, strict=False):
        lanes.replay_runs(run, other, step_s, memory, None, cells)
        # what the vector code cannot compute is NaN
        if not (_is_finite(run) and _is_finite(other)):
            lanes.replay_runs(run, other, step_s, memory, True, cells)


def _is_finite(run: lanes.Run) -> bool:
    """Return whether the innovations of a run are finite."""
    return bool(np.all(np.isfinite(run.out[0, run.start[0] : run.start[-1]])))


def momentum_m_s(design: Design, inputs: Inputs, run: int) -> np.ndarray:
    """Return the measured u of [R3] of `replay`, shape (samples,)."""
    axles = design.axles
    p = inputs.parameters[run * axles : (run + 1) * axles]
    turning = design.by_axle(design.turning_rad_s, run) @ (
        p[:, parameters.INERTIA] / p[:, parameters.RADIUS]
    )
    return design.vehicle_m_s[design.vehicle_span(run)] + turning / inputs.mass_kg[run]


def vehicle_force(design: Design, inputs: Inputs, run: int) -> np.ndarray:
    """Return the force over the mass of a vehicle in m/s2, shape (samples,)."""
    axles = design.axles
    v = design.speed_m_s[design.span(run * axles)]
    A, B, C = design.resistance
    force = A + B * v + C * v * v + inputs.force_N[design.vehicle_span(run)]
    for s in range(run * axles, (run + 1) * axles):
        force = force + inputs.torque_Nm[design.span(s)] / inputs.parameters[s, parameters.RADIUS]
    return force / inputs.mass_kg[run]


def replay_vehicles(design: Design, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
    """Return the innovations and variances of all vehicles, flat arrays."""
    total = int(design.vehicle_start[-1])
    nu = np.empty(total)
    variance = np.empty(total)
    for run in range(design.mass_kg.size):
        at = design.vehicle_span(run)
        # standard deviation of the measured force over mass, in one sample
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
