"""Every record and report states what was played: unit, scenario, vehicle, seed, and validity."""

import csv
import hashlib
import html
import json
import os
import shlex
import shutil
import signal
import struct
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import wrong_units
from bench_process import BenchProcess, SimpleUnit, until
from process_tree import is_running
from rerun.chunk import RrdReader
from short_sequences import WALKING_PACE

from rollerrig.realtime import cli
from rollerrig.realtime.bench import unit_identity
from rollerrig.realtime.record import export, played, records
from rollerrig.realtime.record.played import Unit
from rollerrig.realtime.telemetry import views
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

EXAMPLE = Path(__file__).parents[2] / "docs/examples/wsp_unit.py"
COMMAND = f"{shlex.quote(sys.executable)} {shlex.quote(str(EXAMPLE))} {{host}} {{port}}"
NOBODY = 65534  # a user without rights
SHORT = ("--set", "initial_speed_m_s=3", "--set", "adhesion=dry")


def metadata(folder):
    """Return the metadata of channels.parquet as texts."""
    found = pq.read_schema(folder / "channels.parquet").metadata
    return {key.decode(): text.decode() for key, text in found.items()}


def assert_metadata_are_those_of_the_summary(folder):
    """The recorder writes the metadata, the bench the summary."""
    assert metadata(folder) == played.of_summary(records.summary(folder)).texts()


@pytest.fixture(scope="module")
def command_run(tmp_path_factory):
    """A run with a program of the user as its unit."""
    out = tmp_path_factory.mktemp("played") / "run"
    words = ("--pacing", "lockstep", "--unit", COMMAND, "--seed", "5", *SHORT)
    bench = BenchProcess(out, *words).finish()
    assert bench.status == 0, bench.stderr
    return records.load(out)


def test_the_summary_has_the_command_and_the_hashes_of_its_files(command_run):
    unit = command_run.summary["unit_played"]
    assert unit["kind"] == "command"
    assert unit["command"] == COMMAND
    assert unit["sha256"][str(EXAMPLE)] == hashlib.sha256(EXAMPLE.read_bytes()).hexdigest()
    assert len(unit["sha256"]) == 2  # Python, too
    assert command_run.summary["vehicle"] == "uic_z1"


def test_the_channels_have_what_was_played_as_metadata(command_run):
    assert_metadata_are_those_of_the_summary(command_run.folder)
    found = metadata(command_run.folder)
    assert json.loads(found["unit_played"])["command"] == COMMAND
    assert (found["scenario"], found["vehicle"], found["seed"]) == ("velim_a1", "uic_z1", "5")
    assert found["config_hash"] == command_run.summary["config_hash"]
    assert json.loads(found["valid"]) is True
    assert json.loads(found["invalid_because"]) == []


def test_exported_files_have_what_was_played(command_run, tmp_path):
    texts = played.of_summary(command_run.summary).texts()

    *_, file = export.write(command_run, "csv", tmp_path / "run.csv")
    assert file.name == "run.run.csv"
    with file.open(encoding="utf-8", newline="") as lines:
        assert dict(csv.reader(lines)) == texts

    from scipy.io import loadmat

    [file] = export.write(command_run, "mat", tmp_path / "run.mat")
    read = loadmat(file, squeeze_me=True, simplify_cells=True)["run"]
    assert read["unit_played"] == texts["unit_played"]
    assert read["valid"] == "true"

    asammdf = pytest.importorskip("asammdf")
    [file] = export.write(command_run, "mdf4", tmp_path / "run.mf4")
    with asammdf.MDF(file) as read:
        comment = html.unescape(read.header.comment)
    for key, text in texts.items():
        assert f"{key}: {text}" in comment


