"""Data chooses a unit only from those that run no code, and from the FMUs that the user allows."""

from pathlib import Path

import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.wsp_interface import unit_choice
from rollerrig.wsp_interface.unit_choice import NOTHING, AllowList

WHERE = "plan.toml, line 3: wsp"


@pytest.mark.parametrize("unit", unit_choice.NAMES)
def test_data_may_choose_a_unit_that_runs_no_code_of_other_people(unit):
    assert NOTHING.check(unit, WHERE) == unit


@pytest.mark.parametrize("unit", ["fmu:unit.fmu", "fmu:/a/unit.fmu", "fmu:a.fmu,fmu:b.fmu"])
def test_an_fmu_in_data_is_refused_and_the_message_names_place_and_option(unit):
    with pytest.raises(ConfigError) as error:
        NOTHING.check(unit, WHERE)
    file = str(unit_choice.fmus_of(unit)[0])
    assert str(error.value).startswith(f"{WHERE}: fmu:{file} is a program")
    assert f"--allow-unit {file}" in str(error.value)


def test_an_allowed_fmu_may_be_chosen_by_any_path_that_leads_to_it(tmp_path, monkeypatch):
    fmu = tmp_path / "unit.fmu"
    fmu.touch()
    (tmp_path / "link.fmu").symlink_to(fmu)
    monkeypatch.chdir(tmp_path)
    allowed = AllowList.of([Path("unit.fmu")])
    for text in (f"fmu:{fmu}", "fmu:unit.fmu", "fmu:./unit.fmu", "fmu:link.fmu"):
        assert allowed.check(text, WHERE) == text


def test_one_allowed_fmu_does_not_allow_another_beside_it(tmp_path):
    for name in ("good.fmu", "bad.fmu"):
        (tmp_path / name).touch()
    allowed = AllowList.of([tmp_path / "good.fmu"])
    with pytest.raises(ConfigError, match=r"bad\.fmu is a program"):
        allowed.check(f"fmu:{tmp_path / 'good.fmu'},fmu:{tmp_path / 'bad.fmu'}", WHERE)


@pytest.mark.parametrize(
    "unit", ["", "fmu:", "fmu:a.fmu,fmu:", "reference,fmu:a.fmu", "os:abort", "--json", "Reference"]
)
def test_any_other_text_is_not_a_unit(unit):
    with pytest.raises(ConfigError, match="choose from reference, external, none, fmu:FILE"):
        AllowList.of([]).check(unit, WHERE)


def test_only_a_file_that_exists_can_be_allowed(tmp_path):
    with pytest.raises(ConfigError, match=r"--allow-unit .*there is no such file"):
        AllowList.of([tmp_path / "absent.fmu"])


def test_a_command_in_data_is_refused_unless_exactly_this_one_is_allowed():
    unit = "command:./unit {host} {port}"
    with pytest.raises(ConfigError) as error:
        NOTHING.check(unit, WHERE)
    assert str(error.value).startswith(f"{WHERE}: {unit} is a program")
    assert f"--allow-unit '{unit}'" in str(error.value)
    allowed = AllowList.of([unit])
    assert allowed.check(unit, WHERE) == unit
    with pytest.raises(ConfigError, match="data starts no program"):
        allowed.check(f"{unit}; rm -r x", WHERE)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("", "is empty; write a command line"),
        ("./unit {hots}", r"\{hots\} is not known; allowed are \{address\}, \{host\}, \{port\}"),
        ("./unit 'a", "No closing quotation; write a command line"),
        ("./unit {", "write a command line"),
        ("./unit {host.x}", "write a command line"),
    ],
)
def test_a_command_that_cannot_be_started_is_refused(command, message):
    with pytest.raises(ConfigError, match=message):
        unit_choice.check(f"command:{command}")


def test_the_places_of_a_command_are_filled():
    words = unit_choice.command_words("./unit '{host} x' {port} {{a}}", "ADDRESS", "here", 7)
    assert words == ["./unit", "here x", "7", "{a}"]
