"""The summary of a run from its channels."""

import json

import numpy as np
import pyarrow as pa
import pytest
import synthetic_stop
from rich.console import Console

from rollerrig.realtime.record import summary
from rollerrig.realtime.record.figures import BY_NAME, FIGURES
from rollerrig.wsp_interface.signals import COLUMNS

SCENARIO = {"title": "a stop", "loop": {"tick_hz": 1000, "step_s": 1e-4, "record_hz": 100}}
COUNTERS = {
    "version": "9.9",
    "config_hash": "abc",
    "scenario": "velim_a1",
    "pacing": "lockstep",
    "seed": 4,
    "unit": "reference",
    "loop": {
        "ticks": 33000,
        "missed": 0,
        "lateness_us": {"p50": 5.0, "p99": 9.0, "p999": 11.0, "max": 30.0},
    },
    "bus": {"frames": 66000, "dropped": 0, "load_percent": 38.0},
    "modbus": {"requests": 12},
}


@pytest.fixture(scope="module")
def stop():
    """Channels of a stop in which axle 1 locks."""
    rows = synthetic_stop.stop(speed_m_s=30.0, lock_axle=1)
    return dict(zip(COLUMNS, rows.T, strict=True))


def braked(seconds=10.0, hz=100, standing_s=2.0):
    """Channels of a vehicle that brakes evenly from 20 m/s and then stands."""
    time_s = np.arange(round((seconds + standing_s) * hz) + 1) / hz
    speed = np.maximum(20.0 * (1 - time_s / seconds), 0.0)
    moving = speed > 0
    columns = {name: np.zeros_like(time_s) for name in COLUMNS}
    columns |= {
        "time_s": time_s + 3.0,
        "vehicle_speed_m_s": speed,
        "sliding_2_m_s": 2.0 * moving,
        "position_m": 50.0 + np.cumsum(speed) / hz,
        "adhesion_3": 0.1 * moving,
        "sliding_work_2_J": 7.0 + 100.0 * np.minimum(time_s, seconds),
        "valve_4": np.where((time_s >= 1.0) & (time_s < 3.5), 1.0, 0.0),
        "vents_4": np.minimum(np.floor(time_s), 5.0),
        "air_consumption_NL": 2.0 * time_s,
    }
    return columns


def test_the_keys_that_others_rely_on_are_there(stop):
    found = summary.of(stop, COUNTERS, SCENARIO)
    assert {
        "version",
        "config_hash",
        "scenario",
        "pacing",
        "seed",
        "tick_hz",
        "step_s",
        "initial_speed_m_s",
        "stop_time_s",
        "stop_distance_m",
        "stopped",
        "axles",
        "wsp",
        "air_consumption_NL",
        "loop",
        "bus",
        "modbus",
    } <= set(found)
    assert [set(axle) for axle in found["axles"]] == [
        {
            "sliding_mean_m_s",
            "sliding_std_m_s",
            "sliding_max_m_s",
            "longest_lock_s",
            "dissipated_energy_J",
            "adhesion_mean",
            "vents",
            "wheel_flat_m",
        }
    ] * 4
    assert set(found["wsp"]) == {"unit", "active_s", "vents"}
    assert found["loop"] == COUNTERS["loop"]
    assert found["bus"] == COUNTERS["bus"]
    assert found["modbus"] == {"requests": 12}
    assert (found["scenario"], found["seed"], found["tick_hz"]) == ("velim_a1", 4, 1000)


def test_the_stop_lasts_from_the_first_sample_to_standstill():
    found = summary.of(braked(), COUNTERS, SCENARIO)
    assert found["stopped"] is True
    assert found["initial_speed_m_s"] == 20.0
    assert found["stop_time_s"] == pytest.approx(10.0, abs=0.011)
    assert found["stop_distance_m"] == pytest.approx(100.0, rel=0.01)
    assert found["duration_s"] == pytest.approx(12.0)


def test_standing_still_afterwards_changes_no_mean():
    short, long = (summary.of(braked(standing_s=s), COUNTERS, SCENARIO) for s in (0.5, 20.0))
    assert short["axles"] == long["axles"]
    assert short["axles"][1]["sliding_mean_m_s"] == pytest.approx(2.0, rel=0.01)
    assert short["axles"][2]["adhesion_mean"] == pytest.approx(0.1, rel=0.01)


