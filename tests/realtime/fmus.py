"""FMUs for the tests, written and compiled here: rules of an earlier reference WSP in C, for FMI 2
and 3.
"""

import functools
import subprocess
import tempfile
import zipfile
from pathlib import Path
from xml.sax.saxutils import quoteattr

import fmpy
from fmpy import fmi2, fmi3

from rollerrig.firmware_sim.wsp import logic, phases
from rollerrig.firmware_sim.wsp.reference_speed import SPEED_SCALE_RAD_S

SOURCE = Path(__file__).parent / "fmu" / "wsp.c"
HEADERS = Path(fmpy.__file__).parent / "c-code"
UNITS = {
    "rad/s": 'rad="1" s="-1"',
    "rpm": 's="-1" rad="1" factor="0.10471975511965977"',
    "Pa": 'kg="1" m="-1" s="-2"',
    "bar": 'kg="1" m="-1" s="-2" factor="100000"',
    "m/s": 'm="1" s="-1"',
}
INPUTS = {
    **{f"wheel_speed_{axle}": "rad/s" for axle in range(1, 5)},
    **{f"cylinder_pressure_{axle}": "Pa" for axle in range(1, 5)},
}
VALVES = (*(f"hold_{axle}" for axle in range(1, 5)), *(f"vent_{axle}" for axle in range(1, 5)))


def build(
    folder,
    version=3,
    name="wsp",
    defines=(),
    binary=True,
    sources=False,
    edit=lambda xml: xml,
    inputs=None,
    files=None,
):
    """An FMU. `edit` changes its description; `inputs`: other names and units of its inputs, in
    their order.

    `files`: what the archive holds besides, its description perhaps among it.
    """
    folder = Path(folder) / name
    folder.mkdir(parents=True)
    _parameters(folder / "parameters.h")
    _stubs(folder / "stubs.c", version)
    files = {
        "modelDescription.xml": edit(description(version, name, inputs or INPUTS, sources)),
        **(files or {}),
    }
    if binary:
        platform = "linux64" if version == 2 else fmpy.platform_tuple
        files[f"binaries/{platform}/{name}.so"] = _library(version, tuple(defines))
    if sources:
        # FMI 3: prefixed functions, for tools that link several FMUs into one
        header = "#define FMI2\n" if version == 2 else f"#define FMI3_FUNCTION_PREFIX {name}_\n"
        files |= {
            "sources/wsp.c": header + SOURCE.read_text(),
            "sources/stubs.c": (folder / "stubs.c").read_text(),
            "sources/parameters.h": (folder / "parameters.h").read_text(),
        }
        if version == 3:
            files["sources/buildDescription.xml"] = (
                f'<fmiBuildDescription fmiVersion="3.0"><BuildConfiguration modelIdentifier="{name}"><SourceFileSet>'
                '<SourceFile name="wsp.c"/><SourceFile name="stubs.c"/></SourceFileSet></BuildConfiguration>'
                "</fmiBuildDescription>"
            )
    path = folder.with_suffix(".fmu")
    with zipfile.ZipFile(path, "w") as archive:
        for place, content in files.items():
            archive.writestr(place, content)
    return path


@functools.cache
def _library(version, defines):
    """Return the compiled library with these defines; each is compiled once."""
    defined = [*(["-DFMI2"] if version == 2 else []), *(f"-D{one}" for one in defines)]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        _parameters(folder / "parameters.h")
        _stubs(folder / "stubs.c", version)
        options = ["-shared", "-fPIC", "-O1", "-ffp-contract=off", *defined]
        options += [f"-I{folder}", f"-I{HEADERS}"]
        files = ["-o", folder / "wsp.so", SOURCE, folder / "stubs.c", "-lm"]
        subprocess.run(["gcc", *options, *files], check=True)
        return (folder / "wsp.so").read_bytes()


def build_can(
    folder, name="wsp", clock="triggered", defines=(), notifications=True, edit=lambda xml: xml
):
    """An FMU that is a CAN node.

    `clock`: the variability of its Tx_Clock; `edit` changes both of its descriptions.
    """
    defines = ["LS_BUS", *(["COUNTDOWN"] if clock == "countdown" else []), *defines]
    files = {
        "modelDescription.xml": edit(
            CAN_DESCRIPTION.format(
                name=name,
                clock=f'causality="{"output" if clock == "triggered" else "input"}" intervalVariability="{clock}"',
                exposed=CAN_NOTIFICATIONS if notifications else "",
            )
        )
    }
    files["terminalsAndIcons/terminalsAndIcons.xml"] = edit(
        '<fmiTerminalsAndIcons fmiVersion="3.0"><Terminals><Terminal name="Can0" '
        'terminalKind="org.fmi-ls-bus.network-terminal" matchingRule="org.fmi-ls-bus.transceiver">'
        + "".join(
            f'<TerminalMemberVariable variableKind="signal" variableName="Can0.{one}" memberName="{one}"/>'
            for one in ("Rx_Data", "Rx_Clock", "Tx_Data", "Tx_Clock")
        )
        + '<Terminal name="Configuration" terminalKind="org.fmi-ls-bus.network-terminal.configuration" '
        'matchingRule="bus"><TerminalMemberVariable variableKind="signal" variableName="Can0.BusNotifications" '
        'memberName="BusNotifications"/></Terminal></Terminal></Terminals></fmiTerminalsAndIcons>'
    )
    return build(folder, name=name, defines=defines, files=files)


