"""The summary of a run is computed from its channels and from the counters of the bench."""

import json
import os

import numpy as np
import pyarrow as pa
import pytest
import synthetic_stop
from rich.console import Console

from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.realtime.record import summary
from rollerrig.realtime.record.figures import BY_NAME, FIGURES
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)
COLUMNS = TABLE.columns
SCENARIO = {
    "title": "a stop",
    "loop": {"tick_hz": 1000, "step_s": 1e-4, "record_hz": 100},
    "rig": {"lock_above_m_s": 3.0},
}
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

# recorded states of a valve
FILL = 0.0
HOLD = 1.0


@pytest.fixture(scope="module")
def stop():
    """The channels of a stop in which axle 1 locks."""
    rows = synthetic_stop.stop(speed_m_s=20.0, lock_axle=1)
    return dict(zip(COLUMNS, rows.T[TABLE.kept], strict=True))


def braked(standing_s=2.0):
    """Return the channels of a vehicle that brakes evenly from 20 m/s in 10 s and then stands.

    Time, position and sliding work do not begin at zero.
    """
    record_hz = 100
    brake_s = 10.0
    elapsed_s = np.arange(round((brake_s + standing_s) * record_hz) + 1) / record_hz
    speed_m_s = np.maximum(20.0 * (1 - elapsed_s / brake_s), 0.0)
    moves = speed_m_s > 0
    holds = (elapsed_s >= 1.0) & (elapsed_s < 3.5)

    columns = {name: np.zeros_like(elapsed_s) for name in COLUMNS}
    columns["time_s"] = elapsed_s + 3.0
    columns["vehicle_speed_m_s"] = speed_m_s
    columns["position_m"] = 50.0 + np.cumsum(speed_m_s) / record_hz
    columns["sliding_2_m_s"] = np.where(moves, 2.0, 0.0)
    columns["sliding_work_2_J"] = 7.0 + 100.0 * np.minimum(elapsed_s, brake_s)
    columns["adhesion_3"] = np.where(moves, 0.1, 0.0)
    columns["valve_4"] = np.where(holds, HOLD, FILL)
    columns["vents_4"] = np.minimum(np.floor(elapsed_s), 5.0)
    columns["air_consumption_NL"] = 2.0 * elapsed_s
    return columns


def without_a_sample():
    """Return the channels of a run that recorded nothing."""
    return {name: np.empty(0) for name in COLUMNS}


def test_a_summary_has_the_keys_that_users_rely_on(stop):
    result = summary.of(stop, COUNTERS, SCENARIO)
    assert set(result) >= {
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
        "braking_time_s",
        "braking_distance_m",
        "stopped",
        "axles",
        "wsp",
        "air_consumption_NL",
        "loop",
        "bus",
        "modbus",
    }
    assert set(result["wsp"]) == {"unit", "active_s", "vents"}
    assert len(result["axles"]) == 4
    for axle in result["axles"]:
        assert set(axle) == {
            "sliding_mean_m_s",
            "sliding_std_m_s",
            "sliding_max_m_s",
            "longest_lock_s",
            "longest_deep_slide_s",
            "dissipated_energy_J",
            "adhesion_mean",
            "vents",
            "wheel_flat_m",
        }


def test_a_summary_has_the_counters_of_the_bench(stop):
    result = summary.of(stop, COUNTERS, SCENARIO)
    assert result["scenario"] == "velim_a1"
    assert result["seed"] == 4
    assert result["tick_hz"] == 1000
    assert result["loop"] == COUNTERS["loop"]
    assert result["bus"] == COUNTERS["bus"]
    assert result["modbus"] == {"requests": 12}


# --- the stop ---


def test_the_stop_lasts_from_the_first_sample_to_standstill():
    result = summary.of(braked(), COUNTERS, SCENARIO)
    assert result["stopped"] is True
    assert result["initial_speed_m_s"] == 20.0
    assert result["stop_time_s"] == pytest.approx(10.0, abs=0.011)
    assert result["stop_distance_m"] == pytest.approx(100.0, rel=0.01)
    assert result["duration_s"] == pytest.approx(12.0)


