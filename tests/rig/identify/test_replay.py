"""The replay: white for its own kind, exact derivatives, mechanisms at zero invisible."""

import math

import numpy as np
import pytest

from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.patch import patch_for
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.data import dataset, parameters, preparation
from rollerrig.rig.identify.decide import evidence, simulate, tuning
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
        want = adhesion.recovering(sliding, 25.0, 52700.0, patch, law)
        assert f == pytest.approx(want[0], rel=1e-12)
        assert rise == pytest.approx(want[5], rel=1e-9)


def test_innovations_of_an_unspoilt_recording_have_unit_variance(
        design: preparation.Design, told: Explanation) -> None:
    nu, S, _, vnu, vS = sensitivity.innovations(design, candidates.inputs(design, told))
    assert np.mean(nu * nu / S) == pytest.approx(1.0, abs=0.05)
    assert np.mean(vnu * vnu / vS) == pytest.approx(1.0, abs=0.08)


def test_simulated_stops_look_like_the_recording(
        data: dataset.Dataset, design: preparation.Design, told: Explanation) -> None:
    made = simulate.runs(data, design, data.group("tune"), told, np.random.default_rng(5))
    again = preparation.prepare(data, made, design)
    nu, S, *_ = sensitivity.innovations(again, candidates.inputs(again, told))
    assert np.mean(nu * nu / S) == pytest.approx(1.0, abs=0.06)
    assert again.sliding_m_s.mean() == pytest.approx(design.sliding_m_s.mean(), rel=0.25)


def test_wet_pads_hidden_in_simulated_stops_are_the_likeliest_cause(
        data: dataset.Dataset, design: preparation.Design, told: Explanation) -> None:
    wet = Cause("wet_pads", 0, {"turns": 12.0}, (0.25,))
    made = simulate.runs(data, design, data.group("tune"), told._replace(causes=(wet,)), np.random.default_rng(6))
    seen = preparation.prepare(data, made, design)
    found = evidence.likely(seen, tuning.normal(seen, told)[0], 3)
    assert found[0].name == "wet_pads"
    fitted = tuning.fit(seen, told._replace(causes=(found[0],)), 4, False)[0]
    assert fitted.causes[0].values[0] == pytest.approx(0.25, abs=0.08)
