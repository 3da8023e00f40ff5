"""Units on the buses of several cars of a train, in lockstep and in real time."""

import sys
from pathlib import Path

import numpy as np
import pytest
from recorded_runs import differing, run

from rollerrig.realtime import cli
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import channels, records, run_folder
from rollerrig.realtime.train import ticks
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.rig_objects import (
    MAGNETS_ID,
    TRAIN_DECELERATION,
    TRAIN_DECELERATION_ID,
)

TWO_COACHES = """
vehicle = "uic_z1"
adhesion = "low"
initial_speed_m_s = 8.0

[brake]
lever_ratio = 3.5

[[demand]]
from_s = 0.2
pressure_Pa = 3.8e5

[train]
delay_of_car_s = 0.1

[[train.car]]
length_m = 26.4
count = 2
"""
PROGRAM = Path(sys.executable).with_name("rollerrig")
AS_PROGRAM = ("--unit", f"{PROGRAM} wsp --bus socketcand://{{host}}:{{port}}/rig0")
FIVE = ("five_coaches", "--set", "initial_speed_m_s=10", "--set", "brake.lever_ratio=3.5")


@pytest.fixture
def two_coaches(tmp_path):
    path = tmp_path / "two_coaches.toml"
    path.write_text(TWO_COACHES)
    return (str(path),)


@pytest.mark.parametrize(
    ("cars", "numbers"),
    [("all", [1, 2]), pytest.param("five", [1, 2, 3, 4, 5], marks=pytest.mark.nightly)],
)
def test_units_of_all_cars_in_lockstep_are_equal_to_the_free_run_to_the_byte(
    cars, numbers, two_coaches, tmp_path, capsys
):
    train = FIVE if cars == "five" else two_coaches
    free, on_buses = tmp_path / "free", tmp_path / "on_buses"
    run(free, capsys, *train, "--pacing", "free")
    result = run(on_buses, capsys, *train, "--pacing", "lockstep", "--car", "all", *AS_PROGRAM)
    assert result["valid"]
    assert result["cars_on_bus"] == numbers
    assert differing(free, on_buses) == []
    ports = set()
    for number in numbers:
        of_car = f"car_{number}"
        assert differing(free / of_car, on_buses / of_car) == []
        summary = records.summary(on_buses / of_car)
        assert summary["unit_played"]["kind"] == "command"
        assert summary["wsp"]["vents"] > 0
        frames = records.frames(on_buses / of_car)
        assert len([data for _, can_id, data in frames if can_id == MAGNETS_ID]) > 300
        places = [
            event.fields["address"]
            for event in records.events(on_buses / of_car)
            if event.code == "bus.place"
        ]
        ports.update(places)
    # each car has a bus that no other has
    assert len(ports) == len(numbers)


def test_units_of_all_cars_in_real_time_stop_the_train_as_without_a_bus(
    two_coaches, tmp_path, capsys
):
    free, in_time = tmp_path / "free", tmp_path / "in_time"
    of_free = run(free, capsys, *two_coaches, "--pacing", "free")
    result = run(in_time, capsys, *two_coaches, "--pacing", "wall", "--car", "all", *AS_PROGRAM)
    assert result["valid"], result["invalid_because"]
    assert result["cars_on_bus"] == [1, 2]
    assert result["braking_distance_m"] == pytest.approx(of_free["braking_distance_m"], rel=0.03)
    of_cars = [records.summary(in_time / f"car_{number}") for number in (1, 2)]
    # one loop runs the ticks of all cars
    assert of_cars[0]["loop"] == of_cars[1]["loop"] == result["loop"]
    assert result["loop"]["ticks"] > 3000
    assert set(result["loop"]["lateness_us"]) == {"p50", "p99", "p999", "max"}
    for number, summary in enumerate(of_cars, start=1):
        assert summary["wsp"]["vents"] > 0
        log = records.frames(in_time / f"car_{number}")
        assert len([can_id for _, can_id, _ in log if can_id == MAGNETS_ID]) > 300
    assert (in_time / "report.html").is_file()


def test_the_bus_of_each_car_has_the_deceleration_of_the_train(two_coaches, tmp_path, capsys):
    folder = tmp_path / "run"
    run(folder, capsys, *two_coaches, "--pacing", "lockstep", "--car", "all")
    recorded = channels.load(folder)
    time_s, measured, speed = (
        recorded[name].to_numpy()
        for name in ("time_s", "train_deceleration_m_s2", "vehicle_speed_m_s")
    )
    # of a first-order lag: what it has passed on, and what it still holds
    passed = np.concatenate(
        ([0.0], np.cumsum(0.5 * np.diff(time_s) * (measured[1:] + measured[:-1])))
    )
    held = ticks.DECELERATION_LAG_S * measured
    np.testing.assert_allclose(passed + held, speed[0] - speed, atol=0.01)
    assert measured.max() > 0.5

    logs = [
        [
            (at, data)
            for at, can_id, data in records.frames(folder / of_car)
            if can_id == TRAIN_DECELERATION_ID
        ]
        for of_car in ("car_1", "car_2")
    ]
    assert logs[0] == logs[1]
    assert len(logs[0]) > 300
    for at_us, data in logs[0]:
        raw = int.from_bytes(bytes.fromhex(data), "little", signed=True)
        sent = signals.value(raw, TRAIN_DECELERATION)
        now = measured[np.searchsorted(time_s, at_us / 1e6 - 1e-6)]
        assert sent == pytest.approx(now, abs=0.5001 * TRAIN_DECELERATION.scale)


def test_a_vehicle_alone_has_no_deceleration_of_a_train_on_its_bus(tmp_path, capsys):
    folder = tmp_path / "run"
    words = ("dry_stop", "--set", "initial_speed_m_s=2", "--set", "bus.interface=hub")
    run(folder, capsys, *words, "--set", "bus.socketcand_port=0", "--pacing", "lockstep")
    sent = {can_id for _, can_id, _ in records.frames(folder)}
    assert MAGNETS_ID in sent
    assert TRAIN_DECELERATION_ID not in sent


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--car", "1,7"), "--car 7: five_coaches has 5 cars"),
        (("--car", "first"), "'first': write the numbers of cars, as in 2 or 1,3, or all"),
        (
            ("--car", "1,2", "--set", "bus.interface=socketcan:vcan0"),
            "bus.interface = 'socketcan:vcan0' with 2 cars on buses: each has a bus of its own",
        ),
    ],
)
def test_buses_that_cannot_be_are_refused(words, message, tmp_path, capsys):
    folder = tmp_path / "run"
    try:
        status = cli.main(
            ["run", "five_coaches", "--pacing", "lockstep", *words, "--out", str(folder)]
        )
    except SystemExit as error:
        status = error.code
    assert status == output.USAGE
    assert message in " ".join(capsys.readouterr().err.split())
    assert not folder.exists()


def test_a_unit_that_fails_is_named_with_its_car(two_coaches, tmp_path, capsys):
    folder = tmp_path / "run"
    # that of car 2 exits at once
    command = f"sh -c 'test {{car}} = 1 && exec {AS_PROGRAM[1]}'"
    words = ["run", *two_coaches, "--pacing", "lockstep", "--car", "all", "--unit", command]
    assert cli.main([*words, "--out", str(folder)]) == output.USAGE
    assert "car 2: " in capsys.readouterr().err
    for number in (1, 2):
        events = [event.code for event in records.events(folder / f"car_{number}")]
        assert "run.failed" in events
        assert (folder / f"car_{number}" / run_folder.SCENARIO).is_file()
