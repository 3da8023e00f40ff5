"""Whether two checkouts give the same: stops in lockstep to the bit, explanations to their last figure.

    .venv/bin/python tests/unchanged.py record before      # in the one checkout
    .venv/bin/python tests/unchanged.py record after       # in the other, with the same file
    .venv/bin/python tests/unchanged.py compare before after

`record` brakes the six stops on the three rigs in lockstep and explains the shipped sets and twenty
generated ones; it goes on where it was interrupted. `compare` prints one line for each and ends with
status 1 where something differs: channels by their largest relative difference, the bus log byte by
byte, reports by verdict, causes and values.
"""

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

STOPS = ("velim_a1", "velim_a2", "velim_a3", "velim_b1", "velim_b2", "velim_b3")
RIGS = ("plain_track", "full_scale", "virtual_track")
SHIPPED = ("open_none", "open_rail_cleaning", "eurosprinter_127001", "velim_synthetic")
GENERATED = 10  # of each generator
SEED = 81000
CLOSE = 1e-9


def rollerrig(*words):
    """Run the command of the interpreter that runs this file."""
    return subprocess.run(
        [sys.executable, "-m", "rollerrig.realtime.cli", *map(str, words)],
        capture_output=True,
        text=True,
    )


def record_stop(out, stop, rig):
    folder = out / "stops" / f"{stop}_{rig}"
    if (folder / "summary.json").is_file():
        return
    done = rollerrig("run", stop, "--pacing", "lockstep", "--set", f"rig={rig}", "--out", folder)
    print(folder.name, done.returncode, done.stderr[-300:] if done.returncode else "", flush=True)


def sets(folder):
    """Twenty generated sets: (name, folder)."""
    from generator import braking_stops, other_stops

    for make in (braking_stops, other_stops):
        name = make.__name__.rpartition(".")[2]
        hidden = [
            {},
            {},
            *({cause: size} for cause, size in list(make.SMALLEST.items())[::3]),
            *make.PAIRS[:2],
        ]
        for k, effects in enumerate(hidden[:GENERATED]):
            place = folder / f"{name}_{k}"
            if not (place / "dataset.toml").is_file():
                make.make(place, effects, SEED + k)
            yield place.name, place


def record_explanation(out, name, data):
    folder = out / "explained" / name
    if (folder / "report.json").is_file():
        return
    done = rollerrig("explain", data, "--out", folder)
    print(name, done.returncode, done.stderr[-300:] if done.returncode else "", flush=True)


def record(out, stops=True, explanations=True):
    if stops:
        for stop in STOPS:
            for rig in RIGS:
                record_stop(out, stop, rig)
    if explanations:
        jobs = [(name, name) for name in SHIPPED] + list(sets(out / "sets"))
        with ThreadPoolExecutor(max(1, (os.cpu_count() or 2) - 1)) as pool:
            list(pool.map(lambda job: record_explanation(out, *job), jobs))


def channels_apart(a, b):
    """Largest difference of any channel, relative to the channel's largest value; inf where they do not fit."""
    one, two = (pq.read_table(folder / "channels.parquet") for folder in (a, b))
    if one.column_names != two.column_names or one.num_rows != two.num_rows:
        return np.inf
    apart = 0.0
    for name in one.column_names:
        x, y = (np.asarray(table[name].to_numpy(), dtype=float) for table in (one, two))
        scale = np.nanmax(np.abs(x), initial=1e-300)
        if not np.array_equal(x, y, equal_nan=True):
            apart = max(apart, float(np.nanmax(np.abs(x - y)) / scale))
    return apart


def leaves(value, at=""):
    """All (path, leaf) of a JSON value."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{at}.{key}")
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from leaves(inner, f"{at}[{k}]")
    else:
        yield at, value


def reports_apart(a, b):
    """(verdict and causes alike, largest relative difference of the causes' values and the gain)."""
    one, two = (json.loads((folder / "report.json").read_text()) for folder in (a, b))
    names = [
        (
            r.get("verdict"),
            [(c["name"], c["axles"], c["confusable_with"]) for c in r.get("causes", ())],
        )
        for r in (one, two)
    ]
    apart = 0.0
    values = [
        dict(leaves({key: r.get(key) for key in ("causes", "gain", "misfit", "unknown")}))
        for r in (one, two)
    ]
    for path in values[0].keys() | values[1].keys():
        x, y = (v.get(path) for v in values)
        numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (x, y))
        if numbers:
            apart = max(apart, abs(x - y) / max(abs(x), abs(y), 1e-12))
        elif x != y:
            apart = np.inf
    return names[0] == names[1], apart


def compare(a, b):
    worst = 0
    for folder in sorted((a / "stops").iterdir() if (a / "stops").is_dir() else ()):
        other = b / "stops" / folder.name
        if not (other / "summary.json").is_file():
            continue
        apart = channels_apart(folder, other)
        log = (folder / "can.log").read_bytes() == (other / "can.log").read_bytes()
        print(
            f"{folder.name:28} channels {'equal to the bit' if apart == 0.0 else f'apart by {apart:.1e}'}, "
            f"bus log {'equal' if log else 'NOT EQUAL'}"
        )
        worst |= apart > CLOSE or not log
    for folder in sorted((a / "explained").iterdir() if (a / "explained").is_dir() else ()):
        other = b / "explained" / folder.name
        if not (other / "report.json").is_file():
            continue
        alike, apart = reports_apart(folder, other)
        print(
            f"{folder.name:28} {'same verdict and causes' if alike else 'OTHER VERDICT OR CAUSES'}, "
            f"values {'equal' if apart == 0.0 else f'apart by {apart:.1e}'}"
        )
        worst |= not alike or apart > 1e-6
    return worst


def main():
    given = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given.add_argument("verb", choices=("record", "compare"))
    given.add_argument("folders", nargs="+", type=Path)
    given.add_argument("--only", choices=("stops", "explanations"))
    given = given.parse_args()
    if given.verb == "record":
        record(given.folders[0], given.only != "explanations", given.only != "stops")
        return 0
    return int(compare(*given.folders))


if __name__ == "__main__":
    sys.exit(main())
