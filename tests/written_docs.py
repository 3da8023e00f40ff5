"""Pages of docs/ and tables of pages that are written, not typed: `make docs` writes them, tests compare.

A test says which behaviour of a standard it holds with `@pytest.mark.conformance("CiA 301", "SDO block
download")`, more than once if it holds more than one; that is the table of conformance.
"""

import inspect
import re

import pytest
import test_architecture
from benchmarks import explain
from generator import thresholds
from generator.keep import KEPT
from robot.libdocpkg import LibraryDocumentation
from sealed.cases import GENERATORS

from rollerrig.firmware_sim.faults import catalogue
from rollerrig.rig import params
from rollerrig.rig.identify.causes import table as causes
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.train_recorder import recording
from rollerrig.wsp_interface import events, harness_client

STANDARDS = (
    "CAN",
    "Hub",
    "CiA 301",
    "CiA 305",
    "CiA 402",
    "CiA 406",
    "CiA 401",
    "Rig control",
    "Modbus",
    "Faults",
    "Bad input",
    "Masters",
)
ALL_ITEMS = pytest.StashKey[list[pytest.Item]]()


def write(folder, items):
    """Write the pages into a folder; `items`: all tests."""
    (folder / "faults.md").write_text(catalogue.markdown(), encoding="utf-8")
    (folder / "events.md").write_text(events.markdown(), encoding="utf-8")
    (folder / "conformance.md").write_text(conformance(items), encoding="utf-8")
    for name in TABLES:
        text = (folder / name).read_text(encoding="utf-8")
        (folder / name).write_text(with_tables(name, text), encoding="utf-8")


def conformance(items):
    """The table of conformance of some tests, as Markdown."""
    rows = {standard: {} for standard in STANDARDS}
    for item in items:
        name = item.path.relative_to(item.config.rootpath).as_posix()
        for mark in reversed(list(item.iter_markers("conformance"))):
            standard, behaviour = mark.args
            assert standard in STANDARDS, f"{item.nodeid}: no standard is called {standard!r}"
            rows[standard][f"| {behaviour} | `{name}` {item.originalname} |"] = None
    lines = [
        "# Conformance",
        "",
        "Written by `make docs`. Each behaviour is held by the test beside it.",
    ]
    for standard, mine in rows.items():
        lines += (
            ["", f"## {standard}", "", "| behaviour | test |", "|---|---|", *mine] if mine else []
        )
    return "\n".join(lines) + "\n"


def keys(rows):
    """Lines of a table of keys; a default outside the bounds stands for "not given"."""
    for row in rows:
        if isinstance(row.default, str):
            default, allowed = f'`"{row.default}"`' if row.default else "", ", ".join(row.choices)
        else:
            default = f"{row.default:g}" if row.low <= row.default <= row.high else ""
            allowed = f"{row.low:g} to {row.high:g}"
        yield f"| `{row.name.removesuffix('_set')}` | {default} | {allowed} | {row.source} |"


def floors():
    """Lines of the table of rooms."""
    for folder, line in test_architecture.FLOORS.items():
        told = [", ".join(floor.split()) for floor in line.split("|")]
        yield f"| `{folder + '/' if folder else 'rollerrig'}` | {' < '.join(told)} |"


def overrides():
    """Lines of the table of parameters that a dataset may override."""
    for section in ("vehicle", "adhesion", "contact", "brake"):
        yield f"| `[{section}]` | {', '.join(f'`{row.name}`' for row in params.ROWS[section])} |"
    yield "| `[axles]` | `positions_m`: metres behind the first wheelset, rising |"


def searches():
    """Lines of the table of causes; a cause in a window is searched in bins."""
    for one in causes.TABLE[:-1]:  # the last is the empirical formula, no cause
        cells = (
            len(one.shapes) or "bins",
            f"{one.floor:g}" if one.floor else "",
            one.price or "",
            f"{one.alpha:.1g}",
            ", ".join(one.remainder_along),
        )
        yield f"| `{one.name}` | {one.mechanism.text} | {' | '.join(map(str, cells))} |"


def rates():
    """Lines of the table of how often `explain` is right, from the answers that are kept."""
    found = [
        explain.judge(folder, folder / "explain.json")["rows"]
        for folder in map(KEPT.joinpath, GENERATORS)
    ]
    for rows in zip(*found, strict=True):
        cells = [
            f"{row['yes']} of {row['of']}"
            if row["yes"] is not None
            else f"{row['share']:.2f} ({row['of']} sets)"
            for row in rows
        ]
        yield f"| {rows[0]['measure']} | {' | '.join(cells)} | {rows[0]['wanted']} |"


def harness():
    """Lines of the table of what a harness has."""
    for name, one in vars(harness_client.Harness).items():
        what = (inspect.getdoc(one) or "").partition("\n")[0]
        if inspect.isfunction(one) and not name.startswith("_"):
            given = list(inspect.signature(one).parameters.values())[1:]
            arguments = ", ".join(
                re.sub(r": .+?(?= = |$)", "", str(each)).replace(" = ", "=") for each in given
            )
            yield f"| `{name}({arguments})` | {what} |"
        elif isinstance(one, property):
            yield f"| `{name}` | {what} |"


def keywords():
    """Lines of the table of Robot Framework's keywords, as its libdoc has them."""
    for one in LibraryDocumentation("rollerrig.wsp_interface.robot").keywords:
        arguments = ", ".join(
            f"`{re.sub(': [a-z]+', '', str(argument)).replace(' = ', '=')}`"
            for argument in one.args
        )
        yield f"| `{one.name}` | {arguments} | {one.short_doc.replace('``', '`')} |"


# page -> tables of it by the line of their heads
TABLES = {
    "architecture.md": {"| room | floors, the lowest first |": floors},
    "datasets.md": {
        "| key | default | allowed | what |": lambda: keys(dataset.HEAD),
        "| key of a run | default | allowed | what |": lambda: keys(dataset.RUN),
        "| key of the accuracy | default | allowed | what |": lambda: keys(dataset.ACCURACY),
        "| table | its keys |": overrides,
    },
    "recorders.md": {
        "| key | default | allowed | what |": lambda: keys(recording.HEAD),
        "| key of a channel | default | allowed | what |": lambda: keys(recording.CHANNEL),
        "| key of a run | default | allowed | what |": lambda: keys(recording.RUN),
    },
    "robot.md": {"| keyword | arguments | what |": keywords},
    "sequences.md": {"| of the harness | what |": harness},
    "explain.md": {
        "| cause | what happens | forms tried | floor | price | p below | may go by |": searches,
        "| measure | first | second | third | wanted |": rates,
        thresholds.HEAD: thresholds.rows,
        thresholds.FORM_HEAD: thresholds.form_rows,
    },
}


def with_tables(name, text):
    """A page with its written tables as they are now."""
    for head, rows in TABLES[name].items():
        assert f"\n{head}\n" in text, f"{name} has no table {head}"
        found = re.compile(rf"(?<=^{re.escape(head)}\n)(?:\|.*\n)+", re.MULTILINE)
        text = found.sub(
            lambda _, rows=rows, head=head: (
                "\n".join(["|---" * (head.count("|") - 1) + "|", *rows()]) + "\n"
            ),
            text,
        )
    return text
