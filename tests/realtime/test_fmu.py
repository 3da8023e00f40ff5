"""A WSP unit that is an FMU: the reference's rules in C, compiled for FMI 2 and 3, brake the coach
over the bus.
"""

import json
import os
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import bench_process
import fmus
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.fmu import fmu_file
from rollerrig.realtime import cli
from rollerrig.realtime.bench import options
from rollerrig.realtime.bench.options import Options
from rollerrig.wsp_interface.events import Code

SHORT = ("--pacing", "lockstep", "--set", "duration_max_s=2")
MAP = """[[to_unit]]
factor = 0.445                # m/s at a radius of 0.445 m
signals = { V1 = "measured_speed_1", V2 = "measured_speed_2", V3 = "measured_speed_3", V4 = "measured_speed_4" }
[[to_unit]]
factor = 1e-5
signals = { P1 = "cylinder_pressure_1" }
[from_unit]
hold = ["hold_1", "hold_2", "hold_3", "hold_4"]
vent = ["vent_1", "vent_2", "vent_3", "vent_4"]
reference = "reference_speed"
reference_factor = 0.5
"""


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    """One of FMI 3 that fits."""
    return fmus.build(tmp_path_factory.mktemp("fmu"))


@pytest.mark.parametrize("version", [pytest.param(2, marks=pytest.mark.nightly), 3])
def test_the_reference_rules_in_an_fmu_give_the_channels_of_the_reference_unit(
    version, stop_with_wsp, tmp_path
):
    # an FMU that is told rpm and bar, which are converted; the other one SI
    units = {"rad/s": "rpm", "Pa": "bar"} if version == 3 else {}
    unit = fmus.build(
        tmp_path,
        version,
        inputs={name: units.get(unit, unit) for name, unit in fmus.INPUTS.items()},
        defines=["SPEED_UNIT=0.10471975511965977"] if units else [],
    )
    run = bench_process.run(
        tmp_path / "run",
        "--pacing",
        "lockstep",
        "--set",
        "duration_max_s=9",
        "--wsp",
        f"fmu:{unit}",
    )
    assert run.status == 4, run.stderr  # it has not stopped
    assert run.record.column("vents_1")[-1] > 0
    bench_process.assert_same_channels(run, stop_with_wsp)
    # what the FMU has said stands in the log of the unit
    assert "the WSP of the FMU is there" in (run.out / "wsp.log").read_text()
    assert json.loads((run.out / "summary.json").read_text())["wsp"]["unit"] == f"fmu:{unit}"


@pytest.mark.nightly
@pytest.mark.parametrize("fault", ["stuck", "dropout"])
def test_the_rules_in_an_fmu_reject_the_sensors_that_the_reference_unit_rejects(
    fault, fmu, tmp_path
):
    words = ["--pacing", "lockstep", "--set", "duration_max_s=14", "--set", "adhesion=very_low"]
    for axle in (1, 2, 3):
        words += ["--fault", f"speed_sensor_{fault} axle={axle} at=2"]
    of_reference = bench_process.run(tmp_path / "reference", *words)
    of_fmu = bench_process.run(tmp_path / "fmu", *words, "--wsp", f"fmu:{fmu}")
    assert of_reference.record.column("vents_4")[-1] > 0
    bench_process.assert_same_channels(of_fmu, of_reference)


@pytest.mark.parametrize("version", [2, pytest.param(3, marks=pytest.mark.nightly)])
def test_an_fmu_of_sources_is_compiled_and_its_names_come_from_a_mapping(version, tmp_path):
    names = {
        **{f"V{axle}": "m/s" for axle in range(1, 5)},
        **{f"P{axle}": "bar" for axle in range(1, 5)},
    }
    unit = fmus.build(tmp_path, version, binary=False, sources=True, inputs=names)
    (tmp_path / "map.toml").write_text(MAP)
    with pytest.raises(ConfigError, match="wheel_speed_1: is missing; give a mapping"):
        fmu_file.check(unit, None, 0.01)
    run = bench_process.run(
        tmp_path / "run", *SHORT, "--wsp", f"fmu:{unit}", "--unit-map", str(tmp_path / "map.toml")
    )
    assert run.status in (0, 4), run.stderr
    record = run.record
    # the FMU takes m/s for rad/s, and halves of m/s for m/s
    expected_m_s = record.column("vehicle_speed_m_s")[20] * 0.445 * 0.5
    assert record.column("wsp_reference_speed_m_s")[20] == pytest.approx(expected_m_s, rel=0.02)


