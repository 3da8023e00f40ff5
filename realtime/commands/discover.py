"""`rollerrig hide`: a rig that hides something; `rollerrig discover`: a rig that finds out by itself what that is."""

import argparse
import secrets
from pathlib import Path

from rollerrig.realtime.commands import explain, output


def hide_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scenario",
        nargs="?",
        default="velim_a1",
        help="what the rig starts from: a packaged scenario, or a TOML file (default: velim_a1)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("sealed.toml"),
        metavar="FILE",
        help="the sealed rig, a scenario (default: sealed.toml)",
    )
    parser.add_argument(
        "--key",
        type=Path,
        metavar="FILE",
        help="what is hidden, in plain words, for afterwards "
        "(default: beside the rig, as sealed.key)",
    )
    parser.add_argument("--seed", type=int, help="the same seed hides the same (default: drawn)")
    parser.add_argument(
        "--effects", type=int, default=0, metavar="N", help="1 or 2 (default: 0, either)"
    )


def hide(given: argparse.Namespace) -> int:
    from rollerrig.realtime.discover import sealed_rig

    key = given.key or given.out.with_suffix(".key")
    sealed_rig.hide(
        given.scenario,
        secrets.randbits(32) if given.seed is None else given.seed,
        given.effects,
        given.out,
        key,
    )
    return output.show(
        given,
        {"rig": str(given.out), "key": str(key)},
        f"sealed rig: {given.out}; find out with: rollerrig discover {given.out}",
        f"its key, to be read afterwards: {key}",
    )


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("rig", help="a sealed rig, or any scenario by name or TOML file")
    parser.add_argument(
        "--stops",
        type=int,
        default=9,
        metavar="N",
        help="stops that may be run, at least 3 (default: 9)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the null simulations (default: 0)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of stops, history and report; one that was "
        "begun is gone on with (default: reports/discover_RIG)",
    )


def call(given: argparse.Namespace) -> int:
    from rollerrig.realtime.discover import discover

    out = given.out or Path("reports") / f"discover_{Path(given.rig).stem}"
    with explain.progress_bar() as progress:
        account, history = discover.find_out(
            given.rig, out, given.stops, given.seed, output.print_message, progress
        )
        return explain.write_and_show(given, account, out, progress, history=history)
