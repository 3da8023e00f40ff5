"""Hidden faults on the bus or in a sander are found in the record of a stop."""

import shutil

import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.discover import discover, fault_signs, sealed_rig
from rollerrig.realtime.record import records
from rollerrig.rig.identify.decide import decision
from rollerrig.rig.identify.next_stops.prototype import Stop
from rollerrig.wsp_interface.events import Code

SAND = {"axle": 1, "from_s": 1.0}


def sealed(folder, *hidden, **tables):
    """Return the file of a rig that hides faults; `tables` replace those of the scenario."""
    rig = folder / "rig.toml"
    content, _ = store.load("scenarios", "velim_a1")
    sealed_rig.write(rig, content | tables, {"fault": list(hidden)})
    return str(rig)


def run_stop(folder, *hidden, speed_m_s=8.0, **tables):
    """Return the record of a stop of a rig that hides faults."""
    rig = sealed(folder, *hidden, **tables)
    stop = Stop(speed_m_s, pressure_Pa=3.8e5, mass_kg=43000.0, axle=0)
    return records.load(discover.brake((rig, folder / "run", stop, 0)))


def find_out(rig, out):
    return discover.find_out(rig, out, 3, 0, lambda _: None, lambda *_: None)


@pytest.fixture(scope="module")
def fault_free(tmp_path_factory) -> records.Run:
    """The record of a stop over the bus, with a fault that never begins."""
    return run_stop(tmp_path_factory.mktemp("none"), {"kind": "frame_lost", "at_s": 36000.0})


def with_frames(run, folder, lines) -> records.Run:
    """Return a run with other lines in its log of the bus."""
    (folder / "can.log").write_text("".join(lines))
    return run._replace(folder=folder)


def test_a_stop_over_the_bus_without_a_fault_shows_none(fault_free) -> None:
    assert fault_signs.of(fault_free) == []


def test_missing_frames_are_lost_or_delayed(fault_free, tmp_path) -> None:
    lines = (fault_free.folder / "can.log").read_text().splitlines(keepends=True)
    every_second = [line for line in lines if " 190#" in line][::2]
    lost = set(every_second)
    run = with_frames(fault_free, tmp_path, [line for line in lines if line not in lost])
    assert fault_signs.of(run) == ["frame_lost can_id=0x190"]

    def later(line: str) -> str:
        time_s = float(line[1:18])
        if " 191#" in line and time_s > 2.0:
            time_s += 0.05
        return f"({time_s:017.6f}){line[19:]}"

    run = with_frames(fault_free, tmp_path, sorted(map(later, lines)))
    assert fault_signs.of(run) == ["frame_delayed can_id=0x191"]


@pytest.mark.parametrize(
    ("hidden", "signs"),
    [
        pytest.param(
            [{"kind": "drive_trip", "axle": 3}],
            ["drive_trip axle=3"],
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            [{"kind": "drive_over_temperature", "axle": 2, "at_s": 2.0}],
            ["drive_over_temperature axle=2"],
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            [{"kind": "power_dip", "at_s": 2.0, "for_s": 1.0}],
            ["power_dip"],
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            [{"kind": "node_off", "node": 16}],
            ["node_off or bus_off node=16"],
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            [{"kind": "node_off", "node": 17, "at_s": 2.0, "for_s": 1.0}],
            ["node_off node=17"],
            marks=pytest.mark.nightly,
        ),
        (
            [
                {"kind": "bus_off", "node": 17, "at_s": 2.0, "for_s": 1.0},
                {"kind": "wsp_frozen", "at_s": 4.0},
            ],
            ["bus_off node=17", "wsp_frozen"],
        ),
        pytest.param(
            [{"kind": "frame_lost", "can_id": 0x190, "every": 2}],
            ["frame_lost can_id=0x190"],
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            [{"kind": "frame_delayed", "can_id": 0x191, "delay_s": 0.05, "at_s": 2.0}],
            ["frame_delayed can_id=0x191"],
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            [{"kind": "error_frame", "node": 16}],
            ["error_frame node=16"],
            marks=pytest.mark.nightly,
        ),
        ([{"kind": "receive_error", "node": 17, "at_s": 2.0}], ["receive_error node=17"]),
    ],
    ids=str,
)
def test_a_fault_on_the_bus_is_found_in_the_frames_and_its_effects_on_the_motion_are_left_out(
    tmp_path, hidden, signs
) -> None:
    run = run_stop(tmp_path, *hidden)
    assert fault_signs.of(run) == signs
    codes = {event.code for event in run.events}
    assert codes.isdisjoint({Code.FAULT_BEGINS, Code.FAULT_LIFTED})
    # a fault that is in the scenario is no finding
    known = run._replace(scenario=run.scenario | {"fault": hidden})
    assert fault_signs.of(known) == []


