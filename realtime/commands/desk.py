"""`rollerrig desk`: serves a page for the browser that runs the rig and shows it and its runs."""

import argparse
import contextlib
import json
from pathlib import Path

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output, wsp
from rollerrig.wsp_interface.unit_choice import AllowList


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig desk`."""
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address on which the desk listens (default: 127.0.0.1, for this machine only); on "
        "every address the desk answers only to those who have the token in the printed address",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=8530,
        help="port on which the desk listens; 0 chooses a free port (default: 8530)",
    )
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="folder that holds runs, reports and campaigns (default: the current folder)",
    )
    parser.add_argument(
        "--own",
        action="store_true",
        help="follow only benches that this desk has started, and no others on this machine",
    )
    parser.add_argument(
        "--scenario",
        metavar="NAME",
        help="scenario that the page offers first, with its vehicle (default: velim_a1)",
    )
    wsp.allow_argument(parser, "a user of the page")
    parser.add_argument(
        "--allow-folder",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="a folder whose scenario files, and FMUs that are in it now, a user of the page may "
        "choose; may be repeated (default: scenario files below --folder, and no FMU)",
    )
    parser.add_argument("--open", action="store_true", help="open a browser with the page")


def call(options: argparse.Namespace) -> int:
    """Serve the desk until the user interrupts it. Returns PASS."""
    if options.scenario:
        from rollerrig.realtime.bench import scenario
        from rollerrig.realtime.train import plan

        if plan.find(options.scenario) is not None:
            raise ConfigError(
                f"--scenario {options.scenario}: is a train, which the desk runs under Automatic; allowed "
                "is the scenario of one vehicle"
            )
        # an error in it is reported before the page is served
        scenario.load(options.scenario)

    if not options.folder.is_dir():
        raise ConfigError(
            f"--folder {options.folder}: this folder does not exist; make it, or give a folder "
            "that holds runs"
        )

    for folder in options.allow_folder:
        if not folder.is_dir():
            raise ConfigError(f"--allow-folder {folder}: there is no such folder; give another one")
    fmus = [file for folder in options.allow_folder for file in sorted(folder.glob("*.fmu"))]
    allowed = AllowList.of([*options.allow_unit, *fmus])

    try:
        from rollerrig.realtime.desk import desk, server
    except ImportError as error:
        raise ConfigError(
            f"the desk needs nicegui ({error}): pip install 'rollerrig[desk]'"
        ) from None

    def print_address(address: str, warning: str) -> None:
        if warning:
            output.print_message(f"warning: {warning}")
        if options.json:
            line = json.dumps({"address": address})
        else:
            line = (
                f"desk: {address} (not a safety function; Ctrl-C stops the desk, and a running "
                "bench continues)"
            )
        # flushed, because a program that reads the address waits for it
        print(line, flush=True)

    shared = desk.Desk(options.folder.resolve(), options.own, allowed, options.allow_folder)
    if options.scenario:
        shared.prepared["scenario"] = options.scenario
        shared.show_vehicle_of(options.scenario)
    with contextlib.suppress(KeyboardInterrupt):
        server.serve(
            shared,
            options.host,
            options.port,
            options.open,
            print_address,
        )
    return output.PASS
