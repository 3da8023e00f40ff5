"""Shapes of causes: found between the points on which they were searched."""

from pathlib import Path

import numpy as np
import pytest
from generator import braking_stops, other_stops

from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data import dataset, preparation
from rollerrig.rig.identify.decide import (
    choice,
    evidence,
    fitting,
    null_simulations,
    shapes,
    simulate,
)


def test_the_edges_of_a_patch_move_to_where_the_friction_changes(tmp_path: Path) -> None:
    data = dataset.load(braking_stops.make(tmp_path / "stops", {}, 21))
    runs = data.group("tune")
    design = preparation.prepare(data, runs)
    base, _, _ = fitting.fit(design, candidates.untuned(design))
    patch = Cause("contaminated_patch", 0, {"start_m": 212.0, "length_m": 90.0}, (0.3,))
    made = simulate.runs(
        data, design, runs, base._replace(causes=(patch,)), np.random.default_rng(3)
    )
    seen = preparation.prepare(data, made, design)
    coarse = patch._replace(shape={"start_m": 200.0, "length_m": 125.0})
    told, before, _ = fitting.fit(seen, base._replace(causes=(coarse,)), 4)
    better = shapes.refine_windows(seen, told)
    found = better.causes[0].shape
    assert fitting.deviance(seen, better) < before
    assert found["start_m"] == pytest.approx(212.0, abs=4.0)
    assert found["start_m"] + found["length_m"] == pytest.approx(302.0, abs=4.0)


def test_the_scale_of_a_cause_moves_to_that_of_the_rail(tmp_path: Path) -> None:
    data = dataset.load(braking_stops.make(tmp_path / "stops", {}, 21))
    runs = data.group("tune")
    design = preparation.prepare(data, runs)
    base, _, _ = fitting.fit(design, candidates.untuned(design))
    cleaning = Cause("rail_cleaning", 0, {"energy_J_m": 60.0}, (0.25,))
    made = simulate.runs(
        data, design, runs, base._replace(causes=(cleaning,)), np.random.default_rng(4)
    )
    seen = preparation.prepare(data, made, design)
    coarse = cleaning._replace(shape={"energy_J_m": 600.0})
    told, before, _ = fitting.fit(seen, base._replace(causes=(coarse,)), 4)
    better = shapes.refine_scales(seen, told)
    assert fitting.deviance(seen, better) < before - 20.0
    assert 30.0 < better.causes[0].shape["energy_J_m"] < 130.0


def test_a_long_memory_is_found_from_a_base_that_had_to_leave_recovery_out(tmp_path: Path) -> None:
    folder = other_stops.make(
        tmp_path / "late", {"adhesion_memory": 4.0}, 9, ("a1", "a2", "a3", "b1")
    )
    data = dataset.load(folder)
    design = preparation.prepare(data, data.group("tune"))
    base, value, _ = fitting.fit(design, candidates.untuned(design))
    # to the base alone a late recovery looks like none, and like a rough rail
    assert base.base["ln_tau"] < -1.0
    assert base.sigma > 0.08
    found = choice.fit_explanation(
        design, base._replace(causes=(Cause("adhesion_memory", 0, {}, (1.0,)),))
    )
    assert value - found.deviance > 1000.0
    assert abs(found.explanation.base.get("ln_tau", 0.0)) < 0.3
    assert found.explanation.causes[0].values[0] == pytest.approx(4.0, abs=1.0)
    assert found.explanation.sigma < 0.5 * base.sigma


def test_a_fit_beside_a_memory_ends_where_no_coefficient_alone_is_better_elsewhere(
    tmp_path: Path,
) -> None:
    data = dataset.load(
        other_stops.make(tmp_path / "late", {"adhesion_memory": 3.0}, 11, ("a1", "a2", "b1"))
    )
    design = preparation.prepare(data, data.group("tune"))
    begun = candidates.untuned(design)._replace(causes=(Cause("adhesion_memory", 0, {}, (2.0,)),))
    found, value, _ = fitting.fit(design, fitting.fit(design, begun, 9)[0], 9)
    memory = found.causes[0]
    beside = [
        found._replace(base=found.base | {label: x + step})
        for label, x in found.base.items()
        for step in (-1e-3, 1e-3)
    ]
    beside += [
        found.with_cause(0, memory._replace(values=(memory.values[0] + step,)))
        for step in (-0.02, 0.02)
    ]
    assert min(fitting.deviance(design, other) for other in beside) > value - 1.0


