"""The recorder keeps a run, whichever process is killed: at most its last second is lost."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import paced_writer
import process_tree
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader

from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.realtime.bench import processes
from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring
from rollerrig.realtime.record import channels, records
from rollerrig.realtime.telemetry import recorder
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import frames
from rollerrig.wsp_interface.events import Code

RAN_S = 2.0


def until(condition, timeout_s=120.0):
    """Wait until a condition is true; the test fails after the time-out."""
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def last_drawn_s(path, entity="/sliding/sliding"):
    """The latest time in s of an entity in a .rrd."""
    times = [0]
    for chunk in RrdReader(path).stream():
        if str(chunk.entity_path) == entity and not chunk.is_static:
            times += chunk.to_record_batch()["t"].cast("int64").to_pylist()
    return max(times) / 1e9


class Killed:
    """A run whose bench or recorder, or both, are killed after some seconds of writing."""

    def __init__(self, folder):
        self.folder = folder
        self.bench = subprocess.Popen(
            [sys.executable, paced_writer.__file__, str(folder)],
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def kill(self, victims):
        """Kill the victims once enough is written, and wait until the other processes exit."""
        self.recorder_was_killed = "recorder" in victims
        bench = self.bench
        printed = json.loads(bench.stdout.readline())
        self.rings = [Path(path) for path in printed["rings"]]
        rows = Ring(self.rings[0], np.float64)
        until(lambda: rows.header[ring.WRITTEN] > 100 * RAN_S)
        if "recorder" in victims:
            os.kill(printed["recorder"], signal.SIGKILL)
        self.written_s = (int(rows.header[ring.WRITTEN]) - 1) / 100.0
        if "group" in victims:
            os.killpg(bench.pid, signal.SIGKILL)
        elif "bench" in victims:
            os.kill(bench.pid, signal.SIGKILL)
        if victims != ("recorder",):
            # do not wait for it: the recorder must notice the end of a process that became a zombie
            self.written_s = (int(rows.header[ring.WRITTEN]) - 1) / 100.0
        if "recorder" not in victims:
            until(lambda: not any(path.exists() for path in self.rings))
            until(lambda: not process_tree.is_running(printed["recorder"]))
        bench.kill()
        bench.wait()
        for path in self.rings:
            path.unlink(missing_ok=True)


VICTIMS = {
    "bench_killed": ("bench",),
    "group_killed": ("group",),
    "recorder_killed": ("recorder",),
    "both_killed": ("recorder", "group"),
}


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """Run by the processes that were killed.

    They write simultaneously, because they mostly wait.
    """
    begun = {name: Killed(tmp_path_factory.mktemp(name)) for name in VICTIMS}
    for name, victims in VICTIMS.items():
        begun[name].kill(victims)
    return begun


@pytest.fixture(params=VICTIMS)
def run(request, killed):
    return killed[request.param]


def test_a_killed_run_loses_at_most_the_last_second_of_its_channels(run):
    time_s = pq.read_table(run.folder / "channels.parquet")["time_s"].to_numpy()
    assert time_s[-1] >= run.written_s - 1.0
    assert np.allclose(np.diff(time_s), 0.01)


def test_reading_a_killed_run_back_adds_what_the_file_did_not_yet_hold(run):
    time_s = records.load(run.folder).column("time_s")
    rows_in_file = pq.read_table(run.folder / "channels.parquet").num_rows
    rows_in_tail = 0
    if run.recorder_was_killed:
        # the tail has all rows since the start of the run
        tail_bytes = (run.folder / "channels.tail").stat().st_size
        rows_in_tail = tail_bytes // (8 * paced_writer.WIDTH)
    assert len(time_s) == max(rows_in_file, rows_in_tail)
    assert time_s[-1] >= run.written_s - 1.0
    assert np.allclose(np.diff(time_s), 0.01)


def test_a_killed_run_loses_at_most_the_last_second_of_its_picture(run):
    assert last_drawn_s(run.folder / "run.rrd") >= run.written_s - 1.0


def test_a_killed_run_loses_at_most_the_last_second_of_its_can_log(run):
    lines = (run.folder / "can.log").read_text().splitlines()
    assert float(lines[-1].split(")")[0].strip("(")) >= run.written_s - 1.0
    assert lines[0] == "(0000000000.000000) rig0 181#0000000000000000"


def test_a_killed_run_keeps_its_events(run):
    events = records.load(run.folder).events
    notes = [event for event in events if event.code == Code.OPERATOR_NOTE]
    assert [event.time_s for event in notes] == [0.25 * number for number in range(len(notes))]
    assert notes[-1].time_s >= run.written_s - 1.0


def test_a_recorder_whose_bench_was_killed_notes_it_and_removes_the_rings(killed):
    bench_killed = killed["bench_killed"]
    summary = records.load(bench_killed.folder).summary
    assert summary["ended"] == "killed"
    assert (summary["pacing"], summary["seed"]) == ("wall", 7)
    assert not summary["stopped"]
    assert summary["invalid_because"][0].startswith("the bench was killed, at ")
    assert summary["samples"] == round(100 * bench_killed.written_s) + 1
    assert records.load(bench_killed.folder).events[-1].code == Code.BENCH_KILLED
    assert not (bench_killed.folder / "channels.tail").exists()


def test_a_recorder_outlives_the_process_group_of_its_bench(killed):
    assert records.load(killed["group_killed"].folder).summary["ended"] == "killed"


# --- runs that end as they should ---


@contextlib.contextmanager
def recording(folder):
    """Yield rings that this process writes, and the recorder that drains them into a folder."""
    (folder / "scenario.toml").write_text(paced_writer.SCENARIO)
    to = paced_writer.rings()
    process = processes.record(folder, COACH, *to)
    try:
        yield to, process
    finally:
        process.kill()
        process.wait()
        for one in to:
            one.unlink()


@pytest.fixture
def begun(tmp_path):
    """A folder, rings that this process writes, and the recorder that drains them."""
    with recording(tmp_path) as (to, process):
        yield tmp_path, to, process


def finish(to, process):
    for one in to:
        one.close()
    assert process.wait(120) == 0


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run of ten seconds that has finished."""
    folder = tmp_path_factory.mktemp("finished")
    with recording(folder) as (to, process):
        assert processes.wait_ready(process, to[0])
        for number in range(1000):
            paced_writer.write(to, number)
        finish(to, process)
    return folder


