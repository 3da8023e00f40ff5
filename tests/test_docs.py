"""The documentation is true: commands parse, files exist, values and tables agree with the code."""

import ast
import importlib
import re
import shlex
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import numpy as np
import program
import pytest
import written_docs
import written_words
import yaml
from generator import thresholds as generator_thresholds
from scipy.stats import binomtest

from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime import cli
from rollerrig.realtime.benchmarks import figures
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.train_recorder import thresholds
from rollerrig.wsp_interface import rig_objects, signals

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMES = [path.name for path in PAGES]
ROOMS = ("rig", "firmware_sim", "wsp_interface", "realtime", "configs", "tests", "docs", ".ci")
LONGEST_README = 130
# Words of docs/, CHANGELOG.md and DECISIONS.md without what is generated. The aim is 65,000: this
# number only falls. If a page needs more words, shorten another: `python tests/written_words.py`.
MOST_WORDS = 67255
# pages that a reader finds from the README, by links
MOST_CLICKS = 2
# files that a command writes, and files of the reader
MADE = re.compile(r"^(runs|report|reports|campaigns|devices|stops|my|build)/")


def text_of(name):
    return (ROOT / name).read_text(encoding="utf-8")


def commands(path):
    """Yield the `rollerrig` commands that a page shows, in blocks and in backticks, as words."""
    text = path.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    lines += re.findall(r"`(rollerrig [^`]*)`", text.replace("\n", " "))
    for line in lines:
        if re.match(r"(?:\.venv/bin/)?rollerrig (?=[a-z])", line):
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
    # in backticks a path that begins in a room; elsewhere any path of a source file
    named = set()
    for name in re.findall(r"`([\w.{}*-]+(?:/[\w.{}*-]+)*/?[\w.*-]*)`", text):
        if "/" in name and name.split("/")[0] in ROOMS:
            named.add(name)
    named.update(re.findall(r"(?<![\w./-])((?:\w+/)+\w+\.(?:py|go|toml|md))\b", text))

    bases = (ROOT, ROOT / "tests", path.parent)
    missing = set()
    for name in named:
        exists = any(list(base.glob(name.rstrip("/"))) for base in bases)
        if not exists and not MADE.match(name):
            missing.add(name)
    assert missing == set()


@pytest.mark.parametrize("path", PAGES, ids=NAMES)
def test_every_name_that_a_page_places_in_a_file_is_there(path):
    placed = re.findall(r"`(\w+)`\s+of\s+`([\w/]+\.py)`", path.read_text(encoding="utf-8"))
    missing = [
        (name, file) for name, file in placed if not re.search(rf"\b{name}\b", text_of(file))
    ]
    assert missing == []


def test_the_readme_is_one_page():
    assert len(text_of("README.md").splitlines()) <= LONGEST_README


def test_the_documents_have_no_more_words_than_before():
    assert sum(map(written_words.written, written_words.documents())) <= MOST_WORDS


def test_a_table_that_is_generated_does_not_count_as_written(tmp_path):
    page = tmp_path / "performance.md"
    by_hand = "# Performance\n\nfour words by hand\n\n"
    page.write_text(f"{by_hand}## loop\n\n2026-11-25, 2 cores.\n\n| a | b |\n\n## By hand\n\nyes\n")
    assert written_words.written(page) == len(by_hand.split()) + 4


def test_each_decision_has_a_number_and_at_most_three_lines():
    decisions = re.findall(
        r"^(\d+)\. 20\d\d-\d\d-\d\d\. .*\n((?: +.*\n)*)", text_of("DECISIONS.md"), re.M
    )
    numbers = [number for number, _ in decisions]
    assert len(numbers) > 100
    assert len(set(numbers)) == len(numbers)
    assert [number for number, rest in decisions if rest.count("\n") > 2] == []


def test_every_page_is_two_clicks_from_the_readme():
    readme = ROOT / "README.md"
    clicks = {readme: 0}
    to_read = [readme]
    while to_read:
        page = to_read.pop(0)
        for target in re.findall(r"\]\(([^)#\s:]+\.md)", page.read_text(encoding="utf-8")):
            linked = (page.parent / target).resolve()
            if linked not in clicks and linked.exists():
                clicks[linked] = clicks[page] + 1
                to_read.append(linked)
    pages = [*PAGES, ROOT / "CHANGELOG.md", ROOT / "DECISIONS.md"]
    assert [page.name for page in pages if clicks.get(page, 99) > MOST_CLICKS] == []


