"""Compile what many tests call before the workers of `make test` start: two that compile alike cost double.

The compiled kernels stay in the cache of numba until a source with kernels changes; a mark beside them
tells that this checkout has been here before.
"""

import hashlib
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rollerrig.rig.compiled import kernel_cache

ROOT = Path(__file__).parent.parent
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
# the kernels of the generators of stops, which is a program and no command
GENERATORS = """import sys
from pathlib import Path
import rollerrig.rig.compiled.kernel  # it tells numba where to keep them
from generator import braking_stops, other_stops
other_stops.make(Path(sys.argv[-1]), {}, 1, ("a3",))
braking_stops.make(Path(sys.argv[-1]), {}, 1)
"""
# the longest first; commands of one line one after the other
COMMANDS = (
    ((*RUN, "--pacing", "wall"), (*RUN, "--pacing", "lockstep"), (*RUN, "--pacing", "free")),
    ((*COACH, "rig=plain_track"), (*COACH, "rig=virtual_track")),
    (
        ("tune", "velim_synthetic"),
        ("campaign", "CAMPAIGN"),
        (*RUN, "--pacing", "free", "--wsp", "none"),
        GENERATORS,
    ),
)
CAMPAIGN = """title = "two short stops"
scenario = "velim_a1"
design = "matrix"
[vary]
initial_speed_m_s = [1.0, 2.0]
"""


def main():
    mark = (
        kernel_cache.folder() or Path(tempfile.gettempdir())
    ) / f"compiled-{hashlib.sha256(str(ROOT).encode()).hexdigest()[:16]}"
    if mark.exists():
        return
    begun_s = time.monotonic()
    print("compiling kernels ...", flush=True)
    with (
        tempfile.TemporaryDirectory(prefix="rollerrig-compile-") as folder,
        ThreadPoolExecutor(2) as workers,
    ):
        list(
            workers.map(
                lambda n: compile_with(COMMANDS[n], Path(folder) / str(n)), range(len(COMMANDS))
            )
        )
    mark.touch()
    print(f"compiled in {time.monotonic() - begun_s:.0f} s")


def compile_with(commands, folder):
    for n, words in enumerate(commands):
        out = folder / str(n)
        out.parent.mkdir(parents=True, exist_ok=True)
        plan = out.with_suffix(".toml")
        plan.write_text(CAMPAIGN)
        start = (
            ("-c", words)
            if isinstance(words, str)
            else (
                "-m",
                "rollerrig.realtime.cli",
                *(str(plan) if word == "CAMPAIGN" else word for word in words),
            )
        )
        done = subprocess.run(
            [sys.executable, *start, "--out", str(out)],
            cwd=ROOT / "tests",
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        if done.returncode not in (0, 4):  # a run need not stop here
            raise SystemExit(done.stderr)


if __name__ == "__main__":
    main()
