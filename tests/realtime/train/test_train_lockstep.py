"""A train in lockstep: a unit on the bus of one car, reference units in all others."""

import sys
from pathlib import Path

import pytest
from recorded_runs import differing, run

from rollerrig.realtime import cli
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import records, run_folder

# a brake that demands more than the rail has, so that the units act
WORDS = ("five_coaches", "--set", "initial_speed_m_s=22", "--set", "brake.lever_ratio=3.5")
LOCKSTEP = ("--pacing", "lockstep", "--car", "2")
PROGRAM = Path(sys.executable).with_name("rollerrig")
AS_PROGRAM = f"{PROGRAM} wsp --bus socketcand://{{host}}:{{port}}/rig0"


def test_lockstep_is_equal_to_the_free_run_and_repeats_to_the_byte(tmp_path, capsys):
    free, first, second = (tmp_path / name for name in ("free", "first", "second"))
    of_free = run(free, capsys, *WORDS, "--pacing", "free")
    on_bus = run(first, capsys, *WORDS, *LOCKSTEP)
    run(second, capsys, *WORDS, *LOCKSTEP, "--unit", AS_PROGRAM)
    assert on_bus["valid"]
    assert on_bus["cars_on_bus"] == [2]
    assert on_bus["bus"]["frames"] > 1000
    assert on_bus["cars"][1]["vents"] > 0
    assert on_bus["braking_distance_m"] == of_free["braking_distance_m"]
    assert differing(free, first) == []
    # another program with the same unit sends the same frames at the same simulated times
    assert differing(first, second) == []
    logs = [(folder / "car_2" / run_folder.CAN_LOG).read_text() for folder in (first, second)]
    magnets = [[line for line in log.splitlines() if " 211#" in line] for log in logs]
    assert magnets[0]
    assert magnets[0] == magnets[1]
    summary = records.summary(second)
    assert summary["unit_played"]["kind"] == "command"
    assert (second / "report.html").is_file()


def test_a_unit_that_fails_ends_the_run_with_its_words(tmp_path, capsys):
    folder = tmp_path / "run"
    status = cli.main(["run", *WORDS, *LOCKSTEP, "--unit", "false", "--out", str(folder)])
    assert status == output.USAGE
    assert "exited with status 1" in capsys.readouterr().err
    events = [event.code for event in records.events(folder / "car_2")]
    assert "run.failed" in events


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--pacing", "lockstep", "--car", "6"), "--car 6: five_coaches has 5 cars"),
        (("--pacing", "lockstep", "--wsp", "none"), "--wsp none with --pacing lockstep: a train"),
        (("--pacing", "free", "--wsp", "external"), "--wsp external with --pacing free: a train"),
    ],
)
def test_what_lockstep_cannot_do_is_refused(words, message, tmp_path, capsys):
    folder = tmp_path / "run"
    status = cli.main(["run", "five_coaches", *words, "--out", str(folder)])
    assert status == output.USAGE
    assert message in " ".join(capsys.readouterr().err.split())


def test_a_car_without_a_unit_has_no_bus(tmp_path, capsys):
    words = ["run", "freight_ten_wagons", "--pacing", "lockstep", "--out", str(tmp_path / "run")]
    assert cli.main(words) == output.USAGE
    assert "this car of freight_ten_wagons has unit = 'none'" in capsys.readouterr().err
