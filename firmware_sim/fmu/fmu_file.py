"""A WSP as an FMU: what the file contains and whether it fits the rig, before any of it is run.

Inputs are `wheel_speed_1` to `_4` (rad/s) and optionally `cylinder_pressure_1` to `_4` (Pa).
Outputs are `hold_1` to `_4` and `vent_1` to `_4`, and optionally `reference_speed` (m/s). A unit
that the FMU defines (bar, rpm) is converted. Other names and scales come from a mapping
(`wsp_interface.unit_map`). An FMU that has a terminal with the media type of CAN is a node of the
bus instead, and sends and receives the frames of `wsp_interface.rig_objects`.
Source: FMI 2.0.4 and 3.0.2, co-simulation; FMI-LS-BUS 1.0, bus terminal.
"""

import math
import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from rollerrig.configs import unpacking, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.configs.vehicle import AXLES_OF_GROUP
from rollerrig.firmware_sim.fmu import kinds
from rollerrig.firmware_sim.fmu.ls_bus import MEDIA_TYPE
from rollerrig.wsp_interface.unit_map import mapping

# an FMU without a mapping needs neither the inputs with this beginning nor this output
_PRESSURE = "cylinder_pressure_"
_REFERENCE = "reference_speed"

_LONGEST_REASON = 2000  # characters
_MAP = "give a mapping with --unit-map"
_DESCRIPTION = "modelDescription.xml"
_BUILD = "sources/buildDescription.xml"
_TERMINALS = "terminalsAndIcons/terminalsAndIcons.xml"


class _SiUnit(NamedTuple):
    """A unit: its exponents of kilogram, metre, second and radian.

    The radian counts: 1 rad/s is no hertz, which is 2 pi rad/s for a rotation.
    """

    name: str
    kg: int
    m: int
    s: int
    rad: int


# by the first word of a quantity
_SI_UNITS = {
    "measured": _SiUnit("rad/s", 0, 0, -1, 1),
    "cylinder": _SiUnit("Pa", 1, -1, -2, 0),
    "reference": _SiUnit("m/s", 0, 1, -1, 0),
}


def usual_names(unit_axles: int) -> mapping.FmuMap:
    """Return the variables of an FMU without a mapping, for a group of so many axles."""
    axles = range(1, unit_axles + 1)
    speeds = {f"wheel_speed_{axle}": (f"measured_speed_{axle}", 1.0) for axle in axles}
    pressures = {f"{_PRESSURE}{axle}": (f"{_PRESSURE}{axle}", 1.0) for axle in axles}
    return mapping.FmuMap(
        inputs=speeds | pressures,
        hold=tuple(f"hold_{axle}" for axle in axles),
        vent=tuple(f"vent_{axle}" for axle in axles),
        reference=_REFERENCE,
        reference_factor=1.0,
    )


class Finding(NamedTuple):
    """One result of a check.

    `name`: the checked part; `fits`: whether it fits; `found`: what the FMU has; `mend`: the remedy
    if it does not fit.
    """

    name: str
    fits: bool
    found: str
    mend: str = ""


class Port(NamedTuple):
    """A variable that is set or read. Its value is `factor` times the quantity in SI units."""

    quantity: str
    reference: int
    kind: str  # type of FMI: Float64, Boolean, ...
    factor: float


class Terminal(NamedTuple):
    """A CAN port: the references of its variables, and the description of its Tx_Clock."""

    name: str
    rx_data: int
    rx_clock: int
    tx_data: int
    tx_clock: int
    clock: str  # variability of the interval of Tx_Clock
    interval_s: float | None
    shift_s: float
    notify: int | None  # parameter with which the FMU waits for confirmations; None without
    structural: bool  # that parameter is structural


class CheckedFmu(NamedTuple):
    """An FMU that fits the rig: everything that is needed to run it."""

    path: Path
    description: Any  # ModelDescription of FMPy
    binary: str  # path in the archive
    sources: tuple[str, ...]  # to compile; empty if there is a binary for this machine
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    period_s: float  # SYNC period
    step_s: float  # internal step; 0 if the FMU takes any step
    unit_axles: int  # axles for which it has inputs and outputs
    terminal: Terminal | None = None  # its CAN port, if it has one


