"""What the variables of an FMU are, in the words of the standard: arrays, enumerations, clocks.

The rig exchanges single numbers and Booleans, one for each axle. Everything else is named for what
it is, so that its author knows what to declare. Source: FMI 2.0.4 and 3.0.2.
"""

from collections.abc import Iterator
from typing import Any

_MOST_NAMES = 8  # values of an enumeration in a message
_EXCHANGED = ("input", "output")


def is_alias(description: Any, name: str) -> str:
    """Return the name of the variable of which a name is an alias; "" if it is none."""
    for variable in description.modelVariables:
        if any(alias.name == name for alias in variable.aliases):
            return str(variable.name)
    return ""


def by_name(description: Any) -> dict[str, Any]:
    """Return the variables of an FMU by name, each also by its aliases."""
    variables = {}
    for variable in description.modelVariables:
        variables[variable.name] = variable
        for alias in variable.aliases:
            variables[alias.name] = variable
    return variables


def unfit_kind(description: Any, variable: Any) -> str:
    """Return what a variable is if it is no single number or Boolean; "" if it is one."""
    if variable.dimensions:
        return f"an array of {_size(description, variable)}"
    if variable.type == "Enumeration":
        items = variable.declaredType.items if variable.declaredType else []
        names = ", ".join(f"{item.name} = {item.value}" for item in items[:_MOST_NAMES])
        return f"an enumeration ({names})" if names else "an enumeration"
    if variable.type == "Clock":
        return f"a clock ({variable.intervalVariability or 'triggered'})"
    if variable.clocks:
        return f"a clocked variable of {_clocks(variable)}, valid at its ticks only"
    if variable.type in ("String", "Binary"):
        return f"of type {variable.type}"
    return ""


def _size(description: Any, variable: Any) -> str:
    """Return the size of an array, as in "4 values" or "n values (structural parameter n)"."""
    by_reference = {one.valueReference: one for one in description.modelVariables}
    sizes = []
    for dimension in variable.dimensions:
        start = getattr(dimension, "start", None)
        if start:
            sizes.append(str(start))
            continue
        reference = getattr(dimension, "valueReference", None)
        reference = getattr(reference, "valueReference", reference)
        parameter = by_reference.get(reference)
        sizes.append(str(parameter.name) if parameter else "unknown size")
    return f"{' x '.join(sizes)} values"


def _clocks(variable: Any) -> str:
    """Return the names of the clocks of a variable."""
    return ", ".join(f"the clock {clock.name}" for clock in variable.clocks)


def unfit_variables(description: Any) -> Iterator[tuple[str, str]]:
    """Yield name and kind of the inputs and outputs that the rig cannot exchange."""
    for variable in description.modelVariables:
        if variable.causality not in _EXCHANGED:
            continue
        kind = unfit_kind(description, variable)
        if kind:
            yield str(variable.name), f"{variable.causality}: is {kind}"


def interfaces(description: Any) -> str:
    """Return what an FMU without co-simulation is for."""
    found = []
    if description.modelExchange:
        found.append("model exchange")
    if getattr(description, "scheduledExecution", None):
        found.append("scheduled execution (its clocks call model partitions)")
    return " and ".join(found) or "no interface"
