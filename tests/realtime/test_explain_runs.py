"""Faults hidden in stops of the bench over the bus are found in the recordings alone."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from bench_process import BenchProcess

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime import cli
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.datasets import run_dataset, run_sensors
from rollerrig.realtime.record import records
from rollerrig.realtime.reports import cause_report as report
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data import dataset, preparation
from rollerrig.rig.identify.decide import choice, decision, extended_model
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.mechanisms import applied
from rollerrig.rig.plant import Plant

SPEEDS_M_S = (16.0, 12.0, 14.0)


def stops(folder: Path, *hidden: str) -> list[str]:
    """Stops in lockstep with the reference unit in its own process, all at a time."""
    going = [
        BenchProcess(
            folder / f"from_{speed:g}",
            "--pacing",
            "lockstep",
            "--set",
            "stand_s=0",
            "--set",
            f"initial_speed_m_s={speed}",
            *hidden,
        )
        for speed in SPEEDS_M_S
    ]
    for bench in going:
        assert bench.finish().status == 0, bench.stderr
        assert bench.told["bus"]["frames"] > 1000
    return [str(bench.out) for bench in going]


def explained(runs: list[str], out: Path, capsys: pytest.CaptureFixture[str]) -> dict:
    assert cli.main(["explain", *runs, "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads((out / "report.json").read_text())
    return told


@pytest.mark.explanation
def test_stops_of_a_sound_bench_over_the_bus_are_consistent(tmp_path, capsys) -> None:
    told = explained(stops(tmp_path), tmp_path / "report", capsys)
    assert told["verdict"] == "consistent"
    assert told["causes"] == []


@pytest.mark.explanation
def test_a_wheel_of_another_diameter_hidden_in_stops_over_the_bus_is_found(
    tmp_path, capsys
) -> None:
    told = explained(
        stops(tmp_path, "--fault", "wheel_diameter_mismatch axle=3 difference_percent=1"),
        tmp_path / "report",
        capsys,
    )
    assert told["causes"][0]["name"] == "wheel_radius"
    assert told["causes"][0]["axles"] == [3]
    assert told["causes"][0]["parameters"]["fraction"]["value"] == pytest.approx(0.01, abs=5e-4)


# --- what the recording becomes ---


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


def rerecorded(stop: Path, folder: Path, every: int, **changed: float) -> Path:
    """A copy of the run with every n-th row and changed values of its scenario's tables."""
    import pyarrow.parquet as pq
    import tomli_w

    run = records.load(stop)
    folder.mkdir()
    pq.write_table(run.table.take(np.arange(0, len(run.table), every)), folder / "channels.parquet")
    plan = run.scenario
    for key, value in changed.items():
        table, _, name = key.partition("__")
        plan[table][name] = value
    (folder / "scenario.toml").write_text(tomli_w.dumps(plan))
    records.write_summary(folder, run.summary)
    return folder


def test_what_the_sensors_tell_is_what_acts_on_a_sound_bench(stop: Path) -> None:
    run = records.load(stop)
    told = run_sensors.of_run(run, 1.0)
    step = round(run_sensors.SAMPLE_TIME_S / 0.001)
    n = len(told.time_s)
    inside = slice(5, n - 5)
    for j in range(4):
        truth = run.column(f"brake_torque_{j + 1}_Nm")[::step][:n]
        assert np.abs(told.torque_Nm[inside, j] - truth[inside]).max() < 0.01 * truth.max()
        load = run.column(f"wheel_load_{j + 1}_N")[::step][:n]
        assert np.abs(told.load_N[inside, j] - load[inside]).max() < 0.002 * load.max()
        surface = run.column(f"roller_speed_{j + 1}_rad_s")[::step][:n]
        assert np.abs(told.surface_m_s[inside, j] - surface[inside]).max() < 2e-3


