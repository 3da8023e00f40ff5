"""`rollerrig bench` and `rollerrig devices`: short real runs, and how benchmarks judge."""

import argparse
import json
import subprocess
from typing import Any, NamedTuple

import cantools
import numpy as np
import pytest
from benchmarks import contact, hunting
from paper import table8

from rollerrig.configs.processes import children
from rollerrig.configs.vehicle import COACH
from rollerrig.realtime import cli
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import bus, client, figures, older_checkout, references
from rollerrig.realtime.benchmarks import loop as loop_benchmark
from rollerrig.realtime.commands import bench, clone
from rollerrig.realtime.loop import loop
from rollerrig.rig import params
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.multibody import coach, coach_state
from rollerrig.rig.multibody.coordinates import BEFORE_WHEELSETS, PER_BODY, PITCH
from rollerrig.wsp_interface import signals

# what cyclictest prints: a histogram of latencies in us and their statistics
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
    """Return the punctuality of a program that is equally late in every tick."""
    histogram = np.zeros(loop.BINS, dtype=np.int64)
    histogram[lateness_us] = ticks
    program = loop_benchmark.Punctuality()
    program.add(histogram, 1000 * lateness_us, missed)
    return program


# -- devices


def test_devices_writes_an_eds_of_every_node_one_dbc_and_the_tables(tmp_path, capsys):
    assert cli.main(["devices", "--out", str(tmp_path / "new" / "devices"), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    names = set(printed["files"])

    descriptions = [name for name in names if name.endswith(".eds")]
    for node in (*signals.table(COACH).drive_nodes, signals.SPEED_NODE, signals.BRAKE_NODE):
        assert any(name.startswith(f"node_{node:03d}") for name in descriptions)
    assert {"rig.dbc", "signals.md", "objects.csv"} < names

    database = cantools.database.load_file(f"{printed['folder']}/rig.dbc")
    assert database.get_message_by_frame_id(0x180 + signals.SPEED_NODE).length == 8
    assert all((tmp_path / "new" / "devices" / name).stat().st_size for name in names)


def test_devices_reports_where_it_cannot_write(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert cli.main(["devices", "--out", str(tmp_path / "file" / "devices")]) == 2
    assert "--out" in capsys.readouterr().err


# -- judging


def test_a_target_is_met_up_to_its_limit_and_not_beyond_or_unknown():
    assert figures.target("t", 1.5, 1.5)["met"]
    assert not figures.target("t", 1.6, 1.5)["met"]
    assert not figures.target("t", None, 1.5)["met"]


def test_quantiles_of_a_thousand_values():
    assert figures.quantiles(range(1000)) == {
        "p50": 500.0,
        "p99": 990.0,
        "p999": 999.0,
        "max": 999.0,
    }
    assert figures.quantiles([]) == {}


def test_the_output_of_cyclictest_is_read_with_its_latencies_beyond_the_histogram():
    histogram, worst_ns, missed_deadlines = references.parse(PRINTED, 1000)
    assert histogram.sum() == 1000
    assert histogram[12] == 900
    assert worst_ns == 25_000_000
    # nine latencies of 1.2 ms cost a deadline each, and one beyond the last bin (20 ms) costs 19
    assert missed_deadlines == 9 * 1 + 19


# what rtla timerlat hist prints: for each core a column of interrupts and one of threads
TRACED = """# RTLA timerlat histogram
# Time unit is microseconds (us)
# Duration:   0 00:00:01
Index   IRQ-000   Thr-000   IRQ-001   Thr-001
0           990         0       980         0
5             9       700        18       950
1200          0       299         0        40
over:         1         1         2        10
count:     1000      1000      1000      1000
min:          0         5         0         5
avg:          0       300         0       200
max:      11000     12000     13000     25000
"""


def test_of_rtla_timerlat_the_latencies_of_its_threads_on_all_cores_are_read():
    histogram, worst_ns, missed_deadlines = references.parse_timerlat(TRACED, 1000)
    assert histogram.sum() == 2000
    assert histogram[5] == 1650
    assert worst_ns == 25_000_000
    assert missed_deadlines == 339 * 1 + 11 * 19


def test_only_ticks_that_the_loop_slept_for_are_compared():
    # the second tick is 2.5 ms late, the next two begin late because of it
    lateness_us = np.array([10.0, 2500.0, 1550.0, 600.0, 15.0])
    duration_us = np.full(5, 50.0)
    wakes_us = loop_benchmark.wakes(lateness_us, duration_us, 1000.0)
    assert wakes_us.tolist() == [10.0, 2500.0, 15.0]


def test_a_loop_as_punctual_as_cyclictest_meets_its_targets():
    result = loop_benchmark.compared(punctual(20, 20000), punctual(20, 15000))
    assert all(target["met"] for target in result["targets"])


def test_a_loop_that_is_later_than_cyclictest_misses_its_targets():
    result = loop_benchmark.compared(punctual(30, 20000), punctual(20, 15000))
    assert [target["met"] for target in result["targets"]] == [False, False, True]


def test_missed_ticks_count_against_the_loop_unless_cyclictest_missed_as_many():
    alone = loop_benchmark.compared(punctual(20, 20000, 5), punctual(20, 20000, 0))
    both = loop_benchmark.compared(punctual(20, 20000, 5), punctual(20, 20000, 5))
    assert alone["targets"][-1]["met"] is False
    assert both["targets"][-1]["met"] is True


def test_without_cyclictest_the_loop_reports_how_to_install_it():
    result = loop_benchmark.compared(punctual(20, 20000), None)
    assert result["ratio"] is None
    assert "rt-tests" in result["notes"][0]


def test_a_burst_lasts_from_sync_to_the_last_tpdo_and_not_to_a_unit_s_answer():
    sync = client.SYNC
    speeds = client.SPEEDS
    frames = [
        (100, sync, ""),
        (150, 0x181, ""),
        (190, speeds, ""),
        (900, client.MAGNETS, "00"),
        (1100, sync, ""),
        (1130, speeds, ""),
        (2100, sync, ""),
    ]
    assert bus.bursts(frames) == [90, 30]


# -- short real runs


@pytest.mark.nightly
def test_bench_contact_times_every_law(capsys, monkeypatch):
    monkeypatch.setattr(contact, "_CALLS", 20_000)
    monkeypatch.setattr(table8, "_ROUNDS", 2)
    monkeypatch.setattr(table8, "END_M_S", 38.0)
    assert cli.main(["bench", "contact", "--json"]) == 0
    contacts = json.loads(capsys.readouterr().out)["contact"]["contacts"]
    assert contacts["polach"]["ratio"] == 1.0
    for law in contacts.values():
        assert law["time_ns"] > 1.0


@pytest.mark.nightly
def test_bench_loop_measures_a_real_run(capsys):
    assert cli.main(["bench", "loop", "--seconds", "1", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["loop"]["loop"]
    assert 0 < result["samples"] <= 1000
    assert result["lateness_us"]["max"] >= result["lateness_us"]["p99"] > 0.0


@pytest.mark.nightly
def test_bench_bus_follows_the_magnets_from_the_frame_to_the_tick():
    # on a busy machine the client needs up to 2 s to join
    valve, timing = bus.to_valve(4.0)

    assert valve["switches"] > 10
    assert 0.0 < valve["from_command_us"]["p50"] <= valve["from_tpdo_us"]["p50"]
    assert timing["last_tpdo_us"]["p50"] > timing["last_tpdo_hub_us"]["p50"] > 0.0


def test_bench_bus_measures_round_trips_of_the_echo_and_of_a_node():
    trips = bus.round_trips(3.0)
    assert trips["ratio"] > 0.0
    assert trips["sdo_us"]["p50"] > 0.0


@pytest.mark.parametrize(
    "wrong", [["bench"], ["bench", "nothing"], ["bench", "loop", "--seconds", "0"]]
)
def test_a_wrong_benchmark_is_refused_with_status_2(wrong, capsys):
    try:
        status = cli.main(wrong)
    except SystemExit as request:
        status = request.code
    assert status == 2
    assert capsys.readouterr().err


# -- the coach

# the rotation speeds of the wheelsets among the velocities of the coach
WHEELSET_ROTATIONS = slice(BEFORE_WHEELSETS + PITCH, None, PER_BODY)


class RecordedStop(NamedTuple):
    """A stop of the coach, and what is needed to repeat its steps with each contact model."""

    stop: table8.Recorded
    law: Any  # the parameters of the adhesion law
    coaches: dict[str, Any]  # the coach with each contact model, by the name of the model


@pytest.fixture(scope="module")
def recorded_stop():
    """A sliding stop of the coach, recorded in four pieces."""
    plan = scenario.load("velim_a1", settings=("rig=plain_track",))
    sections = params.check(plan.resolved, "velim_a1")
    law = params.law_of(sections["adhesion"])
    coaches = {name: coach.build(sections, np.inf, model, 10) for name, model in MODELS.items()}
    stop = table8.recorded(coaches["degraded"], law, 4)
    return RecordedStop(stop, law, coaches)


@pytest.mark.nightly
def test_every_model_of_table_8_meets_the_same_states_of_one_sliding_stop(recorded_stop):
    stop, law, coaches = recorded_stop
    assert stop.memory.shape == (4, coach_state.SIZE)

    first_v = stop.v[0, 0]
    last_v = stop.v[-1, -1]
    first_speed_m_s = first_v[0]
    last_speed_m_s = last_v[0]
    assert last_speed_m_s < first_speed_m_s - 0.5

    # some wheelset slides
    wheel_radius_m = 0.445
    rim_speeds_m_s = wheel_radius_m * np.abs(last_v[WHEELSET_ROTATIONS])
    assert (last_speed_m_s - rim_speeds_m_s > 1.0).any()

    states = {}
    for name, model in coaches.items():
        buffer = np.empty(coach_state.SIZE)
        table8.seconds(table8.CONTACT, model, law, 3, stop, buffer)
        states[name] = coach_state.views(buffer)

    polach = states["polach"]
    for name, state in states.items():
        np.testing.assert_array_equal(state.v, stop.v[3, -1], err_msg=name)
        np.testing.assert_array_equal(state.contacts, polach.contacts, err_msg=name)
        if name != "polach":
            assert (state.wheelset_forces != polach.wheelset_forces).any()


@pytest.mark.nightly
def test_the_vehicle_of_table_8_is_the_step_without_its_contacts(recorded_stop):
    stop, law, coaches = recorded_stop
    model = coaches["degraded"]
    whole, vehicle = np.empty((2, coach_state.SIZE))
    table8.seconds(table8.WHOLE, model, law, 2, stop, whole)
    first_step = stop._replace(q=stop.q[:, :1], v=stop.v[:, :1])
    table8.seconds(table8.WHOLE, model, law, 2, first_step, whole)

    # with the contact forces of this state, the step of the vehicle alone gives the same velocities
    with_contacts = first_step._replace(memory=stop.memory.copy())
    state = coach_state.views(with_contacts.memory[2])
    after = coach_state.views(whole)
    state.wheelset_forces[:] = after.wheelset_forces
    state.Gx[:] = after.Gx
    state.Gy[:] = after.Gy
    table8.seconds(table8.VEHICLE, model, law, 2, with_contacts, vehicle)

    moved = coach_state.views(vehicle)
    np.testing.assert_allclose(moved.v, after.v, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(moved.contacts, coach_state.views(stop.memory[2]).contacts)


@pytest.mark.parametrize(("scatter_us", "met"), [(0.001, True), (0.2, False)])
def test_a_target_of_table_8_is_met_only_beyond_its_spread_which_is_printed(scatter_us, met):
    rng = np.random.default_rng(8)
    vehicle_us = 2.0
    whole_us = {"johnson_vermeulen": 4.3, "fastsim": 17.0, "polach": 4.4, "degraded": 4.5}

    def rounds(cost_us):
        return cost_us + scatter_us * rng.standard_normal(15)

    timed = {("polach", table8.VEHICLE): rounds(vehicle_us)}
    for row in table8.ROWS:
        timed[row.model, table8.WHOLE] = rounds(whole_us[row.model])
        timed[row.model, table8.CONTACT] = rounds(whole_us[row.model] - vehicle_us)

    result = table8.judged(timed, 50.0)

    assert result["recovery_percent_of_whole"] == pytest.approx(
        100 * 0.1 / 4.4, abs=60 * scatter_us + 0.1
    )
    assert result["targets"][0]["met"] is met
    assert "+-" in figures.lines(result)[0]
    models = result["models"]
    assert models["degraded"]["vehicle_s"] == models["fastsim"]["vehicle_s"]
    assert models["degraded"]["vehicle_s"] == pytest.approx(1.0, abs=scatter_us)


def test_table_8_has_the_papers_figures():
    for row in table8.ROWS:
        assert row.model in MODELS
        assert 300.0 < row.whole_s < 450.0
    assert table8.ROWS[-2].whole_s == 360.0
    assert table8.ROWS[-1].whole_s == 362.0


@pytest.mark.nightly
def test_the_sweep_for_hunting_prints_the_critical_speed(monkeypatch):
    monkeypatch.setattr(hunting, "SPEEDS_M_S", (30.0, 60.0, 90.0))
    arguments = argparse.Namespace(set=["multibody.laying=0.025"])
    progress = []
    result = hunting.run(arguments, progress.append)

    critical_m_s = result["critical_speed_m_s"]["soap"]
    assert 20.0 < critical_m_s < 90.0
    assert any(f"hunting from {critical_m_s:.1f} m/s" in note for note in result["notes"])
    assert len(progress) == 6
    assert hunting.table(result).row_count == 3


# -- commands that need a clone


@pytest.mark.parametrize(
    "words",
    [
        ("bench", "contact"),
        ("bench", "soak"),
        ("score", "sets", "answers.json"),
        ("tune", "velim"),
        ("validate", "velim"),
        ("validate", "sanding"),
    ],
    ids=" ".join,
)
def test_a_command_that_needs_a_clone_reports_how_to_get_one(words, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(clone, "TESTS", tmp_path / "tests")
    assert cli.main(list(words)) == cli.USAGE
    error = capsys.readouterr().err
    assert "the installed package does not have" in error
    assert "clone the repository" in error


def test_the_help_of_bench_marks_which_benchmarks_need_a_clone(capsys):
    with pytest.raises(SystemExit):
        cli.main(["bench", "--help"])
    printed = capsys.readouterr().out
    marked = {name for name in bench.BENCHMARKS if f"\n* {name} " in printed}
    assert set(bench.BENCHMARKS) - marked == {
        "loop",
        "bus",
        "vehicle",
        "train",
        "start",
        "campaign",
        "million",
        "merge",
        "evidence",
    }


@pytest.mark.parametrize("name", bench.BENCHMARKS)
def test_the_row_of_every_benchmark_has_the_place_of_its_module(name):
    module = bench._module(name)
    assert callable(module.run)
    assert callable(module.table)


# --- an older checkout ---


@pytest.mark.parametrize("name", ["rollerrig", "rollerrig-old"])
def test_a_checkout_of_any_name_is_imported_as_rollerrig_from_a_place_that_stays(
    name, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    checkout = tmp_path / name
    checkout.mkdir()
    (checkout / "__init__.py").write_text("")
    place = older_checkout.import_folder(checkout)
    assert older_checkout.import_folder(checkout) == place
    program = (
        "import os, sys; sys.path.insert(0, sys.argv[1]); import rollerrig; "
        "print(os.path.realpath(rollerrig.__file__))"
    )
    printed = subprocess.run(
        [children.interpreter(), "-P", "-c", program, str(place)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert printed.stdout.strip() == str((checkout / "__init__.py").resolve())


def test_beside_a_folder_that_is_no_checkout_is_refused_before_any_stop(tmp_path, capsys):
    assert cli.main(["bench", "campaign", "--beside", str(tmp_path)]) == 2
    assert (
        f"--beside {tmp_path}: there is no realtime/campaign/campaign.py" in capsys.readouterr().err
    )
