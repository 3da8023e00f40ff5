"""The verdict as a law of the likelihood that causes win and of the remainder that they leave."""

import math

import numpy as np
import pytest
from scipy.stats import t as student

from rollerrig.realtime.reports import cause_sentences
from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.decide import choice, decision, estimates, evidence
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.notes import Note, NoteCode
from rollerrig.rig.identify.statistics import interval


def score_test(name: str, statistic: float) -> ScoreTest:
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


def identified(ratio: float, name: str = "speed_sensor_delay") -> IdentifiedCause:
    """A cause on all axles that wins the same in the filters of the four wheelsets."""
    return IdentifiedCause(
        score_test=score_test(name, ratio),
        cause=Cause(name, 0, {}, (0.02,)),
        likelihood_ratio=ratio,
        ratio_by_filter=(0.25 * ratio,) * 4 + (0.0,),
        deviation=(0.001,),
        confusable=(),
        rivals=(),
    )


# --- the verdict ---


@pytest.mark.parametrize(
    ("left", "expected", "code"),
    [
        (0.0, "explained", None),
        (60.0, "explained", NoteCode.SMALL_REMAINDER),
        (150.0, "partly", None),
        (170.0, "partly", None),
        (190.0, "unexplained", NoteCode.LARGE_REMAINDER),
        (2000.0, "unexplained", NoteCode.LARGE_REMAINDER),
    ],
)
def test_the_larger_the_remainder_the_more_cautious_is_the_verdict(
    left: float, expected: str, code: NoteCode | None
) -> None:
    remainder = [score_test("along vehicle time", left)]
    verdict, notes = decision.decide_verdict([identified(1000.0)], remainder, None)
    assert verdict == expected
    # `partly` reports its remainder by itself; the others do so in a note
    assert [note.code for note in notes] == ([] if code is None else [code])


def test_the_share_that_remains_is_a_share_of_all_evidence() -> None:
    causes = [identified(1000.0)]
    remainder = [score_test("along time", 250.0)]
    assert decision.remainder_share(causes, remainder) == pytest.approx(0.2)
    assert decision.remainder_share(causes, []) == 0.0


def test_no_cause_and_no_remainder_is_consistent() -> None:
    verdict, notes = decision.decide_verdict([], [], None)
    assert verdict == "consistent"
    assert notes == []

    remainder = [score_test("along time", 100.0)]
    verdict, _ = decision.decide_verdict([], remainder, None)
    assert verdict == "unexplained"


def test_every_cause_whose_shape_other_runs_do_not_show_has_a_note_on_the_gain() -> None:
    for row in table.TABLE:
        if row.unknown_in_other_runs:
            note = Note(NoteCode.GAIN_NOT_JUDGED, causes=(row.name,))
            assert "the gain cannot be judged there" in cause_sentences.note_sentence(note)


def of_size(
    name: str, value: float, deviation: float, freedom: float = math.inf, form: float = 0.0
):
    """A cause of this size, whose coefficient has this standard deviation."""
    found = identified(99.0, name)
    return found._replace(
        score_test=found.score_test._replace(freedom=freedom),
        cause=found.cause._replace(values=(value,)),
        deviation=(deviation,),
        form=form,
    )


@pytest.mark.parametrize("freedom", [19.0, 59.0, math.inf])
def test_a_cause_is_a_finding_if_its_family_wise_interval_excludes_0(freedom: float) -> None:
    quantile = float(student.isf(0.5 * table.ALPHA_CAUSE, freedom))
    for factor in (0.99, 1.01):
        found = of_size("brake_gain", factor * quantile * 0.01, 0.01, freedom)
        size = estimates.family_wise(found)
        assert interval.excludes(size.low, size.high) == (factor > 1.0)
        assert estimates.is_finding(found) == (factor > 1.0)


