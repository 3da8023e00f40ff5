"""A first start: what is said while numba compiles, and which compiled kernels are kept."""

import fcntl
import itertools
import os
import re
import subprocess
import sys
import time

import pytest

from rollerrig.rig.compiled import kernel_cache


def started(*words, cache, out):
    """A command with an empty cache of kernels."""
    return subprocess.Popen(
        [sys.executable, "-m", "rollerrig.realtime.cli", *words, "--out", str(out)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"XDG_CACHE_HOME": str(cache)},
    )


@pytest.mark.parametrize(
    "words",
    [("run", "velim_a1", "--pacing", "free"), ("explain", "open_rail_cleaning")],
    ids=lambda words: words[0],
)
def test_a_first_start_says_that_it_compiles_before_it_does_and_then_how_far_it_is(words, tmp_path):
    with started(*words, cache=tmp_path / "cache", out=tmp_path / "out") as process:
        # a verb may say in between how far its own work is
        first = process.stderr.readline()
        told = (
            re.fullmatch(r"compiling: \d+ s so far, (\d+) kernels done\n", line)
            for line in process.stderr
        )
        counts = [int(one[1]) for one in itertools.islice(filter(None, told), 2)]
        process.kill()
    assert first.startswith("compiling the kernels")
    assert len(counts) == 2
    assert counts == sorted(counts)
    assert counts[-1] > 0


def test_what_is_compiled_is_not_announced_again():
    code = (
        "from rollerrig.rig import brake\n"
        "from rollerrig.rig.compiled import compile_progress\n"
        "print(compile_progress.has_compiled())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("False\n", "")


def generation(base, number, size=0):
    folder = base / f"kernels-{number}"
    folder.mkdir(parents=True)
    (folder / "kernel.nbc").write_bytes(bytes(size))
    os.utime(folder, (time.time() - 1000 + number,) * 2)
    return folder


def left(base):
    return {int(path.name.removeprefix("kernels-")) for path in base.iterdir()}


def test_the_generations_used_last_are_kept(tmp_path):
    for number in range(6):
        generation(tmp_path, number)
    kernel_cache.remove_old(tmp_path, folders_kept=4)
    assert left(tmp_path) == {2, 3, 4, 5}


def test_generations_beyond_the_size_are_removed_oldest_first(tmp_path):
    for number in range(4):
        generation(tmp_path, number, 1000)
    kernel_cache.remove_old(tmp_path, folders_kept=4, bytes_kept=2500)
    assert left(tmp_path) == {2, 3}


def test_a_generation_that_a_process_uses_is_never_removed(tmp_path):
    used = generation(tmp_path, 0)
    for number in range(1, 6):
        generation(tmp_path, number)
    code = (
        "import fcntl, os, sys\nfcntl.flock(os.open(sys.argv[1], os.O_RDONLY), fcntl.LOCK_SH)\n"
        "print(flush=True)\nsys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(used)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        process.stdout.readline()
        kernel_cache.remove_old(tmp_path, folders_kept=2)
        assert left(tmp_path) == {0, 4, 5}
        process.stdin.close()
    kernel_cache.remove_old(tmp_path, folders_kept=2)
    assert left(tmp_path) == {4, 5}


@pytest.mark.skipif("NUMBA_CACHE_DIR" in os.environ, reason="the cache is somebody else's")
def test_a_process_locks_the_generation_that_it_uses():
    file = os.open(kernel_cache.folder(), os.O_RDONLY)
    try:
        with pytest.raises(OSError, match="unavailable"):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    finally:
        os.close(file)


def test_a_run_is_recorded_and_summed_up_without_pandas(tmp_path):
    code = (
        "import sys\nfrom rollerrig.realtime import cli\n"
        "status = cli.main(['run', 'dry_stop', '--wsp=none', '--pacing=free', '--set', 'initial_speed_m_s=3', "
        f"'--json', '--out', {str(tmp_path / 'run')!r}])\n"
        "print(status, 'pandas' in sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1] == "0 False"


def test_the_command_line_loads_no_package_that_only_others_use():
    code = (
        "import sys\nfrom rollerrig.realtime import cli\ncli.main(['run', 'nothing'])\n"
        "from rollerrig.realtime.bench import bench\nprint(sorted(sys.modules.keys() & "
        "{'asammdf', 'pandas', 'scipy.linalg', 'matplotlib', 'rerun', 'distributed'}))\n"
        "import asammdf, scipy.linalg"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_recorder_loads_neither_the_compiler_nor_pandas():
    code = (
        "import io, sys\nsys.stdin = io.StringIO()\nfrom rollerrig.realtime.record import channels\n"
        "from rollerrig.realtime.telemetry import recorder\nchannels.leave_pandas_out()\n"
        "import pyarrow\npyarrow.array([1.0])\n"
        "print(recorder.main([]), sorted(sys.modules.keys() & {'numba', 'pandas'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0 []"
