"""Noise of a load, a speed or a temperature is no effect of it on friction."""

import numpy as np
import pytest
from each import for_each

from rollerrig.rig.identify.creep_curves import conditions, judgement
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.runs import Curve

POINTS = 150


def law(creepage):
    """Return the adhesion of a magic formula at a creepage."""
    return 0.35 * np.sin(0.98 * np.arctan(300.0 * creepage))


def curve_of(rng, true_load_N, noise, exponent=0.0, *, divided_by_measured=True):
    """Return points whose load sensor has noise, a share; adhesion is force over a load."""
    size = true_load_N.size
    creepage = rng.uniform(0.001, 0.05, size)
    adhesion = law(creepage) * (true_load_N / 1e4) ** exponent
    force_N = adhesion * (1.0 + 0.01 * rng.standard_normal(size)) * true_load_N
    measured_N = true_load_N * (1.0 + noise * rng.standard_normal(size))
    divisor_N = measured_N if divided_by_measured else true_load_N
    return Curve(creepage, force_N / divisor_N, np.full(size, 10.0), measured_N, np.zeros(size))


def judged(curve, **accuracy):
    data = dataset.load("eurosprinter_127001")
    declared = data.accuracy | accuracy
    return judgement.without_law(data._replace(curve=curve, accuracy=declared))


def effect(shown, name):
    [found] = [one for one in shown.factors.effects if one.name == name]
    return found


@pytest.mark.parametrize("noise", [0.03, 0.10])
@pytest.mark.parametrize("seed", [1, 2])
def test_friction_does_not_fall_with_a_load_that_is_noise(noise, seed):
    rng = np.random.default_rng(seed)
    shown = judged(curve_of(rng, np.full(POINTS, 1e4), noise))
    load = effect(shown, conditions.LOAD)
    assert not load.judged
    assert "noise of its sensor" in load.why_not
    assert shown.reported == []


def test_one_load_with_a_noisy_sensor_is_consistent_with_the_law():
    rng = np.random.default_rng(3)
    data = dataset.load("eurosprinter_127001")
    curve = curve_of(rng, np.full(POINTS, 1e4), 0.03)
    # the curve of the locomotive's contact: it rises to a limit
    answer = judgement.judge(data._replace(curve=curve._replace(creepage=20.0 * curve.creepage)))
    assert answer.shown.reported == []
    assert not answer.law_fails


@pytest.mark.parametrize("seed", range(4))
def test_an_effect_of_set_loads_has_the_truth_inside_although_the_sensor_is_noisy(seed):
    rng = np.random.default_rng(seed)
    true_load_N = rng.choice((5e3, 1e4, 2e4), POINTS)
    load = effect(judged(curve_of(rng, true_load_N, 0.01, exponent=-0.2)), conditions.LOAD)
    assert load.is_reported
    truth = 4.0**-0.2 - 1.0
    assert load.low - 0.02 < truth < load.high + 0.02


@pytest.mark.parametrize("divided_by_measured", [True, False])
def test_a_declared_noise_is_taken_out_of_the_effect_of_loads_that_jump(divided_by_measured):
    """Loads jump from point to point: without a declared noise, all of it may be noise."""
    covered = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        true_load_N = 1e4 * np.exp(0.2 * rng.standard_normal(POINTS))
        curve = curve_of(
            rng, true_load_N, 0.08, exponent=-0.3, divided_by_measured=divided_by_measured
        )
        assert not effect(judged(curve), conditions.LOAD).judged
        load = effect(judged(curve, load_fraction=0.08), conditions.LOAD)
        assert load.judged
        low, high = curve.load_N.min(), curve.load_N.max()
        covered += load.low <= (high / low) ** -0.3 - 1.0 <= load.high
    assert covered >= 8


def test_a_load_that_changes_slowly_is_judged_although_its_values_are_no_levels():
    rng = np.random.default_rng(4)
    true_load_N = np.linspace(5e3, 2e4, POINTS)
    load = effect(judged(curve_of(rng, true_load_N, 0.005, exponent=-0.2)), conditions.LOAD)
    assert load.judged
    assert load.is_reported
    assert load.low - 0.02 < 4.0**-0.2 - 1.0 < load.high + 0.02


@for_each([(conditions.SPEED, "speed_m_s"), (conditions.TEMPERATURE, "temperature_K")])
def test_a_speed_or_temperature_that_is_noise_is_not_judged(row):
    name, column = row
    rng = np.random.default_rng(5)
    creepage = rng.uniform(0.001, 0.05, POINTS)
    noisy = {
        "speed_m_s": 10.0 * (1.0 + 0.03 * rng.standard_normal(POINTS)),
        "temperature_K": 293.0 + 3.0 * rng.standard_normal(POINTS),
    }[column]
    curve = Curve(
        creepage,
        law(creepage) + 0.003 * rng.standard_normal(POINTS),
        np.full(POINTS, 10.0),
        np.full(POINTS, 1e4),
        np.zeros(POINTS),
    )._replace(**{column: noisy})
    found = effect(judged(curve), name)
    assert not found.judged
    assert "noise of its sensor" in found.why_not


def test_the_noise_of_levels_is_the_scatter_within_them():
    rng = np.random.default_rng(6)
    true_load_N = rng.choice((5e3, 1e4, 2e4), 600)
    prepared = conditions.prepare(curve_of(rng, true_load_N, 0.02))
    [load] = [one for one in prepared.conditions if one.name == conditions.LOAD]
    assert load.noise == pytest.approx(0.02, rel=0.1)
    assert not load.may_be_noise


def test_the_order_of_the_file_decides_what_is_noise():
    rng = np.random.default_rng(7)
    slow = curve_of(rng, np.linspace(5e3, 2e4, POINTS), 0.005)
    shuffled = slow.chosen(rng.permutation(POINTS))
    noise = []
    for curve in (slow, shuffled):
        [load] = [c for c in conditions.prepare(curve).conditions if c.name == conditions.LOAD]
        noise.append(load.may_be_noise)
    assert noise == [False, True]


@for_each([(0.05, 0.0), (0.15, 0.0), (0.05, -0.15), (0.15, -0.15)])
def test_noise_of_the_creepage_makes_no_effect_of_a_temperature_and_hides_none(row):
    """Wheels that slide more are hotter, so a noisy creepage could look like a temperature."""
    creepage_noise, per_10_K = row
    for seed in range(3):
        rng = np.random.default_rng(seed)
        creepage = rng.uniform(0.001, 0.05, POINTS)
        true_K = 293.0 + 400.0 * creepage + 8.0 * rng.standard_normal(POINTS)
        adhesion = law(creepage) * np.exp(0.1 * per_10_K * (true_K - 300.0))
        curve = Curve(
            np.maximum(creepage * (1.0 + creepage_noise * rng.standard_normal(POINTS)), 1e-4),
            adhesion * (1.0 + 0.01 * rng.standard_normal(POINTS)),
            np.full(POINTS, 10.0),
            np.full(POINTS, 1e4),
            np.zeros(POINTS),
            temperature_K=true_K + 2.0 * rng.standard_normal(POINTS),
        )
        found = effect(judged(curve, temperature_K=2.0), conditions.TEMPERATURE)
        assert found.judged
        assert found.is_reported == (per_10_K != 0.0)
        assert found.exponent == pytest.approx(per_10_K, abs=0.04)
        # all of the spread may be noise where the sensor's is not declared
        assert not effect(judged(curve), conditions.TEMPERATURE).judged
