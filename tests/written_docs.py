"""Pages of docs/ that are written, not typed: `make docs` writes them, test_written_docs.py compares.

A test says which behaviour of a standard it holds with `@pytest.mark.conformance("CiA 301", "SDO block
download")`, more than once if it holds more than one; that is the table of conformance.
"""

import pytest

from rollerrig.firmware_sim.faults import catalogue

STANDARDS = ("CAN", "Hub", "CiA 301", "CiA 305", "CiA 402", "CiA 406", "CiA 401", "Rig control", "Modbus",
             "Faults", "Bad input", "Masters")
ALL_ITEMS = pytest.StashKey[list[pytest.Item]]()


def write(folder, items):
    """Write the pages into a folder; `items`: all tests."""
    (folder / "faults.md").write_text(catalogue.markdown(), encoding="utf-8")
    (folder / "conformance.md").write_text(conformance(items), encoding="utf-8")


def conformance(items):
    """The table of conformance of some tests, as Markdown."""
    rows = {standard: {} for standard in STANDARDS}
    for item in items:
        test = item.nodeid.partition("[")[0]
        for mark in reversed(list(item.iter_markers("conformance"))):
            standard, behaviour = mark.args
            assert standard in STANDARDS, f"{item.nodeid}: no standard is called {standard!r}"
            name, _, function = test.rpartition("::")
            rows[standard][f"| {behaviour} | `{name}` {function} |"] = None
    lines = ["# Conformance", "", "Written by `make docs`. Each behaviour is held by the test beside it."]
    for standard, mine in rows.items():
        lines += ["", f"## {standard}", "", "| behaviour | test |", "|---|---|", *mine] if mine else []
    return "\n".join(lines) + "\n"