def test_thinned_samples_have_no_frequencies_folded_down(stop: Path, tmp_path: Path) -> None:
    run = records.load(rerecorded(stop, tmp_path / "run", 1))
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
def test_what_a_pole_wheel_tells_late_is_told_as_late_of_all_channels(
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
    # a vehicle that moves exactly as wheel 1 turns must be told in step with it
    at = run.table.column_names.index("vehicle_speed_m_s")
    table = run.table.set_column(at, "vehicle_speed_m_s", [run.column("wheel_speed_1_rad_s")])
    told = run_sensors.of_run(run._replace(table=table), 6.0)
    off = (told.wheel_speed_rad_s[:, 0] - told.speed_m_s)[20:-20]
    rate = np.gradient(told.speed_m_s, run_sensors.SAMPLE_TIME_S)[20:-20]
    assert off.std() < run_sensors.NOISE["wheel_speed_rad_s"]
    assert abs(np.dot(off, rate) / np.dot(rate, rate)) < 5e-4


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
    told = run_sensors.of_run(bench.record, 4.0)
    n = len(told.time_s)
    assert told.surface_m_s is None
    for j in range(4):
        sliding = told.speed_m_s - 0.445 * told.wheel_speed_rad_s[:, j]
        np.testing.assert_allclose(
            sliding, bench.record.column(f"sliding_{j + 1}_m_s")[:n], atol=1e-9
        )


def test_a_coarse_recording_is_refused(stop: Path, tmp_path: Path) -> None:
    run = records.load(rerecorded(stop, tmp_path / "run", 100))
    with pytest.raises(ConfigError, match="record_hz"):
        run_sensors.of_run(run, 1.0)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, "same samples"),
        ({"contact__roller_radius_m": 0.5}, "roller_radius_m"),
        ({"adhesion__tau_m_J": 1e-4}, "tau_m_J"),
    ],
)
def test_runs_that_cannot_be_judged_together_are_refused(
    stop: Path, tmp_path: Path, changed, said
) -> None:
    other = rerecorded(stop, tmp_path / "run", 1, **changed)
    with pytest.raises(ConfigError, match=said):
        run_dataset.from_folders([stop, other], tmp_path / "out")


def test_runs_of_another_mass_stand_in_one_dataset_each_with_its_own(
    stop: Path, tmp_path: Path
) -> None:
    other = rerecorded(stop, tmp_path / "run", 10, vehicle__mass_kg=48000.0)
    out = run_dataset.from_folders([stop], tmp_path / "out", [other], run_sensors.NOISE, 1.0)
    data = dataset.load(out)
    assert [run.mass_kg for run in data.runs] == [43000.0, 48000.0]
    assert [run.group for run in data.runs] == ["tune", "validate"]
    assert data.sample_time_s == pytest.approx(0.01)
    assert data.runs[0].surface_m_s is not None


def test_a_dataset_of_runs_has_their_vehicle_and_their_brake(stop: Path, tmp_path: Path) -> None:
    own = {
        "vehicle__bogie_wheelbase_m": 2.9,
        "vehicle__body_height_m": 2.1,
        "brake__pad_friction": 0.3,
    }
    other = rerecorded(stop, tmp_path / "run", 10, **own)
    sections = dataset.load(
        run_dataset.from_folders([other], tmp_path / "out", (), run_sensors.NOISE, 1.0)
    ).sections
    for key, value in own.items():
        table, name = key.split("__")
        assert sections[table][name] == value
    plan = records.load(other).scenario
    assert sections["brake"] == plan["brake"]
    plan["vehicle_set"] = "trams/mine.toml"  # which lies where nobody will look for it
    run = run_sensors.of_run(records.load(other), 1.0)
    out = run_dataset.write(tmp_path / "elsewhere", [run], plan, run_sensors.NOISE, title="a test")
    assert "uic_z1" not in (out / "dataset.toml").read_text()
    assert dataset.load(out).sections == sections


def test_runs_to_validate_are_only_named_beside_runs(tmp_path: Path, capsys) -> None:
    assert (
        cli.main(["explain", "open_none", "--validate", str(tmp_path), "--out", str(tmp_path)]) == 2
    )
    assert "dataset.toml" in capsys.readouterr().err


# --- what was found as a model ---

FOUND = {
    "adhesion_memory": Cause("adhesion_memory", 0, {"speed_power": 1.0}, (3.0,)),
    "wheel_out_of_round": Cause("wheel_out_of_round", 2, {}, (0.03, 0.04)),
    "wheel_radius": Cause("wheel_radius", 3, {}, (0.01,)),
    "wheel_inertia": Cause("wheel_inertia", 1, {}, (0.25,)),
    "speed_sensor_delay": Cause("speed_sensor_delay", 0, {}, (0.025,)),
}


