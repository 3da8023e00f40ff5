"""The whole explanation, on stops of a generator that shares no code with it."""

from pathlib import Path

import numpy as np
import pytest
from generator import braking_stops, other_stops

from rollerrig.realtime import scenario
from rollerrig.rig.identify import dataset, explain, extension


def silent(title: str, share: float) -> None:
    """No progress."""


def test_stops_with_nothing_hidden_are_consistent() -> None:
    found = explain.braking_runs(dataset.load("open_none"), 0, silent)
    assert found.verdict == "consistent"
    assert found.causes == []
    assert found.gain is None


def test_cleaning_by_leading_wheels_is_named_and_improves_runs_never_fitted() -> None:
    found = explain.braking_runs(dataset.load("open_rail_cleaning"), 0, silent)
    assert found.verdict == "explained"
    assert [named.finding.name for named in found.causes] == ["rail_cleaning"]
    assert found.gain is not None
    assert found.gain.claimed
    assert found.gain.reduction > 0.05


@pytest.mark.parametrize(("cause", "seed"), [("wheel_radius", 11)])
def test_a_hidden_cause_of_another_form_is_named(tmp_path: Path, cause: str, seed: int) -> None:
    size = 1.5 * braking_stops.SMALLEST[cause]
    folder = braking_stops.make(tmp_path / cause, {cause: size}, seed)
    found = explain.braking_runs(dataset.load(folder), 0, silent)
    assert cause in {n.finding.name for n in found.causes} | {
        other for n in found.causes for other in n.confusable}
    model = tmp_path / "extended.toml"
    model.write_text(extension.toml(found))
    # every cause of this one is in the plant
    assert "not in the plant" not in model.read_text()
    wheels = scenario.load("velim_a1", str(model)).params.wheels
    if cause in {n.finding.name for n in found.causes}:
        assert np.ptp(wheels.table[:4]) > 0.0  # radii


def test_a_cause_outside_the_library_is_unexplained_and_gets_a_formula(tmp_path: Path) -> None:
    folder = braking_stops.make(tmp_path / "joints", {"joints": 0.12}, 12)
    found = explain.braking_runs(dataset.load(folder), 0, silent)
    assert found.verdict == "unexplained"
    assert found.causes == []
    assert found.unknown is not None
    # the rail of this generator has a dip every 30 m
    assert found.unknown.cause.shape["period"] == pytest.approx(30.0, rel=0.02)
    assert found.gain is not None
    assert found.gain.claimed
    model = tmp_path / "extended.toml"
    model.write_text(extension.toml(found))
    params = scenario.load("velim_a1", str(model)).params
    assert params.effects.empirical == 3
    assert params.effects.period == pytest.approx(found.unknown.cause.shape["period"], rel=1e-4)


def test_a_drop_under_the_first_wheelset_at_some_moment_is_not_told_as_cleaning(tmp_path: Path) -> None:
    folder = other_stops.make(tmp_path / "drop", {"one_axle_drop": 0.12}, 24002)
    found = explain.braking_runs(dataset.load(folder), 0, silent)
    assert found.verdict == "unexplained"
    worst = max(found.remainder, key=lambda f: f.statistic)
    assert (worst.name, worst.axle) == ("along time of one axle", 1)