def test_the_recording_of_rerun_has_what_was_played(command_run):
    contents = []
    for chunk in RrdReader(command_run.folder / "run.rrd").stream():
        if str(chunk.entity_path) == views.RESULT:
            contents.append(str(chunk.to_record_batch().to_pydict()))
    (content,) = contents
    digest = hashlib.sha256(EXAMPLE.read_bytes()).hexdigest()
    for part in ("unit played command", digest, "vehicle uic_z1", "seed 5", "**valid**"):
        assert part in content


def test_a_run_with_an_error_is_not_valid_in_its_channels_either(tmp_path):
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--answer-wait", "1", *SHORT
    )
    unit = SimpleUnit(bench.address(), lambda n: [(0x211, b"\0")] if n < 20 else None)
    bench.finish()
    unit.close()
    assert bench.reported(Code.RUN_FAILED)
    assert_metadata_are_those_of_the_summary(bench.out)
    found = metadata(bench.out)
    assert json.loads(found["valid"]) is False
    assert "has not answered SYNC" in found["invalid_because"]
    assert json.loads(found["unit_played"])["kind"] == "external"


def test_a_killed_bench_leaves_what_was_played(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "wall", "--seed", "7")
    bench.runs_for(0.3)
    recorder = bench.child("rollerrig.realtime.telemetry.recorder")
    os.kill(bench.process.pid, signal.SIGKILL)
    bench.process.wait(60.0)
    until(lambda: not is_running(recorder), "the end of the recorder")
    assert_metadata_are_those_of_the_summary(bench.out)
    found = metadata(bench.out)
    assert json.loads(found["unit_played"])["kind"] == "reference"
    assert found["seed"] == "7"
    assert "the bench was killed" in found["invalid_because"]


# --- reports ---


def play(tmp_path, capfd, *words):
    """Play a short sequence; return its report as data, as page and as JUnit, and the messages."""
    path = tmp_path / "walk.toml"
    path.write_text(WALKING_PACE, encoding="utf-8")
    out = tmp_path / "report"
    cli.main(["sequence", str(path), "--out", str(out), *words])
    printed = capfd.readouterr()
    data = json.loads((out / "report.json").read_text())
    suite = ET.parse(out / "junit.xml").getroot()[0]
    properties = {one.get("name"): one.get("value") for one in suite.iter("property")}
    return data, (out / "report.html").read_text(), properties, printed.out + printed.err


def test_a_report_states_the_command_that_was_played_whatever_its_user_states(tmp_path, capfd):
    words = ("--unit", COMMAND, "--about", "unit under test=ACME 7")
    data, page, properties, printed = play(tmp_path, capfd, *words)
    (one,) = data["sequences"]
    digest = hashlib.sha256(EXAMPLE.read_bytes()).hexdigest()
    assert one["unit_played"]["kind"] == "command"
    assert one["unit_played"]["sha256"][str(EXAMPLE)] == digest
    for content in (page, properties["unit played"]):
        assert "wsp_unit.py {host} {port}" in content
        assert digest in content
    assert "ACME 7" in page
    assert "contradicts" not in printed
    assert data["warnings"] == []


def test_a_report_that_names_another_unit_than_the_reference_unit_warns(tmp_path, capfd):
    words = ("--about", "unit under test=ACME 7", "--about", "version of the unit=3.2")
    data, page, properties, printed = play(tmp_path, capfd, *words)
    for content in (page, properties["unit played"]):
        assert "reference WSP of rollerrig (simulated)" in content
    (warning,) = data["warnings"]
    assert "contradicts --about 'unit under test=ACME 7' and 'version of the unit=3.2':" in warning
    assert "the reference unit of rollerrig was played" in page
    assert "the record contradicts --about" in printed


def test_the_unit_that_was_played_cannot_be_stated(tmp_path, capfd):
    words = ["sequence", "low_speed_010", "--about", "Unit played=ACME", "--out", str(tmp_path)]
    assert cli.main(words) == 2
    assert "write 'unit under test=...'" in capfd.readouterr().err


