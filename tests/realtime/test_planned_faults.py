"""A planned fault that never begins is reported by runs, sequences and campaigns."""

import json
from pathlib import Path

import bench_process
import pytest
import short_campaign

from rollerrig.realtime import cli
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code

# a short stop, as words of the command line
SHORT = ("--wsp", "none", "--pacing", "free", "--set", "initial_speed_m_s=3")
NEVER = "never began: it was planned for 500 s, and the run did not last so long"

SEQUENCE = """title = "A stop from walking pace with a late fault"
criteria = "none"
[start]
speed = "9 km/h"
adhesion = "dry"
[[step]]
set = { brake_demand = "3.8 bar" }
fault = ["speed_sensor_stuck axle=2 at=500", "cylinder_leak axle=1 at=0.5"]
until = "vehicle_speed < 0.01 m/s"
timeout = "20 s"
"""

SCENARIO = """initial_speed_m_s = 3.0
[[demand]]
pressure_Pa = 3.8e5
[[fault]]
kind = "speed_sensor_stuck"
axle = 2
at_s = 500.0
"""
PLAN = """scenario = "{scenario}"
[vary]
initial_speed_m_s = [2.0, 3.0]
"""


def test_a_run_warns_of_a_fault_that_never_began_and_its_summary_has_the_warning(tmp_path):
    bench = bench_process.run(
        tmp_path / "run",
        *SHORT,
        "--fault",
        "speed_sensor_stuck axle=2 at=500",
        "--fault",
        "cylinder_leak axle=1 at=0.5",
        scenario="dry_stop",
    )
    assert bench.status == 0, bench.stderr
    (event,) = bench.reported(Code.FAULT_NEVER_BEGAN)
    assert event.level == "warning"
    assert event.fields == {
        "fault": "speed_sensor_stuck axle=2",
        "kind": "speed_sensor_stuck",
        "at_s": 500.0,
    }
    summary = records.summary(bench.out)
    assert summary["valid"] is True
    (warning,) = summary["warnings"]
    assert f"fault speed_sensor_stuck axle=2 {NEVER}" in warning
    assert NEVER in bench.stderr
    # the other fault has begun
    assert bench.reported(Code.FAULT_BEGINS, kind="cylinder_leak")


@pytest.mark.nightly
def test_a_run_whose_faults_all_begin_has_no_warning(tmp_path):
    bench = bench_process.run(
        tmp_path / "run", *SHORT, "--fault", "cylinder_leak axle=1 at=0.5", scenario="dry_stop"
    )
    assert records.summary(bench.out)["warnings"] == []
    assert not bench.reported(Code.FAULT_NEVER_BEGAN)


def test_a_sequence_begins_a_fault_at_its_time_and_warns_of_one_that_never_began(tmp_path, capsys):
    path = tmp_path / "late.toml"
    path.write_text(SEQUENCE)
    out = tmp_path / "out"
    assert cli.main(["sequence", str(path), "--wsp", "none", "--out", str(out), "--json"]) == 0

    printed = json.loads(capsys.readouterr().out)
    (warning,) = printed["warnings"]
    assert warning.startswith(f"late: fault speed_sensor_stuck axle=2 {NEVER}")
    (in_report,) = json.loads((out / "report.json").read_text())["sequences"][0]["warnings"]
    assert NEVER in in_report
    assert NEVER in (out / "report.html").read_text()

    run = records.load(out / "late")
    assert NEVER in run.summary["warnings"][0]
    (begins,) = [event for event in run.events if event.code == Code.FAULT_BEGINS]
    assert begins.fields["kind"] == "cylinder_leak"
    assert begins.time_s == 0.5


@pytest.mark.nightly
def test_a_campaign_warns_once_of_a_fault_that_never_began_and_counts_its_runs(tmp_path, capsys):
    (tmp_path / "late.toml").write_text(SCENARIO)
    plan = tmp_path / "plan.toml"
    plan.write_text(PLAN.format(scenario=tmp_path / "late.toml"))
    out = tmp_path / "out"
    short_campaign.run_here(plan, out)
    assert cli.main(["campaign", str(plan), "--out", str(out), "--json"]) == 0

    printed = json.loads(capsys.readouterr().out)
    (warning,) = printed["warnings"]
    assert NEVER in warning
    assert "(2 of 2 runs)" in warning
    assert NEVER in Path(printed["report"]).read_text()
