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

from rollerrig.rig import kernel

ROOT = Path(__file__).parent.parent
RUN = ("run", "velim_a1", "--set", "duration_max_s=0.3", "--set", "bus.socketcand_port=0", "--set", "modbus.port=0")
# the longest first; commands of one line one after the other
COMMANDS = (
    ((*RUN, "--pacing", "wall"), (*RUN, "--pacing", "lockstep"), (*RUN, "--pacing", "free")),
    ((*RUN, "--pacing", "free", "--set", "vehicle.model=multibody", "--set", "rig=plain_track"),),
    (("tune", "velim_synthetic"),),
)


def main():
    mark = Path(kernel.settings.CACHE_DIR) / f"compiled-{hashlib.sha256(str(ROOT).encode()).hexdigest()[:16]}"
    if mark.exists():
        return
    begun_s = time.monotonic()
    print("compiling kernels ...", flush=True)
    with tempfile.TemporaryDirectory(prefix="rollerrig-compile-") as folder, ThreadPoolExecutor(2) as workers:
        list(workers.map(lambda n: compile_with(COMMANDS[n], Path(folder) / str(n)), range(len(COMMANDS))))
    mark.touch()
    print(f"compiled in {time.monotonic() - begun_s:.0f} s")


def compile_with(commands, folder):
    for n, words in enumerate(commands):
        subprocess.run([sys.executable, "-m", "rollerrig.realtime.cli", *words, "--out", str(folder / str(n))],
                       cwd=ROOT, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
