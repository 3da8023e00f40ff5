"""Generated pages are up to date, and hand-written tables agree with the code."""

import ast
import re
import tomllib
from pathlib import Path

import licences
import pytest
import test_architecture
import written_reference
from collected import ALL_ITEMS
from packaging.utils import canonicalize_name
from written_docs import conformance

from rollerrig.configs import store
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import bench_node
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.firmware_sim.modbus import map
from rollerrig.realtime.bench import scenario
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.sequences import measures, sequence

ROOT = Path(__file__).parent.parent


def read(page):
    """Return the text of a page."""
    return page.read_text(encoding="utf-8")


def rows_of(page, files):
    """Return the rows of the table of conformance that have tests of some files."""
    rows = []
    for line in page.splitlines():
        if any(f"| `{file}` " in line for file in files):
            rows.append(line)
    return rows


def test_the_page_of_conformance_is_up_to_date(docs, request):
    # only the rows of the collected files; with the whole suite these are all
    items = request.config.stash[ALL_ITEMS]
    files = {item.path.relative_to(ROOT).as_posix() for item in items}
    page = read(docs / "conformance.md")
    assert rows_of(page, files) == rows_of(conformance(items), files), "run: make docs"


def test_the_tests_on_the_page_of_conformance_exist(docs):
    page = read(docs / "conformance.md")
    listed = re.findall(r"\| `([^`]+)` (\w+) \|$", page, re.MULTILINE)
    assert len(listed) > 150
    texts = {file: read(ROOT / file) for file, _ in listed}
    assert [test for file, test in listed if f"def {test}(" not in texts[file]] == []


def test_the_page_of_faults_is_up_to_date(docs):
    text = read(docs / "faults.md")
    assert text == catalogue.markdown(), "run: make docs"
    assert [kind.name for kind in catalogue.CATALOGUE if f"| `{kind.name}` |" not in text] == []


@pytest.mark.parametrize("name", written_reference.PAGES)
def test_a_page_of_reference_is_up_to_date(docs, name):
    assert read(docs / name) == written_reference.PAGES[name](), "run: make docs"


def test_the_page_of_environment_variables_has_those_that_the_product_uses():
    # in files that use the environment, names in capitals with an underscore or of a screen
    used = set()
    for name, path in test_architecture.FILES.items():
        if "environ" not in read(path):
            continue
        tree = test_architecture.tree(name)
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                used.add(node.value)
            elif isinstance(node, ast.keyword):
                used.add(node.arg)
    # the library of the rig as an FMU is written in C
    for path in (test_architecture.ROOT / "realtime").rglob("*.c"):
        used.update(re.findall(r'getenv\("(\w+)"\)', path.read_text(encoding="utf-8")))
    names = {name for name in used if re.fullmatch("_?[A-Z]{2,}(_[A-Z]+)*", str(name))}
    not_variables = {"FILE", "FMU", "PREEMPT_RT", "VERB"}
    # the product sets them for itself or its children, whatever the user has set
    not_variables |= {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "PYTHONPATH"}
    assert names - not_variables == set(written_reference.ENVIRONMENT)


def test_the_page_of_licences_has_every_installed_package_and_its_declared_licence(docs):
    page = read(docs / "licences.md")
    copyleft_part, _, all_part = page.partition("## All packages")
    for package in licences.packages():
        assert f"{package.row}\n" in all_part, "run: make docs"
        assert (f"{package.row}\n" in copyleft_part) == licences.is_copyleft(package)

    # a package on the page that is not installed here is one that another Python version needs
    listed = re.findall(r"^\| ([a-z0-9-]+) \|", all_part, re.MULTILINE)
    assert len(listed) > 100
    pinned = {
        canonicalize_name(line.partition("==")[0])
        for line in read(ROOT / "constraints.txt").splitlines()
    }
    assert set(listed) - pinned - {"package"} == set()


def test_copyleft_licences_of_dependencies_are_known():
    # a new one needs a decision
    copyleft = {package.name for package in licences.packages() if licences.is_copyleft(package)}
    assert copyleft == {"asammdf", "bidict", "certifi", "docutils", "fpdf2", "orjson", "python-can"}


def test_the_settings_on_the_page_of_modbus_are_the_defaults(docs):
    text = read(docs / "modbus.md")
    block = re.search(r"^    \[modbus\]\n(?:    .*\n)+", text, re.MULTILINE)
    shown = tomllib.loads(without_indent(block[0]))["modbus"]
    assert shown == {row.name: row.default for row in scenario.SECTIONS["modbus"]}


def without_indent(block):
    """Return the text of an indented block."""
    return re.sub(r"^    ", "", block, flags=re.MULTILINE)


def test_the_registers_on_the_page_of_modbus_are_those_of_the_map(docs):
    text = read(docs / "modbus.md")
    at = {row.name: row.address for row in (*map.BITS, *map.words(signals.table(COACH)))}
    # a row of the table of steps, the text of its register or bit, and the name in the map
    for step, register, name in (
        ("choose a scenario", "register {}:", "scenario"),
        ("choose a speed", "register {}:", "speed_set_point"),
        ("set a brake demand", "register {}:", "brake_demand_set_point"),
        ("start", "bit {} ", "run"),
        ("stop early", "bit {} ", "stop"),
        ("emergency stop", "bit {},", "emergency_stop"),
        ("inject a fault", "then bit {};", "inject_fault"),
        ("inject a fault", "registers {} to", "fault"),
    ):
        row = re.search(rf"^\| {step}.*$", text, re.MULTILINE)[0]
        assert register.format(at[name]) in row, (step, name)


def test_the_objects_of_node_127_on_the_page_of_sequences_are_those_of_the_node(docs):
    text = read(docs / "sequences.md")
    # the first column is one object (2000h:1..3), or a range of objects (2100h..2105h)
    objects = r"^\| (2\w{3})h(?:\.\.(2\w{3})h|[^|.]*(?:\.\.\d)?[^|.]*) \|"
    listed = set()
    for first, last in re.findall(objects, text, re.MULTILINE):
        listed |= set(range(int(first, 16), int(last or first, 16) + 1))
    assert listed == {row.index for row in bench_node.rows(signals.table(COACH), "wall")}


def test_the_measures_on_the_page_of_sequences_exist(docs):
    text = read(docs / "sequences.md")
    chapter = re.search(r"\n## Measures\n(.*?)\n\nAll measures", text, re.DOTALL)[1]
    named = set(re.findall(r"`(\w+)`", chapter))
    assert named
    assert named <= set(measures.BY_NAME)


def test_the_sequence_on_the_page_loads(docs, tmp_path):
    text = read(docs / "sequences.md")
    block = re.search(r"^    title = .*?(?=\n\n[^ ])", text, re.DOTALL | re.MULTILINE)
    path = tmp_path / "sequence.toml"
    path.write_text(without_indent(block[0]), encoding="utf-8")
    loaded = sequence.load(str(path))
    assert loaded.title in block[0]
    assert store.names("criteria")
