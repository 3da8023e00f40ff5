"""The suite relies on this behaviour of the tools that run it."""

import os

import pytest


@pytest.mark.skipif("PYTEST_XDIST_WORKER" not in os.environ, reason="one process runs all tests")
def test_one_worker_runs_all_tests_of_a_file(request):
    # otherwise several workers would make the fixtures of a file
    assert request.node.nodeid.endswith("@tests/test_suite.py")
