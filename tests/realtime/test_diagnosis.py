"""What a run shows of a unit's wiring and reference speed: found in units that do it, and never in
the reference unit on the stops of the paper.
"""

import math
from pathlib import Path

import bench_process
import numpy as np
import pytest

from rollerrig.configs import store
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.record import records, seal
from rollerrig.wsp_interface import diagnosis, signals
from rollerrig.wsp_interface.diagnosis import Diagnosis, Sample
from rollerrig.wsp_interface.events import Code

TABLE = signals.table(COACH)
STOPS = ("velim_a1", "velim_a2", "velim_a3", "velim_b1", "velim_b2", "velim_b3")
VENT_AXLE_2 = 0b1100  # hold and vent magnet of axle 2
WSP_CODES = (
    Code.WSP_VENTS_WITHOUT_SLIDING,
    Code.WSP_VENTS_ON,
    Code.WSP_AXLES_SWAPPED,
    Code.WSP_REFERENCE_DRIFTS,
    Code.WSP_REFERENCE_DRIFTS_IN_FAULT,
)


def diagnosed(rows):
    """Return the diagnosis of the samples of a stop, and its events as (code, fields)."""
    found = []
    one = Diagnosis(COACH, lambda code, /, **fields: found.append((code, fields)))
    columns = [
        rows[:, signals.column("time")].tolist(),
        rows[:, signals.column("vehicle_speed")].tolist(),
        rows[:, TABLE.span("sliding")].tolist(),
        rows[:, TABLE.span("valve")].tolist(),
        rows[:, signals.column("wsp_reference_speed")].tolist(),
        rows[:, signals.column("brake_demand")].tolist(),
    ]
    for sample in zip(*columns, strict=True):
        one.look(Sample(*sample))
    return one, found


def codes(found):
    return [code for code, _ in found]


NIGHTLY = pytest.mark.nightly


@pytest.mark.parametrize(
    "name",
    ["velim_a1", *(pytest.param(name, marks=NIGHTLY) for name in STOPS[1:-1]), "velim_b3"],
)
def test_the_reference_unit_gives_no_finding_in_the_stops_of_the_paper(name):
    one, found = diagnosed(free.simulate(scenario.load(name)))
    assert found == []
    assert one.vents_without_sliding == 0
    assert one.open_without_sliding_s < diagnosis.OPEN_S / 1.5
    assert one.wrong_axle_s < diagnosis.SWAPPED_S / 1.5
    assert one.drift_s == 0.0


def test_a_unit_that_vents_a_rolling_axle_is_found_and_its_vents_are_counted():
    cycles = iter(range(10**6))

    def vents_every_two_seconds(_inputs):
        return VENT_AXLE_2 if next(cycles) % 200 >= 150 else 0

    rows = free.simulate(scenario.load("dry_stop"), vents_every_two_seconds)
    one, found = diagnosed(free.moving(rows))
    # each vent lasts for 0.5 s less the dead time of the valve
    assert codes(found) == [Code.WSP_VENTS_WITHOUT_SLIDING]
    assert found[0][1]["axle"] == 2
    assert one.vents_without_sliding > 5


def test_a_unit_that_keeps_a_vent_open_after_the_slide_is_found_and_the_time_is_measured():
    """The unit vents a sliding axle as it should, and closes the valve two seconds later."""
    usual = logic.load("reference")
    keeps = usual._replace(run_up_shortest_s=2.0)
    one, found = diagnosed(free.moving(free.simulate(scenario.load("velim_a1"), keeps)))
    assert Code.WSP_VENTS_ON in codes(found)
    assert Code.WSP_VENTS_WITHOUT_SLIDING not in codes(found)
    fields = dict(found)[Code.WSP_VENTS_ON]
    assert fields["for_s"] == pytest.approx(diagnosis.OPEN_S, abs=0.011)
    assert 1.0 < one.open_without_sliding_s < 2.0


