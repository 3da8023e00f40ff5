"""The real-time loop: deadlines, lateness, and its report when the system refuses a request."""

import os
import threading
import time

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.realtime.bench import bench, scenario, tick_data
from rollerrig.realtime.loop import clock, loop, tick
from rollerrig.realtime.loop import ring as rings
from rollerrig.realtime.loop.tick import DONE, MISSED, STALLED_NS, STOP, TICK, WORST_NS
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)

MS = 1_000_000


def built(folder, duration_s):
    """The tick data of a stop that lasts at most this time."""
    ring = rings.Ring(folder / "rows", np.float64, 1 << 12, len(TABLE.columns))
    plan = scenario.load("velim_a1", settings=(f"duration_max_s={duration_s}",))
    return tick_data.build(plan, ring)


@pytest.fixture
def machine(tmp_path):
    return built(tmp_path, 0.5)


def wall(machine, begin_ns, sync_ticks=10, early_ns=0):
    """Run the loop to its end; return its histogram, and how often it woke the bus thread."""
    histogram = np.zeros(loop.BINS, dtype=np.int64)
    descriptor = clock.eventfd()
    scratch = np.zeros(3, dtype=np.int64)
    loop.wall(machine, MS, sync_ticks, early_ns, descriptor, histogram, scratch, begin_ns)
    calls = int.from_bytes(os.read(descriptor, 8), "little")
    os.close(descriptor)
    return histogram, calls


def test_every_tick_is_run_once_and_has_its_lateness_counted(machine):
    tick_data.warm_up(machine, "wall")
    begin_ns = time.monotonic_ns()
    histogram, calls = wall(machine, begin_ns)
    assert time.monotonic_ns() - begin_ns >= 500 * MS
    assert machine.control[TICK] == histogram.sum() == 500
    assert machine.control[DONE] == 1
    assert calls == 50 + 1  # the last call is the end of the loop
    assert machine.state.time[0] == pytest.approx(0.5)


def test_a_loop_that_wakes_early_begins_no_tick_early_and_sleeps_a_fifth_of_the_time(machine):
    tick_data.warm_up(machine, "wall")
    begin_ns = time.monotonic_ns()
    awake_begun_ns = time.thread_time_ns()
    # early by ten ticks: it would never sleep
    histogram, _ = wall(machine, begin_ns, early_ns=10 * MS)
    awake_ns = time.thread_time_ns() - awake_begun_ns
    assert machine.control[TICK] == histogram.sum() == 500
    assert time.monotonic_ns() - begin_ns >= 500 * MS
    # computing and waiting take at most 80 % of each tick; some more for waking and sleeping
    assert awake_ns < 0.9 * 500 * MS


def test_a_loop_that_is_behind_catches_up_and_counts_what_it_missed(machine):
    tick_data.warm_up(machine, "wall")
    begin_ns = time.monotonic_ns() - 60 * MS
    histogram, _ = wall(machine, begin_ns)
    # deadlines are absolute: the 500th tick still belongs 500 ms after the beginning
    assert time.monotonic_ns() - begin_ns >= 500 * MS
    assert machine.control[TICK] == 500
    assert 20 <= machine.control[MISSED] <= 500
    assert machine.control[WORST_NS] >= 59 * MS
    assert histogram[loop.BINS - 1 :].sum() >= 30  # ticks that are 20 ms late or more


def test_a_long_stall_starts_afresh_and_counts_every_tick_of_it(machine):
    tick_data.warm_up(machine, "wall")
    begin_ns = time.monotonic_ns() - 3000 * MS
    histogram, _ = wall(machine, begin_ns)
    assert 2990 <= machine.control[MISSED] <= 3500
    # a stall counts its ticks; any other tick that is late by a tick or more counts as one
    late_ticks = int(histogram[MS // 1000 :].sum())
    assert machine.control[MISSED] <= machine.control[STALLED_NS] // MS + late_ticks - 1
    assert (time.monotonic_ns() - begin_ns) / 1e9 >= 3.0 + 0.49


def test_a_flag_set_from_python_stops_the_loop(tmp_path):
    machine = built(tmp_path, 60)
    tick_data.warm_up(machine, "wall")
    thread = threading.Thread(target=wall, args=(machine, time.monotonic_ns()), daemon=True)
    thread.start()
    while machine.control[TICK] < 20:
        time.sleep(0.001)
    machine.control[STOP] = 1
    thread.join(60.0)
    assert not thread.is_alive()
    assert 20 <= machine.control[TICK] < 60_000


def test_the_loop_lets_python_run_in_parallel(machine):
    tick_data.warm_up(machine, "wall")
    thread = threading.Thread(target=wall, args=(machine, time.monotonic_ns()))
    thread.start()
    counted = 0
    while thread.is_alive():
        counted += 1
    assert counted > 10  # a loop that holds the GIL lets it count to 1
    assert machine.control[TICK] == 500


def test_warming_up_runs_no_tick_and_changes_nothing(machine):
    before = machine.buffer.copy()
    for pacing in bench.PACINGS:
        tick_data.warm_up(machine, pacing)
    assert machine.control[TICK] == machine.control[STOP] == machine.control[DONE] == 0
    assert before.tobytes() == machine.buffer.tobytes()
    assert machine.ring_header[rings.WRITTEN] == 0


def test_percentiles_are_the_upper_edges_of_their_bins():
    histogram = np.zeros(loop.BINS, dtype=np.int64)
    histogram[4] = 985
    histogram[9] = 10
    histogram[99] = 5
    found = loop.percentiles(histogram, 99_500)
    assert found == {"p50": 5.0, "p99": 10.0, "p999": 99.5, "max": 99.5}


def test_percentiles_agree_with_those_of_the_values_themselves():
    lateness_us = np.random.default_rng(5).gamma(2.0, 12.0, 50_000)
    histogram = np.bincount(lateness_us.astype(int), minlength=loop.BINS)
    found = loop.percentiles(histogram, round(lateness_us.max() * 1000))
    for name, share in (("p50", 50), ("p99", 99), ("p999", 99.9)):
        assert found[name] == pytest.approx(np.percentile(lateness_us, share), abs=1.01)


def test_no_ticks_have_no_lateness():
    assert loop.percentiles(np.zeros(loop.BINS, dtype=np.int64), 0) == {
        "p50": 0.0,
        "p99": 0.0,
        "p999": 0.0,
        "max": 0.0,
    }


def test_a_missing_core_is_refused_with_the_available_ones():
    refused = []
    thread = threading.Thread(target=lambda: refused.extend(loop.ask_for_priority(0, 1023)))
    thread.start()
    thread.join()
    (text,) = refused
    assert "core 1023" in text
    assert "loop.cpu" in text
    assert str(sorted(os.sched_getaffinity(0))[0]) in text


def test_without_a_requested_priority_or_core_nothing_changes():
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    assert loop.ask_for_priority(0, -1) == []
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before


def test_a_sample_has_the_worst_lateness_since_the_last_sample(machine):
    tick_data.warm_up(machine, "wall")
    wall(machine, time.monotonic_ns() - 15 * MS)
    rows = TABLE.rows_of_all(machine.ring_rows[: machine.ring_header[rings.WRITTEN]])
    late_us = rows[:, signals.column("tick_lateness")]
    # the first tick is due 1 ms after the beginning; the worst of all may come after the last row
    assert 14_000 <= late_us.max() <= machine.control[WORST_NS] / 1000.0 + 1e-3
    assert rows[-1, signals.column("ticks_missed")] <= machine.control[tick.MISSED]
