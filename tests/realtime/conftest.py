"""Runs that several test files look at: each is made once."""

import bench_process
import pytest


@pytest.fixture(scope="session")
def folders(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="session")
def stop_with_wsp(folders):
    """velim_a1 over the bus in lockstep, the reference unit in its own process."""
    return bench_process.run(folders / "with", "--pacing", "lockstep")


@pytest.fixture(scope="session")
def stop_without_wsp(folders):
    return bench_process.run(folders / "without", "--pacing", "lockstep", "--wsp", "none")


@pytest.fixture(scope="session")
def free_stop(folders):
    """The same stop without a bus, the unit's cycle called in the tick."""
    return bench_process.run(folders / "free", "--pacing", "free")


@pytest.fixture(scope="session")
def wall_run(folders):
    """Four seconds in real time."""
    return bench_process.run(folders / "wall", "--pacing", "wall", "--set", "duration_max_s=4")
