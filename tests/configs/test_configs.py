"""Every packaged configuration loads, has sources for its numbers, runs and repeats."""

import itertools
import re
import tomllib

import numpy as np
import pytest

from rollerrig.configs import store, table
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import MOST_AXLES
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop import tick

SETS = {"vehicles": "vehicle", "rigs": "rig", "adhesion": "adhesion", "buses": "bus"}
# vehicles with other numbers of axles are in test_vehicles
SCENARIOS = scenario.names()
# Sequences and criteria have a source field for each limit, and datasets are data. Other tests
# check these.
KINDS = (*SETS, "scenarios", "wsp", "campaigns", "couplers", "trains")
FILES = sorted(path for kind in KINDS for path in (store.ROOT / kind).glob("*.toml"))
RUN_S = 4.0
RECORD_HZ = 100
DIGITS = set("123456789")  # a number without them is zero
# words that give the source of a number
SOURCE = re.compile(
    r"assumption|paper|Table \d|EN 1\d{4}|rail head R|recollection|as on soap|"
    r"as in \w+\.toml|this project|the rig's",
    re.IGNORECASE,
)
# words by which the comment at the head of a file covers all its numbers
ALL = re.compile(r"every number|all data|throughout", re.IGNORECASE)
# scenarios that the documents promise
PROMISED = {
    "velim_a1",
    "velim_a2",
    "velim_a3",
    "velim_b1",
    "velim_b2",
    "velim_b3",
    "dry_stop",
    "step_adhesion",
    "leaf_film",
}
# initial speeds of the tests at Velim, from Table 5 of the paper
TABLE_5_M_S = {
    "velim_a1": 42.3,
    "velim_a2": 40.4,
    "velim_a3": 40.8,
    "velim_b1": 40.8,
    "velim_b2": 41.1,
    "velim_b3": 41.8,
}


def test_the_promised_scenarios_and_sets_are_packaged():
    assert set(SCENARIOS) >= PROMISED
    assert set(store.names("adhesion")) >= {"dry", "wet_clean", "soap", "wet_leaves"}
    # earlier names
    assert store.find("adhesion", "wet") == store.find("adhesion", "wet_clean")
    assert store.find("adhesion", "leaf_film") == store.find("adhesion", "wet_leaves")
    assert store.names("vehicles")
    assert store.names("rigs")
    for name, speed_m_s in TABLE_5_M_S.items():
        assert scenario.load(name)["initial_speed_m_s"] == speed_m_s


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(store.ROOT).as_posix())
def test_a_file_is_toml_and_describes_itself_in_words(path):
    text = path.read_text(encoding="utf-8")
    content = tomllib.loads(text)
    begins_with_comment = text.startswith("#")
    title = str(content.get("title", ""))
    assert begins_with_comment or len(title.split()) >= 4


def without_source(text):
    """Yield the lines with a number for which no comment gives a source.

    The source is in the comment after the number, or after or above the head of its table. It may
    also be in the comment at the beginning of the file, if the file has only one table or the
    comment covers every number.
    """
    lines = text.splitlines()
    head = " ".join(itertools.takewhile(lambda line: line.startswith("#"), lines))
    only_table = sum(line.startswith("[") for line in lines) <= 1
    file_has_source = bool(SOURCE.search(head) and (only_table or ALL.search(head)))

    table_has_source = file_has_source
    above = ""  # the comment lines directly above
    for line in lines:
        code, _, comment = line.partition("#")
        if code.startswith("["):
            table_has_source = file_has_source or bool(SOURCE.search(above + comment))
        elif has_number(code) and not table_has_source and not SOURCE.search(comment):
            yield line
        comment_only = comment and not code
        above = above + comment if comment_only else ""


def has_number(code):
    """Return whether the value of a key is or contains a number other than zero."""
    value = code.partition("=")[2].strip()
    is_text = value.startswith('"')
    return not is_text and bool(set(value) & DIGITS)


