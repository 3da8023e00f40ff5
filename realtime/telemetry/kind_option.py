"""The option with which the bench gives the kind of its vehicle to recorder and live view."""

import argparse
import json

from rollerrig.configs.vehicle import Kind


def words(kind: Kind) -> tuple[str, str]:
    """Return the option for a kind of vehicle, as words of a command line."""
    return "--kind", json.dumps(kind)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the option to a parser; it becomes a `Kind`."""
    parser.add_argument(
        "--kind",
        type=lambda text: Kind(*json.loads(text)),
        required=True,
        metavar="JSON",
        help="the kind of the vehicle, a list of its fields",
    )