def test_a_rig_without_such_a_fault_is_braked_without_a_bus(tmp_path) -> None:
    run = run_stop(tmp_path, {"kind": "cylinder_leak", "axle": 2})
    assert run.summary["pacing"] == "free"
    assert records.frames(run.folder) == []


@pytest.fixture(scope="module")
def late_sander(tmp_path_factory) -> records.Run:
    """The record of a stop with sand that comes late."""
    fault = {"kind": "sander_late", "axle": 1}
    return run_stop(tmp_path_factory.mktemp("late"), fault, speed_m_s=25.0, sanders=SAND)


def test_a_late_sander_is_found_by_the_sand_that_it_gives(late_sander) -> None:
    assert fault_signs.of(late_sander) == ["sander_late axle=1"]


@pytest.mark.parametrize(
    ("fault", "signs"),
    [
        (None, []),
        pytest.param("sander_empty", ["sander_empty axle=1"], marks=pytest.mark.nightly),
        pytest.param("sander_blocked", ["sander_blocked axle=1"], marks=pytest.mark.nightly),
        ("sander_wrong_orifice", ["sander_wrong_orifice axle=1"]),
    ],
)
def test_a_faulty_sander_is_found_by_the_sand_that_it_gives(tmp_path, fault, signs) -> None:
    hidden = [{"kind": fault, "axle": 1}] if fault else []
    run = run_stop(tmp_path, *hidden, speed_m_s=25.0, sanders=SAND)
    assert fault_signs.of(run) == signs


@pytest.mark.nightly
def test_a_sand_box_that_becomes_empty_during_a_stop_is_no_fault(tmp_path) -> None:
    run = run_stop(tmp_path, speed_m_s=25.0, sanders={"axle": 1, "from_s": 1.0, "box_kg": 0.3})
    assert run.column("sand_box_1_kg")[-1] == 0.0
    assert fault_signs.of(run) == []


@pytest.mark.nightly
def test_a_search_whose_stops_are_not_valid_reports_the_faults_that_they_show(tmp_path) -> None:
    rig = sealed(tmp_path, {"kind": "wsp_frozen", "at_s": 1.0})
    with pytest.raises(ConfigError, match=r"the WSP unit was lost.*the stops show wsp_frozen"):
        find_out(rig, tmp_path / "found")


def test_stops_with_sand_are_refused_and_the_message_has_the_fault_that_they_show(
    tmp_path, late_sander
) -> None:
    # three stops that show the same fault; the last one is held out
    folders = [tmp_path / str(number) for number in range(3)]
    for folder in folders:
        shutil.copytree(late_sander.folder, folder)
    (tmp_path / "dataset").mkdir()
    with pytest.raises(ConfigError, match=r"the stops show sander_late axle=1.*sand was used"):
        discover._explain(folders, tmp_path, 0, lambda *_: None, decision.explain_braking_runs)


@pytest.mark.nightly
def test_a_search_with_sand_is_refused_and_the_message_has_the_fault_that_its_stops_show(
    tmp_path,
) -> None:
    fault = {"kind": "sander_late", "axle": 3}
    rig = sealed(tmp_path, fault, sanders={"axle": 3, "from_s": 1.0})
    with pytest.raises(ConfigError, match=r"the stops show sander_late axle=3.*sand was used"):
        find_out(rig, tmp_path / "found")