def account(*causes: Cause) -> decision.Diagnosis:
    """What `explain` would hand over had it found these causes."""
    data = dataset.load("open_none")
    design = preparation.prepare(data, data.group("tune")[:1])
    base = candidates.untuned(design)
    named = []
    for cause in causes:
        tiny, none = (1e-6,) * len(cause.values), (0.0,) * len(cause.values)
        finding = ScoreTest(
            cause.name, cause.axle, cause.shape, cause.values, none, tiny, 99.0, 0.001, 1.0, 1.0
        )
        named.append(choice.IdentifiedCause(finding, cause, 99.0, (99.0,) * 5, tiny, (), ()))
    return decision.Diagnosis(
        data,
        design,
        None,
        base,
        base._replace(causes=causes),
        "explained",
        named,
        [],
        [],
        [],
        None,
        0.001,
        [],
        None,
        1.0,
    )


@pytest.mark.parametrize("name", FOUND)
def test_every_cause_of_wheel_and_contact_becomes_keys_that_run_in_batch(name, tmp_path) -> None:
    model = tmp_path / "extended.toml"
    model.write_text(extended_model.toml(account(FOUND[name])))
    told = tomllib.loads(model.read_text()).get("mechanisms", {})
    plan = scenario.load("velim_a1", str(model), ("initial_speed_m_s=6.0",))
    felt = free.channels(free.simulate(plan))
    plain = free.channels(
        free.simulate(scenario.load("velim_a1", settings=("initial_speed_m_s=6.0",)))
    )
    differs = not np.array_equal(felt["wheel_speed_2_rad_s"], plain["wheel_speed_2_rad_s"])
    if name == "speed_sensor_delay":
        assert told == {}
        assert not differs
        return
    wheels, effects = plan.params.wheels, plan.params.effects
    radius_m, inertia_kgm2, _, swing = wheels.table.reshape(4, 4)
    assert differs
    assert {
        "adhesion_memory": (effects.memory_m, effects.memory_power) == pytest.approx((3.0, 1.0)),
        "wheel_out_of_round": swing == pytest.approx(np.array([0.0, 0.05, 0.0, 0.0]))
        and wheels.swing_phase_rad == pytest.approx(-np.arctan2(0.04, 0.03)),
        "wheel_radius": radius_m / 0.445 == pytest.approx(np.array([1.0, 1.0, 1.01, 1.0])),
        "wheel_inertia": inertia_kgm2 / 160.0 == pytest.approx(np.array([1.25, 1.0, 1.0, 1.0])),
    }[name]


def test_friction_of_the_contaminant_alone_is_told_in_words_and_leaves_the_clean_rail_as_it_is(
    tmp_path,
) -> None:
    found = account(Cause("friction_trend", 0, {"contaminant_alone": 1.0}, (-0.05,)))
    assert (
        "in a stop, that of the contaminant alone [friction_trend]; rate_1_s"
        in report.story(found)[0]
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
    told = extended_model.toml(account(FOUND["speed_sensor_delay"]))
    fault = catalogue.parse(re.search(r"--fault '([^']+)'", told).group(1))
    assert fault.values["delay_s"] == pytest.approx(0.025)
    assert fault.values["can_id"] == 0x190  # speeds of all axles
    alone = extended_model.toml(account(FOUND["speed_sensor_delay"]._replace(axle=2)))
    assert "--fault" not in alone
    assert "cannot" in alone


def test_an_extended_model_is_the_same_plant_in_batch_and_in_the_bench(tmp_path) -> None:
    model = tmp_path / "extended.toml"
    model.write_text(extended_model.toml(account(*FOUND.values())))
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
    felt, run = free.channels(free.simulate(plan)), bench.record
    assert run.column("transition_1").max() > 0.0
    for name in (
        "vehicle_speed_m_s",
        "wheel_speed_1_rad_s",
        "wheel_speed_3_rad_s",
        "wheel_load_2_N",
        "transition_1",
        "cylinder_pressure_4_Pa",
    ):
        assert np.array_equal(run.column(name), felt[name]), name
