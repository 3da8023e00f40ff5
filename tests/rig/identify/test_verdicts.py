"""The verdict as a law of what causes win and what remains behind them."""

import pytest

from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.decide import choice, evidence, explain
from rollerrig.rig.identify.decide.choice import NamedCause
from rollerrig.rig.identify.decide.evidence import Finding


def finding(name: str, statistic: float) -> Finding:
    return Finding(name=name, axle=0, shape={}, estimate=(0.02,), bias=(0.0,), deviation=(0.001,), statistic=statistic,
                   p_value=1e-9 if statistic > 25.0 else 0.5, expected=1.0, spread=1.0)


def named(won: float, name: str = "speed_sensor_delay") -> NamedCause:
    return NamedCause(finding(name, won), Cause(name, 0, {}, (0.02,)), won, (0.001,), ())


@pytest.mark.parametrize(("left", "verdict"), [(0.0, "explained"), (60.0, "explained"), (150.0, "partly"),
                                               (300.0, "partly"), (400.0, "unexplained"), (2000.0, "unexplained")])
def test_the_more_remains_behind_a_cause_the_less_is_said(left: float, verdict: str) -> None:
    causes, notes = [named(1000.0)], []
    found = explain._verdict(causes, [finding("along vehicle time", left)], None, notes)
    assert found == verdict
    # what is left is told, unless it is nothing
    assert bool(notes) == (found == "unexplained" or 20.0 < left < 80.0)


def test_the_share_that_remains_is_of_all_that_was_found() -> None:
    assert explain.remainder_share([named(1000.0)], [finding("along time", 250.0)]) == pytest.approx(0.2)
    assert explain.remainder_share([named(1000.0)], []) == 0.0


def test_nothing_named_and_nothing_left_is_consistent() -> None:
    assert explain._verdict([], [], None, []) == "consistent"
    assert explain._verdict([], [finding("along time", 100.0)], None, []) == "unexplained"


def test_two_causes_that_leave_much_are_told_in_a_note_and_not_named() -> None:
    two, notes = [named(1000.0), named(500.0)], list[str]()
    assert explain._verdict(two, [finding("along vehicle time", 200.0)], None, notes) == "unexplained"
    assert notes[0].startswith("behind speed_sensor_delay and speed_sensor_delay much remains along vehicle time")
    assert explain._verdict(two, [finding("along vehicle time", 60.0)], None, []) == "explained"


def test_what_a_second_cause_must_win_is_a_share_of_the_first_unless_nothing_of_the_first_can_show_there() -> None:
    memory, gain, resistance = (finding(name, 100.0) for name in (
        "adhesion_memory", "brake_gain", "running_resistance"))
    of_one_axle = gain._replace(axle=3)
    assert choice._least_beside(named(10_000.0, "adhesion_memory"), resistance) == choice.SECOND_FLOOR
    assert choice._least_beside(named(10_000.0, "brake_gain"), resistance) == pytest.approx(1100.0)
    assert choice._least_beside(named(10_000.0, "running_resistance"), memory) == pytest.approx(1100.0)
    assert choice._least_beside(named(10_000.0, "adhesion_memory"), of_one_axle) == pytest.approx(500.0)


def test_a_cause_whose_simulated_stops_do_not_brake_like_the_recording_is_not_named() -> None:
    notes: list[str] = []
    assert explain._verdict([named(1000.0)], None, None, notes) == "unexplained"
    assert "do not brake like the recording" in notes[0]


@pytest.mark.parametrize(("seen", "enough"), [
    ({}, True), ({"brake_gain": (8.0, 0.5)}, True), ({"brake_gain": (14.0, 0.003)}, False),
    ({"brake_gain": (90.0, 1e-9)}, True), ({"brake_gain": (90.0, 1e-9), "along time": (14.0, 0.001)}, True),
    ({"contaminated_patch": (90.0, 1e-9)}, False), ({"brake_gain": (90.0, 1e-9), "sanding": (80.0, 1e-9)}, False),
    ({"brake_gain": (400.0, 1e-9), "sanding": (80.0, 1e-9)}, True)], ids=str)
def test_clean_sets_are_enough_where_one_finding_stands_out_or_none_is_near_its_limit_and_no_window_rivals_it(
        seen: dict[str, tuple[float, float]], enough: bool) -> None:
    found = [finding(name, statistic)._replace(p_value=p) for name, (statistic, p) in seen.items()]
    assert evidence.settled(found) is enough