def test_every_question_is_answered_with_a_link_to_a_page():
    questions = text_of("docs/questions.md").split("\n### ")[1:]
    assert len(questions) >= 20
    for question in questions:
        title, _, answer = question.partition("\n")
        # a statement may come before the question
        assert title.endswith("?"), title
        assert re.search(r"\]\([a-z_]+\.md", answer), f"{title}: the answer has no link"


def test_the_thresholds_of_explain_are_those_of_the_code():
    rows = re.findall(
        r"^\| `(\w+)` \| ([^|]+) \| `([\w/]+)\.py` \|",
        text_of("docs/explain_causes.md") + text_of("docs/recorders.md"),
        re.MULTILINE,
    )
    assert {name for name, _, path in rows if path.endswith("recorder/thresholds")} == {
        name for name in vars(thresholds) if name.isupper()
    }
    for name, text, path in rows:
        # a number, or a fraction as in 1 / 3
        parts = [float(ast.literal_eval(part.strip())) for part in text.split("/")]
        value = parts[0] / parts[1] if len(parts) == 2 else parts[0]
        module = importlib.import_module("rollerrig." + path.replace("/", "."))
        assert getattr(module, name) == pytest.approx(value), f"{path}: {name}"


def test_the_rates_that_the_page_of_explain_quotes_are_those_of_its_page_of_rates():
    quoted = re.findall(r"\| (\d+ of \d+) \|$", text_of("docs/explain.md"), re.MULTILINE)
    third = {}
    for row in re.findall(r"^\| (.+) \|$", text_of("docs/explain_rates.md"), re.MULTILINE):
        cells = row.split(" | ")
        if len(cells) == 6:
            third[cells[0]] = cells[3]
    assert quoted == [
        third["nothing hidden: consistent"],
        third["one cause: it is the most likely, or one of two, of detected"],
        third["effect outside the library: identified as a cause"],
    ]


def test_the_fall_of_a_measured_creep_curve_on_the_page_of_explain_is_that_of_measured_data():
    row = re.search(r"^\| `eurosprinter_127001` \|.*$", text_of("docs/measured.md"), re.MULTILINE)
    size = re.search(r"`falling_friction` (\S+ \(\S+ to \S+\) %) of the maximum", row[0])
    law = re.search(r"rms (\S+), scatter (\S+);", row[0])
    sentence = " ".join(text_of("docs/explain.md").split())
    assert f"a fall of adhesion by {size[1]} from its maximum" in sentence
    assert f"an error of {law[1]} (root mean square)" in sentence
    assert f"The scatter of the 148 points is {law[2]}." in sentence


@pytest.mark.nightly
def test_no_limits_of_remainders_name_more_causes_of_first_and_second_generator_than_a_hundredth():
    kept = generator_thresholds.kept_answers()
    answers = kept["first"] + kept["second"]
    present = generator_thresholds.PRESENT_LIMITS
    hidden = [answer for answer in answers if answer.kind in ("one", "two")]
    unknown = [answer for answer in answers if answer.kind == "unknown"]

    named = sum(bool(answer.sets_named_by(present)) for answer in unknown)
    assert binomtest(named, len(unknown)).proportion_ci(method="wilson").low < 0.05
    best, _ = max(generator_thresholds.limits_within(answers, named))
    right = sum(answer.is_right_by(present) for answer in hidden)
    assert best <= right + 0.01 * len(hidden)


def test_form_fraction_is_what_first_and_second_generator_set():
    kept = generator_thresholds.kept_answers()
    form = generator_thresholds.form_set_by(kept["first"], kept["second"])
    assert form == generator_thresholds.FORM


# the rates of explanations are computed again from all kept answers
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.nightly) if name == "explain_rates.md" else name
        for name in written_docs.TABLES
    ],
)
def test_the_written_tables_of_a_page_are_up_to_date(name):
    text = text_of(f"docs/{name}")
    assert text == written_docs.with_tables(name, text), "run: make docs"


