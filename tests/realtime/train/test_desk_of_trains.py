"""The desk runs trains, shows the car that the user chooses, and opens trains by car."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest
from bench_process import until
from desk_process import entered, served

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import channels, records

pytest.importorskip("nicegui", reason="the desk needs nicegui")

from nicegui import events, ui
from test_desk import PATIENCE, simulated

from rollerrig.realtime.desk import desk, library

SHORT = "initial_speed_m_s=5"
# three cars that roll, brake and stop within seconds, with a bus for two of them
WALL = """
vehicle = "uic_z1"
adhesion = "low"
initial_speed_m_s = 4.0
[[demand]]
from_s = 2.0
pressure_Pa = 3.0e5
[train]
[[train.car]]
count = 3
length_m = 26.4
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of a desk with two runs of a train, and a run of one vehicle."""
    place = tmp_path_factory.mktemp("desk")
    for name, more in (("first", ""), ("second", "train.delay_s=0.5")):
        words = ["run", "two_car_unit", "--pacing", "free", "--set", SHORT, "--json"]
        words += ["--out", str(place / "runs" / name)]
        assert cli.main([*words, *(["--set", more] if more else [])]) == output.PASS
    words = ["run", "velim_a1", "--pacing", "free", "--set", SHORT, "--json"]
    assert cli.main([*words, "--out", str(place / "runs" / "coach")]) == output.PASS
    return place


def choose(user, marker, value):
    """Put a value into a field of the page."""
    with user:
        user.find(marker=marker).elements.pop().value = value


def test_a_train_is_one_row_with_the_number_of_its_cars(folder):
    rows = {row["name"]: row for row in library.rows(folder)}
    assert set(rows) == {"runs/first", "runs/second", "runs/coach"}
    assert [rows[f"runs/{name}"]["cars"] for name in ("first", "second", "coach")] == [2, 2, None]
    assert rows["runs/first"]["verdict"] == "valid"
    assert rows["runs/first"]["braking_distance_m"] > 0.0
    # a folder of this name is a car only below a train
    stray = folder / "runs" / "car_1"
    stray.mkdir()
    for file in ("scenario.toml", "summary.json"):
        (stray / file).write_bytes((folder / "runs" / "coach" / file).read_bytes())
    try:
        assert "runs/car_1" in {row["name"] for row in library.rows(folder)}
    finally:
        for file in stray.iterdir():
            file.unlink()
        stray.rmdir()


def test_the_table_of_runs_opens_a_train_by_car(folder):
    one = desk.Desk(folder, own=True)

    async def play(user):
        user.find(marker="tab-Runs").click()
        await user.should_see(marker="verdict-filter", retries=50)
        table = user.find(kind=ui.table, marker="runs").elements.pop()
        car = user.find(kind=ui.select, marker="car").elements.pop()
        assert not car.enabled

        def select(*names):
            with user:
                table.selected = [row for row in table.rows if row["name"] in names]
                chosen = events.TableSelectionEventArguments(
                    sender=table, client=table.client, selection=table.selected
                )
                for handler in table._selection_handlers:
                    events.handle_event(handler, chosen)

        select("runs/first", "runs/second")
        assert list(car.options) == [0, 1, 2]
        assert car.enabled
        user.find(marker="compare").click()
        await user.should_see("whole trains are not compared", retries=50)
        choose(user, "car", 2)
        user.find(marker="compare").click()
        await user.should_see(marker="compared", retries=PATIENCE)
        select("runs/coach")
        assert list(car.options) == [0]
        assert car.value == 0
        user.find(marker="report-of-run").click()
        await user.should_see("runs/coach: this run has no report", retries=50)

    simulated(one, play)


def test_a_report_of_a_train_is_served(folder):
    with served(folder) as running:
        client = entered(running)
        answer = client.get("/file/runs/first/report.html")
        assert answer.status == 200
        assert "<h2>Couplers</h2>" in answer.text


def test_a_train_is_run_from_the_automatic_mode(tmp_path):
    one = desk.Desk(tmp_path, own=True)

    async def play(user):
        user.find(marker="tab-Automatic").click()
        await user.should_see(marker="run-train", retries=50)
        choose(user, "train", "two_car_unit")
        choose(user, "train-more", SHORT)
        user.find(marker="run-train").click()
        for _ in range(PATIENCE):
            if one.programs and one.programs[-1].status is not None:
                break
            await asyncio.sleep(0.1)
        (program,) = one.programs
        assert program.status == 0, (program.error, program.lines)
        await user.should_see(marker="report", retries=100)

    simulated(one, play)
    summary = records.summary(tmp_path / "runs" / "two_car_unit")
    assert summary["initial_speed_m_s"] == 5.0
    # a second run replaces nothing
    program = one.run_train("two_car_unit", "free", "reference", "all", SHORT)
    until(lambda: program.status is not None, "the second run")
    assert program.status == 0, program.error
    assert (tmp_path / "runs" / "two_car_unit-2" / "report.html").is_file()


@pytest.mark.parametrize(
    ("name", "pacing", "unit", "cars", "message"),
    [
        ("velim_a1", "free", "reference", "all", "velim_a1 is no train"),
        (
            "/etc/train.toml",
            "free",
            "reference",
            "all",
            "this desk starts the trains of the library",
        ),
        ("five_coaches", "wall", "reference", "2;", "cars '2;': write numbers of cars"),
        ("five_coaches", "wall", "fmu:unit.fmu", "2", "unit.fmu"),
    ],
)
def test_what_may_not_be_chosen_starts_nothing(name, pacing, unit, cars, message, tmp_path):
    one = desk.Desk(tmp_path, own=True)
    with pytest.raises(ConfigError, match=message):
        one.run_train(name, pacing, unit, cars, "")
    assert one.programs == []


def test_a_train_is_not_prepared_in_the_manual_mode(tmp_path, capsys):
    one = desk.Desk(tmp_path, own=True)
    with pytest.raises(ConfigError, match=r"five_coaches is a train, .* run it under Automatic"):
        asyncio.run(one.prepare("five_coaches", "reference", {}))
    assert one.programs == []
    assert cli.main(["desk", "--scenario", "five_coaches", "--port", "0"]) == output.USAGE
    assert "--scenario five_coaches: is a train" in capsys.readouterr().err


def test_the_desk_shows_the_car_of_a_train_that_the_user_chooses(tmp_path):
    (tmp_path / "short.toml").write_text(WALL, encoding="utf-8")
    one = desk.Desk(tmp_path, own=True)

    async def play(user):
        one.run_train("short.toml", "wall", "reference", "1,3", "")
        for _ in range(PATIENCE):
            if len(one.cars) == 2 and one.bench.points > 4:
                break
            await asyncio.sleep(0.1)
        assert [car.car for car in one.cars] == [1, 3], one.programs[0].lines
        assert one.bench.car == 1
        await user.should_see(marker="car-shown", retries=50)
        choose(user, "car-shown", 3)
        assert one.bench.car == 3
        assert one.bench.name.endswith(", car 3")
        with pytest.raises(ConfigError, match=r"car 2 has no bus in this run; .* 1, 3"):
            one.show_car(2)
        (program,) = one.programs
        for _ in range(PATIENCE):
            if program.status is not None:
                break
            await asyncio.sleep(0.1)
        assert program.status in (0, 4), (program.error, program.lines)
        await asyncio.sleep(0.3)

    simulated(one, play)
    # what the desk has shown of car 3 is what was recorded of car 3
    recorded = channels.Columns(tmp_path / "runs" / "short" / "car_3")
    names = one.bench.columns.names
    shown_m = float(one.bench.newest[names.index("position_m")])
    assert shown_m == pytest.approx(channels.values(recorded["position_m"])[-1], abs=0.1)
    first = channels.Columns(tmp_path / "runs" / "short" / "car_1")
    assert abs(shown_m - channels.values(first["position_m"])[-1]) > 20.0
    assert np.isfinite(one.cars[0].newest).any()
    summary = json.loads((Path(tmp_path) / "runs" / "short" / "summary.json").read_text())
    assert len(summary["cars"]) == 3
