"""The whole explanation, on stops of a generator that shares no code with it."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from generator import braking_stops, mujoco_stops, other_stops

from rollerrig.realtime.bench import scenario
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.decide import decision, evidence, extended_model
from rollerrig.rig.mechanisms import applied as effects

pytestmark = pytest.mark.explanation


def silent(title: str, share: float) -> None:
    """No progress."""


def test_stops_with_nothing_hidden_are_consistent() -> None:
    found = decision.explain_braking_runs(dataset.load("open_none"), 0, silent)
    assert found.verdict == "consistent"
    assert found.causes == []
    assert found.gain is None


def test_cleaning_by_leading_wheels_is_named_and_improves_runs_never_fitted() -> None:
    found = decision.explain_braking_runs(dataset.load("open_rail_cleaning"), 0, silent)
    assert found.verdict == "explained"
    assert [named.finding.name for named in found.causes] == ["rail_cleaning"]
    assert found.gain is not None
    assert found.gain.claimed
    assert found.gain.reduction > 0.05
    for before, after, low, high in found.gain.by_run.values():
        assert low < 1.0 - after / before < high
    squares = np.square([errors[:2] for errors in found.gain.by_run.values()])
    assert min(squares[:, 0]) <= found.gain.before**2 <= max(squares[:, 0])


def test_an_irregularity_of_longer_waves_is_not_told_as_a_patch(tmp_path: Path) -> None:
    # a dip of 4 % on 36 m of this rail, once told as one; it is there in all runs
    found = decision.explain_braking_runs(
        dataset.load(braking_stops.make(tmp_path / "none", {}, 61002)), 0, silent
    )
    assert found.verdict == "consistent"


def test_a_long_memory_and_one_larger_wheel_of_another_form_are_both_named(tmp_path: Path) -> None:
    folder = other_stops.make(
        tmp_path / "two", {"adhesion_memory": 4.0, "wheel_radius": 0.001}, 63001
    )
    found = decision.explain_braking_runs(dataset.load(folder), 0, silent)
    assert [named.finding.name for named in found.causes] == ["adhesion_memory", "wheel_radius"]
    memory, wheel = (extended_model.parameters(named) for named in found.causes)
    assert memory["length_m"]["value"] == pytest.approx(4.0, abs=1.0)
    assert wheel["fraction"]["ci95"][0] < 0.001 < wheel["fraction"]["ci95"][1]
    model = tmp_path / "extended.toml"
    model.write_text(extended_model.toml(found))
    # every cause of this one is in the plant
    assert "not in the plant" not in model.read_text()
    params = scenario.load("velim_a1", str(model)).params
    assert params.effects.memory_m == pytest.approx(memory["length_m"]["value"], rel=1e-4)
    assert np.ptp(params.wheels.table[:4]) > 0.0  # radii


def test_a_brake_that_is_stronger_in_half_of_the_runs_only_is_not_explained_by_a_stronger_brake(
    tmp_path: Path,
) -> None:
    folder = mujoco_stops.make(tmp_path / "half", {"brake_gain": 0.06}, 14)
    plain = mujoco_stops.make(tmp_path / "none", {}, 14)
    for run in ("long_2", "short_2", "check_2"):
        shutil.copy(plain / "runs" / f"{run}.csv", folder / "runs")
    found = decision.explain_braking_runs(dataset.load(folder), 0, silent)
    assert found.verdict in ("partly", "unexplained")
    clear = {f.name for f in found.remainder if evidence.is_significant(f, 20.0)}
    assert "along the runs in the size of brake_gain" in clear


def test_a_wheel_clock_that_runs_behind_is_not_told_as_a_late_sensor(tmp_path: Path) -> None:
    folder = mujoco_stops.make(tmp_path / "clock", {"wheel_clock_drift": 0.0012}, 15)
    found = decision.explain_braking_runs(dataset.load(folder), 0, silent)
    assert found.verdict == "unexplained"
    assert found.causes == []
    # 1.2 ms more in every second: a delay that has another size as time goes on
    worst = max(found.remainder, key=lambda f: f.statistic)
    assert worst.name == "along time in the size of speed_sensor_delay"


def test_a_cause_outside_the_library_is_unexplained_and_gets_a_formula(tmp_path: Path) -> None:
    folder = braking_stops.make(tmp_path / "joints", {"joints": 0.12}, 12)
    found = decision.explain_braking_runs(dataset.load(folder), 0, silent)
    assert found.verdict == "unexplained"
    assert found.causes == []
    assert found.unknown is not None
    # the rail of this generator has a dip every 30 m
    assert found.unknown.cause.shape["period"] == pytest.approx(30.0, rel=0.02)
    assert found.gain is not None
    assert found.gain.claimed
    model = tmp_path / "extended.toml"
    model.write_text(extended_model.toml(found))
    params = scenario.load("velim_a1", str(model)).params
    effect = dict(zip(effects.PLACE, params.effects.values, strict=True))
    assert effect["empirical_covariate"] == 3
    assert effect["empirical_period"] == pytest.approx(
        found.unknown.cause.shape["period"], rel=1e-4
    )


def test_a_drop_under_the_first_wheelset_at_some_moment_is_not_told_as_cleaning(
    tmp_path: Path,
) -> None:
    folder = other_stops.make(tmp_path / "drop", {"one_axle_drop": 0.12}, 24002)
    found = decision.explain_braking_runs(dataset.load(folder), 0, silent)
    assert found.verdict == "unexplained"
    worst = max(found.remainder, key=lambda f: f.statistic)
    assert (worst.name, worst.axle) == ("along time of one axle", 1)
