"""The whole explanation, on stops of generators that share no code with it.

`make test` has one that finds nothing, of the runs that show it in the shortest time. A tutorial
and `tests/realtime/test_explain_runs.py` explain stops by a cause. `test_verdicts.py` has the law
of the verdicts, and `test_empirical.py` the formula for what no cause explains.
"""

import shutil
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
from generator import braking_stops, mujoco_stops, other_stops
from tiers import first_of

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.reports import extended_model
from rollerrig.rig import vehicle
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.decide import decision, estimates, evidence
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.mechanisms import applied as effects

pytestmark = pytest.mark.explanation


def silent(title: str, share: float) -> None:
    """No progress."""


def explain(dataset_name: str | Path, runs: Collection[str] = ()) -> Diagnosis:
    """Return the diagnosis of a dataset, or of the runs of these names in it."""
    data = dataset.load(dataset_name)
    if runs:
        data = data._replace(runs=[run for run in data.runs if run.name in runs])
    return decision.explain_braking_runs(data, 0, silent)


def names_of_causes(diagnosis: Diagnosis) -> list[str]:
    return [identified.score_test.name for identified in diagnosis.causes]


@pytest.mark.parametrize("runs", first_of([("a3", "b3"), ()]), ids=["two", "all"])
def test_stops_with_nothing_hidden_are_consistent(runs: Collection[str]) -> None:
    diagnosis = explain("open_none", runs)
    assert diagnosis.verdict == "consistent"
    assert diagnosis.causes == []
    assert diagnosis.gain is None


@pytest.mark.nightly
@pytest.mark.parametrize("runs", [("a3", "b2", "b3"), ()], ids=["three", "all"])
def test_cleaning_by_leading_wheels_is_identified_and_improves_runs_never_fitted(
    runs: Collection[str],
) -> None:
    diagnosis = explain("open_rail_cleaning", runs)
    assert diagnosis.verdict == "explained"
    assert names_of_causes(diagnosis) == ["rail_cleaning"]

    gain = diagnosis.gain
    assert gain is not None
    assert gain.claimed
    assert gain.reduction > 0.05
    for before, after, low, high in gain.by_run.values():
        assert low < 1.0 - after / before < high
    squares_before = [of_run.before**2 for of_run in gain.by_run.values()]
    assert min(squares_before) <= gain.before**2 <= max(squares_before)


@pytest.mark.nightly
def test_a_softer_contact_is_identified_and_what_its_form_leaves_is_reported_with_it(
    tmp_path: Path,
) -> None:
    folder = braking_stops.make(tmp_path / "layer", {"interfacial_layer": 0.9}, 107191)
    diagnosis = explain(folder, ("a2", "a3", "b3"))
    assert diagnosis.verdict == "partly"
    assert names_of_causes(diagnosis) == ["interfacial_layer"]
    assert any(evidence.is_significant(test, 20.0) for test in diagnosis.remainder)


@pytest.mark.nightly
def test_an_irregularity_of_longer_waves_is_not_reported_as_a_patch(tmp_path: Path) -> None:
    # this rail has a dip of 4 % over 36 m, in all runs, which was reported as a patch before
    diagnosis = explain(braking_stops.make(tmp_path / "none", {}, 61002))
    assert diagnosis.verdict == "consistent"


@pytest.mark.nightly
def test_a_long_memory_and_one_larger_wheel_of_another_form_are_both_identified(
    tmp_path: Path,
) -> None:
    folder = other_stops.make(
        tmp_path / "two", {"adhesion_memory": 4.0, "wheel_radius": 0.001}, 63001
    )
    diagnosis = explain(folder)
    assert names_of_causes(diagnosis) == ["adhesion_memory", "wheel_radius"]
    memory, wheel = (estimates.parameters(cause) for cause in diagnosis.causes)
    assert memory["length_m"].value == pytest.approx(4.0, abs=1.0)
    assert wheel["fraction"].low < 0.001 < wheel["fraction"].high

    model = tmp_path / "extended.toml"
    model.write_text(extended_model.toml(diagnosis))
    # the plant has both causes
    assert "not in the plant" not in model.read_text()
    params = scenario.load("velim_a1", str(model)).params
    assert params.effects.memory_m == pytest.approx(memory["length_m"].value, rel=1e-4)
    assert np.ptp(params.wheels.table[vehicle.RADIUS_M]) > 0.0


