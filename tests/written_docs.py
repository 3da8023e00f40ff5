"""Generated pages of docs/ and generated tables: `make docs` writes them, and tests compare.

A test names the behaviour of a standard that it checks with a mark, or with several:
`@pytest.mark.conformance("CiA 301", "SDO block download")`. The table of conformance is made of
these marks.
"""

import inspect
import itertools
import re

import licences
import test_architecture
import written_reference
from benchmarks import explain
from generator import thresholds
from generator.keep import KEPT
from robot.libdocpkg import LibraryDocumentation
from sealed.cases import GENERATORS

from rollerrig.configs import store
from rollerrig.configs.vehicle import COACH, COACH_AXLES, Kind
from rollerrig.firmware_sim import bench_node
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.firmware_sim.modbus import map as modbus_map
from rollerrig.rig import params
from rollerrig.rig.identify.causes import table as causes
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.train_recorder import recording
from rollerrig.wsp_interface import events, harness_client, signals

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
# a vehicle with everything that the coach lacks, on as many axles
EQUIPPED = Kind(COACH_AXLES, dynamic_brake=True, magnetic_track_brake=True)


def write(folder, items):
    """Write the generated pages and tables into a folder; `items`: all tests."""
    (folder / "faults.md").write_text(catalogue.markdown(), encoding="utf-8")
    (folder / "events.md").write_text(events.markdown(), encoding="utf-8")
    (folder / "licences.md").write_text(licences.markdown(), encoding="utf-8")
    (folder / "conformance.md").write_text(conformance(items), encoding="utf-8")
    for name, page in written_reference.PAGES.items():
        (folder / name).write_text(page(), encoding="utf-8")
    for name in TABLES:
        text = (folder / name).read_text(encoding="utf-8")
        (folder / name).write_text(with_tables(name, text), encoding="utf-8")


def conformance(items):
    """Return the table of conformance of some tests, as Markdown."""
    rows = {standard: {} for standard in STANDARDS}
    for item in items:
        name = item.path.relative_to(item.config.rootpath).as_posix()
        for mark in reversed(list(item.iter_markers("conformance"))):
            standard, behaviour = mark.args
            assert standard in STANDARDS, (
                f"{item.nodeid}: there is no standard {standard!r}; use one of {STANDARDS}"
            )
            rows[standard][f"| {behaviour} | `{name}` {item.originalname} |"] = None
    lines = [
        "# Conformance",
        "",
        "This page is for engineers who want to know which rules of a standard rollerrig follows. After",
        "reading it you can find the test that checks each rule, in the second column.",
        "`make docs` writes this page from the marks of the tests.",
    ]
    for standard, behaviours in rows.items():
        if behaviours:
            lines += ["", f"## {standard}", "", "| behaviour | test |", "|---|---|", *behaviours]
    return "\n".join(lines) + "\n"


def keys(rows):
    """Yield the lines of a table of keys; a default outside the bounds means "not given"."""
    for row in rows:
        if isinstance(row.default, str):
            default = f'`"{row.default}"`' if row.default else ""
            # a bar would begin the next cell
            allowed = ", ".join(row.choices).replace("|", r"\|")
        else:
            default = f"{row.default:g}" if row.low <= row.default <= row.high else ""
            allowed = f"{row.low:g} to {row.high:g}"
        yield f"| `{row.name.removesuffix('_set')}` | {default} | {allowed} | {row.source} |"


def floors():
    """Yield the lines of the table of rooms."""
    for folder, floors_of_folder in test_architecture.FLOORS.items():
        name = f"{folder}/" if folder else "rollerrig"
        rooms = [", ".join(floor.split()) for floor in floors_of_folder]
        yield f"| `{name}` | {' < '.join(rooms)} |"


def overrides():
    """Yield the lines of the table of parameters that a dataset may override."""
    for section in ("vehicle", "adhesion", "contact", "brake"):
        keys_of_section = ", ".join(f"`{row.name}`" for row in params.ROWS[section])
        yield f"| `[{section}]` | {keys_of_section} |"
    yield "| `[axles]` | `positions_m`: metres behind the first wheelset, rising |"


