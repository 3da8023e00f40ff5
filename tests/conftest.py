"""The table of conformance: which behaviour of a standard is held by which test, and how it went.

A test says so with `@pytest.mark.conformance("CiA 301", "SDO block download")`, more than once if it
holds more than one; `pytest --conformance=docs/conformance.md` writes the table of that run.
"""

from collections import defaultdict
from pathlib import Path

import pytest

STANDARDS = ("CAN", "Hub", "CiA 301", "CiA 305", "CiA 402", "CiA 406", "CiA 401", "Rig control", "Modbus",
             "Faults", "Bad input", "Masters")
_RESULTS = pytest.StashKey[dict[str, set[str]]]()
_ROWS = pytest.StashKey[dict[tuple[str, str], dict[str, None]]]()
_WORST = ("failed", "error", "skipped", "passed")


def pytest_addoption(parser):
    parser.addoption("--conformance", metavar="FILE", help="write the table of conformance")


def pytest_configure(config):
    config.addinivalue_line("markers", "conformance(standard, behaviour): what of a standard this "
                            "test holds, for the table of conformance")
    config.stash[_RESULTS], config.stash[_ROWS] = defaultdict(set), defaultdict(dict)


def pytest_collection_modifyitems(config, items):
    for item in items:
        for mark in reversed(list(item.iter_markers("conformance"))):
            standard, behaviour = mark.args
            assert standard in STANDARDS, f"{item.nodeid}: no standard is called {standard!r}"
            config.stash[_ROWS][standard, behaviour][item.nodeid.partition("[")[0]] = None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if call.when == "call" or not report.passed:
        found = report.outcome if call.when == "call" or report.skipped else "error"
        item.config.stash[_RESULTS][item.nodeid.partition("[")[0]].add(found)
    return report


def pytest_sessionfinish(session):
    path = session.config.getoption("--conformance")
    if path:
        rows, results = session.config.stash[_ROWS], session.config.stash[_RESULTS]
        Path(path).write_text(table(rows, results), encoding="utf-8")


def table(rows, results):
    """The table as Markdown; `rows` tests by (standard, behaviour), `results` outcomes by test."""
    lines = ["# Conformance", "", "Written by a run of the tests: `.venv/bin/python -m pytest -m conformance "
             "--conformance=docs/conformance.md`. Each behaviour is held by the tests beside it.", ""]
    for standard in STANDARDS:
        mine = [(behaviour, tests) for (one, behaviour), tests in rows.items() if one == standard]
        if not mine:
            continue
        lines += [f"## {standard}", "", "| behaviour | test | result |", "|---|---|---|"]
        for behaviour, tests in mine:
            for test in tests:
                name, _, function = test.rpartition("::")
                outcome = next((one for one in _WORST if one in results.get(test, ())), "not run")
                lines.append(f"| {behaviour} | `{name}` {function} | {outcome} |")
        lines.append("")
    return "\n".join(lines).rstrip("\n") + "\n"
