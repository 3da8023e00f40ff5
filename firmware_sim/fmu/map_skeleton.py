"""A mapping for an FMU whose variables have other names: proposed from names and units, to correct.

Wheel speeds and pressures are recognised by their units, else by words in their names; magnets by
words. The axle is the last number in a name. What is not recognised becomes a question mark, which
`rollerrig check` then reports. Nothing of the FMU is run.
"""

import math
import re
from pathlib import Path
from typing import Any

import tomli_w

from rollerrig.configs.output_files import write_text, writing
from rollerrig.configs.vehicle import AXLES_OF_GROUP
from rollerrig.firmware_sim.fmu import fmu_file, kinds

_UNKNOWN = "?"
# words in names, in lower case; the first group that has one counts
_WORDS = {
    "cylinder_pressure": ("pressure", "press", "druck", "bcp", "p_cyl", "pcyl", "cyl"),
    "measured_speed": ("speed", "velocity", "omega", "wheel", "axle", "rpm", "v", "n", "w"),
    "vent": ("vent", "release", "exhaust", "dump", "loes", "low", "l"),
    "hold": ("hold", "halt", "keep", "block", "h"),
}
# value of one SI unit in units that wheel speeds and pressures have: by the name of the unit
_FACTORS = {
    "rad/s": 1.0,
    "Hz": 1.0 / math.tau,
    "1/s": 1.0 / math.tau,
    "rpm": 60.0 / math.tau,
    "1/min": 60.0 / math.tau,
    "deg/s": 180.0 / math.pi,
    "Pa": 1.0,
    "kPa": 1e-3,
    "bar": 1e-5,
}
_RADIUS_m = 0.445  # of the wheels of the packaged coach
_SPEEDS_OF_RIM = {"m/s": 1.0, "km/h": 3.6}


def write(fmu: Path, out: Path, unit_axles: int = AXLES_OF_GROUP) -> int:
    """Write the proposal for an FMU; return how many of its places are unknown.

    `unit_axles`: the axles of the largest group of the vehicle. Raises ConfigError.
    """
    description = fmu_file.description_of(fmu)
    text, unknown = skeleton(description, fmu.name, unit_axles)
    with writing(out, "give another file with --write-map"):
        write_text(out, text)
    return unknown


def skeleton(description: Any, name: str, unit_axles: int) -> tuple[str, int]:
    """Return the text of a proposal, and how many of its places are unknown."""
    axles = range(1, unit_axles + 1)
    inputs: dict[str, dict[int, str]] = {"measured_speed": {}, "cylinder_pressure": {}}
    outputs: dict[str, dict[int, str]] = {"hold": {}, "vent": {}}
    factors = {"measured_speed": 1.0, "cylinder_pressure": 1.0}
    for variable in description.modelVariables:
        if kinds.unfit_kind(description, variable):
            continue
        groups = inputs if variable.causality == "input" else outputs
        if variable.causality not in ("input", "output"):
            continue
        quantity = _quantity(variable, groups)
        axle = _axle(variable.name)
        if not quantity or axle not in axles or axle in groups[quantity]:
            continue
        groups[quantity][axle] = variable.name
        if groups is inputs:
            factors[quantity] = _factor(variable)

    tables = []
    unknown = 0
    for quantity, found in inputs.items():
        if not found and quantity == "cylinder_pressure":
            continue  # a unit may do without pressures
        signals = {}
        for axle in axles:
            key = found.get(axle, f"{_UNKNOWN}{axle}")
            unknown += axle not in found
            signals[key] = f"{quantity}_{axle}"
        tables.append({"factor": factors[quantity], "signals": signals})
    from_unit: dict[str, Any] = {}
    for magnet, found in outputs.items():
        from_unit[magnet] = [found.get(axle, f"{_UNKNOWN}{axle}") for axle in axles]
        unknown += unit_axles - len(found)
    from_unit |= _reference(description)
    content = tomli_w.dumps({"to_unit": tables, "from_unit": from_unit})
    return "".join(f"# {line}\n" for line in _head(description, name)) + "\n" + content, unknown


def _reference(description: Any) -> dict[str, Any]:
    """Return the entries of the reference speed; none if no output has such a name and unit."""
    for variable in description.modelVariables:
        unit = _unit(variable)
        if variable.causality != "output" or unit not in _SPEEDS_OF_RIM:
            continue
        if "ref" in variable.name.lower():
            factor = round(1.0 / _SPEEDS_OF_RIM[unit], 6)
            return {"reference": str(variable.name), "reference_factor": factor}
    return {}


def _head(description: Any, name: str) -> list[str]:
    """Return the lines of a comment: what to do, and all inputs and outputs of the FMU."""
    lines = [
        f"A mapping for {name}, proposed by 'rollerrig check {name} --write-map'.",
        "Correct every name and factor; a name with ? was not recognised.",
        "A factor is the value that the FMU gets for 1 rad/s or 1 Pa.",
        "Remove a [[to_unit]] that the unit does not need.",
    ]
    for causality in ("input", "output"):
        lines.append(f"{causality}s of the FMU:")
        for variable in description.modelVariables:
            if variable.causality == causality:
                kind = kinds.unfit_kind(description, variable) or variable.type
                unit = f", {_unit(variable)}" if _unit(variable) else ""
                about = f": {variable.description}" if variable.description else ""
                line = f"  {variable.name} ({kind}{unit}){about}"
                lines.append(" ".join(line.splitlines()))
    return lines


def _quantity(variable: Any, groups: dict[str, dict[int, str]]) -> str:
    """Return the quantity that a variable probably has; "" if nothing shows it."""
    unit = _unit(variable)
    if "measured_speed" in groups:
        if unit in ("Pa", "kPa", "bar", "mbar"):
            return "cylinder_pressure"
        if unit in _FACTORS or unit in _SPEEDS_OF_RIM:
            return "measured_speed"
    # words of a name: letters between digits, marks, and changes to a capital letter
    words = [word.lower() for word in re.findall(r"[A-Za-z][a-z]*", variable.name)]
    whole = variable.name.lower()
    for quantity, known in _WORDS.items():
        if quantity not in groups:
            continue
        for word in known:
            if word in words or (len(word) > 2 and word in whole):
                return quantity
    return ""


def _axle(name: str) -> int:
    """Return the last number in a name; 0 if there is none."""
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1][-3:]) if numbers else 0


def _unit(variable: Any) -> str:
    if variable.unit:
        return str(variable.unit)
    declared = variable.declaredType
    return str(declared.unit) if declared and declared.unit else ""


def _factor(variable: Any) -> float:
    """Return the value of one SI unit in the unit of a variable; 1 if the unit is unknown."""
    unit = _unit(variable)
    if unit in _SPEEDS_OF_RIM:
        return round(_SPEEDS_OF_RIM[unit] * _RADIUS_m, 6)
    return float(f"{_FACTORS.get(unit, 1.0):.6g}")