def test_a_finished_run_is_recorded_whole(finished):
    folder = finished
    run = records.load(folder)
    expected = np.array([paced_writer.row(number) for number in range(1000)])
    assert run.table.column_names == list(paced_writer.TABLE.columns)
    rows = records.rows(run.table, paced_writer.TABLE)
    assert np.array_equal(rows[:, paced_writer.TABLE.kept], expected)
    assert len((folder / "can.log").read_text().splitlines()) == 2000
    assert len(run.events) == 40
    assert run.summary["ended"] == "finished"
    assert run.summary["recorder"]["lost"] == 0
    assert last_drawn_s(folder / "run.rrd") == 9.99
    assert sorted(path.name for path in folder.iterdir()) == [
        "can.log",
        "channels.parquet",
        "events.jsonl",
        "run.rrd",
        "scenario.toml",
        "summary.json",
    ]


def resident_MB(process):
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+) kB", status)[1]) / 1024


@pytest.mark.nightly
def test_the_memory_of_a_recorder_does_not_grow_with_the_length_of_its_run(begun):
    folder, to, process = begun
    assert processes.wait_ready(process, to[0])
    minutes = 12
    taken = []
    for number in range(minutes * 6000):
        paced_writer.write(to, number)
        while min(one.room / one.header[ring.CAPACITY] for one in to) < 0.5:
            time.sleep(0.01)
        if number % 6000 == 5999:
            taken.append(resident_MB(process))
    finish(to, process)
    # the memory of Arrow and Rerun varies by 50 MB; rows that stay in memory (16 MB a minute) would
    # add 128 MB
    assert max(taken[-4:]) < max(taken[:4]) + 80.0, taken
    assert len(channels.load(folder)) == minutes * 6000


