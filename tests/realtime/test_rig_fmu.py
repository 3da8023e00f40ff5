"""The rig as an FMU: its stop is that of a free run, and no importing tool is crashed by it.

One importing tool is FMPy. The other is a C program without Python (`fmu/importer.c`).
"""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import fmpy
import numpy as np
import pytest
from fmpy import fmi3
from fmpy.validation import validate_fmu

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime import cli
from rollerrig.realtime.bench import free, scenario
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)

SETTINGS = ("--set", "duration_max_s=4")
AXLES = range(1, 5)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """The FMU of a stop on soap."""
    out = tmp_path_factory.mktemp("rig") / "rig.fmu"
    assert cli.main(["export-fmu", "velim_a1", *SETTINGS, "--out", str(out)]) == 0
    return out


class Imported(NamedTuple):
    """An unpacked FMU and a C program that imports it; `references` are by name of the variable."""

    program: Path
    library: Path
    token: str
    resources: str
    references: dict[str, int]

    def run(self, *commands, token=None, python=sys.executable):
        """Run commands; return the lines that the program prints. It must not crash."""
        words = [self.program, self.library, token or self.token, self.resources, *commands]
        done = subprocess.run(
            [*map(str, words)],
            capture_output=True,
            text=True,
            timeout=600,
            env=os.environ | {"ROLLERRIG_PYTHON": str(python)},
        )
        assert done.returncode == 0, (done.returncode, done.stdout, done.stderr)
        return done.stdout.splitlines()


@pytest.fixture(scope="module")
def imported(rig, tmp_path_factory):
    folder = tmp_path_factory.mktemp("importer")
    headers = Path(fmpy.__file__).parent / "c-code"
    source = Path(__file__).parent / "fmu" / "importer.c"
    program = folder / "importer"
    subprocess.run(["gcc", "-O1", f"-I{headers}", "-o", program, source, "-ldl"], check=True)
    unpacked = Path(fmpy.extract(str(rig), str(folder / "rig")))
    description = fmpy.read_model_description(str(rig))
    identifier = description.coSimulation.modelIdentifier
    return Imported(
        program=program,
        library=unpacked / "binaries" / fmpy.platform_tuple / f"{identifier}.so",
        token=description.instantiationToken,
        resources=f"{unpacked / 'resources'}{os.sep}",
        references={one.name: one.valueReference for one in description.modelVariables},
    )


def values(lines):
    return [float(line.split()[1]) for line in lines if line.startswith("value")]


def test_a_tool_without_python_steps_the_rig_and_gets_the_stop_of_a_free_run(imported):
    of = imported.references
    get = f"get:{of['vehicle_speed']}"
    steps = [word for cycle in range(100) for word in (get, f"step:{cycle * 0.01:.2f}:0.01")]
    lines = imported.run("version", "init:0", *steps, f"get:{of['time']}", "reset", "init:7", get)
    assert lines[0] == "version 3.0"
    assert lines[-1] == "end"
    assert not any(line.startswith("log") for line in lines)
    *speeds_m_s, time_s, after_reset_m_s = values(lines)
    plan = scenario.load("velim_a1", settings=SETTINGS[1:])
    expected = free.channels(free.simulate(plan, None), plan.table)
    np.testing.assert_allclose(speeds_m_s, expected["vehicle_speed_m_s"][:100], rtol=1e-12)
    assert time_s == 1.0
    assert after_reset_m_s == speeds_m_s[0]


# what no rig does: the command with the place of a variable, and what the logger must report
REFUSED = {
    "a demand of 1e9 Pa": ("set:{brake_demand}:1e9", "brake_demand = 1e+09 Pa: allowed is"),
    "a demand of NaN": ("set:{brake_demand}:nan", "brake_demand = nan"),
    "a demand of infinity": ("set:{brake_demand}:-inf", "brake_demand = -inf"),
    "friction of -1": ("set:{friction_2}:-1", "friction_2 = -1: allowed is 0 to 1"),
    "friction of NaN": ("set:{friction_1}:nan", "friction_1 = nan"),
    "a value for an output": ("set:{vehicle_speed}:3", "vehicle_speed is an output"),
    "a number for a magnet": ("set:{hold_1}:1", "hold_1 (value reference 1) is of type Boolean"),
    "a variable that is not there": ("get:4711", "no variable with the value reference 4711"),
    "a step from a later time": ("step:5:0.01", "a step from 5 s, but the rig is at 0 s"),
    "a step from an earlier time": ("step:-1:0.01", "a step from -1 s"),
    "a step from NaN": ("step:nan:0.01", "a step from nan s"),
    "a step backwards": ("step:0:-0.01", "a step of -0.01 s is not a whole number of ticks"),
    "a step of half a tick": ("step:0:0.0005", "a step of 0.0005 s is not a whole number"),
    "a step of NaN": ("step:0:nan", "a step of nan s"),
    "a step without end": ("step:0:inf", "a step of inf s"),
    "a second initialisation": ("init:0", "not allowed in this state"),
}


def test_what_no_rig_does_is_refused_with_a_message_and_the_rig_goes_on(imported):
    commands = [command.format(**imported.references) for command, _ in REFUSED.values()]
    lines = imported.run("init:0", *commands, "step:0:0.01", f"get:{imported.references['time']}")
    assert lines[0] == "init 0"
    for number, (name, (command, message)) in enumerate(REFUSED.items()):
        report, status = lines[1 + 2 * number : 3 + 2 * number]
        assert report.startswith("log 3 logStatusError: "), (name, report)
        assert message in report, name
        assert status == f"{command.partition(':')[0]} 3", name
    assert lines[-4:] == ["step 0", "value 0.01", "get 0", "end"]