@pytest.mark.nightly
def test_a_wrong_scale_of_a_speed_sensor_is_a_cause_and_a_wrong_radius_is_another(
    tmp_path: Path,
) -> None:
    wrong_scale = shutil.copytree(dataset.find("open_none"), tmp_path / "scale")
    for run in wrong_scale.glob("runs/*.csv"):
        names, *rows = [line.split(",") for line in run.read_text().splitlines()]
        at = names.index("wheel_speed_2_rad_s")
        for row in rows:
            row[at] = repr(1.015 * float(row[at]))
        run.write_text("\n".join(",".join(row) for row in [names, *rows]) + "\n")
    [scale] = explain(wrong_scale).causes
    assert (scale.cause.name, scale.cause.axle) == ("sensor_scale", 2)
    size = estimates.parameters(scale)["fraction"]
    assert size.low < 0.015 < size.high

    wrong_radius = braking_stops.make(tmp_path / "radius", {"wheel_radius": 0.015}, 107_200)
    radius, *_ = explain(wrong_radius).causes
    assert radius.cause.name == "wheel_radius"


@pytest.mark.nightly
def test_a_brake_that_is_stronger_in_half_of_the_runs_only_is_not_explained_by_a_stronger_brake(
    tmp_path: Path,
) -> None:
    folder = mujoco_stops.make(tmp_path / "half", {"brake_gain": 0.06}, 14)
    plain = mujoco_stops.make(tmp_path / "none", {}, 14)
    for run in ("long_2", "short_2", "check_2"):
        shutil.copy(plain / "runs" / f"{run}.csv", folder / "runs")
    diagnosis = explain(folder)
    assert diagnosis.verdict in ("partly", "unexplained")
    clear = {test.name for test in diagnosis.remainder if evidence.is_significant(test, 20.0)}
    assert "along the runs in the size of brake_gain" in clear


@pytest.mark.nightly
def test_a_wheel_clock_that_runs_behind_is_not_reported_as_a_late_sensor(tmp_path: Path) -> None:
    folder = mujoco_stops.make(tmp_path / "clock", {"wheel_clock_drift": 0.0012}, 15)
    diagnosis = explain(folder)
    assert diagnosis.verdict == "unexplained"
    assert diagnosis.causes == []
    # the delay grows by 1.2 ms in every second: its size changes with time
    worst = max(diagnosis.remainder, key=lambda test: test.statistic)
    assert worst.name == "along time in the size of speed_sensor_delay"


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("depth", "runs"),
    [(0.2, ("a2", "b2", "b3")), (0.12, ())],
    ids=["three", "all"],
)
def test_a_cause_outside_the_library_is_unexplained_and_gets_a_formula(
    tmp_path: Path, depth: float, runs: Collection[str]
) -> None:
    diagnosis = explain(braking_stops.make(tmp_path / "joints", {"joints": depth}, 12), runs)
    assert diagnosis.verdict == "unexplained"
    assert diagnosis.causes == []
    assert diagnosis.formula is not None
    # the rail of this generator has a dip every 30 m
    period_m = diagnosis.formula.cause.shape["period"]
    assert period_m == pytest.approx(30.0, rel=0.02)
    assert diagnosis.gain is not None
    assert diagnosis.gain.claimed

    model = tmp_path / "extended.toml"
    model.write_text(extended_model.toml(diagnosis))
    params = scenario.load("velim_a1", str(model)).params
    effect = dict(zip(effects.PLACE, params.effects.values, strict=True))
    assert effect["empirical_covariate"] == 3
    assert effect["empirical_period"] == pytest.approx(period_m, rel=1e-4)


@pytest.mark.nightly
def test_a_drop_under_the_first_wheelset_at_some_moment_is_not_reported_as_cleaning(
    tmp_path: Path,
) -> None:
    folder = other_stops.make(tmp_path / "drop", {"one_axle_drop": 0.12}, 24002)
    diagnosis = explain(folder)
    assert diagnosis.verdict == "unexplained"
    worst = max(diagnosis.remainder, key=lambda test: test.statistic)
    assert (worst.name, worst.axle) == ("along time of one axle", 1)
