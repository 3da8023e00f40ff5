"""Sequences with a train: they pass, their limits fail with a flaw, and what a train has not is
refused.
"""

import json
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from program import rollerrig

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.commands import output, sequence

PROGRAM = Path(sys.executable).with_name("rollerrig")
AS_PROGRAM = f"{PROGRAM} wsp --bus socketcand://{{host}}:{{port}}/rig0"
NAMES = (
    "five_coaches_low",
    "five_coaches_isolated",
    "five_coaches_sensor_dropout",
    "freight_emergency_forces",
)
# from a low speed, which is a short stop
SLOW = ('speed = "160 km/h"', 'speed = "50 km/h"')


def copy_of(folder, name, *replaced, as_name="flawed"):
    """Return a copy of a packaged sequence with replaced texts, each of which it has."""
    text = store.find("sequences", name).read_text()
    for old, new in replaced:
        assert old in text, old
        text = text.replace(old, new)
    path = folder / f"{as_name}.toml"
    path.write_text(text)
    return path


def play(out, *words):
    """Play sequences; return the status, and what the report has of each by its name."""
    done = rollerrig("sequence", *words, "--out", out, "--json")
    content = json.loads((out / "report.json").read_text())
    return done, {one["name"]: one for one in content["sequences"]}


def values(played):
    return {one["what"]: one["value"] for one in played["verdicts"]}


def failed(played):
    return {one["what"] for one in played["verdicts"] if one["result"] == "fail"}


def test_packaged_sequences_of_trains_pass(tmp_path):
    done, played = play(tmp_path, *NAMES, "--pacing", "free")
    assert done.status == output.PASS, done.messages
    for name in NAMES:
        assert played[name]["error"] is None
        assert played[name]["conditions"]["train"]
    found = values(played["five_coaches_low"])
    # the first coach cleans the rail for the others
    assert 0.8 < found["stop_distance_over_alone"] < 1.0
    isolated = values(played["five_coaches_isolated"])
    assert isolated["coupler_compression"] > 2.0 * found["coupler_compression"]
    events = {one["code"]: one for one in played["five_coaches_sensor_dropout"]["events"]}
    assert events["sequence.step"]["time_s"] == events["fault.begins"]["time_s"] == 1.0
    assert events["fault.begins"]["who"] == "car 2, warning"
    suites = ET.parse(tmp_path / "junit.xml").getroot()
    cases = {case.get("name") for case in suites.iter("testcase")}
    assert "coupler_compression: at most 200 kN" in cases
    page = (tmp_path / "report.html").read_text()
    assert page.count(">Couplers</h2>") == len(NAMES)


def test_limits_of_a_train_fail_with_a_flaw(tmp_path):
    unprotected = copy_of(
        tmp_path,
        "five_coaches_low",
        ('scenario = "five_coaches"', 'scenario = "five_coaches"\nwsp = "none"'),
        as_name="unprotected",
    )
    isolated = copy_of(
        tmp_path,
        "five_coaches_isolated",
        SLOW,
        ("isolated = true", "isolated = true\n[start.tables.car_4]\nisolated = true"),
        ("max = 100.0", "max = 20.0"),
        as_name="isolated_twice",
    )
    # the brake of the heavy half behind has failed: it pushes the other one
    cars = "".join(
        f"[start.tables.car_{n}]\nload_kg = 60000.0\nisolated = true\n" for n in range(6, 11)
    )
    pushing = copy_of(
        tmp_path,
        "freight_emergency_forces",
        ("[[step]]", f"{cars}\n[start.tables.brake]\nlever_ratio = 20.0\n\n[[step]]"),
        as_name="pushing",
    )
    done, played = play(tmp_path / "out", unprotected, isolated, pushing, "--pacing", "free")
    assert done.status == output.FAILED
    assert "longest_lock" in failed(played["unprotected"])
    assert "coupler_compression" in failed(played["isolated_twice"])
    assert "stop_distance_over_alone" in failed(played["isolated_twice"])
    assert failed(played["pushing"]) == {"coupler_compression"}


