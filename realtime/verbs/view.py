"""`rollerrig view`: open recorded runs in Rerun, or make a picture of one."""

import argparse
import json
import sys
from pathlib import Path


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", nargs="+", type=Path, help="folders of runs; several are overlaid")
    parser.add_argument("--png", type=Path, metavar="FILE", help="write a picture instead, headless")
    parser.add_argument("--size", default="1600x1000", metavar="WxH", help="of the picture")
    parser.add_argument("--time", type=float, metavar="S", help="time shown in the picture")


def call(given: argparse.Namespace) -> int:
    from rollerrig.configs.errors import ConfigError
    from rollerrig.realtime.telemetry import viewer

    if given.png:
        try:
            width, height = (int(part) for part in given.size.split("x"))
        except ValueError:
            raise ConfigError(f"--size {given.size}: write width x height, as in 1600x1000") from None
        result = {"picture": str(viewer.picture(given.run, given.png, (width, height), given.time))}
    else:
        result = viewer.open_run(given.run)
    if given.json:
        print(json.dumps(result, default=str))
    else:
        for key, value in result.items():
            print(f"{key}: {value}", file=sys.stderr)
    return 0
