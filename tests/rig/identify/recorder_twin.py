"""Simulated recordings of runs of the bench, with the defects that recordings of trams had.

The runs are free stops of the bench, sampled at 10 Hz and rounded to 0.1 km/h. The reference is a
receiver with separate noise, 0.3 s late. A defect is a function that changes the columns of the
runs and returns the truths about it. This file shares no code with `explain`.
"""

import functools
import math
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.realtime.bench import free, scenario

RADIUS_M = 0.445
STEP_S = 0.1
REFERENCE_DELAY_S = 0.3
SCENARIO = """title = "{title}"
vehicle = "uic_z1"
rig = "plain_track"
adhesion = "dry"
initial_speed_m_s = {speed}
[[demand]]
from_s = 0.0
pressure_Pa = 0.0
[[demand]]
from_s = 14.0
pressure_Pa = {first}
"""
CLEAN = """[[demand]]
from_s = 22.0
pressure_Pa = 0.0
[[demand]]
from_s = 34.0
pressure_Pa = 2.2e5
"""
PATCH = """[[friction]]
from_m = 600.0
mu_cd = 0.03
[[friction]]
from_m = 680.0
"""
SPEEDS = (39, 36, 33, 30, 27, 24)


class Truth(NamedTuple):
    """The truth about a hidden defect; None where it has no such value."""

    name: str  # of the finding that is right
    channel: str
    run: str | None
    start_s: float | None
    end_s: float | None
    size: float | None


@functools.cache
def stop(kind, speed):
    """Return the columns of a simulated stop."""
    demand_and_friction = {"clean": CLEAN, "patch": PATCH}[kind]
    first_Pa = {"clean": 1.5e5, "patch": 2.4e5}[kind]
    text = SCENARIO.format(title=kind, speed=speed, first=first_Pa) + demand_and_friction
    plan = scenario.read(tomllib.loads(text), Path(f"{kind}_{speed}.toml"))
    return free.channels(free.simulate(plan), plan.table)


def stops(kind, speeds=SPEEDS):
    """Return the columns of simulated stops, by the names of the stops.

    `kind` is "clean" or "patch": without or with a slippery place.
    """
    return {f"{kind}_{speed}": stop(kind, speed) for speed in speeds}


def record(true, rng, axles=4, reference=True, position=True):
    """Return the columns of a recording in SI units: t, axle_1 .., gnss, place, handle."""
    moving = true["vehicle_speed_m_s"] > 0.5
    true_time_s = true["time_s"][moving]
    start_s = rng.uniform(0.0, 2.0)
    stamps = np.arange(start_s, true_time_s[-1] - 0.5, STEP_S)
    stamps = np.round(stamps + rng.normal(0.0, 0.004, stamps.size), 3)

    def at(name, delay_s=0.0):
        return np.interp(stamps - delay_s, true_time_s, true[name][moving])

    columns = {"t": stamps - stamps[0]}
    for axle in range(1, axles + 1):
        speed = RADIUS_M * at(f"measured_speed_{axle}_rad_s")
        speed = speed + rng.normal(0.0, 0.02, stamps.size)
        columns[f"axle_{axle}"] = np.maximum(speed, 0.0)
    if reference:
        # half of the noise of a receiver lasts a second
        white = rng.normal(0.0, 0.04 * math.sqrt(10.0), stamps.size + 9)
        slow = np.convolve(white, np.full(10, 0.1), "valid")
        speed = at("vehicle_speed_m_s", REFERENCE_DELAY_S) + slow
        speed = speed + rng.normal(0.0, 0.04, stamps.size)
        columns["gnss"] = np.maximum(speed, 0.0)
    if position:
        columns["place"] = np.round(at("position_m") + rng.normal(0.0, 1.5), 1)
    columns["handle"] = at("brake_demand_Pa")
    return columns


