"""Files of other people do no harm: bombs, links, devices, and names that act on a terminal.

All commands of `COMMANDS` run in one child process, whose memory is limited.
"""

import base64
import json
import os
import re
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile
import zlib
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH
from rollerrig.realtime import cli
from rollerrig.realtime.commands import check
from rollerrig.realtime.desk import library
from rollerrig.realtime.record import channels, records, run_folder
from rollerrig.realtime.reports import page, pdf
from rollerrig.rig.identify.data import mdf
from rollerrig.wsp_interface import signals

# address space and resident memory of the child process; its libraries need about 300 MB
ADDRESS_SPACE_BYTES = 6_000_000_000
MOST_RESIDENT_BYTES = 900_000_000

# a short recording of a train
RECORDING = Path(__file__).parents[1] / "data" / "field" / "min_unit_row"
SCENARIO = 'title = "t"\n[[demand]]\nfrom_s = 0.0\npressure_Pa = 3.8e5\n'
DATASET = (
    'kind = "braking_runs"\nvehicle = "uic_z1"\nsample_time_s = 0.01\n'
    '[[run]]\nfile = "{}"\ngroup = "tune"\ninitial_speed_m_s = 20.0\n'
)
RECORDER = 'kind = "recorder"\n[[run]]\nfile = "{}"\n'
DESCRIPTION = (
    '<fmiModelDescription fmiVersion="2.0" modelName="[/nope]" guid="g">{}</fmiModelDescription>'
)

MODEL_EXCHANGE = (
    '<ModelExchange modelIdentifier="m"/><ModelVariables><ScalarVariable name="x" '
    'valueReference="0"><Real/></ScalarVariable></ModelVariables><ModelStructure/>'
)

CHILD = """
import contextlib, io, json, resource, sys, traceback
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
from rollerrig.realtime import cli
results = {}
for name, words in json.load(sys.stdin).items():
    out, err = io.StringIO(), io.StringIO()
    status = None
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = cli.main(words)
        except SystemExit as error:
            status = error.code
        except BaseException:
            traceback.print_exc()
    # not ru_maxrss, which counts the memory of the parent, too
    with open("/proc/self/status") as file:
        (peak,) = [line.split() for line in file if line.startswith("VmHWM")]
    resident = int(peak[1]) * 1024
    results[name] = [status, out.getvalue(), err.getvalue(), resident]
print(json.dumps(results))
"""


def deflated_zeros(megabytes):
    """Return a zlib stream that unpacks to zeros. It is made of one block that is repeated."""
    packing = zlib.compressobj(9)
    begin = packing.compress(b"") + packing.flush(zlib.Z_FULL_FLUSH)
    block = packing.compress(bytes(1_000_000)) + packing.flush(zlib.Z_FULL_FLUSH)
    # the checksum of zeros
    checksum = ((megabytes * 1_000_000) % 65521) << 16 | 1
    return begin + block * megabytes + b"\x03\x00" + struct.pack(">L", checksum)


def dataset(folder, file, head=DATASET):
    folder.mkdir(parents=True)
    (folder / "dataset.toml").write_text(head.format(file))
    return str(folder)


def scenario(path, text):
    path.write_text(text)
    return str(path)


def fmu(path, description, **files):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("modelDescription.xml", description)
        for name, content in files.items():
            archive.writestr(name, content)
    return ["check", str(path)]


def data_is_a_device(folder):
    return ["explain", dataset(folder, "/dev/zero")]


def data_is_a_link_to_a_device(folder):
    words = ["explain", dataset(folder, "a.csv")]
    (folder / "a.csv").symlink_to("/dev/zero")
    return words


def recording_is_a_device(folder):
    words = ["explain", dataset(folder, "a.csv", RECORDER)]
    (folder / "a.csv").symlink_to("/dev/zero")
    return words


def data_is_a_link_out_of_the_folder(folder):
    (folder.parent / "secret").write_text("top secret\n")
    words = ["explain", dataset(folder, "a.csv")]
    (folder / "a.csv").symlink_to(folder.parent / "secret")
    return words


