"""Runs exported and read back by the readers of others."""

import csv
import json
import resource
import subprocess
import sys

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record import export, records
from rollerrig.realtime.record.channels import Channels
from rollerrig.wsp_interface.signals import COLUMNS

EVENTS = [(0.5, "info", "the rig is on the bus"), (1.25, "warning", "Ölstand, „niedrig“")]


@pytest.fixture
def run(tmp_path):
    """Half a second of all channels, with two events."""
    folder = tmp_path / "run"
    folder.mkdir()
    rows = np.random.default_rng(1).normal(size=(50, len(COLUMNS)))
    rows[:, 0] = np.arange(50) / 100.0
    rows[3, 7] = np.nan
    channels = Channels(folder)
    channels.add(rows)
    channels.finish()
    (folder / "scenario.toml").write_text('title = "a run"\n')
    (folder / "events.jsonl").write_text(
        "".join(
            json.dumps(dict(zip(("time_s", "level", "text"), event, strict=True))) + "\n"
            for event in EVENTS
        )
    )
    return records.load(folder)


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
        told = read.get("events")
        assert list(told.timestamps) == [event[0] for event in EVENTS]
        assert [
            text.decode().rstrip("\0") if isinstance(text, bytes) else text for text in told.samples
        ] == [f"{level}: {text}" for _, level, text in EVENTS]


def test_mat_gives_back_every_channel_with_its_unit_and_the_events(run, tmp_path):
    from scipy.io import loadmat

    [file] = export.write(run, "mat", tmp_path / "run.mat")
    read = loadmat(file, squeeze_me=True, simplify_cells=True)
    for name in COLUMNS:
        assert np.array_equal(read[name], run.column(name), equal_nan=True), name
    assert read["units"]["vehicle_speed_m_s"] == "m/s"
    assert list(read["events"]["time_s"]) == [event[0] for event in EVENTS]
    assert list(read["events"]["text"]) == [event[2] for event in EVENTS]


def test_csv_gives_back_every_channel_with_its_unit_and_the_events(run, tmp_path):
    file, beside = export.write(run, "csv", tmp_path / "run.csv")
    with file.open(encoding="utf-8") as lines:
        names, units = (next(csv.reader(lines)) for _ in range(2))
        rows = np.loadtxt(lines, delimiter=",")
    assert names == list(COLUMNS)
    assert units[names.index("vehicle_acceleration_m_s2")] == "m/s^2"
    assert np.array_equal(rows, records.rows(run.table), equal_nan=True)
    with beside.open(encoding="utf-8") as lines:
        assert [
            (float(time_s), level, text) for time_s, level, text in list(csv.reader(lines))[1:]
        ] == EVENTS


def test_an_unknown_format_is_refused_with_those_there_are(run, tmp_path):
    with pytest.raises(ConfigError, match=r"mdf5.*did you mean 'mdf4'.*csv, mat, mdf4"):
        export.write(run, "mdf5", tmp_path / "run.mdf5")


def test_without_asammdf_the_message_says_how_to_install_it(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "asammdf", None)
    with pytest.raises(ConfigError, match=r"pip install 'rollerrig\[export\]'"):
        export.write(run, "mdf4", tmp_path / "run.mf4")


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "rollerrig.realtime.cli",
            "export",
            str(tmp_path),
            "--format",
            "csv",
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "not a run's folder" in done.stderr


def test_a_full_disk_leaves_no_half_a_file(run, tmp_path):
    out = tmp_path / "full" / "run.csv"
    full = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))  # noqa: E731
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "rollerrig.realtime.cli",
            "export",
            str(run.folder),
            "--format",
            "csv",
            "--out",
            str(out),
        ],
        capture_output=True,
        text=True,
        preexec_fn=full,
    )
    assert done.returncode == 2
    assert "make room" in done.stderr
    assert list(out.parent.iterdir()) == []
