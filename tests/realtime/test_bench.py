"""Whole runs over the bus: the WSP prevents locks and shortens stops; runs repeat bit for bit."""

import json
import os
import signal
import time

import bench_process
import numpy as np
import pytest
from bench_process import BenchProcess, SimpleUnit

from rollerrig.configs.vehicle import COACH
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code

COLUMNS = signals.table(COACH).columns
CUT_OFF_M_S = 3.0


def channels(run):
    table = run.record.table
    return np.array([table[name].to_numpy() for name in COLUMNS])


def without_times(summary):
    """A summary without the entries that may differ: times, folder, and free ports."""
    comparable = dict(summary)
    for key in ("folder", "made", "started"):
        comparable.pop(key, None)
    with_ports = (Code.BUS_PLACE, Code.BUS_PORT)
    comparable["events"] = [event for event in summary["events"] if event["code"] not in with_ports]
    return comparable


# --- the main job ---


def test_with_wsp_on_soap_no_axle_locks_longer_than_0_4_s(stop_with_wsp):
    assert stop_with_wsp.status == 0, stop_with_wsp.stderr
    assert stop_with_wsp.result["stopped"]
    axles = stop_with_wsp.result["axles"]
    assert max(axle["longest_lock_s"] for axle in axles) <= 0.4
    assert sum(axle["vents"] for axle in axles) > 3


def test_without_wsp_on_leaves_every_wheelset_locks(stop_without_wsp):
    assert stop_without_wsp.status == 0, stop_without_wsp.stderr
    assert min(axle["longest_lock_s"] for axle in stop_without_wsp.result["axles"]) > 5.0
    assert stop_without_wsp.result["wsp"]["vents"] == 0


def test_with_wsp_the_stop_on_leaves_is_shorter_than_without(stop_on_leaves, stop_without_wsp):
    with_wsp = stop_on_leaves.result
    without = stop_without_wsp.result
    assert with_wsp["stopped"]
    assert without["stopped"]
    assert with_wsp["stop_distance_m"] < 0.95 * without["stop_distance_m"]
    assert with_wsp["stop_time_s"] < without["stop_time_s"]


def test_sliding_stays_moderate_with_wsp(stop_with_wsp):
    run = stop_with_wsp.record
    fast = run.column("vehicle_speed_m_s") > CUT_OFF_M_S
    for axle in "1234":
        assert run.column(f"sliding_{axle}_m_s")[fast].max() < 12.0
        assert run.column(f"wheel_speed_{axle}_rad_s")[fast].min() > 0.0


# --- the unit receives the speeds over the bus, and its magnets act ---


def test_the_record_has_speeds_magnets_and_heartbeats_of_every_cycle(stop_with_wsp):
    lines = (stop_with_wsp.out / "can.log").read_text().splitlines()
    assert len(lines) == stop_with_wsp.result["bus"]["frames"]
    cycles = stop_with_wsp.result["loop"]["ticks"] // 10
    for identifier in ("080#", "190#", "211#"):
        assert abs(count(identifier, lines) - cycles) <= 2
    assert count("720#", lines) >= cycles // 5
    assert stop_with_wsp.result["bus"]["dropped"] == 0


def count(frame, lines):
    """How many lines of a log have this frame."""
    return sum(f" {frame}" in line for line in lines)


def test_magnets_on_the_bus_reach_the_valves_after_their_dead_time(stop_with_wsp):
    run = stop_with_wsp.record
    for axle in "1234":
        magnets = run.column(f"magnets_{axle}")
        commanded = np.select([magnets >= 2, magnets == 1], [2.0, 1.0], 0.0)
        # a sample is taken every 10 ms, and the dead time is 40 ms
        np.testing.assert_array_equal(run.column(f"valve_{axle}")[4:], commanded[:-4])


def test_the_units_reference_speed_is_recorded_and_near_the_vehicles(stop_with_wsp):
    run = stop_with_wsp.record
    speed = run.column("vehicle_speed_m_s")
    reference = run.column("wsp_reference_speed_m_s")
    fast = (speed > 5.0) & (run.column("time_s") > 1.0)
    assert np.isfinite(reference[fast]).all()
    assert np.abs(reference - speed)[fast].mean() < 2.0


# --- runs repeat ---


def test_lockstep_with_the_wsp_in_a_separate_process_equals_free_bit_for_bit(
    stop_with_wsp, free_stop
):
    assert free_stop.status == 0, free_stop.stderr
    over_bus = channels(stop_with_wsp)
    in_tick = channels(free_stop)
    assert over_bus.shape == in_tick.shape

    different = []
    for name, one, other in zip(COLUMNS, over_bus, in_tick, strict=True):
        if one.tobytes() != other.tobytes():
            different.append(name)
    assert different == []


@pytest.mark.nightly
def test_two_lockstep_runs_give_the_same_summary_channels_and_bus_log(folders):
    arguments = ("--pacing", "lockstep", "--set", "duration_max_s=5")
    first = bench_process.run(folders / "again0", *arguments)
    second = bench_process.run(folders / "again1", *arguments)
    # they do not stop in that time
    assert first.status == 4
    assert second.status == 4

    first_summary = json.loads((first.out / "summary.json").read_text())
    second_summary = json.loads((second.out / "summary.json").read_text())
    assert without_times(first_summary) == without_times(second_summary)
    assert channels(first).tobytes() == channels(second).tobytes()
    assert (first.out / "can.log").read_bytes() == (second.out / "can.log").read_bytes()


