"""What the suite takes for granted of the tools that run it."""

import os

import pytest


@pytest.mark.skipif("PYTEST_XDIST_WORKER" not in os.environ, reason="one process runs all tests")
def test_the_tests_of_a_file_are_one_workers(request):
    # else what a file makes once would be made by each of its workers
    assert request.node.nodeid.endswith("@tests/test_suite.py")