def searches():
    """Yield the lines of the table of causes; a cause in a window is searched in bins."""
    # the last row is the empirical formula, which is no cause
    for cause in causes.TABLE[:-1]:
        cells = (
            len(cause.shapes) or "bins",
            f"{cause.floor:g}" if cause.floor else "",
            cause.price or "",
            f"{cause.alpha:.1g}",
            ", ".join(cause.remainder_along),
        )
        yield f"| `{cause.name}` | {cause.mechanism.text} | {' | '.join(map(str, cells))} |"


def equations():
    """Yield the lines of the table of the equations of the causes, with their parameters."""
    # the last row is the empirical formula, which is no cause
    for cause in causes.TABLE[:-1]:
        mechanism = cause.mechanism
        sizes = [f"`{row.name}` ({row.source})" for row in mechanism.parameters]
        equation = mechanism.formula.rstrip(".").replace("|", r"\|")
        yield f"| `{cause.name}` | {equation} | {', '.join(sizes)} |"


def thresholds_of_data():
    """Yield the lines of the table of thresholds with which the data of braking runs are judged."""
    data = ("quality", "units", "pressures", "preparation", "pulses")
    base = ("rolling", "weight", "channels", "sampling", "reference")
    yield from numbers_of("rig/identify/data", data)
    yield from numbers_of("rig/identify/base", base)


def thresholds_of_decision():
    """Yield the lines of the table of thresholds with which causes are found and decided."""
    yield from numbers_of("rig/identify/replay", ("replay",))
    yield from numbers_of("rig/identify/causes", ("columns", "discrepancy"))
    yield from numbers_of("rig/identify/decide", ("thresholds", "gain"))


def thresholds_of_recordings():
    """Yield the lines of the table of thresholds with which recordings of a train are judged."""
    yield from numbers_of("rig/identify/train_recorder", ("thresholds",))


def numbers_of(folder, modules):
    """Yield a line for each commented number of some modules."""
    paths = [f"{folder}/{module}.py" for module in modules]
    for path, name, value, reason in commented_numbers(paths):
        yield f"| `{name}` | {value} | `{path}` | {reason} |"


def thresholds_of_creep_curves():
    """Yield the lines of the table of thresholds with which creep curves are judged."""
    modules = ("judgement", "shape", "conditions", "factors", "laws")
    yield from numbers_of("rig/identify/creep_curves", modules)


def commented_numbers(paths):
    """Yield (path, name, value, comment) of the numbers of some modules.

    Numbers without a blank line or a comment between them share the comment above the first.
    """
    number = re.compile(r"([A-Z][A-Z_0-9]*) = (-?[0-9][-0-9._e/ ]*?)(?:  # (.*))?$")
    for path in paths:
        comment = ""
        is_comment = False
        for line in (test_architecture.ROOT / path).read_text(encoding="utf-8").splitlines():
            was_comment = is_comment
            is_comment = line.startswith("# ") and not line.startswith("# ---")
            found = number.match(line)
            if is_comment:
                words = line.removeprefix("# ")
                comment = f"{comment} {words}" if was_comment else words
            elif found:
                name, value, words_behind = found.groups()
                reasons = [words.rstrip(".,") for words in (comment, words_behind) if words]
                if reasons:
                    yield path, name, value, "; ".join(reasons)
            elif not line:
                comment = ""


def rates():
    """Yield the lines of the table of how often `explain` is right, from the kept answers."""
    by_generator = []
    for generator in GENERATORS:
        folder = KEPT / generator
        by_generator.append(explain.judge(folder, folder / "explain.json")["rows"])
    for rows in zip(*by_generator, strict=True):
        cells = [_rate(row) for row in rows]
        first = rows[0]
        yield f"| {first['measure']} | {' | '.join(cells)} | {first['wanted']} | {_met(rows)} |"


