"""The faults that single stops show: `python tests/realtime/fault_rows.py [FOLDER]`.

Each fault of the catalogue is hidden in two stops at its default size; other stops have no fault.
The rows are those of the table in docs/discover.md. Stops that are in the folder are not run again.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs import store
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.discover import discover, fault_signs, sealed_rig
from rollerrig.realtime.record import records
from rollerrig.rig.identify.next_stops.prototype import Stop
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, SPEEDS_ID
from rollerrig.wsp_interface.signals import BRAKE_NODE, SPEED_NODE

SCENARIO = "velim_a1"
MASS_KG = 43000.0
ALL_AXLES = 0


class Case(NamedTuple):
    """A stop: its initial speed, and the values of the parameters that say where a fault acts."""

    speed_m_s: float
    targets: dict[str, int]


CASES = (
    Case(38.0, {"axle": 2, "other": 3, "node": BRAKE_NODE, "can_id": SPEEDS_ID}),
    Case(30.0, {"axle": 3, "other": 4, "node": SPEED_NODE, "can_id": MAGNETS_ID}),
)

NONE = "none"
WITH_BUS = "none, with a bus"
WITH_SANDER = "none, with a sander"
FAULT_FREE: dict[str, list[dict[str, Any]]] = {
    NONE: [],
    # with a fault that never begins, the rig is braked with a bus
    WITH_BUS: [{"kind": "frame_lost", "at_s": 36000.0}],
    WITH_SANDER: [],
}
# if the supply stayed low, no drive could brake its roller to a stop
POWER_DIP = {"at_s": 3.0, "for_s": 1.0}


class Row(NamedTuple):
    """The result for one fault."""

    name: str
    largest_difference_m_s: float  # of the vehicle's speed, to a rig without the fault
    found: int  # stops that show this fault and no other
    signs: list[str]  # what each stop shows


def hidden_faults(name: str, targets: dict[str, int]) -> list[dict[str, Any]]:
    """Return the faults of a row as tables of a scenario."""
    if name in FAULT_FREE:
        return FAULT_FREE[name]
    parameters = {parameter.name for parameter in catalogue.BY_NAME[name].parameters}
    if name == "node_babbling":
        parameters = {"node"}  # the default identifier belongs to no node
    fault: dict[str, Any] = {"kind": name}
    for key, value in targets.items():
        if key in parameters:
            fault[key] = value
    if name == "power_dip":
        fault |= POWER_DIP
    return [fault]


def shows(signs: list[str], name: str, targets: dict[str, int]) -> bool:
    """Whether the signs are this fault in the right place, and nothing else.

    A sign does not have every target: the bus does not show all of them.
    """
    if name in FAULT_FREE:
        return not signs
    if len(signs) != 1:
        return False
    words = signs[0].split()
    places = {*words} - {"or", *catalogue.BY_NAME}
    possible_places = set()
    for key, value in targets.items():
        possible_places.add(f"{key}={value:#x}" if key == "can_id" else f"{key}={value}")
    return name in words and places <= possible_places


def stop_folder(folder: Path, name: str, number: int) -> Path:
    return folder / f"{name}_{number}"


def run_missing(folder: Path, names: tuple[str, ...]) -> None:
    """Write the sealed rigs of all rows, and run the stops that are not in the folder."""
    content, _ = store.load("scenarios", SCENARIO)
    jobs = []
    for name in names:
        for number, case in enumerate(CASES):
            out = stop_folder(folder, name, number)
            rig = out.with_suffix(".toml")
            sanders = {}
            if "sander" in name:
                sanders = {"sanders": {"axle": case.targets["axle"], "from_s": 3.0}}
            hidden = {"fault": hidden_faults(name, case.targets)}
            sealed_rig.write(rig, content | sanders, hidden)
            if not records.summary(out):
                stop = Stop(case.speed_m_s, discover.FULL_PA, MASS_KG, ALL_AXLES)
                jobs.append((str(rig), out, stop, 0))

    def report(done: int) -> None:
        print(f"{done} of {len(jobs)} stops done", file=sys.stderr)

    discover.brake_all(jobs, report)


def row_of(folder: Path, name: str) -> Row:
    """Return the row of one fault from the recorded stops."""
    fault_free = WITH_SANDER if "sander" in name else NONE
    largest_difference_m_s = 0.0
    found = 0
    shown = []
    for number, case in enumerate(CASES):
        run = records.load(stop_folder(folder, name, number))
        reference = records.load(stop_folder(folder, fault_free, number))
        speed_m_s = run.column("vehicle_speed_m_s")
        reference_m_s = reference.column("vehicle_speed_m_s")
        # stops have different lengths
        samples = min(speed_m_s.size, reference_m_s.size)
        difference_m_s = np.abs(speed_m_s[:samples] - reference_m_s[:samples])
        largest_difference_m_s = max(largest_difference_m_s, float(difference_m_s.max()))

        signs = fault_signs.of(run)
        if shows(signs, name, case.targets):
            found += 1
        text = ", ".join(signs) or "nothing"
        if not run.summary["valid"]:
            text += " (run not valid)"
        shown.append(text)
    return Row(name, largest_difference_m_s, found, shown)


def rows(folder: Path) -> Iterator[Row]:
    """Yield the rows of all faults, first those without a fault."""
    names = (*FAULT_FREE, *catalogue.BY_NAME)
    run_missing(folder, names)
    for name in names:
        yield row_of(folder, name)


def main(folder: str = "reports/fault_rows") -> None:
    for row in rows(Path(folder)):
        signs = "; ".join(row.signs)
        print(
            f"| `{row.name}` | {row.largest_difference_m_s:.2g} "
            f"| {row.found} of {len(row.signs)} | {signs} |"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
