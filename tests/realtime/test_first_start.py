"""A first start: the progress that is shown while numba compiles, and the kernels that are kept."""

import fcntl
import os
import re
import subprocess
import sys
import time

import pytest

from rollerrig.realtime.bench.tick_data import KERNELS
from rollerrig.realtime.commands import explain
from rollerrig.rig.compiled import kernel_cache

SHORT = (
    *("run", "velim_a1", "--set", "duration_max_s=0.3", "--set", "bus.interface=hub"),
    *("--set", "bus.socketcand_port=0", "--set", "modbus.port=0"),
)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("words", "kernels"),
    [
        ((*SHORT, "--pacing", "free"), KERNELS["free"]),
        ((*SHORT, "--pacing", "lockstep"), KERNELS["lockstep"]),
        ((*SHORT, "--pacing", "wall", "--also-without-wsp"), KERNELS["wall"]),
        (("explain", "open_none"), explain._KERNELS),
    ],
    ids=["free", "lockstep", "wall", "explain"],
)
def test_a_first_start_announces_that_it_compiles_and_reports_its_progress(
    words, kernels, tmp_path
):
    program = (
        "import sys; from rollerrig.realtime import cli;"
        "from rollerrig.rig.compiled import compile_progress;"
        "cli.main(sys.argv[1:]); print('counted', compile_progress._listener.compiled)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *words, "--out", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        env=os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")},
    )
    assert "compiling the kernels" in done.stderr
    progress = r"compiling: kernel \d+ of about (\d+), about \d+ s left\n"
    assert set(re.findall(progress, done.stderr)) == {str(kernels)}
    (counted,) = re.findall(r"^counted (\d+)$", done.stdout, re.MULTILINE)
    assert int(counted) == pytest.approx(kernels, rel=0.1)


def test_a_kernel_that_is_compiled_within_a_moment_is_not_announced():
    code = (
        "import logging, time\n"
        "logging.basicConfig()\n"
        "from rollerrig.rig.compiled import compile_progress\n"
        "import numba\n"
        "compile_progress.ANNOUNCED_AFTER_S = 60.0\n"
        "numba.njit(lambda x: x + 1)(1)\n"
        "time.sleep(2.0)\n"
        "print(compile_progress.has_compiled())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
    assert done.stderr == ""


def test_kernels_that_are_in_the_cache_are_not_announced():
    code = (
        "from rollerrig.rig import brake\n"
        "from rollerrig.rig.compiled import compile_progress\n"
        "print(compile_progress.has_compiled())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
    assert done.stderr == ""


def generation(base, number, size=0):
    """Make a folder of compiled kernels; of two folders, the higher number was used later."""
    folder = base / f"kernels-{number}"
    folder.mkdir(parents=True)
    (folder / "kernel.nbc").write_bytes(bytes(size))
    last_use_s = time.time() - 1000 + number
    os.utime(folder, (last_use_s, last_use_s))
    return folder


def remaining(base):
    """Return the numbers of the generations that are in a folder."""
    return {int(path.name.removeprefix("kernels-")) for path in base.iterdir()}


def test_the_generations_used_last_are_kept(tmp_path):
    for number in range(6):
        generation(tmp_path, number)
    kernel_cache.remove_old(tmp_path, folders_kept=4)
    assert remaining(tmp_path) == {2, 3, 4, 5}


def test_generations_beyond_the_size_are_removed_oldest_first(tmp_path):
    for number in range(4):
        generation(tmp_path, number, 1000)
    kernel_cache.remove_old(tmp_path, folders_kept=4, bytes_kept=2500)
    assert remaining(tmp_path) == {2, 3}


def test_a_generation_that_a_process_uses_is_never_removed(tmp_path):
    used = generation(tmp_path, 0)
    for number in range(1, 6):
        generation(tmp_path, number)
    # a process that locks the folder until its input is closed
    code = (
        "import fcntl, os, sys\n"
        "fcntl.flock(os.open(sys.argv[1], os.O_RDONLY), fcntl.LOCK_SH)\n"
        "print(flush=True)\n"
        "sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(used)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        process.stdout.readline()
        kernel_cache.remove_old(tmp_path, folders_kept=2)
        assert remaining(tmp_path) == {0, 4, 5}
        process.stdin.close()
    kernel_cache.remove_old(tmp_path, folders_kept=2)
    assert remaining(tmp_path) == {4, 5}


def test_a_process_locks_the_generation_that_it_uses():
    file = os.open(kernel_cache.folder(), os.O_RDONLY)
    try:
        with pytest.raises(OSError, match="unavailable"):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    finally:
        os.close(file)


def test_a_run_is_recorded_and_summed_up_without_pandas(tmp_path):
    code = (
        "import sys\n"
        "from rollerrig.realtime import cli\n"
        "status = cli.main(['run', 'dry_stop', '--wsp=none', '--pacing=free', "
        "'--set', 'initial_speed_m_s=3', "
        f"'--json', '--out', {str(tmp_path / 'run')!r}])\n"
        "print(status, 'pandas' in sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1] == "0 False"


def test_run_loads_no_package_that_only_other_commands_use():
    # the last line proves that two of the packages are installed
    code = (
        "import sys\n"
        "from rollerrig.realtime import cli\n"
        "cli.main(['run', 'nothing'])\n"
        "from rollerrig.realtime.bench import bench\n"
        "unused = {'asammdf', 'pandas', 'scipy.linalg', 'matplotlib', 'rerun', 'distributed'}\n"
        "print(sorted(sys.modules.keys() & unused))\n"
        "import asammdf, scipy.linalg"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_recorder_loads_neither_the_compiler_nor_pandas():
    code = (
        "import io, sys\n"
        "sys.stdin = io.StringIO()\n"
        "from rollerrig.realtime.record import channels\n"
        "from rollerrig.realtime.telemetry import recorder\n"
        "channels.leave_pandas_out()\n"
        "import pyarrow\n"
        "pyarrow.array([1.0])\n"
        "print(recorder.main([]), sorted(sys.modules.keys() & {'numba', 'pandas'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0 []"
