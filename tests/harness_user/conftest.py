"""As in a repository of somebody else: one line gives the tests their benches."""

from rollerrig.wsp_interface.harness import rollerrig_bench  # noqa: F401
