"""Test programmes: what they contain, what counts for their result, and how they continue."""

import argparse
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import program
import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.commands import sequence
from rollerrig.realtime.commands.evidence import programme as programme_command
from rollerrig.realtime.reports.evidence import programme as report
from rollerrig.wsp_interface.sequences import programme

SEQUENCE = """title = "A stop from walking pace, number {number}"
criteria = "none"
[start]
speed = "4 km/h"
adhesion = "dry"
[[step]]
title = "brake"
set = {{ brake_demand = "3.8 bar" }}
until = "vehicle_speed < 0.01 m/s"
timeout = "20 s"
[[measure]]
measure = "stop_distance"
unit = "m"
max = {limit}
source = "recollection, to be checked against EN 15595: a number of this test"
"""
PROGRAMME = """title = "Three short stops"
source = "assumption"
log = ["vehicle_speed", "cylinder_pressure", "valve"]
[[group]]
title = "Stops"
kind = "mandatory"
source = "assumption"
sequences = ["a.toml", "b.toml"]
[[group]]
title = "More"
kind = "additional"
source = "assumption"
sequences = ["c.toml"]
[[group]]
title = "Elsewhere"
kind = "apart"
source = "assumption"
reason = "on another rig"
"""


def write(folder):
    """Write a programme whose additional sequence fails; return its file."""
    for number, (name, limit) in enumerate((("a", 50.0), ("b", 50.0), ("c", 0.01))):
        (folder / f"{name}.toml").write_text(SEQUENCE.format(number=number, limit=limit))
    path = folder / "short.toml"
    path.write_text(PROGRAMME)
    return path


@pytest.fixture
def files(tmp_path):
    """The file of a programme."""
    return write(tmp_path)


@pytest.mark.parametrize(
    "name", [*store.names("programmes"), *store.names_of_vehicles("programmes")]
)
def test_every_packaged_programme_and_its_sequences_are_valid(name):
    loaded = programme.load(name)
    kinds = [group.kind for group in loaded.groups]
    assert {programme.MANDATORY, programme.BY_AGREEMENT, programme.APART} <= set(kinds)
    assert len(sequence.load(list(loaded.sequences))) == len(loaded.sequences)
    # what a programme contains is not read from a standard
    for group in loaded.groups:
        assert group.source.startswith(("recollection, to be checked against", "assumption"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('source = "assumption"\nlog', "log", "source is missing"),
        ('"mandatory"', '"must"', "kind = 'must'"),
        ('["a.toml", "b.toml"]', "[]", "has sequences and no reason"),
        ('["a.toml", "b.toml"]', '["a.toml", "c.toml"]', "twice"),
        ('["a.toml", "b.toml"]', '["no_such"]', "no sequence is called"),
        ('reason = "on another rig"', "", "has a reason and no sequences"),
        ('"valve"', '"valves"', "did you mean 'valve'"),
        ("[[group]]", "[[groups]]", "unknown key 'groups'"),
    ],
)
def test_a_wrong_programme_is_refused_with_its_place(files, old, new, message):
    files.write_text(PROGRAMME.replace(old, new))
    with pytest.raises(ConfigError, match=message) as raised:
        programme.load(str(files))
    assert "short.toml" in str(raised.value) or "no_such" in str(raised.value)


