"""A run's folder is read, also an incomplete one; channels are written while a run goes on."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.realtime.record import channels, records
from rollerrig.realtime.record.channels import Channels
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code, Event, make

TABLE = signals.table(COACH)
COLUMNS = TABLE.columns
RECORD_HZ = 100.0
UNIT_LOST = make(1.5, Code.UNIT_LOST, node=32, silent_s=0.2)


def some_rows(first, count):
    """Return rows `first` to `first + count - 1` of a run: rising times and random values."""
    rows = np.random.default_rng(first).normal(size=(count, len(COLUMNS)))
    rows[:, COLUMNS.index("time_s")] = np.arange(first, first + count) / RECORD_HZ
    return rows


def rows_in_file(folder):
    """Return how many rows channels.parquet has, without those of the tail."""
    return len(pq.read_table(folder / "channels.parquet"))


def rows_read_from(folder):
    """Return the rows of the file and of the tail, shape (n, columns)."""
    return records.rows(channels.load(folder), TABLE)[:, TABLE.kept]


@pytest.fixture
def folder(tmp_path):
    """The folder of a run with 300 rows and one event."""
    writer = Channels(tmp_path, COLUMNS)
    writer.add(some_rows(0, 300))
    writer.finish()
    (tmp_path / "scenario.toml").write_text('title = "a run"\n[loop]\ntick_hz = 1000\n')
    (tmp_path / "events.jsonl").write_text(json.dumps(UNIT_LOST._asdict()) + "\n")
    return tmp_path


def test_a_run_reads_back_as_it_was_written(folder):
    run = records.load(folder)
    assert np.array_equal(records.rows(run.table, TABLE)[:, TABLE.kept], some_rows(0, 300))
    assert run.column("time_s")[-1] == 2.99
    assert run.scenario["loop"]["tick_hz"] == 1000
    assert run.events == [UNIT_LOST]
    assert run.summary == {}
    assert run.kind == COACH


def test_a_run_knows_the_kind_of_its_vehicle_and_its_rows_have_places_for_all_signals(tmp_path):
    kind = Kind(6, dynamic_brake=True)
    table = signals.table(kind)
    values = np.arange(len(table.columns), dtype=float)
    writer = Channels(tmp_path, table.columns)
    writer.add(np.array([values]))
    writer.finish()
    (tmp_path / "scenario.toml").write_text(
        "[vehicle]\naxles = 6\n[dynamic_brake]\naxles = [1, 2]\n"
    )
    run = records.load(tmp_path)
    assert run.kind == kind
    [row] = records.rows(run.table, run.signal_table)
    assert row.shape == (signals.WIDTH,)
    for name in ("sliding", "dynamic_torque"):
        for axle in table.axles:
            column = signals.columns(table.by_name[name])[axle - 1]
            assert row[signals.column(name, axle)] == values[table.columns.index(column)]
    assert np.isnan(row[signals.column("sliding", 7)])
    assert np.isnan(row[signals.column("track_brake_work")])


def test_a_run_of_a_vehicle_that_there_cannot_be_is_refused(folder):
    (folder / "scenario.toml").write_text("[vehicle]\naxles = 5\n")
    with pytest.raises(ConfigError, match=r"axles = 5; it must be one of 2, 4"):
        records.load(folder)


# --- channels while a run goes on ---


def test_channels_are_readable_from_the_first_moment(tmp_path):
    Channels(tmp_path, COLUMNS)
    assert pq.read_table(tmp_path / "channels.parquet").column_names == list(COLUMNS)


def test_rows_that_are_only_in_the_tail_are_read_too(tmp_path):
    writer = Channels(tmp_path, COLUMNS)
    writer.add(some_rows(0, 10))
    writer.write()
    writer.add(some_rows(10, 7))
    writer.add(some_rows(17, 3))

    expected = np.vstack([some_rows(0, 10), some_rows(10, 7), some_rows(17, 3)])
    assert rows_in_file(tmp_path) == 10
    assert np.array_equal(rows_read_from(tmp_path), expected)


def test_rows_in_both_file_and_tail_are_read_once(tmp_path):
    writer = Channels(tmp_path, COLUMNS)
    writer.add(some_rows(0, 10))
    tail = (tmp_path / "channels.tail").read_bytes()
    writer.write()
    # a recorder that is killed now leaves the old tail next to the new file
    (tmp_path / "channels.tail").write_bytes(tail)

    times_s = channels.load(tmp_path)["time_s"].to_pylist()
    assert times_s == [number / RECORD_HZ for number in range(10)]


def test_an_incomplete_last_row_of_the_tail_is_left_out(tmp_path):
    writer = Channels(tmp_path, COLUMNS)
    writer.add(some_rows(0, 10))
    tail = tmp_path / "channels.tail"
    tail.write_bytes(tail.read_bytes()[:-100])
    assert np.array_equal(rows_read_from(tmp_path), some_rows(0, 10)[:9])


def test_many_small_blocks_are_read_as_one_table(tmp_path):
    writer = Channels(tmp_path, COLUMNS)
    for number in range(500):
        writer.add(some_rows(number, 1))
    writer.finish()

    expected = np.vstack([some_rows(number, 1) for number in range(500)])
    assert np.array_equal(rows_read_from(tmp_path), expected)


def test_channels_are_not_written_before_they_are_due(tmp_path):
    writer = Channels(tmp_path, COLUMNS)
    writer._due_s += 1000.0
    writer.add(some_rows(0, 10))
    writer.write_if_due()
    assert rows_in_file(tmp_path) == 0

    writer._due_s -= 1001.0
    writer.write_if_due()
    assert rows_in_file(tmp_path) == 10


def test_rows_can_be_added_while_a_long_file_is_written_block_by_block(tmp_path, monkeypatch):
    # each call of write_if_due writes one block of 100 rows
    monkeypatch.setattr(channels, "_STEP_S", 0.0)
    monkeypatch.setattr(channels, "_BLOCK_ROWS", 100)
    writer = Channels(tmp_path, COLUMNS)
    writer.add(some_rows(0, 250))
    writer._due_s -= 1.0
    writer.write_if_due()
    writer.add(some_rows(250, 50))

    # blocks two and three; the old file stays until the new one is complete
    for _ in range(2):
        assert rows_in_file(tmp_path) == 0
        assert len(channels.load(tmp_path)) == 300
        writer.write_if_due()

    # this call completes the new file, with the rows that were there when its write began
    writer.write_if_due()
    expected = np.vstack([some_rows(0, 250), some_rows(250, 50)])
    assert rows_in_file(tmp_path) == 250
    assert np.array_equal(rows_read_from(tmp_path), expected)

    writer.finish()
    assert np.array_equal(rows_read_from(tmp_path), expected)


# --- missing and damaged files ---


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("channels.parquet", "channels.parquet: no such file"),
        ("scenario.toml", "not a run's folder"),
    ],
)
def test_a_missing_file_is_reported(folder, name, message):
    (folder / name).unlink()
    with pytest.raises(ConfigError, match=message):
        records.load(folder)


def test_a_name_of_a_channel_that_is_no_text_is_reported(folder):
    path = folder / "channels.parquet"
    path.write_bytes(path.read_bytes().replace(b"time_s", b"tim\xe4_s"))
    with pytest.raises(ConfigError, match=r"channels.parquet: damaged"):
        records.load(folder)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("channels.parquet", "PAR1 not", "channels.parquet: damaged"),
        ("scenario.toml", "= =", "scenario.toml: not valid TOML"),
        ("events.jsonl", "x\n{}\n", "events.jsonl, line 1: not an event"),
        ("summary.json", "{", "summary.json: not valid JSON"),
        ("summary.json", "[]", "summary.json: an object is wanted"),
    ],
)
def test_a_damaged_file_is_reported(folder, name, content, message):
    (folder / name).write_text(content)
    with pytest.raises(ConfigError, match=message):
        records.load(folder)


def test_a_parquet_file_that_is_no_run_is_refused(folder):
    without_times = channels.load(folder).select(["position_m"])
    pq.write_table(without_times, folder / "channels.parquet")
    with pytest.raises(ConfigError, match="has no column time_s"):
        records.load(folder)


def test_a_folder_that_does_not_exist_is_reported(tmp_path):
    with pytest.raises(ConfigError, match="nowhere: no such folder"):
        records.load(tmp_path / "nowhere")


def test_a_channel_that_does_not_exist_is_reported(folder):
    run = records.load(folder)
    with pytest.raises(ConfigError, match="no channel is called 'speed'"):
        run.column("speed")


# --- events and summary ---


def test_an_incomplete_last_event_of_a_killed_run_is_left_out(folder):
    with open(folder / "events.jsonl", "a") as file:
        file.write('{"time_s": 2.0, "lev')
    assert records.load(folder).events == [UNIT_LOST]


def test_events_without_a_known_code_are_read(folder):
    # older versions wrote no codes, later versions may write further codes
    without_code = {"time_s": 1.5, "level": "info", "text": "first"}
    with_unknown_code = without_code | {"code": "of.tomorrow", "fields": {"at_m": 2.0}}
    lines = [json.dumps(without_code), json.dumps(with_unknown_code)]
    (folder / "events.jsonl").write_text("\n".join(lines) + "\n")

    assert records.load(folder).events == [
        Event(1.5, "info", "first", None, {}),
        Event(1.5, "info", "first", None, {"at_m": 2.0}),
    ]


def test_a_summary_is_replaced_in_one_step(folder):
    records.write_summary(folder, {"stopped": True})
    records.write_summary(folder, {"stopped": False})
    assert records.load(folder).summary == {"stopped": False}
    # no temporary file is left
    assert not list(folder.glob(".*"))