def _met(rows):
    """Return whether a measure is as wanted, and the generators on which it is not."""
    if not rows[0]["wanted"]:
        return ""
    missed = []
    for generator, row in zip(GENERATORS, rows, strict=True):
        if not _is_as_wanted(row):
            missed.append(generator)
    return f"no: {', '.join(missed)}" if missed else "yes"


def _is_as_wanted(row):
    """Return whether a measure is within its wanted bound or bounds."""
    share = row["share"]
    words = row["wanted"].split()
    if words == ["all"]:
        return row["yes"] == row["of"]
    if words[0] == ">=":
        return share >= float(words[1])
    if words[0] == "<=":
        return share <= float(words[1])
    low, to, high = words
    assert to == "to", row["wanted"]
    return float(low) <= share <= float(high)


def _rate(row):
    """Return the text of a measure: a count, or the mean or median of some sets."""
    if row["yes"] is not None:
        return f"{row['yes']} of {row['of']}"
    return f"{row['share']:.2f} ({row['of']} sets)"


def harness():
    """Yield the lines of the table of what a harness has: its methods and properties."""
    for name, member in vars(harness_client.Harness).items():
        summary = (inspect.getdoc(member) or "").partition("\n")[0]
        if inspect.isfunction(member) and not name.startswith("_"):
            _, *parameters = inspect.signature(member).parameters.values()
            # without types, and without spaces at the default
            arguments = ", ".join(
                re.sub(r": .+?(?= = |$)", "", str(parameter)).replace(" = ", "=")
                for parameter in parameters
            )
            yield f"| `{name}({arguments})` | {summary} |"
        elif isinstance(member, property):
            yield f"| `{name}` | {summary} |"


def keywords():
    """Yield the lines of the table of Robot Framework's keywords, from its libdoc."""
    for keyword in LibraryDocumentation("rollerrig.wsp_interface.robot").keywords:
        arguments = ", ".join(
            f"`{re.sub(': [a-z]+', '', str(argument)).replace(' = ', '=')}`"
            for argument in keyword.args
        )
        yield f"| `{keyword.name}` | {arguments} | {keyword.short_doc.replace('``', '`')} |"


def without_axle(name):
    """Return a name without the number of the axle at its end."""
    return re.sub(r"[_ ]?\d+$", "", name)


def count_of(factor, unit):
    """Return the text of the value of one count."""
    return f"{factor:g} {unit.replace('_', '/')}".strip()


def registers(kind=COACH, without=()):
    """Yield the lines of the table of Modbus registers, one for all axles of a signal."""
    rows = [row for row in modbus_map.words(signals.table(kind)) if row not in without]
    rows.sort(key=lambda row: row.address)
    for (name, text), found in itertools.groupby(
        rows, lambda row: (without_axle(row.name), row.text)
    ):
        same = list(found)
        first = same[0]
        end = same[-1].address + same[-1].width - 1
        places = str(first.address) if end == first.address else f"{first.address} to {end}"
        shown = name if len(same) > 1 else first.name
        count = count_of(first.scale, first.unit)
        if first.of:
            count = f"{first.scale:g} x `{first.of}`"
        yield f"| {places} | `{shown}` | {text} | {first.kind} {first.access} | {count} |"


def registers_of_equipment():
    """Yield the lines of the table of registers that a vehicle with motors and magnets adds."""
    yield from registers(EQUIPPED, without=modbus_map.words(signals.table(COACH)))


def bits():
    """Yield the lines of the table of Modbus bits."""
    for row in modbus_map.BITS:
        yield f"| {row.address} | `{row.name}` | {row.text} | {row.access} |"


