"""A WSP unit that is a program of the user, wherever a run gets its unit."""

import json
import shlex
import sys
from pathlib import Path

import pytest
from short_sequences import WALKING_PACE

import rollerrig
from rollerrig.configs.errors import BusError, ConfigError
from rollerrig.realtime import cli
from rollerrig.wsp_interface import harness, own_bench
from rollerrig.wsp_interface.harness import bench
from rollerrig.wsp_interface.sequences import play, sequence
from rollerrig.wsp_interface.sequences.verdict import Result

EXAMPLE = Path(__file__).parents[2] / "docs/examples/wsp_unit.py"
UNIT = f"{shlex.quote(sys.executable)} {shlex.quote(str(EXAMPLE))} {{host}} {{port}}"
SHORT = ("--pacing", "lockstep", "--set", "initial_speed_m_s=3", "--set", "adhesion=dry")


def run(capfd, out, unit, *more):
    """Run a short stop with a unit; return the exit status, the JSON result and the messages."""
    words = ["run", "velim_a1", *SHORT, "--unit", unit, "--out", str(out), "--json", *more]
    status = cli.main(words)
    printed = capfd.readouterr()
    return status, json.loads(printed.out), printed.err


def test_a_run_starts_the_unit_and_its_summary_names_the_command(tmp_path, capfd):
    status, result, _ = run(capfd, tmp_path / "run", UNIT)
    assert status == 0
    assert result["valid"]
    assert result["wsp"]["unit"] == f"command:{UNIT}"
    assert (tmp_path / "run/wsp.log").is_file()


def test_a_unit_that_exits_is_reported_with_its_last_lines(tmp_path, capfd):
    unit = "sh -c 'echo reading parameters; echo no such file: parameters.bin >&2; exit 3'"
    status, result, _ = run(capfd, tmp_path / "run", unit)
    assert status == 2
    assert "exited with status 3" in result["error"]
    assert "reading parameters | no such file: parameters.bin" in result["error"]
    assert "wsp.log" in result["error"]


@pytest.mark.nightly
def test_a_unit_that_does_not_exist_is_reported_with_its_name(tmp_path, capfd):
    status, result, _ = run(capfd, tmp_path / "run", "./no_such_unit {port}")
    assert status == 2
    assert "./no_such_unit: No such file or directory" in result["error"]


def test_a_unit_that_never_answers_is_reported_with_its_last_lines(tmp_path, capfd):
    unit = "sh -c 'echo waiting for a licence; sleep 1000'"
    status, result, _ = run(capfd, tmp_path / "run", unit, "--wait", "1")
    assert status == 2
    assert "no heartbeat on 7" in result["error"]
    assert f"correct the unit '{unit}'" in result["error"]
    assert "its last lines: waiting for a licence" in result["error"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--unit", "./unit", "--wsp", "none"), "are two units; give one of them"),
        (("--unit", "./unit {prot}"), "{prot} is not known; allowed are {address}"),
        (("--unit", "./unit", "--pacing", "free"), "--pacing free has no bus"),
    ],
)
def test_a_unit_that_cannot_be_is_refused_before_the_run(words, message, tmp_path, capfd):
    out = tmp_path / "run"
    assert cli.main(["run", "velim_a1", *words, "--out", str(out)]) == 2
    assert message in capfd.readouterr().err
    assert not out.exists()


def test_the_context_manager_starts_a_bench_with_a_unit(tmp_path):
    options = {"initial_speed_km_h": 9.0, "adhesion": "dry", "unit": UNIT}
    with bench(folder=tmp_path / "run", **options) as rig:
        rig.brake(bar=3.0)
        rig.stop()
        assert isinstance(rig, harness.Harness)
    stop = rollerrig.load(tmp_path / "run")
    assert stop.summary["wsp"]["unit"] == f"command:{UNIT}"
    assert stop.summary["valid"]


@pytest.mark.nightly
def test_the_package_starts_a_bench_and_reports_a_unit_that_exits(tmp_path):
    with (
        pytest.raises(BusError, match=r"exited with status 4.*calibration is missing"),
        rollerrig.bench(
            folder=tmp_path / "run", unit="sh -c 'echo calibration is missing; exit 4'"
        ),
    ):
        pass


def test_a_sequence_file_may_choose_a_command_only_if_it_is_allowed(tmp_path, capfd):
    text = (
        f'title = "A stop from walking speed"\nwsp = {json.dumps("command:" + UNIT)}\n'
        '[start]\nspeed = "9 km/h"\nadhesion = "dry"\n'
        '[[step]]\nset = { brake_demand = "3 bar" }\nuntil = "vehicle_speed < 0.1 km/h"\n'
    )
    (tmp_path / "stop.toml").write_text(text)
    words = ["sequence", str(tmp_path / "stop.toml"), "--out", str(tmp_path / "report")]
    assert cli.main(words) == 2
    assert "stop.toml, line 2: wsp" in capfd.readouterr().err
    assert cli.main([*words, "--check", "--allow-unit", f"command:{UNIT}"]) == 0


PLAN = 'scenario = "dry_stop"\nchunk = 1\n[vary]\ninitial_speed_m_s = [2.0, 3.0]\n'


@pytest.mark.nightly
def test_each_run_of_a_campaign_starts_the_unit(tmp_path):
    plan = tmp_path / "two.toml"
    plan.write_text(PLAN)
    done = rollerrig.campaign(plan, out=tmp_path / "out", unit=UNIT, workers=1)
    assert done.table["valid"].to_pylist() == [True, True]
    short_m, long_m = done.table["braking_distance_m"].to_pylist()
    assert 0.0 < short_m < long_m
    replay = done.summary["worst"][0]["replay"]
    assert shlex.split(replay)[:7] == [
        *("rollerrig", "run", "dry_stop", "--pacing", "lockstep", "--unit", UNIT)
    ]


@pytest.mark.nightly
def test_a_unit_that_fails_is_the_error_of_each_run_of_a_campaign(tmp_path):
    plan = tmp_path / "two.toml"
    plan.write_text(PLAN)
    done = rollerrig.campaign(plan, out=tmp_path / "out", unit="sh -c 'echo broken; exit 5'")
    assert done.summary["failed"] == 2
    for error in done.table["error"].to_pylist():
        assert "exited with status 5; its last words: broken" in error


def test_a_plan_starts_no_program_itself(tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text('unit = "command:./unit {port}"\n' + PLAN)
    with pytest.raises(ConfigError, match=r"a plan starts no program.*--unit './unit \{port\}'"):
        rollerrig.campaign(plan, out=tmp_path / "out")


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("unit", "state"),
    [
        ("sh -c 'echo waiting for a licence; sleep 1000'", "still runs; its last words: waiting"),
        ("sh -c 'echo done; exit 0'", "exited with status 0; its last words: done"),
        ("sleep 1000", "still runs; it has written nothing"),
    ],
)
def test_a_silent_program_of_a_sequence_is_the_first_thing_that_its_error_states(
    unit, state, tmp_path
):
    path = tmp_path / "walk.toml"
    path.write_text(WALKING_PACE, encoding="utf-8")
    found = play.on_own_bench(
        sequence.load(path),
        tmp_path / "run",
        wsp="external",
        companions=(own_bench.program(unit, tmp_path / "unit.log"),),
        arguments=("--wait", "1"),
    )
    assert found.result is Result.ERROR
    first = "the program of --unit has sent no heartbeat on 720h within 1 s; "
    assert found.error.startswith(f"{first}'{unit}' {state}")
    assert "correct the program" in found.error
    # advice for a bench without --unit
    assert "rollerrig wsp" not in found.error
