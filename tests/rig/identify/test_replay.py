"""The replay: white for its own kind, exact derivatives, mechanisms at zero invisible."""

import math

import numpy as np
import pytest

from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.patch import patch_for
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.data import dataset, parameters, preparation
from rollerrig.rig.identify.decide import simulate, tuning
from rollerrig.rig.identify.filter import replay, sensitivity


@pytest.fixture(scope="module")
def data() -> dataset.Dataset:
    return dataset.load("open_none")


@pytest.fixture(scope="module")
def design(data: dataset.Dataset) -> preparation.Design:
    return preparation.prepare(data, data.group("tune"))


@pytest.fixture(scope="module")
def told(design: preparation.Design) -> Explanation:
    level = {"ln_mu_cd_0": -0.397, "ln_mu_cd_1": -0.522, "ln_mu_cd_2": -0.455}
    return Explanation(level, 0.0225, 6.9, ())


def test_the_replayed_law_is_the_law_of_the_plant(design: preparation.Design) -> None:
    law = adhesion.Law(*(float(x) for x in design.base[parameters.LAW]))
    patch = patch_for(0.445, math.inf, 0.3, 2.1e11, 8.0e10, 0.3)
    for sliding in (0.01, 0.3, 2.0, 8.0, -1.0):
        f, rise, _ = replay.wheel_adhesion(sliding, 25.0, 52700.0, 0.0, design.base, 0.0, 1.0)
        want = adhesion.degraded(sliding, 25.0, 52700.0, patch, law)
        assert f == pytest.approx(want[0], rel=1e-12)
        assert rise == pytest.approx(want[5], rel=1e-9)


def test_innovations_of_an_unspoilt_recording_have_unit_variance(
        design: preparation.Design, told: Explanation) -> None:
    nu, S, _, vnu, vS = sensitivity.innovations(design, candidates.inputs(design, told))
    assert np.mean(nu * nu / S) == pytest.approx(1.0, abs=0.05)
    assert np.mean(vnu * vnu / vS) == pytest.approx(1.0, abs=0.08)


ZERO = [Cause("rail_cleaning", 0, {"energy_J_m": 150.0}, (0.0,)),
        Cause("adhesion_memory", 0, {}, (0.0,)), Cause("speed_dependent_friction", 0, {}, (0.0,)),
        Cause("negative_conditioning", 0, {"distance_m": 30.0}, (0.0,)),
        Cause("contaminated_patch", 0, {"start_m": 50.0, "length_m": 50.0}, (0.0,)),
        Cause("friction_trend", 0, {}, (0.0,)), Cause("brake_gain", 2, {}, (0.0,)),
        Cause("pad_fade", 0, {}, (0.0,)), Cause("torque_offset", 0, {}, (0.0,)),
        Cause("running_resistance", 0, {}, (0.0,)), Cause("track_gradient", 0, {}, (0.0,)),
        Cause("wheel_radius", 3, {}, (0.0,)), Cause("wheel_inertia", 0, {}, (0.0,)),
        Cause("speed_sensor_delay", 1, {}, (0.0,)), Cause("torque_sensor_delay", 0, {}, (0.0,)),
        Cause("wheel_out_of_round", 1, {}, (0.0,) * 6), Cause("load_transfer", 0, {}, (0.0, 0.0)),
        Cause("sanding", 0, {"start_s a1": 4.0, "duration_s a1": 4.0}, (0.0,)),
        Cause("roller_curvature", 0, {}, (0.0,)), Cause("interfacial_layer", 0, {}, (0.0,)),
        Cause("interfacial_layer", 0, {"whole": 1.0}, (0.0,)),
        Cause("falling_friction", 0, {}, (0.0,)), Cause("falling_friction", 0, {"height": 1.0}, (0.0,))]


@pytest.mark.parametrize("cause", ZERO, ids=lambda cause: cause.name)
def test_a_cause_of_size_zero_changes_no_bit_of_the_replay(
        design: preparation.Design, told: Explanation, cause: Cause) -> None:
    plain = sensitivity.innovations(design, candidates.inputs(design, told))
    with_it = sensitivity.innovations(design, candidates.inputs(
        design, told._replace(causes=(cause,))))
    assert all(np.array_equal(a, b) for a, b in zip(plain, with_it, strict=True))


SMALL = [Cause("friction_trend", 0, {}, (1e-4,)), Cause("roller_curvature", 0, {}, (1e-3,)),
         Cause("falling_friction", 0, {}, (1e-3,)), Cause("falling_friction", 0, {"height": 1.0}, (1e-3,)),
         Cause("interfacial_layer", 0, {}, (1e-3,)), Cause("interfacial_layer", 0, {"whole": 1.0}, (1e-3,)),
         Cause("brake_gain", 1, {}, (1e-3,)), Cause("wheel_radius", 2, {}, (1e-5,)),
         Cause("pad_fade", 0, {}, (1e-4,))]


@pytest.mark.parametrize("cause", SMALL, ids=lambda cause: cause.name)
def test_the_linearised_answer_is_the_derivative_of_the_replay(
        design: preparation.Design, told: Explanation, cause: Cause) -> None:
    found, linear, _, Z = tuning.normal(design, told)
    column = next(v.columns[0] for v in found.matrix.variants
                  if (v.cause, v.axle, v.shape) == (cause.name, cause.axle, cause.shape))
    moved = sensitivity.innovations(design, candidates.inputs(
        design, told._replace(causes=(cause,))))[0]
    change = (moved - linear.nu) / np.sqrt(linear.variance) / cause.values[0]
    answer = Z[:, column].astype(float)
    assert np.dot(change, answer) / np.linalg.norm(change) / np.linalg.norm(answer) > 0.99
    assert np.dot(change, answer) / np.dot(answer, answer) == pytest.approx(1.0, abs=0.06)


def test_simulated_stops_look_like_the_recording(
        data: dataset.Dataset, design: preparation.Design, told: Explanation) -> None:
    made = simulate.runs(data, design, data.group("tune"), told, np.random.default_rng(5))
    again = preparation.prepare(data, made, design)
    nu, S, *_ = sensitivity.innovations(again, candidates.inputs(again, told))
    assert np.mean(nu * nu / S) == pytest.approx(1.0, abs=0.06)
    assert again.sliding_m_s.mean() == pytest.approx(design.sliding_m_s.mean(), rel=0.25)