# --- the value object ---


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        (Unit("none"), "none"),
        (Unit("external"), "unknown unit on the bus; without an identity object (1018h)"),
        (Unit("reference", version="1.2"), "reference WSP of rollerrig (simulated); version 1.2"),
        (Unit("command", "./unit", {"./unit": "ab"}), "command ./unit; ./unit: SHA-256 ab"),
        (Unit("fmu", None, {"a.fmu": "cd"}, "3"), "FMU; version 3; a.fmu: SHA-256 cd"),
        (None, "not stated in this record"),
    ],
)
def test_a_unit_in_words(unit, words):
    assert played.words(unit) == words


def test_an_fmu_has_its_hash_and_the_version_of_its_description(tmp_path):
    fmus = pytest.importorskip("fmus")

    def with_version(xml):
        return xml.replace("<fmiModelDescription ", '<fmiModelDescription version="4.2" ', 1)

    file = fmus.build(tmp_path, edit=with_version)
    unit = played.unit_of(f"fmu:{file}")
    assert unit.kind == "fmu"
    assert unit.version == "4.2"
    assert unit.sha256 == {str(file): hashlib.sha256(file.read_bytes()).hexdigest()}


def test_a_record_without_these_entries_is_still_read():
    old = {"scenario": "velim_a1", "seed": 0, "valid": True, "invalid_because": []}
    found = played.of_summary(old)
    assert found.unit is None
    assert found.valid
    assert found.facts()["unit played"] == "not stated in this record"
    assert played.of_summary({}).valid is False


def test_a_report_on_a_running_bench_does_not_state_that_its_run_is_valid():
    found = played.of_summary({"scenario": "velim_a1", "seed": 0})
    assert found.valid is None
    assert found.facts()["valid"] == "not stated"
    assert found.texts()["valid"] == "null"


# --- the seed ---


