"""Pages that are written are what would be written now; tables that are typed agree with the code."""

import re
import tomllib
from pathlib import Path

from written_docs import ALL_ITEMS, conformance

from rollerrig.configs import store
from rollerrig.firmware_sim import bench_node
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.firmware_sim.modbus import map
from rollerrig.realtime.bench import scenario
from rollerrig.wsp_interface.sequences import measures, sequence

ROOT = Path(__file__).parent.parent


def rows_of(page, files):
    return [line for line in page.splitlines() if any(f"| `{file}` " in line for file in files)]


def test_the_page_of_conformance_is_up_to_date(docs, request):
    # as far as this session sees: all of it in `make test`
    items = request.config.stash[ALL_ITEMS]
    files = {item.path.relative_to(ROOT).as_posix() for item in items}
    page = (docs / "conformance.md").read_text(encoding="utf-8")
    assert rows_of(page, files) == rows_of(conformance(items), files), "run: make docs"


def test_the_page_of_conformance_names_tests_that_are_there(docs):
    told = re.findall(
        r"\| `([^`]+)` (\w+) \|$",
        (docs / "conformance.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    assert len(told) > 150
    texts = {name: (ROOT / name).read_text(encoding="utf-8") for name, _ in told}
    assert [test for name, test in told if f"def {test}(" not in texts[name]] == []


def test_the_page_of_faults_is_up_to_date(docs):
    text = (docs / "faults.md").read_text(encoding="utf-8")
    assert text == catalogue.markdown(), "run: make docs"
    assert [kind.name for kind in catalogue.CATALOGUE if f"| `{kind.name}` |" not in text] == []


def test_the_settings_on_the_page_of_modbus_are_the_defaults(docs):
    text = (docs / "modbus.md").read_text(encoding="utf-8")
    block = re.search(r"^    \[modbus\]\n(?:    .*\n)+", text, re.MULTILINE)
    told = tomllib.loads(re.sub(r"^    ", "", block[0], flags=re.MULTILINE))["modbus"]
    assert told == {row.name: row.default for row in scenario.SECTIONS["modbus"]}


def test_the_registers_on_the_page_of_modbus_are_those_of_the_map(docs):
    text = (docs / "modbus.md").read_text(encoding="utf-8")
    at = {row.name: row.at for row in (*map.BITS, *map.WORDS)}
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
    text = (docs / "sequences.md").read_text(encoding="utf-8")
    told = set()
    for first, last in re.findall(
        r"^\| (2\w{3})h(?:\.\.(2\w{3})h|[^|.]*(?:\.\.\d)?[^|.]*) \|", text, re.MULTILINE
    ):
        told |= set(range(int(first, 16), int(last or first, 16) + 1))
    assert told == {row.index for row in bench_node.rows("wall")}


def test_the_measures_on_the_page_of_sequences_are_those_that_are_known(docs):
    text = (docs / "sequences.md").read_text(encoding="utf-8")
    told = re.search(r"Measures: (.*?)\n\n", text, re.DOTALL)[1]
    assert set(re.findall(r"`(\w+)`", told)) == set(measures.BY_NAME)


def test_the_sequence_on_the_page_can_be_read(docs, tmp_path):
    text = (docs / "sequences.md").read_text(encoding="utf-8")
    block = re.search(r"^    title = .*?(?=\n\n[^ ])", text, re.DOTALL | re.MULTILINE)
    path = tmp_path / "own.toml"
    path.write_text(re.sub(r"^    ", "", block[0], flags=re.MULTILINE), encoding="utf-8")
    found = sequence.load(str(path))
    assert found.title in block[0]
    assert store.names("criteria")