def test_energy_is_what_was_dissipated_within_the_stop():
    assert summary.of(braked(), COUNTERS, SCENARIO)["axles"][1]["dissipated_energy_J"] == (
        pytest.approx(1000.0, abs=2.0)
    )


def test_the_wsp_is_active_while_any_valve_does_not_fill():
    found = summary.of(braked(), COUNTERS, SCENARIO)["wsp"]
    assert found == {"unit": "reference", "active_s": pytest.approx(2.5), "vents": 5}


def test_a_vehicle_that_still_moves_has_not_stopped():
    columns = {name: values[:500] for name, values in braked().items()}
    found = summary.of(columns, COUNTERS, SCENARIO)
    assert (found["stopped"], found["stop_time_s"], found["stop_distance_m"]) == (False, None, None)
    assert found["axles"][1]["sliding_mean_m_s"] == pytest.approx(2.0)


def test_a_vehicle_that_never_moved_has_not_stopped():
    columns = {name: np.zeros(5) for name in COLUMNS} | {"time_s": np.arange(5) / 100.0}
    assert summary.of(columns, COUNTERS, SCENARIO)["stopped"] is False


def test_a_run_without_a_sample_has_a_summary():
    found = summary.of({name: np.empty(0) for name in COLUMNS}, {}, {})
    assert (found["stopped"], found["samples"], found["initial_speed_m_s"]) == (False, 0, None)
    assert found["axles"][0]["sliding_mean_m_s"] is None


def test_channels_that_were_not_recorded_give_null():
    columns = {name: values for name, values in braked().items() if "sliding" not in name}
    axle = summary.of(columns, COUNTERS, SCENARIO)["axles"][1]
    assert (axle["sliding_max_m_s"], axle["dissipated_energy_J"]) == (None, None)


def test_a_table_and_arrays_give_the_same_summary_again_and_again(stop):
    table = pa.table({name: pa.array(values) for name, values in stop.items()})
    first = json.dumps(summary.of(stop, COUNTERS, SCENARIO))
    assert json.dumps(summary.of(table, COUNTERS, SCENARIO)) == first
    assert json.dumps(summary.of(stop, COUNTERS, SCENARIO)) == first
    assert "NaN" not in first


def test_what_a_killed_bench_could_not_count_comes_from_the_samples():
    columns = braked()
    columns["ticks_missed"], columns["tick_lateness_us"] = np.full((2, 1201), [[3.0], [80.0]])
    loop = summary.of(columns, {}, SCENARIO)["loop"]
    assert (loop["ticks"], loop["missed"], loop["lateness_us"]["max"]) == (15000, 3, 80.0)
    assert loop["lateness_us"]["p50"] is None


def test_every_figure_of_a_stop_is_read_from_its_summary(stop):
    found = summary.of(stop, COUNTERS, SCENARIO)
    axles = found["axles"]
    values = {figure.name: figure.of(found) for figure in FIGURES}
    # this stop has no motors that hold a speed
    assert {name for name, value in values.items() if value is None} == {
        "tracking_max_m_s",
        "tracking_rms_m_s",
    }
    assert values["stop_distance_m"] == found["stop_distance_m"]
    assert values["longest_lock_s"] == axles[0]["longest_lock_s"] > 0.0
    assert values["dissipated_energy_J"] == pytest.approx(
        sum(axle["dissipated_energy_J"] for axle in axles)
    )
    assert BY_NAME["dissipated_energy_J"].shown(found) == pytest.approx(
        1e-6 * values["dissipated_energy_J"]
    )


def test_a_run_without_a_sample_has_no_figures():
    empty = summary.of({name: np.empty(0) for name in COLUMNS}, {}, {})
    assert {figure.name for figure in FIGURES if figure.of(empty) is not None} == set()


def test_the_table_shows_stop_and_axles(stop):
    console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    found = summary.of(stop, COUNTERS, SCENARIO)
    console.print(summary.table(found))
    text = console.export_text()
    assert f"velim_a1: stopped from 30.0 m/s in {found['stop_time_s']:.2f} s" in text
    assert f"{found['axles'][0]['sliding_mean_m_s']:.2f}" in text
    assert "66000 frames" in text
    console.print(summary.table(summary.of({n: np.empty(0) for n in COLUMNS}, {}, {})))
    assert "not stopped" in console.export_text()