def findings_of_axle_1(sliding_m_s, valves, at_cycle_120=lambda one: None):
    """Return the findings when the valve of axle 1 does this and the axle slides so much.

    `at_cycle_120` is called with the diagnosis there.
    """
    found = []
    one = Diagnosis(COACH, lambda code, /, **fields: found.append(code))
    still = [0.0] * (COACH.axles - 1)
    for cycle, (sliding, valve) in enumerate(zip(sliding_m_s, valves, strict=True)):
        if cycle == 120:
            at_cycle_120(one)
        one.look(
            Sample(
                time_s=0.01 * cycle,
                speed_m_s=10.0,
                sliding_m_s=[sliding, *still],
                valves=[valve, *still],
                reference_m_s=10.0,
                brake_demand_Pa=3.8e5,
            )
        )
    return found


def vent_of_axle_1(sliding_m_s):
    """Return the findings when the valve of axle 1 vents once while the axle slides so much."""
    return findings_of_axle_1([sliding_m_s] * 200, [0.0] * 150 + [2.0] + [0.0] * 49)


SLIDES_FIRST = [1.0] * 100 + [0.0] * 100


@pytest.mark.parametrize(
    ("valves", "found"),
    [
        ([2.0] * 200, [Code.WSP_VENTS_ON]),
        ([2.0] * 148 + [0.0] * 52, []),  # it closes in time
        ([2.0] * 145 + [1.0] + [2.0] * 4 + [0.0] * 50, []),  # holds in between
        ([2.0] * 110 + [1.0] * 90, []),
        ([0.0] * 200, []),
    ],
    ids=["stays open", "closes", "holds", "holds on", "fills"],
)
def test_a_vent_that_began_in_a_slide_may_stay_open_for_half_a_second_after_it(valves, found):
    assert findings_of_axle_1(SLIDES_FIRST, valves) == found


@pytest.mark.parametrize("sliding_m_s", [1.0, -1.0])
def test_a_wheel_that_slips_in_either_direction_slides(sliding_m_s):
    assert vent_of_axle_1(0.0) == [Code.WSP_VENTS_WITHOUT_SLIDING]
    assert vent_of_axle_1(sliding_m_s) == []


@pytest.mark.parametrize(("sliding", "swaps"), [((2,), [(1, 2)]), ((2, 3), [])])
def test_swapped_axles_are_reported_only_where_one_other_axle_slides_unprotected(sliding, swaps):
    found = []
    one = Diagnosis(COACH, lambda code, /, **fields: found.append((code, fields)))
    for cycle in range(300):
        one.look(
            Sample(
                time_s=0.01 * cycle,
                speed_m_s=10.0,
                sliding_m_s=[8.0 if axle in sliding else 0.0 for axle in range(1, 5)],
                valves=[2.0, 0.0, 0.0, 0.0],
                reference_m_s=10.0,
                brake_demand_Pa=3.8e5,
            )
        )
    swapped = [fields for code, fields in found if code == Code.WSP_AXLES_SWAPPED]
    assert [(fields["axle"], fields["other"]) for fields in swapped] == swaps


SWAPPED = "swapped_axles axle=1 other=2"


def test_swapped_axles_are_found_and_named():
    plan = scenario.load("velim_a1", faults=[SWAPPED])
    one, found = diagnosed(free.simulate(plan))
    swaps = [fields for code, fields in found if code == Code.WSP_AXLES_SWAPPED]
    assert [(swap["axle"], swap["other"]) for swap in swaps] == [(1, 2)]
    # the unit soon rejects a sensor that its own valve does not move
    assert one.wrong_axle_s > 3.0


@pytest.mark.parametrize(
    "fault",
    [
        "speed_sensor_stuck axle=1 at=9",
        pytest.param("speed_sensor_stuck axle=3 at=4", marks=NIGHTLY),
        pytest.param("speed_sensor_dropout axle=2 at=5", marks=NIGHTLY),
        pytest.param("vent_magnet_dead axle=2 at=3", marks=NIGHTLY),
        "vent_magnet_stuck axle=4 at=3",
        pytest.param("missing_tooth axle=1", marks=NIGHTLY),
    ],
)
def test_another_fault_of_one_axle_is_not_called_swapped_axles(fault):
    plan = scenario.load("velim_a1", faults=[fault])
    _, found = diagnosed(free.simulate(plan))
    assert Code.WSP_AXLES_SWAPPED not in codes(found)


