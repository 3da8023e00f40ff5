"""The description of the FMU of a rig: modelDescription.xml of FMI 3.0.

The value reference of a variable is its place among the ports of the rig; 0 is the time.
"""

import hashlib
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence

from rollerrig.realtime.bench.rig_fmu.rig import Port

STEP_S = 0.01  # proposed to the importing tool
IDENTIFIER = "rollerrig_rig"  # of the library
_UNITS = {
    "s": {"s": 1},
    "m/s": {"m": 1, "s": -1},
    "m": {"m": 1},
    "rad/s": {"rad": 1, "s": -1},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "N": {"kg": 1, "m": 1, "s": -2},
}
_TEXT = (
    "A roller rig with a railway coach, for wheel slide protection. It computes in a process of "
    "Python with rollerrig, which has to be installed where it runs."
)


def token(model: str, scenario: str) -> str:
    """Return the instantiation token: the same for the same scenario, and another for any other."""
    return hashlib.sha256(f"{model}\0{scenario}".encode()).hexdigest()


def xml(model: str, ports: Sequence[Port], instantiation_token: str, version: str) -> bytes:
    """Return the description of the FMU of a rig. `version` is that of rollerrig."""
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=model,
        instantiationToken=instantiation_token,
        description=_TEXT,
        generationTool=f"rollerrig {version}",
        variableNamingConvention="flat",
    )
    ET.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=IDENTIFIER,
        needsExecutionTool="true",
        canHandleVariableCommunicationStepSize="true",
    )
    units = ET.SubElement(root, "UnitDefinitions")
    for name, exponents in _UNITS.items():
        unit = ET.SubElement(units, "Unit", name=name)
        ET.SubElement(unit, "BaseUnit", {base: str(power) for base, power in exponents.items()})
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", name="logStatusError")
    ET.SubElement(root, "DefaultExperiment", startTime="0.0", stepSize=str(STEP_S))

    variables = ET.SubElement(root, "ModelVariables")
    structure = ET.SubElement(root, "ModelStructure")
    initial = []
    for reference, port in enumerate(ports):
        _add_variable(variables, reference, port)
        if reference and port.set is None:
            ET.SubElement(structure, "Output", valueReference=str(reference))
            initial.append(reference)
    for reference in initial:
        ET.SubElement(structure, "InitialUnknown", valueReference=str(reference))
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def _add_variable(variables: ET.Element, reference: int, port: Port) -> None:
    """Add a variable; the first one is the time, which is independent."""
    attributes = {
        "name": port.name,
        "valueReference": str(reference),
        "description": port.text,
        "variability": "discrete" if port.boolean else "continuous",
    }
    if reference == 0:
        attributes["causality"] = "independent"
    elif port.set is None:
        attributes["causality"] = "output"
    else:
        attributes["causality"] = "input"
        attributes["start"] = str(port.get()).lower()
    if port.unit:
        attributes["unit"] = port.unit
    if math.isfinite(port.low):
        attributes["min"] = str(port.low)
    if math.isfinite(port.high):
        attributes["max"] = str(port.high)
    ET.SubElement(variables, "Boolean" if port.boolean else "Float64", attributes)