CAN_MEDIA = 'mimeType="application/org.fmi-standard.fmi-ls-bus.can; version=&quot;1.0.0&quot;"'
CAN_NOTIFICATIONS = (
    '<Boolean name="Can0.BusNotifications" valueReference="5" causality="parameter" '
    'variability="fixed" start="false"/>'
)
CAN_DESCRIPTION = (
    '<?xml version="1.0"?><fmiModelDescription fmiVersion="3.0" modelName="{name}" instantiationToken="g">'
    '<CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true" hasEventMode="true"/>'
    '<ModelVariables><Float64 name="time" valueReference="99" causality="independent"/>'
    f'<Binary name="Can0.Rx_Data" valueReference="1" causality="input" variability="discrete" clocks="2" {CAN_MEDIA}>'
    '<Start value=""/></Binary>'
    '<Clock name="Can0.Rx_Clock" valueReference="2" causality="input" intervalVariability="triggered"/>'
    f'<Binary name="Can0.Tx_Data" valueReference="3" causality="output" variability="discrete" clocks="4" {CAN_MEDIA}/>'
    '<Clock name="Can0.Tx_Clock" valueReference="4" {clock}/>{exposed}</ModelVariables>'
    '<ModelStructure><Output valueReference="3"/></ModelStructure></fmiModelDescription>'
)


def description(version, name, inputs, sources=False):
    """modelDescription.xml of an FMI version; 1 is one that nobody here can run."""
    rows = [(one, at, "input", "continuous", unit) for at, (one, unit) in enumerate(inputs.items())]
    rows += [(one, 8 + at, "output", "discrete", None) for at, one in enumerate(VALVES)]
    rows += [("reference_speed", 16, "output", "discrete", "m/s")]
    units = "".join(
        f"<Unit name={quoteattr(one)}><BaseUnit {base}/></Unit>" for one, base in UNITS.items()
    )
    outputs = range(9, 18) if version == 2 else range(8, 17)
    if version == 2:
        variables = "".join(
            f'<ScalarVariable name="{one}" valueReference="{vr}" causality="{causality}" variability="{variability}">'
            + (
                "<Boolean/>"
                if unit is None
                else f'<Real unit="{unit}"' + (' start="0"/>' if causality == "input" else "/>")
            )
            + "</ScalarVariable>"
            for one, vr, causality, variability, unit in rows
        )
        files = (
            '<SourceFiles><File name="wsp.c"/><File name="stubs.c"/></SourceFiles>'
            if sources
            else ""
        )
        kind = (
            f'<CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true">{files}'
            "</CoSimulation>"
        )
        structure = "".join(f'<Unknown index="{at}"/>' for at in outputs)
        return (
            f'<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{{g}}">{kind}'
            f"<UnitDefinitions>{units}</UnitDefinitions><ModelVariables>{variables}</ModelVariables>"
            f"<ModelStructure><Outputs>{structure}</Outputs>"
            f"<InitialUnknowns>{structure}</InitialUnknowns></ModelStructure></fmiModelDescription>"
        )
    variables = "".join(
        ("<Boolean" if unit is None else f'<Float64 unit="{unit}"')
        + f' name="{one}" valueReference="{vr}" causality="{causality}" variability="{variability}"'
        + (' start="0"/>' if causality == "input" else "/>")
        for one, vr, causality, variability, unit in rows
    )
    variables = '<Float64 name="time" valueReference="99" causality="independent"/>' + variables
    structure = "".join(
        f'<{kind} valueReference="{at}"/>'
        for kind in ("Output", "InitialUnknown")
        for at in outputs
    )
    return (
        f'<?xml version="1.0"?><fmiModelDescription fmiVersion="3.0" modelName="{name}" instantiationToken="g">'
        f'<CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true"/>'
        f"<UnitDefinitions>{units}</UnitDefinitions><ModelVariables>{variables}</ModelVariables>"
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


def _parameters(path):
    """The thresholds and tables of the present reference WSP as C."""
    params = logic.load()
    lines = [
        f"#define SPEED_SCALE {SPEED_SCALE_RAD_S!r}",
        f"static const double DIAMETER[] = {{{', '.join(map(repr, params.wheel_diameter_m))}}};",
    ]
    lines += [
        f"#define {name.upper()} {value!r}"
        for name, value in params._asdict().items()
        if name != "wheel_diameter_m"
    ]
    for name in ("WISHES", "NEXT", "INTERRUPTS", "MAGNETS"):
        table = getattr(phases, name)
        rows = ", ".join("{" + ", ".join(str(int(one)) for one in row) + "}" for row in table)
        lines.append(f"static const int {name}[{table.shape[0]}][{table.shape[1]}] = {{{rows}}};")
    path.write_text("\n".join(lines) + "\n")


def _stubs(path, version):
    """The functions of the standard that wsp.c has no use for, which a library has to export all
    the same.
    """
    kind = fmi2.FMU2Slave if version == 2 else fmi3.FMU3Slave
    path.write_text(
        "".join(
            f"__attribute__((weak)) int {name}(void) {{ return 3; }}\n"
            for name in dir(kind)
            if name.startswith(f"fmi{version}")
        )
    )
