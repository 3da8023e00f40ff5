"""Faults hidden in stops of the bench over the bus are found in the recordings alone."""

import functools
import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from bench_process import BenchProcess
from generator import diagnoses

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime import cli
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.datasets import run_dataset, run_sensors
from rollerrig.realtime.record import records
from rollerrig.realtime.reports import cause_sentences, extended_model
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.preparation import prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide import evidence, fitting
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.mechanisms import applied
from rollerrig.rig.plant import Plant

SPEEDS_M_S = (16.0, 12.0, 14.0)


def run_stops(folder: Path, *hidden: str, pacing: str = "lockstep") -> list[str]:
    """Run stops, all at a time; in lockstep the reference unit is in a separate process."""
    benches = [
        BenchProcess(
            folder / f"from_{speed:g}",
            "--pacing",
            pacing,
            "--set",
            "stand_s=0",
            "--set",
            f"initial_speed_m_s={speed}",
            *hidden,
        )
        for speed in SPEEDS_M_S
    ]
    for bench in benches:
        assert bench.finish().status == 0, bench.stderr
        if pacing == "lockstep":
            assert bench.result["bus"]["frames"] > 1000
    return [str(bench.out) for bench in benches]


def explain(runs: list[str], out: Path, capsys: pytest.CaptureFixture[str]) -> dict:
    """Return the report on runs, after the check that standard output and file are the same."""
    assert cli.main(["explain", *runs, "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((out / "report.json").read_text())
    return report


@pytest.mark.nightly
@pytest.mark.explanation
def test_stops_of_a_fault_free_bench_over_the_bus_are_consistent(tmp_path, capsys) -> None:
    report = explain(run_stops(tmp_path), tmp_path / "report", capsys)
    assert report["verdict"] == "consistent"
    assert report["causes"] == []


ANOTHER_DIAMETER = "wheel_diameter_mismatch axle=3 difference_percent=1"


def test_a_unit_that_assumes_another_diameter_has_a_speed_sensor_of_wrong_scale(tmp_path) -> None:
    runs = run_stops(tmp_path, "--fault", ANOTHER_DIAMETER, pacing="free")
    data = dataset.load(run_dataset.from_folders(list(map(Path, runs)), tmp_path / "set"))
    design = prepare(data, data.runs)
    base = fitting.fit(design, candidates.untuned(design)).explanation
    normal, *_ = fitting.normal_equations(design, base)
    cause, *_ = evidence.most_promising(design, normal, 6)
    # the brake of this wheelset acts at the stated radius
    assert (cause.name, cause.axle) == ("sensor_scale", 3)
    # the fit of the base has taken a part of the fraction of -0.01
    assert -0.011 < cause.values[0] < -0.001


@pytest.mark.nightly
@pytest.mark.explanation
def test_a_wheel_of_another_diameter_hidden_in_stops_over_the_bus_is_found(
    tmp_path, capsys
) -> None:
    runs = run_stops(tmp_path, "--fault", ANOTHER_DIAMETER)
    report = explain(runs, tmp_path / "report", capsys)
    cause = report["causes"][0]
    # at 1 % the data may not distinguish it from a wheel of another radius
    assert "sensor_scale" in {cause["name"], *cause["confusable_with"]}
    assert cause["name"] in ("sensor_scale", "wheel_radius")
    assert cause["axles"] == [3]
    assert abs(cause["parameters"]["fraction"]["value"]) == pytest.approx(0.01, abs=5e-4)


@pytest.mark.nightly
@pytest.mark.explanation
@pytest.mark.parametrize(("axle", "fraction"), [(2, -0.02), (4, 0.02)])
def test_a_wheel_whose_radius_is_far_off_is_the_only_cause(
    tmp_path, capsys, axle: int, fraction: float
) -> None:
    # more than the creepage of the largest adhesion: the linearised replay shows a tenth of it
    settings = (
        f"mechanisms.wheel_radius_axle={axle}",
        f"mechanisms.wheel_radius_fraction={fraction}",
    )
    runs = run_stops(tmp_path, "--set", settings[0], "--set", settings[1])
    report = explain(runs, tmp_path / "report", capsys)
    [cause] = report["causes"]
    assert cause["name"] == "wheel_radius"
    assert cause["axles"] == [axle]
    assert cause["parameters"]["fraction"]["value"] == pytest.approx(fraction, abs=5e-4)


# --- runs as measured data ---


@pytest.fixture(scope="module")
def stop(tmp_path_factory) -> Path:
    """A short stop on rollers without a bus, recorded a thousand times a second."""
    bench = BenchProcess(
        tmp_path_factory.mktemp("short") / "stop",
        "--pacing",
        "free",
        "--set",
        "initial_speed_m_s=12",
        "--set",
        "loop.record_hz=1000",
        "--set",
        "stand_s=0",
    )
    assert bench.finish().status == 0, bench.stderr
    return bench.out


def copied(stop: Path, folder: Path, every: int, **changed: float) -> Path:
    """A copy of a run with every n-th row and changed values (table__key) of its scenario."""
    import pyarrow.parquet as pq
    import tomli_w

    run = records.load(stop)
    folder.mkdir()
    rows = np.arange(0, len(run.table), every)
    pq.write_table(run.table.take(rows), folder / "channels.parquet")
    plan = run.scenario
    for key, value in changed.items():
        table, _, name = key.partition("__")
        plan[table][name] = value
    (folder / "scenario.toml").write_text(tomli_w.dumps(plan))
    records.write_summary(folder, run.summary)
    return folder


def test_the_sensors_of_a_fault_free_bench_measure_what_acts(stop: Path) -> None:
    run = records.load(stop)
    measured = run_sensors.of_run(run, 1.0)
    step = round(run_sensors.SAMPLE_TIME_S / 0.001)
    n = len(measured.time_s)
    # the torque of a brake jumps where its wheel locks, below the speed at which the WSP cuts off;
    # no sensor of limited bandwidth follows a jump
    slowest_rad_s = np.min([run.column(f"wheel_speed_{j}_rad_s") for j in (1, 2, 3, 4)], axis=0)
    turning = int(np.argmax(slowest_rad_s[::step] < 1.0))
    assert turning > 0.8 * n
    inside = slice(5, turning - 5)
    for j in range(4):
        torque_Nm = run.column(f"brake_torque_{j + 1}_Nm")[::step][:n]
        torque_error_Nm = np.abs(measured.torque_Nm[inside, j] - torque_Nm[inside])
        assert torque_error_Nm.max() < 0.01 * torque_Nm.max()
        load_N = run.column(f"wheel_load_{j + 1}_N")[::step][:n]
        load_error_N = np.abs(measured.load_N[inside, j] - load_N[inside])
        assert load_error_N.max() < 0.002 * load_N.max()
        surface_m_s = run.column(f"roller_speed_{j + 1}_rad_s")[::step][:n]
        assert np.abs(measured.surface_m_s[inside, j] - surface_m_s[inside]).max() < 2e-3


def test_thinned_samples_have_no_frequencies_folded_down(stop: Path, tmp_path: Path) -> None:
    run = records.load(copied(stop, tmp_path / "run", 1))
    ripple = 0.2 * np.sin(2.0 * np.pi * 97.0 * run.column("time_s"))
    at = run.table.column_names.index("measured_speed_1_rad_s")
    clean = run_sensors.of_run(run, 1.0).wheel_speed_rad_s[:, 0]
    table = run.table.set_column(
        at, "measured_speed_1_rad_s", [run.column("measured_speed_1_rad_s") + ripple]
    )
    rippled = run_sensors.of_run(run._replace(table=table), 1.0).wheel_speed_rad_s[:, 0]
    inside = slice(20, -20)
    assert np.abs(rippled - clean)[inside].max() < 0.01


@pytest.mark.parametrize("record_hz", [100, 1000])
def test_the_delay_of_a_pole_wheel_is_the_same_in_all_channels(
    tmp_path: Path, record_hz: int
) -> None:
    bench = BenchProcess(
        tmp_path / "stop",
        "--pacing",
        "free",
        "--set",
        "initial_speed_m_s=12",
        "--set",
        f"loop.record_hz={record_hz}",
        "--set",
        "sensor.model=pole_wheel",
    )
    assert bench.finish().status == 0, bench.stderr
    run = bench.record
    # a vehicle that moves exactly as wheel 1 turns must be measured in step with it
    at = run.table.column_names.index("vehicle_speed_m_s")
    table = run.table.set_column(at, "vehicle_speed_m_s", [run.column("wheel_speed_1_rad_s")])
    measured = run_sensors.of_run(run._replace(table=table), 6.0)
    off = (measured.wheel_speed_rad_s[:, 0] - measured.speed_m_s)[20:-20]
    rate = np.gradient(measured.speed_m_s, run_sensors.SAMPLE_TIME_S)[20:-20]
    assert off.std() < run_sensors.NOISE["wheel_speed_rad_s"]
    delay_s = np.dot(off, rate) / np.dot(rate, rate)
    assert abs(delay_s) < 5e-4


def test_on_a_virtual_track_the_wheels_are_those_of_the_track(tmp_path: Path) -> None:
    bench = BenchProcess(
        tmp_path / "stop",
        "--pacing",
        "free",
        "--set",
        "initial_speed_m_s=12",
        "--set",
        "rig=virtual_track",
    )
    assert bench.finish().status == 0, bench.stderr
    measured = run_sensors.of_run(bench.record, 4.0)
    n = len(measured.time_s)
    assert measured.surface_m_s is None
    for j in range(4):
        sliding = measured.speed_m_s - 0.445 * measured.wheel_speed_rad_s[:, j]
        np.testing.assert_allclose(
            sliding, bench.record.column(f"sliding_{j + 1}_m_s")[:n], atol=1e-9
        )


def test_a_coarse_recording_is_refused(stop: Path, tmp_path: Path) -> None:
    run = records.load(copied(stop, tmp_path / "run", 100))
    with pytest.raises(ConfigError, match="record_hz"):
        run_sensors.of_run(run, 1.0)


@pytest.mark.parametrize("verb", ["explain", "tune", "validate"])
def test_a_study_that_is_refused_leaves_no_folder(stop: Path, tmp_path: Path, capsys, verb) -> None:
    coarse = str(copied(stop, tmp_path / "run", 100))
    out = tmp_path / "reports" / "new"
    assert cli.main([verb, coarse, "--out", str(out)]) == 2
    assert "record_hz" in capsys.readouterr().err
    assert not out.parent.exists()

    # what a user has in a folder stays
    (out / "dataset").mkdir(parents=True)
    (out / "dataset" / "notes.txt").write_text("mine")
    assert cli.main([verb, coarse, "--out", str(out)]) == 2
    assert [path.name for path in out.rglob("*")] == ["dataset", "notes.txt"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({}, "same samples"),
        ({"contact__roller_radius_m": 0.5}, "roller_radius_m"),
        ({"adhesion__tau_m_J": 1e-4}, "tau_m_J"),
    ],
)
def test_runs_that_cannot_be_judged_together_are_refused(
    stop: Path, tmp_path: Path, changed: dict[str, float], message: str
) -> None:
    other = copied(stop, tmp_path / "run", 1, **changed)
    with pytest.raises(ConfigError, match=message):
        run_dataset.from_folders([stop, other], tmp_path / "out")


def test_runs_of_different_mass_make_one_dataset_in_which_each_keeps_its_mass(
    stop: Path, tmp_path: Path
) -> None:
    other = copied(stop, tmp_path / "run", 10, vehicle__mass_kg=48000.0)
    out = run_dataset.from_folders([stop], tmp_path / "out", [other], run_sensors.NOISE, 1.0)
    data = dataset.load(out)
    assert [run.mass_kg for run in data.runs] == [43000.0, 48000.0]
    assert [run.group for run in data.runs] == ["tune", "validate"]
    assert data.sample_time_s == pytest.approx(0.01)
    assert data.runs[0].surface_m_s is not None
    radius_m = records.load(stop).scenario["contact"]["roller_radius_m"]
    assert data.sections["contact"]["roller_radius_m"] == radius_m


def test_a_dataset_of_runs_has_their_vehicle_and_their_brake(stop: Path, tmp_path: Path) -> None:
    changed = {
        "vehicle__bogie_wheelbase_m": 2.9,
        "vehicle__body_height_m": 2.1,
        "brake__pad_friction": 0.3,
    }
    other = copied(stop, tmp_path / "run", 10, **changed)
    sections = dataset.load(
        run_dataset.from_folders([other], tmp_path / "out", (), run_sensors.NOISE, 1.0)
    ).sections
    for key, value in changed.items():
        table, name = key.split("__")
        assert sections[table][name] == value
    plan = records.load(other).scenario
    # a list of TOML is a tuple in a dataset
    assert sections["brake"] == plan["brake"] | {"axle_factors": ()}
    assert plan["brake"]["axle_factors"] == []
    plan["vehicle_set"] = "trams/mine.toml"  # a file that the dataset cannot find
    run = run_sensors.of_run(records.load(other), 1.0)
    out = run_dataset.write(tmp_path / "elsewhere", [run], plan, run_sensors.NOISE, title="a test")
    assert "uic_z1" not in (out / "dataset.toml").read_text()
    assert dataset.load(out).sections == sections


@pytest.mark.parametrize(("adhesion", "is_noted"), [("low", True), ("soap", False)])
def test_cleaning_that_the_adhesion_of_the_package_includes_is_a_note(
    stop: Path, tmp_path: Path, adhesion: str, is_noted: bool
) -> None:
    run = copied(stop, tmp_path / "run", 1)
    plan = tomllib.loads((run / "scenario.toml").read_text())
    text = (run / "scenario.toml").read_text()
    used = f'adhesion_set = "{plan["adhesion_set"]}"'
    assert used in text
    (run / "scenario.toml").write_text(text.replace(used, f'adhesion_set = "{adhesion}"'))
    out = run_dataset.from_folders([run], tmp_path / "out")
    assert ("cleaning of the rail" in (out / "dataset.toml").read_text()) == is_noted


def test_runs_to_validate_are_accepted_with_runs_only(tmp_path: Path, capsys) -> None:
    assert (
        cli.main(["explain", "open_none", "--validate", str(tmp_path), "--out", str(tmp_path)]) == 2
    )
    assert "dataset.toml" in capsys.readouterr().err


# --- the extended model ---

CAUSES = {
    "adhesion_memory": Cause("adhesion_memory", 0, {"speed_power": 1.0}, (3.0,)),
    "wheel_out_of_round": Cause("wheel_out_of_round", 2, {}, (0.03, 0.04)),
    "wheel_radius": Cause("wheel_radius", 3, {}, (0.01,)),
    "wheel_inertia": Cause("wheel_inertia", 1, {}, (0.25,)),
    "speed_sensor_delay": Cause("speed_sensor_delay", 0, {}, (0.025,)),
}


@functools.cache
def open_none() -> Dataset:
    return dataset.load("open_none")


def diagnosis_of(*causes: Cause) -> Diagnosis:
    """The diagnosis that `explain` would return if it had found these causes."""
    found = [diagnoses.identified(cause) for cause in causes]
    return diagnoses.diagnosis(open_none(), found, runs=1)


@pytest.mark.parametrize("name", CAUSES)
def test_every_cause_of_wheel_and_contact_becomes_keys_that_run_in_batch(name, tmp_path) -> None:
    model = tmp_path / "extended.toml"
    model.write_text(extended_model.toml(diagnosis_of(CAUSES[name])))
    keys = tomllib.loads(model.read_text()).get("mechanisms", {})
    settings = ("initial_speed_m_s=6.0",)
    plan = scenario.load("velim_a1", str(model), settings)
    extended = free.channels(free.simulate(plan), plan.table)
    without = scenario.load("velim_a1", settings=settings)
    plain = free.channels(free.simulate(without), without.table)
    differs = not np.array_equal(extended["wheel_speed_2_rad_s"], plain["wheel_speed_2_rad_s"])
    if name == "speed_sensor_delay":
        assert keys == {}
        assert not differs
        return

    assert differs
    wheels = plan.params.wheels
    effects = plan.params.effects
    radius_m, inertia_kgm2, _, swing = wheels.table.reshape(4, 4)
    if name == "adhesion_memory":
        assert (effects.memory_m, effects.memory_power) == pytest.approx((3.0, 1.0))
    elif name == "wheel_out_of_round":
        assert swing == pytest.approx(np.array([0.0, 0.05, 0.0, 0.0]))
        assert wheels.swing_phase_rad == pytest.approx(-np.arctan2(0.04, 0.03))
    elif name == "wheel_radius":
        assert radius_m / 0.445 == pytest.approx(np.array([1.0, 1.0, 1.01, 1.0]))
    else:
        assert name == "wheel_inertia"
        assert inertia_kgm2 / 160.0 == pytest.approx(np.array([1.25, 1.0, 1.0, 1.0]))


def test_friction_of_the_contaminant_alone_is_reported_in_words_and_does_not_change_the_clean_rail(
    tmp_path,
) -> None:
    found = diagnosis_of(Cause("friction_trend", 0, {"contaminant_alone": 1.0}, (-0.05,)))
    sentence = cause_sentences.story(found)[0]
    assert (
        "in a stop, only in the friction of the contaminant [friction_trend]; rate_1_s" in sentence
    )
    model = tmp_path / "extended.toml"
    model.write_text(extended_model.toml(found))
    params = scenario.load("velim_a1", str(model)).params
    rig = Plant(params, 20.0)
    rig.state.time[0] = 4.0
    factors = [
        applied.friction_factor(rig.state, 0, 0.0, params.effects, clean) for clean in (False, True)
    ]
    assert factors == pytest.approx([np.exp(-0.2), 1.0])


def test_a_late_speed_sensor_is_noted_with_the_fault_that_does_it_on_the_bus() -> None:
    text = extended_model.toml(diagnosis_of(CAUSES["speed_sensor_delay"]))
    fault = catalogue.parse(re.search(r"--fault '([^']+)'", text).group(1), COACH)
    assert fault.values["delay_s"] == pytest.approx(0.025)
    assert fault.values["can_id"] == 0x190  # speeds of all axles
    on_one_axle = CAUSES["speed_sensor_delay"]._replace(axle=2)
    text = extended_model.toml(diagnosis_of(on_one_axle))
    assert "--fault" not in text
    assert "cannot" in text


def test_an_extended_model_is_the_same_plant_in_batch_and_in_the_bench(tmp_path) -> None:
    model = tmp_path / "extended.toml"
    model.write_text(extended_model.toml(diagnosis_of(*CAUSES.values())))
    settings = ("initial_speed_m_s=8.0", "stand_s=0.0")
    bench = BenchProcess(
        tmp_path / "run",
        "--model",
        str(model),
        "--pacing",
        "lockstep",
        *(part for one in settings for part in ("--set", one)),
    )
    assert bench.finish().status == 0, bench.stderr
    plan = scenario.load("velim_a1", str(model), settings)
    batch = free.channels(free.simulate(plan), plan.table)
    run = bench.record
    assert run.column("transition_1").max() > 0.0
    for name in (
        "vehicle_speed_m_s",
        "wheel_speed_1_rad_s",
        "wheel_speed_3_rad_s",
        "wheel_load_2_N",
        "transition_1",
        "cylinder_pressure_4_Pa",
    ):
        assert np.array_equal(run.column(name), batch[name]), name
