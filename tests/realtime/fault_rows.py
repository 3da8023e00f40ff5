"""What single stops tell of each fault of the catalogue: `python tests/realtime/fault_rows.py [FOLDER]`.

Two stops of each, hidden, at the catalogue's default size, and sound ones; a row of docs/discover.md each. Stops that
are there are not run again.
"""

import sys
from pathlib import Path

import numpy as np

from rollerrig.configs import store
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.discover import discover, fault_signs, sealed_rig
from rollerrig.realtime.record import records
from rollerrig.rig.identify.next_stops.prototype import Stop
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, SPEEDS
from rollerrig.wsp_interface.signals import BRAKE_NODE, SPEED_NODE

SCENARIO, MASS_KG = "velim_a1", 43000.0
# initial speed, and what has the fault
STOPS = (
    (38.0, {"axle": 2, "other": 3, "node": BRAKE_NODE, "can_id": SPEEDS.can_id}),
    (30.0, {"axle": 3, "other": 4, "node": SPEED_NODE, "can_id": MAGNETS_ID}),
)
NONE, BUS, SAND = "none", "none, with a bus", "none, with a sander"
# a fault that never begins lets a bus be there
SOUND = {NONE: [], BUS: [{"kind": "frame_lost", "at_s": 36000.0}], SAND: []}
# a supply that stays low lets no drive brake its roller to a stop
DIP = {"at_s": 3.0, "for_s": 1.0}


def hidden(name, aims):
    """The fault of a row as a table of a scenario."""
    if name in SOUND:
        return SOUND[name]
    own = {row.name for row in catalogue.BY_NAME[name].parameters}
    if name == "node_babbling":
        own = {"node"}  # of an identifier that is nobody's
    return [
        {"kind": name}
        | {key: aims[key] for key in aims if key in own}
        | (DIP if name == "power_dip" else {})
    ]


def fits(signs, name, aims):
    """Whether that fault is told, where it is, and nothing else; the bus does not tell every aim."""
    if name in SOUND or not signs:
        return not signs and name in SOUND
    words = {*signs[0].split()} - {"or", *catalogue.BY_NAME}
    told = {
        f"{key}={value:#x}" if key == "can_id" else f"{key}={value}" for key, value in aims.items()
    }
    return len(signs) == 1 and name in signs[0].split() and words <= told


def rows(folder):
    """(fault, largest difference of the vehicle's speed to a sound rig, found, what is told) of each."""
    given, _ = store.load("scenarios", SCENARIO)
    names = (*SOUND, *catalogue.BY_NAME)
    stops = {(name, k): folder / f"{name}_{k}" for name in names for k in range(len(STOPS))}
    for (name, k), out in stops.items():
        sanders = (
            {"sanders": {"axle": STOPS[k][1]["axle"], "from_s": 3.0}} if "sander" in name else {}
        )
        sealed_rig.write(
            out.with_suffix(".toml"), given | sanders, {"fault": hidden(name, STOPS[k][1])}
        )
    todo = [
        (str(out.with_suffix(".toml")), out, Stop(STOPS[k][0], discover.FULL_PA, MASS_KG, 0), 0)
        for (_, k), out in stops.items()
        if not records.summary(out)
    ]
    discover.brake_all(
        todo, lambda done: print(f"{done} of {len(todo)} stops done", file=sys.stderr)
    )
    for name in names:
        told, differs_m_s, found = [], 0.0, 0
        for k, (_, aims) in enumerate(STOPS):
            run, sound = (
                records.load(stops[one, k]) for one in (name, SAND if "sander" in name else NONE)
            )
            signs = fault_signs.of(run)
            a, b = (one.column("vehicle_speed_m_s") for one in (run, sound))
            differs_m_s = max(differs_m_s, float(np.abs(a[: b.size] - b[: a.size]).max()))
            found += fits(signs, name, aims)
            told.append(
                (", ".join(signs) or "nothing")
                + ("" if run.summary["valid"] else " (run not valid)")
            )
        yield name, differs_m_s, found, told


def main(folder="reports/fault_rows"):
    for name, differs_m_s, found, told in rows(Path(folder)):
        print(f"| `{name}` | {differs_m_s:.2g} | {found} of {len(told)} | {'; '.join(told)} |")


if __name__ == "__main__":
    main(*sys.argv[1:])