def test_a_reference_speed_that_falls_with_the_wheels_is_found():
    usual = logic.load("reference")
    falls = usual._replace(
        reference_fall_m_s2=5.0,
        first_deceleration_m_s2=3.0,
        run_up_first_s=60.0,
        run_up_interval_s=60.0,
        band_low_fraction=0.5,
        band_high_fraction=0.6,
    )
    plan = scenario.load("leaf_film", settings=("duration_max_s=15",))
    one, found = diagnosed(free.simulate(plan, falls))
    assert Code.WSP_REFERENCE_DRIFTS in codes(found)
    fields = dict(found)[Code.WSP_REFERENCE_DRIFTS]
    assert fields["reference_m_s"] < fields["speed_m_s"] - diagnosis.DRIFT_M_S
    assert one.drift_s > diagnosis.DRIFT_S


def test_a_unit_without_a_reference_speed_gives_no_finding_about_it():
    plan = scenario.load("velim_a1", settings=("initial_speed_m_s=15",))
    rows = free.simulate(plan, lambda inputs: 0)
    one, found = diagnosed(rows)
    assert found == []
    assert math.isnan(one.drift_s)


@pytest.mark.parametrize("pacing", ["free", "lockstep"])
def test_a_run_records_each_finding_once(tmp_path, pacing):
    words = ("--pacing", pacing, "--fault", SWAPPED, "--set", "duration_max_s=15")
    bench = bench_process.run(tmp_path / "run", *words)
    found = [event for event in bench.record.events if event.code in WSP_CODES]
    assert [event.code for event in found].count(Code.WSP_AXLES_SWAPPED) == 1
    swap = next(event for event in found if event.code == Code.WSP_AXLES_SWAPPED)
    assert (swap.fields["axle"], swap.fields["other"]) == (1, 2)
    assert "swapped" in swap.text
    assert np.isfinite(swap.fields["for_s"])


FAULTS_OF_AXLES = ("vent_magnet_stuck axle=2 at=5", "speed_sensor_dropout axle=3 at=8")


def recorded_with(faults, folder):
    """Return the findings in the events of a stop with faults that the bench injects."""
    words = [word for fault in faults for word in ("--fault", fault)]
    for setting in ("adhesion=low", "duration_max_s=20"):
        words += ["--set", setting]
    run = bench_process.run(folder, "--pacing", "free", *words).record
    events = [event for event in run.events if event.code in WSP_CODES]
    return events, diagnosed(records.rows(run.table, run.signal_table))[1]


def test_what_a_known_fault_explains_is_not_diagnosed_as_wiring_or_diameters(tmp_path):
    events, without_the_faults = recorded_with(FAULTS_OF_AXLES, tmp_path / "run")
    # an observer who does not know the faults finds wrong causes
    assert Code.WSP_VENTS_ON in codes(without_the_faults)
    assert Code.WSP_VENTS_WITHOUT_SLIDING in codes(without_the_faults)
    assert not events


def test_a_fault_explains_its_axle_until_the_axle_no_longer_slides():
    found = []
    one = Diagnosis(COACH, lambda code, /, **fields: found.append((code, fields["axle"])))
    still = [0.0] * (COACH.axles - 1)
    stuck = ["vent_magnet_stuck axle=1", *[""] * (COACH.axles - 1)]
    nothing = [""] * COACH.axles
    # until, valve of axle 1, its sliding, and the faults
    phases = (
        (1.0, 0.0, 0.0, stuck),
        (2.0, 2.0, 0.0, stuck),
        (3.0, 0.0, 1.0, stuck),
        (4.0, 0.0, 1.0, nothing),
        (4.2, 2.0, 0.0, nothing),
        (6.0, 0.0, 0.0, nothing),
        (7.0, 2.0, 0.0, nothing),
    )
    for cycle in range(700):
        time_s = 0.01 * cycle
        _, valve, sliding_m_s, faults = next(phase for phase in phases if time_s < phase[0])
        one.look(
            Sample(
                time_s=time_s,
                speed_m_s=10.0,
                sliding_m_s=[sliding_m_s, *still],
                valves=[valve, *still],
                reference_m_s=10.0,
                brake_demand_Pa=3.8e5,
                faults=faults,
            )
        )
    assert found == [(Code.WSP_VENTS_WITHOUT_SLIDING, 1), (Code.WSP_VENTS_ON, 1)]
    assert one.vents_without_sliding == 1


