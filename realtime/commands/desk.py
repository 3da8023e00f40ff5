"""`rollerrig desk`: a page in the browser from which the rig is run, watched and asked about its runs."""

import argparse
import contextlib
import json
from pathlib import Path

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="where it listens (default: 127.0.0.1); "
        "on another address it is open to all who have the token that it prints",
    )
    parser.add_argument(
        "--port", type=int, default=8530, help="0: one that is free (default: 8530)"
    )
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="where runs, reports and campaigns stand (default: here)",
    )
    parser.add_argument(
        "--own",
        action="store_true",
        help="look only at benches that this desk has started, not at "
        "others that run on this machine",
    )
    parser.add_argument("--open", action="store_true", help="open a browser as well")


def call(given: argparse.Namespace) -> int:
    try:
        from rollerrig.realtime.desk import desk, server
    except ImportError as error:
        raise ConfigError(
            f"the desk needs nicegui ({error}): pip install 'rollerrig[desk]'"
        ) from None

    if not given.folder.is_dir():
        raise ConfigError(
            f"--folder {given.folder}: no such folder; make it, or give one that holds runs"
        )

    def say(address: str, warning: str) -> None:
        if warning:
            output.print_message(f"warning: {warning}")
        print(
            json.dumps({"address": address})
            if given.json
            else f"desk: {address} (no safety function; Ctrl-C ends it, a bench goes on)",
            flush=True,
        )

    with contextlib.suppress(KeyboardInterrupt):
        server.serve(
            desk.Desk(given.folder.resolve(), given.own), given.host, given.port, given.open, say
        )
    return output.PASS
