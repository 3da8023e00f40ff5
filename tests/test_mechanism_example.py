"""The example of CONTRIBUTING.md, "Add a mechanism", is a mechanism that does not exist yet, and
works where the page says that it is pasted."""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from rollerrig.rig.mechanisms.table import BY_NAME

ROOT = Path(__file__).parent.parent
ROOMS = ("rig", "firmware_sim", "wsp_interface", "realtime", "configs")
FORMULAS = "rig/mechanisms/torque.py"
SEARCHES = "rig/identify/causes/table.py"
WORDS = "realtime/reports/hints/sizes.py"


def blocks():
    """Return the three blocks of the section: formula with row, search, words."""
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = page.partition("## Add a mechanism\n")[2].partition("\n## ")[0]
    found = re.findall(r"(?:^ {8}.*\n|^\n(?= {8}))+", section, re.MULTILINE)
    return [textwrap.dedent(block).strip("\n") for block in found]


def name():
    return re.search(r"^def (\w+)", blocks()[0], re.MULTILINE)[1]


def insert(text, before, pasted):
    """Return a text with pasted lines before the last line that is `before`."""
    at = text.rindex(f"\n{before}\n") + 1
    return text[:at] + pasted + "\n" + text[at:]


def paste_into(folder):
    """Write the rooms of the product with the example into a folder."""
    package = folder / "rollerrig"
    for room in ROOMS:
        shutil.copytree(ROOT / room, package / room, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "realtime" / "api" / "__init__.py", package / "__init__.py")

    formula, search, words = blocks()
    kernel, _, rows = formula.partition("ROWS = (\n")
    row = rows.partition("...\n")[2].rpartition("\n)")[0]
    path = package / FORMULAS
    text = path.read_text(encoding="utf-8")
    text = text.replace("\nROWS = (", f"\n{kernel}\nROWS = (")
    path.write_text(insert(text, ")", row), encoding="utf-8")
    for file, line, end in (
        (SEARCHES, search, '    Search("brake_gain", on_bogies=True),'),
        (WORDS, words, "}"),
    ):
        path = package / file
        text = path.read_text(encoding="utf-8")
        path.write_text(insert(text, end, textwrap.indent(line, "    ")), encoding="utf-8")


def test_the_example_does_not_exist_yet():
    assert name() not in BY_NAME
    assert len(blocks()) == 3


@pytest.mark.nightly
def test_the_example_works_where_the_page_has_it_pasted(tmp_path):
    paste_into(tmp_path)
    variables = {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    distances_m = []
    for loss in (0.0, 0.4):
        command = [sys.executable, "-m", "rollerrig.realtime.cli", "run", "dry_stop", "--json"]
        command += ["--pacing", "free", "--set", f"mechanisms.{name()}_loss={loss}"]
        command += ["--out", str(tmp_path / f"run_{loss}")]
        done = subprocess.run(
            command, env=os.environ | variables, cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        distances_m.append(json.loads(done.stdout)["braking_distance_m"])
    assert distances_m[1] > 1.05 * distances_m[0]
