"""Short versions of the endurance runs: the resources of a long run, and the losses of a kill."""

import argparse
import os
import re
import signal

import pytest
from endurance import files, kill, runs, soak

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def soaked():
    return soak.run(argparse.Namespace(seconds=16.0), lambda text: None)


@pytest.mark.parametrize("pacing", soak.PACINGS)
def test_a_long_run_is_reported_by_process_with_disk_losses_and_missed_ticks(pacing, soaked):
    run = soaked[pacing]
    assert run["simulated_s"] > 2.0
    assert set(run["memory_MB"]) == {"bench", *runs.ROLES}
    assert all(memory_MB > 10.0 for memory_MB in run["memory_MB"].values())
    assert run["disk_MB_h"] > 10.0
    assert run["frames"] > 1000.0 * run["simulated_s"]
    assert run["dropped"] == 0
    assert run["lost"] == 0
    assert run["traceback"] == 0
    assert run["missed"] <= run["ticks"]

    [because] = run["because"]
    interrupted = re.fullmatch(r"the run is interrupted by SIGTERM, at (\d+\.\d\d) s", because)
    assert interrupted, because
    # the sentence has two decimals
    assert float(interrupted[1]) == pytest.approx(run["ticks"] / 1000, abs=0.011)


@pytest.mark.parametrize("pacing", soak.PACINGS)
def test_a_bench_that_writes_its_summary_needs_little_more_memory_than_before(pacing, soaked):
    run = soaked[pacing]
    assert run["at_end_MB"]["bench"] < run["memory_MB"]["bench"] + 200.0


@pytest.mark.parametrize(
    "how", ["recorder + bench", "recorder + unit + bench", kill.GROUP, "unit", "SIGHUP"]
)
def test_a_kill_costs_a_second_at_most_and_leaves_no_process(how):
    found = kill.killed(how, "wall", 0.7)
    assert found["unreadable"] == ""
    assert found["lost_s"] <= kill.LOST_S
    assert found["left"] == 0
    assert found["traceback"] == 0


def test_damaged_files_of_each_kind_are_read_or_refused():
    found = files.run(argparse.Namespace(count=4, seed=3), lambda text: None)
    assert found["failures"] == []
    for name, kind in found["kinds"].items():
        assert sum(kind["outcomes"].values()) == 4, name


def test_an_exception_that_is_not_of_the_program_is_found():
    done = files.apart(lambda: 1 / 0)
    assert done["outcome"] == files.FOREIGN
    assert "ZeroDivisionError" in done["text"]


def test_a_process_that_dies_is_found():
    killed = files.apart(lambda: os.kill(os.getpid(), signal.SIGKILL))
    assert killed["outcome"] == files.DIED
