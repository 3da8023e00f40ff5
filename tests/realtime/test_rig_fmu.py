"""The rig as an FMU: FMPy finds no error in it, and its stop is that of a free run."""

import fmpy
import numpy as np
import pytest
from fmpy import fmi3
from fmpy.validation import validate_fmu

from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime import cli
from rollerrig.realtime.bench import free, scenario
from rollerrig.wsp_interface import signals

SETTINGS = ("--set", "duration_max_s=4")
AXLES = range(1, 5)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """The FMU of a stop on soap."""
    out = tmp_path_factory.mktemp("rig") / "rig.fmu"
    assert cli.main(["export-fmu", "velim_a1", *SETTINGS, "--out", str(out)]) == 0
    return out


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


def test_its_stop_is_that_of_a_free_run(rig, tmp_path):
    wsp = logic.new_unit(logic.load())

    def magnets(counts):
        return int(logic.cycle(wsp, counts)[0])

    plan = scenario.load("velim_a1", settings=SETTINGS[1:])
    expected = free.channels(free.simulate(plan, magnets))
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
    speed_scale = signals.BY_NAME["measured_speed"].places[0].scale
    pressure_scale = signals.BY_NAME["cylinder_pressure"].places[0].scale
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
