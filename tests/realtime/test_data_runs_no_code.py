"""Data runs no code: only an option of the command line allows it, and it is off by default."""

import argparse
import json
import re
import shlex
import sys
import zipfile
from pathlib import Path

import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.bench.rig_fmu import export
from rollerrig.realtime.campaign import campaign
from rollerrig.wsp_interface.sequences import play, sequence

SEQUENCE = """title = "The unit of a colleague protects the vehicle"
wsp = "fmu:unit.fmu"
[[step]]
for = "0.1 s"
"""
PLAN = """scenario = "velim_a1"
unit = "{unit}"
[vary]
initial_speed_m_s = [2.0]
"""
CODE = """
from pathlib import Path
Path({mark!r}).touch()
def unit():
    return lambda counts: 0
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working folder, with a sequence that names an FMU."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.toml").write_text(SEQUENCE)
    (tmp_path / "unit.fmu").write_text("not even an archive")
    return tmp_path


@pytest.fixture
def plan_with_code(folder, monkeypatch):
    """A plan whose unit is a function of a module; the file `ran` shows that it was imported."""
    mark = str(folder / "ran")
    (folder / "units_of_a_colleague.py").write_text(CODE.format(mark=mark))
    monkeypatch.syspath_prepend(folder)
    yield written_plan(folder, "units_of_a_colleague:unit")
    sys.modules.pop("units_of_a_colleague", None)


def written_plan(folder, unit):
    path = folder / "plan.toml"
    path.write_text(PLAN.format(unit=unit))
    return str(path)


def message(words, capsys):
    """Return the message of a command that ends with status 2."""
    assert cli.main([*words, "--json"]) == cli.USAGE
    return json.loads(capsys.readouterr().out)["error"]


def test_a_sequence_that_names_an_fmu_is_refused_with_its_line_and_the_option(folder, capsys):
    text = message(["sequence", "one.toml"], capsys)
    assert text.startswith("one.toml, line 2: wsp: fmu:unit.fmu is a program")
    assert text.endswith("--allow-unit unit.fmu")
    assert not (folder / "report").exists()


def test_an_fmu_that_the_user_allows_is_used(folder, capsys):
    # it is opened now, and fails only because this file is not an FMU
    text = message(["sequence", "one.toml", "--allow-unit", str(folder / "unit.fmu")], capsys)
    assert "unit.fmu: is not an FMU" in text


def test_a_unit_on_the_command_line_replaces_the_unit_of_a_sequence(folder, capsys):
    text = message(["sequence", "one.toml", "--wsp", "fmu:unit.fmu"], capsys)
    assert "unit.fmu: is not an FMU" in text


def test_a_sequence_that_a_program_plays_is_refused_as_well(folder):
    outcome = play.on_own_bench(sequence.load("one.toml"), folder / "run")
    assert "--allow-unit unit.fmu" in outcome.error
    assert not (folder / "run").exists()


@pytest.mark.parametrize("unit", ["os:abort", "subprocess", "../unit.fmu", "--json"])
def test_a_sequence_with_another_text_as_its_unit_is_refused(folder, unit):
    (folder / "one.toml").write_text(SEQUENCE.replace("fmu:unit.fmu", unit))
    with pytest.raises(ConfigError, match=r"line 2: wsp: .*choose from reference, external"):
        sequence.load("one.toml")


def test_a_plan_that_names_a_function_is_refused_with_the_option(plan_with_code, folder, capsys):
    text = message(["campaign", plan_with_code], capsys)
    assert 'unit = "units_of_a_colleague:unit" is code' in text
    assert text.endswith("--allow-code")
    assert not (folder / "ran").exists()


def test_a_plan_that_the_user_allows_runs_its_function(plan_with_code, folder):
    plan = campaign.load(plan_with_code, allow_code=True)
    assert plan.head["unit"] == "units_of_a_colleague:unit"
    assert (folder / "ran").exists()


@pytest.mark.parametrize("unit", ["os", "os:", ":abort", "os:abort()", "os:path.join", "a b:c"])
def test_a_plan_whose_unit_is_no_name_of_a_function_is_refused(folder, unit):
    with pytest.raises(ConfigError, match=r"allowed are reference, none, and package\.module"):
        campaign.load(written_plan(folder, unit), allow_code=True)


@pytest.mark.parametrize("unit", ["no_such_module:unit", "os:no_such_function", "os:getcwd"])
def test_an_allowed_function_that_gives_no_unit_is_an_error_and_no_crash(folder, unit):
    with pytest.raises(ConfigError, match="where the function returns a unit"):
        campaign.load(written_plan(folder, unit), allow_code=True)


def test_the_command_that_repeats_a_run_is_one_command_whatever_is_in_the_plan(folder):
    path = written_plan(folder, "reference")
    Path(path).write_text(Path(path).read_text().replace("[2.0]", '["2.0; touch ran"]'))
    plan = campaign.Plan(
        {"scenario": "a; touch ran.toml", "unit": "reference"},
        ("vehicle",),
        (("x'; touch ran; '$(touch ran)",),),
    )
    words = shlex.split(campaign.command(plan, 0))
    assert words[:3] == ["rollerrig", "run", "a; touch ran.toml"]
    assert words[-2:] == ["--set", "vehicle=\"x'; touch ran; '$(touch ran)\""]


def test_the_name_of_a_scenario_is_not_part_of_the_program_in_its_fmu(folder):
    pytest.importorskip("fmpy")
    name = 'a"""\nimport pathlib\npathlib.Path("ran").touch()\n"""b'
    scenario_path = folder / f"{name}.toml"
    scenario_path.write_text('title = "A stop"\n')
    export.write(scenario.load(str(scenario_path)), folder / "rig.fmu")
    assert not (folder / "ran").exists()
    with zipfile.ZipFile(folder / "rig.fmu") as archive:
        for source in export.SOURCES:
            program = Path(export.__file__).with_name(source).read_bytes()
            assert archive.read(f"sources/{source}") == program
        token = archive.read("sources/token.h").decode()
        model = archive.read("modelDescription.xml").decode()
        assert not any(name.endswith(".py") for name in archive.namelist())
    assert re.fullmatch(r'#define INSTANTIATION_TOKEN "[0-9a-f]{64}"\n', token)
    assert 'modelName="a____import_pathlib_' in model


@pytest.mark.parametrize("key", ["unit", "wsp", "allow_unit", "allow_code", "allow"])
def test_a_scenario_such_as_that_of_a_recorded_run_can_name_no_unit(folder, key):
    (folder / "scenario.toml").write_text(f'{key} = "fmu:unit.fmu"\n')
    with pytest.raises(ConfigError, match=key):
        scenario.load(str(folder / "scenario.toml"))


@pytest.mark.parametrize("key", ["allow_unit", "allow_code", "unit"])
def test_a_sequence_cannot_allow_code(folder, key):
    (folder / "one.toml").write_text(f'{key} = "unit.fmu"\n{SEQUENCE}')
    with pytest.raises(ConfigError, match=key):
        sequence.load("one.toml")


@pytest.mark.parametrize("key", ["allow_unit", "allow_code"])
def test_a_plan_cannot_allow_code(folder, key):
    path = Path(written_plan(folder, "os:abort"))
    path.write_text(f"{key} = true\n{path.read_text()}")
    with pytest.raises(ConfigError, match=key):
        campaign.load(str(path))


def test_no_option_that_allows_something_is_on_by_default():
    (verbs,) = [
        action for action in cli.parser()._actions if isinstance(action, argparse._SubParsersAction)
    ]
    allowing = {}
    for verb, parser in verbs.choices.items():
        for action in parser._actions:
            if any(option.startswith("--allow") for option in action.option_strings):
                allowing[verb, action.option_strings[0]] = action.default
    assert ("sequence", "--allow-unit") in allowing
    assert ("campaign", "--allow-code") in allowing
    assert not any(allowing.values())
