"""A sequence on a running bench: its report states what that bench plays, or nothing is judged."""

import json
import shlex
from html import escape

import pytest
from bench_process import BenchProcess

from rollerrig.realtime import cli
from rollerrig.wsp_interface import harness_client
from rollerrig.wsp_interface.sequences import running_bench
from rollerrig.wsp_interface.sequences import sequence as sequence_file

SEQUENCE = """title = "A stop from walking pace on low adhesion"
criteria = "none"
[start]
speed = "9 km/h"
adhesion = "low"
[[step]]
title = "the train rolls"
for = "1 s"
expect = "every cylinder_pressure < 0.1 bar"
[[step]]
title = "the driver brakes"
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 0.01 m/s"
timeout = "30 s"
[[measure]]
measure = "stop_distance"
unit = "m"
max = 100
source = "assumption"
"""


def bench(folder, *settings, pacing="lockstep"):
    """A bench of velim_a1, whose programme brakes from 0 s on, that waits for a harness."""
    arguments = ["--pacing", pacing, "--harness", "--set", "stand_s=60"]
    for setting in ("initial_speed_m_s=2.5", *settings):
        arguments += ["--set", setting]
    return BenchProcess(folder, *arguments)


def play(tmp_path, address):
    """Play the sequence; return exit status, its data in the report, and the page."""
    path = tmp_path / "slow.toml"
    path.write_text(SEQUENCE)
    out = tmp_path / "report"
    status = cli.main(["sequence", str(path), "--bus", address, "--out", str(out)])
    (sequence,) = json.loads((out / "report.json").read_text())["sequences"]
    return status, sequence, (out / "report.html").read_text()


def end(running):
    running.process.kill()
    running.process.wait(60.0)


def test_a_bench_with_other_adhesion_than_the_sequence_starts_from_is_refused(tmp_path):
    running = bench(tmp_path / "run")  # soap
    try:
        status, sequence, page = play(tmp_path, running.address())
    finally:
        end(running)
    assert status == 1
    assert sequence["result"] == "error"
    assert (
        "the bench does not have the [start] of the sequence: the adhesion is soap instead of low; "
        "adhesion.initial_adhesion is 0 instead of 0.065"
    ) in sequence["error"]
    command = "rollerrig run velim_a1 --harness --set initial_speed_m_s=2.5 --set adhesion=low"
    assert command in sequence["error"]
    # the page states no conditions of a run that was not played
    assert "t in all" not in page
    assert sequence["figures"] == {}


@pytest.mark.nightly
def test_the_report_of_a_running_bench_has_the_load_and_adhesion_of_that_bench(tmp_path):
    running = bench(tmp_path / "run", "adhesion=low", "vehicle.mass_kg=30000")
    try:
        status, sequence, page = play(tmp_path, running.address())
    finally:
        end(running)
    assert status == 0, sequence
    # the programme of the bench has not braked while the train was to roll
    assert [line["result"] for line in sequence["verdicts"]] == ["pass"] * 3
    assert "30 t in all" in page
    assert "43 t in all" not in page
    (warning,) = sequence["warnings"]
    assert "vehicle.mass_kg is 30000 instead of 43000" in warning
    assert escape(warning) in page
    written = (tmp_path / "report" / "slow" / "scenario.toml").read_text()
    assert "mass_kg = 30000" in written
    assert running.record.scenario["vehicle"]["mass_kg"] == 30000
    assert len(sequence["config_hash"]) == 16


def test_friction_that_an_earlier_harness_has_set_is_not_reported_as_that_of_the_sequence(tmp_path):
    running = bench(tmp_path / "run", "adhesion=low", pacing="wall")
    try:
        address = running.address()
        with harness_client.connect(address) as earlier:
            earlier.brake(0.0)
            earlier.friction(0.2, (2, 3))
        status, sequence, _ = play(tmp_path, address)
        assert status == 1
        assert "an earlier harness has set the friction under axle 2, 3" in sequence["error"]

        with harness_client.connect(address) as earlier:
            earlier.friction(0.0)
            earlier.wait(0.6)
        status, sequence, page = play(tmp_path, address)
    finally:
        end(running)
    assert status == 0, sequence
    (warning,) = sequence["warnings"]
    assert "before the sequence began. Not known: the faults that were injected" in warning
    assert escape(warning) in page
    # what the bench plays; it judges the run in its record
    assert sequence["unit_played"]["kind"] == "reference"
    assert sequence["vehicle"] == "uic_z1"
    assert "reference WSP of rollerrig (simulated)" in page


def test_the_command_that_starts_a_bench_runs_nothing_of_a_sequence_in_a_shell(tmp_path):
    path = tmp_path / "slow.toml"
    path.write_text(SEQUENCE.replace('"low"', '"$(touch x).toml"'))
    command = running_bench.start_command(sequence_file.load(path))
    assert "adhesion=$(touch x).toml" in shlex.split(command)