@pytest.mark.parametrize(
    ("fault", "random"),
    [(None, False), ("speed_noise_burst axle=1 std_rad_s=0.2", True)],
    ids=["nothing", "noise"],
)
def test_a_seed_where_nothing_is_random_is_reported(fault, random, tmp_path, capsys):
    words = ["run", "velim_a1", "--pacing", "free", *SHORT, "--out", str(tmp_path / "run")]
    if fault:
        words += ["--fault", fault]
    assert cli.main([*words, "--seed", "3"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert ("--seed 3 has no effect: nothing in this run of the rig is random" in printed) != random
    summary = records.summary(tmp_path / "run")
    assert summary["random"] is random
    assert ("without effect" in played.of_summary(summary).facts()["seed"]) != random


# --- the identity object of a unit ---

IDENTITY = {"vendor_id": 0x123, "product_code": 0x45, "revision": 0x10002, "serial": 0xABCD}


class UnitWithIdentity(wrong_units.Unit):
    """A unit with an SDO server that has the object 1018h and nothing else."""

    def take(self, message):
        if message.arbitration_id != 0x620:
            return
        _, index, sub, _ = struct.unpack("<BHBI", message.data)
        assert index == 0x1018
        value = list(IDENTITY.values())[sub - 1]
        reply = struct.pack("<BHBI", 0x43, index, sub, value)
        self.bus.send(wrong_units.data_frame(0x5A0, reply))


def test_an_unknown_unit_on_the_bus_is_recorded_with_its_identity_object(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", *SHORT)
    unit = UnitWithIdentity(bench.address(), lambda n: [wrong_units.COMMAND])
    bench.finish()
    unit.close()
    assert bench.status == 0, bench.stderr
    assert_metadata_has_identity(bench)
    unit_played = bench.record.summary["unit_played"]
    assert unit_played["identity"] == [{"node": 32, **IDENTITY}]
    words = played.words(played.of_summary(bench.record.summary).unit)
    assert "identity of node 32 (1018h): vendor_id 123h, product_code 45h" in words


def assert_metadata_has_identity(bench):
    found = json.loads(metadata(bench.out)["unit_played"])
    assert found["identity"] == [{"node": 32, **IDENTITY}]


def repeat(out, capsys, *words):
    """Repeat a short stop three times; return the exit status and the JSON result."""
    options = ("--pacing", "free", "--repeat", "3", "--seed", "4", "--json", "--out", str(out))
    status = cli.main(["run", "velim_a1", *SHORT, *options, *words])
    return status, json.loads(capsys.readouterr().out)


def test_repeated_runs_have_successive_seeds_and_one_table_of_their_figures(tmp_path, capsys):
    noise = "speed_noise_burst axle=1 std_rad_s=2"
    status, result = repeat(tmp_path / "runs", capsys, "--fault", noise)
    assert status == 0
    summaries = [records.summary(tmp_path / "runs" / name) for name in ("1", "2", "3")]
    assert [summary["seed"] for summary in summaries] == [4, 5, 6]
    figures = {one["name"]: one for one in result["figures"]}
    vents = [summary["wsp"]["vents"] for summary in summaries]
    assert figures["vents"]["runs"] == 3
    assert figures["vents"]["mean"] == pytest.approx(sum(vents) / 3)
    assert (figures["vents"]["least"], figures["vents"]["largest"]) == (min(vents), max(vents))


def test_repeated_runs_without_anything_random_are_equal(tmp_path, capsys):
    status, result = repeat(tmp_path / "runs", capsys)
    assert status == 0
    assert all(one["standard_deviation"] == 0.0 for one in result["figures"])
    first, *others = (records.load(tmp_path / "runs" / name) for name in ("1", "2", "3"))
    names = [name for name in first.table.column_names if not name.startswith("tick")]
    for other in others:
        for name in names:
            np.testing.assert_array_equal(other.column(name), first.column(name), err_msg=name)


def test_repeated_runs_that_are_not_valid_have_no_figures(tmp_path, capsys):
    status, result = repeat(tmp_path / "runs", capsys, "--set", "duration_max_s=0.3")
    assert status == 4
    assert result["figures"] == []
    assert [one["run"] for one in result["not_valid"]] == [1, 2, 3]


def answers_of_identity(commands):
    """Return the identities that a node states which answers with these commands of SDO."""
    sent = []
    identities = unit_identity.Identities(sent.append)
    identities.ask([32])
    for sub, command in enumerate(commands, start=1):
        data = struct.pack("<BHBI", command, 0x1018, sub, 0x10 + sub)
        identities.hear(Frame(0x5A0, data))
    return identities, sent


@pytest.mark.parametrize("command", [0x42, 0x43], ids=["without its size", "with its size"])
def test_a_value_of_the_identity_need_not_state_its_size(command):
    identities, sent = answers_of_identity([command] * 4)
    assert [frame.data[3] for frame in sent] == [1, 2, 3, 4]
    assert not identities.open
    values = {"vendor_id": 0x11, "product_code": 0x12, "revision": 0x13, "serial": 0x14}
    assert identities.finish() == [{"node": 32, **values}]


def test_a_late_answer_leads_to_no_request_during_the_run():
    identities, sent = answers_of_identity([0x43])
    assert identities.finish()[0]["product_code"] is None
    before = len(sent)
    identities.hear(Frame(0x5A0, struct.pack("<BHBI", 0x43, 0x1018, 2, 0)))
    assert len(sent) == before


def test_a_program_that_may_be_run_but_not_read_is_played_without_its_hash():
    # root may read everything, so the test acts as another user, who cannot enter pytest's folder
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        program = Path(folder, "unit")
        shutil.copyfile("/bin/true", program)
        config = Path(folder, "unit.toml")
        config.write_text("a = 1")
        program.chmod(0o111)
        user = os.geteuid()
        if user == 0:
            os.seteuid(NOBODY)
        try:
            unit = played.unit_of(f"command:{program} --config={config}")
        finally:
            os.seteuid(user)
    assert list(unit.sha256) == [str(config)]
