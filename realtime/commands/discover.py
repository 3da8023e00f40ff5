"""`rollerrig hide` makes a rig with hidden effects; `rollerrig discover` finds them."""

import argparse
import secrets
import shlex
from pathlib import Path

from rollerrig.realtime.commands import explain, output


def hide_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig hide`."""
    parser.add_argument(
        "scenario",
        nargs="?",
        default="velim_a1",
        help="scenario that the rig is made from: a packaged scenario, or a TOML file "
        "(default: velim_a1)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("sealed.toml"),
        metavar="FILE",
        help="file for the sealed rig, which is a scenario (default: sealed.toml)",
    )
    parser.add_argument(
        "--key",
        type=Path,
        metavar="FILE",
        help="file for the key, which lists the hidden effects in plain words; read it after the "
        "search (default: next to the rig, as in sealed.key)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        help="seed of the choice; the same seed hides the same effects (default: random)",
    )
    parser.add_argument(
        "--effects",
        type=int,
        default=0,
        metavar="N",
        help="number of hidden effects, 1 or 2; 0 leaves the number to the seed (default: 0)",
    )


def hide(options: argparse.Namespace) -> int:
    """Write a sealed rig and its key. Returns PASS."""
    from rollerrig.realtime.discover import sealed_rig

    key = options.key or options.out.with_suffix(".key")
    seed = secrets.randbits(32) if options.seed is None else options.seed
    sealed_rig.hide(options.scenario, seed, options.effects, options.out, key)

    return output.show(
        options,
        {"rig": str(options.out), "key": str(key)},
        f"sealed rig: {options.out}; search it with: "
        f"rollerrig discover {shlex.quote(str(options.out))}",
        f"key, to be read after the search: {key}",
    )


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig discover`."""
    parser.add_argument("rig", help="a sealed rig, or any scenario by its name or TOML file")
    parser.add_argument(
        "--stops",
        type=int,
        default=9,
        metavar="N",
        help="largest number of stops, at least 3 (default: 9)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the null simulations (default: 0)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for stops, history and report; an unfinished search in it is continued "
        "(default: reports/discover_RIG)",
    )


def call(options: argparse.Namespace) -> int:
    """Search a rig for hidden effects and write the report. Returns the exit status."""
    from rollerrig.realtime.discover import discover

    out = options.out or Path("reports") / f"discover_{Path(options.rig).stem}"
    with explain.progress_bar() as progress:
        diagnosis, history = discover.find_out(
            options.rig,
            out,
            options.stops,
            options.seed,
            output.print_message,
            progress,
        )
        return explain.write_and_show(options, diagnosis, out, progress, history=history)
