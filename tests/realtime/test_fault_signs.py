"""Faults that act over the bus, or in a sander, are told from the record of a stop in which nobody told of them."""

import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.discover import discover, fault_signs, sealed_rig
from rollerrig.realtime.record import records
from rollerrig.rig.identify.next_stops.prototype import Stop
from rollerrig.wsp_interface.events import Code


def stop(folder, *hidden, speed_m_s=12.0, **tables):
    """The record of a stop of a rig that hides faults."""
    given, _ = store.load("scenarios", "velim_a1")
    sealed_rig.write(folder / "rig.toml", given | tables, {"fault": list(hidden)})
    return records.load(
        discover.brake(
            (str(folder / "rig.toml"), folder / "run", Stop(speed_m_s, 3.8e5, 43000.0, 0), 0)
        )
    )


@pytest.mark.parametrize(
    ("hidden", "told"),
    [
        ({"kind": "frame_lost", "at_s": 36000.0}, []),  # never begins
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
def test_a_fault_on_the_bus_is_told_by_its_frames_and_not_what_it_does_to_the_motion(
    tmp_path, hidden, told
) -> None:
    run = stop(tmp_path, hidden)
    assert fault_signs.of(run) == told
    assert not any(event.code in (Code.FAULT_BEGINS, Code.FAULT_LIFTED) for event in run.events)
    # a scenario that tells of a fault is told nothing new
    assert fault_signs.of(run._replace(scenario=run.scenario | {"fault": [hidden]})) == []


def test_a_rig_without_such_a_fault_is_braked_without_a_bus(tmp_path) -> None:
    run = stop(tmp_path, {"kind": "cylinder_leak", "axle": 2})
    assert run.summary["pacing"] == "free"
    assert records.frames(run.folder) == []


@pytest.mark.parametrize(
    ("hidden", "told"),
    [
        (None, []),
        ("sander_empty", ["sander_empty axle=1"]),
        ("sander_blocked", ["sander_blocked axle=1"]),
        ("sander_wrong_orifice", ["sander_wrong_orifice axle=1"]),
        ("sander_late", ["sander_late axle=1"]),
    ],
)
def test_a_sander_that_fails_is_told_by_the_sand_that_it_gives(tmp_path, hidden, told) -> None:
    faults = [{"kind": hidden, "axle": 1}] if hidden else []
    run = stop(tmp_path, *faults, speed_m_s=25.0, sanders={"axle": 1, "from_s": 1.0})
    assert fault_signs.of(run) == told


def test_a_box_that_runs_out_on_the_way_is_no_fault(tmp_path) -> None:
    run = stop(tmp_path, speed_m_s=25.0, sanders={"axle": 1, "from_s": 1.0, "box_kg": 0.3})
    assert run.column("sand_box_1_kg")[-1] == 0.0
    assert fault_signs.of(run) == []


def test_a_search_whose_stops_are_not_valid_says_what_their_record_shows(tmp_path) -> None:
    given, _ = store.load("scenarios", "velim_a1")
    rig = tmp_path / "rig.toml"
    sealed_rig.write(rig, given, {"fault": [{"kind": "wsp_frozen", "at_s": 1.0}]})
    with pytest.raises(ConfigError, match=r"the WSP unit was lost.*the stops show wsp_frozen"):
        discover.find_out(str(rig), tmp_path / "found", 3, 0, lambda _: None, lambda *_: None)


def test_stops_with_sand_are_refused_for_an_explanation_with_the_fault_that_they_show(
    tmp_path,
) -> None:
    given, _ = store.load("scenarios", "velim_a1")
    rig = tmp_path / "rig.toml"
    sealed_rig.write(
        rig,
        given | {"sanders": {"axle": 3, "from_s": 1.0}},
        {"fault": [{"kind": "sander_late", "axle": 3}]},
    )
    with pytest.raises(ConfigError, match=r"the stops show sander_late axle=3.*sand was strewn"):
        discover.find_out(str(rig), tmp_path / "found", 3, 0, lambda _: None, lambda *_: None)
