"""`rollerrig devices`: the files that tell other tools what stands on the rig's buses."""

import argparse
from pathlib import Path
from typing import Any

from rollerrig.realtime.commands import output


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("devices"),
        metavar="DIR",
        help="folder to write into (default: devices)",
    )
    parser.add_argument(
        "--scenario",
        default="velim_a1",
        metavar="NAME",
        help="whose rig: its rated torques and pole "
        "wheels stand in the objects' units (default: velim_a1)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change one value, as in sensor.teeth=80; may be repeated",
    )


def call(given: argparse.Namespace) -> int:
    from rollerrig.configs import store
    from rollerrig.firmware_sim.modbus import map
    from rollerrig.realtime.bench import scenario
    from rollerrig.realtime.record.files import writing
    from rollerrig.wsp_interface import descriptions, signals

    nodes = dictionaries(scenario.load(given.scenario, settings=tuple(given.set)))
    drives = {one.node_id: one for one in nodes if one.node_id in signals.DRIVE_NODES}
    with writing(given.out):
        written = [
            *descriptions.write(given.out, nodes),
            *map.write(given.out, drives, tuple(store.names("scenarios"))),
        ]
    output.show(
        given,
        {"folder": str(given.out), "files": [path.name for path in written]},
        *(str(path) for path in written),
    )
    if not given.json:
        output.print_message(
            f"{len(written)} files for tools that read EDS, DBC, Modbus maps and tables"
        )
    return output.PASS


def dictionaries(plan: Any) -> list[Any]:
    """The object dictionaries of a scenario's nodes, from the very nodes that a run makes."""
    import numpy as np

    from rollerrig.realtime.bench import rig_bus
    from rollerrig.wsp_interface import events, signals
    from rollerrig.wsp_interface.bus.hub import Hub

    # a hub that listens nowhere: the nodes boot, and nobody hears them
    bus = rig_bus.RigBus(
        Hub(lambda: 0),
        plan,
        np.zeros(len(signals.COLUMNS)),
        lambda row: None,
        events.ignore,
        lambda: 0,
    )
    members: list[Any] = bus.rack.members
    return [member.dictionary for member in members if hasattr(member, "dictionary")]
