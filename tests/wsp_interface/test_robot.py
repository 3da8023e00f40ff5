"""The library for Robot Framework, in a suite that Robot Framework runs."""

import subprocess
import sys
import xml.etree.ElementTree as ET

import pytest

SUITE = """*** Settings ***
Library          rollerrig.wsp_interface.robot
Test Teardown    End Bench

*** Test Cases ***
The brakes hold the train
    Start Bench    speed=36 km/h    adhesion=soap
    Brake    3.8 bar
    Wait Until    every cylinder_pressure > 1 bar    timeout=5 s
    Adhesion    soap    axle=1
    Inject    speed_sensor_stuck    axle=2    for=1
    Note    the driver looks out
    Wait Until Speed Below    30 km/h
    Lift    speed_sensor_stuck    axle=2
    Let Pass    0.2 s
    Should Hold    vehicle_speed < 30 km/h
    Wait Until Standstill    60 s
    Longest Lock Should Be Below    0.4 s
    Distance Should Be Below    200 m

A wheel locks
    Start Bench    speed=50 km/h    wsp=none    adhesion=leaf_film
    Adhesion    0.02
    Brake    3.8 bar
    Let Pass    5 s
    Run Keyword And Expect Error    *longest_lock * s, wanted at most 0.4 s*    Limits Should Be Kept
    Longest Lock Should Be Below    0.4 s

A wrong unit
    Run Keyword And Expect Error    *no bench runs: begin with the keyword 'Start Bench'    Brake    1 bar
    Start Bench    speed=9 km/h
    Brake    3.8 m
"""


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """The folder of the suite, and (status, message) of each test by name."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "suite.robot").write_text(SUITE)
    done = subprocess.run(
        [sys.executable, "-m", "robot", "--outputdir", folder, folder / "suite.robot"],
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode == 2, done.stdout + done.stderr
    results = {}
    for test in ET.parse(folder / "output.xml").getroot().iter("test"):
        status = test.find("status")
        results[test.get("name")] = (status.get("status"), status.text or "")
    return folder, results


def test_a_suite_of_keywords_brakes_the_train(played):
    _, results = played
    assert results["The brakes hold the train"] == ("PASS", "")


def test_a_failed_test_shows_the_figure_with_its_limit(played):
    _, results = played
    status, message = results["A wheel locks"]
    assert status == "FAIL"
    assert message.startswith("longest lock ")
    assert message.endswith(" s, wanted below 0.4 s")


def test_a_wrong_unit_is_refused_and_the_message_lists_the_right_ones(played):
    _, results = played
    status, message = results["A wrong unit"]
    assert status == "FAIL"
    assert (
        "the unit 'm' does not belong here; write a number with its unit ('Pa', 'kPa', 'mbar', 'bar')"
        in message
    )


def test_the_log_has_the_plot_of_each_run_and_where_its_record_is(played):
    folder, _ = played
    output = (folder / "output.xml").read_text()
    runs = sorted((folder / "rollerrig").iterdir())
    assert [run.name for run in runs] == [
        "A_wheel_locks-1",
        "A_wrong_unit-1",
        "The_brakes_hold_the_train-1",
    ]
    for run in runs[::2]:
        assert f"run: {run}" in output
        assert (run / "stop.svg").read_text().startswith("<svg")
        assert (run / "channels.parquet").is_file()
    assert output.count("&lt;svg") >= 2
