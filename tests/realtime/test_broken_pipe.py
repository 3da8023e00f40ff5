"""Output without a reader changes neither a run nor an exit status.

The output of a command has no reader if it is a pipe whose other end is closed, as in
`rollerrig run dry_stop | head -1`, or if its standard streams are closed.
"""

import json
import os
import subprocess
import sys

import pytest
from program import CLI, Program

from rollerrig.realtime import cli
from rollerrig.realtime.campaign import campaign

ROLLERRIG = (sys.executable, *CLI)
# a short run
STOP = (
    "run",
    "dry_stop",
    "--wsp",
    "none",
    "--pacing",
    "free",
    "--set",
    "initial_speed_m_s=3",
    "--set",
    "duration_max_s=20",
)
FAILING_SEQUENCE = """title = "a limit that no stop can meet"
[start]
speed = "10 km/h"
[[step]]
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 0.1 km/h"
[[measure]]
measure = "stop_distance"
unit = "m"
max = 0.001
source = "assumption"
"""
# three runs; the first friction is filled in by the test
CAMPAIGN = """scenario = "dry_stop"
unit = "none"
chunk = 1
[vary]
"adhesion.mu_cd" = [0.08, {friction}, 0.06]
initial_speed_m_s = [3.0]
"""


def status_without_reader(*arguments, ignore_stderr=False):
    """Return the exit status of a rollerrig command whose output is a pipe without a reader.

    `ignore_stderr`: only standard output is this pipe, and standard error is discarded.
    """
    read_end, write_end = os.pipe()
    os.close(read_end)
    with (
        open(os.devnull) as nothing,
        open(os.devnull, "wb") as discarded,
        open(write_end, "wb") as unread,
    ):
        stderr = discarded if ignore_stderr else unread
        return Program((*CLI, *arguments), (nothing, unread, stderr)).wait(300)


def run_in_shell(*arguments, closed):
    """Run a rollerrig command with standard streams closed by a redirection, for example "2>&-"."""
    return subprocess.run(
        ["sh", "-c", f'exec "$@" {closed}', "sh", *ROLLERRIG, *arguments],
        capture_output=True,
        timeout=300,
    )


@pytest.fixture
def failing_sequence(tmp_path):
    path = tmp_path / "failing.toml"
    path.write_text(FAILING_SEQUENCE)
    return str(path)


@pytest.mark.nightly
def test_a_failed_sequence_exits_with_1_with_and_without_a_reader(failing_sequence, tmp_path):
    command = ("sequence", failing_sequence, "--wsp", "none", "--out")
    with_reader = str(tmp_path / "read")
    without_reader = str(tmp_path / "report")
    assert cli.main([*command, with_reader]) == 1
    assert status_without_reader(*command, without_reader, ignore_stderr=True) == 1


def test_a_run_is_complete_when_nobody_reads_its_progress(tmp_path):
    out = tmp_path / "run"
    assert status_without_reader(*STOP, "--out", str(out)) == 0
    assert json.loads((out / "summary.json").read_text())["stopped"]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("friction", "status", "workers"),
    [
        pytest.param(0.05, 0, 2, marks=pytest.mark.nightly),
        # this friction is out of bounds, so one of the three runs fails
        (7.0, 1, 1),
    ],
)
def test_a_campaign_without_a_reader_finishes_with_its_usual_exit_status(
    friction, status, workers, tmp_path
):
    plan = tmp_path / "plan.toml"
    plan.write_text(CAMPAIGN.format(friction=friction))
    out = tmp_path / "out"
    command = ("campaign", str(plan), "--workers", str(workers), "--out", str(out))
    assert status_without_reader(*command) == status
    assert len(campaign.result(out)) == 3
    assert (out / "report.html").stat().st_size > 1000


# standard input is 0 ("<&-" closes it), output 1 (">&-"), error 2 ("2>&-")
@pytest.mark.parametrize(
    "closed",
    [
        pytest.param("2>&-", marks=pytest.mark.nightly),
        pytest.param(">&- 2>&-", marks=pytest.mark.nightly),
        pytest.param("<&-", marks=pytest.mark.nightly),
        "<&- >&- 2>&-",
    ],
)
def test_a_run_needs_no_standard_stream(closed, tmp_path):
    out = tmp_path / "run"
    done = run_in_shell(*STOP, "--out", str(out), closed=closed)
    assert done.returncode == 0
    assert json.loads((out / "summary.json").read_text())["stopped"]
    assert b"Traceback" not in done.stderr


def test_standard_output_holds_only_json_when_standard_error_is_closed(tmp_path):
    done = run_in_shell(*STOP, "--json", "--out", str(tmp_path / "run"), closed="2>&-")
    assert json.loads(done.stdout)["stopped"]