def test_the_recording_holds_the_values_of_the_channels(finished):
    folder = finished
    table = channels.load(folder)
    found = {}
    for chunk in RrdReader(folder / "run.rrd").stream():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            values = found.setdefault(str(chunk.entity_path), [])
            values += batch["Scalars:scalars"].to_pylist()
    found = {path: np.array(values) for path, values in found.items()}
    assert np.array_equal(
        found["/speeds/vehicle_speed"][:, 0], 3.6 * np.array(table["vehicle_speed_m_s"])
    )  # km/h
    assert found["/adhesion/adhesion_2"][:, 0].tolist() == table["adhesion_2"].to_pylist()
    for axle in paced_writer.TABLE.axles:
        assert (
            found["/sliding/sliding"][:, axle - 1].tolist()
            == table[f"sliding_{axle}_m_s"].to_pylist()
        )


def test_the_recorder_gets_the_vehicle_from_the_bench_and_not_from_the_scenario_file(tmp_path):
    (tmp_path / "scenario.toml").write_text("this is no TOML")
    kind = Kind(6, magnetic_track_brake=True)
    columns = signals.table(kind).columns
    to = paced_writer.rings(width=len(columns))
    process = processes.record(tmp_path, kind, *to)
    try:
        assert processes.wait_ready(process, to[0])
        for number in range(100):
            values = np.zeros(len(columns))
            values[columns.index("time_s")] = number / 100.0
            to[0].push(values)
        finish(to, process)
    finally:
        process.kill()
        process.wait()
        for one in to:
            one.unlink()
    assert pq.read_table(tmp_path / "channels.parquet").column_names == list(columns)
    assert len(json.loads((tmp_path / "summary.json").read_text())["axles"]) == 6
    assert last_drawn_s(tmp_path / "run.rrd") == 0.99


def test_rows_that_were_overrun_are_counted_and_reported(begun):
    folder, to, process = begun
    for number in range(6000):  # the recorder has not started yet, and the ring holds 4096
        to[0].push(paced_writer.row(number))
    assert processes.wait_ready(process, to[0])
    finish(to, process)
    run = records.load(folder)
    assert len(run.table) == 4095
    assert run.summary["recorder"]["lost"] == 6000 - 4095
    overruns = [event.fields for event in run.events if event.code == Code.RECORDER_OVERRUN]
    assert overruns == [{"lost": 1905, "rows": "rows of channels"}]


def test_ctrl_c_is_left_to_the_bench(begun):
    folder, to, process = begun
    assert processes.wait_ready(process, to[0])
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGHUP)
    time.sleep(0.3)
    paced_writer.write(to, 0)
    finish(to, process)
    assert len(channels.load(folder)) == 1


def test_a_recorder_that_is_terminated_completes_the_files(begun):
    folder, to, process = begun
    assert processes.wait_ready(process, to[0])
    for number in range(50):
        paced_writer.write(to, number)
    process.terminate()
    assert process.wait(120) == 0
    assert records.load(folder).summary["ended"] == "terminated"
    assert len(channels.load(folder)) == 50


def test_the_recorder_gives_way_to_the_bench(begun):
    _, to, process = begun
    assert processes.wait_ready(process, to[0])
    nice_of_bench = os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getpriority(os.PRIO_PROCESS, process.pid) >= min(nice_of_bench + 5, 19)
    assert os.getsid(process.pid) == process.pid


def test_each_run_has_a_different_recording_id(tmp_path):
    first, second = (Ring(tmp_path / name, np.float64, 4, 2) for name in ("a", "b"))
    assert recorder.recording_id(tmp_path, first) == recorder.recording_id(tmp_path, first)
    assert recorder.recording_id(tmp_path, first) != recorder.recording_id(tmp_path, second)
    assert recorder.recording_id(tmp_path, first) != recorder.recording_id(tmp_path / "x", first)


@pytest.mark.parametrize(
    ("word", "length", "line"),
    [
        (0x181, 8, "(0000000001.500000) rig0 181#0807060504030201"),
        (0x181, 2, "(0000000001.500000) rig0 181#0807"),
        (0x1ABCDEF0 | frames.EXTENDED_FLAG, 1, "(0000000001.500000) rig0 1ABCDEF0#08"),
        (0x702 | frames.REMOTE_FLAG, 0, "(0000000001.500000) rig0 702#R"),
    ],
)
def test_a_row_of_the_frame_ring_is_a_line_of_a_candump_log(word, length, line):
    row = [1_500_000_000, word, length, 0x0102030405060708]
    assert frames.candump_line(recorder.frame_of(row), "rig0") == line
