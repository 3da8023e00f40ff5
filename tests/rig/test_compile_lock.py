"""One process compiles, the others wait and load: kernels are compiled once, and nobody hangs."""

import os
import signal
import subprocess
import sys
import time

import pytest

from rollerrig.rig.compiled import compile_lock

# a module with a kernel that needs some time to compile: its loops are unrolled by hand
MODULE = """
from rollerrig.rig.compiled.kernel import kernel

@kernel
def inner(x):
    return {terms}

@kernel
def outer(x):
    return inner(x) + inner(x + 1.0)
"""
PROGRAM = """
import sys, time
sys.path.insert(0, sys.argv[1])
from rollerrig.rig.compiled import compile_lock, compile_progress
import many_terms
compile_lock.LONGEST_S = float(sys.argv[2])
sys.stdin.readline()
many_terms.outer(1.0)
print(compile_progress._listener.compiled, flush=True)
sys.stdin.readline()
"""
TERMS = [f"(x * {n}.5 if x > {n}.0 else x / {n}.25)" for n in range(1, 120)]
# some are enough where a process is not stopped while it compiles
FEW_TERMS = TERMS[:30]


@pytest.fixture
def processes(tmp_path):
    """Return a function that starts processes which wait for a line before they compile."""
    started = []

    def start(count, longest_s=300.0, terms=TERMS):
        if not started:
            (tmp_path / "many_terms.py").write_text(MODULE.format(terms=" + ".join(terms)))
        for _ in range(count):
            started.append(
                subprocess.Popen(
                    [sys.executable, "-c", PROGRAM, str(tmp_path), str(longest_s)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                    env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")},
                )
            )
        return started[-count:]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def compile_now(process) -> None:
    process.stdin.write("\n")
    process.stdin.flush()


def compiled(process) -> int:
    """Return how many kernels a process has compiled."""
    return int(process.stdout.readline())


def locks(tmp_path):
    """Return the files of locks in the cache."""
    return list((tmp_path / "kernels").rglob("compiling.lock"))


def test_of_several_processes_one_compiles_each_kernel(processes):
    both = processes(2, terms=FEW_TERMS)
    for process in both:
        compile_now(process)
    counts = sorted(compiled(process) for process in both)
    assert counts[0] == 0
    assert counts[1] > 0


def test_the_lock_is_free_while_its_process_lives_on(processes, tmp_path):
    first, second = processes(2, terms=FEW_TERMS)
    compile_now(first)
    assert compiled(first) > 0
    # the first process is still there, and has kept nothing that the second one waits for
    for index in (tmp_path / "kernels").rglob("*.nbi"):
        index.unlink()
    compile_now(second)
    assert compiled(second) > 0
    assert first.poll() is None


def test_a_process_that_is_killed_while_it_compiles_blocks_nobody(processes, tmp_path):
    first, second = processes(2)
    compile_now(first)
    while not locks(tmp_path):
        time.sleep(0.01)
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    compile_now(second)
    assert compiled(second) > 0


@pytest.mark.nightly
def test_a_process_that_is_suspended_while_it_compiles_blocks_nobody_for_ever(processes, tmp_path):
    (first,) = processes(1)
    (second,) = processes(1, longest_s=0.1)
    compile_now(first)
    while not locks(tmp_path):
        time.sleep(0.01)
    os.kill(first.pid, signal.SIGSTOP)
    compile_now(second)
    assert compiled(second) > 0


def test_a_forked_process_does_not_keep_a_lock(tmp_path):
    here = compile_lock.CompileLock(tmp_path)
    here.take("kernel")
    child = os.fork()
    if child == 0:
        signal.pause()
    try:
        here.release("kernel")
        # a lock of another process would be an error here
        program = (
            "import sys; from pathlib import Path;"
            "from rollerrig.rig.compiled.compile_lock import CompileLock;"
            "sys.exit(not CompileLock(Path(sys.argv[1]))._try('kernel'))"
        )
        done = subprocess.run([sys.executable, "-c", program, str(tmp_path)])
        assert done.returncode == 0
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