def test_the_interval_of_a_report_is_inside_the_one_that_decides() -> None:
    for name in ("brake_gain", "wheel_radius", "speed_sensor_delay", "contaminated_patch"):
        found = of_size(name, 0.004, 0.001, freedom=19.0, form=0.07)
        reported = next(iter(estimates.parameters(found).values()))
        decided = estimates.family_wise(found)
        assert decided.low < reported.low < reported.value < reported.high < decided.high


def test_another_form_widens_the_interval_of_a_large_size_and_decides_nothing() -> None:
    exact = next(iter(estimates.parameters(of_size("brake_gain", 0.1, 1e-5)).values()))
    wide = next(iter(estimates.parameters(of_size("brake_gain", 0.1, 1e-5, form=0.07)).values()))
    assert wide.high - wide.low > 10.0 * (exact.high - exact.low)
    # uniform within 7 %: the standard deviation is 4 %
    assert wide.high / wide.value - 1.0 == pytest.approx(1.96 * 0.07 / 3.0**0.5, rel=0.01)
    assert estimates.is_finding(of_size("brake_gain", 0.1, 1e-5, form=0.07))


def test_two_causes_that_leave_a_large_remainder_are_noted_and_not_reported() -> None:
    two = [identified(1000.0), identified(500.0, "brake_gain")]
    verdict, notes = decision.decide_verdict(two, [score_test("along vehicle time", 200.0)], None)
    assert verdict == "unexplained"
    [note] = notes
    assert note.code == NoteCode.LARGE_REMAINDER
    assert cause_sentences.note_sentence(note).startswith(
        "with speed_sensor_delay and brake_gain in the model a large remainder is left along vehicle time"
    )

    verdict, _ = decision.decide_verdict(two, [score_test("along vehicle time", 60.0)], None)
    assert verdict == "explained"


def test_another_form_of_a_cause_excuses_the_remainder_of_one_cause_and_not_of_two() -> None:
    resistance = identified(1000.0, "running_resistance")
    remainder = [score_test("along vehicle speed", 110.0)]
    verdict, _ = decision.decide_verdict([resistance], remainder, None)
    assert verdict == "explained"
    verdict, _ = decision.decide_verdict([resistance, identified(10.0)], remainder, None)
    assert verdict == "unexplained"


def test_a_cause_whose_simulated_stops_do_not_brake_like_the_recording_is_not_reported() -> None:
    verdict, notes = decision.decide_verdict([identified(1000.0)], None, None)
    assert verdict == "unexplained"
    [note] = notes
    assert note.code == NoteCode.NOT_LIKE_RECORDING
    assert "do not brake like the recording" in cause_sentences.note_sentence(note)


def test_the_model_that_is_judged_and_written_has_a_cause_less_the_bias_of_null_simulations() -> (
    None
):
    # the fitted size is 0.02 s
    biased = score_test("speed_sensor_delay", 100.0)._replace(bias=(0.003,))
    cause = identified(100.0)._replace(score_test=biased)
    assert cause.unbiased.values == pytest.approx((0.017,))
    assert estimates.parameters(cause)["delay_s"].value == pytest.approx(0.017)


# --- a second cause ---


@pytest.mark.parametrize(
    ("first_by_filter", "second", "second_by_filter", "lent"),
    [
        # what the causes win in the filters of the four wheelsets and of the vehicle
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
        # the level of friction is that of all wheelsets: an error behind shows in front
        ((0.0, 1000.0, 1000.0, 1000.0, 0.0), "load_transfer", (70.0, 0.0, 0.0, 0.0, 0.0), 70.0),
    ],
    ids=str,
)
def test_a_wrong_shape_of_the_first_cause_lends_a_second_a_share_of_its_likelihood_in_the_same_filters(
    first_by_filter: tuple[float, ...],
    second: str,
    second_by_filter: tuple[float, ...],
    lent: float,
) -> None:
    first = identified(sum(first_by_filter))._replace(ratio_by_filter=first_by_filter)
    ratio = sum(second_by_filter)
    net = choice._net_likelihood(
        first, score_test(second, ratio), ratio, np.array(second_by_filter)
    )
    assert ratio - net == pytest.approx(lent)