def data_is_a_pipe(folder):
    words = ["explain", dataset(folder, "a.csv")]
    os.mkfifo(folder / "a.csv")
    return words


def data_has_200_MB(folder):
    words = ["explain", dataset(folder, "a.csv")]
    (folder / "a.csv").touch()
    os.truncate(folder / "a.csv", 200_000_000)
    return words


def data_is_a_parquet_bomb(folder):
    words = ["explain", dataset(folder, "a.parquet")]
    block = pa.table({"time_s": pa.nulls(20_000_000, pa.float64())})
    with pq.ParquetWriter(folder / "a.parquet", block.schema) as writer:
        for _ in range(8):
            writer.write_table(block, row_group_size=20_000_000)
    return words


def data_is_a_parquet_bomb_of_texts(folder):
    words = ["explain", dataset(folder, "a.parquet")]
    texts = pa.DictionaryArray.from_arrays(pa.array([0] * 20_000, pa.int32()), ["a" * 100_000])
    pq.write_table(pa.table({"time_s": texts}), folder / "a.parquet")
    return words


def data_has_nul_in_its_name(folder):
    return ["explain", dataset(folder, r"a\u0000.csv")]


def scenario_is_nested_deeply(folder):
    return ["run", scenario(folder, SCENARIO + "[x]\na = " + "[" * 3000 + "]" * 3000)]


def scenario_has_a_number_of_6000_digits(folder):
    return ["run", scenario(folder, f"seed = {'9' * 6000}\n" + SCENARIO)]


def scenario_has_a_number_of_400_digits(folder):
    return ["run", scenario(folder, f"initial_speed_m_s = {'9' * 400}\n" + SCENARIO)]


def setting_is_nested_deeply(folder):
    return ["run", "velim_a1", "--set", "vehicle.mass_kg=" + "[" * 3000 + "]" * 3000]


def setting_has_a_number_of_6000_digits(folder):
    return ["run", "velim_a1", "--set", "vehicle.mass_kg=" + "9" * 6000]


def fault_has_a_number_of_6000_digits(folder):
    return ["run", "velim_a1", "--fault", "speed_sensor_stuck axle=" + "9" * 6000]


def sequence_is_nested_deeply(folder):
    return ["sequence", "--check", scenario(folder, "a = " + "{a = " * 500 + "1" + "}" * 500)]


def scenario_has_nul_in_a_path(folder):
    return ["run", scenario(folder, r'rig = "a\u0000.toml"' + "\n" + SCENARIO)]


def sealed_is_a_bomb(folder):
    text = base64.b64encode(deflated_zeros(700)).decode()
    assert len(text) < 990_000
    return ["run", scenario(folder, f'sealed = "{text}"\n' + SCENARIO)]


def fmu_description_is_a_bomb(folder):
    return fmu(folder, DESCRIPTION.format("<a/>" * 11_000_000))


def fmu_unpacks_to_200_MB(folder):
    words = fmu(folder, DESCRIPTION.format(""), zeros=bytes(200_000_000))
    assert folder.stat().st_size < 1_000_000
    return words


def fmu_defines_entities(folder):
    entities = '<!ENTITY a "aaaaaaaaaa">' + "".join(
        f'<!ENTITY {chr(97 + k)} "{f"&{chr(96 + k)};" * 10}">' for k in range(1, 10)
    )
    return fmu(folder, f"<!DOCTYPE x [{entities}]>" + DESCRIPTION.format("&j;"))


def fmu_is_a_pipe(folder):
    os.mkfifo(folder)
    return ["check", str(folder)]


