"""Proposed stops distinguish causes that the data cannot distinguish, and the bench runs them."""

import tomllib

import numpy as np
import pytest
import tomli_w

from rollerrig.realtime import cli
from rollerrig.realtime.record import records
from rollerrig.realtime.reports import proposed_stops
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.data import dataset, preparation
from rollerrig.rig.identify.decide import fitting
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.next_stops import planning
from rollerrig.rig.identify.next_stops.planning import FittedData, Information, Library
from rollerrig.rig.identify.next_stops.prototype import Stop


def score_test(name: str, size: float, axle: int = 0) -> ScoreTest:
    """Return the significant test of a cause of this size."""
    return ScoreTest(
        name=name,
        axle=axle,
        shape={},
        estimate=(size,),
        bias=(0.0,),
        deviation=(abs(size) / 5.0,),
        statistic=25.0,
        p_value=1e-6,
        expected=1.0,
        spread=1.0,
    )


def silent(title: str, share: float) -> None:
    """Show no progress."""


# two causes that the data cannot distinguish
SPEED = "speed_dependent_friction"
TIME = "friction_trend"
NAMES = (SPEED, TIME)


@pytest.fixture(scope="module")
def fitted() -> FittedData:
    """One stop of the shipped set with its fitted base."""
    data = dataset.load("open_none")
    design = preparation.prepare(data, data.group("tune")[:1])
    fit = fitting.fit(design, candidates.untuned(design), 3, noise=False)
    return FittedData(data, design, fit.explanation)


@pytest.fixture(scope="module")
def speed_or_time(fitted: FittedData) -> Library:
    """The possible stops for the two causes."""
    tests = [score_test(SPEED, 0.004), score_test(TIME, 0.01)]
    return planning.library(fitted, tests, silent)


def test_stops_hardly_distinguish_speed_from_time_and_sliding_at_a_steady_speed_does(
    speed_or_time: Library,
) -> None:
    of_data = speed_or_time.of_data
    without_stop = planning.separation([of_data], NAMES).value
    with_stop = {}
    for stop, of_stop in zip(speed_or_time.stops, speed_or_time.of_stops, strict=True):
        with_stop[stop] = planning.separation([of_data, of_stop], NAMES).value

    def distance_from_data(stop: Stop) -> float:
        """Return how far a stop is from that in the data: all wheelsets brake, from 42.3 m/s."""
        return abs(stop.initial_speed_m_s - 42.3) + 100 * stop.axle

    steady = max(value for stop, value in with_stop.items() if stop.axle)
    like_the_data = min(with_stop, key=distance_from_data)
    assert steady > 3.0 * without_stop
    assert steady > 2.0 * with_stop[like_the_data]


def test_the_first_proposal_is_the_best_and_each_further_one_adds(speed_or_time: Library) -> None:
    proposals = planning.propose(speed_or_time, 3)
    best = max(
        planning.separation([speed_or_time.of_data, of_stop], NAMES).value
        for of_stop in speed_or_time.of_stops
    )
    assert proposals[0].after == pytest.approx(best)

    separations = [proposals[0].before]
    separations += [proposal.after for proposal in proposals]
    assert np.all(np.diff(separations) > 0.0)
    assert len({proposal.stop for proposal in proposals}) == 3


def test_a_full_brake_informs_more_about_a_weak_brake_than_a_gentle_one(fitted: FittedData) -> None:
    library = planning.library(fitted, [score_test("brake_gain", 0.04, axle=2)], silent)
    information = {}
    for stop, of_stop in zip(library.stops, library.of_stops, strict=True):
        if not stop.axle:
            information[stop] = planning.separation([of_stop], ["brake_gain"]).value

    for stop, of_gentle in information.items():
        if stop.pressure_Pa < 2e5 and stop.initial_speed_m_s > 20.0:
            full = stop._replace(pressure_Pa=planning.PRESSURES_PA[-1])
            assert of_gentle < information[full]
    # only the wheelset in question is worth braking alone
    assert {stop.axle for stop in library.stops} == {0, 2}


def test_what_the_base_could_absorb_distinguishes_nothing() -> None:
    keys = ("cause a", "cause b", "base ln_tau ")

    def separation(*matrices: list[list[float]]) -> float:
        """Return the separation of the causes a and b by the information of some runs."""
        runs = [Information(keys, np.array(matrix)) for matrix in matrices]
        return planning.separation(runs, ["a", "b"]).value

    alike = [[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 1.0]]
    different = [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]]
    a_absorbed = [[4.0, 0.0, 2.0], [0.0, 4.0, 0.0], [2.0, 0.0, 1.0]]
    assert separation(alike) == pytest.approx(0.0, abs=1e-6)
    assert separation(alike, different) == pytest.approx(8.0 * 0.75)
    assert separation(a_absorbed) == pytest.approx(0.0, abs=1e-6)


def test_without_candidates_nothing_is_proposed(fitted: FittedData) -> None:
    assert planning.propose(planning.library(fitted, [], silent), 3) == []


def test_possible_stops_vary_speed_pressure_and_mass() -> None:
    stops = planning.possible(dataset.load("open_none"), ())
    full = {stop for stop in stops if stop.axle == 0 and stop.held_s == 0.0}
    assert {stop.pressure_Pa for stop in full} == set(planning.PRESSURES_PA)
    assert len(full) == len(planning.SPEEDS_M_S) * len(planning.PRESSURES_PA) * 2
    masses_kg = {stop.mass_kg for stop in full}
    assert max(masses_kg) == planning.LADEN * min(masses_kg)


def test_every_possible_stop_is_a_sequence_that_is_accepted(
    fitted: FittedData, speed_or_time: Library, tmp_path, capsys
) -> None:
    for k, stop in enumerate(speed_or_time.stops):
        proposal = planning.Proposal(stop, NAMES, 1.0, 2.0)
        text = tomli_w.dumps(proposed_stops.sequence(proposal, fitted))
        (tmp_path / f"next_{k}.toml").write_text(text)
    assert cli.main(["sequence", str(tmp_path), "--check"]) == 0
    capsys.readouterr()


def test_the_bench_runs_sliding_at_a_steady_speed(
    fitted: FittedData, speed_or_time: Library, tmp_path, capsys
) -> None:
    stop = next(stop for stop in speed_or_time.stops if stop.axle)
    # from a lower speed, which takes less time
    stop = stop._replace(initial_speed_m_s=8.0)
    file = tmp_path / "next_1.toml"
    proposal = planning.Proposal(stop, NAMES, 1.0, 2.0)
    file.write_text(tomli_w.dumps(proposed_stops.sequence(proposal, fitted)))
    written = tomllib.loads(file.read_text())
    assert written["start"]["tables"]["rig"]["mode"] == "track"

    assert cli.main(["sequence", str(file), "--out", str(tmp_path / "report")]) == 0
    capsys.readouterr()
    run = records.load(tmp_path / "report" / "next_1")
    speed_m_s = run.column("vehicle_speed_m_s")
    time_s = run.column("time_s")
    assert speed_m_s[0] == pytest.approx(stop.initial_speed_m_s, abs=0.01)
    deceleration_m_s2 = (speed_m_s[0] - speed_m_s[-1]) / time_s[-1]
    assert deceleration_m_s2 < 0.5
    assert np.abs(run.column(f"sliding_{stop.axle}_m_s")).mean() > 0.3
    for other in {1, 2, 3, 4} - {stop.axle}:
        assert np.abs(run.column(f"sliding_{other}_m_s")).mean() < 0.02