def rounded(columns):
    """Return the speeds in km/h, rounded as a recorder writes them."""
    written = {}
    for name, values in columns.items():
        if name.startswith("axle"):
            written[name] = np.round(36.0 * values) / 10.0
        elif name == "gnss":
            written[name] = np.round(360.0 * values) / 100.0
        else:
            written[name] = values
    return written


def cell(value):
    """Return a value as a recorder writes it: nothing for NaN."""
    return "" if math.isnan(value) else f"{value:.9g}"


def write(folder, runs, dates=None):
    """Write a dataset of recordings, which are rounded and in km/h, and return its folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    names = [name for name in next(iter(runs.values())) if name != "t"]
    lines = [
        'kind = "recorder"',
        'title = "a twin of a recorder on runs of the bench"',
        "[channels]",
        'time_s = { column = "t" }',
    ]
    keys = {"gnss": "reference_speed_m_s", "place": "position_m", "handle": "brake_demand"}
    for name in names:
        key = keys.get(name, f"wheel_speed_{name.removeprefix('axle_')}_m_s")
        unit = ', unit = "km/h"' if name.startswith(("axle", "gnss")) else ""
        lines.append(f'{key} = {{ column = "{name}", name = "{name}"{unit} }}')

    for k, (name, columns) in enumerate(runs.items()):
        lines += ["[[run]]", f'file = "{name}.csv"']
        if dates:
            lines.append(f'date = "{dates[k]}"')
        written = ["t", *names]
        rows = [",".join(written)]
        for row in zip(*(columns[name] for name in written), strict=True):
            rows.append(",".join(cell(value) for value in row))
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")
    (folder / "dataset.toml").write_text("\n".join(lines) + "\n")
    return folder


# --- defects in m/s, before the speeds are rounded ---


def radius(runs, rng, size=0.008, first=0, name="wheel_radius"):
    for run in list(runs)[first:]:
        runs[run]["axle_2"] = runs[run]["axle_2"] / (1.0 + size)
    return [Truth(name, "axle_2", None, None, None, 100.0 * size)]


def radius_step(runs, rng):
    return radius(runs, rng, -0.009, len(runs) // 2, "wheel_radius_step")


def late(runs, rng, size=0.5):
    for columns in runs.values():
        columns["axle_3"] = np.interp(columns["t"] - size, columns["t"], columns["axle_3"])
    return [Truth("speed_sensor_delay", "axle_3", None, None, None, size)]


def unit(runs, rng):
    for columns in runs.values():
        columns["axle_2"] *= 3.6
    return [Truth("wrong_unit", "axle_2", None, None, None, 3.6)]


def drift(runs, rng):
    """Let the speed of an axle drift away and come back, which is not in the list of causes."""
    run, columns, _ = _somewhere(runs, rng)
    bump = 1.0 * np.exp(-0.5 * ((columns["t"] - 16.0) / 4.0) ** 2)
    columns["axle_3"] = columns["axle_3"] + bump
    return [Truth("unknown", "axle_3", run, 10.0, 22.0, None)]


def noise(runs, rng):
    """Make a sensor noisy for some seconds, which is not in the list of causes."""
    run, columns, k = _somewhere(runs, rng)
    columns["axle_3"][k : k + 100] += rng.normal(0.0, 0.6, 100)
    return [Truth("unknown", "axle_3", run, columns["t"][k], columns["t"][k + 99], None)]


# --- defects in km/h, after the speeds are rounded ---


def zeros(runs, rng):
    run, columns, k = _somewhere(runs, rng)
    n = int(rng.integers(8, 60))
    columns["axle_1"][k : k + n] = 0.0
    return [_lasting("sensor_dropout", "axle_1", run, columns["t"], k, n)]


def missing(runs, rng):
    run, columns, k = _somewhere(runs, rng)
    n = int(rng.integers(20, 60))
    columns["axle_1"][k : k + n] = np.nan
    return [_lasting("sensor_dropout", "axle_1", run, columns["t"], k, n)]


def gap(runs, rng):
    run, columns, k = _somewhere(runs, rng)
    n = int(rng.integers(20, 60))
    start_s = columns["t"][k - 1]
    end_s = columns["t"][k + n]
    for name in columns:
        columns[name] = np.delete(columns[name], slice(k, k + n))
    return [Truth("sensor_dropout", "axle_1", run, start_s, end_s, end_s - start_s)]


def stuck(runs, rng):
    run, columns, _ = _somewhere(runs, rng)
    k = int(np.searchsorted(columns["t"], 16.0))
    columns["axle_4"][k : k + 50] = columns["axle_4"][k]
    return [_lasting("sensor_stuck", "axle_4", run, columns["t"], k, 50)]


def clock_step(runs, rng):
    run, columns, k = _somewhere(runs, rng)
    n = int(rng.integers(30, 150))
    start_s = columns["t"][k - 1]
    end_s = columns["t"][k + n - 1] + 1.0
    columns["t"][k : k + n] += 1.0
    return [Truth("clock_step", "axle_1", run, start_s, end_s, 1.0)]


def clock_step_for_good(runs, rng):
    run, columns, _ = _somewhere(runs, rng)
    k = int(np.searchsorted(columns["t"], 17.0))
    start_s = columns["t"][k - 1]
    columns["t"][k:] += 1.0
    return [Truth("clock_step", "axle_1", run, start_s, None, 1.0)]


def old_messages(runs, rng):
    truths = []
    for run, columns in runs.items():
        n = int(rng.integers(20, 60)) if truths else 60
        for name in columns:
            if name not in ("t", "place", "handle"):
                columns[name][:n] = 0.6 * columns[name][:n]
        end_s = columns["t"][n - 1]
        truths.append(Truth("old_messages", "axle_1", run, 0.0, end_s, n * STEP_S))
    return truths


def copied(runs, rng):
    run, columns, _ = _somewhere(runs, rng)
    k = int(np.searchsorted(columns["t"], 15.0))
    n = 90
    for name in columns:
        if name not in ("t", "place"):
            columns[name][k + 200 : k + 200 + n] = columns[name][k : k + n]
    return [_lasting("copy", "axle_1", run, columns["t"], k + 200, n)]


def line(runs, rng):
    run, columns, _ = _somewhere(runs, rng)
    k = int(np.searchsorted(columns["t"], 15.0))
    n = 45
    speed = columns["axle_1"]
    speed[k : k + n] = np.linspace(speed[k], speed[k + n - 1], n)
    return [_lasting("interpolated", "axle_1", run, columns["t"], k, n)]


BEFORE = (radius, radius_step, late, unit, drift, noise)
AFTER = (zeros, missing, gap, stuck, clock_step, clock_step_for_good, old_messages, copied, line)


def _lasting(name, channel, run, time_s, k, n):
    """Return the truth of a defect in n samples from sample k on."""
    return Truth(name, channel, run, time_s[k], time_s[k + n - 1], n * STEP_S)


def _somewhere(runs, rng):
    """Return a random run (name, columns), and a random sample in its second quarter."""
    run = list(runs)[int(rng.integers(len(runs)))]
    n = runs[run]["t"].size
    return run, runs[run], int(rng.integers(n // 4, n // 2))


def dataset(folder, stops_by_name, seed, defects=(), **channels):
    """Write a dataset with some hidden defects, and return the truths about them.

    `channels` are the arguments of `record`. The second half of the runs has a later date.
    """
    rng = np.random.default_rng(seed)
    runs = {name: record(true, rng, **channels) for name, true in stops_by_name.items()}
    truths = []
    for defect in defects:
        if defect in BEFORE:
            truths += defect(runs, rng)
    runs = {name: rounded(columns) for name, columns in runs.items()}
    for defect in defects:
        if defect in AFTER:
            truths += defect(runs, rng)

    runs_of_month = max(len(runs) // 2, 1)
    dates = [f"2026-0{1 + k // runs_of_month}-01" for k in range(len(runs))]
    write(folder, runs, dates)
    return truths
