"""A cause shows the same everywhere: sand has a trigger, a patch one place, a torque one size."""

from pathlib import Path

import numpy as np
import pytest
from generator import braking_stops

from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.causes.table import CONTAMINANT_ALONE
from rollerrig.rig.identify.data import dataset, preparation
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import choice, coherence, fitting, thresholds
from rollerrig.rig.identify.decide.coherence import Contradiction


@pytest.fixture(scope="module")
def clean() -> Design:
    """Three stops in which nothing is hidden; the brake acts from about 1 s on."""
    data = dataset.load("open_none")
    return preparation.prepare(data, data.group("tune"))


@pytest.fixture(scope="module")
def two() -> Design:
    """Two of these stops."""
    data = dataset.load("open_none")
    return preparation.prepare(data, data.group("tune")[1:])


def sand(design: Design, windows: list[tuple[float, float]]) -> Explanation:
    """An explanation with sand in these windows (start, duration) of the runs, in s."""
    shape = dict(CONTAMINANT_ALONE)
    for run, (start_s, duration_s) in zip(design.names, windows, strict=True):
        shape |= {f"start_s {run}": start_s, f"duration_s {run}": duration_s}
    return candidates.untuned(design)._replace(causes=(Cause("sanding", 0, shape, (0.1,)),))


@pytest.mark.parametrize(
    ("windows", "is_sand"),
    [
        ([(5.0, 6.0), (5.5, 5.0), (4.8, 6.0)], True),
        ([(4.0, 5.0), (8.0, 5.0), (6.0, 7.0)], True),
        # before the brake acts
        ([(0.0, 4.0), (0.0, 5.0), (0.0, 4.0)], False),
        # no common onset
        ([(19.7, 5.0), (7.1, 5.0), (1.6, 5.0)], False),
        # a sander does not work for 1.5 s here and for 7 s there
        ([(4.0, 1.5), (4.5, 7.0), (5.0, 6.0)], False),
    ],
)
def test_sand_has_the_same_onset_after_a_trigger_in_all_runs(
    clean: Design, windows: list[tuple[float, float]], is_sand: bool
) -> None:
    found = coherence.of_window(clean, sand(clean, windows), 0, likelihood_ratio=100.0)
    if is_sand:
        assert found is None
    else:
        assert found is not None
        assert found.what is Contradiction.NO_TRIGGER
        assert [window.start for window in found.windows] == [start_s for start_s, _ in windows]


def with_torque(design: Design, axles: tuple[int, ...], factor: float) -> Design:
    """The same stops with another recorded torque on some wheelsets."""
    on = np.repeat(np.isin(design.axle + 1, axles), np.diff(design.start))
    return design._replace(torque_Nm=np.where(on, factor, 1.0) * design.torque_Nm)


def fitted(design: Design, cause: Cause) -> fitting.Fit:
    base = fitting.fit(design, candidates.untuned(design), 4).explanation
    return fitting.fit(design, base._replace(causes=(cause,)), 6)


def test_a_wrong_torque_of_one_bogie_is_no_resistance_of_the_vehicle(two: Design) -> None:
    design = with_torque(two, (3, 4), 1.0 / 1.1)
    of_bogie = fitted(design, Cause("brake_gain", -2, {}, (0.0,)))
    of_all = fitted(design, Cause("brake_gain", 0, {}, (0.0,)))
    resistance = fitted(design, Cause("running_resistance", 0, {}, (0.0,)))
    rivals = min(of_all.deviance, resistance.deviance)
    assert of_bogie.deviance < rivals - thresholds.LEAST_RATIO
    assert of_bogie.explanation.causes[0].values[0] == pytest.approx(0.1, abs=0.01)
    assert coherence.of_forces(design, of_bogie.explanation) is None


def test_less_load_on_one_wheelset_is_no_torque_for_the_vehicle_does_not_feel_it(
    two: Design,
) -> None:
    on = np.repeat(two.axle == 1, np.diff(two.start))
    design = two._replace(load_N=np.where(on, 1.2, 1.0) * two.load_N)
    offset = fitted(design, Cause("torque_offset", 2, {"from_Nm": 300.0}, (0.0,)))
    assert abs(offset.explanation.causes[0].values[0]) > 50.0
    assert coherence.of_forces(design, offset.explanation) == 0


def test_a_patch_is_at_the_same_place_in_all_runs(tmp_path: Path) -> None:
    folder = braking_stops.make(tmp_path / "patch", {"contaminated_patch": 0.14}, 7)
    data = dataset.load(folder)
    design = preparation.prepare(data, data.group("tune")[1:])
    base = fitting.fit(design, candidates.untuned(design), 4).explanation
    fits = []
    for start_m in np.arange(100.0, 320.0, 70.0):
        shape = CONTAMINANT_ALONE | {"start_m": float(start_m), "length_m": 75.0}
        patch = Cause("contaminated_patch", 0, shape, (0.1,))
        fits.append(fitting.fit(design, base._replace(causes=(patch,)), 2, noise=False))
    best = min(fits, key=lambda fit: fit.deviance)
    with_patch = choice.fit_explanation(design, best.explanation).explanation
    assert coherence.of_window(design, with_patch, 0, likelihood_ratio=100.0) is None

    # the same stops, as if one of them had begun 60 m further on
    first = design.run == 0
    moved = np.repeat(first, np.diff(design.start)) * 60.0
    elsewhere = design._replace(place_m=design.place_m + moved)
    found = coherence.of_window(elsewhere, with_patch, 0, likelihood_ratio=100.0)
    assert found is not None
    assert found.what is Contradiction.OTHER_PLACES
    starts_m = [window.start for window in found.windows]
    assert starts_m[0] > max(starts_m[1:]) + 30.0