class _Platform(NamedTuple):
    """The binary of an FMU for this machine, and the sources to compile if it is missing."""

    binary: str
    sources: tuple[str, ...]
    finding: Finding


class _Bus(NamedTuple):
    """A terminal that is a bus. `members`: the XML attributes of its variables, by role."""

    name: str
    media_type: str
    members: dict[str, dict[str, str]]


class _Wanted(NamedTuple):
    """A variable that the FMU should have."""

    name: str
    quantity: str
    causality: str
    factor: float


class _Problem(NamedTuple):
    """What is wrong with a variable, and the remedy."""

    found: str
    mend: str


def check_all(
    paths: tuple[Path, ...],
    map_path: Path | None,
    period_s: float,
    unit_axles: int = AXLES_OF_GROUP,
) -> list[CheckedFmu]:
    """Check one FMU, or several that share the bus by their CAN ports, as `check` does.

    Raises ConfigError.
    """
    fmus = [check(path, map_path, period_s, unit_axles) for path in paths]
    if len(fmus) > 1:
        for fmu in fmus:
            if not fmu.terminal:
                raise ConfigError(
                    f"{fmu.path}: has no CAN port, so it has to be the only unit of a run; several "
                    "FMUs share the bus by terminals of FMI-LS-BUS"
                )
    return fmus


def check(
    path: Path, map_path: Path | None, period_s: float, unit_axles: int = AXLES_OF_GROUP
) -> CheckedFmu:
    """Check an FMU that is stepped once a SYNC, every `period_s`.

    `unit_axles`: the axles of the largest group of the vehicle, for which it has variables. Raises
    ConfigError with everything that does not fit.
    """
    fmu, findings = examine(path, map_path, period_s, unit_axles)
    problems = [
        f"{finding.name}: {finding.found}; {finding.mend}"
        for finding in findings
        if not finding.fits
    ]
    if problems or fmu is None:
        raise ConfigError(f"{path}: does not fit the rig:\n  " + "\n  ".join(problems))
    return fmu


def examine(
    path: Path, map_path: Path | None, period_s: float, unit_axles: int = AXLES_OF_GROUP
) -> tuple[CheckedFmu | None, list[Finding]]:
    """Return the content of an FMU, and what fits and what does not; `unit_axles` as in `check`.

    Raises ConfigError if the file cannot be read.
    """
    names = usual_names(unit_axles)
    if map_path:
        names = mapping.load_fmu_map(map_path, unit_axles)
    description, deviation = _read(path)
    simulation = description.coSimulation
    tool = f", by {description.generationTool}" if description.generationTool else ""
    findings = [
        Finding("FMU", True, f"FMI {description.fmiVersion}, {description.modelName}{tool}"),
        Finding("description", True, deviation or "conforms to the schema of the standard"),
    ]
    if not simulation:
        problem = Finding(
            name="co-simulation",
            fits=False,
            found=f"has none, only {kinds.interfaces(description)}",
            mend="export it for co-simulation, because the rig has no solver and runs no scheduler",
        )
        return None, [*findings, problem]

    platform = _platform(path, description)
    step_s, step = _step(description, period_s)
    findings += [platform.finding, step]

    inputs: tuple[Port, ...] = ()
    outputs: tuple[Port, ...] = ()
    terminal = None
    # a mapping gives the signals, so that a bus terminal is not used
    buses = _buses(path) if description.fmiMajorVersion == 3 and not map_path else []
    if buses:
        terminal, found = _terminal(buses, bool(simulation.hasEventMode))
    else:
        inputs, outputs, found = _ports(description, names, map_path is not None)
    findings += found

    fmu = CheckedFmu(
        path=path,
        description=description,
        binary=platform.binary,
        sources=platform.sources,
        inputs=inputs,
        outputs=outputs,
        period_s=period_s,
        step_s=step_s,
        unit_axles=unit_axles,
        terminal=terminal,
    )
    return fmu, findings


# -- the file


def library() -> Any:
    """Return FMPy. Raises ConfigError if it is not installed."""
    try:
        import fmpy
    except ImportError:
        raise ConfigError("FMUs need the extra: pip install 'rollerrig[fmu]'") from None
    return fmpy