def test_a_unit_on_a_car_in_lockstep_gives_the_measures_of_the_free_run(tmp_path):
    short = copy_of(
        tmp_path, "five_coaches_sensor_dropout", SLOW, ("max = 1.0", "max = 1.1"), as_name="short"
    )
    free, on_bus, flawed = (tmp_path / name for name in ("free", "lockstep", "flawed"))
    words = (short, "--car", "2")
    _, of_free = play(free, short, "--pacing", "free")
    done, of_unit = play(on_bus, *words, "--unit", AS_PROGRAM)
    assert done.status == output.PASS, done.messages
    assert values(of_unit["short"]) == values(of_free["short"])
    assert of_unit["short"]["unit_played"]["kind"] == "command"
    # a unit that is no unit cannot be judged
    done, of_none = play(flawed, *words, "--unit", "false")
    assert done.status == output.FAILED
    assert of_none["short"]["result"] == "error"


def test_a_programme_plays_sequences_of_a_train(tmp_path):
    short = copy_of(
        tmp_path, "five_coaches_isolated", SLOW, ("max = 1.3", "max = 1.6"), as_name="a"
    )
    assert short.is_file()
    path = tmp_path / "short.toml"
    path.write_text(
        'title = "short"\nsource = "assumption"\nlog = ["sliding", "valve"]\n[[group]]\n'
        'title = "one"\nkind = "mandatory"\nsource = "assumption"\nsequences = ["a.toml"]\n'
    )
    done = rollerrig("programme", path, "--car", "2", "--out", tmp_path / "out", "--json")
    assert done.status == output.PASS, done.messages
    assert json.loads(done.printed)["sequences"] == {"a": "pass"}
    # a part that is done is not played again
    again = json.loads(
        rollerrig("programme", path, "--car", "2", "--out", tmp_path / "out", "--json").printed
    )
    assert again["done_before"] == 1


STEP = '[[step]]\ntitle = "the driver brakes"'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('speed = "160 km/h"', 'speed = "160 km/h"\nmass = "40 t"', "remove mass"),
        (STEP, f"{STEP}\nsand = true", "unknown key 'sand'"),
        (STEP, f"{STEP}\nfriction = {{ mu = 0.05 }}", "friction: a train has no such command"),
        (STEP, f'{STEP}\nfault = "speed_sensor_dropout axle=1"', "write car=N once"),
        (STEP, f'{STEP}\nfault = "speed_sensor_dropout car=6 axle=1"', "it has the cars 1 to 5"),
        (STEP, f'{STEP}\nfault = "speed_sensor_dropout car=2 axle=5"', "axle = 5"),
        (STEP, f'{STEP}\nexpect = "any sliding < 5 m/s"', "a condition of a train is on"),
        ('criteria = "none"', 'criteria = "stop"', "a train has no measure"),
        (
            "[[measure]]",
            f'{STEP}\nset = {{ brake_demand = "1 bar" }}\n[[measure]]',
            "waits `until`",
        ),
        ("[start]", "[start.tables.car_2]\nspeed = 3\n[start]", "unknown key 'speed'"),
    ],
)
def test_what_a_train_cannot_play_is_refused(old, new, message, tmp_path):
    text = store.find("sequences", "five_coaches_low").read_text()
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError, match=message):
        sequence.load([str(path)])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("five_coaches_low", "--bus", "socketcand://localhost:1/rig0"), "leave --bus out"),
        (("emergency_120", "--pacing", "free"), "commands a vehicle over its bus"),
    ],
)
def test_options_that_do_not_fit_a_train_are_refused(words, message, tmp_path, capsys):
    assert cli.main(["sequence", *words, "--out", str(tmp_path / "out")]) == output.USAGE
    assert message in " ".join(capsys.readouterr().err.split())


def test_a_measure_of_a_train_is_none_of_a_vehicle(tmp_path):
    text = store.find("sequences", "dry_120").read_text()
    more = '\n[[measure]]\nmeasure = "coupler_tension"\nunit = "kN"\nmax = 1.0\nsource = "assumption"\n'
    path = tmp_path / "wrong.toml"
    path.write_text(text + more)
    with pytest.raises(ConfigError, match="one vehicle has no measure coupler_tension"):
        sequence.load([str(path)])
