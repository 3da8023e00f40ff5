"""The changes of the friction of the rail in a run: by the scenario, and by commands of a test.

A scenario changes it by time or place with `[[friction]]`. A step of a sequence, the harness and
the desk change it by a command, from then on.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.vehicle import kind_of
from rollerrig.wsp_interface import harness_client
from rollerrig.wsp_interface.events import Code, Event

# a recorded signal by name
Column = Callable[[str], np.ndarray]


# an event of a bench, or of a harness
AnyEvent = Event | harness_client.Event


class Change(NamedTuple):
    """A change of the friction under some axles."""

    time_s: float
    """When it acts; NaN if the vehicle does not reach its place."""
    name: str
    """The new friction and the axles, for a picture."""
    text: str
    """`name` and from which time or place, for a table."""


def changes(
    scenario: Mapping[str, Any], events: Iterable[AnyEvent], column: Column
) -> tuple[Change, ...]:
    """Return the changes by the resolved scenario in their order, then those by commands."""
    axles = kind_of(scenario, "the scenario of the run").axles
    rows = scenario.get("friction", ())
    programmed = [_programmed(row, scenario, column, axles) for row in rows]
    commanded = [_commanded(event, axles) for event in events]
    return (*programmed, *(change for change in commanded if change is not None))


def text(found: Sequence[Change]) -> str:
    """Return the changes as one cell of a table; "" if there are none."""
    return "; ".join(change.text for change in found)


def _programmed(
    row: Mapping[str, Any], scenario: Mapping[str, Any], column: Column, axles: int
) -> Change:
    """Return the change by one `[[friction]]` of a scenario, of a vehicle with so many axles."""
    name = f"mu_cd {row['mu_cd']:.3g}"
    if row["mu_cr"] != scenario["adhesion"]["mu_cr"]:
        name += f", mu_cr {row['mu_cr']:.3g}"
    name += _under(row["axles"], axles)
    if "from_m" not in row:
        return Change(row["from_s"], name, f"{name}, from {row['from_s']:g} s")
    reached = np.flatnonzero(column("position_m") >= row["from_m"])
    place = f"{name}, from {row['from_m']:g} m"
    if not reached.size:
        return Change(math.nan, name, f"{place} (not reached)")
    return Change(float(column("time_s")[reached[0]]), name, place)


def _commanded(event: AnyEvent, axles: int) -> Change | None:
    """Return the change of friction that an event reports; None for any other event."""
    fields = event.fields
    if event.code == Code.TEST_FRICTION:
        name = f"mu_cd {fields['mu']:.3g}{_under(fields['axles'], axles)}"
    elif event.code == Code.SET_POINT_FRICTION:
        name = f"mu_cd {fields['mu']:.3g}{_under([fields['axle']], axles)}"
    elif event.code == Code.TEST_FRICTION_DEFAULT:
        name = "friction as in the scenario"
    elif event.code == Code.SET_POINT_FRICTION_NONE:
        name = f"friction as in the scenario{_under([fields['axle']], axles)}"
    else:
        return None
    return Change(event.time_s, name, f"{name}, by command at {event.time_s:.2f} s")


def _under(changed: Sequence[int], axles: int) -> str:
    """Return under which of all axles the friction changes, as the end of a name."""
    if set(changed) == set(range(1, axles + 1)):
        return " under all axles"
    if len(changed) == 1:
        return f" under axle {changed[0]}"
    first = ", ".join(str(axle) for axle in changed[:-1])
    return f" under axles {first} and {changed[-1]}"