# a maker of files, which returns the words of a command; and what its message must contain
COMMANDS = {
    data_is_a_device: "/dev/zero: is outside of its folder",
    data_is_a_link_to_a_device: "is outside of its folder",
    recording_is_a_device: "is outside of its folder",
    data_is_a_link_out_of_the_folder: "copy the file into the folder",
    data_is_a_pipe: "is a pipe, and a CSV file is needed",
    data_has_200_MB: "has 200 MB; a CSV file may have at most 128 MB",
    data_is_a_parquet_bomb: "160000000 rows need",
    data_is_a_parquet_bomb_of_texts: "the texts of column 'time_s' need 2000 MB",
    data_has_nul_in_its_name: "must not contain the character NUL",
    scenario_is_nested_deeply: "at most 32 deep",
    scenario_has_a_number_of_6000_digits: "line 1: a number has too many digits",
    scenario_has_a_number_of_400_digits: "initial_speed_m_s: the number is too large",
    setting_is_nested_deeply: "--set vehicle.mass_kg",
    setting_has_a_number_of_6000_digits: "--set vehicle.mass_kg",
    fault_has_a_number_of_6000_digits: "a number has too many digits",
    sequence_is_nested_deeply: "at most 32 deep",
    scenario_has_nul_in_a_path: "no such file",
    sealed_is_a_bomb: "sealed: the text is damaged",
    fmu_description_is_a_bomb: "has more than 32 MB",
    fmu_unpacks_to_200_MB: "would unpack to 200 MB; at most",
    fmu_defines_entities: "has a document type",
    fmu_is_a_pipe: "is a pipe, and an FMU is needed",
}