@pytest.mark.parametrize(
    ("after_s", "is_found"), [(0.03, False), (diagnosis.RECOVERY_S + 0.1, True)]
)
def test_a_fault_explains_its_axle_for_some_time_after_it_was_lifted(after_s, is_found):
    """A sensor stands still, is whole again, and the valve of its axle vents so much later."""
    found = []
    one = Diagnosis(COACH, lambda code, /, **fields: found.append((code, fields["axle"])))
    still = [0.0] * COACH.axles
    for cycle in range(400):
        time_s = 0.01 * cycle
        is_faulty = time_s < 1.0
        vents = 1.0 + after_s <= time_s < 1.2 + after_s
        one.look(
            Sample(
                time_s=time_s,
                speed_m_s=20.0,
                sliding_m_s=still,
                valves=[2.0 if vents else 0.0, *still[1:]],
                reference_m_s=20.0,
                brake_demand_Pa=3.8e5,
                faults=["speed_sensor_stuck axle=1" if is_faulty else "", *[""] * 3],
            )
        )
    assert found == ([(Code.WSP_VENTS_WITHOUT_SLIDING, 1)] if is_found else [])


@pytest.mark.parametrize(
    ("fault", "axles"),
    [
        ("vent_magnet_stuck axle=2", {2}),
        ("speed_sensor_dropout axle=3", {1, 2, 3, 4}),
        ("frame_lost can_id=0x190", {1, 2, 3, 4}),
        ("swapped_axles axle=1 other=2", set()),
        ("drive_trip axle=1", set()),
    ],
)
def test_a_fault_explains_the_axles_whose_valves_or_reference_it_falsifies(fault, axles):
    assert catalogue.parse(fault, COACH).explains == axles


def test_the_events_of_a_sealed_rig_do_not_show_its_swapped_axles(tmp_path):
    hidden = {"fault": [{"kind": "swapped_axles", "axle": 1, "other": 2}]}
    file = tmp_path / "sealed.toml"
    base = Path(store.find("scenarios", "velim_a1")).read_text(encoding="utf-8")
    sealed = seal.encode(hidden).replace("\n", "")
    file.write_text(f'sealed = "{sealed}"\n{base}', encoding="utf-8")
    words = ("--pacing", "free", "--set", "duration_max_s=20")
    run = bench_process.run(tmp_path / "run", *words, scenario=str(file)).record
    assert [event for event in run.events if event.code in WSP_CODES] == []
    # the axles are swapped all the same
    one, _ = diagnosed(records.rows(run.table, run.signal_table))
    # the unit soon rejects a sensor that its own valve does not move
    assert one.wrong_axle_s > 3.0


def test_what_an_emergency_stop_or_a_long_pause_of_the_bench_causes_is_not_blamed_on_the_unit():
    sliding, valves = SLIDES_FIRST, [2.0] * 200
    assert findings_of_axle_1(sliding, valves) == [Code.WSP_VENTS_ON]
    assert findings_of_axle_1(sliding, valves, at_cycle_120=Diagnosis.end) == []


def test_a_short_pause_of_the_bench_starts_each_duration_anew():
    # the valve vents over the rolling axle for 0.4 s before and after the pause
    valves = [0.0] * 80 + [2.0] * 80 + [0.0] * 40
    assert findings_of_axle_1([1.0] * 81 + [0.0] * 119, valves) == [Code.WSP_VENTS_ON]
    found = findings_of_axle_1([1.0] * 81 + [0.0] * 119, valves, at_cycle_120=Diagnosis.start_anew)
    assert found == []
