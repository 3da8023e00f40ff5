"""Statistics of stopping distances: the confidence of bounds, and the drivers of the tail."""

import math

import numpy as np
import pyarrow as pa
import pytest

from rollerrig.realtime.campaign import campaign, outcome, stopping
from rollerrig.realtime.record import figures
from rollerrig.realtime.reports import campaign as report
from rollerrig.realtime.reports.statistics import tail

NOT_STOPPED = "the coach did not stop within 180 s (duration_max_s)"


def runs(distance_m, **inputs):
    """Return the result of a campaign with these distances; NaN: the coach did not stop."""
    stopped = [math.isfinite(distance) for distance in distance_m]
    known_m = [distance if math.isfinite(distance) else None for distance in distance_m]
    reasons = [None if has_stopped else NOT_STOPPED for has_stopped in stopped]
    columns = {
        "braking_distance_m": known_m,
        "stopped": stopped,
        "ended": ["finished"] * len(stopped),
        "valid": stopped,
        "invalid_because": pa.array(reasons, pa.string()),
        "error": pa.nulls(len(stopped), pa.string()),
        "long_step_missed": pa.nulls(len(stopped), pa.float64()),
    }
    return pa.table(columns | inputs)


def plan(design="random", axes=("a", "b")):
    return campaign.Plan({"design": design}, axes, ())


def test_runs_that_did_not_stop_are_longer_than_any_other_and_failed_runs_do_not_count():
    table = runs([*range(100, 195), *[math.nan] * 5])
    counts, distance_m = stopping.counted(table)
    assert counts.all()
    assert np.isinf(distance_m).sum() == 5
    assert stopping.bounds(stopping.distances(table))[-2] == {
        "quantile": 0.95,
        "rank": 99,
        "needs": 59,
        "confidence": pytest.approx(0.963, abs=1e-3),
        "estimate_m": 194.0,
        "bound_m": None,
    }

    # a run that failed has an error, and no other result
    columns = {name: table[name].to_pylist() for name in table.column_names}
    for name in ("stopped", "ended", "valid", "invalid_because"):
        columns[name][95:] = [None] * 5
    columns["error"][95:] = ["no such vehicle"] * 5
    assert stopping.counted(pa.table(columns))[1].tolist() == list(range(100, 195))


def test_a_run_that_derailed_is_not_one_that_did_not_stop_in_its_time():
    table = runs([100.0, math.nan, math.nan])
    place = table.column_names.index("ended")
    derailed = table.set_column(place, "ended", [["finished", "derailed", "finished"]])
    counts, distance_m = stopping.counted(derailed)
    assert counts.tolist() == [True, False, True]
    assert distance_m.tolist() == [100.0, math.inf]


def test_no_fact_about_a_run_is_read_from_its_sentences():
    table = runs([*range(100, 110), math.nan])
    place = table.column_names.index("invalid_because")
    other_words = pa.array([*[None] * 10, "other words"], pa.string())
    reworded = table.set_column(place, "invalid_because", other_words)
    assert stopping.counted(reworded)[1][-1] == math.inf
    # these words do not make a valid run one that did not stop
    valid = runs([100.0, 101.0]).set_column(
        place, "invalid_because", pa.array([NOT_STOPPED, None], pa.string())
    )
    assert stopping.counted(valid)[1].tolist() == [100.0, 101.0]


def test_the_input_that_drives_all_distances_comes_first_and_a_driver_of_the_tail_shows_there():
    rng = np.random.default_rng(3)
    a = rng.random(400)
    b = rng.random(400)
    table = runs(100.0 + 10.0 * a + 100.0 * np.maximum(b - 0.9, 0.0), a=a, b=b)
    (first, all_of_a, _), (second, all_of_b, tail_of_b) = stopping.drivers(plan(), table)
    assert (first, second) == ("a", "b")
    assert all_of_a > 0.8
    assert tail_of_b > all_of_b + 0.3


def test_the_page_states_that_it_is_no_certificate_and_a_matrix_gives_no_statistics():
    a = np.linspace(0.0, 1.0, 60)
    others = dict.fromkeys(set(figures.BY_NAME) - {"braking_distance_m"}, a)
    table = runs(100.0 + a, a=a, b=a, warnings=pa.nulls(60, pa.string()), **others)
    found = outcome.of_rows(table)
    text = "".join(report._stopping(plan(), found))
    assert "not a certificate" in text
    assert "needs 299 runs" in text
    assert text.count("<svg") == 1
    assert "for orientation" in "".join(report._stopping(plan("sobol"), found))
    assert report._stopping(plan("matrix"), found) == []


def test_the_picture_of_a_large_campaign_shows_each_of_its_longest_stops():
    assert tail.shown_ranks(4).tolist() == [1, 2, 3, 4]
    shown = tail.shown_ranks(1_000_000)
    assert shown[0] == 1
    assert shown[-100:].tolist() == list(range(999_901, 1_000_001))
    assert shown.size < 6000
