"""The measures of `bench explain`: what counts as right, on verdicts written by hand."""

import pytest
from generator import braking_stops

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.benchmarks import explain as bench
from rollerrig.realtime.benchmarks.explain import Case, Judged


def judged(kind: str, hidden: dict[str, float], verdict: str, *sets: tuple[str, ...],
           covered: bool | None = None, won: float | None = None, possible: float | None = None
           ) -> Judged:
    return Judged(Case(kind, hidden, 0), verdict, [s[0] for s in sets], [set(s) for s in sets],
                  covered, won, possible, 1.0)


def counts(*found: Judged) -> dict[str, tuple[int, int]]:
    return {row["measure"]: (row["yes"], row["of"]) for row in bench.rows(list(found))}


def test_the_first_turn_of_the_matrix_has_every_kind_and_every_cause_has_three_sizes() -> None:
    matrix = bench.cases(braking_stops, 0)
    assert {case.kind for case in matrix[:6]} == {"none", "one", "two", "unknown"}
    assert len({case.seed for case in matrix}) == len(matrix)
    for cause in braking_stops.SMALLEST:
        assert sum(list(case.effects) == [cause] for case in matrix) == 3


def test_a_named_cause_where_nothing_is_hidden_is_a_false_alarm() -> None:
    found = counts(judged("none", {}, "consistent"), judged("none", {}, "explained", ("sanding",)))
    assert found["nothing hidden: consistent"] == (1, 2)


def test_the_truth_counts_first_alone_or_in_a_set_of_two_but_not_of_three() -> None:
    hidden = {"pad_fade": 0.1}
    found = counts(judged("one", hidden, "explained", ("pad_fade", "brake_gain", "torque_offset")),
                   judged("one", hidden, "explained", ("brake_gain", "pad_fade")),
                   judged("one", hidden, "explained", ("brake_gain", "pad_fade", "sanding")),
                   judged("one", hidden, "consistent"))
    assert found["one cause: detected"] == (3, 4)
    assert found["one cause: named first or in a set of two, of detected"] == (2, 3)
    assert found["one cause: in the named set, of detected"] == (3, 3)


def test_second_causes_pairs_and_unknown_ones_are_counted_against_what_was_hidden() -> None:
    found = counts(judged("one", {"sanding": 0.1}, "explained", ("sanding",), ("wheel_radius",)),
                   judged("two", {"sanding": 0.1, "wheel_radius": 0.1}, "explained", ("sanding",)),
                   judged("two", {"sanding": 0.1, "wheel_radius": 0.1}, "explained",
                          ("wheel_radius",), ("sanding",), covered=True),
                   judged("unknown", {"joints": 0.1}, "explained", ("sanding",), covered=False))
    assert found["one cause: a false second cause"] == (1, 1)
    assert found["two causes: both named"] == (1, 2)
    assert found["cause not in the library: given a name"] == (1, 1)
    assert found["95 % intervals hold the truth"] == (1, 2)


def test_the_gain_is_a_median_share_of_what_was_possible_and_small_possible_gains_do_not_count() -> None:
    sets = [judged("one", {"sanding": 0.1}, "explained", ("sanding",), won=w, possible=p)
            for w, p in ((0.10, 0.20), (0.18, 0.20), (0.30, 0.30), (0.50, 0.01), (0.1, None))]
    row = next(r for r in bench.rows(sets) if "possible" in r["measure"])
    assert (row["of"], row["share"]) == (3, 0.18 / 0.20)


def test_generators_are_those_of_the_tests_by_the_same_name() -> None:
    assert bench.generator("braking_stops") is braking_stops
    with pytest.raises(ConfigError, match="only a clone"):
        bench.generator("no_stops")
