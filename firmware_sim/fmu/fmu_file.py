"""A WSP as an FMU: what the file holds and whether it fits the rig, asked before anything of it is run.

Inputs `wheel_speed_1` to `_4` (rad/s) and, where it has them, `cylinder_pressure_1` to `_4` (Pa); outputs `hold_1` to
`_4` and `vent_1` to `_4`, and where it tells it `reference_speed` (m/s). A unit that the FMU defines otherwise (bar,
rpm) is converted; other names and scales come from a mapping (`wsp_interface.sequences.mapping`). An FMU that has a
terminal with the media type of CAN is a node of the bus instead, and speaks as `wsp_interface.rig_objects` says.
Source: FMI 2.0.4 and 3.0.2, co-simulation; FMI-LS-BUS 1.0, bus terminal.
"""

import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.firmware_sim.fmu.ls_bus import MEDIA_TYPE
from rollerrig.wsp_interface import unit_map
from rollerrig.wsp_interface.signals import AXLES

_AXLES = range(1, AXLES + 1)
NAMES = unit_map.FmuMap(
    {
        **{f"wheel_speed_{axle}": (f"measured_speed_{axle}", 1.0) for axle in _AXLES},
        **{f"cylinder_pressure_{axle}": (f"cylinder_pressure_{axle}", 1.0) for axle in _AXLES},
    },
    tuple(f"hold_{axle}" for axle in _AXLES),
    tuple(f"vent_{axle}" for axle in _AXLES),
    "reference_speed",
    1.0,
)
# an FMU without a mapping may do without these
_OPTIONAL = (*(name for name in NAMES.inputs if name.startswith("cylinder")), NAMES.reference)
# base units (kg, m, s) and name of what the rig tells and hears; angles have none
_SI = {
    "measured": ((0, 0, -1), "rad/s"),
    "cylinder": ((1, -1, -2), "Pa"),
    "reference": ((0, 1, -1), "m/s"),
}
_MAP = "give a mapping with --unit-map"


class Finding(NamedTuple):
    """One answer: what was looked at, whether it fits, what was found, and how to mend what does not fit."""

    name: str
    fits: bool
    found: str
    mend: str = ""


class Port(NamedTuple):
    """A variable that is set or read: `factor` times the quantity, in SI, is its value."""

    quantity: str
    reference: int
    kind: str
    factor: float


class Terminal(NamedTuple):
    """A CAN port: references of its variables. `clock`: the variability of the interval of its Tx_Clock.

    `interval_s` and `shift_s` are what the description says of that clock; `notify` the parameter that lets the FMU
    wait for confirmations, None where it has none.
    """

    name: str
    rx_data: int
    rx_clock: int
    tx_data: int
    tx_clock: int
    clock: str
    interval_s: float | None
    shift_s: float
    notify: int | None
    structural: bool


class Fitted(NamedTuple):
    """An FMU that fits: what is needed to run it. `sources` is empty where it has a binary for this machine.

    `step_s`: its own step, 0 where it takes any; `terminal`: its CAN port, where it has one.
    """

    path: Path
    description: Any
    binary: str
    sources: tuple[str, ...]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    period_s: float
    step_s: float
    terminal: Terminal | None = None


def fit_all(paths: tuple[Path, ...], map_path: Path | None, period_s: float) -> list[Fitted]:
    """One FMU, or several that share the bus by their CAN ports. Raises ConfigError."""
    fitted = [fit(path, map_path, period_s) for path in paths]
    lone = next((one for one in fitted if not one.terminal), None)
    if len(fitted) > 1 and lone:
        raise ConfigError(
            f"{lone.path}: has no CAN port, so it has to be the only unit of a run; several FMUs "
            "share the bus by terminals of FMI-LS-BUS"
        )
    return fitted


def fit(path: Path, map_path: Path | None, period_s: float) -> Fitted:
    """An FMU that is stepped once a SYNC, every `period_s`. Raises ConfigError with all that does not fit."""
    fitted, findings = look(path, map_path, period_s)
    wrong = [f"{one.name}: {one.found}; {one.mend}" for one in findings if not one.fits]
    if wrong or fitted is None:
        raise ConfigError(f"{path}: does not fit the rig:\n  " + "\n  ".join(wrong))
    return fitted


