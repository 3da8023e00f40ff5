"""Compiles the kernels that many tests call, before the workers of `make test` start.

Two workers that compile the same kernel at the same time need double the time. The compiled kernels
remain in the cache until a source with kernels changes. A mark in the folder of the cache shows
that this checkout has been compiled.
"""

import hashlib
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import ending

from rollerrig.rig.compiled import kernel_cache

ROOT = Path(__file__).parent.parent
# exit status of a run that has passed, and of one that is not valid: a short run does not stop
ACCEPTED = (0, 4)
WORKERS = 2

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
# the generators of stops are no command, so their kernels need a program
GENERATORS = """import sys
from pathlib import Path
from generator import braking_stops, other_stops
other_stops.make(Path(sys.argv[-1]), {}, 1, ("a3",))
braking_stops.make(Path(sys.argv[-1]), {}, 1)
"""
CAMPAIGN = """title = "two short stops"
scenario = "velim_a1"
design = "matrix"
[vary]
initial_speed_m_s = [1.0, 2.0]
"""
# Series of commands; a worker runs the commands of a series one after another. The longest series
# is first. A text is a Python program.
SERIES = (
    ((*RUN, "--pacing", "wall"), (*RUN, "--pacing", "lockstep"), (*RUN, "--pacing", "free")),
    ((*COACH, "rig=plain_track"), (*COACH, "rig=virtual_track")),
    (
        ("tune", "velim_synthetic"),
        ("campaign", "CAMPAIGN"),
        (*RUN, "--pacing", "free", "--wsp", "none"),
        GENERATORS,
    ),
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
        ThreadPoolExecutor(WORKERS) as workers,
    ):
        running = []
        for number, commands in enumerate(SERIES):
            running.append(workers.submit(run_series, commands, Path(folder) / str(number)))
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


def run_series(commands, folder):
    """Run commands one after another, each with a result folder inside `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    plan = folder / "campaign.toml"
    plan.write_text(CAMPAIGN)
    for number, words in enumerate(commands):
        done = subprocess.run(
            [sys.executable, *arguments_of(words, plan), "--out", str(folder / str(number))],
            cwd=ROOT / "tests",
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        if done.returncode not in ACCEPTED:
            raise SystemExit(done.stderr)


def arguments_of(words, plan):
    """Return the arguments of the interpreter for a program, or for the words of a command."""
    if isinstance(words, str):
        return ["-c", words]
    replaced = [str(plan) if word == "CAMPAIGN" else word for word in words]
    return ["-m", "rollerrig.realtime.cli", *replaced]


if __name__ == "__main__":
    main()