def description_of(path: Path) -> Any:
    """Return FMPy's description of an FMU. Raises ConfigError if the file is unreadable."""
    description, _ = _read(path)
    return description


def _read(path: Path) -> tuple[Any, str]:
    """Return the model description, and how it deviates from the standard ("" if it does not).

    Raises ConfigError if it cannot be read.
    """
    fmpy = library()
    _check_archive(path)
    version = _fmi_version(path)
    if not version.startswith(("2.", "3.")):
        raise ConfigError(
            f"{path}: is an FMU of FMI {version or 'no version'}; export it for FMI 2.0 or 3.0, "
            "co-simulation"
        )
    try:
        return fmpy.read_model_description(path), ""
    except Exception as error:  # of many kinds, also plain ones
        # the list of all deviations from the schema can be as long as the file
        reason = " ".join(str(error)[:_LONGEST_REASON].split())
    # an FMU that does not conform to the standard is used all the same, if FMPy can read it
    try:
        description = fmpy.read_model_description(path, validate=False)
    except Exception:
        raise ConfigError(
            f"{path}: {_DESCRIPTION} cannot be read: {reason}; export it again"
        ) from None
    return description, f"does not conform to the standard: {reason}"


def _fmi_version(path: Path) -> str:
    """Return the FMI version of a file. Raises ConfigError if it is not an FMU."""
    try:
        with zipfile.ZipFile(path) as archive:
            model = ElementTree.fromstring(unpacking.read_xml(archive, _DESCRIPTION, str(path)))
    except KeyError:
        raise ConfigError(f"{path}: {_without_description(path)}") from None
    return model.get("fmiVersion", "")


def _without_description(path: Path) -> str:
    """Return what is wrong with an archive whose top folder has no description, and the remedy."""
    with zipfile.ZipFile(path) as archive:
        elsewhere = [name for name in archive.namelist() if name.endswith(f"/{_DESCRIPTION}")]
    if not elsewhere:
        return f"is not an FMU: it contains no {_DESCRIPTION}; export it again"
    folder = elsewhere[0].removesuffix(_DESCRIPTION)
    return (
        f"contains {elsewhere[0]}, and an FMU has {_DESCRIPTION} at its top; pack the content of "
        f"{folder} without this folder in the names: zip -r FILE.fmu *, inside the unpacked {folder}"
    )


