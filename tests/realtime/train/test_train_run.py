"""`rollerrig run` with a train: its folder, channels and report, and the options it refuses."""

import json

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import channels, records, run_folder

# a short stop of a packaged train
WORDS = ("run", "four_car_unit", "--pacing", "free", "--set", "initial_speed_m_s=10", "--json")


def run(folder, capsys, *more):
    status = cli.main([*WORDS, "--out", str(folder), *more])
    return status, json.loads(capsys.readouterr().out)


def test_a_run_of_a_train_is_a_folder_with_a_folder_for_each_car(tmp_path, capsys):
    status, result = run(tmp_path / "run", capsys)
    assert status == output.PASS
    assert result["valid"]
    assert result["stopped"]
    assert len(result["cars"]) == 4
    assert len(result["couplers"]) == 3
    assert len(result["axles"]) == 16
    assert [car["axles"] for car in result["cars"]] == [[1, 4], [5, 8], [9, 12], [13, 16]]
    assert result["wsp"]["vents"] == sum(car["vents"] for car in result["cars"])
    assert result["alone"]["braking_distance_m"] > 0.0

    recorded = records.load(tmp_path / "run")
    names = recorded.table.column_names
    assert {"time_s", "vehicle_speed_m_s", "car_2_speed_m_s", "coupler_1_N"} <= set(names)
    assert "sliding_16_m_s" in names
    assert "sliding_17_m_s" not in names
    # axle 6 of the train is axle 2 of the second car, whose record is one of a vehicle
    car = records.load(tmp_path / "run" / "car_2")
    assert np.array_equal(recorded.column("sliding_6_m_s"), car.column("sliding_2_m_s"))
    assert car.kind.axles == 4
    assert car.summary["valid"]

    page = (tmp_path / "run" / "report.html").read_text()
    assert "couplers" in page.lower()
    assert page.count("<svg") == 4
    # the record of a car is what other verbs open
    cars = [str(tmp_path / "run" / f"car_{number}") for number in (1, 2)]
    assert cli.main(["compare", *cars]) == output.PASS
    assert cli.main(["compare", str(tmp_path / "run"), str(tmp_path / "run")]) == output.USAGE
    assert "is a train" in capsys.readouterr().err


def test_the_resolved_train_repeats_the_run_to_the_byte(tmp_path, capsys):
    first, second = tmp_path / "first", tmp_path / "second"
    assert run(first, capsys)[0] == output.PASS
    words = ["run", str(first / run_folder.SCENARIO), "--pacing", "free", "--out", str(second)]
    assert cli.main(words) == output.PASS
    a, b = (channels.load(folder) for folder in (first, second))
    assert a.column_names == b.column_names
    for name in a.column_names:
        assert a[name].equals(b[name]), name
    hashes = [records.summary(folder)["config_hash"] for folder in (first, second)]
    assert hashes[0] == hashes[1]


def test_a_fault_of_a_car_is_in_the_events_of_the_car_and_of_the_train(tmp_path, capsys):
    path = tmp_path / "faulty.toml"
    path.write_text(
        "initial_speed_m_s = 5.0\n[[demand]]\npressure_Pa = 3e5\n[[train.car]]\n[[train.car]]\n"
        "[[train.car.fault]]\nkind = 'hold_magnet_stuck'\naxle = 1\nat_s = 0.5\n"
        "[[train.car.fault]]\nkind = 'hold_magnet_stuck'\naxle = 2\nat_s = 500.0\n"
    )
    folder = tmp_path / "run"
    words = ["run", str(path), "--pacing", "free", "--json", "--out", str(folder)]
    assert cli.main(words) == output.PASS
    events = json.loads(capsys.readouterr().out)["events"]
    assert [(one["car"], one["code"]) for one in events] == [
        (2, "fault.begins"),
        (2, "fault.never_began"),
    ]
    assert [event.code for event in records.events(folder / "car_1")] == []
    assert len(records.events(folder / "car_2")) == 2


def test_a_shorter_train_in_the_same_folder_leaves_no_car_of_the_longer_one(tmp_path, capsys):
    folder = tmp_path / "run"
    for name, cars in (("four_car_unit", 4), ("two_car_unit", 2)):
        words = ["run", name, "--pacing", "free", "--set", "initial_speed_m_s=3"]
        assert cli.main([*words, "--out", str(folder), "--replace"]) == output.PASS
        capsys.readouterr()
        assert len(list(folder.glob("car_*"))) == cars


def test_without_units_wheels_slide_more(tmp_path, capsys):
    # a brake that demands more than this rail has
    faster = ("--set", "initial_speed_m_s=25", "--set", "brake.lever_ratio=2.5")
    _, with_units = run(tmp_path / "with", capsys, *faster)
    _, without = run(tmp_path / "without", capsys, *faster, "--wsp", "none")
    assert without["wsp"] == {"unit": "none", "active_s": 0.0, "vents": 0}
    slid = [
        np.mean([axle["sliding_mean_m_s"] for axle in result["axles"]])
        for result in (with_units, without)
    ]
    assert slid[1] > slid[0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--pacing", "wall", "--live"), "--live: a train does not have this yet"),
        (("--pacing", "free", "--live"), "--live: a train does not have this yet"),
        (("--pacing", "free", "--fault", "bus_off node=1 at=1"), "--fault: a train does not"),
        (("--pacing", "free", "--also-without-wsp"), "--also-without-wsp: a train does not"),
    ],
)
def test_options_that_a_train_does_not_have_are_refused(words, message, tmp_path, capsys):
    folder = tmp_path / "run"
    status = cli.main(["run", "four_car_unit", *words, "--out", str(folder)])
    assert status == output.USAGE
    assert message in " ".join(capsys.readouterr().err.split())
    assert not folder.exists()


def test_a_report_is_of_a_train_only(tmp_path):
    from rollerrig.realtime.reports import train

    with pytest.raises(ConfigError, match="is not the run of a train"):
        train.write(tmp_path)
