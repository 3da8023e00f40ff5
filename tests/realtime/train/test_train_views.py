"""A train in Rerun and in pictures: what is drawn is what was recorded, car by car."""

import numpy as np
import pytest
import rerun as rr
from drawn_samples import entities

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import cars, records, run_folder
from rollerrig.realtime.reports import train as report
from rollerrig.realtime.telemetry import train_view, viewer, views
from rollerrig.realtime.train import plan

CARS = 4
# the second car has a fault, so that the train has an event
FAULT = """
[[train.car.fault]]
kind = "hold_magnet_stuck"
axle = 1
at_s = 0.5
"""


@pytest.fixture(autouse=True)
def strict():
    """Let Rerun raise its errors; by default it only logs them."""
    rr.set_strict_mode(True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a short stop of a packaged train on a rail that its wheels clean."""
    place = tmp_path_factory.mktemp("train")
    text = plan.find("four_car_unit").read_text(encoding="utf-8")
    first, second, *_ = text.split("[[train.car]]")
    (place / "faulty.toml").write_text(
        text.replace(second, second + FAULT.strip() + "\n\n", 1), encoding="utf-8"
    )
    assert first
    words = ["run", str(place / "faulty.toml"), "--pacing", "free", "--json"]
    out = place / "run"
    words += ["--set", "initial_speed_m_s=25", "--set", "brake.lever_ratio=2.5", "--out", str(out)]
    assert cli.main(words) == output.PASS
    return out


@pytest.fixture(scope="module")
def run(folder):
    return records.load(folder)


@pytest.fixture(scope="module")
def drawn(folder):
    return entities(folder / run_folder.RRD)


def scalars(drawn, path):
    """Return the values of an entity, shape (n, series)."""
    return np.array([value for _, value in drawn[path]["Scalars:scalars"]])


def shades(drawn, path, shape):
    """Return times (n,) and colours (n, shapes, 3) of an entity, as red, green and blue."""
    samples = drawn[path][f"{shape}:colors"]
    packed = np.array([value for _, value in samples], dtype=np.int64)
    of_rgb = np.stack([packed >> 24 & 255, packed >> 16 & 255, packed >> 8 & 255], axis=-1)
    return np.array([time_s for time_s, _ in samples]), of_rgb


def test_the_plots_of_cars_and_axles_have_the_recorded_values(drawn, run):
    assert np.allclose(scalars(drawn, "/train/speed")[:, 0], 3.6 * run.column("vehicle_speed_m_s"))
    forces_kN = scalars(drawn, "/train/couplers")
    assert forces_kN.shape[1] == CARS - 1
    assert np.allclose(forces_kN[:, 1], 1e-3 * run.column("coupler_2_N"))
    third = scalars(drawn, "/car_3/pressures")
    for seat, axle in enumerate(range(9, 13)):
        assert np.allclose(third[:, seat], 1e-5 * run.column(f"cylinder_pressure_{axle}_Pa"))
    means = np.mean([run.column(f"sliding_{axle}_m_s") for axle in range(9, 13)], axis=0)
    assert np.allclose(scalars(drawn, "/train/sliding")[:, 2], means)
    states = [value[0] for _, value in drawn["/car_2/valves/axle_5"]["StateChange:state"]]
    recorded = run.column("valve_5")
    assert len(states) == 1 + np.count_nonzero(np.diff(recorded))
    assert "vent" in states


def test_wheels_are_redder_the_more_they_slip(drawn, run):
    times_s, colours = shades(drawn, f"{train_view.ROW}/car_1/wheels", "Points2D")
    assert colours.shape[1] == 4
    green = colours[:, 1, 1]
    at = np.searchsorted(run.column("time_s"), times_s)
    speed_m_s = run.column("vehicle_speed_m_s")[at]
    slip = np.abs(run.column("sliding_2_m_s")[at]) / np.maximum(speed_m_s, 1.0)
    assert slip.max() > 0.1
    assert green[np.argmax(slip)] < green[0]
    rolls = slip < 0.005
    assert np.all(green[rolls] >= green[0] - 5)


def test_the_drawn_rail_is_light_behind_the_wheels_that_have_cleaned_it(drawn, run):
    rail = cars.rail(run.column, cars.cars(run.summary))
    ahead, behind = rail.friction[0], rail.friction[-1]
    known = np.isfinite(behind)
    # far from the start of the stop all axles have cleaned the place
    last = np.flatnonzero(known)[-1]
    assert behind[last] > 1.1 * ahead[last]
    assert np.nanmax(ahead) - np.nanmin(ahead) < 1e-9

    times_s, colours = shades(drawn, f"{train_view.ROW}/rail", "LineStrips2D")
    middle = np.searchsorted(times_s, 0.5 * times_s[-1])
    blue = colours[middle, :, 2]
    # ahead of the train it is as found, below the last car it is clean
    assert np.array_equal(colours[middle, 0], train_view.DIRTY)
    assert blue[-1] > blue[0] + 100
    # before the brakes act it is as found everywhere
    assert np.all(colours[0] == colours[0, 0])


def test_places_of_cars_and_wheelsets_are_those_of_the_train(run):
    train = plan.read(run.scenario, run.folder / "scenario.toml")
    of_train = cars.cars(run.summary)
    assert len(of_train) == CARS
    assert of_train[-1].front_m + of_train[-1].length_m == pytest.approx(train.length_m)
    for car, of_plan in zip(of_train, train.cars, strict=True):
        positions_m = of_plan.plan.params.axle_position_m
        assert np.allclose(np.subtract(car.wheelsets_m, car.wheelsets_m[0]), positions_m)
        # a car's wheelsets are in its middle
        before_m = car.wheelsets_m[0] - car.front_m
        after_m = car.front_m + car.length_m - car.wheelsets_m[-1]
        assert before_m == pytest.approx(after_m)
        first = run.column(f"car_{car.number}_position_m")[0]
        assert first == pytest.approx(of_train[0].wheelsets_m[0] - car.wheelsets_m[0])


def test_an_event_is_drawn_with_its_car(drawn):
    texts = [value[0] for _, value in drawn[views.EVENTS]["TextLog:text"]]
    assert any("car 1: " in text and "hold_magnet_stuck" in text for text in texts)


def test_a_recording_that_is_lost_is_drawn_again(folder, tmp_path):
    file = folder / run_folder.RRD
    before = file.read_bytes()
    file.unlink()
    assert viewer.recording_file(folder) == file
    assert file.stat().st_size > 0.5 * len(before)


@pytest.mark.parametrize("kind", ["svg", "png", "pdf"])
def test_a_picture_of_a_train_shows_its_cars_and_couplers(kind, folder, tmp_path, capsys):
    picture = tmp_path / f"stop.{kind}"
    assert cli.main(["view", str(folder), "--png", str(picture)]) == output.PASS
    assert picture.stat().st_size > 10_000
    if kind == "svg":
        text = picture.read_text(encoding="utf-8")
        words = ("car 4", "speed,", "couplers, kN,", "mean friction of", "brake demand")
        for word in words:
            assert word in text
        assert "car 5" not in text
    exported = tmp_path / "exported.svg"
    words = ["export", str(folder), "--format", "svg", "--out", str(exported)]
    assert cli.main(words) == output.PASS
    assert "couplers, kN," in exported.read_text(encoding="utf-8")


def test_the_channels_of_a_train_are_exported_with_their_units(folder, run, tmp_path):
    out = tmp_path / "train.csv"
    assert cli.main(["export", str(folder), "--format", "csv", "--out", str(out)]) == output.PASS
    names, units, first, *_ = (line.split(",") for line in out.read_text().splitlines())
    unit_of = dict(zip(names, units, strict=True))
    assert unit_of["coupler_1_N"] == "N"
    assert unit_of["coupler_1_m"] == "m"
    assert unit_of["car_2_speed_m_s"] == unit_of["sliding_16_m_s"] == "m/s"
    assert unit_of["car_2_acceleration_m_s2"] == "m/s^2"
    assert unit_of["adhesion_9"] == ""
    assert float(first[names.index("car_3_position_m")]) == run.column("car_3_position_m")[0]


def test_a_train_is_drawn_alone(folder, tmp_path, capsys):
    car = str(folder / "car_1")
    words = ["view", str(folder), car, "--png", str(tmp_path / "both.svg")]
    assert cli.main(words) == output.USAGE
    assert "is the run of a train, which is drawn alone" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="is the run of a train, which is shown alone"):
        viewer.overlay([folder, folder], tmp_path / "both.rrd")


def test_the_report_shows_the_rail_place_by_place_where_wheels_have_cleaned_it(folder, tmp_path):
    page = report.write(folder).read_text(encoding="utf-8")
    assert page.count("<svg") == 4
    assert "The rail place by place" in page
    assert "friction of the contaminant mu_cd" in page
    # without cleaning the rail is the same everywhere, which needs no picture
    out = tmp_path / "dirty"
    words = ["run", "two_car_unit", "--pacing", "free", "--set", "initial_speed_m_s=5"]
    words += ["--set", "mechanisms.rail_cleaning_gain=0", "--out", str(out), "--json"]
    assert cli.main(words) == output.PASS
    dirty = (out / "report.html").read_text(encoding="utf-8")
    assert "The rail place by place" not in dirty
    assert dirty.count("<svg") == 3


def test_a_summary_of_one_vehicle_has_no_cars(folder):
    with pytest.raises(ConfigError, match="does not have the cars of a train"):
        cars.cars(records.summary(folder / "car_1"))
