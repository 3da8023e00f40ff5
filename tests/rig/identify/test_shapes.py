"""Edges of windows: found between the bins on which they were searched."""

from pathlib import Path

import numpy as np
import pytest
from generator import braking_stops

from rollerrig.rig.identify import candidates, dataset, preparation, shapes, simulate, tuning
from rollerrig.rig.identify.candidates import Cause


def test_the_edges_of_a_patch_move_to_where_the_friction_changes(tmp_path: Path) -> None:
    data = dataset.load(braking_stops.make(tmp_path / "stops", {}, 21))
    runs = data.group("tune")
    design = preparation.prepare(data, runs)
    base, _, _ = tuning.fit(design, candidates.start(design))
    patch = Cause("contaminated_patch", 0, {"start_m": 212.0, "length_m": 90.0}, (0.3,))
    made = simulate.runs(data, design, runs, base._replace(causes=(patch,)), np.random.default_rng(3))
    seen = preparation.prepare(data, made, design)
    coarse = patch._replace(shape={"start_m": 200.0, "length_m": 125.0})
    told, before, _ = tuning.fit(seen, base._replace(causes=(coarse,)), 4)
    better = shapes.refined(seen, told)
    found = better.causes[0].shape
    assert tuning.deviance(seen, better) < before
    assert found["start_m"] == pytest.approx(212.0, abs=4.0)
    assert found["start_m"] + found["length_m"] == pytest.approx(302.0, abs=4.0)