def test_a_number_without_source_is_found():
    text = """[a]
x = 1.0  # assumption
y = 2.0
# Table 3
[b]
z = 3
[c]  # assumption
name = 'd'
w = 4
"""
    assert list(without_source(text)) == ["y = 2.0"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(store.ROOT).as_posix())
def test_every_number_or_its_table_has_a_source(path):
    assert list(without_source(path.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize(("kind", "short"), SETS.items())
def test_every_set_loads_in_a_scenario(kind, short):
    for name in store.names(kind):
        packaged, _ = store.load(kind, name)
        plan = scenario.load("velim_a1", settings=(f"{short}={name}",))
        assert plan[f"{short}_set"] == name
        for section, values in packaged.items():
            for key, value in values.items():
                if isinstance(value, int | float | str):
                    assert plan[section][key] == value


@pytest.mark.parametrize("name", store.names("wsp"))
def test_every_wsp_configuration_loads(name):
    assert logic.new_unit(logic.load(name))


def run(plan):
    """Run some seconds without deadlines, with the reference units in the tick.

    Return the samples, with the columns of the vehicle.
    """
    memory = rings.Memory(1 << 10, plan.table)
    machine = tick_data.build(plan, memory)
    unit = logic.load(plan["wsp_config"])
    units = tick.Units(np.zeros((plan.kind.groups, logic.SIZE)), unit)
    inputs = np.zeros(2 * MOST_AXLES, dtype=np.int64)
    ticks = round(RUN_S * plan["loop"]["tick_hz"])
    tick.run_ticks_with_units(machine, ticks, plan.sync_ticks, units, inputs)
    return memory.recorded


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_runs_and_repeats(name):
    plan = scenario.load(name, settings=(f"duration_max_s={RUN_S}",))
    first = run(plan)
    second = run(plan)
    assert len(first) == round(RUN_S * RECORD_HZ)
    assert first.tobytes() == second.tobytes()

    # the units have sent no reference speed before the first cycle
    for unit in plan.table.reference_speeds:
        first[0, plan.table.columns.index(f"{unit}_m_s")] = 0.0
    assert np.isfinite(first).all()

    speed_m_s = first[:, plan.table.columns.index("vehicle_speed_m_s")]
    if "traction" not in plan.resolved:
        assert speed_m_s[-1] < speed_m_s[0]
        assert (np.diff(speed_m_s) <= 1e-9).all()


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_resolved_scenario_is_the_same_scenario(name, tmp_path):
    plan = scenario.load(name)
    (tmp_path / "scenario.toml").write_text(scenario.dump(plan))
    loaded = scenario.load(str(tmp_path / "scenario.toml"))
    assert loaded.resolved == plan.resolved


def test_the_error_for_an_unknown_name_lists_the_known_ones():
    for kind in SETS:
        with pytest.raises(ConfigError) as caught:
            store.find(kind, "nothing_of_the_kind")
        for name in store.names(kind):
            assert name in str(caught.value)


def test_rows_refuse_what_their_kind_does_not_allow():
    rows = (
        table.number("a_m", 1.0, 0.0, 2.0, "s"),
        table.integer("n", 3, 1, 9, "s"),
        table.flag("on", True, "s"),
        table.choice("word", "x", ("x", "y"), "s"),
        table.number("must_m", None, 0.0, 1.0, "s"),
    )
    good = {"must_m": 0.5}
    assert table.read(rows, good, "w") == {
        "a_m": 1.0,
        "n": 3,
        "on": True,
        "word": "x",
        "must_m": 0.5,
    }
    # a whole number may be written as a float, and a float as a whole number
    assert table.read(rows, good | {"a_m": 2, "n": 4.0}, "w")["n"] == 4
    for bad in (
        {"a_m": 2.1},
        {"a_m": True},
        {"a_m": "1"},
        {"n": 1.5},
        {"n": 0},
        {"on": 1},
        {"word": "z"},
        {"word": 1},
        {"a": 1.0},  # no such key
    ):
        with pytest.raises(ConfigError, match=r"^w: "):
            table.read(rows, good | bad, "w")
    with pytest.raises(ConfigError, match="must_m is missing"):
        table.read(rows, {}, "w")
