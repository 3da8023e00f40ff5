"""What the check of an FMU names, and the mapping that it proposes; nothing of the FMU is run."""

import json
from pathlib import Path

import pytest

fmus = pytest.importorskip("fmus")

from rollerrig.configs.errors import ConfigError, UnitError  # noqa: E402
from rollerrig.configs.vehicle import COACH  # noqa: E402
from rollerrig.firmware_sim.fmu import fmu_file, signal_unit  # noqa: E402
from rollerrig.realtime import cli  # noqa: E402
from rollerrig.wsp_interface import signals  # noqa: E402
from rollerrig.wsp_interface.rig_objects import unit_frames  # noqa: E402
from rollerrig.wsp_interface.unit_map import mapping  # noqa: E402

HERTZ = Path(__file__).parent.parent / "data" / "field" / "fmu_units" / "Hz.fmu"
SPEED_1 = (
    '<Float64 unit="rad/s" name="wheel_speed_1" valueReference="0" causality="input" '
    'variability="continuous" start="0"/>'
)
VENT_4 = '<Boolean name="vent_4" valueReference="15" causality="output" variability="discrete"/>'
TYPES = (
    '<TypeDefinitions><EnumerationType name="Valve"><Item name="Fill" value="0"/>'
    '<Item name="Vent" value="1"/></EnumerationType></TypeDefinitions><ModelVariables>'
)


def problems(path, unit_map=None):
    """Return the text with which an FMU is refused."""
    with pytest.raises(ConfigError) as refused:
        fmu_file.check(path, unit_map, 0.01)
    return str(refused.value)


def edited(folder, *changes, version=3):
    """Return an FMU with changes of its description, as pairs of old and new text."""

    def edit(xml):
        for old, new in changes:
            assert old in xml, (old, xml)
            xml = xml.replace(old, new, 1)
        return xml

    return fmus.build(folder, version, edit=edit)


def test_a_speed_in_hertz_is_no_angular_speed():
    text = problems(HERTZ)
    for axle in range(1, 5):
        assert f"wheel_speed_{axle}: has the unit Hz, which is 1/s without an angle" in text
    assert "factor = 0.159155 for turns in a second" in text


@pytest.mark.parametrize("version", [2, 3])
def test_units_are_equal_only_if_the_exponent_of_the_angle_is(version, tmp_path):
    with_angle = '<BaseUnit rad="1" s="-1"/>'
    fmu_file.check(edited(tmp_path, version=version), None, 0.01)
    bare = edited(tmp_path / "bare", (with_angle, '<BaseUnit s="-1"/>'), version=version)
    assert "has the unit rad/s, which is 1/s without an angle" in problems(bare)
    # 1 Pa is no Pa rad
    odd = edited(
        tmp_path / "odd",
        ('<BaseUnit kg="1" m="-1" s="-2"/>', '<BaseUnit kg="1" m="-1" s="-2" rad="1"/>'),
        version=version,
    )
    assert "has the unit Pa, which is not a unit of this quantity" in problems(odd)


