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

from rollerrig.firmware_sim.faults import catalogue
from rollerrig.wsp_interface.sequences import play, sequence
from rollerrig.wsp_interface.sequences.verdict import Result

PAGES = (
    "tutorial_unit.md",
    "tutorial_judge.md",
    "tutorial_kwet.md",
    "tutorial_ci.md",
    "tutorial_data.md",
    "tutorial_modbus.md",
    "howto_compare.md",
    "howto_sequence.md",
    "howto_campaign.md",
    "howto_kdry.md",
    "howto_brake_calculation.md",
    "howto_robot_ci.md",
)
# commands of the README that are not run here, and why
NOT_RUN = {
    "make demo": "installs the package; its command is run by other tests",
    "make test": "runs tests, as this one",
    ". .venv/bin/activate": "the tests have the installation on their path",
    "rollerrig run velim_a1 --live": "opens a window",
    "rollerrig desk": "serves until it is stopped",
    "rollerrig check": "its status is that of the machine",
    "rollerrig programme": "takes many minutes; tests/wsp_interface/test_programme.py plays one",
    "rollerrig explain open_rail_cleaning": "tests/rig/identify/test_explain.py explains this set",
    "rollerrig explain runs/a": "needs recordings of the reader",
}
# a block of indented lines, and the paragraph before it
BLOCK = re.compile(
    r"^(?P<before>\S[^\n]*)\n\n(?P<block>(?: {4}[^\n]*\n|\n(?= {4}))+)", re.MULTILINE
)
# a fenced block, which follows a block of commands
OUTPUT = re.compile(r"\n```text\n(?P<lines>.*?)```\n", re.DOTALL)
# where several tests run at a time: any free port, and Modbus at one of the test's own where the
# page has it
ALONE = "--set bus.interface=hub --set bus.socketcand_port=0 --set modbus."


@pytest.mark.nightly
@pytest.mark.parametrize("page", PAGES)
def test_a_tutorial_does_what_it_says(page, docs, tmp_path):
    port = free_port()
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
        output = output_of(commands, tmp_path)
        if shown := OUTPUT.match(whole, found.end()):
            is_in_output(shown["lines"], output)
        done += 1
    assert done >= 1


@pytest.mark.parametrize("page", ["tutorial_unit.md", "tutorial_ci.md", "howto_sequence.md"])
def test_the_sequence_of_a_page_fails_without_a_wsp(page, docs, tmp_path):
    """A limit that a train without a WSP meets says nothing of the reader's unit."""
    for found in BLOCK.finditer((docs / page).read_text()):
        if name := re.fullmatch(r"`(\w+\.toml)`:", found["before"]):
            text = re.sub(r"^ {4}", "", found["block"], flags=re.MULTILINE)
            (tmp_path / name[1]).write_text(text)
            break
    stop = sequence.load(tmp_path / name[1], catalogue.parse)
    outcome = play.on_own_bench(stop, tmp_path / "run", wsp="none")
    assert outcome.result is Result.FAIL
    results = {verdict.measure: verdict.result for verdict in outcome.verdicts}
    assert results["longest_lock"] is Result.FAIL


def free_port():
    """Return a port of this machine that no program listens on."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def environment():
    """Return the environment of a reader who has activated this installation."""
    # a pytest of a page is not this one, nor are its options
    variables = {
        name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")
    }
    variables["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return variables


@pytest.mark.nightly
def test_every_command_of_the_readme_runs_here_or_has_a_reason(docs, tmp_path):
    (tmp_path / "docs").symlink_to(docs)
    readme = (docs.parent / "README.md").read_text(encoding="utf-8")
    # a bus of this test, which other tests do not find
    port = free_port()
    alone = f"--set bus.interface=hub --set bus.socketcand_port={port} --set modbus.enabled=false"
    readme = readme.replace("--wsp external", f"--wsp external {alone}")
    readme = readme.replace("wsp_unit.py\n", f"wsp_unit.py 127.0.0.1 {port}\n")
    left_out = set()
    run = 0
    for found in BLOCK.finditer(readme):
        lines = []
        for line in found["block"].splitlines():
            command = line.partition("#")[0].strip()
            begins = [begin for begin in NOT_RUN if command.startswith(begin)]
            if begins:
                left_out.update(begins)
            else:
                lines.append(command)
        if not "".join(lines):
            continue
        script = "\n".join(lines)
        output_of(script, tmp_path)
        run += 1
    assert run >= 2
    # no reason is left of a command that the page no longer has
    assert left_out == set(NOT_RUN)


def output_of(commands: str, folder: Path) -> str:
    """Return what commands of a shell print in a folder; the first that fails is an error."""
    result = subprocess.run(
        ["bash", "-e", "-c", commands],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    output = result.stdout + result.stderr
    assert result.returncode == 0, commands + output
    return output


def is_in_output(lines: str, output: str):
    """Assert that each line is in the output of a command, which may be wrapped elsewhere."""
    unwrapped = " ".join(output.split())
    for line in lines.splitlines():
        pattern = re.escape(" ".join(line.split())).replace(r"\.\.\.", ".*")
        assert re.search(pattern, unwrapped), f"not in the output: {line}\n{output}"
