"""`rollerrig list`: what there is by name, each with its title, from the tables and packaged files themselves."""

import argparse
from pathlib import Path

from rollerrig.configs import store
from rollerrig.realtime.commands import output

KINDS = ("scenarios", "faults", "signals", "sequences", "datasets", "campaigns", "adhesion")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", choices=KINDS, metavar="KIND", help=", ".join(KINDS))


def call(given: argparse.Namespace) -> int:
    rows = named(given.kind)
    return output.show(
        given,
        {given.kind: [{"name": name, "title": title} for name, title in rows]},
        (None, ("name", "title"), rows),
    )


def named(kind: str) -> list[tuple[str, str]]:
    """Names and titles of a kind, in the order of its table or by name."""
    if kind == "faults":
        from rollerrig.firmware_sim.faults import catalogue

        return [(one.name, one.text) for one in catalogue.CATALOGUE]
    if kind == "signals":
        from rollerrig.wsp_interface import signals

        return [
            (one.name, f"{one.text} ({one.unit})" if one.unit else one.text)
            for one in signals.SIGNALS
        ]
    if kind == "datasets":
        from rollerrig.rig.identify.data import dataset

        files = sorted(store.ROOT.glob("datasets/*/dataset.toml"))
        return [(path.parent.name, dataset.parse(path)["title"]) for path in files]
    return [(name, _title(store.find(kind, name))) for name in store.names(kind)]


def _title(path: Path) -> str:
    """A file's title, or the comment that it begins with."""
    first = path.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")
    return str(store.parse(path).get("title") or first)
