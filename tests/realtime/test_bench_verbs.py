"""`rollerrig bench` and `rollerrig devices`: short runs of the real thing, and how they judge."""

import argparse
import json

import cantools
import numpy as np
import pytest

from rollerrig.realtime import cli
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import bus, client, figures, hunting, table8
from rollerrig.realtime.benchmarks import loop as loop_benchmark
from rollerrig.realtime.benchmarks.figures import Target
from rollerrig.realtime.loop import loop
from rollerrig.rig import params
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.multibody import coach
from rollerrig.wsp_interface import signals

PRINTED = """# /dev/cpu_dma_latency set to 0us
# Histogram
000000 000000
000012 000900
000030 000090
001200 000009
# Total: 000000999
# Min Latencies: 00012
# Avg Latencies: 00016
# Max Latencies: 25000
# Histogram Overflows: 00001
"""


def punctual(lateness_us, ticks, missed=0):
    found = loop_benchmark.Punctuality()
    histogram = np.zeros(loop.BINS, dtype=np.int64)
    histogram[lateness_us] = ticks
    found.add(histogram, 1000 * lateness_us, missed)
    return found


# -- devices

def test_devices_writes_an_eds_of_every_node_one_dbc_and_the_tables(tmp_path, capsys):
    assert cli.main(["devices", "--out", str(tmp_path / "new" / "devices"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    names = set(told["files"])
    nodes = (*signals.DRIVE_NODES, signals.SPEED_NODE, signals.BRAKE_NODE)
    for node in nodes:
        assert any(name.startswith(f"node_{node:03d}") and name.endswith(".eds") for name in names)
    assert {"rig.dbc", "signals.md"} < names
    database = cantools.database.load_file(f"{told['folder']}/rig.dbc")
    assert database.get_message_by_frame_id(0x180 + signals.SPEED_NODE).length == 8
    assert all((tmp_path / "new" / "devices" / name).stat().st_size for name in names)


def test_devices_says_where_it_cannot_write(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert cli.main(["devices", "--out", str(tmp_path / "file" / "devices")]) == 2
    assert "--out" in capsys.readouterr().err


# -- judging

def test_a_target_is_met_up_to_its_limit_and_not_beyond_or_unknown():
    assert Target("t", 1.5, 1.5).met
    assert not Target("t", 1.6, 1.5).met
    assert not Target("t", None, 1.5).met


def test_quantiles_of_a_thousand_values():
    assert figures.quantiles(range(1000)) == {"p50": 500.0, "p99": 990.0, "p999": 999.0,
                                              "max": 999.0}
    assert figures.quantiles([]) == {}


def test_the_output_of_cyclictest_is_read_with_what_lies_beyond_the_histogram():
    histogram, worst_ns, late = loop_benchmark.parse(PRINTED, 1000)
    assert histogram.sum() == 1000
    assert histogram[12] == 900
    assert worst_ns == 25_000_000
    assert late == 9 * 1 + 19  # of 1.2 ms each one, and of what lies beyond the last bin's 20 ms


def test_only_ticks_that_the_loop_slept_for_are_compared():
    # the second tick is 2.5 ms late, the next two begin late because of it
    lateness, duration = np.array([10.0, 2500.0, 1550.0, 600.0, 15.0]), np.full(5, 50.0)
    assert loop_benchmark.wakes(lateness, duration, 1000.0).tolist() == [10.0, 2500.0, 15.0]


def test_a_loop_as_punctual_as_cyclictest_meets_its_targets():
    found = loop_benchmark.compared(punctual(20, 20000), punctual(20, 15000))
    assert all(one["met"] for one in found["targets"])


def test_a_loop_that_is_later_than_cyclictest_does_not():
    found = loop_benchmark.compared(punctual(30, 20000), punctual(20, 15000))
    assert [one["met"] for one in found["targets"]] == [False, False, True]


def test_missed_ticks_count_against_the_loop_unless_cyclictest_missed_as_many():
    alone = loop_benchmark.compared(punctual(20, 20000, 5), punctual(20, 20000, 0))
    both = loop_benchmark.compared(punctual(20, 20000, 5), punctual(20, 20000, 5))
    assert alone["targets"][-1]["met"] is False
    assert both["targets"][-1]["met"] is True


def test_without_cyclictest_the_loop_says_how_to_install_it():
    found = loop_benchmark.compared(punctual(20, 20000), None)
    assert found["ratio"] is None
    assert "rt-tests" in found["notes"][0]


def test_a_burst_lasts_from_sync_to_the_last_tpdo_and_not_to_a_unit_s_answer():
    sync, speeds = client.SYNC, client.SPEEDS
    frames = [(100, sync, ""), (150, 0x181, ""), (190, speeds, ""), (900, client.MAGNETS, "00"),
              (1100, sync, ""), (1130, speeds, ""), (2100, sync, "")]
    assert bus.bursts(frames) == [90, 30]


# -- the real thing, short

def test_bench_contact_times_every_law(capsys):
    assert cli.main(["bench", "contact", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["contact"]["contacts"]
    assert told["polach"]["ratio"] == 1.0
    assert all(one["time_ns"] > 1.0 for one in told.values())


def test_bench_loop_measures_a_real_run(capsys):
    assert cli.main(["bench", "loop", "--seconds", "1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["loop"]
    assert 0 < told["loop"]["samples"] <= 1000
    assert told["loop"]["lateness_us"]["max"] >= told["loop"]["lateness_us"]["p99"] > 0.0


def test_bench_bus_follows_the_magnets_from_the_frame_to_the_tick():
    valve, timing = bus.to_valve(1.5)
    assert valve["switches"] > 10
    assert 0.0 < valve["from_command_us"]["p50"] <= valve["from_tpdo_us"]["p50"]
    assert timing["last_tpdo_us"]["p50"] > timing["last_tpdo_hub_us"]["p50"] > 0.0


def test_bench_bus_asks_the_echo_and_a_node():
    trips = bus.round_trips(3.0)
    assert trips["ratio"] > 0.0
    assert trips["sdo_us"]["p50"] > 0.0


@pytest.mark.parametrize("wrong", [["bench"], ["bench", "nothing"], ["bench", "loop", "--seconds",
                                                                     "0"]])
def test_a_wrong_benchmark_is_refused_with_status_2(wrong, capsys):
    try:
        status = cli.main(wrong)
    except SystemExit as left:
        status = left.code
    assert status == 2
    assert capsys.readouterr().err


# -- the coach

def test_contacts_found_twice_do_not_change_how_the_coach_brakes():
    sections = params.check(scenario.load("velim_a1", settings=("rig=plain_track",)).resolved, "velim_a1")
    law = params.Law(**{name: sections["adhesion"][name] for name in params.Law._fields})
    one = coach.build(sections, np.inf, MODELS["degraded"], 10)
    once, twice = (table8._seconds(one, law, twice, 4000)[1] for twice in (False, True))
    assert once == twice < table8.SPEED_M_S


def test_table_8_stands_beside_the_papers_figures():
    for row in table8.ROWS:
        assert row.model in MODELS
        assert 300.0 < row.vehicle_s + row.contact_s < 450.0
    assert [row.vehicle_s + row.contact_s for row in table8.ROWS][-2:] == [360.0, 362.0]


def test_the_sweep_for_hunting_prints_the_critical_speed(monkeypatch):
    monkeypatch.setattr(hunting, "SPEEDS_M_S", (30.0, 60.0, 90.0))
    given = argparse.Namespace(set=["multibody.laying=0.025"])
    said = []
    result = hunting.run(given, said.append)
    critical = result["critical_speed_m_s"]["soap"]
    assert 20.0 < critical < 90.0
    assert any(f"hunting from {critical:.1f} m/s" in note for note in result["notes"])
    assert len(said) == 6
    assert hunting.table(result).row_count == 3