def look(path: Path, map_path: Path | None, period_s: float) -> tuple[Fitted | None, list[Finding]]:
    """What an FMU holds, and whether it fits. Raises ConfigError where it cannot be read at all."""
    names = unit_map.load_fmu_map(map_path) if map_path else NAMES
    description, strict = _read(path)
    tool = f", by {description.generationTool}" if description.generationTool else ""
    findings = [
        Finding("FMU", True, f"FMI {description.fmiVersion}, {description.modelName}{tool}"),
        Finding("description", True, strict or "holds to the standard's schema"),
    ]
    if not description.coSimulation:
        return None, [
            *findings,
            Finding(
                "co-simulation",
                False,
                "has none, only model exchange",
                "export it for co-simulation: the rig brings no solver",
            ),
        ]
    binary, sources, platforms = _platforms(path, description)
    step_s, step = _step(description, period_s)
    findings += [platforms, step]
    if description.fmiMajorVersion == 3 and not map_path and (buses := _buses(path)):
        terminal, found = _terminal(buses, bool(description.coSimulation.hasEventMode))
        return Fitted(
            path, description, binary, sources, (), (), period_s, step_s, terminal
        ), findings + found
    ports, found = _ports(description, names, map_path is not None)
    findings += found
    count = len(names.inputs)
    inputs = tuple(port for port in ports[:count] if port)
    outputs = tuple(port for port in ports[count:] if port)
    return Fitted(path, description, binary, sources, inputs, outputs, period_s, step_s), findings


def library() -> Any:
    """FMPy. Raises ConfigError where it is not installed."""
    try:
        import fmpy
    except ImportError:
        raise ConfigError("FMUs need the extra: pip install 'rollerrig[fmu]'") from None
    return fmpy


def _read(path: Path) -> tuple[Any, str]:
    """The model description, and what of it does not hold to the standard."""
    fmpy = library()
    try:
        with zipfile.ZipFile(path) as file:
            version = ElementTree.fromstring(file.read("modelDescription.xml")).get(
                "fmiVersion", ""
            )
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None
    except zipfile.BadZipFile:
        raise ConfigError(f"{path}: is no FMU, which is a ZIP archive; export it again") from None
    except KeyError:
        raise ConfigError(
            f"{path}: is no FMU: it holds no modelDescription.xml; export it again"
        ) from None
    except ElementTree.ParseError as error:
        raise ConfigError(
            f"{path}: modelDescription.xml cannot be read: {error}; export it again"
        ) from None
    if not version.startswith(("2.", "3.")):
        raise ConfigError(
            f"{path}: is an FMU of FMI {version or 'no version'}; export it for FMI 2.0 or 3.0, "
            "co-simulation"
        )
    try:
        return fmpy.read_model_description(path), ""
    except Exception as error:  # of many kinds, also plain ones; what can be used all the same, is
        said = " ".join(str(error).split())
        try:
            return fmpy.read_model_description(
                path, validate=False
            ), f"does not hold to the standard: {said}"
        except Exception:
            raise ConfigError(
                f"{path}: modelDescription.xml cannot be read: {said}; export it again"
            ) from None


def _platforms(path: Path, description: Any) -> tuple[str, tuple[str, ...], Finding]:
    """Where its binary stands, the sources to compile where there is none for this machine, and a finding."""
    fmpy = library()
    here = fmpy.platform if description.fmiMajorVersion == 2 else fmpy.platform_tuple
    binary = (
        f"binaries/{here}/{description.coSimulation.modelIdentifier}{fmpy.sharedLibraryExtension}"
    )
    with zipfile.ZipFile(path) as file:
        held = file.namelist()
    platforms = sorted(
        {
            name.split("/")[1]
            for name in held
            if name.startswith("binaries/") and name.count("/") > 1
        }
    )
    sources = tuple(
        name
        for one in description.buildConfigurations
        for files in one.sourceFileSets
        for name in files.sourceFiles
        if f"sources/{name}" in held
    )
    told = f"binaries for {', '.join(platforms) or 'no platform'}" + (
        ", sources" if sources else ""
    )
    if binary in held:
        return binary, (), Finding("platform", True, told)
    if sources and shutil.which("cc"):
        return binary, sources, Finding("platform", True, f"{told}: will be compiled for {here}")
    mend = (
        "install a C compiler (cc)"
        if sources
        else f"have it exported for {here}, or with its sources"
    )
    return (
        binary,
        sources,
        Finding("platform", False, f"{told}, none for this machine ({here}: {binary})", mend),
    )