def play(files, out, *more):
    return cli.main(["programme", str(files), "--out", str(out), "--json", *more])


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A part of a programme is played, then the whole: the folder, and what each has printed."""
    folder = tmp_path_factory.mktemp("programme")
    words = ("programme", write(folder), "--out", folder / "out", "--json")
    printed = []
    for more in (("--group", "sto"), ("--about", "tested by=A. Meier")):
        done = program.rollerrig(*words, *more)
        assert done.status == cli.PASS, done.messages
        printed.append(json.loads(done.printed))
    return folder, *printed


def test_a_programme_writes_one_evidence_and_an_additional_failure_does_not_count(played):
    folder, _, printed = played
    out = folder / "out"
    assert printed["sequences"] == {"a": "pass", "b": "pass", "c": "fail"}

    found = json.loads((out / "evidence.json").read_text())
    assert found["result"] == "pass"
    assert found["tested"]["unit"] == "reference"
    (stop, *_), (failed,), nothing = [group["sequences"] for group in found["groups"]]
    assert nothing == []
    (distance,) = [one for one in failed["verdicts"] if one["what"] == "stop_distance"]
    assert (distance["result"], distance["limit"]) == ("fail", "at most 0.01")
    assert stop["missing_signals"] == []
    assert not found["is_part"]
    # the scenario describes this test, and does not promise to repeat it
    scenario = (out / "a" / "a" / "scenario.toml").read_text()
    assert 'title = "A stop from walking pace, number 0"' in scenario
    assert "Play the sequence or the test again to repeat the run" in scenario
    assert "Run it again" not in scenario
    # what each sequence was played with, and which sequence it was
    assert stop["conditions"]["initial speed"] == "4 km/h"
    digest = hashlib.sha256((folder / "a.toml").read_bytes()).hexdigest()
    assert stop["sequence_sha256"] == digest
    assert "a/channels.parquet" in stop["files"]
    assert found["versions"]["rollerrig"]

    page = (out / "evidence.html").read_text()
    assert "from memory, not verified against EN 15595" in page
    assert "Not a certification" in page
    assert "on another rig" in page
    assert "A. Meier" in page
    assert "<th>load</th><td>43 t in all</td>" in page
    assert "<th>adhesion</th><td>dry, mu_cd" in page
    assert "<th>gradient</th><td>0 % (level)</td>" in page
    assert f"sequence {digest[:16]} (SHA-256)" in page
    assert "the whole programme" in page
    assert stop["files"]["a/channels.parquet"] in page


def test_a_programme_that_is_called_again_keeps_the_entries_of_its_title_block(played, tmp_path):
    folder, *_ = played
    out = tmp_path / "out"
    shutil.copytree(folder / "out", out)
    assert play(folder / "short.toml", out, "--about", "revision=B") == cli.PASS
    about = json.loads((out / "evidence.json").read_text())["about"]
    assert about == {"tested by": "A. Meier", "revision": "B"}
    assert "A. Meier" in (out / "evidence.html").read_text()
    # a later entry replaces an earlier one
    assert play(folder / "short.toml", out, "--about", "tested by=B. Kern") == cli.PASS
    about = json.loads((out / "evidence.json").read_text())["about"]
    assert about == {"tested by": "B. Kern", "revision": "B"}


def test_a_part_of_a_programme_is_played_by_its_groups_and_its_evidence_states_that(played):
    folder, printed, of_the_whole = played
    out = folder / "out"
    assert printed["sequences"] == {"a": "pass", "b": "pass"}
    # the whole programme continues with what the part has left
    assert of_the_whole["done_before"] == 2
    found = json.loads((out / "evidence_part.json").read_text())
    assert (found["is_part"], found["result"]) == (True, "pass")
    assert found["groups_left_out"] == ["More", "Elsewhere"]
    page = (out / "evidence_part.html").read_text()
    assert "A part of the programme.</b> The result is that of the groups below." in page
    assert "Not chosen: More; Elsewhere." in page

    # a part with additional groups only is judged by them
    loaded = programme.load(str(folder / "short.toml")).part(["More"])
    assert loaded.counted == programme.KINDS


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Brakes", "there is no such group; give the title or its beginning: Stops; More"),
        ("", "there is no such group"),
        ("elsewhere", "this group is not run here: on another rig"),
    ],
)
def test_a_group_that_cannot_be_played_is_refused_with_those_that_can(files, text, message):
    with pytest.raises(ConfigError, match=message):
        programme.load(str(files)).part([text])


def test_the_evidence_has_the_hash_of_the_files_in_the_command_of_the_unit(tmp_path):
    unit = tmp_path / "unit.py"
    unit.write_text("first")
    settings = tmp_path / "unit.toml"
    settings.write_text("a = 1")
    options = argparse.Namespace(
        wsp="external",
        unit=f"{sys.executable} {unit} --config={settings} {{host}} {{port}}",
        unit_map=None,
        seed=0,
    )
    first = programme_command._tested(options)
    assert set(first["files"]) == {sys.executable, str(unit), str(settings)}
    assert first["files"][str(unit)] == hashlib.sha256(b"first").hexdigest()

    # another unit is another test
    one = sequence.load(["emergency_120"])[0]
    mark = programme_command._fingerprint(one, first)
    unit.write_text("second")
    assert programme_command._fingerprint(one, programme_command._tested(options)) != mark


@pytest.mark.nightly
def test_a_programme_that_is_killed_continues_with_what_is_left(files, tmp_path, capsys):
    out = tmp_path / "out"
    words = [sys.executable, "-m", "rollerrig.realtime.cli", "programme", str(files)]
    process = subprocess.Popen(
        [*words, "--out", str(out)], stderr=subprocess.DEVNULL, start_new_session=True
    )
    until_s = time.monotonic() + 300.0
    while not (out / "a" / "evidence.json").exists() and time.monotonic() < until_s:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = (out / "a" / "evidence.json").read_bytes()
    kept_at_ns = (out / "a" / "evidence.json").stat().st_mtime_ns

    assert play(files, out) == cli.PASS
    assert json.loads(capsys.readouterr().out)["done_before"] >= 1
    assert (out / "a" / "evidence.json").read_bytes() == kept
    assert (out / "a" / "evidence.json").stat().st_mtime_ns == kept_at_ns

    # another seed, or another limit, is another test
    assert play(files, out) == cli.PASS
    assert json.loads(capsys.readouterr().out)["done_before"] == 3
    (tmp_path / "a.toml").write_text(SEQUENCE.format(number=0, limit=0.01))
    assert play(files, out) == cli.FAILED
    printed = json.loads(capsys.readouterr().out)
    assert printed["done_before"] == 2
    assert printed["sequences"]["a"] == "fail"


def part(name, result="pass", signals=("vehicle_speed", "cylinder_pressure", "valve")):
    """Return the evidence of a sequence that has no verdicts."""
    return {"name": name, "result": result, "signals": list(signals), "verdicts": [], "files": {}}


@pytest.mark.parametrize(
    ("parts", "result"),
    [
        ((part("a"), part("b"), part("c")), "pass"),
        ((part("a"), part("b")), "pass"),
        ((part("a"), part("c")), "error"),
        ((part("a", "fail"), part("b")), "fail"),
        ((part("a", "fail"), part("b", "error")), "fail"),
        ((part("a", "fail"),), "fail"),
        ((part("a", "fail", signals=["vehicle_speed"]), part("b")), "fail"),
        ((part("a"), part("b", signals=["vehicle_speed", "valve"])), "error"),
        ((), "error"),
    ],
)
def test_a_sequence_that_was_not_run_or_lacks_a_signal_never_counts_as_a_pass(files, parts, result):
    loaded = programme.load(str(files))
    named = {one["name"]: one for one in parts}
    found = report.evidence(loaded, named, {"unit": "none"}, datetime(2026, 1, 1, tzinfo=UTC), {})
    assert found["result"] == result


def test_the_evidence_of_a_failure_mentions_its_conditions_and_what_was_not_judged(files, tmp_path):
    loaded = programme.load(str(files))
    line = {"what": "stop_distance_over_dry", "result": "error", "unit": "", "value": None}
    line |= {"limit": "at most 1.3", "source": "assumption"}
    failed = part("a", "fail") | {"title": "A stop", "error": None, "config_hash": "0", "seed": 0}
    failed |= {
        "pacing": "lockstep",
        "verdicts": [line],
        "conditions": {"changed friction": "mu_cd 0.02 under axle 3, from 100 m"},
        "sequence_sha256": "0" * 64,
    }
    tested = {"unit": "none", "command": None, "seed": 0, "files": {}}
    when = datetime(2026, 1, 1, tzinfo=UTC)
    found = report.evidence(loaded, {"a": failed}, tested, when, {})
    assert found["result"] == "fail"
    assert found["not_judged"] == ["a: stop_distance_over_dry", "b: not run"]
    report.write(found, tmp_path)
    page = (tmp_path / "evidence.html").read_text()
    assert "Could not be judged: </b>a: stop_distance_over_dry; b: not run" in page
    assert "<th>changed friction</th><td>mu_cd 0.02 under axle 3, from 100 m</td>" in page


def test_a_run_without_a_record_has_no_signals(tmp_path):
    assert report.recorded(Path(tmp_path)) == []


def test_a_unit_that_sends_no_reference_speed_can_pass_and_the_evidence_states_it(files, tmp_path):
    text = files.read_text().replace("log = [", 'log = ["wsp_reference_speed", ', 1)
    files.write_text(text)
    loaded = programme.load(str(files))
    assert "wsp_reference_speed" in loaded.log
    named = {name: part(name) for name in ("a", "b", "c")}
    found = report.evidence(loaded, named, {"unit": "none"}, datetime(2026, 1, 1, tzinfo=UTC), {})
    assert found["result"] == "pass"
    (first, *_) = found["groups"][0]["sequences"]
    assert first["missing_signals"] == ["wsp_reference_speed"]
