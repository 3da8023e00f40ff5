"""A conftest.py as in another repository: one line gives the tests their benches."""

from rollerrig.wsp_interface.harness import rollerrig_bench  # noqa: F401
