"""Options and marks of the whole suite, and how its tests are distributed over workers.

With `-n`, all tests of one file run in one worker, so that its kernels are compiled once and its
fixtures are made once. Tests that use the same recorded run also share a worker. Whole explanations
and tutorials are the longest tests: they start first, and each of them goes to the next free
worker.
"""

import os
import signal
from pathlib import Path

import pytest
from collected import ALL_ITEMS
from threadpoolctl import threadpool_limits

pytest_plugins = ["ending"]

# fixtures of tests/realtime/conftest.py
RUNS = {"stop_with_wsp", "stop_without_wsp", "stop_on_leaves", "free_stop", "wall_run"}

# characters; a longer text or longer bytes of a parameter are cut in the name of a test, which
# workers send to each other and keep
LONGEST_PARAMETER = 200
KEPT_OF_A_LONGER_ONE = 40

# groups of many files, which start first
LONGEST_GROUPS = ("vehicles", "runs")

# folders in the order in which workers start them: first those whose tests take long and wait as
# often as they compute
START_ORDER = (
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
        help="write the generated pages, from all collected tests; use it with --collect-only",
    )


def pytest_configure(config):
    # under nohup the processes that tests start would inherit that the signal is ignored
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

    # With its default order, xdist starts the groups with the fewest tests last. Those are the
    # whole explanations: one worker would compute the last of them while the others wait.
    config.option.loadscopereorder = False

    for mark in (
        "conformance(standard, behaviour): the row of the conformance table that this test proves",
        "explanation: explains whole sets of runs; it starts first, and stays on one core",
        "nightly: rates, whole searches, long endurance, other people's programs beyond one smoke "
        "test each; `make nightly` runs it, `make test` leaves it out",
        "xdist_group(name): tests that run in one worker; without it, those of a file do",
    ):
        config.addinivalue_line("markers", mark)


def pytest_make_parametrize_id(val):
    if isinstance(val, str | bytes) and len(val) > LONGEST_PARAMETER:
        return f"{val[:KEPT_OF_A_LONGER_ONE]!a}...{len(val)}"
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    config.stash[ALL_ITEMS] = list(items)
    for item in items:
        item.add_marker(pytest.mark.xdist_group(worker_group(item)), append=False)

    if config.getoption("numprocesses", None) or hasattr(config, "workerinput"):
        items.sort(key=start_rank)


def worker_group(item):
    """Return the name of the group of tests that one worker runs with this test."""
    file, _, test = item.nodeid.partition("::")
    if mark := item.get_closest_marker("xdist_group"):
        return mark.args[0]
    if RUNS & set(item.fixturenames):
        return "runs"
    if item.get_closest_marker("explanation") or file.startswith("tests/tutorials/"):
        return test
    return file


def start_rank(item):
    """Return when workers start a test, lowest first. Tests of equal rank keep their order."""
    if item.get_closest_marker("explanation"):
        return -2
    if worker_group(item) in LONGEST_GROUPS:
        return -1
    for rank, folder in enumerate(START_ORDER):
        if item.nodeid.startswith(folder):
            return rank
    return len(START_ORDER)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_logreport(report):
    # xdist appends the group to the name of a worker's test; without it --last-failed finds the
    # test
    if hasattr(report, "node"):
        report.nodeid = report.nodeid.rpartition("@")[0]


def pytest_collection_finish(session):
    if os.environ.get("PYTEST_XDIST_WORKER"):
        # Numerical libraries of several workers that each use all cores wait for one another, and a
        # test takes up to thirty times as long.
        threadpool_limits(1)
    if folder := session.config.getoption("--write-docs"):
        # it imports nearly everything
        from written_docs import write

        write(folder, session.config.stash[ALL_ITEMS])


@pytest.fixture(autouse=True)
def on_one_core(request):
    """Keep an explanation on one core if there are several workers.

    It then starts no processes.
    """
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