@pytest.mark.parametrize(
    ("second_by_filter", "lent"),
    [((80.0, 80.0, 80.0, 80.0, 0.0), 80.0), ((5.0, -2.0, 90.0, 5.0, 0.0), 90.0)],
)
def test_a_wrong_shape_of_a_cause_of_one_wheelset_lends_nothing_in_the_filters_of_the_others(
    second_by_filter: tuple[float, ...], lent: float
) -> None:
    radius = identified(5000.0)._replace(
        ratio_by_filter=(0.0, 0.0, 5000.0, 0.0, 0.0),
        cause=Cause("wheel_radius", 3, {}, (0.01,)),
    )
    ratio = sum(second_by_filter)
    net = choice._net_likelihood(
        radius, score_test("sanding", ratio), ratio, np.array(second_by_filter)
    )
    assert ratio - net == pytest.approx(lent)


def test_a_wrong_shape_of_a_cause_of_all_wheelsets_lends_less_to_a_cause_of_a_single_one() -> None:
    first = identified(4000.0)._replace(ratio_by_filter=(1000.0, 1000.0, 1000.0, 1000.0, 0.0))
    on_axle_2 = score_test("brake_gain", 300.0)._replace(axle=2)
    net = choice._net_likelihood(first, on_axle_2, 300.0, np.array([0.0, 300.0, 0.0, 0.0, 0.0]))
    assert net == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("name", "axle", "responds"),
    [
        ("adhesion_memory", 0, (1, 1, 1, 1, 0)),
        ("running_resistance", 0, (0, 0, 0, 0, 1)),
        ("brake_gain", 0, (1, 1, 1, 1, 1)),
        ("brake_gain", 3, (0, 0, 1, 0, 1)),
        ("wheel_out_of_round", 2, (0, 1, 0, 0, 0)),
        ("brake_gain", -3, (0, 0, 0, 0, 1, 1, 1)),
    ],
)
def test_a_cause_shows_in_the_filters_of_its_wheelsets_and_in_the_vehicles_if_it_slows_the_vehicle(
    name: str, axle: int, responds: tuple[int, ...]
) -> None:
    test = score_test(name, 99.0)._replace(axle=axle)
    filters = choice._filters_that_respond(test, axles=len(responds) - 1)
    assert filters.tolist() == list(responds)


# --- null simulations, and causes that cannot be distinguished ---


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
def test_null_simulations_are_enough_where_one_test_is_clear_or_none_is_near_its_limit_and_no_window_rivals_it(
    seen: dict[str, tuple[float, float]], enough: bool
) -> None:
    tests = []
    for name, (statistic, p_value) in seen.items():
        tests.append(score_test(name, statistic)._replace(p_value=p_value))
    assert evidence.is_settled(tests) is enough


@pytest.mark.parametrize(
    ("other_ratio", "form", "is_confusable"),
    [(940.0, 0.07, True), (920.0, 0.07, False), (940.0, 0.0, False), (997.0, 0.0, True)],
)
def test_causes_are_distinguished_only_where_one_wins_more_than_a_wrong_form_may_cost(
    other_ratio: float, form: float, is_confusable: bool
) -> None:
    # In every block of 3 s the second cause wins the same share of what the first wins. So their
    # difference is not due to chance.
    def fit(ratio: float) -> choice.BlockwiseFit:
        return choice.BlockwiseFit(
            explanation=None,
            deviance=-ratio,
            covariance=np.zeros((1, 1)),
            blocks=np.full((5, 20), -ratio / 100.0),
        )

    other = choice.Candidate(score_test("friction_trend", other_ratio), fit(other_ratio))
    rivals = choice._rivals(fit(1000.0), 1000.0, [(other, other_ratio)])
    assert rivals[0].share == other_ratio / 1000.0
    assert choice._confusable(rivals, form) == (("friction_trend",) if is_confusable else ())
