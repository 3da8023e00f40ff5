"""`rollerrig devices`: writes the files that describe the nodes of the rig to other tools."""

import argparse
from pathlib import Path
from typing import Any

from rollerrig.realtime.commands import output


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig devices`."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("devices"),
        metavar="DIR",
        help="folder for the files (default: devices)",
    )
    parser.add_argument(
        "--scenario",
        default="velim_a1",
        metavar="NAME",
        help="scenario of the rig; nodes and registers are those of its vehicle, and the units of the "
        "objects depend on its rated torques and pole wheels (default: velim_a1)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change a value of the scenario, as in sensor.teeth=80; may be repeated",
    )


def call(options: argparse.Namespace) -> int:
    """Write the files of all nodes. Returns PASS."""
    from rollerrig.configs.output_files import writing
    from rollerrig.firmware_sim.modbus import map
    from rollerrig.realtime.bench import scenario
    from rollerrig.wsp_interface import descriptions, own_bench

    plan = scenario.load(options.scenario, settings=tuple(options.set))
    table = plan.table
    nodes = dictionaries(plan)
    drives = {node.node_id: node for node in nodes if node.node_id in table.drive_nodes}

    with writing(options.out):
        paths = [
            *descriptions.write(options.out, table, nodes, plan["bus"]["sync_period_s"]),
            *map.write(options.out, table, drives, own_bench.scenarios_of(table.kind)),
        ]

    result = {"folder": str(options.out), "files": [path.name for path in paths]}
    output.show(options, result, *[str(path) for path in paths])
    if not options.json:
        output.print_message(
            f"{len(paths)} files for tools that read EDS, DBC, Modbus maps and tables"
        )
    return output.PASS


def dictionaries(plan: Any) -> list[Any]:
    """Return the object dictionaries of the nodes of a scenario.

    They are those of a run, because the nodes are made as for a run.
    """
    import numpy as np

    from rollerrig.realtime.bench import rig_bus
    from rollerrig.wsp_interface import events, signals
    from rollerrig.wsp_interface.bus.hub import Hub

    # the hub listens on no address: the nodes boot, and nobody receives their frames
    bus = rig_bus.RigBus(
        hub=Hub(lambda: 0),
        scenario=plan,
        row=np.zeros(signals.WIDTH),
        on_command=lambda row: None,
        on_event=events.ignore,
        clock_ns=lambda: 0,
    )
    members: list[Any] = bus.rack.members
    return [member.dictionary for member in members if hasattr(member, "dictionary")]
