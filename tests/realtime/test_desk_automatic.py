"""The desk plays sequences and programmes, also those of the user, with a title block and a PDF."""

import asyncio
import json

import pytest
from short_sequences import WALKING_PACE
from test_desk import PATIENCE, simulated

from rollerrig.configs.errors import ConfigError

pytest.importorskip("nicegui", reason="the desk needs nicegui")

from nicegui import ui

from rollerrig.realtime.desk import automatic, desk, library

PROGRAMME = """title = "One stop from walking pace"
source = "assumption: a test of the desk"
log = ["vehicle_speed"]
[[group]]
title = "Walking pace"
kind = "mandatory"
source = "assumption: a test of the desk"
sequences = ["sequences/mine.toml"]
"""


@pytest.fixture
def one(tmp_path):
    """A desk whose folder has a sequence and a programme of the user."""
    for kind, text in (("sequences", WALKING_PACE), ("programmes", PROGRAMME)):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / "mine.toml").write_text(text, encoding="utf-8")
    return desk.Desk(tmp_path, own=True)


def put(user, kind, marker, value):
    """Put a value into a field of the page."""
    with user:
        user.find(kind=kind, marker=marker).elements.pop().value = value


def test_a_sequence_and_a_programme_of_the_user_are_played_with_title_block_and_pdf(one):
    pytest.importorskip("fpdf", reason="a PDF needs fpdf2")

    async def exited(count):
        for _ in range(PATIENCE):
            if len(one.programs) == count and one.programs[-1].status is not None:
                return one.programs[-1]
            await asyncio.sleep(0.1)
        raise AssertionError([program.lines for program in one.programs])

    async def play(user):
        user.find(marker="tab-Automatic").click()
        await user.should_see(marker="play-programme", retries=50)
        put(user, ui.input, "about-tested by", "A. Meier")
        put(user, ui.input, "about-document number", "R-12")
        put(user, ui.textarea, "about-further", "checked by=B. Novak")
        put(user, ui.checkbox, "pdf", True)
        put(user, ui.select, "sequences", ["sequences/mine.toml"])
        user.find(marker="play").click()
        program = await exited(1)
        assert program.status == 0, (program.error, program.lines)
        await user.should_see(marker="report-pdf", retries=100)

        put(user, ui.select, "programme", "programmes/mine.toml")
        user.find(marker="play-programme").click()
        program = await exited(2)
        assert program.status == 0, (program.error, program.lines)
        await user.should_see("programmes/mine.toml", retries=100)

    simulated(one, play)
    entries = {"tested by": "A. Meier", "document number": "R-12", "checked by": "B. Novak"}
    for report in ("reports/mine/report", "programmes/mine/evidence"):
        about = json.loads((one.folder / f"{report}.json").read_text())["about"]
        assert entries.items() <= about.items()
        assert (one.folder / f"{report}.pdf").read_bytes().startswith(b"%PDF")
    pages = [automatic._reports(program) for program in one.programs]
    assert [[file.name for file in files] for files in pages] == [
        ["report.html", "report.pdf"],
        ["evidence.html", "evidence.pdf"],
    ]
    # the library knows the result of the sequence of each run
    results = {row["name"]: row["test"] for row in library.rows(one.folder)}
    assert results == {"reports/mine/mine": "pass", "programmes/mine/mine/mine": "pass"}


def test_files_outside_the_folders_of_the_desk_are_not_played(one, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "other.toml"
    elsewhere.write_text(WALKING_PACE, encoding="utf-8")
    assert one.own_files("sequences") == ["sequences/mine.toml"]
    for what in ("sequence", "programme"):
        one.check_file(what, f"{what}s/mine.toml")
        with pytest.raises(ConfigError, match=f"{what} .*other.toml: this desk starts the {what}s"):
            one.check_file(what, str(elsewhere))


def test_an_entry_of_the_title_block_that_cannot_be_used_starts_nothing(one):
    async def play(user):
        user.find(marker="tab-Automatic").click()
        await user.should_see(marker="play-programme", retries=50)
        put(user, ui.textarea, "about-further", "checked by B. Novak")
        user.find(marker="play").click()
        await user.should_see("write WHAT=TEXT", retries=PATIENCE)

    simulated(one, play)
    assert one.programs == []


def test_the_runs_are_filtered_by_their_verdicts(tmp_path, stop_on_leaves):
    for name in ("stop", "slide", "plain", "damaged"):
        (tmp_path / "reports" / name).mkdir(parents=True)
        for file in ("scenario.toml", "summary.json"):
            (tmp_path / "reports" / name / file).write_bytes(
                (stop_on_leaves.out / file).read_bytes()
            )
    (tmp_path / "reports/damaged/summary.json").write_text("{")
    results = [{"name": "stop", "result": "pass"}, {"name": "slide", "result": "fail"}]
    (tmp_path / "reports/report.json").write_text(json.dumps({"sequences": results}))
    of_verdict = {
        "all": {"stop", "slide", "plain", "damaged"},
        "valid": {"stop", "slide", "plain"},
        "not valid": {"damaged"},
        "pass": {"stop"},
        "fail": {"slide"},
        "error": set(),
    }

    async def play(user):
        user.find(marker="tab-Runs").click()
        await user.should_see(marker="verdict-filter", retries=50)
        choice = user.find(kind=ui.toggle, marker="verdict-filter").elements.pop()
        table = user.find(kind=ui.table, marker="runs").elements.pop()
        for verdict, names in of_verdict.items():
            put(user, ui.toggle, "verdict-filter", verdict)
            assert {row["name"].rpartition("/")[2] for row in table.rows} == names
            assert choice.options[verdict] == f"{verdict} ({len(names)})"

    simulated(desk.Desk(tmp_path, own=True), play)


def test_the_bar_of_a_program_has_a_name(one):
    async def play(user):
        one.start(["sequence", "--check", "--", "sequences/mine.toml"])
        user.find(marker="tab-Automatic").click()
        await user.should_see(kind=ui.linear_progress, retries=PATIENCE)
        bar = user.find(kind=ui.linear_progress).elements.pop()
        assert bar.props["aria-label"] == "progress of this program"

    simulated(one, play)