@pytest.mark.nightly
def test_a_step_before_the_initialisation_and_a_foreign_token_are_refused(imported):
    lines = imported.run("step:0:0.01")
    assert lines == [
        "log 3 logStatusError: fmi3DoStep is not allowed in this state of the FMU",
        "step 3",
        "end",
    ]
    lines = imported.run(token="of another FMU")
    assert lines[-1] == "no instance"
    assert "the instantiation token is not that of this FMU" in lines[0]


@pytest.mark.nightly
def test_without_rollerrig_there_is_a_message_and_no_crash(imported, tmp_path):
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "bare"], check=True)
    lines = imported.run("init:0", python=tmp_path / "bare" / "bin" / "python")
    assert lines[-1] == "no instance"
    text = "".join(lines)
    assert "the process of the rig is gone: it has exited with status 1" in text
    assert "No module named 'rollerrig'" in text or "ModuleNotFoundError" in text
    assert "ROLLERRIG_PYTHON" in text


def test_without_python_there_is_a_message_and_no_crash(imported, tmp_path):
    lines = imported.run("init:0", python=tmp_path / "nothing")
    assert lines[-1] == "no instance"
    assert re.search(r"cannot start .*nothing: No such file or directory", lines[0])


def test_a_rig_whose_process_is_killed_is_an_error_and_no_crash(imported):
    get = f"get:{imported.references['vehicle_speed']}"
    lines = imported.run("init:0", "step:0:0.01", "kill", "step:0.01:0.01", get, "reset")
    assert lines[1] == "step 0"
    assert "the process of the rig is gone: it was ended by signal 9" in lines[3]
    assert [line for line in lines if line.startswith(("step", "get", "reset"))][1:] == [
        "step 3",
        "get 3",
        "reset 3",
    ]
    assert lines[-1] == "end"


def test_a_fault_of_the_bus_is_refused_with_what_an_exported_rig_allows(tmp_path, capsys):
    path = tmp_path / "faulty.toml"
    path.write_text('vehicle = "uic_z1"\n[[fault]]\nkind = "node_off"\nnode = 16\n')
    out = tmp_path / "rig.fmu"
    assert cli.main(["export-fmu", str(path), "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert "fault node_off acts on the bus, and the FMU of a rig has none" in message
    assert f"remove the fault from scenario {path}" in message
    assert "--pacing" not in message
    assert not out.exists()


def test_the_rig_holds_to_the_standard_and_says_that_it_needs_a_tool(rig):
    assert validate_fmu(str(rig)) == []
    description = fmpy.read_model_description(str(rig))
    assert (description.fmiVersion, description.coSimulation.needsExecutionTool) == ("3.0", True)
    assert description.defaultExperiment.stepSize == "0.01"
    bounds = {one.name: (one.min, one.max) for one in description.modelVariables}
    assert bounds["friction_1"] == ("0.0", "1.0")
    assert bounds["brake_demand"] == (None, "1000000.0")


def test_its_stop_is_that_of_a_free_run(rig, tmp_path):
    wsp = logic.new_unit(logic.load())

    def magnets(counts):
        return int(logic.cycle(wsp, counts)[0])

    plan = scenario.load("velim_a1", settings=SETTINGS[1:])
    expected = free.channels(free.simulate(plan, magnets), plan.table)
    wsp = logic.new_unit(logic.load())
    description = fmpy.read_model_description(str(rig))
    reference = {one.name: one.valueReference for one in description.modelVariables}
    fmu = fmi3.FMU3Slave(
        guid=description.guid,
        unzipDirectory=fmpy.extract(str(rig), str(tmp_path)),
        instanceName="rig",
        modelIdentifier=description.coSimulation.modelIdentifier,
    )
    fmu.instantiate()
    fmu.enterInitializationMode(startTime=0.0)
    fmu.exitInitializationMode()
    # what the unit receives: outputs of the FMU, and the value of one count of each
    outputs = [f"{name}_{axle}" for name in ("wheel_speed", "cylinder_pressure") for axle in AXLES]
    speed_scale = TABLE.by_name["measured_speed"].places[0].scale
    pressure_scale = TABLE.by_name["cylinder_pressure"].places[0].scale
    scales = np.repeat((speed_scale, pressure_scale), len(AXLES))
    valves = [reference[f"{name}_{axle}"] for axle in AXLES for name in ("hold", "vent")]
    speeds_m_s = []
    for cycle in range(300):
        values = np.array(fmu.getFloat64([reference[name] for name in outputs]))
        counts = np.rint(values / scales).astype(np.int64)
        byte = magnets(counts)
        fmu.setBoolean(valves, [bool(byte >> bit & 1) for bit in range(8)])
        speeds_m_s += fmu.getFloat64([reference["vehicle_speed"]])
        fmu.doStep(cycle * 0.01, 0.01)
    np.testing.assert_allclose(speeds_m_s, expected["vehicle_speed_m_s"][:300], rtol=1e-12)
    assert fmu.getFloat64([reference["time"]]) == [3.0]
    assert max(speeds_m_s) - min(speeds_m_s) > 1.0
    # inputs act: demand, friction, magnets
    fmu.setFloat64(
        [reference[f"friction_{axle}"] for axle in AXLES] + [reference["brake_demand"]],
        [0.3] * 4 + [0.0],
    )
    fmu.setBoolean(valves, [False] * 8)
    cylinders = [reference[f"cylinder_pressure_{axle}"] for axle in AXLES]
    before_Pa = fmu.getFloat64(cylinders)
    fmu.doStep(3.0, 1.0)
    assert max(fmu.getFloat64(cylinders)) < 0.95 * max(before_Pa)
    with pytest.raises(fmpy.fmi1.FMICallException):
        fmu.doStep(4.0, 0.0005)
    fmu.terminate()
    fmu.freeInstance()
