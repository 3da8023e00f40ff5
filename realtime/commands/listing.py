"""`rollerrig list`: prints everything of a kind that has a name, with its title, or one file.

Names and titles come from the tables of the program and from the packaged files. `--show NAME`
prints a packaged file, so that a user can read it, or change a copy of it.
"""

import argparse
from pathlib import Path

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.realtime.commands import output

# the kinds, with what they are
TITLES = {
    "scenarios": "a stop: vehicle, rig, adhesion, speed and brake demand",
    "faults": "what can go wrong in sensors, devices and buses",
    "signals": "what is recorded, with its unit",
    "sequences": "a scripted test over the buses, with its limits",
    "programmes": "groups of sequences that test one unit together",
    "criteria": "limits that judge a run, each with its source",
    "trains": "a stop of several cars: vehicles, couplers, brake control",
    "couplers": "what joins two cars: force by displacement",
    "vehicles": "axles, masses, brakes and other equipment",
    "datasets": "measured or synthetic stops, to be explained",
    "campaigns": "a plan of many runs",
    "adhesion": "what is between wheel and roller",
}
KINDS = tuple(TITLES)
# kinds that are tables of the program, and have no files
_WITHOUT_FILES = ("faults", "signals")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `rollerrig list`."""
    parser.add_argument(
        "kind",
        nargs="?",
        choices=KINDS,
        metavar="KIND",
        help=f"{', '.join(KINDS)} (default: list these kinds)",
    )
    parser.add_argument(
        "--show",
        default="",
        metavar="NAME",
        help="print the packaged file of this name, as in 'rollerrig list sequences --show "
        "emergency_120 > my.toml'",
    )


def call(options: argparse.Namespace) -> int:
    """Print the names and titles of a kind, the kinds, or a packaged file. Returns PASS.

    Raises ConfigError if there is no such file.
    """
    if options.show:
        path = file_of(options.kind or "", options.show)
        text = path.read_text(encoding="utf-8")
        output.print_message(str(path))
        shown = {"name": options.show, "file": str(path), "text": text}
        return output.show(options, shown, text.rstrip("\n"))
    if options.kind == "faults":
        return _show_faults(options)
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


def _show_faults(options: argparse.Namespace) -> int:
    """Print the faults with the number that starts each over Modbus. Returns PASS."""
    from rollerrig.firmware_sim.faults import catalogue

    entries = []
    rows = []
    for fault in catalogue.CATALOGUE:
        title = _with_equipment(fault.text, fault.equipment)
        entries.append({"name": fault.name, "title": title, "modbus_number": fault.number})
        rows.append((str(fault.number), fault.name, title))
    # register 20 of the rig takes the number
    head = ("Modbus number", "name", "title")
    return output.show(options, {"faults": entries}, (None, head, rows))


def file_of(kind: str, name: str) -> Path:
    """Return the packaged file of a name. Raises ConfigError if there is none."""
    kinds_with_files = [one for one in KINDS if one not in _WITHOUT_FILES]
    if kind not in kinds_with_files:
        raise ConfigError(
            f"--show {name}: give the kind of the file, as in 'rollerrig list sequences --show "
            f"emergency_120'; kinds with files: {', '.join(kinds_with_files)}"
        )
    names = [name_of_kind for name_of_kind, _ in names_and_titles(kind)]
    if name not in names:
        raise ConfigError(f"--show {name}: no file of this name in {kind}{nearest(name, names)}")
    if kind == "datasets":
        return store.ROOT / kind / name / "dataset.toml"
    return store.find(kind, name)


def names_and_titles(kind: str) -> list[tuple[str, str]]:
    """Return the names and titles of a kind.

    Faults and signals keep the order of their tables. The other kinds are sorted by name.
    """
    # each kind imports only the module that it needs
    if kind == "faults":
        from rollerrig.firmware_sim.faults import catalogue

        return [
            (fault.name, _with_equipment(fault.text, fault.equipment))
            for fault in catalogue.CATALOGUE
        ]

    if kind == "signals":
        from rollerrig.wsp_interface import signals

        rows = []
        for signal in signals.ALL_SIGNALS:
            title = f"{signal.text} ({signal.unit})" if signal.unit else signal.text
            rows.append((signal.name, _with_equipment(title, signal.equipment)))
        return rows

    if kind == "datasets":
        from rollerrig.rig.identify.data import dataset

        files = sorted(store.ROOT.glob("datasets/*/dataset.toml"))
        return [(path.parent.name, dataset.parse(path)["title"]) for path in files]

    names = [*store.names(kind), *store.names_of_vehicles(kind)]
    return [(name, _title(store.find(kind, name))) for name in names]


def _with_equipment(title: str, equipment: str) -> str:
    """Return a title with the equipment that a vehicle needs; "" is none."""
    return f"{title}; only with [{equipment}]" if equipment else title


def _title(path: Path) -> str:
    """Return the title of a TOML file; without a title, the first sentence of its first comment."""
    title = store.parse(path).get("title")
    if title:
        return str(title)
    comment = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.lstrip("# "))
    first, dot, _ = " ".join(comment).partition(". ")
    return first + dot.rstrip()
