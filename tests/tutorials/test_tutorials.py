"""Every tutorial is done as it stands: its files are written, its commands run, in the order of the
page.
"""

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

PAGES = ("tutorial_unit.md", "tutorial_ci.md", "tutorial_data.md", "tutorial_modbus.md")
# a block of indented lines, and the paragraph before it
BLOCK = re.compile(
    r"^(?P<before>\S[^\n]*)\n\n(?P<block>(?: {4}[^\n]*\n|\n(?= {4}))+)", re.MULTILINE
)
# where several tests run at a time: any free port, and Modbus at one of the test's own where the
# page has it
ALONE = "--set bus.interface=hub --set bus.socketcand_port=0 --set modbus."


@pytest.mark.parametrize("page", PAGES)
def test_a_tutorial_does_what_it_says(page, docs, tmp_path):
    # a pytest of the page's is not ours, nor are its options
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")
    }
    environment["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    done = 0
    for found in BLOCK.finditer((docs / page).read_text().replace("5020", str(port))):
        text = re.sub(r"^ {4}", "", found["block"], flags=re.MULTILINE)
        if name := re.fullmatch(r"`([\w.]+)`:", found["before"]):
            (tmp_path / name[1]).write_text(text)
            continue
        modbus = f"port={port}" if "--start modbus" in text else "enabled=false"
        commands = re.sub(
            r"^( *rollerrig run .*?)( &)?$",
            rf"\1 {ALONE}{modbus}\2",
            text.replace("\\\n", " "),
            flags=re.MULTILINE,
        )
        told = subprocess.run(
            ["bash", "-e", "-c", commands],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert told.returncode == 0, commands + told.stdout + told.stderr
        done += 1
    assert done >= 3
