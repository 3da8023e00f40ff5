"""`rollerrig bench soak` and `bench kill`, in small: what a long run takes, and what a killed one has lost."""

import argparse
import re

import pytest
from endurance import kill, runs, soak


@pytest.fixture(scope="module")
def soaked():
    return soak.run(argparse.Namespace(seconds=16.0), lambda text: None)


@pytest.mark.parametrize("pacing", soak.PACINGS)
def test_a_long_run_is_told_by_process_with_disk_losses_and_missed_ticks(pacing, soaked):
    told = soaked[pacing]
    assert told["simulated_s"] > 2.0
    assert set(told["memory_MB"]) == {"bench", *runs.ROLES}
    assert all(one > 10.0 for one in told["memory_MB"].values())
    assert told["disk_MB_h"] > 10.0
    assert told["frames"] > 1000.0 * told["simulated_s"]
    assert (told["dropped"], told["lost"], told["traceback"]) == (0, 0, 0)
    assert told["missed"] <= told["ticks"]
    [because] = told["because"]
    interrupted = re.fullmatch(r"the run is interrupted by SIGTERM, at (\d+\.\d\d) s", because)
    assert interrupted, because
    assert float(interrupted[1]) == pytest.approx(
        told["ticks"] / 1000, abs=0.011
    )  # both are told to 0.01 s


@pytest.mark.parametrize("pacing", soak.PACINGS)
def test_a_bench_that_writes_its_summary_holds_no_reserve_of_a_library_in_memory(pacing, soaked):
    assert soaked[pacing]["at_end_MB"]["bench"] < soaked[pacing]["memory_MB"]["bench"] + 200.0


@pytest.mark.parametrize(
    "how", ["recorder + bench", "recorder + unit + bench", "group", "unit", "SIGHUP"]
)
def test_whatever_is_killed_a_second_is_lost_at_most_and_no_process_is_left(how):
    found = kill.killed(how, "wall", 0.7)
    assert found["unreadable"] == ""
    assert found["lost_s"] <= kill.LOST_S
    assert (found["left"], found["traceback"]) == (0, 0)
