"""The verdict as a law of what causes win and what remains behind them."""

import numpy as np
import pytest

from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.decide import choice, decision, evidence, extended_model
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.evidence import ScoreTest


def finding(name: str, statistic: float) -> ScoreTest:
    return ScoreTest(
        name=name,
        axle=0,
        shape={},
        estimate=(0.02,),
        bias=(0.0,),
        deviation=(0.001,),
        statistic=statistic,
        p_value=1e-9 if statistic > 25.0 else 0.5,
        expected=1.0,
        spread=1.0,
    )


def named(won: float, name: str = "speed_sensor_delay") -> IdentifiedCause:
    return IdentifiedCause(
        finding(name, won),
        Cause(name, 0, {}, (0.02,)),
        won,
        (0.25 * won,) * 4 + (0.0,),
        (0.001,),
        (),
        (),
    )


@pytest.mark.parametrize(
    ("left", "verdict"),
    [
        (0.0, "explained"),
        (60.0, "explained"),
        (150.0, "partly"),
        (170.0, "partly"),
        (190.0, "unexplained"),
        (2000.0, "unexplained"),
    ],
)
def test_the_more_remains_behind_a_cause_the_less_is_said(left: float, verdict: str) -> None:
    causes, notes = [named(1000.0)], []
    found = decision._verdict(causes, [finding("along vehicle time", left)], None, notes)
    assert found == verdict
    # what is left is told, unless it is nothing
    assert bool(notes) == (found == "unexplained" or 20.0 < left < 80.0)


def test_the_share_that_remains_is_of_all_that_was_found() -> None:
    assert decision.remainder_share(
        [named(1000.0)], [finding("along time", 250.0)]
    ) == pytest.approx(0.2)
    assert decision.remainder_share([named(1000.0)], []) == 0.0


def test_nothing_named_and_nothing_left_is_consistent() -> None:
    assert decision._verdict([], [], None, []) == "consistent"
    assert decision._verdict([], [finding("along time", 100.0)], None, []) == "unexplained"


def test_two_causes_that_leave_much_are_told_in_a_note_and_not_named() -> None:
    two, notes = [named(1000.0), named(500.0)], list[str]()
    assert (
        decision._verdict(two, [finding("along vehicle time", 200.0)], None, notes) == "unexplained"
    )
    assert notes[0].startswith(
        "behind speed_sensor_delay and speed_sensor_delay much remains along vehicle time"
    )
    assert decision._verdict(two, [finding("along vehicle time", 60.0)], None, []) == "explained"


def test_another_form_of_its_own_excuses_what_one_cause_leaves_and_not_what_two_leave() -> None:
    drag, left = named(1000.0, "running_resistance"), [finding("along vehicle speed", 110.0)]
    assert decision._verdict([drag], left, None, []) == "explained"
    assert decision._verdict([drag, named(10.0)], left, None, []) == "unexplained"


@pytest.mark.parametrize(
    ("first", "second", "won", "lent"),
    [
        # what the first won in each of the filters (four wheelsets, vehicle); the same of the second
        (
            (1000.0, 1000.0, 1000.0, 1000.0, 0.0),
            "running_resistance",
            (0.0, 0.0, 0.0, 0.0, 90.0),
            0.0,
        ),
        ((0.0, 0.0, 0.0, 0.0, 9000.0), "adhesion_memory", (30.0, 30.0, 30.0, 30.0, 0.0), 0.0),
        ((20.0, 20.0, 20.0, 20.0, 2000.0), "sanding", (50.0, 50.0, 50.0, 50.0, 0.0), 8.8),
        (
            (1000.0, 1000.0, 1000.0, 1000.0, 0.0),
            "brake_gain",
            (60.0, 60.0, 60.0, 60.0, 80.0),
            240.0,
        ),
        (
            (1000.0, 1000.0, 1000.0, 1000.0, 0.0),
            "brake_gain",
            (200.0, 200.0, 200.0, 200.0, 0.0),
            440.0,
        ),
        # the level of friction is that of all wheelsets: what the first got wrong behind shows in front
        ((0.0, 1000.0, 1000.0, 1000.0, 0.0), "load_transfer", (70.0, 0.0, 0.0, 0.0, 0.0), 70.0),
    ],
    ids=str,
)
def test_a_wrong_shape_of_the_first_cause_lends_a_second_a_share_of_what_it_won_in_the_same_filters(
    first, second, won, lent
) -> None:
    one, ratio = named(sum(first))._replace(won=first), sum(won)
    assert ratio - choice._net_likelihood(
        one, finding(second, ratio), ratio, np.array(won)
    ) == pytest.approx(lent)


