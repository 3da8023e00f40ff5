"""Prepares measured runs for the replay: smooth inputs, and the covariates of all causes.

Every wheelset of every run is one segment of flat arrays. The vehicle's speed is smoothed with the
vehicle's force balance [P1], so that its noise does not enter the sliding. Loads are smoothed,
because noise in an input would look like physics. Covariates come from the measurement and the
balance of the wheelset [P2] alone, never from a fit. So a cause cannot change the evidence for it.

    [P1] u = v + sum J omega / (M r), du/dt = -(sum C / r + resistance) / M + d
    [P2] f = (J domega/dt + C) / (r N)

v is the speed of the vehicle, M its mass. omega, J, r, C and N are speed, inertia, radius, brake
torque and load of a wheelset, and f is its adhesion. The sums are over all wheelsets. u is the
momentum of vehicle and wheelsets together, divided by M. Adhesion does not change it, so [P1] needs
no adhesion. d is a slow disturbance, an unknown acceleration.
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.vehicle import RESISTANCE
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.identify.data import pulses
from rollerrig.rig.identify.data.parameters import RADIUS, base_parameters
from rollerrig.rig.identify.data.pulses import PulseSensor, Sensor
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.data.smoothing import smoothed

WINDOW_S = 0.21  # window of the derivative of wheel speed, s
# Noise in an input would look like physics; the pitch of the vehicle is slower than this.
LOAD_SMOOTHING_S = 0.2
BRAKED_SHARE = 0.02  # above this share of a wheelset's largest torque its brake is applied
_COLUMNS = 5  # of the filter of the vehicle: u, d, puu, pud, pdd
DISTURBANCE_M_S2 = 0.03  # standard deviation of the change of d in [P1] in a second
LEAST_SURFACE_SPEED_M_S = 0.05  # creepage divides by the surface speed, which must not be 0

# The torque of the released brake is the mean over the beginning of a recording, up to a margin
# before the smoothed torque exceeds a share of its largest value.
RELEASED_SMOOTHING_S = 0.05
RELEASED_SHARE = 0.06
RELEASED_MARGIN_S = 0.15
LEAST_RELEASED_S = 0.3  # a shorter beginning gives no value

# Noise that the data set does not state in [accuracy] is estimated from third differences. These
# are the smallest estimates.
LEAST_SPEED_NOISE_M_S = 1e-4
LEAST_WHEEL_NOISE_RAD_S = 1e-3
LEAST_TORQUE_NOISE_NM = 5.0


class CommonBrake(StrEnum):
    """Along what the torques of all wheelsets vary in common."""

    NONE = "none"
    TIME_OF_RUN = "time of a run"  # in each run differently
    TIME = "time"  # in all runs alike
    SPEED = "speed"  # in all runs alike


class Design(NamedTuple):
    """Prepared runs.

    Segment s = run * axles + axle has the samples start[s]:start[s+1] of the flat arrays.
    """

    names: tuple[str, ...]
    axles: int  # of the vehicle
    step_s: float
    start: np.ndarray  # (segments + 1,)
    run: np.ndarray  # (segments,) number of the run
    axle: np.ndarray  # (segments,) 0 is the leading wheelset
    mass_kg: np.ndarray  # (runs,)
    # flat arrays, a value for each sample of each wheelset; many are covariates of mechanisms
    measured_rad_s: np.ndarray
    torque_Nm: np.ndarray
    brake_Nm: np.ndarray  # torque_Nm, smoothed over WINDOW_S
    load_N: np.ndarray
    speed_m_s: np.ndarray  # of the surface under the wheel, smoothed
    time_s: np.ndarray
    place_m: np.ndarray
    sliding_m_s: np.ndarray  # smoothed
    adhesion: np.ndarray  # [P2]
    energy_J_m: np.ndarray  # work of one wheel of the wheelset on a metre
    cleaned_J_m: np.ndarray  # work of the wheels in front on this metre of rail
    heat_MJ: np.ndarray  # work of the brake so far
    slid_m: np.ndarray
    braked_rad: np.ndarray  # angle turned while the brake was applied
    deceleration_m_s2: np.ndarray
    angle_rad: np.ndarray
    # of the vehicles
    vehicle_start: np.ndarray  # (runs + 1,)
    vehicle_m_s: np.ndarray  # flat, measured
    # accuracy, one standard deviation
    speed_noise_m_s: float
    wheel_noise_rad_s: float
    wheel_sensor: PulseSensor
    torque_noise_Nm: np.ndarray  # (runs,)
    calibration: float  # of torque, load and mass, as a share
    form: float  # how far the law of a cause may differ from the true law, as a share of its effect
    # the model
    base: np.ndarray  # (PARAMETERS,), columns of `parameters`
    resistance: np.ndarray  # A, B, C of the running resistance A + B v + C v^2
    released_Nm: np.ndarray  # (segments,) mean torque of the released brake; NaN: never released
    released_sd_Nm: np.ndarray  # (segments,) standard error of this mean
    places_m: tuple[float, float]  # where the bins of place begin and end
    ends_s: tuple[float, ...]  # where the bins of time of each run end
    # how the brakes may vary in common (`causes.discrepancy`, [Y4]); not in the base model
    common_brake: CommonBrake

    @property
    def segments(self) -> int:
        """The number of wheelsets of all runs."""
        return self.run.size

    def span(self, segment: int) -> slice:
        """Return where the samples of a segment are in a flat array."""
        return slice(int(self.start[segment]), int(self.start[segment + 1]))

    def vehicle_span(self, run: int) -> slice:
        """Return where the samples of a run are in a flat array of the vehicles."""
        return slice(int(self.vehicle_start[run]), int(self.vehicle_start[run + 1]))

    @property
    def turning_rad_s(self) -> np.ndarray:
        """The wheel speed whose momentum counts as the vehicle's, flat (n,).

        It is the measured one, but for counted pulses: their error would exceed that of the
        vehicle's speed, and a smaller inertia would reduce it.
        """
        if self.wheel_sensor.kind is not Sensor.COUNTED:
            return self.measured_rad_s
        return (self.speed_m_s - self.sliding_m_s) / self.base[RADIUS]

    def by_axle(self, flat: np.ndarray, run: int) -> np.ndarray:
        """Return the part of a flat array that belongs to a run, shape (samples, axles)."""
        first = self.axles * run
        return np.column_stack([flat[self.span(first + axle)] for axle in range(self.axles)])


def smooth_speed(
    measured: np.ndarray,
    force_over_mass: np.ndarray,
    step_s: float,
    noise: float,
    torque_noise: float,
    drift: float,
) -> np.ndarray:
    """Return the smoothed u of [P1], shape (n,), by a forward filter and a backward smoother.

    The state is u and the slow disturbance d.

    Parameters
    ----------
    measured : (n,), u from measured speeds, m/s
    force_over_mass : (n,), deceleration from sample k to k + 1 by [P1], m/s2
    step_s : time between two samples
    noise : standard deviation of `measured`, m/s
    torque_noise : standard deviation of `force_over_mass` by noise of the torques, m/s2
    drift : standard deviation of the change of d in a second, m/s2
    """
    filtered = np.empty((measured.size, _COLUMNS))
    predicted = np.empty((measured.size, _COLUMNS))
    out = np.empty(measured.size)
    _filter(measured, force_over_mass, step_s, noise, torque_noise, drift, filtered, predicted)
    _smooth(step_s, filtered, predicted, out)
    return out


@kernel
def _filter(measured, force_over_mass, step_s, noise, torque_noise, drift, filtered, predicted):
    """Write u, d and their covariances after each sample, and predicted for it; shape (n, 5)."""
    u = measured[0]
    d = 0.0
    # covariance of (u, d); d is 0 with a standard deviation of 0.01 m/s2 at the beginning
    puu = noise * noise
    pud = 0.0
    pdd = 1e-4
    # growth of the variances of u and d in one step; 1e-12 keeps that of u above 0 where an
    # infinite mass makes `torque_noise` 0
    quu = (torque_noise * step_s) ** 2 + 1e-12
    qdd = drift * drift * step_s

    for k in range(measured.size):
        _store(predicted[k], u, d, puu, pud, pdd)

        # correct by the measurement; pdd comes before pud, because it needs the old pud
        gain_u = puu / (puu + noise * noise)
        gain_d = pud / (puu + noise * noise)
        innovation = measured[k] - u
        u += gain_u * innovation
        d += gain_d * innovation
        pdd -= gain_d * pud
        puu *= 1.0 - gain_u
        pud *= 1.0 - gain_u
        _store(filtered[k], u, d, puu, pud, pdd)

        # predict the next sample; d stays
        u += step_s * (d - force_over_mass[k])
        puu = puu + 2.0 * step_s * pud + step_s * step_s * pdd + quu
        pud += step_s * pdd
        pdd += qdd


@kernel
def _smooth(step_s, filtered, predicted, out):
    """Write the smoothed u by the backward smoother of Rauch, Tung and Striebel."""
    n = len(out)
    smooth_u, smooth_d, _, _, _ = _stored(filtered[n - 1])
    out[n - 1] = smooth_u
    for k in range(n - 2, -1, -1):
        filtered_u, filtered_d, fuu, fud, fdd = _stored(filtered[k])
        predicted_u, predicted_d, puu, pud, pdd = _stored(predicted[k + 1])

        # gain g = m Ppred^-1, m = P F': P is the filtered covariance at k, Ppred the predicted one
        # at k + 1, F = [[1, step_s], [0, 1]]
        m11 = fuu + step_s * fud
        m12 = fud
        m21 = fud + step_s * fdd
        m22 = fdd
        determinant = puu * pdd - pud * pud
        g11 = (m11 * pdd - m12 * pud) / determinant
        g12 = (m12 * puu - m11 * pud) / determinant
        g21 = (m21 * pdd - m22 * pud) / determinant
        g22 = (m22 * puu - m21 * pud) / determinant

        change_u = smooth_u - predicted_u
        change_d = smooth_d - predicted_d
        smooth_u = filtered_u + g11 * change_u + g12 * change_d
        smooth_d = filtered_d + g21 * change_u + g22 * change_d
        out[k] = smooth_u


@kernel
def _store(row, u, d, puu, pud, pdd):
    """Write u, d and their covariances to a row."""
    row[0] = u
    row[1] = d
    row[2] = puu
    row[3] = pud
    row[4] = pdd


@kernel
def _stored(row):
    """Return what `_store` has written."""
    return row[0], row[1], row[2], row[3], row[4]


def prepare(data: Dataset, runs: list[Run], like: Design | None = None) -> Design:
    """Return the design of some runs of a dataset.

    With `like` the design has the bins of place and time of that design, so that a cause that is a
    bin means the same in both.
    """
    vehicle = data.sections["vehicle"]
    radius_m = vehicle["wheel_radius_m"]
    inertia_kgm2 = vehicle["wheelset_inertia_kgm2"]
    step_s = data.sample_time_s
    resistance = np.array([vehicle[key] for key in RESISTANCE.values()])

    # three arrays of shape (runs,)
    speed_noise, wheel_noise, torque_noise = np.array([_noise(data, run) for run in runs]).T
    wheel_sensor = pulses.recognise(runs) if like is None else like.wheel_sensor
    wheel_noise_rad_s = float(np.median(wheel_noise))
    if wheel_sensor.is_pulses:
        if like is None:
            of_runs = [pulses.noise_of_pulses(wheel_sensor, run, step_s) for run in runs]
            # the error grows with the speed: that of the fastest run is on the safe side
            wheel_noise_rad_s = max(of_runs)
        else:
            wheel_noise_rad_s = like.wheel_noise_rad_s
    speed_noise_m_s = float(np.median(speed_noise))

    parts = []
    for run, torque_noise_Nm in zip(runs, torque_noise, strict=True):
        parts.append(
            _flat_fields(
                run,
                data,
                radius_m,
                inertia_kgm2,
                step_s,
                speed_noise_m_s,
                float(torque_noise_Nm),
                resistance,
            )
        )
    # (samples, axles) of each run becomes one flat array, wheelset after wheelset
    flat = {key: np.concatenate([part[key].T.ravel() for part in parts]) for key in parts[0]}

    # (segments, 2): mean torque of the released brake and its standard error
    released_rows = []
    for run in runs:
        for axle in range(data.axles):
            released_rows.append(_released_torque(run.torque_Nm[:, axle], step_s))
    released = np.array(released_rows)

    sizes = np.array([run.time_s.size for run in runs])
    if like is None:
        places_m = (float(flat["place_m"].min()), float(flat["place_m"].max()))
        ends_s = tuple(float(run.time_s[-1] - run.time_s[0]) for run in runs)
    else:
        places_m = like.places_m
        ends_s = like.ends_s

    return Design(
        names=tuple(run.name for run in runs),
        axles=data.axles,
        step_s=step_s,
        start=np.concatenate([[0], np.cumsum(np.repeat(sizes, data.axles))]),
        run=np.repeat(np.arange(len(runs)), data.axles),
        axle=np.tile(np.arange(data.axles), len(runs)),
        mass_kg=np.array([run.mass_kg for run in runs]),
        **flat,
        vehicle_start=np.concatenate([[0], np.cumsum(sizes)]),
        vehicle_m_s=np.concatenate([run.speed_m_s for run in runs]),
        speed_noise_m_s=speed_noise_m_s,
        wheel_noise_rad_s=wheel_noise_rad_s,
        wheel_sensor=wheel_sensor,
        torque_noise_Nm=torque_noise.copy(),
        calibration=data.accuracy["calibration_fraction"],
        common_brake=CommonBrake.NONE,
        form=data.accuracy["form_fraction"],
        base=base_parameters(data),
        resistance=resistance,
        released_Nm=released[:, 0].copy(),
        released_sd_Nm=released[:, 1].copy(),
        places_m=places_m,
        ends_s=ends_s,
    )


def _noise(data: Dataset, run: Run) -> tuple[float, float, float]:
    """Return the standard deviations of vehicle speed (m/s), wheel speed (rad/s) and torque (N m).

    A value comes from the section [accuracy] of the data set. A negative value means that the
    section does not give it; then it is estimated from the run.
    """
    accuracy = data.accuracy

    speed_m_s = accuracy["speed_m_s"]
    if speed_m_s <= 0:
        speed_m_s = max(estimated_noise(run.speed_m_s), LEAST_SPEED_NOISE_M_S)

    wheel_rad_s = accuracy["wheel_speed_rad_s"]
    if wheel_rad_s <= 0:
        wheel_rad_s = max(estimated_noise(run.wheel_speed_rad_s), LEAST_WHEEL_NOISE_RAD_S)

    if accuracy["torque_fraction"] > 0:
        torque_Nm = accuracy["torque_fraction"] * float(np.max(run.torque_Nm))
    else:
        torque_Nm = estimated_noise(run.torque_Nm)
    return speed_m_s, wheel_rad_s, max(torque_Nm, LEAST_TORQUE_NOISE_NM)


def estimated_noise(values: np.ndarray) -> float:
    """Return the standard deviation of white noise on a smooth signal, from third differences."""
    third = np.diff(values, n=3, axis=0)
    # 0.6745 is the median of |x| for a normal distribution of standard deviation 1. A third
    # difference of white noise has 1 + 9 + 9 + 1 = 20 times its variance.
    return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0)) + 1e-9


def samples_before_braking(torque_Nm: np.ndarray, step_s: float) -> int:
    """Return the number of samples before the brake of a wheelset applies, less a margin.

    `torque_Nm` (n,) is its torque. 0 if the brake is applied from the beginning, or never.
    """
    smooth = gaussian_filter1d(torque_Nm, RELEASED_SMOOTHING_S / step_s)
    applied = np.flatnonzero(smooth > RELEASED_SHARE * np.max(smooth))
    if not applied.size:
        return 0
    return max(int(applied[0]) - int(RELEASED_MARGIN_S / step_s), 0)


def _released_torque(torque_Nm: np.ndarray, step_s: float) -> tuple[float, float]:
    """Return the mean torque before the brake applies and its standard error.

    Both are NaN where less than LEAST_RELEASED_S of the recording is with the brake released.
    """
    samples = samples_before_braking(torque_Nm, step_s)
    if samples < LEAST_RELEASED_S / step_s:
        return float("nan"), float("nan")
    before = torque_Nm[:samples]
    return float(before.mean()), float(before.std(ddof=1) / np.sqrt(before.size))


def _flat_fields(
    run: Run,
    data: Dataset,
    radius_m: float,
    inertia_kgm2: float,
    step_s: float,
    speed_noise_m_s: float,
    torque_noise_Nm: float,
    resistance: np.ndarray,
) -> dict[str, np.ndarray]:
    """Return the part of one run in the flat arrays of `Design`, each of shape (n, axles)."""
    measured_m_s = run.speed_m_s
    window = max(5, 2 * int(0.5 * WINDOW_S / step_s) + 1)  # samples, odd

    # vehicle speed, smoothed with the force balance [P1]
    coast_N = (
        resistance[0] + resistance[1] * measured_m_s + resistance[2] * measured_m_s * measured_m_s
    )
    force_over_mass = (run.torque_Nm.sum(axis=1) / radius_m + coast_N) / run.mass_kg
    # the mean of each sample and the next one, for the step between them
    force_over_mass_of_step = 0.5 * (
        force_over_mass + np.append(force_over_mass[1:], force_over_mass[-1])
    )
    # sum J omega / (M r), the part of u that the wheelsets contribute
    turning_m_s = inertia_kgm2 * run.wheel_speed_rad_s.sum(axis=1) / (run.mass_kg * radius_m)
    # the noise of the sum of four independent torques is sqrt(4) = 2 times that of one
    torques_noise_m_s2 = 2.0 * torque_noise_Nm / (radius_m * run.mass_kg)
    u = smooth_speed(
        measured_m_s + turning_m_s,
        force_over_mass_of_step,
        step_s,
        speed_noise_m_s,
        torques_noise_m_s2,
        DISTURBANCE_M_S2,
    )
    smooth_rad_s = smoothed(run.wheel_speed_rad_s, window, order=3)
    speed_m_s = u - inertia_kgm2 * smooth_rad_s.sum(axis=1) / (run.mass_kg * radius_m)
    deceleration_m_s2 = -smoothed(
        speed_m_s,
        2 * window + 1,
        order=2,
        derivative=1,
        step=step_s,
    )

    # speed of the surface under the wheels: of the rollers, or of the vehicle on a track
    surface_m_s = speed_m_s[:, None] if run.surface_m_s is None else run.surface_m_s
    surface_m_s = np.maximum(
        np.broadcast_to(surface_m_s, (measured_m_s.size, run.axles)), LEAST_SURFACE_SPEED_M_S
    )

    # adhesion and specific work of each wheelset
    load_N = gaussian_filter1d(run.load_N, LOAD_SMOOTHING_S / step_s, axis=0, mode="nearest")
    rate_rad_s2 = smoothed(
        run.wheel_speed_rad_s,
        window,
        order=3,
        derivative=1,
        step=step_s,
    )
    brake_Nm = smoothed(run.torque_Nm, window, order=3)
    adhesion = (inertia_kgm2 * rate_rad_s2 + brake_Nm) / (radius_m * load_N)  # [P2]
    sliding_m_s = surface_m_s - radius_m * smooth_rad_s
    # friction force times creepage; 0.5: a wheel carries half of the load of its wheelset
    energy_J_m = np.maximum(adhesion * 0.5 * load_N * sliding_m_s / surface_m_s, 0.0)

    # place on the rail; without a measured position, the integral of the speed (trapezoids)
    if run.position_m is not None:
        travelled_m = run.position_m
    else:
        steps_m = 0.5 * step_s * (speed_m_s[1:] + speed_m_s[:-1])
        travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    place_m = travelled_m[:, None] - data.axle_position_m

    # integrals over time, as sums over samples
    turned_rad = step_s * run.wheel_speed_rad_s
    braked = brake_Nm > BRAKED_SHARE * brake_Nm.max(axis=0)
    heat_W = np.maximum(brake_Nm * smooth_rad_s, 0.0)
    return {
        "measured_rad_s": run.wheel_speed_rad_s,
        "torque_Nm": run.torque_Nm,
        "brake_Nm": brake_Nm,
        "load_N": load_N,
        "speed_m_s": surface_m_s,
        "time_s": np.repeat(run.time_s[:, None] - run.time_s[0], run.axles, axis=1),
        "place_m": place_m,
        "sliding_m_s": sliding_m_s,
        "adhesion": adhesion,
        "energy_J_m": energy_J_m,
        "cleaned_J_m": _work_in_front(place_m, energy_J_m),
        "heat_MJ": np.cumsum(heat_W, axis=0) * step_s / 1e6,
        "slid_m": np.cumsum(np.abs(sliding_m_s), axis=0) * step_s,
        "braked_rad": np.cumsum(turned_rad * braked, axis=0),
        "deceleration_m_s2": np.repeat(deceleration_m_s2[:, None], run.axles, axis=1),
        # the last sample counts half: the angle at the time of the sample
        "angle_rad": np.cumsum(run.wheel_speed_rad_s, axis=0) * step_s - 0.5 * turned_rad,
    }


def _work_in_front(place_m: np.ndarray, energy_J_m: np.ndarray) -> np.ndarray:
    """Return the work that the wheels in front have done on each metre of rail, (n, axles).

    The leading wheelset has no wheels in front.
    """
    work_J_m = np.zeros_like(energy_J_m)
    for axle in range(1, energy_J_m.shape[1]):
        for front in range(axle):
            # 0 on rail that the wheel in front had passed before the recording began
            work_J_m[:, axle] += np.interp(
                place_m[:, axle], place_m[:, front], energy_J_m[:, front], left=0.0
            )
    return work_J_m
