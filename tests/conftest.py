"""Options and marks of the whole suite, and which of its tests a worker keeps together.

With `-n` each file is one worker's, so that its kernels are compiled and its fixtures made once; runs
that several files look at are one worker's too; whole explanations, the longest tests, come first and
each goes to the next worker that is free; so does each tutorial.
"""

import os
import signal
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits
from written_docs import ALL_ITEMS, write

# fixtures of tests/realtime/conftest.py
RUNS = {"stop_with_wsp", "stop_without_wsp", "stop_on_leaves", "free_stop", "wall_run"}
# after the explanations: what takes long, and waits as often as it computes
LONG = (
    "tests/tutorials/",
    "tests/realtime/",
    "tests/rig/identify/",
    "tests/third_party/",
    "tests/wsp_interface/",
    "tests/firmware_sim/",
)


def pytest_addoption(parser):
    parser.addoption(
        "--write-docs",
        metavar="FOLDER",
        type=Path,
        help="write the pages that are made, from all "
        "tests that are collected; with --collect-only",
    )


def pytest_configure(config):
    # started under nohup the tests' own processes would ignore it, too
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    # else xdist lets what has the fewest tests come last: whole explanations, with one worker waiting for the other
    config.option.loadscopereorder = False
    config.addinivalue_line(
        "markers",
        "conformance(standard, behaviour): what of a standard this "
        "test holds, for the table of conformance",
    )
    config.addinivalue_line(
        "markers", "explanation: explains whole sets of runs; `make check` leaves these out"
    )
    config.addinivalue_line("markers", "xdist_group(name): tests of one worker")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    config.stash[ALL_ITEMS] = list(items)  # before any is left out
    for item in items:
        file, _, test = item.nodeid.partition("::")
        alone = item.get_closest_marker("explanation") or file.startswith("tests/tutorials/")
        item.add_marker(
            pytest.mark.xdist_group(
                "runs" if RUNS & set(item.fixturenames) else test if alone else file
            )
        )
    if config.getoption("numprocesses", None) or hasattr(config, "workerinput"):
        items.sort(key=turn)


def turn(item):
    """When a test has its turn among workers; equal ones keep their order."""
    if item.get_closest_marker("explanation"):
        return -1
    return next((n for n, folder in enumerate(LONG) if item.nodeid.startswith(folder)), len(LONG))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_logreport(report):
    if hasattr(
        report, "node"
    ):  # a worker's; without the group that xdist appends, --last-failed finds it again
        report.nodeid = report.nodeid.rpartition("@")[0]


def pytest_collection_finish(session):
    if os.environ.get("PYTEST_XDIST_WORKER"):
        # several workers whose libraries each take all cores wait for one another, up to thirty times as long
        threadpool_limits(1)
    if folder := session.config.getoption("--write-docs"):
        write(folder, session.config.stash[ALL_ITEMS])


@pytest.fixture(autouse=True)
def on_one_core(request):
    """Keep an explanation to one core where tests run on several: it starts no processes of its own there."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    if not worker or not request.node.get_closest_marker("explanation"):
        yield
        return
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})
    yield
    os.sched_setaffinity(0, cores)


@pytest.fixture(scope="session")
def docs():
    """The folder of the documentation."""
    return Path(__file__).parent.parent / "docs"
