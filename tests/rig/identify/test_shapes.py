"""Shapes of causes are found between the points of the grid on which they are searched."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from generator import braking_stops, other_stops

from rollerrig.rig.identify.causes import candidates, simulate, table
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.data import dataset, preparation
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.decide import (
    choice,
    evidence,
    fitting,
    null_simulations,
    shapes,
)

SEED_OF_STOPS = 21


@pytest.mark.parametrize(
    ("name", "axles", "places"),
    [
        ("rail_cleaning", 8, (0,)),
        ("wheel_radius", 6, (1, 2, 3, 4, 5, 6)),
        ("brake_gain", 4, (0, 1, 2, 3, 4, -1, -2)),
        ("brake_gain", 8, (0, 1, 2, 3, 4, 5, 6, 7, 8, -1, -2, -3, -4)),
    ],
)
def test_a_cause_is_searched_for_on_the_wheelsets_and_bogies_of_the_vehicle(
    name: str, axles: int, places: tuple[int, ...]
) -> None:
    assert table.BY_NAME[name].places(axles) == places


class Fitted(NamedTuple):
    """Generated stops and the base model that is fitted to them."""

    data: Dataset
    runs: list[Run]
    design: Design
    base: Explanation


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Generated stops without a hidden cause."""
    folder = tmp_path_factory.mktemp("stops")
    return dataset.load(braking_stops.make(folder, {}, SEED_OF_STOPS))


def with_base(data: Dataset, runs: list[Run]) -> Fitted:
    """Return stops with their fitted base."""
    design = preparation.prepare(data, runs)
    base = fitting.fit(design, candidates.untuned(design)).explanation
    return Fitted(data, runs, design, base)


@pytest.fixture(scope="module")
def stops(data: Dataset) -> Fitted:
    """The two shorter stops to tune on."""
    return with_base(data, data.group("tune")[1:])


@pytest.fixture(scope="module")
def all_stops(data: Dataset) -> Fitted:
    """All stops to tune on."""
    return with_base(data, data.group("tune"))


def simulated(stops: Fitted, explanation: Explanation, seed: int) -> Design:
    """Return stops like the generated ones, simulated under an explanation and prepared."""
    rng = np.random.default_rng(seed)
    made = simulate.runs(stops.data, stops.design, stops.runs, explanation, rng)
    return preparation.prepare(stops.data, made, stops.design)


# --- scales and edges ---


# two stops find the end of a patch at 302 m with an error of 5 m
@pytest.mark.parametrize(
    ("name", "start_m"),
    [("stops", 112.0), pytest.param("all_stops", 212.0, marks=pytest.mark.nightly)],
)
def test_the_edges_of_a_patch_move_to_where_the_friction_changes(
    name: str, start_m: float, request: pytest.FixtureRequest
) -> None:
    stops: Fitted = request.getfixturevalue(name)
    patch = Cause("contaminated_patch", 0, {"start_m": start_m, "length_m": 90.0}, (0.3,))
    design = simulated(stops, stops.base._replace(causes=(patch,)), seed=3)

    coarse = patch._replace(shape={"start_m": start_m - 12.0, "length_m": 125.0})
    fit = fitting.fit(design, stops.base._replace(causes=(coarse,)), 4)
    refined = shapes.refine_windows(design, fit.explanation)

    shape = refined.causes[0].shape
    assert fitting.deviance(design, refined) < fit.deviance
    assert shape["start_m"] == pytest.approx(start_m, abs=4.0)
    assert shape["start_m"] + shape["length_m"] == pytest.approx(start_m + 90.0, abs=4.0)


def test_the_scale_of_a_cause_moves_to_that_of_the_rail(stops: Fitted) -> None:
    cleaning = Cause("rail_cleaning", 0, {"energy_J_m": 60.0}, (0.25,))
    design = simulated(stops, stops.base._replace(causes=(cleaning,)), seed=4)

    coarse = cleaning._replace(shape={"energy_J_m": 600.0})
    fit = fitting.fit(design, stops.base._replace(causes=(coarse,)), 4)
    refined = shapes.refine_scales(design, fit.explanation)

    assert fitting.deviance(design, refined) < fit.deviance - 20.0
    assert 30.0 < refined.causes[0].shape["energy_J_m"] < 130.0


# --- adhesion memory ---


def test_a_long_memory_is_found_from_a_base_that_had_to_leave_recovery_out(tmp_path: Path) -> None:
    folder = other_stops.make(tmp_path / "late", {"adhesion_memory": 4.0}, 9, ("a2", "a3"))
    data = dataset.load(folder)
    design = preparation.prepare(data, data.group("tune"))
    base_fit = fitting.fit(design, candidates.untuned(design))
    base = base_fit.explanation
    # to the base alone a late recovery looks like none, and like a rough rail
    assert base.base["ln_tau"] < -1.0
    assert base.sigma > 0.08

    memory = Cause("adhesion_memory", 0, {}, (1.0,))
    fit = choice.fit_explanation(design, base._replace(causes=(memory,)))
    assert base_fit.deviance - fit.deviance > 1000.0
    assert abs(fit.explanation.base.get("ln_tau", 0.0)) < 0.3
    assert fit.explanation.causes[0].values[0] == pytest.approx(4.0, abs=1.0)
    assert fit.explanation.sigma < 0.5 * base.sigma


def neighbours(explanation: Explanation) -> Iterator[Explanation]:
    """Yield the explanation with each coefficient alone a little smaller and a little larger."""
    for label, value in explanation.base.items():
        for step in (-1e-3, 1e-3):
            yield explanation._replace(base=explanation.base | {label: value + step})

    memory = explanation.causes[0]
    for step in (-0.02, 0.02):
        yield explanation.with_cause(0, memory._replace(values=(memory.values[0] + step,)))


