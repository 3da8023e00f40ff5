"""What no cause explains gets a formula, if it improves runs that were never fitted."""

from pathlib import Path

import pytest
from generator import braking_stops

from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.data import dataset, preparation
from rollerrig.rig.identify.decide import empirical, fitting


def test_a_rail_with_a_dip_every_30_m_gets_a_formula_with_this_period(tmp_path: Path) -> None:
    data = dataset.load(braking_stops.make(tmp_path / "joints", {"joints": 0.2}, 12))
    design = preparation.prepare(data, data.group("tune")[1:])
    held_out = preparation.prepare(data, data.group("validate")[1:])
    base = fitting.fit(design, candidates.untuned(design), 4).explanation

    found = empirical.find(design, held_out, base, [], 0)
    assert found is not None
    assert found.cause.shape["period"] == pytest.approx(30.0, rel=0.02)
    assert found.gain.claimed
    # nothing shows that it improves other runs
    assert empirical.find(design, None, base, [], 0) is None