def _check_archive(path: Path) -> None:
    """Raise ConfigError unless a file is an archive that may be unpacked and parsed."""
    user_files.check(path, user_files.FMU)
    try:
        unpacking.check_archive(path)
        with zipfile.ZipFile(path) as archive:
            # FMPy parses these, too
            for name in (_DESCRIPTION, _BUILD, _TERMINALS):
                if name in archive.namelist():
                    unpacking.read_xml(archive, name, str(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None
    except zipfile.BadZipFile:
        raise ConfigError(
            f"{path}: is not an FMU, which is a ZIP archive; export it again"
        ) from None


def _platform(path: Path, description: Any) -> _Platform:
    """Return the binary for this machine, or the sources to compile, and a finding."""
    fmpy = library()
    here = fmpy.platform if description.fmiMajorVersion == 2 else fmpy.platform_tuple
    identifier = description.coSimulation.modelIdentifier
    binary = f"binaries/{here}/{identifier}{fmpy.sharedLibraryExtension}"

    with zipfile.ZipFile(path) as archive:
        files = archive.namelist()
    platforms = set()
    for name in files:
        parts = name.split("/")
        if parts[0] == "binaries" and len(parts) > 2:
            platforms.add(parts[1])
    sources = _sources(description, files)
    found = f"binaries for {', '.join(sorted(platforms)) or 'no platform'}"
    if sources:
        found += ", sources"

    if binary in files:
        return _Platform(binary, (), Finding("platform", True, found))
    if sources and shutil.which("cc"):
        compiled = f"{found}: will be compiled for {here}"
        return _Platform(binary, sources, Finding("platform", True, compiled))
    export = f"export it for {here}, or with its sources"
    mend = "install a C compiler (cc)" if sources else export
    missing = f"{found}, none for this machine ({here}: {binary})"
    return _Platform(binary, sources, Finding("platform", False, missing, mend))


def _sources(description: Any, files: list[str]) -> tuple[str, ...]:
    """Return the source files of the description that the archive contains."""
    sources = []
    for configuration in description.buildConfigurations:
        for file_set in configuration.sourceFileSets:
            for name in file_set.sourceFiles:
                if f"sources/{name}" in files:
                    sources.append(name)
    return tuple(sources)


def _step(description: Any, period_s: float) -> tuple[float, Finding]:
    """Return the internal step of the FMU (0 if it takes any), and whether the SYNC period fits it.

    The SYNC period has to be a whole number of steps.
    """
    simulation = description.coSimulation
    step_s = float(simulation.fixedInternalStepSize or 0.0)
    takes_any = simulation.canHandleVariableCommunicationStepSize
    if not step_s and not takes_any and description.defaultExperiment:
        step_s = float(description.defaultExperiment.stepSize or 0.0)
    if not step_s:
        return 0.0, Finding("step", True, f"any; {period_s:g} s a SYNC")

    steps = period_s / step_s
    fits = round(steps) >= 1 and abs(steps - round(steps)) < 1e-6
    finding = Finding(
        name="step",
        fits=fits,
        found=f"its internal steps take {step_s:g} s, and one doStep a SYNC takes {period_s:g} s "
        "(bus.sync_period_s)",
        mend=f"export it with a step of which {period_s:g} s is a multiple, or set "
        f"bus.sync_period_s to a multiple of {step_s:g} s",
    )
    return step_s, finding


# -- an FMU with a CAN port


def _buses(path: Path) -> list[_Bus]:
    """Return the terminals that are a bus. Raises ConfigError if the XML cannot be read."""
    with zipfile.ZipFile(path) as archive:
        if _TERMINALS not in archive.namelist():
            return []
        terminals = ElementTree.fromstring(unpacking.read_xml(archive, _TERMINALS, str(path)))
        model = ElementTree.fromstring(unpacking.read_xml(archive, _DESCRIPTION, str(path)))

    variables: dict[str, dict[str, str]] = {}
    for group in model.iter("ModelVariables"):
        for variable in group:
            variables[variable.get("name", "")] = variable.attrib

    buses = []
    for terminal in terminals.iter("Terminal"):
        members = {}
        media_types = []
        for member in terminal.iter("TerminalMemberVariable"):
            variable_name = member.get("variableName", "")
            if variable_name in variables:
                members[member.get("memberName", "")] = variables[variable_name]
        for attributes in members.values():
            media_type = attributes.get("mimeType", "")
            if media_type.startswith(MEDIA_TYPE):
                media_types.append(media_type.removeprefix(MEDIA_TYPE))
        if media_types:
            buses.append(_Bus(terminal.get("name", ""), media_types[0], members))
    return buses


# the members of a bus terminal, and what causality each may have
_MEMBERS = {
    "Rx_Data": ("input",),
    "Rx_Clock": ("input",),
    "Tx_Data": ("output",),
    "Tx_Clock": ("input", "output"),
}
# the media type of CAN, of major version 1 or without a version
_CAN = re.compile(r'can\s*(;\s*version="?1\.|$)')


def _terminal(buses: list[_Bus], has_event_mode: bool) -> tuple[Terminal | None, list[Finding]]:
    """Return the CAN port of an FMU (None if it does not fit), and the findings about it."""
    can_buses = [bus for bus in buses if _CAN.match(bus.media_type)]
    bus = (can_buses or buses)[0]
    findings = [
        Finding(
            name=f"terminal {bus.name}",
            fits=bool(can_buses),
            found=f"FMI-LS-BUS, {bus.media_type}",
            mend="the bus of the rig is CAN: export it with a terminal of the media type "
            'fmi-ls-bus.can; version="1.0.0"',
        )
    ]
    if not has_event_mode:
        findings.append(
            Finding(
                name="event mode",
                fits=False,
                found="hasEventMode is false",
                mend="export it with event mode, because clocks transfer the frames",
            )
        )
    findings += _member_problems(bus)
    others = [other.name for other in buses if other.name != bus.name]
    if others:
        findings.append(
            Finding("other terminals", True, f"{', '.join(others)}: are not connected to a bus")
        )
    if not all(finding.fits for finding in findings):
        return None, findings

    clock = bus.members["Tx_Clock"]
    interval_s = clock.get("intervalDecimal")
    variability = clock.get("intervalVariability", "triggered")
    tx_clock = f"{variability}, every {interval_s} s" if interval_s else variability
    findings.append(Finding("Tx_Clock", True, tx_clock))

    notify = bus.members.get("BusNotifications", {})
    terminal = Terminal(
        name=bus.name,
        rx_data=int(bus.members["Rx_Data"]["valueReference"]),
        rx_clock=int(bus.members["Rx_Clock"]["valueReference"]),
        tx_data=int(bus.members["Tx_Data"]["valueReference"]),
        tx_clock=int(clock["valueReference"]),
        clock=variability,
        interval_s=float(interval_s) if interval_s else None,
        shift_s=float(clock.get("shiftDecimal", 0.0)),
        notify=int(notify["valueReference"]) if notify else None,
        structural=notify.get("causality") == "structuralParameter",
    )
    return terminal, findings


def _member_problems(bus: _Bus) -> Iterator[Finding]:
    """Yield a finding for each member of a bus terminal that is missing or wrongly declared."""
    for role, causalities in _MEMBERS.items():
        attributes = bus.members.get(role)
        if attributes is None:
            found = "is missing"
        elif attributes.get("causality") not in causalities:
            found = f"is declared as {attributes.get('causality')}"
        else:
            continue
        yield Finding(
            name=f"{bus.name} {role}",
            fits=False,
            found=found,
            mend=f"a bus terminal has {', '.join(_MEMBERS)}, and {role} is an "
            f"{' or '.join(causalities)}",
        )


# -- an FMU with signals


def _ports(
    description: Any, names: mapping.FmuMap, mapped: bool
) -> tuple[tuple[Port, ...], tuple[Port, ...], list[Finding]]:
    """Return the inputs, the outputs, and one finding for each variable.

    `mapped`: the names come from a mapping, which also gives the scales.
    """
    variables = kinds.by_name(description)
    inputs: list[Port] = []
    outputs: list[Port] = []
    findings: list[Finding] = []
    all_wanted = list(_wanted(names))
    for wanted in all_wanted:
        variable = variables.get(wanted.name)
        if variable is None:
            findings.append(_missing(description, wanted, mapped))
            continue
        port, finding = _port(description, variable, wanted, mapped)
        ports = inputs if wanted.causality == "input" else outputs
        ports.append(port)
        findings.append(finding)

    used_names = {wanted.name for wanted in all_wanted}
    aliases = [
        f"{name} is an alias of {original}" for name, original in _aliases(description, used_names)
    ]
    if aliases:
        findings.append(Finding("aliases", True, ", ".join(aliases)))
    used_names |= {original for _, original in _aliases(description, used_names)}
    if not all(finding.fits for finding in findings):
        for name, kind in kinds.unfit_variables(description):
            if name not in used_names:
                findings.append(Finding(name, True, f"{kind}, which the rig does not exchange"))
    unused = [
        variable.name
        for variable in description.modelVariables
        if variable.causality == "input" and variable.name not in used_names
    ]
    if unused:
        findings.append(
            Finding("other inputs", True, f"{', '.join(unused)}: keep their start values")
        )
    return tuple(inputs), tuple(outputs), findings


def _aliases(description: Any, names: set[str]) -> list[tuple[str, str]]:
    """Return the names that are aliases, each with the variable that has the value."""
    found = [(name, kinds.is_alias(description, name)) for name in sorted(names)]
    return [(name, original) for name, original in found if original]


def _wanted(names: mapping.FmuMap) -> Iterator[_Wanted]:
    """Yield the variables that the FMU should have, inputs first."""
    for name, (quantity, factor) in names.inputs.items():
        yield _Wanted(name, quantity, "input", factor)
    for axle, (hold, vent) in enumerate(zip(names.hold, names.vent, strict=True), start=1):
        yield _Wanted(hold, f"hold_{axle}", "output", 1.0)
        yield _Wanted(vent, f"vent_{axle}", "output", 1.0)
    if names.reference:
        yield _Wanted(names.reference, "reference_speed", "output", 1.0 / names.reference_factor)


def _missing(description: Any, wanted: _Wanted, mapped: bool) -> Finding:
    """Return the finding about a variable that the FMU does not have."""
    dispensable = wanted.name.startswith(_PRESSURE) or wanted.name == _REFERENCE
    optional = not mapped and dispensable
    others = [
        variable.name
        for variable in description.modelVariables
        if variable.causality == wanted.causality
    ]
    return Finding(
        name=wanted.name,
        fits=optional,
        found="is missing, and is not needed" if optional else "is missing",
        mend=f"{_MAP} if it has another name{nearest(wanted.name, others)}; 'rollerrig check FMU "
        "--write-map map.toml' writes one to fill in",
    )


def _port(description: Any, variable: Any, wanted: _Wanted, mapped: bool) -> tuple[Port, Finding]:
    """Return the port of a variable, and the finding about it."""
    problem = _wrong_declaration(description, variable, wanted.causality)
    factor = 1.0
    is_magnet = wanted.quantity.startswith(("hold", "vent"))
    if mapped:
        factor = wanted.factor
    elif not is_magnet:
        unit_factor = _unit_factor(description, variable, wanted.quantity)
        if isinstance(unit_factor, float):
            factor = unit_factor
        elif problem is None:
            problem = unit_factor

    port = Port(wanted.quantity, variable.valueReference, variable.type, factor)
    if problem:
        return port, Finding(wanted.name, False, problem.found, problem.mend)
    times = "" if factor == 1.0 else f"{factor:g} times "
    found = f"{wanted.causality}, {variable.type}: {times}{wanted.quantity}"
    return port, Finding(wanted.name, True, found)


def _wrong_declaration(description: Any, variable: Any, causality: str) -> _Problem | None:
    """Return what is wrong with the declaration of a variable, apart from its unit."""
    kind = kinds.unfit_kind(description, variable)
    if kind:
        return _Problem(
            f"is {kind}", "allowed are single numbers and Booleans: one variable for each axle"
        )
    if variable.causality != causality:
        return _Problem(
            f"is declared as {variable.causality}",
            f"declare it as an {causality}, or {_MAP} that gives another variable",
        )
    if variable.variability not in (None, "continuous", "discrete"):
        return _Problem(
            f"has the variability {variable.variability}",
            "allowed are continuous and discrete",
        )
    return None


def _unit_factor(description: Any, variable: Any, quantity: str) -> float | _Problem:
    """Return the value of one SI unit in the unit of a variable, or what is wrong with that
    unit.
    """
    unit = variable.unit
    if not unit:
        unit = variable.declaredType.unit if variable.declaredType else None
    si_unit = _SI_UNITS[quantity.partition("_")[0]]

    base = None
    for definition in description.unitDefinitions:
        if definition.name == unit:
            base = definition.baseUnit
            break

    if base is not None and _has_dimension(base, si_unit):
        if base.offset:
            return _Problem(
                f"has the unit {unit} with an offset", f"use one without, such as {si_unit.name}"
            )
        return 1.0 / float(base.factor)
    if unit is None or (unit == si_unit.name and base is None):
        return 1.0
    if base is not None and quantity.startswith("measured") and _is_per_second(base):
        return _Problem(
            f"has the unit {unit}, which is 1/s without an angle, such as turns in a second",
            f"declare rad/s, or {_MAP}: factor = {1.0 / math.tau:.6g} for turns in a second, "
            "factor = 1 where the radian was left out",
        )
    problem = "which is not a unit of this quantity" if base else "which it does not define"
    radius = " (for m/s the wheel radius in m)" if quantity.startswith("measured") else ""
    return _Problem(
        f"has the unit {unit}, {problem}",
        f"declare {si_unit.name}, or {_MAP} and its factor{radius}",
    )


def _is_per_second(base: Any) -> bool:
    """Return whether a base unit is that of a frequency."""
    return _has_dimension(base, _SiUnit("Hz", 0, 0, -1, 0))


def _has_dimension(base: Any, si_unit: _SiUnit) -> bool:
    """Return whether the base unit of a definition has the dimension of an SI unit."""
    exponents = (base.kg, base.m, base.s, base.rad)
    same = exponents == (si_unit.kg, si_unit.m, si_unit.s, si_unit.rad)
    return same and not any((base.A, base.K, base.mol, base.cd))
