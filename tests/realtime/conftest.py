"""Runs that several test files look at: each is made once."""

import bench_process
import pytest

ON_LEAVES = ("--set", "adhesion=leaf_film", "--set", "initial_speed_m_s=20")


@pytest.fixture(scope="session")
def folders(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="session")
def stop_with_wsp(folders):
    """velim_a1 over the bus in lockstep, the reference unit in its own process."""
    return bench_process.run(folders / "with", "--pacing", "lockstep")


@pytest.fixture(scope="session")
def stop_without_wsp(folders):
    """From 20 m/s on leaves, where no sliding cleans enough for a full brake."""
    return bench_process.run(folders / "without", "--pacing", "free", "--wsp", "none", *ON_LEAVES)


@pytest.fixture(scope="session")
def stop_on_leaves(folders):
    """The same with the reference unit."""
    return bench_process.run(folders / "leaves", "--pacing", "free", *ON_LEAVES)


@pytest.fixture(scope="session")
def free_stop(folders):
    """The same stop without a bus, the unit's cycle called in the tick."""
    return bench_process.run(folders / "free", "--pacing", "free")


@pytest.fixture(scope="session")
def wall_run(folders):
    """Four seconds in real time."""
    return bench_process.run(folders / "wall", "--pacing", "wall", "--set", "duration_max_s=4")
