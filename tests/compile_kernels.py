"""Compiles the kernels that many tests call, before the workers of `make test` start.

Two workers that compile the same kernel at the same time need double the time. The compiled kernels
remain in the cache until a source with kernels changes. A mark in the folder of the cache shows
that this checkout has been compiled.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import ending

from rollerrig.realtime import cli
from rollerrig.rig.compiled import kernel_cache

ROOT = Path(__file__).parent.parent
# exit status of a run that has passed, and of one that is not valid: a short run does not stop
ACCEPTED = (0, 4)

RUN = (
    "run",
    "velim_a1",
    "--set",
    "duration_max_s=0.3",
    "--set",
    "bus.interface=hub",
    "--set",
    "bus.socketcand_port=0",
    "--set",
    "modbus.port=0",
)
COACH = (*RUN, "--pacing", "free", "--set", "vehicle.model=multibody", "--set")
CAMPAIGN = """title = "two short stops"
scenario = "velim_a1"
design = "matrix"
[vary]
initial_speed_m_s = [1.0, 2.0]
"""
# s; an explanation of the first seconds of its runs uses all kernels that one of whole runs uses
EXPLAINED = ROOT / "configs/datasets/open_none"
EXPLAINED_S = 4.0
# Series of commands; a process runs the commands of a series one after another, so that each kernel
# which several of them need is compiled once.
SERIES = (
    (
        (*RUN, "--pacing", "wall"),
        (*RUN, "--pacing", "lockstep"),
        (*RUN, "--pacing", "free"),
        (*RUN, "--pacing", "free", "--wsp", "none"),
        (*COACH, "rig=plain_track"),
        (*COACH, "rig=virtual_track"),
    ),
    (("explain", "DATASET"), ("tune", "velim_synthetic"), ("campaign", "CAMPAIGN"), "generators"),
)


def main():
    mark = mark_of_this_checkout()
    if mark and mark.exists():
        return
    ending.end_all_at_sigterm()
    begin_s = time.monotonic()
    print("compiling kernels ...", flush=True)
    with (
        tempfile.TemporaryDirectory(prefix="rollerrig-compile-") as folder,
        ThreadPoolExecutor(len(SERIES)) as workers,
    ):
        running = []
        for number in range(len(SERIES)):
            running.append(workers.submit(start_series, number, Path(folder) / str(number)))
        for series in running:
            series.result()
    if mark:
        mark.touch(mode=0o600)  # a folder of kernels that is open to others is not used
    print(f"compiled in {time.monotonic() - begin_s:.0f} s")


def mark_of_this_checkout():
    """Return the file that marks this checkout as compiled; None if there is no folder for it."""
    folder = kernel_cache.folder()
    if folder is None:
        return None
    digest = hashlib.sha256(str(ROOT).encode()).hexdigest()[:16]
    return folder / f"compiled-{digest}"


def start_series(number, folder):
    """Run a series in a process; raise SystemExit with its messages if it fails."""
    done = subprocess.run(
        [sys.executable, __file__, str(number), str(folder)],
        cwd=ROOT / "tests",
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    if done.returncode:
        raise SystemExit(done.stderr)


def run_series(number, folder):
    """Run the commands of a series in this process, each with a result folder inside `folder`."""
    # an explanation on one core starts no processes, which would compile for themselves
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[number % len(cores)]})
    folder.mkdir(parents=True, exist_ok=True)
    plan = folder / "campaign.toml"
    plan.write_text(CAMPAIGN)
    dataset = folder / "dataset"
    write_first_seconds(dataset)
    paths = {"CAMPAIGN": str(plan), "DATASET": str(dataset)}
    for place, words in enumerate(SERIES[number]):
        out = folder / str(place)
        if words == "generators":
            make_generated_stops(out)
            continue
        replaced = [paths.get(word, word) for word in words]
        status = cli.main([*replaced, "--out", str(out)])
        if status not in ACCEPTED:
            raise SystemExit(f"{' '.join(words)}: status {status}")


def write_first_seconds(folder):
    """Write a dataset with the first seconds of each run of EXPLAINED."""
    shutil.copytree(EXPLAINED, folder)
    content = tomllib.loads((folder / "dataset.toml").read_text())
    samples = round(EXPLAINED_S / content["sample_time_s"])
    for run in content["run"]:
        path = folder / run["file"]
        head, *lines = path.read_text().splitlines(keepends=True)
        path.write_text(head + "".join(lines[:samples]))


def make_generated_stops(out):
    """Make stops with the generators of the tests, which are no command."""
    from generator import braking_stops, other_stops

    other_stops.make(out, {}, 1, ("a3",))
    braking_stops.make(out, {}, 1)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        run_series(int(sys.argv[1]), Path(sys.argv[2]))
    else:
        main()