def test_the_resolved_scenario_repeats_the_run(stop_without_wsp, folders):
    resolved = str(stop_without_wsp.out / "scenario.toml")
    words = ("--pacing", "free", "--wsp", "none")
    again = bench_process.run(folders / "repeated", *words, scenario=resolved)
    assert again.result["config_hash"] == stop_without_wsp.result["config_hash"]
    assert channels(again).tobytes() == channels(stop_without_wsp).tobytes()


def test_the_printed_summary_is_the_recorded_one(stop_with_wsp):
    printed = dict(stop_with_wsp.result)
    assert printed.pop("folder") == str(stop_with_wsp.out)
    assert printed == records.summary(stop_with_wsp.out)


# --- an outside unit ---


def test_an_external_unit_drives_a_stop_in_lockstep(tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "lockstep",
        "--wsp",
        "external",
        "--set",
        "initial_speed_m_s=4",
    )

    def vent_axle_1_for_50_cycles(n):
        return [(bench_process.MAGNETS, b"\x03" if n < 50 else b"\0")]

    unit = SimpleUnit(bench.address(), vent_axle_1_for_50_cycles)
    bench.finish()
    unit.close()
    assert bench.status == 0, bench.stderr
    assert bench.result["stopped"]
    run = bench.record
    vented = run.column("valve_1") == 2.0
    assert 0.4 < run.column("time_s")[vented].max() < 0.6
    assert not run.column("valve_2").any()
    assert len(unit.speeds) >= unit.syncs - 1
    # 0.01 rad/s a count, four axles
    first_count = int.from_bytes(unit.speeds[0][:2], "little")
    assert first_count == round(4.0 / 0.445 / 0.01)


# --- real time ---


def test_wall_pacing_keeps_real_time(wall_run):
    assert wall_run.status == 4, wall_run.stderr
    assert wall_run.result["ended"] == "finished"
    loop = wall_run.result["loop"]
    assert loop["ticks"] == 4000
    late = loop["lateness_us"]
    assert 0.0 < late["p50"] <= late["p99"] <= late["p999"] <= late["max"]


def times_s(run, frame):
    """The times of a frame on the bus, from the log."""
    lines = (run.out / "can.log").read_text().splitlines()
    return np.array([float(line[1:18]) for line in lines if f" {frame}" in line])


def test_syncs_keep_their_period_in_wall_pacing(wall_run):
    # deadlines are absolute: they do not drift, even if ticks are late or missed on a busy machine
    at_s = times_s(wall_run, "080#")
    assert np.median(np.diff(at_s)) == pytest.approx(0.01, rel=0.05)
    assert at_s[-1] - wall_run.result["loop"]["stalled_s"] == pytest.approx(4.0, abs=0.1)


def test_the_unit_is_lost_only_where_its_heartbeat_is_missing_on_the_bus(stop_with_wsp, wall_run):
    losses = (Code.UNIT_LOST, Code.NODE_LOST, Code.HEARTBEAT_LOST)
    assert [event for event in stop_with_wsp.result["events"] if event["code"] in losses] == []
    beats_s = times_s(wall_run, "720#")
    assert len(beats_s) >= 20
    for event in wall_run.result["events"]:
        if event["code"] in losses:
            silent_s = longest_gap_s(beats_s, event["time_s"])
            stalled_s = longest_gap_s(times_s(wall_run, "080#"), event["time_s"])
            # the heartbeat time is 100 ms, and 200 ms are allowed; or the bench itself was stopped
            assert silent_s > 0.15 or stalled_s > 0.05, event


def longest_gap_s(times, before_s):
    """The longest gap between the last 30 frames before a time, or from the last one to it."""
    return np.diff(times[times < before_s][-30:], append=before_s).max()


def test_a_stall_is_counted_as_missed_ticks_and_strict_reports_it(tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "wall",
        "--strict",
        "--wsp",
        "none",
        "--set",
        "initial_speed_m_s=2",
        scenario="dry_stop",
    )
    bench.runs_for(0.5)
    os.kill(bench.process.pid, signal.SIGSTOP)
    time.sleep(0.4)
    os.kill(bench.process.pid, signal.SIGCONT)
    bench.finish()
    assert bench.status == 3, bench.stderr
    assert bench.result["valid"] is True
    assert bench.result["loop"]["ticks"] == pytest.approx(
        1000 * bench.record.column("time_s")[-1], abs=10
    )
    assert bench.result["loop"]["missed"] >= 350
    assert bench.result["loop"]["lateness_us"]["max"] >= 350_000
    assert bench.record.column("ticks_missed")[-1] >= 350

    # the record has two clocks; events report their difference, and from which time on it exists
    stalls = [event for event in bench.result["events"] if event["code"] == Code.LOOP_STALLED]
    apart_s = bench.result["loop"]["stalled_s"]
    reported_s = sum(event["fields"]["stalled_s"] for event in stalls)
    assert apart_s == pytest.approx(reported_s, abs=0.002 * len(stalls))
    assert stalls[-1]["fields"]["ahead_s"] == pytest.approx(apart_s, abs=0.002)
    assert apart_s > 0.3
    assert {event["level"] for event in stalls} == {"warning"}
    syncs_s = times_s(bench, "080#")
    first = stalls[0]["time_s"]
    assert syncs_s[syncs_s < first].size == pytest.approx(first / 0.01, abs=30)
    assert syncs_s[-1] - apart_s == pytest.approx(bench.record.column("time_s")[-1], abs=0.15)