def run_limited(commands, folder):
    """Run commands in one child process with limited memory; return their results by name."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(ADDRESS_SPACE_BYTES)],
        input=json.dumps(commands),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def commands_with_names_that_act(folder):
    """Return commands about names with control characters and with markup."""
    named = folder / "a\x1b]0;owned\x07\u202e.fmu"
    return {
        "table": fmu(named, DESCRIPTION.format(MODEL_EXCHANGE)),
        "error": ["run", str(folder / "no\x1b[2J\r\x9b.toml")],
        "usage": ["run", "velim_a1", "--pacing", "\x1b[31mred"],
    }


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("others")
    # the NUL of a name is in a file, because no argument can contain it
    commands = {make.__name__: make(folder / make.__name__) for make in COMMANDS}
    return run_limited(commands | commands_with_names_that_act(folder), folder)


@pytest.mark.parametrize("make", COMMANDS, ids=lambda make: make.__name__)
def test_a_harmful_file_is_refused_with_a_message_and_little_memory(make, results):
    status, out, err, resident_bytes = results[make.__name__]
    assert status == 2, out + err
    assert "Traceback" not in err
    assert COMMANDS[make] in err
    assert "top secret" not in err
    assert len(err) < 6000
    assert resident_bytes < MOST_RESIDENT_BYTES


# --- names that act ---


@pytest.fixture
def printed(results):
    """What commands print about names with control characters and with markup."""
    return {name: results[name] for name in ("table", "error", "usage")}


def test_no_control_character_of_a_name_reaches_the_terminal(printed):
    for status, out, err, _ in printed.values():
        assert status == 2
        assert "Traceback" not in err
        assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", out + err)
    table, error, usage = (printed[name][1] + printed[name][2] for name in printed)
    # the terminal of the test is narrow, so that names are folded
    assert "\\x1b]0;owned" in "".join(table.split())
    assert "no\\x1b[2J\\r\\x9b.toml: no such file" in error
    assert "\\x1b[31mred" in usage


def test_the_markup_of_a_name_is_printed_as_it_is(printed):
    assert "[/nope]" in "".join(printed["table"][1].split())


def test_a_page_and_a_pdf_show_hidden_characters(tmp_path):
    hostile = "a\x1b[31m\x00\u202e<b>"
    with page.on_paper():
        text = page.page(hostile, page.table(("x", "y"), [(hostile, "1"), ("b", "2")]))
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", text)
    assert "a\\x1b[31m\\x00\\u202e&lt;b&gt;" in text
    body = text[text.index("<body>") : text.index("</html>")]
    ET.fromstring(body)
    pdf.write(text, tmp_path / "a.pdf")
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")


def test_a_dollar_sign_in_a_picture_is_no_formula():
    drawn = page.picture(lambda figure: figure.suptitle(r"$\frac{ $ \x1b".replace("x1b", "\x1b")))
    assert "frac" in drawn


# --- links in folders of runs and reports ---


def test_a_note_that_is_a_link_is_not_shown_and_a_new_note_replaces_the_link(tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("secret")
    run = tmp_path / "runs" / "one"
    run.mkdir(parents=True)
    (run / "scenario.toml").write_text(SCENARIO)
    (run / library.NOTE).symlink_to(secret)
    assert library.note(run) == ""
    (row,) = library.rows(tmp_path / "runs")
    assert row["note"] == ""

    library.write_note(run, "mine")
    assert library.note(run) == "mine"
    assert secret.read_text() == "secret"


def test_the_files_of_a_run_are_read_only_from_its_folder(tmp_path):
    other = tmp_path / "other"
    run = tmp_path / "run"
    other.mkdir()
    run.mkdir()
    (other / run_folder.SCENARIO).write_text(SCENARIO)
    (other / run_folder.SUMMARY).write_text("{}")
    (other / run_folder.EVENTS).write_text("")
    channels.Channels(other, signals.table(COACH).columns).finish()
    assert records.load(other).summary == {}

    for name in (run_folder.SCENARIO, run_folder.CHANNELS, run_folder.SUMMARY, run_folder.EVENTS):
        (run / name).symlink_to(other / name)
    for read in (
        lambda: records.load(run),
        lambda: records.summary(run),
        lambda: records.events(run),
        lambda: channels.load(run),
    ):
        with pytest.raises(ConfigError, match="is outside of its folder"):
            read()


def test_a_run_does_not_write_through_links_in_its_folder(tmp_path):
    target = tmp_path / "target"
    target.write_text("precious")
    run = tmp_path / "run"
    run.mkdir()
    (run / run_folder.MARK).symlink_to(target)
    for name in run_folder.FILES:
        (run / name).symlink_to(target)
    run_folder.begin(run)
    assert target.read_text() == "precious"
    assert not (run / run_folder.MARK).is_symlink()
    assert not any((run / name).is_symlink() for name in run_folder.FILES)


def test_a_report_does_not_write_through_links_in_its_folder(tmp_path):
    target = tmp_path / "target"
    target.write_text("precious")
    out = tmp_path / "report"
    out.mkdir()
    names = ("report.json", "report.html", "report.rrd")
    for name in names:
        (out / name).symlink_to(target)
    assert cli.main(["explain", str(RECORDING), "--out", str(out)]) == 0
    assert target.read_text() == "precious"
    assert not any((out / name).is_symlink() for name in names)
    assert json.loads((out / "report.json").read_text())["verdict"]


# --- channels of MDF ---


def test_a_compressed_block_of_an_mdf_file_is_not_unpacked_without_limit(tmp_path):
    packed = deflated_zeros(1100)
    header = struct.pack(
        "<4s4xQQ2sBxIQQ", b"##DZ", 48 + len(packed), 0, b"DT", 0, 0, 1, len(packed)
    )
    path = tmp_path / "a.mf4"
    path.write_bytes(b"MDF     4.10" + bytes(100) + header + packed)
    with pytest.raises(ConfigError, match=r"need more than 1000 MB of memory.*split it"):
        mdf.channels(path, ("wheel_speed_1_rad_s",))


# --- what `check` recommends ---


def test_check_never_recommends_that_everybody_may_write_to_a_device():
    findings = check.check_machine(0)
    for finding in findings:
        assert not re.search(r"chmod|o\+w|a\+w|\b0?(666|777)\b", finding.mend)
    (idle,) = [finding for finding in findings if finding.name == "idle states"]
    if idle.mend:
        assert 'GROUP="realtime", MODE="0660"' in idle.mend
        assert "usermod" in idle.mend


def test_runs_of_one_name_are_shown_with_as_many_parts_of_their_path_as_make_them_differ():
    folders = [Path("a/mine/stop"), Path("b/mine/stop"), Path("c/other")]
    assert run_folder.short_names(folders) == ["a/mine/stop", "b/mine/stop", "other"]
    assert run_folder.short_names([Path("runs/a"), Path("runs/a")]) == ["a", "a"]
