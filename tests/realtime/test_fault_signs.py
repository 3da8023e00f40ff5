"""Hidden faults on the bus or in a sander are found in the record of a stop."""

import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.discover import discover, fault_signs, sealed_rig
from rollerrig.realtime.record import records
from rollerrig.rig.identify.next_stops.prototype import Stop
from rollerrig.wsp_interface.events import Code


def sealed(folder, *hidden, **tables):
    """Return the file of a rig that hides faults; `tables` replace those of the scenario."""
    rig = folder / "rig.toml"
    content, _ = store.load("scenarios", "velim_a1")
    sealed_rig.write(rig, content | tables, {"fault": list(hidden)})
    return str(rig)


def run_stop(folder, *hidden, speed_m_s=12.0, **tables):
    """Return the record of a stop of a rig that hides faults."""
    rig = sealed(folder, *hidden, **tables)
    stop = Stop(speed_m_s, pressure_Pa=3.8e5, mass_kg=43000.0, axle=0)
    return records.load(discover.brake((rig, folder / "run", stop, 0)))


def find_out(rig, out):
    return discover.find_out(rig, out, 3, 0, lambda _: None, lambda *_: None)


@pytest.mark.parametrize(
    ("hidden", "signs"),
    [
        ({"kind": "frame_lost", "at_s": 36000.0}, []),  # the fault never begins
        ({"kind": "drive_trip", "axle": 3}, ["drive_trip axle=3"]),
        (
            {"kind": "drive_over_temperature", "axle": 2, "at_s": 2.0},
            ["drive_over_temperature axle=2"],
        ),
        ({"kind": "power_dip", "at_s": 2.0, "for_s": 1.0}, ["power_dip"]),
        ({"kind": "node_off", "node": 16}, ["node_off or bus_off node=16"]),
        ({"kind": "node_off", "node": 17, "at_s": 2.0, "for_s": 1.0}, ["node_off node=17"]),
        ({"kind": "bus_off", "node": 17, "at_s": 2.0, "for_s": 1.0}, ["bus_off node=17"]),
        ({"kind": "frame_lost", "can_id": 0x190, "every": 2}, ["frame_lost can_id=0x190"]),
        (
            {"kind": "frame_delayed", "can_id": 0x191, "delay_s": 0.05, "at_s": 2.0},
            ["frame_delayed can_id=0x191"],
        ),
        ({"kind": "error_frame", "node": 16}, ["error_frame node=16"]),
        ({"kind": "receive_error", "node": 17, "at_s": 2.0}, ["receive_error node=17"]),
        ({"kind": "wsp_frozen", "at_s": 2.0}, ["wsp_frozen"]),
    ],
    ids=str,
)
def test_a_fault_on_the_bus_is_found_in_the_frames_and_its_effects_on_the_motion_are_left_out(
    tmp_path, hidden, signs
) -> None:
    run = run_stop(tmp_path, hidden)
    assert fault_signs.of(run) == signs
    codes = {event.code for event in run.events}
    assert codes.isdisjoint({Code.FAULT_BEGINS, Code.FAULT_LIFTED})
    # a fault that is in the scenario is no finding
    known = run._replace(scenario=run.scenario | {"fault": [hidden]})
    assert fault_signs.of(known) == []


def test_a_rig_without_such_a_fault_is_braked_without_a_bus(tmp_path) -> None:
    run = run_stop(tmp_path, {"kind": "cylinder_leak", "axle": 2})
    assert run.summary["pacing"] == "free"
    assert records.frames(run.folder) == []


@pytest.mark.parametrize(
    ("fault", "signs"),
    [
        (None, []),
        ("sander_empty", ["sander_empty axle=1"]),
        ("sander_blocked", ["sander_blocked axle=1"]),
        ("sander_wrong_orifice", ["sander_wrong_orifice axle=1"]),
        ("sander_late", ["sander_late axle=1"]),
    ],
)
def test_a_faulty_sander_is_found_by_the_sand_that_it_gives(tmp_path, fault, signs) -> None:
    hidden = [{"kind": fault, "axle": 1}] if fault else []
    run = run_stop(tmp_path, *hidden, speed_m_s=25.0, sanders={"axle": 1, "from_s": 1.0})
    assert fault_signs.of(run) == signs


def test_a_sand_box_that_becomes_empty_during_a_stop_is_no_fault(tmp_path) -> None:
    run = run_stop(tmp_path, speed_m_s=25.0, sanders={"axle": 1, "from_s": 1.0, "box_kg": 0.3})
    assert run.column("sand_box_1_kg")[-1] == 0.0
    assert fault_signs.of(run) == []


def test_a_search_whose_stops_are_not_valid_reports_the_faults_that_they_show(tmp_path) -> None:
    rig = sealed(tmp_path, {"kind": "wsp_frozen", "at_s": 1.0})
    with pytest.raises(ConfigError, match=r"the WSP unit was lost.*the stops show wsp_frozen"):
        find_out(rig, tmp_path / "found")


def test_stops_with_sand_are_refused_and_the_message_has_the_fault_that_they_show(tmp_path) -> None:
    fault = {"kind": "sander_late", "axle": 3}
    rig = sealed(tmp_path, fault, sanders={"axle": 3, "from_s": 1.0})
    with pytest.raises(ConfigError, match=r"the stops show sander_late axle=3.*sand was used"):
        find_out(rig, tmp_path / "found")