def test_the_stopping_distance_counts_from_the_first_brake_demand():
    columns = braked()
    since = columns["time_s"] - columns["time_s"][0]
    # the demand is given at 2 s, and the next sample shows it
    columns["brake_demand_Pa"] = np.where(since > 2.0, 3.8e5, 0.0)
    found = summary.of(columns, COUNTERS, SCENARIO)
    assert found["braking_time_s"] == pytest.approx(8.0, abs=0.011)
    assert found["braking_distance_m"] == pytest.approx(64.0, rel=0.01)
    # the stop still counts from the first sample
    assert found["stop_distance_m"] == pytest.approx(100.0, rel=0.01)


@pytest.mark.parametrize("demanded_s", [None, 11.0])
def test_a_coach_that_stops_without_a_brake_demand_has_no_stopping_distance(demanded_s):
    columns = braked()
    if demanded_s is not None:
        since = columns["time_s"] - columns["time_s"][0]
        columns["brake_demand_Pa"] = np.where(since > demanded_s, 3.8e5, 0.0)
    found = summary.of(columns, COUNTERS, SCENARIO)
    assert found["braking_distance_m"] is None
    assert found["stop_distance_m"] == pytest.approx(100.0, rel=0.01)


def test_samples_after_the_stop_change_no_mean():
    short = summary.of(braked(standing_s=0.5), COUNTERS, SCENARIO)
    long = summary.of(braked(standing_s=20.0), COUNTERS, SCENARIO)
    assert short["axles"] == long["axles"]

    _, axle_2, axle_3, _ = short["axles"]
    assert axle_2["sliding_mean_m_s"] == pytest.approx(2.0, rel=0.01)
    assert axle_3["adhesion_mean"] == pytest.approx(0.1, rel=0.01)


def test_the_control_error_is_the_largest_and_the_root_mean_square_over_all_axles():
    columns = braked()
    columns["tracking_error_3_m_s"][:] = -0.02
    tracking = summary.of(columns, COUNTERS, SCENARIO)["tracking"]
    assert tracking == {"max_m_s": pytest.approx(0.02), "rms_m_s": pytest.approx(0.01)}


def test_energy_is_the_sliding_work_of_the_stop():
    result = summary.of(braked(), COUNTERS, SCENARIO)
    _, axle_2, _, _ = result["axles"]
    assert axle_2["dissipated_energy_J"] == pytest.approx(1000.0, abs=2.0)


def test_the_wsp_is_active_while_any_valve_does_not_fill():
    result = summary.of(braked(), COUNTERS, SCENARIO)
    assert result["wsp"] == {"unit": "reference", "active_s": pytest.approx(2.5), "vents": 5}


def test_a_vehicle_that_still_moves_has_not_stopped():
    columns = {name: values[:500] for name, values in braked().items()}
    result = summary.of(columns, COUNTERS, SCENARIO)
    assert result["stopped"] is False
    assert result["stop_time_s"] is None
    assert result["stop_distance_m"] is None

    _, axle_2, _, _ = result["axles"]
    assert axle_2["sliding_mean_m_s"] == pytest.approx(2.0)


def test_a_vehicle_that_never_moved_has_not_stopped():
    columns = {name: np.zeros(5) for name in COLUMNS}
    columns["time_s"] = np.arange(5) / 100.0
    result = summary.of(columns, COUNTERS, SCENARIO)
    assert result["stopped"] is False


# --- incomplete records ---


def test_a_run_without_a_sample_has_a_summary():
    result = summary.of(without_a_sample(), {}, {})
    assert result["stopped"] is False
    assert result["samples"] == 0
    assert result["initial_speed_m_s"] is None
    assert result["axles"][0]["sliding_mean_m_s"] is None