@pytest.mark.parametrize(
    ("defines", "said"),
    [
        (
            "FAIL_AT_S=1.0",
            "the FMU has failed at 1.000 s: fmi3DoStep failed with status 3 (error).; its log: "
            "wheel 3 of the WSP is lost",
        ),
        # test_fmu_can.py has a crash
        pytest.param(
            "CRASH_AT_S=1.0",
            "wsp.fmu crashed (signal 6, SIGABRT); its last words: the next step crashes",
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            "HANG_AT_S=1.0",
            "the FMU hangs: doStep at 1.000 s has not returned within 2 s",
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_an_fmu_that_fails_is_a_unit_that_died_and_the_record_is_kept(defines, said, tmp_path):
    unit = fmus.build(tmp_path, defines=[defines])
    run = bench_process.run(tmp_path / "run", *SHORT, "--wsp", f"fmu:{unit}", "--answer-wait", "2")
    assert run.status == 4
    assert said in run.stderr
    assert "Traceback" not in run.stderr + (run.out / "wsp.log").read_text()
    assert len(run.record.column("time_s")) > 90
    (failed,) = run.reported(Code.RUN_FAILED)
    assert "the WSP unit wsp.fmu " in failed.fields["reason"]


@pytest.mark.nightly
def test_the_unit_in_c_of_the_documents_becomes_an_fmu_that_prevents_locked_wheels(docs, tmp_path):
    # the script takes the headers of the Python that it finds first
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    script = docs / "examples" / "fmu" / "build.sh"
    subprocess.run(["sh", script], cwd=tmp_path, check=True, env={**os.environ, "PATH": path})
    unit = tmp_path / "unit.fmu"
    run = bench_process.run(tmp_path / "run", "--pacing", "lockstep", "--wsp", f"fmu:{unit}")
    assert run.status == 0, run.stderr
    axles = json.loads((run.out / "summary.json").read_text())["axles"]
    assert all(axle["vents"] > 0 for axle in axles)
    assert all(axle["longest_lock_s"] == 0.0 for axle in axles)


# in a unit in C: a function of another file
USES_THE_OTHER_FILE = "double twice_the_limit(void) { return 2.0 * limit_of_slip(); }\n"


@pytest.mark.parametrize("more_files", [True, False], ids=["all files", "one is missing"])
def test_the_script_compiles_every_c_file_and_refuses_what_none_defines(docs, tmp_path, more_files):
    folder = tmp_path / "unit"
    shutil.copytree(docs / "examples" / "fmu", folder)
    # the algorithm of a user in two files
    code = (folder / "unit.c").read_text()
    (folder / "unit.c").write_text(f"double limit_of_slip(void);\n{code}\n" + USES_THE_OTHER_FILE)
    if more_files:
        (folder / "limits.c").write_text("double limit_of_slip(void) { return 0.1; }\n")
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", folder / "build.sh"],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode == 0) is more_files, done.stderr
    assert (tmp_path / "unit.fmu").exists() is more_files
    assert ("limit_of_slip" in done.stderr) is not more_files


def test_the_script_that_compiles_the_unit_in_c_names_the_package_that_it_lacks(docs, tmp_path):
    python = tmp_path / "python"
    # a Python without site packages has no fmpy
    python.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -S "$@"\n')
    python.chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", docs / "examples" / "fmu" / "build.sh"],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "build.sh: the headers of FMI are missing; install them with: pip install 'rollerrig[fmu]'"
    ]


@pytest.mark.nightly
def test_the_brakes_apply_when_an_fmu_dies_in_real_time(tmp_path):
    unit = fmus.build(tmp_path, defines=["CRASH_AT_S=1.0"])
    run = bench_process.run(tmp_path / "run", "--set", "duration_max_s=10", "--wsp", f"fmu:{unit}")
    assert run.status == 4  # not valid
    (ended,) = run.reported(Code.UNIT_ENDED, unit="WSP unit wsp.fmu", status=-6)
    assert ended.fields["last_words"].startswith("the next step crashes")
    assert run.reported(Code.UNIT_LOST)
    assert all(run.record.column(f"magnets_{axle}")[-1] == 0 for axle in range(1, 5))


def test_a_frozen_fmu_goes_on_where_it_was(tmp_path, fmu):
    """What stops the process is no hanging step."""
    run = bench_process.run(
        tmp_path / "run",
        *SHORT,
        "--wsp",
        f"fmu:{fmu}",
        "--fault",
        "wsp_frozen at=1 for=0.5",
        "--answer-wait",
        "2",
    )
    assert not run.reported(Code.UNIT_ENDED)
    assert run.record.column("time_s")[-1] > 1.9


@pytest.mark.nightly
def test_a_packaged_sequence_is_played_with_an_fmu_and_judged(fmu, tmp_path, capsys):
    assert (
        cli.main(
            ["sequence", "low_speed_010", "--wsp", f"fmu:{fmu}", "--out", str(tmp_path), "--json"]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out)["sequences"] == {"low_speed_010": "pass"}
    assert (
        json.loads((tmp_path / "low_speed_010" / "summary.json").read_text())["wsp"]["unit"]
        == f"fmu:{fmu}"
    )


# the description, what of it is changed, what is said
WRONG = [
    (
        3,
        'name="hold_3"',
        'name="halt_3"',
        "hold_3: is missing; give a mapping with --unit-map if it has another "
        "name; did you mean 'hold_",
    ),
    (
        3,
        'name="wheel_speed_2" valueReference="1" causality="input"',
        'name="wheel_speed_2" valueReference="1" causality="local"',
        "wheel_speed_2: is declared as local; declare it as an input",
    ),
    (
        2,
        'name="vent_1" valueReference="12" causality="output" variability="discrete"',
        'name="vent_1" valueReference="12" causality="output" variability="constant"',
        "vent_1: has the variability constant; allowed are",
    ),
    (
        3,
        '<Float64 unit="rad/s" name="wheel_speed_1" valueReference="0" causality="input" variability="continuous" '
        'start="0"/>',
        '<Float64 name="wheel_speed_1" valueReference="0" causality="input" variability="continuous" '
        'start="0 0"><Dimension start="2"/></Float64>',
        "wheel_speed_1: is an array of 2 values; allowed are single numbers",
    ),
    (
        2,
        '<Real unit="rad/s" start="0"/>',
        '<Real unit="m/s" start="0"/>',
        "wheel_speed_1: has the unit m/s, which is "
        "not a unit of this quantity; declare rad/s, or give a mapping with --unit-map and "
        "its factor (for m/s the wheel ",
    ),
    (
        3,
        'unit="Pa"',
        'unit="psi"',
        "cylinder_pressure_4: has the unit psi, which it does not define; declare Pa",
    ),
    (
        3,
        'canHandleVariableCommunicationStepSize="true"',
        'fixedInternalStepSize="0.004"',
        "step: its internal steps take "
        "0.004 s, and one doStep a SYNC takes 0.01 s (bus.sync_period_s); export it with a step of which 0.01 s is",
    ),
    (
        3,
        "CoSimulation",
        "ModelExchange",
        "co-simulation: has none, only model exchange; export it for",
    ),
]


@pytest.mark.parametrize(("version", "old", "new", "said"), WRONG)
def test_an_fmu_that_does_not_fit_is_refused_before_the_run(version, old, new, said, tmp_path):
    def edit(xml):
        assert old in xml
        return xml.replace(old, new)

    unit = fmus.build(tmp_path, version, edit=edit)
    with pytest.raises(ConfigError) as refusal:
        fmu_file.check(unit, None, 0.01)
    assert said in str(refusal.value)


def test_an_fmu_of_fmi_1_is_refused_by_name(tmp_path):
    first = (
        '<?xml version="1.0"?><fmiModelDescription fmiVersion="1.0" modelName="old" modelIdentifier="old" '
        'guid="g" numberOfContinuousStates="0" numberOfEventIndicators="0"/>'
    )
    with pytest.raises(
        ConfigError, match=r"is an FMU of FMI 1\.0; export it for FMI 2\.0 or 3\.0, co-simulation"
    ):
        fmu_file.check(fmus.build(tmp_path, edit=lambda xml: first), None, 0.01)


def test_an_fmu_without_a_binary_for_this_machine_says_which_it_has(tmp_path, monkeypatch):
    unit = fmus.build(tmp_path, binary=False)
    with pytest.raises(
        ConfigError,
        match=r"binaries for no platform, none for this machine .*; export it for",
    ):
        fmu_file.check(unit, None, 0.01)
    unit = fmus.build(tmp_path, name="source", binary=False, sources=True)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(
        ConfigError, match=r"no platform, sources, none .*; install a C compiler \(cc\)"
    ):
        fmu_file.check(unit, None, 0.01)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"no archive", "is not an FMU, which is a ZIP archive"),
        (None, "no such file"),
        (b"PK\5\6" + bytes(18), "contains no modelDescription.xml"),
    ],
)
def test_a_file_that_is_no_fmu_is_refused(content, said, tmp_path):
    path = tmp_path / "unit.fmu"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=said):
        fmu_file.check(path, None, 0.01)


