"""Options and marks of the whole suite."""

from pathlib import Path

import pytest
from written_docs import ALL_ITEMS, write


def pytest_addoption(parser):
    parser.addoption("--write-docs", metavar="FOLDER", type=Path, help="write the pages that are made, from all "
                     "tests that are collected; with --collect-only")


def pytest_configure(config):
    config.addinivalue_line("markers", "conformance(standard, behaviour): what of a standard this "
                            "test holds, for the table of conformance")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    config.stash[ALL_ITEMS] = list(items)  # before any is left out


def pytest_collection_finish(session):
    if folder := session.config.getoption("--write-docs"):
        write(folder, session.config.stash[ALL_ITEMS])


@pytest.fixture(scope="session")
def docs():
    """The folder of the documentation."""
    return Path(__file__).parent.parent / "docs"