def test_the_kind_of_the_vehicle_counts_where_the_scenario_cannot_be_read():
    assert len(summary.of(without_a_sample(), {}, {})["axles"]) == 4
    assert len(summary.of({"time_s": np.empty(0)}, {}, {}, kind=Kind(8))["axles"]) == 8
    scenario = {"vehicle": {"axles": 2}}
    assert len(summary.of({"time_s": np.empty(0)}, {}, scenario)["axles"]) == 2


def test_channels_that_were_not_recorded_give_null():
    columns = {name: values for name, values in braked().items() if "sliding" not in name}
    result = summary.of(columns, COUNTERS, SCENARIO)
    _, axle_2, _, _ = result["axles"]
    assert axle_2["sliding_max_m_s"] is None
    assert axle_2["dissipated_energy_J"] is None


def test_the_samples_replace_the_counters_of_a_killed_bench():
    columns = braked()
    columns["ticks_missed"] = np.full_like(columns["time_s"], 3.0)
    columns["tick_lateness_us"] = np.full_like(columns["time_s"], 80.0)
    loop = summary.of(columns, {}, SCENARIO)["loop"]
    assert loop["ticks"] == 15000
    assert loop["missed"] == 3
    assert loop["lateness_us"]["max"] == 80.0
    assert loop["lateness_us"]["p50"] is None


def test_a_table_and_arrays_give_the_same_summary_each_time(stop):
    table = pa.table({name: pa.array(values) for name, values in stop.items()})
    first = json.dumps(summary.of(stop, COUNTERS, SCENARIO))
    of_table = json.dumps(summary.of(table, COUNTERS, SCENARIO))
    second = json.dumps(summary.of(stop, COUNTERS, SCENARIO))
    assert of_table == first
    assert second == first
    assert "NaN" not in first


# --- figures and table ---


def test_every_figure_of_a_stop_is_read_from_its_summary(stop):
    result = summary.of(stop, COUNTERS, SCENARIO)
    values = {figure.name: figure.of(result) for figure in FIGURES}

    # this stop has no motors that hold a speed
    missing = {name for name, value in values.items() if value is None}
    assert missing == {"tracking_max_m_s", "tracking_rms_m_s"}

    assert values["stop_distance_m"] == result["stop_distance_m"]

    locked_axle = result["axles"][0]
    assert values["longest_lock_s"] > 0.0
    assert values["longest_lock_s"] == locked_axle["longest_lock_s"]

    # a lock is a part of a deep slide
    assert values["longest_deep_slide_s"] >= values["longest_lock_s"] - 0.02

    energy_J = sum(axle["dissipated_energy_J"] for axle in result["axles"])
    assert values["dissipated_energy_J"] == pytest.approx(energy_J)
    energy_MJ = 1e-6 * values["dissipated_energy_J"]
    assert BY_NAME["dissipated_energy_J"].shown(result) == pytest.approx(energy_MJ)


def test_a_run_without_a_sample_has_no_figures():
    result = summary.of(without_a_sample(), {}, {})
    for figure in FIGURES:
        assert figure.of(result) is None, figure.name


def printed(result):
    """Return the text of the table of a summary."""
    with open(os.devnull, "w") as screen:
        console = Console(width=120, record=True, file=screen)
        console.print(summary.table(result))
        return console.export_text()


def test_the_table_shows_stop_axles_and_bus(stop):
    result = summary.of(stop, COUNTERS, SCENARIO)
    text = printed(result)
    assert f"velim_a1: stopped from 20.0 m/s in {result['braking_time_s']:.2f} s" in text
    assert f"{result['axles'][0]['sliding_mean_m_s']:.2f}" in text
    assert "66000 frames" in text


def test_the_table_of_a_run_without_a_sample_shows_that_it_has_not_stopped():
    result = summary.of(without_a_sample(), {}, {})
    assert "not stopped" in printed(result)
