"""A recorder on runs of the bench, and the defects that recordings of trams had; shares no code with explain.

Runs are free stops of the bench, sampled at 10 Hz with rounding to 0.1 km/h; the reference is a receiver
with noise of its own that is 0.3 s late. A defect is a function of the columns of a run; it returns what is true of it.
"""

import functools
import math
import tomllib
from pathlib import Path

import numpy as np

from rollerrig.realtime.bench import free, scenario
from rollerrig.wsp_interface import signals

RADIUS_M = 0.445
STEP_S = 0.1
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


@functools.cache
def stops(kind, speeds=SPEEDS):
    """What the physics computed of stops, clean ones or ones over a patch: columns by name, of every run by name."""
    more, first = {"clean": (CLEAN, 1.5e5), "patch": (PATCH, 2.4e5)}[kind]
    found = {}
    for speed in speeds:
        text = SCENARIO.format(title=kind, speed=speed, first=first) + more
        rows = free.simulate(scenario.read(tomllib.loads(text), Path(f"{kind}_{speed}.toml")))
        found[f"{kind}_{speed}"] = dict(zip(signals.COLUMNS, rows.T, strict=True))
    return found


def record(true, rng, axles=4, reference=True, position=True):
    """Columns of a recording: t, axle_1 .., gnss, place, handle."""
    moving = true["vehicle_speed_m_s"] > 0.5
    t = true["time_s"][moving]
    start = rng.uniform(0.0, 2.0)
    stamps = np.arange(start, t[-1] - 0.5, STEP_S)
    stamps = np.round(stamps + rng.normal(0.0, 0.004, stamps.size), 3)

    def at(name, late=0.0):
        return np.interp(stamps - late, t, true[name][moving])

    out = {"t": stamps - stamps[0]}
    for j in range(1, axles + 1):
        speed = RADIUS_M * at(f"measured_speed_{j}_rad_s") + rng.normal(0.0, 0.02, stamps.size)
        out[f"axle_{j}"] = np.maximum(speed, 0.0)
    if reference:
        # half of a receiver's noise lasts a second
        slow = np.convolve(
            rng.normal(0.0, 0.04 * math.sqrt(10.0), stamps.size + 9), np.full(10, 0.1), "valid"
        )
        out["gnss"] = np.maximum(
            at("vehicle_speed_m_s", 0.3) + slow + rng.normal(0.0, 0.04, stamps.size), 0.0
        )
    if position:
        out["place"] = np.round(at("position_m") + rng.normal(0.0, 1.5), 1)
    out["handle"] = at("brake_demand_Pa")
    return out


def rounded(out):
    """Speeds in km/h as a recorder writes them."""
    return {
        name: np.round(36.0 * values) / 10.0
        if name.startswith("axle")
        else np.round(360.0 * values) / 100.0
        if name == "gnss"
        else values
        for name, values in out.items()
    }


def write(folder, runs, dates=None, units="km/h", delimiter=","):
    """A dataset of recordings (already rounded, in km/h)."""
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
        unit = units if isinstance(units, str) else units.get(name, "km/h")
        told = f', unit = "{unit}"' if name.startswith(("axle", "gnss")) else ""
        key = keys.get(name, f"wheel_speed_{name.removeprefix('axle_')}_m_s")
        lines.append(f'{key} = {{ column = "{name}", name = "{name}"{told} }}')
    for k, (name, columns) in enumerate(runs.items()):
        lines += ["[[run]]", f'file = "{name}.csv"'] + ([f'date = "{dates[k]}"'] if dates else [])
        rows = [",".join(["t", *names]).replace(",", delimiter)]
        for row in zip(columns["t"], *(columns[name] for name in names), strict=True):
            rows.append(delimiter.join("" if math.isnan(x) else f"{x:.9g}" for x in row))
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")
    (folder / "dataset.toml").write_text("\n".join(lines) + "\n")
    return folder


# --- what is hidden: each changes recordings in m/s before they are rounded, or after (AFTER), and tells the truth:
# (name, channel, run, start s, end s, size) with None where there is none ---


def radius(runs, rng, size=0.008, first=0, name="wheel_radius"):
    for run in list(runs)[first:]:
        runs[run]["axle_2"] = runs[run]["axle_2"] / (1.0 + size)
    return [(name, "axle_2", None, None, None, 100.0 * size)]


