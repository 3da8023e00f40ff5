"""The suite relies on this behaviour of the tools that run it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from process_tree import descendants, is_running

# a test that starts a process in another session, and one whose parent has exited
STARTS_PROCESSES = """
import subprocess, time
def test_that_is_interrupted():
    subprocess.Popen(["sleep", "900"], start_new_session=True)
    subprocess.run(["sh", "-c", "trap '' TERM; sh -c 'sleep 901; sleep 902'; true"])
"""
LONGEST_S = 300.0


@pytest.mark.skipif("PYTEST_XDIST_WORKER" not in os.environ, reason="one process runs all tests")
def test_one_worker_runs_all_tests_of_a_file(request):
    # otherwise several workers would make the fixtures of a file
    assert request.node.nodeid.endswith("@tests/test_suite.py")


def test_a_session_that_gets_sigterm_leaves_no_process(tmp_path):
    (tmp_path / "test_long.py").write_text(STARTS_PROCESSES)
    words = [sys.executable, "-m", "pytest", "-p", "ending", "-p", "no:cacheprovider", "-n", "1"]
    names = [name for name in os.environ if name.startswith("PYTEST_")]
    environment = {name: value for name, value in os.environ.items() if name not in names}
    environment["PYTHONPATH"] = str(Path(__file__).parent)
    with subprocess.Popen(
        words, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL
    ) as session:
        end_s = time.monotonic() + LONGEST_S
        started = {}
        while sum("sleep 90" in command for command in started.values()) < 2:
            assert time.monotonic() < end_s, started
            time.sleep(0.05)
            started = descendants(session.pid)
        session.send_signal(signal.SIGTERM)
        assert session.wait(LONGEST_S) == 128 + signal.SIGTERM
    assert not any(map(is_running, started))