KINDS = {
    "an array": (
        [(SPEED_1, SPEED_1.replace("/>", '><Dimension start="4"/></Float64>'))],
        "wheel_speed_1: is an array of 4 values; allowed are single numbers",
    ),
    "an enumeration": (
        [
            ("<ModelVariables>", TYPES),
            (VENT_4, VENT_4.replace("Boolean", 'Enumeration declaredType="Valve"')),
        ],
        "vent_4: is an enumeration (Fill = 0, Vent = 1); allowed are single numbers",
    ),
    "a clocked variable": (
        [
            (SPEED_1, SPEED_1.replace("continuous", 'discrete" clocks="77')),
            (
                VENT_4,
                VENT_4 + '<Clock name="cycle" valueReference="77" causality="input" '
                'intervalVariability="constant" intervalDecimal="0.01"/>',
            ),
        ],
        "wheel_speed_1: is a clocked variable of the clock cycle, valid at its ticks only",
    ),
    "scheduled execution": (
        [
            ("CoSimulation", "ScheduledExecution"),
            (' canHandleVariableCommunicationStepSize="true"', ""),
        ],
        "co-simulation: has none, only scheduled execution (its clocks call model partitions)",
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_variable_that_the_rig_cannot_exchange_is_named_for_what_it_is(kind, tmp_path):
    changes, expected = KINDS[kind]
    assert expected in problems(edited(tmp_path, *changes))


def test_an_array_of_another_name_is_shown_beside_the_missing_variables(tmp_path, capsys):
    array = SPEED_1.replace("wheel_speed_1", "v").replace("/>", '><Dimension start="4"/></Float64>')
    unit = edited(tmp_path, (SPEED_1, array))
    assert cli.main(["check", str(unit), "--json"]) == 2
    rows = {one["name"]: one for one in json.loads(capsys.readouterr().out)["checks"]}
    assert rows["wheel_speed_1"]["state"] == "missing"
    assert "--write-map" in rows["wheel_speed_1"]["mend"]
    assert rows["v"]["found"] == "input: is an array of 4 values, which the rig does not exchange"


def test_an_alias_of_a_variable_is_the_variable(tmp_path):
    alias = SPEED_1.replace("wheel_speed_1", "v_front").replace(
        "/>", '><Alias name="wheel_speed_1"/></Float64>'
    )
    fmu, findings = fmu_file.examine(edited(tmp_path, (SPEED_1, alias)), None, 0.01)
    assert all(finding.fits for finding in findings), findings
    assert fmu.inputs[0].reference == 0
    found = {finding.name: finding.found for finding in findings}
    assert found["aliases"] == "wheel_speed_1 is an alias of v_front"


def test_the_proposed_mapping_of_an_fmu_with_other_names_fits_it(tmp_path, capsys):
    names = {f"nRad{axle}": "rpm" for axle in range(1, 5)}
    names |= {f"Bremsdruck_{axle}": "bar" for axle in range(1, 5)}
    unit = fmus.build(tmp_path, inputs=names)
    out = tmp_path / "map.toml"
    assert cli.main(["check", str(unit)]) == 2
    assert cli.main(["check", str(unit), "--write-map", str(out)]) == 0
    capsys.readouterr()
    proposed = mapping.load_fmu_map(out, 4)
    assert proposed.inputs["nRad2"] == ("measured_speed_2", pytest.approx(9.5493, rel=1e-4))
    assert proposed.inputs["Bremsdruck_4"] == ("cylinder_pressure_4", 1e-5)
    assert (proposed.hold[0], proposed.vent[3]) == ("hold_1", "vent_4")
    assert proposed.reference == "reference_speed"
    assert cli.main(["check", str(unit), "--unit-map", str(out)]) == 0
    # a mapping that somebody has corrected is not replaced
    assert cli.main(["check", str(unit), "--write-map", str(out)]) == 2


def test_what_a_proposal_cannot_recognise_is_a_question_mark_that_the_check_reports(
    tmp_path, capsys
):
    def rename(xml):
        return xml.replace("hold_", "alpha_").replace("vent_", "beta_")

    unit = fmus.build(tmp_path, edit=rename)
    out = tmp_path / "map.toml"
    assert cli.main(["check", str(unit), "--write-map", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["unknown"] == 8
    text = out.read_text()
    assert "#   alpha_1 (Boolean)" in text
    assert '"?1"' in text
    assert "?1: is missing" in problems(unit, out)


@pytest.mark.parametrize("version", [2, 3])
def test_the_log_of_an_fmu_is_part_of_the_error_when_a_step_fails(version, tmp_path, capfd):
    unit = fmus.build(tmp_path, version, defines=("FAIL_AT_S=0.02",))
    fmu = signal_unit.Fmu(
        fmu_file.check(unit, None, 0.01),
        tmp_path / "unpacked",
        unit_frames(signals.table(COACH), 0),
    )
    fmu.begin()
    for _ in range(3):
        fmu.idle()
    with pytest.raises(UnitError, match=r"; its log: wheel 3 of the WSP is lost"):
        fmu.idle()
    assert "[ERROR] wheel 3 of the WSP is lost" in capfd.readouterr().out
