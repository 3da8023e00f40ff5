"""Statistics of stopping distances: bounds that hold as often as they say, and inputs that drive the tail."""

import math

import numpy as np
import pyarrow as pa
import pytest

from rollerrig.realtime.campaign import campaign, stopping
from rollerrig.realtime.reports import campaign as report


def runs(distance_m, **more):
    """The result of a campaign with these distances; NaN: it did not stop."""
    why = [
        None if math.isfinite(d) else "the coach did not stop within 180 s (duration_max_s)"
        for d in distance_m
    ]
    return pa.table(
        {
            "stop_distance_m": [d if math.isfinite(d) else None for d in distance_m],
            "error": pa.nulls(len(why), pa.string()),
            "invalid_because": pa.array(why, pa.string()),
        }
        | more
    )


def plan(design="random", axes=("a", "b")):
    return campaign.Plan({"design": design}, axes, ())


@pytest.mark.parametrize(
    ("count", "quantile", "rank"),
    [
        (58, 0.95, 0),
        (59, 0.95, 59),
        (93, 0.95, 92),
        (92, 0.95, 92),
        (124, 0.95, 122),
        (299, 0.99, 299),
        (298, 0.99, 0),
    ],
)
def test_the_ranks_are_those_of_wilks(count, quantile, rank):
    # 59 for 95/95, 93 for its second order, 299 for 99/95: Wilks 1941 and all that use him
    assert stopping.rank(count, quantile) == rank


@pytest.mark.parametrize("quantile", [0.5, 0.9, 0.95])
def test_a_bound_lies_above_its_quantile_as_often_as_it_says(quantile):
    rng, count, tries = np.random.default_rng(5), 80, 4000
    drawn = np.sort(rng.exponential(size=(tries, count)), axis=1)
    above = drawn[:, stopping.rank(count, quantile) - 1] >= -math.log1p(-quantile)
    # the rank is whole, so the confidence is a little more than asked for, and never less
    assert stopping.CONFIDENCE - 0.01 <= above.mean() <= 1.0
    one_less = drawn[:, stopping.rank(count, quantile) - 2] >= -math.log1p(-quantile)
    assert one_less.mean() < stopping.CONFIDENCE + 0.01


def test_runs_that_did_not_stop_are_longer_than_any_and_failed_ones_count_nowhere():
    table = runs([*range(100, 195), *[math.nan] * 5])
    counts, distance_m = stopping.counted(table)
    assert counts.all()
    assert np.isinf(distance_m).sum() == 5
    assert stopping.bounds(table)[-2] == {
        "quantile": 0.95,
        "rank": 99,
        "needs": 59,
        "estimate_m": 194.0,
        "bound_m": None,
    }
    failed = table.set_column(
        1, "error", pa.array([*[None] * 95, *["no such vehicle"] * 5], pa.string())
    )
    assert stopping.counted(failed)[1].tolist() == list(range(100, 195))


def test_the_input_that_drives_the_distance_comes_first_and_one_of_the_tail_alone_is_seen_there():
    rng = np.random.default_rng(3)
    a, b = rng.random(400), rng.random(400)
    table = runs(100.0 + 10.0 * a + 100.0 * np.maximum(b - 0.9, 0.0), a=a, b=b)
    found = {key: (whole, tail) for key, whole, tail in stopping.drivers(plan(), table)}
    assert next(iter(found)) == "a"
    assert found["a"][0] > 0.8
    assert found["b"][1] > found["b"][0] + 0.3


def test_the_page_says_that_it_is_no_certificate_and_a_matrix_gives_no_statistics():
    a = np.linspace(0.0, 1.0, 60)
    table = runs(100.0 + a, a=a, b=a)
    text = "".join(report._stopping(plan(), table))
    assert "not a certificate" in text
    assert "needs 299 runs" in text
    assert text.count("<svg") == 1
    assert "for orientation" in "".join(report._stopping(plan("sobol"), table))
    assert report._stopping(plan("matrix"), table) == []
