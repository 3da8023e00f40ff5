"""`rollerrig wsp`: the reference WSP unit as a program of its own on a bus."""

import argparse

from rollerrig.wsp_interface.signals import DEFAULT_ADDRESS


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--bus", default=DEFAULT_ADDRESS, metavar="ADDRESS",
                        help=f"socketcand://HOST:PORT/rig0 or socketcan:vcan0 (default: "
                        f"{DEFAULT_ADDRESS})")
    parser.add_argument("--config", default="reference", metavar="NAME",
                        help="thresholds: a packaged configuration or a TOML file (default: reference)")


def call(given: argparse.Namespace) -> int:
    from rollerrig.firmware_sim.wsp import node

    return node.main(given.bus, given.config)