def test_every_column_that_the_loader_reads_is_on_its_page():
    text = text_of("docs/datasets.md")
    # the page shows the first and the last wheelset
    shown = [name for name in dataset.channels_of(4) if not re.search(r"_[23]_", name)]
    assert [name for name in shown if f"`{name}`" not in text] == []


@pytest.mark.nightly
def test_the_dataset_of_the_page_loads(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = text_of("docs/datasets.md")
    for speed in (30, 27, 24):
        words = ["run", "velim_a1", "--pacing", "free", "--out", f"runs/from_{speed}"]
        words += ["--set", "rig=plain_track", "--set", f"initial_speed_m_s={speed}"]
        assert cli.main(words) == 0
    text_of_program = re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]
    done = program.python("-c", text_of_program)
    assert done.status == 0, done.messages
    content = re.search(r"```toml\n(kind = .*?)```", text, re.DOTALL)[1]
    (tmp_path / "stops" / "dataset.toml").write_text(content)

    data = dataset.load("stops")
    assert [run.name for run in data.group("validate")] == ["from_27"]
    for run in data.runs:
        assert run.load_N.shape == (run.time_s.size, 4)
    assert np.all(np.diff(data.runs[0].position_m) >= 0.0)


def test_the_identifiers_of_the_page_of_units_are_those_of_the_rig():
    text = text_of("docs/units.md")
    for can_id in (
        rig_objects.SPEEDS_ID,
        rig_objects.PRESSURES_ID,
        rig_objects.REFERENCE_SPEED_ID,
        rig_objects.MAGNETS_ID,
        rig_objects.UNIT_HEARTBEAT_ID,
    ):
        assert f"| {can_id:X}h |" in text
    assert f"I16, {signals.first_place('measured_speed').scale:g} rad/s" in text
    assert f"I16, {signals.first_place('wsp_reference_speed').scale:g} m/s" in text


def files_of(page):
    """Return the files that a page lets its reader write, by name."""
    blocks = re.findall(
        r"^`([\w.]+)`:\n\n((?: {4}.*\n|\n(?= {4}))+)", text_of(f"docs/{page}"), re.MULTILINE
    )
    return {name: re.sub(r"^ {4}", "", block, flags=re.MULTILINE) for name, block in blocks}


@pytest.mark.parametrize(
    "page", ["howto_run.md", pytest.param("howto_vehicle.md", marks=pytest.mark.nightly)]
)
def test_the_scenario_of_a_page_and_its_vehicle_load(page, tmp_path):
    files = files_of(page)
    for name, content in files.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    command = [Path(sys.executable).with_name("rollerrig"), "devices", "--out", "devices"]
    command += ["--scenario", "my_stop.toml"]
    subprocess.run(command, cwd=tmp_path, check=True)

    axles = re.search(r"^axles = (\d+)", files.get("my_vehicle.toml", ""), re.MULTILINE)
    drives = list((tmp_path / "devices").glob("node_*_roller_drive.eds"))
    assert len(drives) == (int(axles[1]) if axles else 4)


def test_the_settings_of_the_reference_unit_on_the_page_of_vehicles_load(tmp_path):
    path = tmp_path / "my_wsp.toml"
    path.write_text(files_of("howto_vehicle.md")[path.name], encoding="utf-8")
    logic.load(str(path))


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


def test_the_citation_and_the_changelog_name_the_version_that_is_installed():
    version = metadata.version("rollerrig")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == version
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_files_of_the_code_host_are_valid_and_run_what_decides():
    folder = ROOT / ".github"
    for file in folder.rglob("*.yml"):
        assert yaml.safe_load(file.read_text(encoding="utf-8")), file
    workflow = yaml.safe_load((folder / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    steps = workflow["jobs"]["run"]["steps"]
    assert ".ci/run" in [step.get("run") for step in steps]
    # with the oldest and the newest Python that the package allows
    assert workflow["jobs"]["run"]["strategy"]["matrix"]["python"] == ["3.11", "3.13"]
    required = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert required["requires-python"] == ">=3.11,<3.14"
