"""Runs that several test files examine: each run is made once in a session of tests."""

import functools
from pathlib import Path

import bench_process
import program
import pytest


@pytest.fixture(scope="session")
def folders(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="session")
def stop_with_wsp(folders):
    """velim_a1 over the bus in lockstep, with the reference unit in a separate process."""
    return bench_process.run(folders / "with", "--pacing", "lockstep")


@pytest.fixture(scope="session")
def stop_without_wsp(folders):
    """A stop from 20 m/s on leaves, where sliding never cleans enough for a full brake."""
    return bench_process.run(
        folders / "without", "--pacing", "free", "--wsp", "none", *bench_process.ON_LEAVES
    )


@pytest.fixture(scope="session")
def stop_on_leaves(folders):
    """The same stop on leaves, with the reference unit."""
    return bench_process.run(folders / "leaves", "--pacing", "free", *bench_process.ON_LEAVES)


@pytest.fixture(scope="session")
def free_stop(folders):
    """velim_a1 without a bus: the tick calls the cycle of the unit."""
    return bench_process.run(folders / "free", "--pacing", "free")


@pytest.fixture(scope="session")
def wall_run(folders):
    """The first four seconds of velim_a1 in real time."""
    return bench_process.run(folders / "wall", "--pacing", "wall", "--set", "duration_max_s=4")


@pytest.fixture(scope="session")
def free_run_of(folders):
    """A function that returns the folder of a free run of a scenario, with every tick, and what the
    command has printed.
    """

    @functools.cache
    def run(scenario):
        folder = folders / "of_vehicles" / Path(scenario).stem
        words = ("run", scenario, "--pacing", "free", "--set", "loop.record_hz=1000")
        done = program.rollerrig(*words, "--out", folder)
        assert done.status == 0, done.messages
        return folder, done.printed

    return run
