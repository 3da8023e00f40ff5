"""Output without a reader changes neither a run nor an exit status."""

import json
import os
import subprocess
import sys

import pytest

from rollerrig.realtime import cli
from rollerrig.realtime.campaign import campaign

RUN = (sys.executable, "-m", "rollerrig.realtime.cli")
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
FAILING = """title = "a limit that no stop can meet"
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
CAMPAIGN = """scenario = "dry_stop"
unit = "none"
chunk = 1
[vary]
"adhesion.mu_cd" = [0.08, {friction}, 0.06]
initial_speed_m_s = [3.0]
"""


def without_reader(*command, **streams):
    """Run a command whose streams that are None are pipes without a reader; its exit status."""
    read, write = os.pipe()
    os.close(read)
    connected = {name: write if stream is None else stream for name, stream in streams.items()}
    try:
        return subprocess.run(command, **connected, timeout=300).returncode
    finally:
        os.close(write)


@pytest.fixture
def failing(tmp_path):
    path = tmp_path / "failing.toml"
    path.write_text(FAILING)
    return str(path)


def test_a_failed_sequence_is_failed_whoever_reads_its_output(failing, tmp_path):
    words = (*RUN, "sequence", failing, "--wsp", "none", "--out", str(tmp_path / "report"))
    assert cli.main([*words[len(RUN) : -1], str(tmp_path / "read")]) == 1
    assert without_reader(*words, stdout=None, stderr=subprocess.DEVNULL) == 1


def test_a_run_is_whole_when_nobody_reads_its_progress(tmp_path):
    out = tmp_path / "run"
    assert without_reader(*RUN, *STOP, "--out", str(out), stdout=None, stderr=None) == 0
    assert json.loads((out / "summary.json").read_text())["stopped"]


@pytest.mark.parametrize(("friction", "status", "workers"), [(0.05, 0, 2), (7.0, 1, 1)])
def test_a_campaign_is_finished_and_keeps_its_status_whoever_reads_its_output(
    friction, status, workers, tmp_path
):
    (tmp_path / "plan.toml").write_text(CAMPAIGN.format(friction=friction))
    words = (*RUN, "campaign", str(tmp_path / "plan.toml"), "--workers", str(workers), "--out")
    assert without_reader(*words, str(tmp_path / "out"), stdout=None, stderr=None) == status
    assert len(campaign.result(tmp_path / "out")) == 3
    assert (tmp_path / "out" / "report.html").stat().st_size > 1000


@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-", "<&-", "<&- >&- 2>&-"])
def test_a_run_needs_no_standard_stream(closed, tmp_path):
    out = tmp_path / "run"
    done = subprocess.run(
        ["sh", "-c", f'exec "$@" {closed}', "sh", *RUN, *STOP, "--out", str(out)],
        capture_output=True,
        timeout=300,
    )
    assert done.returncode == 0
    assert json.loads((out / "summary.json").read_text())["stopped"]
    assert b"Traceback" not in done.stderr


def test_json_stands_alone_on_standard_output_when_standard_error_is_closed(tmp_path):
    done = subprocess.run(
        ["sh", "-c", 'exec "$@" 2>&-', "sh", *RUN, *STOP, "--json", "--out", str(tmp_path / "run")],
        capture_output=True,
        timeout=300,
    )
    assert json.loads(done.stdout)["stopped"]
