"""The documentation says what is so: commands parse, files exist, values and tables are the code's."""

import ast
import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import written_docs
from generator import thresholds as limits
from scipy.stats import binomtest

from rollerrig.realtime import cli
from rollerrig.realtime.benchmarks import figures
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.train_recorder import thresholds
from rollerrig.wsp_interface import rig_objects

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMES = [path.name for path in PAGES]
ROOMS = ("rig", "firmware_sim", "wsp_interface", "realtime", "configs", "tests", "docs", ".ci")
LONGEST_README = 130
# what a page says of files that a command writes, or of a reader's own
MADE = re.compile(r"^(runs|report|reports|campaigns|devices|stops|my|build)/")


def text_of(name):
    return (ROOT / name).read_text(encoding="utf-8")


def commands(path):
    """Command lines of `rollerrig` that a page shows, in blocks and between backticks, as lists of words."""
    text = path.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    lines += re.findall(r"`(rollerrig [^`]*)`", text.replace("\n", " "))
    for line in lines:
        begin = re.match(r"(?:\.venv/bin/)?rollerrig (?=[a-z])", line)
        if begin:
            words = shlex.split(line, comments=True)
            yield [word for word in words if word not in ("&", "...")][1:]


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_every_command_of_a_page_parses(path):
    parser = cli.parser()
    for words in commands(path):
        if len(words) == 1:  # a verb by its name
            assert words[0] in {verb.name for verb in cli.VERBS}
            continue
        parser.parse_args(words)


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_every_file_that_a_page_names_exists(path):
    text = path.read_text(encoding="utf-8")
    told = re.findall(r"`([\w.{}*-]+(?:/[\w.{}*-]+)*/?[\w.*-]*)`", text)
    named = {
        one for one in told if one.split("/")[0] in ROOMS and "/" in one and not MADE.match(one)
    }
    named |= {
        one
        for one in re.findall(r"(?<![\w./-])((?:\w+/)+\w+\.(?:py|go|toml|md))\b", text)
        if not MADE.match(one)
    }
    bases = (ROOT, ROOT / "tests", path.parent)
    assert {
        one for one in named if not any(list(base.glob(one.rstrip("/"))) for base in bases)
    } == set()


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_every_name_that_a_page_places_in_a_file_is_there(path):
    placed = re.findall(r"`(\w+)`\s+of\s+`([\w/]+\.py)`", path.read_text(encoding="utf-8"))
    assert [
        (name, file) for name, file in placed if not re.search(rf"\b{name}\b", text_of(file))
    ] == []


def test_the_readme_is_one_page():
    assert len(text_of("README.md").splitlines()) <= LONGEST_README


def test_the_thresholds_of_explain_are_those_of_the_code():
    rows = re.findall(
        r"^\| `(\w+)` \| ([^|]+) \| `([\w/]+)\.py` \|",
        text_of("docs/explain.md") + text_of("docs/recorders.md"),
        re.MULTILINE,
    )
    assert {name for name, _, path in rows if path.endswith("recorder/thresholds")} == {
        name for name in vars(thresholds) if name.isupper()
    }
    for name, told, path in rows:
        share = [float(ast.literal_eval(part.strip())) for part in told.split("/")]
        value = share[0] / share[1] if len(share) == 2 else share[0]
        module = importlib.import_module("rollerrig." + path.replace("/", "."))
        assert getattr(module, name) == pytest.approx(value), f"{path}: {name}"


def test_no_limits_of_remainders_are_better_for_first_and_second_generator_by_more_than_one_cause_in_a_hundred():
    natures = limits.natures()
    told, shipped = natures["first"] + natures["second"], limits.SHIPPED[1]
    hidden = [t for t in told if t.kind in ("one", "two")]
    named = [bool(t.names(shipped)) for t in told if t.kind == "unknown"]
    assert binomtest(sum(named), len(named)).proportion_ci(method="wilson").low < 0.05
    best, _ = max(limits.rightly(told, sum(named)))
    assert best <= sum(t.right(shipped) for t in hidden) + 0.01 * len(hidden)


def test_how_far_a_law_may_be_another_is_what_first_and_second_generator_set():
    told = limits.natures()
    assert limits.form_set_by(told["first"], told["second"]) == limits.FORM


@pytest.mark.parametrize("name", written_docs.TABLES)
def test_the_written_tables_of_a_page_are_up_to_date(name):
    text = text_of(f"docs/{name}")
    assert text == written_docs.with_tables(name, text), "run: make docs"


def test_every_column_that_the_loader_reads_is_on_its_page():
    text = text_of("docs/datasets.md")
    assert [
        name
        for name in dataset.CHANNELS
        if f"`{name}`" not in text and not re.search(r"_[23]_", name)
    ] == []


def test_the_dataset_of_the_page_loads(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = text_of("docs/datasets.md")
    for speed in (30, 27, 24):
        assert (
            cli.main(
                [
                    "run",
                    "velim_a1",
                    "--pacing",
                    "free",
                    "--set",
                    "rig=plain_track",
                    "--set",
                    f"initial_speed_m_s={speed}",
                    "--out",
                    f"runs/from_{speed}",
                ]
            )
            == 0
        )
    cut = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    subprocess.run([sys.executable, "-c", cut[1]], check=True)
    (tmp_path / "stops" / "dataset.toml").write_text(
        re.search(r"```toml\n(.*?)```", text, re.DOTALL)[1]
    )
    found = dataset.load("stops")
    assert [run.name for run in found.group("validate")] == ["from_27"]
    assert all(run.load_N.shape == (run.time_s.size, 4) for run in found.runs)
    assert np.all(found.runs[0].position_m[1:] >= found.runs[0].position_m[:-1])


def test_the_identifiers_of_the_page_of_units_are_those_of_the_rig():
    text = text_of("docs/units.md")
    for can_id in (
        rig_objects.SPEEDS.can_id,
        rig_objects.PRESSURES.can_id,
        rig_objects.REFERENCE_SPEED.can_id,
        rig_objects.MAGNETS_ID,
        rig_objects.UNIT_HEARTBEAT_ID,
    ):
        assert f"| {can_id:X}h |" in text
    assert f"I16, {rig_objects.SPEEDS.scales[0]:g} rad/s" in text
    assert f"I16, {rig_objects.REFERENCE_SPEED.scales[0]:g} m/s" in text


def test_a_benchmark_replaces_its_own_section_of_the_page(tmp_path):
    path = tmp_path / "performance.md"
    path.write_text("# Performance\n\nHead.\n\n## loop\n\nold\n\n## bus\n\nkept\n")
    shown = figures.table("lateness", ("what", "us"), [("p50", 12.0)])
    figures.put(path, "loop", "rollerrig bench loop", shown, ["met"])
    text = path.read_text()
    assert text.index("## loop") < text.index("## bus")
    assert "old" not in text
    assert "kept" in text
    assert "| what | us |\n| --- | --- |\n| p50 | 12 |" in text
    assert "    rollerrig bench loop\n" in text
