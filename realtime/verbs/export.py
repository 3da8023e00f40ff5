"""`rollerrig export`: a recorded run as MDF4, MAT or CSV, all channels with units, and its events."""

import argparse
import json
from pathlib import Path

PASS = 0


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, help="folder of a run")
    parser.add_argument("--format", required=True, metavar="FORMAT", help="mdf4, mat or csv")
    parser.add_argument("--out", type=Path, metavar="FILE",
                        help="the file (default: in the run's folder, called as the run)")


def call(given: argparse.Namespace) -> int:
    from rollerrig.realtime.record import export, records

    run = records.load(given.run)
    suffix = export.SUFFIX.get(given.format, "")
    out = given.out or given.run / f"{given.run.resolve().name}{suffix}"
    files = export.write(run, given.format, out)
    if given.json:
        print(json.dumps({"files": [str(file) for file in files], "samples": len(run.table),
                          "channels": len(run.table.column_names), "events": len(run.events)}))
    else:
        print(f"{len(run.table)} samples of {len(run.table.column_names)} channels and "
              f"{len(run.events)} events in {', '.join(str(file) for file in files)}")
    return PASS
