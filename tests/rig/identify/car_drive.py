"""A car that is generated from scratch: drive, curves, creepage, slides, sensors and reference.

It shares no code with `explain`. Front wheels are driven and take more of the brake force, so they
creep more. All values are in SI units; wheels are in the order front left, front right, rear left,
rear right.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

HALF_TRACK_M = 0.75
RADII = (0.004, -0.003, 0.002, 0.006)  # share by which a wheel reads too much
CREEPAGE_S2_M = 0.006  # of a braked wheel for each m/s2, on average
STEP_S = 0.01


class PlantedSlide(NamedTuple):
    """A slide of one wheel, a half sine from `start_s` on."""

    wheel: int
    start_s: float
    duration_s: float
    depth_m_s: float


class Drive(NamedTuple):
    """The true motion: time, speed, acceleration and yaw rate, (n,)."""

    time_s: np.ndarray
    speed_m_s: np.ndarray
    change_m_s2: np.ndarray
    yaw_rad_s: np.ndarray


def drive(seed, stops=5, hard_m_s2=(7.0, 9.0), top_m_s=(20.0, 30.0)):
    """Return a drive of some stops from different speeds with hard braking, in curves."""
    rng = np.random.default_rng(seed)
    speeds = [0.0]
    changes = [0.0]

    def hold(target_m_s2, for_s=np.inf, until_m_s=np.nan):
        start = len(speeds)
        sign = np.sign(target_m_s2)
        while STEP_S * (len(speeds) - start) <= for_s:
            if sign * (speeds[-1] - until_m_s) >= 0.0:
                break
            change = changes[-1] + (target_m_s2 - changes[-1]) * STEP_S / 0.12
            changes.append(change)
            speeds.append(max(speeds[-1] + change * STEP_S, 0.0))

    for _ in range(stops):
        top = rng.uniform(*top_m_s)
        slower = top * rng.uniform(0.6, 0.85)
        hold(0.0, for_s=2.0)
        hold(rng.uniform(1.5, 3.0), until_m_s=top)
        hold(0.0, for_s=rng.uniform(6.0, 10.0))
        hold(-rng.uniform(1.0, 2.5), until_m_s=slower)
        hold(0.0, for_s=rng.uniform(6.0, 10.0))
        hold(-rng.uniform(*hard_m_s2), until_m_s=0.4)
        hold(0.0, for_s=0.5)
        speeds[-1] = 0.0
        changes[-1] = 0.0
    speed = np.array(speeds)
    time_s = STEP_S * np.arange(speed.size)
    places_s = np.arange(0.0, time_s[-1] + 3.0, 3.0)
    curvature = np.interp(time_s, places_s, rng.normal(0.0, 0.02, places_s.size))
    most = 2.0 / np.maximum(speed, 3.0) ** 2
    yaw = speed * np.clip(curvature, -most, most)
    return Drive(time_s, speed, np.array(changes), yaw)


def wheels(of, seed, slides=(), noise_m_s=0.03):
    """Return the speeds of the four wheels (4, n) as their sensors read them."""
    rng = np.random.default_rng(seed + 1000)
    columns = []
    for wheel in range(4):
        is_front = wheel < 2
        side = -1.0 if wheel % 2 == 0 else 1.0
        braked = CREEPAGE_S2_M * (1.25 if is_front else 0.75)
        driven = 0.8 * CREEPAGE_S2_M if is_front else 0.0
        creepage = np.where(of.change_m_s2 < 0.0, braked, driven) * of.change_m_s2
        speed = (of.speed_m_s + side * HALF_TRACK_M * of.yaw_rad_s) * (1.0 + creepage)
        for slide in slides:
            if slide.wheel == wheel:
                phase = np.clip((of.time_s - slide.start_s) / slide.duration_s, 0.0, 1.0)
                speed = speed - slide.depth_m_s * np.sin(np.pi * phase)
        speed = speed * (1.0 + RADII[wheel])
        noise = rng.normal(0.0, noise_m_s, speed.size)
        columns.append(np.maximum(speed + np.where(speed > 0.05, noise, 0.0), 0.0))
    return np.array(columns)


def reference(of, seed, scale=0.0, offset_m_s=0.0, delay_s=0.1, noise_m_s=0.05, step_m_s=0.0):
    """Return a reference with a new value every 0.1 s, with straight lines between them."""
    rng = np.random.default_rng(seed + 2000)
    time_s = np.arange(0.0, of.time_s[-1], 0.1)
    speed = np.interp(time_s - delay_s, of.time_s, of.speed_m_s)
    read = np.where(speed > 0.2, (1.0 + scale) * speed + offset_m_s, 0.0)
    read = np.maximum(read + rng.normal(0.0, noise_m_s, read.size), 0.0)
    if step_m_s:
        read = step_m_s * np.round(read / step_m_s)
    return np.interp(of.time_s, time_s, read)


def in_hard_braking(of, seed, depth_m_s, duration_s):
    """Return a slide of a random wheel in each hard braking, of random depth and duration.

    Depth and duration are ranges.
    """
    rng = np.random.default_rng(seed + 3000)
    is_hard = (of.change_m_s2 < -6.0) & (of.speed_m_s > 8.0)
    samples = np.flatnonzero(is_hard)
    slides = []
    for part in np.split(samples, np.flatnonzero(np.diff(samples) > 1) + 1):
        if part.size > 60:
            start = int(rng.integers(part[5], part[-45]))
            slides.append(
                PlantedSlide(
                    wheel=int(rng.integers(4)),
                    start_s=float(of.time_s[start]),
                    duration_s=rng.uniform(*duration_s),
                    depth_m_s=rng.uniform(*depth_m_s),
                )
            )
    return slides


def write(folder, of, speeds, read=None):
    """Write the recording as a dataset and return its folder."""
    folder = Path(folder)
    columns = {"t": of.time_s}
    lines = ['kind = "recorder"', "[channels]", 'time_s = "t"']
    for wheel, speed in enumerate(speeds, start=1):
        columns[f"v{wheel}"] = speed
        lines.append(f'wheel_speed_{wheel}_m_s = "v{wheel}"')
    if read is not None:
        columns["gps"] = read
        lines.append('reference_speed_m_s = "gps"')
    np.savetxt(
        folder / "a.csv",
        np.column_stack(list(columns.values())),
        delimiter=",",
        header=",".join(columns),
        comments="",
        fmt="%.4f",
    )
    lines += ["[[run]]", 'file = "a.csv"']
    (folder / "dataset.toml").write_text("\n".join(lines) + "\n")
    return folder
