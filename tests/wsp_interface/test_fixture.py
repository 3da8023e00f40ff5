"""The pytest plugin as a WSP team uses it: tests without a conftest, in another pytest."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

GOOD = """
def test_a_wheel_turns_{name}(rollerrig_bench, tmp_path):
    rig = rollerrig_bench(initial_speed_km_h=9.0, adhesion="soap")
    rig.brake(bar=1.0)
    rig.wait(0.3)
    _, folder = rollerrig_bench.begun[0]
    file = tmp_path.parent.parent / "{name}.txt"
    file.write_text(rig.bus.channel_info + " in " + str(folder))
    assert "km/h after" in repr(rig)
"""
BAD = """
def test_no_wheel_locks(rollerrig_bench):
    rig = rollerrig_bench(initial_speed_km_h=20.0, adhesion="leaf_film", wsp="none")
    rig.brake(bar=3.8)
    rig.stop(timeout_s=90.0)
    rollerrig_bench.judge(rig)
"""
SHARED = """
import pytest

@pytest.fixture(scope="module")
def rig(rollerrig_module_bench):
    unit = "{python} {unit} {{host}} {{port}}"
    return rollerrig_module_bench(initial_speed_km_h=9.0, adhesion="dry", unit=unit)

def test_it_brakes(rig):
    rig.brake(bar=3.0)
    rig.until(lambda: rig.axles("cylinder_pressure")[0] > 1e5, timeout_s=5.0)

def test_it_still_brakes(rig):
    assert rig.axles("cylinder_pressure")[0] > 1e5
    rig.stop()

def test_it_fails(rig):
    rig.until(lambda: rig.vehicle_speed_m_s > 9.0, timeout_s=0.1)
"""
WAITS = """
import time
def test_waits(rollerrig_bench, tmp_path):
    rig = rollerrig_bench(initial_speed_km_h=36.0)
    (tmp_path / "there").touch()
    time.sleep(600)
"""


def start(folder, files, *arguments):
    """Start another pytest on some files in a folder; its output goes to `output`."""
    theirs = folder / "theirs"
    theirs.mkdir()
    for name, text in files.items():
        (theirs / name).write_text(text)
    with (folder / "output").open("w") as output:
        return subprocess.Popen(
            [
                sys.executable,
                "-m",
                "pytest",
                "-q",
                "-p",
                "no:cacheprovider",
                *arguments,
                "--basetemp",
                str(folder / "base"),
            ],
            cwd=theirs,
            stdout=output,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=without_options(),
        )


def without_options():
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}


def output_of(folder):
    return (folder / "output").read_text()


def processes_with(text):
    """Return the processes with a text in their command line."""
    processes = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if any(text in word for word in words):
            processes.append(int(path.parent.name))
    return processes


@pytest.mark.nightly
def test_the_plugin_needs_no_conftest_and_each_worker_has_separate_ports_and_folders(tmp_path):
    files = {f"test_{name}.py": GOOD.format(name=name) for name in ("one", "two")}
    other_pytest = start(tmp_path, files, "-n", "2", "--dist", "loadfile")
    assert other_pytest.wait(600) == 0, output_of(tmp_path)
    addresses = set()
    folders = set()
    for path in (tmp_path / "base").glob("*.txt"):
        address, folder = path.read_text().split(" in ")
        addresses.add(address)
        folders.add(folder)
    assert len(addresses) == 2
    assert len(folders) == 2


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """What another pytest prints in a session with a failed limit and a shared bench."""
    folder = tmp_path_factory.mktemp("session")
    unit = Path(__file__).parents[2] / "docs/examples/wsp_unit.py"
    shared = SHARED.format(python=sys.executable, unit=unit)
    assert start(folder, {"test_bad.py": BAD, "test_shared.py": shared}).wait(600) == 1
    return output_of(folder)


def test_a_failed_test_shows_the_figure_with_its_limit_and_where_run_and_plot_are(printed):
    assert re.search(
        r"longest_lock \d+\.\d+ s, wanted at most 0.4 s; .*source: recollection", printed
    ), printed
    assert "0.0 km/h after" in printed
    run = Path(re.search(r"^run: (.+)$", printed, re.MULTILINE)[1])
    plot = Path(re.search(r"^plot: (.+)$", printed, re.MULTILINE)[1])
    assert (run / "channels.parquet").is_file()
    assert plot.read_text().startswith("<svg")


def test_the_tests_of_a_module_share_a_bench_with_a_unit_of_the_user(printed):
    # the test of the limit and the last test of the module, and no error in a teardown
    assert printed.splitlines()[-1].startswith("2 failed, 2 passed in")
    assert "test_shared.py, line 18: rig.until(lambda: rig.vehicle_speed_m_s > 9.0" in printed
    _, run = dict.fromkeys(re.findall(r"^run: (.+)$", printed, re.MULTILINE))
    assert Path(run, "stop.svg").is_file()


@pytest.mark.parametrize("workers", [(), pytest.param(("-n", "1"), marks=pytest.mark.nightly)])
def test_no_bench_outlives_a_session_that_is_killed(workers, tmp_path):
    other_pytest = start(tmp_path, {"test_waits.py": WAITS}, *workers)
    end_s = time.monotonic() + 300.0
    while not list((tmp_path / "base").rglob("there")):
        assert other_pytest.poll() is None, output_of(tmp_path)
        assert time.monotonic() < end_s
        time.sleep(0.1)
    base = str(tmp_path / "base")
    assert len(processes_with(base)) > 1
    os.kill(other_pytest.pid, signal.SIGKILL)
    other_pytest.wait()
    while remaining := processes_with(base):
        assert time.monotonic() < end_s, remaining
        time.sleep(0.1)