@pytest.mark.parametrize("folder", ["unit/", "./"])
def test_an_fmu_that_is_packed_with_its_folder_is_refused_with_how_to_pack_it(folder, tmp_path):
    path = tmp_path / "unit.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{folder}modelDescription.xml", "<fmiModelDescription/>")
    with pytest.raises(ConfigError, match=f"contains {folder}modelDescription.xml, and an FMU has"):
        fmu_file.check(path, None, 0.01)


def test_without_fmpy_the_message_says_how_to_install_it(fmu, monkeypatch):
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(ConfigError, match=r"pip install 'rollerrig\[fmu\]'"):
        fmu_file.check(fmu, None, 0.01)


def test_free_pacing_has_no_bus_for_an_fmu_and_a_mapping_wants_one(fmu):
    with pytest.raises(ConfigError, match="no FMU can answer; use --pacing lockstep"):
        options.check(Options(pacing="free", unit=f"fmu:{fmu}"), False)
    with pytest.raises(ConfigError, match="--unit-map is for an FMU, and the unit is reference"):
        options.check(Options(unit_map=fmu), False)


def test_check_says_what_an_fmu_is_and_whether_it_fits(fmu, tmp_path, capsys):
    assert cli.main(["check", str(fmu), "--json"]) == 0
    rows = {one["name"]: one for one in json.loads(capsys.readouterr().out)["checks"]}
    assert rows["FMU"]["found"] == "FMI 3.0, wsp"
    assert rows["platform"]["found"] == "binaries for x86_64-linux"
    assert rows["wheel_speed_1"] == {
        "name": "wheel_speed_1",
        "state": "ok",
        "mend": "",
        "found": "input, Float64: measured_speed_1",
    }
    wrong = fmus.build(tmp_path, edit=lambda xml: xml.replace("vent_4", "went_4"))
    assert cli.main(["check", str(wrong)]) == 2
    assert "missing" in capsys.readouterr().out


def test_a_wrong_word_for_the_unit_is_refused_with_those_there_are(capsys):
    with pytest.raises(SystemExit):
        cli.main(["run", "velim_a1", "--wsp", "fmi:unit.fmu"])
    assert "choose from reference, external, none, fmu:FILE" in capsys.readouterr().err