def test_a_fit_with_a_memory_ends_where_no_coefficient_alone_is_better_elsewhere(
    tmp_path: Path,
) -> None:
    folder = other_stops.make(tmp_path / "late", {"adhesion_memory": 3.0}, 11, ("a2", "a3"))
    data = dataset.load(folder)
    design = preparation.prepare(data, data.group("tune"))
    memory = Cause("adhesion_memory", 0, {}, (2.0,))
    begun = candidates.untuned(design)._replace(causes=(memory,))

    first_fit = fitting.fit(design, begun, 9)
    fit = fitting.fit(design, first_fit.explanation, 9)

    deviances = [fitting.deviance(design, other) for other in neighbours(fit.explanation)]
    assert min(deviances) > fit.deviance - 1.0


# --- a cause once a turn ---


def with_pole_wheel(run: Run, step_s: float) -> Run:
    """Return a run whose sensor of wheelset 2 reads 0.4 % more and less in each turn."""
    wheel_rad_s = run.wheel_speed_rad_s.copy()
    angle_rad = np.cumsum(wheel_rad_s[:, 1]) * step_s
    wheel_rad_s[:, 1] *= 1.0 + 0.004 * np.sin(angle_rad)
    return run._replace(wheel_speed_rad_s=wheel_rad_s)


@pytest.mark.parametrize("source", ["load", "pole wheel"])
def test_a_speed_that_swings_by_its_pole_wheel_leaves_a_remainder_that_an_out_of_round_wheel_does_not(
    stops: Fitted, tmp_path: Path, source: str
) -> None:
    if source == "load":
        effects = {"wheel_out_of_round": 0.05}
        data = dataset.load(braking_stops.make(tmp_path / "stops", effects, SEED_OF_STOPS))
        runs = data.group("tune")[1:]
    else:
        data = stops.data
        runs = [with_pole_wheel(run, data.sample_time_s) for run in stops.runs]
    design = preparation.prepare(data, runs)
    base = fitting.fit(design, candidates.untuned(design)).explanation

    # both look like an out-of-round wheel at first
    normal, _, _ = fitting.normal_equations(design, base)
    promising = evidence.most_promising(design, normal, 4)
    [swing] = [cause for cause in promising if cause.name == "wheel_out_of_round"]
    fitted = fitting.fit(design, base._replace(causes=(swing,)), 6).explanation

    normal, _, _ = fitting.normal_equations(design, fitted)
    scores = evidence.scores(normal, ("wheel_out_of_round",))
    [remainder] = [
        variant
        for variant in normal.matrix.variants
        if variant.cause == "along wheel_angle and speed" and variant.axle == swing.axle
    ]
    x, S = evidence.estimated(scores, remainder.columns)
    statistic = float(x @ S @ x)
    # where nothing is left it is chi-squared, with a degree of freedom for each coefficient
    assert (statistic > 200.0) == (source == "pole wheel")


# --- windows on a rail that looks rough ---


def sand(runs: list[Run], start_s: float, duration_s: float) -> Cause:
    """Return sand at the same time in each run."""
    shape = {}
    for run in runs:
        shape[f"start_s {run.name}"] = start_s
        shape[f"duration_s {run.name}"] = duration_s
    return Cause("sanding", 0, shape, (0.2,))


def test_sand_in_every_run_is_found_to_the_instant_on_a_rail_that_it_made_look_rough(
    stops: Fitted,
) -> None:
    base = stops.base._replace(sigma=0.003)
    true = sand(stops.runs, start_s=6.33, duration_s=4.55)
    design = simulated(stops, base._replace(causes=(true,)), seed=5)

    coarse = sand(stops.runs, start_s=6.0, duration_s=4.0)
    rough = fitting.fit(design, base._replace(causes=(coarse,), sigma=0.03), 4).explanation
    assert rough.sigma > 0.01

    shape = shapes.refine_windows(design, rough).causes[0].shape
    for run in stops.runs:
        start_s = shape[f"start_s {run.name}"]
        end_s = start_s + shape[f"duration_s {run.name}"]
        assert start_s == pytest.approx(6.33, abs=0.05)
        assert end_s == pytest.approx(10.88, abs=0.05)


def test_a_patch_shows_behind_another_cause_on_the_rail_that_is_left_without_it(
    stops: Fitted,
) -> None:
    inertia = Cause("wheel_inertia", 0, {}, (0.1,))
    patch = Cause("contaminated_patch", 0, {"start_m": 60.0, "length_m": 50.0}, (0.25,))
    design = simulated(stops, stops.base._replace(causes=(inertia, patch)), seed=6)

    # the patch that is not in the model makes the rail look rough
    first = fitting.fit(design, stops.base._replace(causes=(inertia,)), 6).explanation
    assert first.sigma > 1.3 * stops.base.sigma

    coarse = patch._replace(shape={"start_m": 50.0, "length_m": 75.0})
    with null_simulations.worker_pool() as pool:
        workspace = null_simulations.Workspace(
            data=stops.data,
            measured=stops.runs,
            design=design,
            pool=pool,
            progress=lambda *_: None,
        )
        smoother, _ = choice.with_remaining_irregularity(workspace, first, [coarse])
    assert smoother.sigma == pytest.approx(stops.base.sigma, rel=0.15)
    assert [cause.name for cause in smoother.causes] == ["wheel_inertia"]