def radius_step(runs, rng):
    return radius(runs, rng, -0.009, len(runs) // 2, "wheel_radius_step")


def late(runs, rng, size=0.5):
    for columns in runs.values():
        columns["axle_3"] = np.interp(columns["t"] - size, columns["t"], columns["axle_3"])
    return [("speed_sensor_delay", "axle_3", None, None, None, size)]


def zeros(runs, rng):
    run, columns, k = _somewhere(runs, rng)
    n = int(rng.integers(8, 60))
    columns["axle_1"][k : k + n] = 0.0
    return [("sensor_dropout", "axle_1", run, columns["t"][k], columns["t"][k + n - 1], n * STEP_S)]


def missing(runs, rng):
    run, columns, k = _somewhere(runs, rng)
    n = int(rng.integers(20, 60))
    columns["axle_1"][k : k + n] = np.nan
    return [("sensor_dropout", "axle_1", run, columns["t"][k], columns["t"][k + n - 1], n * STEP_S)]


def gap(runs, rng):
    run, columns, k = _somewhere(runs, rng)
    n = int(rng.integers(20, 60))
    start, end = columns["t"][k - 1], columns["t"][k + n]
    for name in columns:
        columns[name] = np.delete(columns[name], slice(k, k + n))
    return [("sensor_dropout", "axle_1", run, start, end, end - start)]


def stuck(runs, rng):
    run, columns, _ = _somewhere(runs, rng)
    k = int(np.searchsorted(columns["t"], 16.0))
    columns["axle_4"][k : k + 50] = columns["axle_4"][k]
    return [("sensor_stuck", "axle_4", run, columns["t"][k], columns["t"][k + 49], 5.0)]


def clock_step(runs, rng):
    run, columns, k = _somewhere(runs, rng)
    n = int(rng.integers(30, 150))
    start, end = columns["t"][k - 1], columns["t"][k + n - 1] + 1.0
    columns["t"][k : k + n] += 1.0
    return [("clock_step", "axle_1", run, start, end, 1.0)]


def clock_step_for_good(runs, rng):
    run, columns, _ = _somewhere(runs, rng)
    k = int(np.searchsorted(columns["t"], 17.0))
    start = columns["t"][k - 1]
    columns["t"][k:] += 1.0
    return [("clock_step", "axle_1", run, start, None, 1.0)]


def old_messages(runs, rng):
    told = []
    for run, columns in runs.items():
        n = int(rng.integers(20, 60)) if told else 60
        for name in columns:
            if name not in ("t", "place", "handle"):
                columns[name][:n] = 0.6 * columns[name][:n]
        told.append(("old_messages", "axle_1", run, 0.0, columns["t"][n - 1], n * STEP_S))
    return told


def copied(runs, rng):
    run, columns, _ = _somewhere(runs, rng)
    k, n = int(np.searchsorted(columns["t"], 15.0)), 90
    for name in columns:
        if name not in ("t", "place"):
            columns[name][k + 200 : k + 200 + n] = columns[name][k : k + n]
    return [("copy", "axle_1", run, columns["t"][k + 200], columns["t"][k + 199 + n], n * STEP_S)]


def unit(runs, rng):
    for columns in runs.values():
        columns["axle_2"] *= 3.6
    return [("wrong_unit", "axle_2", None, None, None, 3.6)]


def line(runs, rng):
    run, columns, _ = _somewhere(runs, rng)
    k, n = int(np.searchsorted(columns["t"], 15.0)), 45
    columns["axle_1"][k : k + n] = np.linspace(
        columns["axle_1"][k], columns["axle_1"][k + n - 1], n
    )
    return [("interpolated", "axle_1", run, columns["t"][k], columns["t"][k + n - 1], n * STEP_S)]


def drift(runs, rng):
    """Not in the list: an axle whose speed drifts away and comes back."""
    run, columns, _ = _somewhere(runs, rng)
    columns["axle_3"] = columns["axle_3"] + 1.0 * np.exp(-0.5 * ((columns["t"] - 16.0) / 4.0) ** 2)
    return [("unknown", "axle_3", run, 10.0, 22.0, None)]


def noise(runs, rng):
    """Not in the list: a sensor that is noisy for some seconds."""
    run, columns, k = _somewhere(runs, rng)
    columns["axle_3"][k : k + 100] += rng.normal(0.0, 0.6, 100)
    return [("unknown", "axle_3", run, columns["t"][k], columns["t"][k + 99], None)]


BEFORE = (radius, radius_step, late, unit, drift, noise)
AFTER = (zeros, missing, gap, stuck, clock_step, clock_step_for_good, old_messages, copied, line)


def _somewhere(runs, rng):
    run = list(runs)[int(rng.integers(len(runs)))]
    n = runs[run]["t"].size
    return run, runs[run], int(rng.integers(n // 4, n // 2))


def dataset(folder, truths, seed, hide=(), dates=True, **kind):
    """A dataset with some defects hidden; returns what is true of them."""
    rng = np.random.default_rng(seed)
    runs = {name: record(true, rng, **kind) for name, true in truths.items()}
    told = [row for one in hide if one in BEFORE for row in one(runs, rng)]
    runs = {name: rounded(columns) for name, columns in runs.items()}
    told += [row for one in hide if one in AFTER for row in one(runs, rng)]
    given = (
        [f"2026-0{1 + k // max(len(runs) // 2, 1)}-01" for k in range(len(runs))] if dates else None
    )
    write(folder, runs, given)
    return told
