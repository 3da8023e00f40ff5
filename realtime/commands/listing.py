"""`rollerrig list`: prints everything of a kind that has a name, with its title.

Names and titles come from the tables of the program and from the packaged files.
"""

import argparse
from pathlib import Path

from rollerrig.configs import store
from rollerrig.realtime.commands import output

# the kinds, with what they are
TITLES = {
    "scenarios": "a stop: vehicle, rig, adhesion, speed and brake demand",
    "faults": "what can go wrong in sensors, devices and buses",
    "signals": "what is recorded, with its unit",
    "sequences": "a scripted test over the buses, with its limits",
    "programmes": "groups of sequences that test one unit together",
    "datasets": "measured or synthetic stops, to be explained",
    "campaigns": "a plan of many runs",
    "adhesion": "what is between wheel and roller",
}
KINDS = tuple(TITLES)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig list`."""
    parser.add_argument(
        "kind",
        nargs="?",
        choices=KINDS,
        metavar="KIND",
        help=f"{', '.join(KINDS)} (default: list these kinds)",
    )


def call(options: argparse.Namespace) -> int:
    """Print the names and titles of a kind, or the kinds. Returns PASS."""
    rows = names_and_titles(options.kind) if options.kind else list(TITLES.items())
    entries = [{"name": name, "title": title} for name, title in rows]
    if options.kind:
        return output.show(options, {options.kind: entries}, (None, ("name", "title"), rows))
    return output.show(
        options,
        {"kinds": entries},
        (None, ("kind", "what it is"), rows),
        "print one with: rollerrig list KIND",
    )


def names_and_titles(kind: str) -> list[tuple[str, str]]:
    """Return the names and titles of a kind.

    Faults and signals keep the order of their tables. The other kinds are sorted by name.
    """
    # each kind imports only the module that it needs
    if kind == "faults":
        from rollerrig.firmware_sim.faults import catalogue

        return [(fault.name, fault.text) for fault in catalogue.CATALOGUE]

    if kind == "signals":
        from rollerrig.wsp_interface import signals

        rows = []
        for signal in signals.SIGNALS:
            title = f"{signal.text} ({signal.unit})" if signal.unit else signal.text
            rows.append((signal.name, title))
        return rows

    if kind == "datasets":
        from rollerrig.rig.identify.data import dataset

        files = sorted(store.ROOT.glob("datasets/*/dataset.toml"))
        return [(path.parent.name, dataset.parse(path)["title"]) for path in files]

    names = [*store.names(kind), *store.names_of_vehicles(kind)]
    return [(name, _title(store.find(kind, name))) for name in names]


def _title(path: Path) -> str:
    """Return the title of a TOML file; without a title, the comment in its first line."""
    first_line, _, _ = path.read_text(encoding="utf-8").partition("\n")
    comment = first_line.lstrip("# ")
    return str(store.parse(path).get("title") or comment)
