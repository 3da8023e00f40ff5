"""The file of a train: its cars, its brake control, how it reads again, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs import store, toml_text
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.train import plan, stop

COACHES = {
    "vehicle": "uic_z1",
    "adhesion": "low",
    "initial_speed_m_s": 20.0,
    "demand": [{"from_s": 0.5, "pressure_Pa": 3.0e5}],
}


def read(train, **changes):
    return plan.read({**COACHES, **changes, "train": train}, Path("train.toml"))


@pytest.mark.parametrize("name", plan.names())
def test_every_packaged_train_stops_and_reads_again_as_the_same_train(name, tmp_path):
    settings = ("initial_speed_m_s=8.0",)
    train = plan.load(name, settings=settings)
    path = tmp_path / "again.toml"
    path.write_text(plan.dump(train))
    again = plan.load(str(path))
    first, second = (stop.simulate(one).samples() for one in (train, again))
    assert first.cars[0]["vehicle_speed_m_s"][-1] == 0.0
    assert np.array_equal(first.force_N, second.force_N)
    for a, b in zip(first.cars, second.cars, strict=True):
        assert np.array_equal(a["position_m"], b["position_m"])
        assert np.array_equal(a["sliding_1_m_s"], b["sliding_1_m_s"])


def test_the_demand_reaches_car_after_car_and_never_an_isolated_one():
    train = read(
        {
            "delay_s": 0.1,
            "delay_of_car_s": 0.2,
            "car": [{"count": 2}, {"isolated": True}, {}],
        }
    )
    cars = stop.simulate(train).samples().cars
    for number, delay_s in ((0, 0.1), (1, 0.3), (3, 0.7)):
        demand = cars[number]["brake_demand_Pa"]
        begins_s = cars[number]["time_s"][np.flatnonzero(demand)[0]]
        assert begins_s == pytest.approx(0.5 + delay_s, abs=0.011)
    assert np.all(cars[2]["brake_torque_1_Nm"] == 0.0)


def test_the_brake_pipe_brakes_the_rear_later_and_pushes_the_front():
    train = read(
        {"control": "brake_pipe", "pipe_speed_m_s": 100.0, "car": [{"count": 8, "unit": "none"}]},
        adhesion="dry",
    )
    run = stop.simulate(train)
    samples = run.samples()
    begins_s = [
        one["time_s"][np.flatnonzero(one["brake_demand_Pa"] > 1e3)[0]] for one in samples.cars
    ]
    length_m = train.cars[7].front_m - train.cars[0].front_m
    assert begins_s[7] - begins_s[0] == pytest.approx(length_m / 100.0, abs=0.2)
    # the rear runs into the front
    assert run.link.extremes_N[:, 1].min() < -5e3
    assert samples.pipe_Pa[-1] == pytest.approx(5e5 - 3.0 / 3.8 * 1.5e5, rel=1e-2)


def test_a_load_weighs_on_the_axles_and_is_braked_where_the_vehicle_weighs():
    train = read({"car": [{}, {"load_kg": 20000.0}]}, vehicle="freight_wagon", pads="cast_iron")
    empty, laden = stop.simulate(train, unit="none").samples().cars
    assert laden["wheel_load_1_N"][0] == pytest.approx(42.0 / 22.0 * empty["wheel_load_1_N"][0])
    shares = [one["brake_demand_Pa"].max() / 3.0e5 for one in (empty, laden)]
    assert shares == pytest.approx([0.3, 42.0 / 90.0], rel=0.02)


def test_all_cars_run_on_the_rail_of_the_first_one():
    train = read({"car": [{}, {"load_kg": 20000.0}]})
    friction = {car.plan["adhesion"]["mu_cd"] for car in train.cars}
    assert len(friction) == 1
    alone = scenario.read({**COACHES, "rig": "plain_track"}, Path("car.toml"))
    assert friction == {alone["adhesion"]["mu_cd"]}


CAR = {"car": [{}]}


@pytest.mark.parametrize(
    ("train", "changes", "message"),
    [
        ({}, {}, "has 0 cars; allowed are 1 to 16"),
        ({"car": [{"count": 16}, {}]}, {}, "has 17 cars; allowed are 1 to 16"),
        ({"car": [{"vehicel": "uic_z1"}]}, {}, "unknown key 'vehicel'; did you mean 'vehicle"),
        ({"car": [{"loop": {"tick_hz": 500}}]}, {}, "is the same for all cars"),
        # a coupler is only needed between two cars
        ({"car": [{}, {}], "coupler": "screws"}, {}, "no coupler is called|did you mean"),
        ({**CAR, "emergency": [{"from_s": 1.0}]}, {}, 'allowed with control = "brake_pipe"'),
        (
            {**CAR, "control": "brake_pipe", "emergency": [{"from_s": 1.0, "car": 2}]},
            {},
            "car = 2, but it has 1 cars",
        ),
        (
            {**CAR, "control": "brake_pipe", "pipe_full_demand_Pa": 1e5},
            {},
            r"write \[\[train.emergency\]\]",
        ),
        ({"car": [{"length_m": 10.0}]}, {}, "is not more than the 21.56 m"),
        (CAR, {"rig": "full_scale"}, "rig.mode = contaminated_rollers"),
        (CAR, {"rig": "virtual_track"}, "rig.mode = virtual_track"),
        (CAR, {"fault": [{"kind": "speed_sensor_stuck", "axle": 1}]}, r"\[\[train.car.fault\]\]"),
        (
            {"car": [{"fault": [{"kind": "bus_off", "node": 17, "at_s": 1.0}]}]},
            {},
            "acts on the bus",
        ),
        (CAR, {"friction": [{"from_s": 1.0, "mu_cd": 0.1, "axles": [1]}]}, "remove axles"),
        (CAR, {"contact": {"model": "polach"}}, "contact.model"),
    ],
)
def test_what_a_train_does_not_have_is_refused_by_name(train, changes, message):
    with pytest.raises(ConfigError, match=message) as caught:
        read(train, **changes)
    assert "train.toml" in str(caught.value) or "coupler" in str(caught.value)


def test_other_verbs_refuse_a_train_by_name(tmp_path):
    path = tmp_path / "train.toml"
    path.write_text(store.find("trains", "five_coaches").read_text())
    assert plan.find(str(path)) == path
    with pytest.raises(ConfigError, match=r"has a table \[train\], and this is for one vehicle"):
        scenario.load(str(path))
    assert plan.find("velim_a1") is None


def test_settings_reach_the_train_and_its_cars():
    train = plan.load("five_coaches", settings=("train.delay_of_car_s=0.3", "adhesion.mu_cd=0.05"))
    starts = [car.plan["demand"][0]["from_s"] for car in train.cars]
    assert np.diff(starts) == pytest.approx(0.3)
    assert {car.plan["adhesion"]["mu_cd"] for car in train.cars} == {0.05}
    assert toml_text.parse(plan.dump(train), "dump")["train"]["delay_of_car_s"] == 0.3


@pytest.mark.parametrize("car", ["car_3", "train.car.3"])
def test_a_setting_of_one_car_reaches_it_alone_and_one_of_nothing_is_refused(car):
    train = plan.load("five_coaches", settings=(f"{car}.isolated=true",))
    assert [one.given["isolated"] for one in train.cars] == [False, False, True, False, False]
    with pytest.raises(ConfigError, match=r"unknown key 'nonsense'"):
        plan.load("five_coaches", settings=(f"{car}.nonsense=5",))
    with pytest.raises(ConfigError, match=r"allowed are keys of \[train\].*car_2.load_kg"):
        plan.load("five_coaches", settings=("train.coupler.slack_m=5",))


def test_a_fault_acts_in_its_car_alone_and_reads_again(tmp_path):
    fault = {"kind": "vent_magnet_stuck", "axle": 2, "at_s": 1.0}
    train = read({"car": [{}, {"fault": [fault]}, {}]}, adhesion="dry")
    run = stop.simulate(train)
    cars = run.samples().cars
    assert [one["vents_2"][-1] for one in cars] == [0.0, 1.0, 0.0]
    begins_s = cars[1]["time_s"][np.flatnonzero(cars[1]["vents_2"])[0]]
    assert begins_s == pytest.approx(1.0, abs=0.06)
    assert [[event.code for event in one.events] for one in run.cars] == [
        [],
        ["fault.begins"],
        [],
    ]
    path = tmp_path / "again.toml"
    path.write_text(plan.dump(train))
    again = stop.simulate(plan.load(str(path))).samples().cars
    assert np.array_equal(again[1]["position_m"], cars[1]["position_m"])


def test_a_false_sensor_in_one_car_lengthens_the_stop_less_than_in_a_car_alone():
    faults = [{"kind": "speed_sensor_dropout", "axle": axle, "at_s": 0.6} for axle in (3, 4)]
    changes = {"initial_speed_m_s": 25.0, "brake": {"lever_ratio": 2.5}}

    def way_m(cars):
        position_m = stop.simulate(read({"car": cars}, **changes)).samples().cars[0]["position_m"]
        return position_m[-1] - position_m[0]

    alone = way_m([{"fault": faults}]) / way_m([{}])
    in_train = way_m([{}, {"fault": faults}, {"count": 2}]) / way_m([{"count": 4}])
    assert alone > 1.02
    assert 1.0 < in_train < alone
