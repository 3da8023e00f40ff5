"""Compares the results of two checkouts: stops in lockstep to the bit, explanations to their last
figure.

    .venv/bin/python tests/unchanged.py record before      # in the first checkout
    .venv/bin/python tests/unchanged.py record after       # in the second one, with the same file
    .venv/bin/python tests/unchanged.py compare before after

`record` brakes the six stops on the three rigs in lockstep, and explains the shipped datasets and
twenty generated ones. An interrupted recording continues where it stopped. `compare` prints one
line for each result and exits with status 1 if something differs: channels by their largest
relative difference, the bus log byte by byte, reports by verdict, causes and values.
"""

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq

STOPS = ("velim_a1", "velim_a2", "velim_a3", "velim_b1", "velim_b2", "velim_b3")
RIGS = ("plain_track", "full_scale", "virtual_track")
SHIPPED = ("open_none", "open_rail_cleaning", "eurosprinter_127001", "velim_synthetic")
GENERATED = 10  # datasets of each generator
SEED = 81000
# largest relative differences that count as unchanged
CLOSE_CHANNELS = 1e-9
CLOSE_REPORTS = 1e-6
# parts of a report whose numbers are compared
COMPARED = ("causes", "gain", "misfit", "unknown")


def rollerrig(*words):
    """Run a command with the interpreter that runs this file."""
    return subprocess.run(
        [sys.executable, "-m", "rollerrig.realtime.cli", *map(str, words)],
        capture_output=True,
        text=True,
    )


def print_status(name, done):
    """Print the exit status of a command, and the end of its messages if it failed."""
    messages = done.stderr[-300:] if done.returncode else ""
    print(name, done.returncode, messages, flush=True)


def record_stop(out, stop, rig):
    folder = out / "stops" / f"{stop}_{rig}"
    if (folder / "summary.json").is_file():
        return
    done = rollerrig("run", stop, "--pacing", "lockstep", "--set", f"rig={rig}", "--out", folder)
    print_status(folder.name, done)


def generated_sets(folder):
    """Yield twenty generated datasets: (name, folder)."""
    from generator import braking_stops, other_stops

    for generator in (braking_stops, other_stops):
        name = generator.__name__.rpartition(".")[2]
        single = [{cause: size} for cause, size in list(generator.SMALLEST.items())[::3]]
        hidden_effects = [{}, {}, *single, *generator.PAIRS[:2]]
        for k, effects in enumerate(hidden_effects[:GENERATED]):
            place = folder / f"{name}_{k}"
            if not (place / "dataset.toml").is_file():
                generator.make(place, effects, SEED + k)
            yield place.name, place


def record_explanation(out, name, data):
    folder = out / "explained" / name
    if (folder / "report.json").is_file():
        return
    print_status(name, rollerrig("explain", data, "--out", folder))


def record(out, stops=True, explanations=True):
    if stops:
        for stop in STOPS:
            for rig in RIGS:
                record_stop(out, stop, rig)
    if explanations:
        jobs = [(name, name) for name in SHIPPED]
        jobs += generated_sets(out / "sets")
        workers = max(1, (os.cpu_count() or 2) - 1)
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(lambda job: record_explanation(out, *job), jobs))


def channels_apart(a, b):
    """Return the largest difference of any channel, relative to the largest value of the channel.

    It is 0 if all channels are equal to the bit, inf if names or numbers of rows differ.
    """
    first = pq.read_table(a / "channels.parquet")
    second = pq.read_table(b / "channels.parquet")
    if first.column_names != second.column_names or first.num_rows != second.num_rows:
        return np.inf
    apart = 0.0
    for name in first.column_names:
        x = np.asarray(first[name].to_numpy(), dtype=float)
        y = np.asarray(second[name].to_numpy(), dtype=float)
        if not np.array_equal(x, y, equal_nan=True):
            scale = np.nanmax(np.abs(x), initial=1e-300)
            apart = max(apart, float(np.nanmax(np.abs(x - y)) / scale))
    return apart


def leaves(value, path=""):
    """Yield all (path, leaf) of a JSON value."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{path}.{key}")
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from leaves(inner, f"{path}[{k}]")
    else:
        yield path, value


class Findings(NamedTuple):
    """The verdict of a report, its causes, and its numbers by their paths."""

    verdict: str | None
    causes: list
    values: dict

    @classmethod
    def of(cls, folder):
        report = json.loads((folder / "report.json").read_text())
        causes = [
            (cause["name"], cause["axles"], cause["confusable_with"])
            for cause in report.get("causes", ())
        ]
        values = dict(leaves({key: report.get(key) for key in COMPARED}))
        return cls(report.get("verdict"), causes, values)


def reports_apart(a, b):
    """Return (whether verdict and causes are equal, largest relative difference of the
    numbers).
    """
    first = Findings.of(a)
    second = Findings.of(b)
    equal = (first.verdict, first.causes) == (second.verdict, second.causes)
    apart = 0.0
    for path in first.values.keys() | second.values.keys():
        x = first.values.get(path)
        y = second.values.get(path)
        if is_number(x) and is_number(y):
            apart = max(apart, abs(x - y) / max(abs(x), abs(y), 1e-12))
        elif x != y:
            apart = np.inf
    return equal, apart


def is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)


def results(a, b, kind, file):
    """Yield the folders of one kind that both recordings have, with this file."""
    if not (a / kind).is_dir():
        return
    for folder in sorted((a / kind).iterdir()):
        other = b / kind / folder.name
        if (other / file).is_file():
            yield folder, other


def compare(a, b):
    """Print a line for each result; return 1 if something differs, else 0."""
    differs = False
    for folder, other in results(a, b, "stops", "summary.json"):
        apart = channels_apart(folder, other)
        log_equal = (folder / "can.log").read_bytes() == (other / "can.log").read_bytes()
        channels = "equal to the bit" if apart == 0.0 else f"apart by {apart:.1e}"
        log = "equal" if log_equal else "NOT EQUAL"
        print(f"{folder.name:28} channels {channels}, bus log {log}")
        differs |= apart > CLOSE_CHANNELS or not log_equal
    for folder, other in results(a, b, "explained", "report.json"):
        equal, apart = reports_apart(folder, other)
        findings = "same verdict and causes" if equal else "OTHER VERDICT OR CAUSES"
        values = "equal" if apart == 0.0 else f"apart by {apart:.1e}"
        print(f"{folder.name:28} {findings}, values {values}")
        differs |= not equal or apart > CLOSE_REPORTS
    return int(differs)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("verb", choices=("record", "compare"))
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--only", choices=("stops", "explanations"))
    given = parser.parse_args()
    if given.verb == "record":
        record(given.folders[0], given.only != "explanations", given.only != "stops")
        return 0
    return compare(*given.folders)


if __name__ == "__main__":
    sys.exit(main())
