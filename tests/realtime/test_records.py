"""Reading a run's folder, also an incomplete one, and writing channels while a run goes on."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record import channels, records
from rollerrig.realtime.record.channels import Channels
from rollerrig.wsp_interface.events import Code, Event, make
from rollerrig.wsp_interface.signals import COLUMNS

FIRST = make(1.5, Code.UNIT_LOST, node=32, silent_s=0.2)


def some_rows(first, count):
    rows = np.random.default_rng(first).normal(size=(count, len(COLUMNS)))
    rows[:, 0] = np.arange(first, first + count) / 100.0
    return rows


@pytest.fixture
def folder(tmp_path):
    """A run of 300 rows."""
    written = Channels(tmp_path)
    written.add(some_rows(0, 300))
    written.finish()
    (tmp_path / "scenario.toml").write_text('title = "a run"\n[loop]\ntick_hz = 1000\n')
    (tmp_path / "events.jsonl").write_text(json.dumps(FIRST._asdict()) + "\n")
    return tmp_path


def test_a_run_reads_back_as_it_was_written(folder):
    run = records.load(folder)
    assert np.array_equal(records.rows(run.table), some_rows(0, 300))
    assert run.scenario["loop"]["tick_hz"] == 1000
    assert run.events == [FIRST]
    assert run.summary == {}
    assert run.column("time_s")[-1] == 2.99


def test_channels_are_readable_from_the_first_moment(tmp_path):
    Channels(tmp_path)
    assert pq.read_table(tmp_path / "channels.parquet").column_names == list(COLUMNS)


def test_rows_that_are_only_in_the_tail_are_read_too(tmp_path):
    written = Channels(tmp_path)
    written.add(some_rows(0, 10))
    written.write()
    written.add(some_rows(10, 7))
    written.add(some_rows(17, 3))
    expected = np.vstack([some_rows(0, 10), some_rows(10, 7), some_rows(17, 3)])
    assert len(pq.read_table(tmp_path / "channels.parquet")) == 10
    assert np.array_equal(records.rows(channels.load(tmp_path)), expected)


def test_rows_in_both_file_and_tail_are_read_once(tmp_path):
    written = Channels(tmp_path)
    written.add(some_rows(0, 10))
    tail = (tmp_path / "channels.tail").read_bytes()
    written.write()
    (tmp_path / "channels.tail").write_bytes(tail)  # killed before the tail was emptied
    assert channels.load(tmp_path)["time_s"].to_pylist() == [n / 100 for n in range(10)]


def test_a_row_of_the_tail_that_was_cut_off_is_left_out(tmp_path):
    written = Channels(tmp_path)
    written.add(some_rows(0, 10))
    tail = tmp_path / "channels.tail"
    tail.write_bytes(tail.read_bytes()[:-100])
    assert np.array_equal(records.rows(channels.load(tmp_path)), some_rows(0, 10)[:9])


def test_many_small_blocks_are_read_as_one_table(tmp_path):
    written = Channels(tmp_path)
    for number in range(500):
        written.add(some_rows(number, 1))
    expected = np.vstack([some_rows(number, 1) for number in range(500)])
    written.finish()
    assert np.array_equal(records.rows(channels.load(tmp_path)), expected)


def test_channels_are_written_again_when_a_second_has_not_yet_passed(tmp_path):
    written = Channels(tmp_path)
    written._due_s += 1000.0
    written.add(some_rows(0, 10))
    written.write_if_due()
    assert len(pq.read_table(tmp_path / "channels.parquet")) == 0
    written._due_s -= 1001.0
    written.write_if_due()
    assert len(pq.read_table(tmp_path / "channels.parquet")) == 10


def test_rows_are_taken_in_while_a_long_file_is_written_part_by_part(tmp_path, monkeypatch):
    monkeypatch.setattr(channels, "_STEP_S", 0.0)
    monkeypatch.setattr(channels, "_BLOCK_BYTES", 100 * 8 * len(COLUMNS))
    written = Channels(tmp_path)
    written.add(some_rows(0, 250))
    written._due_s -= 1.0
    written.write_if_due()
    written.add(some_rows(250, 50))
    for _ in range(2):
        assert len(pq.read_table(tmp_path / "channels.parquet")) == 0
        assert len(channels.load(tmp_path)) == 300
        written.write_if_due()
    written.write_if_due()
    assert len(pq.read_table(tmp_path / "channels.parquet")) == 250
    expected = np.vstack([some_rows(0, 250), some_rows(250, 50)])
    assert np.array_equal(records.rows(channels.load(tmp_path)), expected)
    written.finish()
    assert np.array_equal(records.rows(channels.load(tmp_path)), expected)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "channels.parquet").unlink(), "channels.parquet: no such file"),
        (lambda f: (f / "channels.parquet").write_bytes(b"PAR1 not"), "channels.parquet: damaged"),
        (lambda f: (f / "scenario.toml").unlink(), "not a run's folder"),
        (lambda f: (f / "scenario.toml").write_text("= ="), "scenario.toml: not valid TOML"),
        (
            lambda f: (f / "events.jsonl").write_text("x\n{}\n"),
            "events.jsonl, line 1: not an event",
        ),
        (lambda f: (f / "summary.json").write_text("{"), "summary.json: not valid JSON"),
        (lambda f: (f / "summary.json").write_text("[]"), "summary.json: an object is wanted"),
    ],
)
def test_what_is_missing_or_damaged_is_named(folder, spoil, message):
    spoil(folder)
    with pytest.raises(ConfigError, match=message):
        records.load(folder)


def test_a_parquet_file_that_is_no_run_is_refused(folder):
    pq.write_table(channels.load(folder).select(["position_m"]), folder / "channels.parquet")
    with pytest.raises(ConfigError, match="has no column time_s"):
        records.load(folder)


def test_a_folder_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(ConfigError, match="nowhere: no such folder"):
        records.load(tmp_path / "nowhere")


def test_a_channel_that_does_not_exist_is_named(folder):
    with pytest.raises(ConfigError, match="no channel is called 'speed'"):
        records.load(folder).column("speed")


def test_an_event_that_a_kill_cut_off_is_left_out(folder):
    with open(folder / "events.jsonl", "a") as file:
        file.write('{"time_s": 2.0, "lev')
    assert records.load(folder).events == [FIRST]


def test_events_from_before_there_were_codes_are_read_without_one(folder):
    old = {"time_s": 1.5, "level": "info", "text": "first"}
    new = old | {"code": "of.tomorrow", "fields": {"at_m": 2.0}}
    (folder / "events.jsonl").write_text(f"{json.dumps(old)}\n{json.dumps(new)}\n")
    assert records.load(folder).events == [
        Event(1.5, "info", "first", None, {}),
        Event(1.5, "info", "first", None, {"at_m": 2.0}),
    ]


def test_a_summary_is_replaced_in_one_step(folder):
    records.write_summary(folder, {"stopped": True})
    records.write_summary(folder, {"stopped": False})
    assert records.load(folder).summary == {"stopped": False}
    assert not list(folder.glob(".*"))
