"""Turns measured runs into what the replay reads: smooth inputs and the covariates of all causes.

Every wheelset of every run is one segment of flat arrays. The vehicle's speed is smoothed with its
own force balance [P1], so that its noise does not enter the sliding; loads are smoothed because
noise in an input would look like physics. Covariates come from measurement and the wheel balance
alone, never from a fit, so that no cause can shape its own evidence.

    [P1] u = v + sum J omega / (M r), du/dt = -(sum C / r + resistance) / M + slow disturbance
    [P2] f = (J domega/dt + C) / (r N)
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.configs.vehicle import RESISTANCE
from rollerrig.rig.compiled.kernel import kernel_with_memory
from rollerrig.rig.identify.data.parameters import base_parameters
from rollerrig.rig.identify.data.runs import AXLES, Dataset, Run
from rollerrig.rig.identify.data.smoothing import smoothed

WINDOW_S = 0.21  # window of the derivative of wheel speed, s
LOAD_SMOOTHING_S = 0.2
BRAKED_SHARE = 0.02  # above this share of a wheelset's largest torque its brake is applied


class Design(NamedTuple):
    """Prepared runs. Segment s = run * AXLES + axle holds samples start[s]:start[s+1] of flat arrays."""

    names: tuple[str, ...]
    step_s: float
    start: np.ndarray
    run: np.ndarray
    axle: np.ndarray
    mass_kg: np.ndarray  # (runs,)
    measured_rad_s: np.ndarray
    torque_Nm: np.ndarray
    brake_Nm: np.ndarray  # the same, smoothed over 0.2 s
    load_N: np.ndarray
    speed_m_s: np.ndarray  # of the surface under the wheel, smoothed
    time_s: np.ndarray
    place_m: np.ndarray
    sliding_m_s: np.ndarray  # smoothed
    adhesion: np.ndarray  # [P2]
    energy_J_m: np.ndarray
    cleaned_J_m: np.ndarray  # work of the wheels before on this metre
    heat_MJ: np.ndarray
    slid_m: np.ndarray
    braked_rad: np.ndarray  # turned while the brake was applied
    deceleration_m_s2: np.ndarray
    angle_rad: np.ndarray
    vehicle_start: np.ndarray  # (runs + 1,)
    vehicle_m_s: np.ndarray  # measured
    speed_noise_m_s: float
    wheel_noise_rad_s: float
    torque_noise_Nm: np.ndarray  # (runs,)
    calibration: float
    form: float
    base: np.ndarray  # (PARAMETERS,) of `parameters`
    resistance: np.ndarray  # A, B, C
    released_Nm: np.ndarray  # (segments,) mean torque while released, nan: never
    released_sd_Nm: np.ndarray
    places_m: tuple[float, float]  # where the bins of place begin and end
    ends_s: tuple[float, ...]  # where the bins of time of each run end

    @property
    def segments(self) -> int:
        return self.run.size

    def span(self, segment: int) -> slice:
        """Samples of a segment."""
        return slice(int(self.start[segment]), int(self.start[segment + 1]))

    def vehicle_span(self, run: int) -> slice:
        """Samples of the vehicle in a run."""
        return slice(int(self.vehicle_start[run]), int(self.vehicle_start[run + 1]))

    def by_axle(self, flat: np.ndarray, run: int) -> np.ndarray:
        """What a flat array has of the wheelsets of a run, shape (samples, 4)."""
        return np.column_stack([flat[self.span(AXLES * run + j)] for j in range(AXLES)])


@kernel_with_memory
def smooth_speed(measured, force_over_mass, step_s, noise, torque_noise, drift):
    """Smoothed u of [P1], shape (n,): forward filter and backward smoother with a slow disturbance."""
    n = measured.size
    u, d = measured[0], 0.0
    puu, pud, pdd = noise * noise, 0.0, 1e-4
    filtered, predicted = np.empty((n, 5)), np.empty((n, 5))
    quu, qdd = (torque_noise * step_s) ** 2 + 1e-12, drift * drift * step_s
    for k in range(n):
        predicted[k] = np.array([u, d, puu, pud, pdd])
        gain_u, gain_d = puu / (puu + noise * noise), pud / (puu + noise * noise)
        nu = measured[k] - u
        u, d = u + gain_u * nu, d + gain_d * nu
        puu, pud, pdd = puu * (1.0 - gain_u), pud * (1.0 - gain_u), pdd - gain_d * pud
        filtered[k] = np.array([u, d, puu, pud, pdd])
        u += step_s * (d - force_over_mass[k])
        puu, pud, pdd = (
            puu + 2.0 * step_s * pud + step_s * step_s * pdd + quu,
            pud + step_s * pdd,
            pdd + qdd,
        )
    out = np.empty(n)
    su, sd = filtered[n - 1, 0], filtered[n - 1, 1]
    out[n - 1] = su
    for k in range(n - 2, -1, -1):
        fu, fd, a, b, c = filtered[k]
        pu, pd, e, f, g = predicted[k + 1]
        det = e * g - f * f
        # gain = P F' Ppred^-1, F = [[1, h], [0, 1]]
        m11, m12 = a + step_s * b, b
        m21, m22 = b + step_s * c, c
        g11, g12 = (m11 * g - m12 * f) / det, (m12 * e - m11 * f) / det
        g21, g22 = (m21 * g - m22 * f) / det, (m22 * e - m21 * f) / det
        du, dd = su - pu, sd - pd
        su, sd = fu + g11 * du + g12 * dd, fd + g21 * du + g22 * dd
        out[k] = su
    return out


def prepare(data: Dataset, runs: list[Run], like: Design | None = None) -> Design:
    """The design of some runs of a dataset; `like` another one it has the bins of that one."""
    v = data.sections["vehicle"]
    radius, inertia, step = v["wheel_radius_m"], v["wheelset_inertia_kgm2"], data.sample_time_s
    speed_noise, wheel_noise, torque_noise = np.array([_noise(data, run) for run in runs]).T
    resistance = np.array([v[key] for key in RESISTANCE.values()])
    wheels = [inertia * run.wheel_speed_rad_s.sum(axis=1) / (run.mass_kg * radius) for run in runs]
    parts = [
        _run(
            run,
            data,
            radius,
            inertia,
            step,
            float(np.median(speed_noise)),
            float(noise),
            resistance,
            own,
        )
        for run, noise, own in zip(runs, torque_noise, wheels, strict=True)
    ]
    flat = {key: np.concatenate([part[key].T.ravel() for part in parts]) for key in parts[0]}
    released = np.array(
        [_released(run.torque_Nm[:, j], step) for run in runs for j in range(AXLES)]
    )
    sizes = np.array([run.time_s.size for run in runs])
    places = (float(flat["place_m"].min()), float(flat["place_m"].max()))
    ends = tuple(float(run.time_s[-1] - run.time_s[0]) for run in runs)
    return Design(
        names=tuple(run.name for run in runs),
        step_s=step,
        start=np.concatenate([[0], np.cumsum(np.repeat(sizes, AXLES))]),
        run=np.repeat(np.arange(len(runs)), AXLES),
        axle=np.tile(np.arange(AXLES), len(runs)),
        mass_kg=np.array([run.mass_kg for run in runs]),
        **flat,
        vehicle_start=np.concatenate([[0], np.cumsum(sizes)]),
        vehicle_m_s=np.concatenate([run.speed_m_s for run in runs]),
        speed_noise_m_s=float(np.median(speed_noise)),
        wheel_noise_rad_s=float(np.median(wheel_noise)),
        torque_noise_Nm=torque_noise.copy(),
        calibration=data.accuracy["calibration_fraction"],
        form=data.accuracy["form_fraction"],
        base=base_parameters(data),
        resistance=resistance,
        released_Nm=released[:, 0].copy(),
        released_sd_Nm=released[:, 1].copy(),
        places_m=places if like is None else like.places_m,
        ends_s=ends if like is None else like.ends_s,
    )


def _noise(data: Dataset, run: Run) -> tuple[float, float, float]:
    """Standard deviations of speed, wheel speed and torque: declared, or from third differences."""
    a = data.accuracy

    def estimated(values: np.ndarray) -> float:
        third = np.diff(values, n=3, axis=0)
        return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0)) + 1e-9

    speed = a["speed_m_s"] if a["speed_m_s"] > 0 else max(estimated(run.speed_m_s), 1e-4)
    wheel = (
        a["wheel_speed_rad_s"]
        if a["wheel_speed_rad_s"] > 0
        else max(estimated(run.wheel_speed_rad_s), 1e-3)
    )
    share = a["torque_fraction"]
    return (
        speed,
        wheel,
        max(share * float(np.max(run.torque_Nm)) if share > 0 else estimated(run.torque_Nm), 5.0),
    )


def _released(torque: np.ndarray, step_s: float) -> tuple[float, float]:
    """Mean torque before the brake applies and its standard error; nan where it is never released."""
    smooth = gaussian_filter1d(torque, 0.05 / step_s)
    above = np.flatnonzero(smooth > 0.06 * np.max(smooth))
    still = int(above[0]) - int(0.15 / step_s) if above.size else 0
    if still < 0.3 / step_s:
        return float("nan"), float("nan")
    part = torque[:still]
    return float(part.mean()), float(part.std(ddof=1) / np.sqrt(part.size))


def _run(
    run: Run,
    data: Dataset,
    radius: float,
    inertia: float,
    step: float,
    speed_noise: float,
    torque_noise: float,
    resistance: np.ndarray,
    wheels: np.ndarray,
) -> dict[str, np.ndarray]:
    v, window = run.speed_m_s, max(5, 2 * int(0.5 * WINDOW_S / step) + 1)
    coast = resistance[0] + resistance[1] * v + resistance[2] * v * v
    force = (run.torque_Nm.sum(axis=1) / radius + coast) / run.mass_kg
    middle = 0.5 * (force + np.append(force[1:], force[-1]))
    u = smooth_speed(
        v + wheels, middle, step, speed_noise, 2.0 * torque_noise / (radius * run.mass_kg), 0.03
    )
    smooth_wheels = smoothed(run.wheel_speed_rad_s, window, 3)
    speed = u - inertia * smooth_wheels.sum(axis=1) / (run.mass_kg * radius)
    deceleration = -smoothed(speed, 2 * window + 1, 2, 1, step)
    surface = speed[:, None] if run.surface_m_s is None else run.surface_m_s
    surface = np.maximum(np.broadcast_to(surface, (v.size, AXLES)), 0.05)
    load = gaussian_filter1d(run.load_N, LOAD_SMOOTHING_S / step, axis=0, mode="nearest")
    rate = smoothed(run.wheel_speed_rad_s, window, 3, 1, step)
    torque = smoothed(run.torque_Nm, window, 3)
    adhesion = (inertia * rate + torque) / (radius * load)  # [P2]
    sliding = surface - radius * smooth_wheels
    energy = np.maximum(adhesion * 0.5 * load * sliding / surface, 0.0)
    travelled = (
        run.position_m
        if run.position_m is not None
        else np.concatenate([[0.0], np.cumsum(0.5 * step * (speed[1:] + speed[:-1]))])
    )
    place = travelled[:, None] - data.axle_position_m
    turned = step * run.wheel_speed_rad_s
    return {
        "measured_rad_s": run.wheel_speed_rad_s,
        "torque_Nm": run.torque_Nm,
        "brake_Nm": torque,
        "load_N": load,
        "speed_m_s": surface,
        "time_s": np.repeat(run.time_s[:, None] - run.time_s[0], AXLES, axis=1),
        "place_m": place,
        "sliding_m_s": sliding,
        "adhesion": adhesion,
        "energy_J_m": energy,
        "cleaned_J_m": _work_before(place, energy),
        "heat_MJ": np.cumsum(np.maximum(torque * smooth_wheels, 0.0), axis=0) * step / 1e6,
        "slid_m": np.cumsum(np.abs(sliding), axis=0) * step,
        "braked_rad": np.cumsum(turned * (torque > BRAKED_SHARE * torque.max(axis=0)), axis=0),
        "deceleration_m_s2": np.repeat(deceleration[:, None], AXLES, axis=1),
        "angle_rad": np.cumsum(run.wheel_speed_rad_s, axis=0) * step - 0.5 * turned,
    }


def _work_before(place: np.ndarray, energy: np.ndarray) -> np.ndarray:
    before = np.zeros_like(energy)
    for j in range(1, energy.shape[1]):
        for i in range(j):
            before[:, j] += np.interp(place[:, j], place[:, i], energy[:, i], left=0.0)
    return before
