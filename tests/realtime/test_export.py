"""Exported runs, read back by the readers of other packages."""

import csv
import json
import sys
from typing import NamedTuple

import numpy as np
import program
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH
from rollerrig.realtime.record import export, records
from rollerrig.realtime.record.channels import Channels
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)
COLUMNS = TABLE.columns


class RunEvent(NamedTuple):
    """The fields of an event that every format holds."""

    time_s: float
    level: str
    text: str


EVENTS = [
    RunEvent(0.5, "info", "the rig is on the bus"),
    RunEvent(1.25, "warning", "Ölstand, „niedrig“"),
]


@pytest.fixture
def run(tmp_path):
    """A run of half a second with all channels, one missing value and two events."""
    folder = tmp_path / "run"
    folder.mkdir()
    rows = np.random.default_rng(1).normal(size=(50, len(COLUMNS)))
    rows[:, COLUMNS.index("time_s")] = np.arange(50) / 100.0
    rows[3, 7] = np.nan  # any value
    channels = Channels(folder, COLUMNS)
    channels.add(rows)
    channels.finish()
    (folder / "scenario.toml").write_text('title = "a run"\n')
    lines = [json.dumps(event._asdict()) + "\n" for event in EVENTS]
    (folder / "events.jsonl").write_text("".join(lines))
    return records.load(folder)


def as_text(sample):
    """Return a text of an MDF file, which is padded with zeros if it is read as bytes."""
    if isinstance(sample, bytes):
        return sample.decode().rstrip("\0")
    return sample


def test_mdf4_gives_back_every_channel_with_its_unit_and_the_events(run, tmp_path):
    asammdf = pytest.importorskip("asammdf")
    [file] = export.write(run, "mdf4", tmp_path / "run.mf4")
    with asammdf.MDF(file) as read:
        for name in COLUMNS[1:]:
            signal = read.get(name)
            assert np.array_equal(signal.samples, run.column(name), equal_nan=True), name
            assert np.array_equal(signal.timestamps, run.column("time_s"))
        assert read.get("vehicle_speed_m_s").unit == "m/s"
        assert read.get("cylinder_pressure_1_Pa").unit == "Pa"

        events = read.get("events")
        assert list(events.timestamps) == [event.time_s for event in EVENTS]
        texts = [as_text(sample) for sample in events.samples]
        assert texts == [f"{event.level}: {event.text}" for event in EVENTS]


def test_mat_gives_back_every_channel_with_its_unit_and_the_events(run, tmp_path):
    from scipy.io import loadmat

    [file] = export.write(run, "mat", tmp_path / "run.mat")
    read = loadmat(file, squeeze_me=True, simplify_cells=True)
    for name in COLUMNS:
        assert np.array_equal(read[name], run.column(name), equal_nan=True), name
    assert read["units"]["vehicle_speed_m_s"] == "m/s"
    assert list(read["events"]["time_s"]) == [event.time_s for event in EVENTS]
    assert list(read["events"]["text"]) == [event.text for event in EVENTS]


def test_csv_gives_back_every_channel_with_its_unit_and_the_events(run, tmp_path):
    file, events_file, _ = export.write(run, "csv", tmp_path / "run.csv")

    with file.open(encoding="utf-8") as lines:
        names = next(csv.reader(lines))
        units = next(csv.reader(lines))
        rows = np.loadtxt(lines, delimiter=",")
    assert names == list(COLUMNS)
    assert units[names.index("vehicle_acceleration_m_s2")] == "m/s^2"
    assert np.array_equal(rows, records.rows(run.table, TABLE)[:, TABLE.kept], equal_nan=True)

    with events_file.open(encoding="utf-8") as lines:
        _, *event_rows = csv.reader(lines)
    events = [RunEvent(float(time_s), level, text) for time_s, level, text in event_rows]
    assert events == EVENTS


def test_mcap_gives_back_every_channel_with_its_unit_and_the_events(run, tmp_path):
    reader = pytest.importorskip("mcap.reader")
    [path] = export.write(run, "mcap", tmp_path / "run.mcap")
    with path.open("rb") as file:
        read = reader.make_reader(file)
        (what,) = read.iter_metadata()
        messages = list(read.iter_messages())
    assert what.name == "run"
    samples = [found for found in messages if found[1].topic == "/signals"]
    assert [message.log_time for _, _, message in samples] == [
        round(time_s * 1e9) for time_s in run.column("time_s")
    ]
    schema = json.loads(samples[0][0].data)
    assert schema["properties"]["vehicle_speed_m_s"]["description"].endswith("[m/s]")
    rows = [json.loads(message.data) for _, _, message in samples]
    for name in COLUMNS[1:]:
        values = np.array([row.get(name, np.nan) for row in rows])
        assert np.array_equal(values, run.column(name), equal_nan=True), name

    logs = [json.loads(found[2].data) for found in messages if found[1].topic == "/events"]
    levels = {"info": 2, "warning": 3}
    for entry, event in zip(logs, EVENTS, strict=True):
        at = entry["timestamp"]
        assert at["sec"] + 1e-9 * at["nsec"] == pytest.approx(event.time_s)
        assert (entry["level"], entry["message"]) == (levels[event.level], event.text)


def test_an_unknown_format_is_refused_with_a_list_of_the_known_formats(run, tmp_path):
    with pytest.raises(ConfigError, match=r"mdf5.*did you mean 'mdf4'.*csv, mat, mcap, mdf4"):
        export.write(run, "mdf5", tmp_path / "run.mdf5")


@pytest.mark.parametrize(("package", "name"), [("asammdf", "mdf4"), ("mcap.writer", "mcap")])
def test_without_a_package_the_message_shows_how_to_install_it(
    package, name, run, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=r"pip install 'rollerrig\[export\]'"):
        export.write(run, name, tmp_path / "out")


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    done = program.rollerrig("export", tmp_path, "--format", "csv")
    assert done.status == 2
    assert "not a run's folder" in done.messages


# the command line in a process that writes files of at most 4 KiB, as on a disk that is almost full
ALMOST_FULL = """
import resource
import sys
from rollerrig.realtime import cli
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
sys.exit(cli.main(sys.argv[1:]))
"""


def test_a_full_disk_leaves_no_incomplete_file(run, tmp_path):
    out = tmp_path / "full" / "run.csv"
    words = ("export", run.folder, "--format", "csv", "--out", out)
    done = program.python("-c", ALMOST_FULL, *words)
    assert done.status == 2
    assert "make room" in done.messages
    assert list(out.parent.iterdir()) == []