def _step(description: Any, period_s: float) -> tuple[float, Finding]:
    """The FMU's own step, 0 where it takes any, and whether a cycle of the bus is a whole number of them."""
    own = description.coSimulation
    step_s = float(own.fixedInternalStepSize or 0.0)
    if (
        not step_s
        and not own.canHandleVariableCommunicationStepSize
        and description.defaultExperiment
    ):
        step_s = float(description.defaultExperiment.stepSize or 0.0)
    if not step_s:
        return 0.0, Finding("step", True, f"any; {period_s:g} s a SYNC")
    steps = period_s / step_s
    fits = round(steps) >= 1 and abs(steps - round(steps)) < 1e-6
    return step_s, Finding(
        "step",
        fits,
        f"its own steps take {step_s:g} s, and one doStep a SYNC takes {period_s:g} s "
        f"(bus.sync_period_s)",
        f"export it with a step of which {period_s:g} s is a multiple, or "
        f"set bus.sync_period_s to a multiple of {step_s:g} s",
    )


def _buses(path: Path) -> list[tuple[str, str, dict[str, Any]]]:
    """Name, media type and members of the terminals that are a bus; members by role, with the attributes of each."""
    place = "terminalsAndIcons/terminalsAndIcons.xml"
    try:
        with zipfile.ZipFile(path) as file:
            if place not in file.namelist():
                return []
            terminals, model = (
                ElementTree.fromstring(file.read(one)) for one in (place, "modelDescription.xml")
            )
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path}: {place} cannot be read: {error}; export it again") from None
    variables = {
        one.get("name"): one.attrib for each in model.iter("ModelVariables") for one in each
    }
    buses = []
    for terminal in terminals.iter("Terminal"):
        members = {
            one.get("memberName", ""): variables[one.get("variableName")]
            for one in terminal.iter("TerminalMemberVariable")
            if one.get("variableName") in variables
        }
        media = [
            one["mimeType"].removeprefix(MEDIA_TYPE)
            for one in members.values()
            if one.get("mimeType", "").startswith(MEDIA_TYPE)
        ]
        if media:
            buses.append((terminal.get("name", ""), media[0], members))
    return buses


_MEMBERS = {
    "Rx_Data": ("input",),
    "Rx_Clock": ("input",),
    "Tx_Data": ("output",),
    "Tx_Clock": ("input", "output"),
}


def _terminal(
    buses: list[tuple[str, str, dict[str, Any]]], events: bool
) -> tuple[Terminal | None, list[Finding]]:
    """The CAN port of an FMU, and what was found of it."""
    can = [one for one in buses if re.match(r'can\s*(;\s*version="?1\.|$)', one[1])]
    name, media, members = (can or buses)[0]
    others = [one[0] for one in buses if one[0] != name]
    findings = [
        Finding(
            f"terminal {name}",
            bool(can),
            f"FMI-LS-BUS, {media}",
            "the rig's bus is CAN: "
            'export it with a terminal of the media type fmi-ls-bus.can; version="1.0.0"',
        )
    ]
    if not events:
        findings.append(
            Finding(
                "event mode",
                False,
                "hasEventMode is false",
                "frames go by clocks, and these need it: export it with event mode",
            )
        )
    for role, causalities in _MEMBERS.items():
        one = members.get(role)
        if one is None or one.get("causality") not in causalities:
            found = "is not there" if one is None else f"is declared as {one.get('causality')}"
            findings.append(
                Finding(
                    f"{name} {role}",
                    False,
                    found,
                    f"a bus terminal has {', '.join(_MEMBERS)}, and "
                    f"{role} is an {' or '.join(causalities)}",
                )
            )
    if others:
        findings.append(
            Finding("other terminals", True, f"{', '.join(others)}: stay without a bus")
        )
    if not all(one.fits for one in findings):
        return None, findings
    clock, notify = members["Tx_Clock"], members.get("BusNotifications", {})
    interval_s = clock.get("intervalDecimal")
    kind = clock.get("intervalVariability", "triggered")
    findings.append(
        Finding("Tx_Clock", True, kind + (f", every {interval_s} s" if interval_s else ""))
    )
    reference = {role.lower(): int(members[role]["valueReference"]) for role in _MEMBERS}
    return Terminal(
        name=name,
        **reference,
        clock=kind,
        interval_s=float(interval_s) if interval_s else None,
        shift_s=float(clock.get("shiftDecimal", 0.0)),
        notify=int(notify["valueReference"]) if notify else None,
        structural=notify.get("causality") == "structuralParameter",
    ), findings