def bench_objects():
    """Yield the lines of the table of the objects of node 127, one for all axles of a signal."""
    rows = [row for row in bench_node.rows(signals.table(COACH), "wall") if row.access != "const"]
    rows.sort(key=lambda row: (row.index, row.sub))
    for _, found in itertools.groupby(rows, lambda row: (row.index, without_axle(row.name))):
        same = list(found)
        row = same[0]
        place = f"{row.index:X}h" + (f":{row.sub}" if row.sub else "")
        name = row.name.rpartition("/")[2]
        if len(same) > 1:
            place += f"..{same[-1].sub}"
            name = row.name.partition("/")[0]
        count = "" if row.kind == "TEXT" else count_of(row.factor, row.unit)
        yield f"| {place} | {name}: {row.text} | {row.kind} {row.access} | {count} |"


def titles(kind, names):
    """Yield the lines of a table of packaged files: name and title."""
    for name in names:
        title = store.parse(store.find(kind, name))["title"]
        yield f"| `{name}` | {title} |"


def scenarios():
    """Yield the lines of the table of packaged scenarios."""
    yield from titles("scenarios", store.names("scenarios"))


def sequences_of_the_coach():
    """Yield the lines of the table of sequences; those of false sensors are one for each axle."""
    names = [name for name in store.names("sequences") if not name.startswith("sensor_")]
    yield from titles("sequences", names)


def sequences_of_vehicles():
    """Yield the lines of the table of sequences of other vehicles."""
    yield from titles("sequences", store.names_of_vehicles("sequences"))


# by page: the tables in it, by the line of their heads
TABLES = {
    "architecture.md": {"| room | floors, the lowest first |": floors},
    "datasets.md": {
        "| key | default | allowed | what |": lambda: keys(dataset.HEAD),
        "| key of a run | default | allowed | what |": lambda: keys(dataset.RUN),
        "| key of a channel | default | allowed | what |": lambda: keys(dataset.CHANNEL),
        "| key of the accuracy | default | allowed | what |": lambda: keys(dataset.ACCURACY),
        "| table | its keys |": overrides,
    },
    "recorders.md": {
        "| key | default | allowed | what |": lambda: keys(recording.HEAD),
        "| key of a channel | default | allowed | what |": lambda: keys(recording.CHANNEL),
        "| key of a run | default | allowed | what |": lambda: keys(recording.RUN),
        "| threshold of a recording | value | where | reason |": thresholds_of_recordings,
    },
    "modbus.md": {
        "| bit | name | meaning | access |": bits,
        "| registers | name | meaning | kind | one count |": registers,
        "| registers of motors and magnets | name | meaning | kind | one count |": (
            registers_of_equipment
        ),
    },
    "runs.md": {"| scenario | stop |": scenarios},
    "sequences.md": {
        "| sequence of the coach | what it tests |": sequences_of_the_coach,
        "| sequence of another vehicle | what it tests |": sequences_of_vehicles,
        "| object | what | type | one count |": bench_objects,
    },
    "robot.md": {"| keyword | arguments | what |": keywords},
    "harness.md": {"| of the harness | what |": harness},
    "explain_causes.md": {
        "| cause | what happens | forms tried | floor | price | p below | may go by |": searches,
        "| cause | equation | parameters |": equations,
        "| threshold of the data | value | where | reason |": thresholds_of_data,
        "| threshold of the decision | value | where | reason |": thresholds_of_decision,
        "| threshold of creep curves | value | where | reason |": thresholds_of_creep_curves,
    },
    "explain_rates.md": {
        "| measure | first | second | third | wanted | met |": rates,
        thresholds.HEAD: thresholds.rows,
        thresholds.FORM_HEAD: thresholds.form_rows,
    },
}


def with_tables(name, text):
    """Return the text of a page with its generated tables as they are now."""
    for head, rows in TABLES[name].items():
        assert f"\n{head}\n" in text, f"{name} has no table {head}"
        lines = ["|---" * (head.count("|") - 1) + "|", *rows()]
        table = "\n".join(lines) + "\n"
        behind_head = re.compile(rf"(?<=^{re.escape(head)}\n)(?:\|.*\n)+", re.MULTILINE)
        text = behind_head.sub(lambda _, table=table: table, text)
    return text
