"""The library for Robot Framework, in a suite that Robot Framework runs."""

import html
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "docs/examples/wsp_unit.py"

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
    Run Keyword And Expect Error    *the unit 'm' does not belong here*    Brake    3.8 m
    Let Pass    5 s
    Run Keyword And Expect Error    *longest_lock * s, wanted at most 0.4 s*    Limits Should Be Kept
    Longest Lock Should Be Below    0.4 s

Without a bench
    Brake    1 bar
"""


SHORT = """*** Settings ***
Library          rollerrig.wsp_interface.robot
Test Teardown    End Bench

*** Test Cases ***
A wheel locks
    Run Keyword And Expect Error    *begin with the keyword 'Start Bench'    Brake    1 bar
    Start Bench    speed=50 km/h    wsp=none    adhesion=leaf_film
    Run Keyword And Expect Error    *the unit 'm' does not belong here*    Brake    3.8 m
    Brake    3.8 bar
    Wait Until Speed Below    42 km/h
    Run Keyword And Expect Error    *longest_lock * s, wanted at most 0.4 s*    Limits Should Be Kept
"""
SHARED = """*** Settings ***
Library           rollerrig.wsp_interface.robot
Suite Setup       Start Bench    speed=36 km/h    adhesion=soap    unit={unit}
Suite Teardown    End Bench

*** Test Cases ***
The train brakes
    Brake    3.8 bar
    Let Pass    1 s

It is the same train
    Wait Until Speed Below    34 km/h    timeout=10 s

A misspelled fault
    Inject    speed_sensor_stuk    axle=2

A misspelled fault that is lifted
    Lift    Speed_Sensor_Stuck

A misspelled signal
    Wait Until    every cylinder_presure > 1 bar

A wait that ends
    Wait Until    every cylinder_pressure > 9 bar    timeout=0.2 s

A test with its own train
    Start Bench    speed=9 km/h    adhesion=dry
    Brake    1 bar

The train of the suite is gone
    Brake    1 bar
"""


def results_of(folder, expected_status):
    """Run suite.robot in a folder; return (status, message) of each test by its name."""
    done = subprocess.run(
        [sys.executable, "-m", "robot", "--outputdir", folder, folder / "suite.robot"],
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode == expected_status, done.stdout + done.stderr
    results = {}
    for test in ET.parse(folder / "output.xml").getroot().iter("test"):
        status = test.find("status")
        results[test.get("name")] = (status.get("status"), status.text or "")
    return results


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """The results of SHARED, whose bench is started by its Suite Setup with a unit of the user."""
    folder = tmp_path_factory.mktemp("shared")
    unit = f"{sys.executable} {EXAMPLE} {{host}} {{port}}"
    (folder / "suite.robot").write_text(SHARED.format(unit=unit))
    results = results_of(folder, 5)
    return folder, results


@pytest.mark.nightly
def test_a_bench_of_a_suite_setup_is_there_for_all_tests_of_the_suite(shared):
    folder, results = shared
    assert results["The train brakes"] == ("PASS", "")
    assert results["It is the same train"] == ("PASS", "")
    assert results["A test with its own train"] == ("PASS", "")
    status, message = results["The train of the suite is gone"]
    assert status == "FAIL"
    assert "no bench runs" in message
    assert sorted(run.name for run in (folder / "rollerrig").iterdir()) == [
        "A_test_with_its_own_train-1",
        "Suite-1",
    ]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("test", "parts"),
    [
        (
            "A misspelled fault",
            ("kind = 'speed_sensor_stuk' is not a fault; did you mean 'speed_sensor_stuck'?",),
        ),
        ("A misspelled fault that is lifted", ("did you mean 'speed_sensor_stuck'?", "node_off")),
        ("A misspelled signal", ("did you mean 'cylinder_pressure'?", "vehicle_speed")),
        (
            "A wait that ends",
            ("'every cylinder_pressure > 9 bar' has not come true in 0.2 s; last values: ", " bar"),
        ),
    ],
)
def test_a_wrong_name_and_a_time_out_say_what_helps(test, parts, shared):
    _, results = shared
    status, message = results[test]
    assert status == "FAIL"
    assert "abort" not in message
    for part in parts:
        assert part in message


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """The folder of the suite, and (status, message) of each test by name."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "suite.robot").write_text(SUITE)
    return folder, results_of(folder, 2)


def test_keywords_brake_the_train_and_judge_it(tmp_path):
    (tmp_path / "suite.robot").write_text(SHORT)
    assert results_of(tmp_path, 0) == {"A wheel locks": ("PASS", "")}


@pytest.mark.nightly
def test_a_suite_of_keywords_brakes_the_train(played):
    _, results = played
    assert results["The brakes hold the train"] == ("PASS", "")


@pytest.mark.nightly
def test_a_failed_test_shows_the_figure_with_its_limit(played):
    _, results = played
    status, message = results["A wheel locks"]
    assert status == "FAIL"
    assert message.startswith("longest lock ")
    assert message.endswith(" s, wanted below 0.4 s")


@pytest.mark.nightly
def test_a_wrong_unit_is_refused_and_the_message_lists_the_right_ones(played):
    folder, _ = played
    assert (
        "the unit 'm' does not belong here; write a number with its unit ('Pa', 'kPa', 'mbar', 'bar')"
        in html.unescape((folder / "output.xml").read_text())
    )


@pytest.mark.nightly
def test_a_keyword_without_a_bench_names_the_keyword_that_starts_one(played):
    _, results = played
    status, message = results["Without a bench"]
    assert status == "FAIL"
    assert message.endswith("no bench runs: begin with the keyword 'Start Bench'")


@pytest.mark.nightly
def test_the_log_has_the_plot_of_each_run_and_where_its_record_is(played):
    folder, _ = played
    output = (folder / "output.xml").read_text()
    runs = sorted((folder / "rollerrig").iterdir())
    assert [run.name for run in runs] == [
        "A_wheel_locks-1",
        "The_brakes_hold_the_train-1",
    ]
    for run in runs:
        assert f"run: {run}" in output
        assert (run / "stop.svg").read_text().startswith("<svg")
        assert (run / "channels.parquet").is_file()
    assert output.count("&lt;svg") >= 2