def _ports(
    description: Any, names: unit_map.FmuMap, mapped: bool
) -> tuple[list[Port | None], list[Finding]]:
    """The variables of all names, inputs first, and what was found of each."""
    variables = {one.name: one for one in description.modelVariables}
    ports: list[Port | None] = []
    findings: list[Finding] = []
    for name, quantity, causality, factor in _wanted(names):
        variable = variables.get(name)
        if variable is None:
            spare = not mapped and name in _OPTIONAL
            others = [one.name for one in description.modelVariables if one.causality == causality]
            findings.append(
                Finding(
                    name,
                    spare,
                    "is not there" + (", and is not needed" if spare else ""),
                    f"{_MAP} if it has another name{nearest(name, others)}",
                )
            )
            ports.append(None)
            continue
        given = (
            None
            if mapped or quantity.startswith(("hold", "vent"))
            else _factor(description, variable, quantity)
        )
        problem, mend = _misfit(variable, causality) or (
            given if isinstance(given, tuple) else ("", "")
        )
        scale = factor if mapped else given if isinstance(given, float) else 1.0
        times = "" if scale == 1.0 else f"{scale:g} times "
        findings.append(
            Finding(
                name,
                not problem,
                problem or f"{causality}, {variable.type}: {times}{quantity}",
                mend,
            )
        )
        ports.append(Port(quantity, variable.valueReference, variable.type, scale))
    used = {name for name, *_ in _wanted(names)}
    left = [
        one.name
        for one in description.modelVariables
        if one.causality == "input" and one.name not in used
    ]
    if left:
        findings.append(
            Finding("other inputs", True, f"{', '.join(left)}: keep their start values")
        )
    return ports, findings


def _wanted(names: unit_map.FmuMap) -> Iterator[tuple[str, str, str, float]]:
    """Name, quantity, causality and factor of all variables, inputs first."""
    for name, (quantity, factor) in names.inputs.items():
        yield name, quantity, "input", factor
    for axle, (hold, vent) in enumerate(zip(names.hold, names.vent, strict=True), start=1):
        yield hold, f"hold_{axle}", "output", 1.0
        yield vent, f"vent_{axle}", "output", 1.0
    if names.reference:
        yield names.reference, "reference_speed", "output", 1.0 / names.reference_factor


def _misfit(variable: Any, causality: str) -> tuple[str, str] | None:
    """What is wrong with a variable, and how to mend it."""
    if variable.causality != causality:
        return (
            f"is declared as {variable.causality}",
            f"it has to be an {causality}; {_MAP} that names another",
        )
    if variable.variability not in (None, "continuous", "discrete"):
        return (
            f"has the variability {variable.variability}",
            "allowed are continuous and discrete",
        )
    if variable.dimensions or variable.type in ("String", "Binary", "Clock", "Enumeration"):
        kind = "an array" if variable.dimensions else f"of type {variable.type}"
        return f"is {kind}", "allowed are single numbers and Booleans: one variable for each axle"
    return None


def _factor(description: Any, variable: Any, quantity: str) -> float | tuple[str, str]:
    """What one SI unit is in the unit that a variable declares, or what is wrong with that unit and how to mend it."""
    told = variable.unit or (variable.declaredType.unit if variable.declaredType else None)
    dimension, name = _SI[quantity.partition("_")[0]]
    base = next((one.baseUnit for one in description.unitDefinitions if one.name == told), None)
    if (
        base is not None
        and (base.kg, base.m, base.s) == dimension
        and not any((base.A, base.K, base.mol, base.cd))
    ):
        if base.offset:
            return f"has the unit {told} with an offset", f"use one without, such as {name}"
        return 1.0 / float(base.factor)
    if told is None or (told == name and base is None):
        return 1.0
    radius = " (for m/s the wheel's radius in m)" if quantity.startswith("measured") else ""
    return (
        f"has the unit {told}, which "
        + ("is no unit of this quantity" if base else "it does not define"),
        f"declare {name}, or {_MAP} and its factor{radius}",
    )
