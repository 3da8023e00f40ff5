"""A test follows every tutorial: it writes the files and runs the commands, in their order.

A fenced block after a command shows lines of its output. Each line must be in the output of that
command; "..." replaces any text.
"""

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

PAGES = (
    "tutorial_unit.md",
    "tutorial_judge.md",
    "tutorial_kwet.md",
    "tutorial_ci.md",
    "tutorial_data.md",
    "tutorial_modbus.md",
    "howto_compare.md",
    "howto_robot_ci.md",
)
# a block of indented lines, and the paragraph before it
BLOCK = re.compile(
    r"^(?P<before>\S[^\n]*)\n\n(?P<block>(?: {4}[^\n]*\n|\n(?= {4}))+)", re.MULTILINE
)
# a fenced block, which follows a block of commands
OUTPUT = re.compile(r"\n```text\n(?P<lines>.*?)```\n", re.DOTALL)
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
    whole = (docs / page).read_text().replace("5020", str(port))
    for found in BLOCK.finditer(whole):
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
        if shown := OUTPUT.match(whole, found.end()):
            is_in_output(shown["lines"], told.stdout + told.stderr)
        done += 1
    assert done >= 1


def is_in_output(lines: str, output: str):
    """Assert that each line is in the output of a command."""
    for line in lines.splitlines():
        pattern = re.escape(line.strip()).replace(r"\.\.\.", ".*")
        assert re.search(pattern, output), f"not in the output: {line}\n{output}"