@pytest.mark.parametrize(
    ("won", "lent"), [((80.0, 80.0, 80.0, 80.0, 0.0), 80.0), ((5.0, -2.0, 90.0, 5.0, 0.0), 90.0)]
)
def test_a_wrong_shape_of_a_cause_of_one_wheelset_lends_nothing_in_the_filters_of_the_others(
    won, lent
) -> None:
    radius = named(5000.0)._replace(
        won=(0.0, 0.0, 5000.0, 0.0, 0.0), cause=Cause("wheel_radius", 3, {}, (0.01,))
    )
    ratio = sum(won)
    assert ratio - choice._net_likelihood(
        radius, finding("sanding", ratio), ratio, np.array(won)
    ) == pytest.approx(lent)


def test_a_wrong_shape_of_a_cause_of_all_wheelsets_lends_less_to_one_of_a_single_wheelset() -> None:
    one = named(4000.0)._replace(won=(1000.0, 1000.0, 1000.0, 1000.0, 0.0))
    of_axle_2 = finding("brake_gain", 300.0)._replace(axle=2)
    assert choice._net_likelihood(
        one, of_axle_2, 300.0, np.array([0.0, 300.0, 0.0, 0.0, 0.0])
    ) == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("name", "axle", "shows"),
    [
        ("adhesion_memory", 0, (1, 1, 1, 1, 0)),
        ("running_resistance", 0, (0, 0, 0, 0, 1)),
        ("brake_gain", 0, (1, 1, 1, 1, 1)),
        ("brake_gain", 3, (0, 0, 1, 0, 1)),
        ("wheel_out_of_round", 2, (0, 1, 0, 0, 0)),
    ],
)
def test_a_cause_shows_in_the_filters_of_its_wheelsets_and_what_slows_the_vehicle_in_that_of_the_vehicle(
    name, axle, shows
) -> None:
    assert choice._filters_that_respond(finding(name, 99.0)._replace(axle=axle)).tolist() == list(
        shows
    )


def test_the_model_that_is_judged_and_written_has_a_cause_less_the_bias_of_clean_sets() -> None:
    one = named(100.0)._replace(
        finding=finding("speed_sensor_delay", 100.0)._replace(bias=(0.003,))
    )
    assert one.unbiased.values == pytest.approx((0.017,))
    assert extended_model.parameters(one)["delay_s"]["value"] == pytest.approx(0.017)


def test_a_cause_whose_simulated_stops_do_not_brake_like_the_recording_is_not_named() -> None:
    notes: list[str] = []
    assert decision._verdict([named(1000.0)], None, None, notes) == "unexplained"
    assert "do not brake like the recording" in notes[0]


@pytest.mark.parametrize(
    ("seen", "enough"),
    [
        ({}, True),
        ({"brake_gain": (8.0, 0.5)}, True),
        ({"brake_gain": (14.0, 0.003)}, False),
        ({"brake_gain": (90.0, 1e-9)}, True),
        ({"brake_gain": (90.0, 1e-9), "along time": (14.0, 0.001)}, True),
        ({"contaminated_patch": (90.0, 1e-9)}, False),
        ({"brake_gain": (90.0, 1e-9), "sanding": (80.0, 1e-9)}, False),
        ({"brake_gain": (400.0, 1e-9), "sanding": (80.0, 1e-9)}, True),
    ],
    ids=str,
)
def test_clean_sets_are_enough_where_one_finding_stands_out_or_none_is_near_its_limit_and_no_window_rivals_it(
    seen: dict[str, tuple[float, float]], enough: bool
) -> None:
    found = [finding(name, statistic)._replace(p_value=p) for name, (statistic, p) in seen.items()]
    assert evidence.is_settled(found) is enough


@pytest.mark.parametrize(
    ("less", "form", "alike"),
    [(940.0, 0.07, True), (920.0, 0.07, False), (940.0, 0.0, False), (997.0, 0.0, True)],
)
def test_causes_are_told_apart_only_where_one_wins_more_than_a_wrong_form_may_cost(
    less, form, alike
) -> None:
    # in every block of 3 s the second wins the same share of what the first wins: by chance alone they differ surely
    def fit(won: float) -> choice.Fit:
        return choice.Fit(None, -won, np.zeros((1, 1)), np.full((5, 20), -won / 100.0))

    beside = choice._rivals(
        fit(1000.0), 1000.0, [(choice.Candidate(finding("friction_trend", less), fit(less)), less)]
    )
    assert beside[0].share == less / 1000.0
    assert choice._confusable(beside, form) == (("friction_trend",) if alike else ())
