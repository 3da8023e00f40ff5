"""The command `rollerrig`: its verbs, their help, messages and exit status.

Paths in, paths out. With --json one JSON object stands on standard output and nothing else;
progress and messages go to standard error. Status: 0 pass, 1 a verdict failed, 2 usage or
configuration, 3 deadlines missed under --strict, 4 a run that is not valid. Only this file catches RollerrigError.
"""

import argparse
import contextlib
import importlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import NamedTuple

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes.without import without
from rollerrig.realtime import broken_pipe
from rollerrig.realtime.commands import (
    bench,
    campaign,
    check,
    desk,
    devices,
    discover,
    explain,
    listing,
    results,
    run,
    sequence,
    tuning,
    wsp,
)

PASS, FAILED, USAGE, LATE, INVALID = 0, 1, 2, 3, 4


class Verb(NamedTuple):
    """One verb: its name, what declares its arguments, what it does (to the exit status), and its help."""

    name: str
    arguments: Callable[[argparse.ArgumentParser], None]
    call: Callable[[argparse.Namespace], int]
    text: str
    example: str


VERBS = (
    Verb(
        "run",
        run.arguments,
        run.call,
        "one bench run: brake the vehicle, record everything",
        "rollerrig run velim_a1 --pacing lockstep --out runs/a1",
    ),
    Verb(
        "wsp",
        wsp.arguments,
        wsp.call,
        "the reference WSP unit as a separate program on a bus",
        "rollerrig wsp --bus socketcand://127.0.0.1:29536/rig0",
    ),
    Verb(
        "sequence",
        sequence.arguments,
        sequence.call,
        "scripted tests over the buses, with verdicts and a report",
        "rollerrig sequence emergency_120 --out report",
    ),
    Verb(
        "compare",
        results.compare_arguments,
        results.compare,
        "runs side by side, by value with tolerances, overlaid in Rerun",
        "rollerrig compare runs/a runs/b --tolerance m_s=0.1",
    ),
    Verb(
        "export",
        results.export_arguments,
        results.export,
        "a run as MDF4, MAT or CSV: all channels with units, and events",
        "rollerrig export runs/demo --format csv --out demo.csv",
    ),
    Verb(
        "export-fmu",
        results.fmu_arguments,
        results.export_fmu,
        "the rig as an FMU, for simulations of others",
        "rollerrig export-fmu velim_a1 --out rig.fmu",
    ),
    Verb(
        "campaign",
        campaign.arguments,
        campaign.call,
        "many runs from a plan, over processes or a Dask cluster",
        "rollerrig campaign low_adhesion --out campaigns/soap",
    ),
    Verb(
        "explain",
        explain.arguments,
        explain.call,
        "what the simulation gets wrong, why, the extended model, the gain",
        "rollerrig explain open_rail_cleaning --out reports/cleaning",
    ),
    Verb(
        "hide",
        discover.hide_arguments,
        discover.hide,
        "a rig that hides one or two effects, and its key",
        "rollerrig hide --seed 7 --out sealed.toml",
    ),
    Verb(
        "discover",
        discover.arguments,
        discover.call,
        "a rig finds out what is wrong: stops, explanation, the stops that part what is left, and again",
        "rollerrig discover velim_a1 --stops 5 --out reports/found",
    ),
    Verb(
        "desk",
        desk.arguments,
        desk.call,
        "a page in the browser: run the rig, watch it, look at its runs",
        "rollerrig desk --open",
    ),
    Verb(
        "view",
        results.view_arguments,
        results.view,
        "open a run, or several laid over one another, in Rerun",
        "rollerrig view runs/demo",
    ),
    Verb(
        "list",
        listing.arguments,
        listing.call,
        "what there is by name: scenarios, faults, signals and more",
        "rollerrig list scenarios",
    ),
    Verb(
        "check",
        check.arguments,
        check.call,
        "what this machine can do, and how to enable what it cannot",
        "rollerrig check",
    ),
    Verb(
        "devices",
        devices.arguments,
        devices.call,
        "write the EDS of every node, one DBC and the signal table",
        "rollerrig devices --out devices",
    ),
    Verb(
        "bench",
        bench.arguments,
        bench.call,
        "the project's own benchmarks: a table, and JSON",
        "rollerrig bench loop --json",
    ),
    Verb(
        "score",
        bench.score_arguments,
        bench.score,
        "judge any tool's answers on sets of rollerrig bench explain --export",
        "rollerrig score sets answers.json",
    ),
    Verb(
        "tune",
        tuning.tune_arguments,
        tuning.tune,
        "tau of the recovery (or Polach's parameters) from measured data",
        "rollerrig tune velim_synthetic --out reports/tune",
    ),
    Verb(
        "validate",
        tuning.validate_arguments,
        tuning.validate,
        "Table 6 on runs never fitted: measured, with and without recovery",
        "rollerrig validate velim_synthetic --out reports/validate",
    ),
)


def parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    top = argparse.ArgumentParser(
        prog="rollerrig",
        description="Hardware-in-the-loop roller-rig emulator for railway wheel slide protection.",
        epilog="example: rollerrig run velim_a1 --out runs/a1",
    )
    top.add_argument(
        "--version", action="version", version=f"rollerrig {metadata.version('rollerrig')}"
    )
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb in VERBS:
        sub = verbs.add_parser(
            verb.name,
            help=verb.text,
            description=verb.text.capitalize() + ".",
            epilog=f"example: {verb.example}",
        )
        verb.arguments(sub)
        sub.add_argument(
            "--json",
            action="store_true",
            help="print one JSON object on standard output and nothing else there",
        )
        sub.set_defaults(call=verb.call)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    broken_pipe.make_harmless()
    top = parser()
    if "_ARGCOMPLETE" in os.environ:  # the shell asks what might follow
        with contextlib.suppress(ImportError):
            importlib.import_module("argcomplete").autocomplete(top)
    arguments = top.parse_args(argv)
    with without("asammdf"):
        importlib.import_module("can")
    try:
        return arguments.call(arguments)
    except RollerrigError as error:
        print(f"rollerrig {arguments.verb}: {error}", file=sys.stderr)
        if arguments.json:
            print(json.dumps({"error": str(error)}))
        return USAGE
    except KeyboardInterrupt:
        print(f"rollerrig {arguments.verb}: interrupted", file=sys.stderr)
        return INVALID


if __name__ == "__main__":
    sys.exit(main())