@pytest.mark.parametrize("source", ["load", "pole wheel"])
def test_a_speed_that_swings_by_its_pole_wheel_leaves_a_remainder_that_an_out_of_round_wheel_does_not(
    tmp_path: Path, source: str
) -> None:
    effects = {"wheel_out_of_round": 0.05} if source == "load" else {}
    data = dataset.load(braking_stops.make(tmp_path / "stops", effects, 21))
    runs = data.group("tune")
    if source == "pole wheel":
        # the turn of wheelset 2, and its speed told 0.4 % more and less in each
        told = [run.wheel_speed_rad_s.copy() for run in runs]
        for wheel in told:
            wheel[:, 1] *= 1.0 + 0.004 * np.sin(np.cumsum(wheel[:, 1]) * data.sample_time_s)
        runs = [
            run._replace(wheel_speed_rad_s=wheel) for run, wheel in zip(runs, told, strict=True)
        ]
    design = preparation.prepare(data, runs)
    base, _, _ = fitting.fit(design, candidates.untuned(design))
    swings = [
        c
        for c in evidence.most_promising(design, fitting.normal_equations(design, base)[0], 4)
        if c.name == "wheel_out_of_round"
    ]
    assert len(swings) == 1
    found, _, _ = fitting.fit(design, base._replace(causes=tuple(swings)), 6)
    normal = fitting.normal_equations(design, found)[0]
    left = evidence.scores(normal, ("wheel_out_of_round",))
    [own] = [
        v
        for v in normal.matrix.variants
        if (v.cause, v.axle) == ("along wheel_angle and speed", swings[0].axle)
    ]
    x, S = evidence._coefficients(left, own.columns)
    remains = float(x @ S @ x)
    # chi-squared of as many coefficients where nothing is left
    assert (remains > 200.0) == (source == "pole wheel")


def test_sand_in_every_run_is_found_to_the_instant_on_a_rail_that_it_made_look_rough(
    tmp_path: Path,
) -> None:
    data = dataset.load(braking_stops.make(tmp_path / "stops", {}, 21))
    runs = data.group("tune")
    design = preparation.prepare(data, runs)
    base = fitting.fit(design, candidates.untuned(design))[0]._replace(sigma=0.003)

    def sand(start_s: float, duration_s: float) -> Cause:
        window = {"start_s": start_s, "duration_s": duration_s}
        return Cause(
            "sanding",
            0,
            {f"{key} {run.name}": at for run in runs for key, at in window.items()},
            (0.2,),
        )

    made = simulate.runs(
        data, design, runs, base._replace(causes=(sand(6.33, 4.55),)), np.random.default_rng(5)
    )
    seen = preparation.prepare(data, made, design)
    told, _, _ = fitting.fit(seen, base._replace(causes=(sand(6.0, 4.0),), sigma=0.03), 4)
    assert told.sigma > 0.01
    found = shapes.refine_windows(seen, told).causes[0].shape
    for run in runs:
        assert found[f"start_s {run.name}"] == pytest.approx(6.33, abs=0.05)
        assert found[f"start_s {run.name}"] + found[f"duration_s {run.name}"] == pytest.approx(
            10.88, abs=0.05
        )


def test_a_patch_shows_behind_another_cause_on_the_rail_that_is_left_without_it(
    tmp_path: Path,
) -> None:
    data = dataset.load(braking_stops.make(tmp_path / "stops", {}, 21))
    runs = data.group("tune")
    design = preparation.prepare(data, runs)
    base = fitting.fit(design, candidates.untuned(design))[0]
    inertia = Cause("wheel_inertia", 0, {}, (0.1,))
    patch = Cause("contaminated_patch", 0, {"start_m": 60.0, "length_m": 50.0}, (0.25,))
    made = simulate.runs(
        data, design, runs, base._replace(causes=(inertia, patch)), np.random.default_rng(6)
    )
    seen = preparation.prepare(data, made, design)
    first, _, _ = fitting.fit(seen, base._replace(causes=(inertia,)), 6)
    assert first.sigma > 1.3 * base.sigma
    with null_simulations.worker_pool() as pool:
        setting = null_simulations.Workspace(data, runs, seen, pool, lambda *_: None)
        quiet, _ = choice.with_remaining_irregularity(
            setting, first, [patch._replace(shape={"start_m": 50.0, "length_m": 75.0})]
        )
    assert quiet.sigma == pytest.approx(base.sigma, rel=0.15)
    assert quiet.causes[0].name == "wheel_inertia"
    assert len(quiet.causes) == 1
